# SPDX-License-Identifier: Apache-2.0
"""The three nodes on one arm, and the paper's motion."""

from flexarm_bringup import launching


def generate_launch_description():
    """Arguments and nodes: ``ros2 launch flexarm_bringup case_study.launch.py --show-args``."""
    return launching.description(launching.CASE_STUDY, launching.case_study)
