# SPDX-License-Identifier: Apache-2.0
"""Two arms side by side, each in a namespace of its own."""

from flexarm_bringup import launching


def generate_launch_description():
    """Arguments and nodes: ``ros2 launch flexarm_bringup two_arms.launch.py --show-args``."""
    return launching.description(launching.TWO_ARMS, launching.two_arms)
