# SPDX-License-Identifier: Apache-2.0
"""Observer and controller beside the driver of a real arm."""

from flexarm_bringup import launching


def generate_launch_description():
    """Arguments and nodes: ``ros2 launch flexarm_bringup driver.launch.py --show-args``."""
    return launching.description(launching.BESIDE_A_DRIVER, launching.beside_a_driver)
