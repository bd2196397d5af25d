# SPDX-License-Identifier: Apache-2.0
"""Control laws, observers and trajectories for arms with flexible links; only `nodes` uses ROS."""
