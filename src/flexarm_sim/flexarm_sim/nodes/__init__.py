# SPDX-License-Identifier: Apache-2.0
"""Nodes of this package, and their entry points."""

from flexarm_ros.start import start


def start_simulator():
    """Entry point of ``ros2 run flexarm_sim simulator``."""
    start("flexarm_sim.nodes.simulator")


def start_hardware():
    """Entry point of ``ros2 run flexarm_sim hardware``."""
    start("flexarm_sim.nodes.hardware")
