# SPDX-License-Identifier: Apache-2.0
"""The arm: its data, its file, its sections and strain gauges, its URDF."""
