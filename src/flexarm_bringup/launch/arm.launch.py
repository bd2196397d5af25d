# SPDX-License-Identifier: Apache-2.0
"""One arm: simulator, observer and controller; `with_simulator:=false` where a driver runs."""

from flexarm_bringup import launching


def generate_launch_description():
    """Arguments and nodes: ``ros2 launch flexarm_bringup arm.launch.py --show-args``."""
    return launching.description(launching.ONE_ARM, launching.one_arm)
