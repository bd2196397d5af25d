# SPDX-License-Identifier: Apache-2.0
"""Nodes that stand in for a driver where an arm already has other ROS topics."""

from flexarm_ros.start import start


def start_ros2_control_adapter():
    """Entry point of ``ros2 run flexarm_bringup ros2_control_adapter``."""
    start("flexarm_tools.adapters.ros2_control")
