# SPDX-License-Identifier: Apache-2.0
"""Defines plants that are not the controller's model, runs controllers on them, and tunes baselines for them."""
