# SPDX-License-Identifier: Apache-2.0
"""Motions: profiles, shapers, tip paths, the least exciting time law, and excitation for identification."""
