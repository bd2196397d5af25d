# SPDX-License-Identifier: Apache-2.0
"""Designs for arms that differ from their arm file: gains that are optimised over a set of sampled loops."""
