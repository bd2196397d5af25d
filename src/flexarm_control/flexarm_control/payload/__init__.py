# SPDX-License-Identifier: Apache-2.0
"""Estimate of the payload from strains and joint torques."""
