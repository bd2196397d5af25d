# SPDX-License-Identifier: Apache-2.0
"""Plays a recording as a driver: `playback` orders samples, `node` publishes them, `command` is ``flexarm replay``."""

from flexarm_ros.start import start


def start_replay():
    """Entry point of ``ros2 run flexarm_bringup replay``."""
    start("flexarm_tools.replay.node")
