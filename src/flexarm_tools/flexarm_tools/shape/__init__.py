# SPDX-License-Identifier: Apache-2.0
"""Draws a running arm: `drawing` has the mathematics, `node` publishes it for RViz, `flexarm view` shows it."""

from flexarm_ros.start import start


def start_shape():
    """Entry point of ``ros2 run flexarm_bringup shape``."""
    start("flexarm_tools.shape.node")
