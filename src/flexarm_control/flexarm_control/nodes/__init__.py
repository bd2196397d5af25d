# SPDX-License-Identifier: Apache-2.0
"""Nodes of this package, and their entry points."""

from flexarm_ros.start import start


def start_observer():
    """Entry point of ``ros2 run flexarm_control observer``."""
    start("flexarm_control.nodes.observer")


def start_controller():
    """Entry point of ``ros2 run flexarm_control controller``."""
    start("flexarm_control.nodes.controller")


def start_observer_controller():
    """Entry point of ``ros2 run flexarm_control observer_controller``."""
    start("flexarm_control.nodes.observer_controller")


def start_excite():
    """Entry point of ``ros2 run flexarm_control excite``."""
    start("flexarm_control.nodes.excite")
