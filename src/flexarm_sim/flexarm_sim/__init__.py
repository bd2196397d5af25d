# SPDX-License-Identifier: Apache-2.0
"""Simulation of arms with flexible links; ROS only in `nodes`."""
