# SPDX-License-Identifier: Apache-2.0
"""Dynamics of arms with flexible links; no ROS anywhere in this package."""
