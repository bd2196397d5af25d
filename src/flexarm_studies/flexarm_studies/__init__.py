# SPDX-License-Identifier: Apache-2.0
"""Studies of arms under control, without ROS: closed loop, case study, analysis, comparison, identification."""
