# SPDX-License-Identifier: Apache-2.0
"""Runs the case study of Siciliano & Book (1986), section 5."""
