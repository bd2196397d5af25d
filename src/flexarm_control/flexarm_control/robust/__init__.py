# SPDX-License-Identifier: Apache-2.0
"""Designs for arms that are not quite what their file says: gains, optimised over a set of sampled loops."""
