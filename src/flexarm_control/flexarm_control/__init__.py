# SPDX-License-Identifier: Apache-2.0
"""Laws, observers and trajectories for arms with flexible links; ROS only in `nodes`."""
