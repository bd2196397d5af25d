# SPDX-License-Identifier: Apache-2.0
"""Nodes of this package, and their entry points."""

from functools import partial

from flexarm_ros.start import start

# ``ros2 run flexarm_control observer``, and so on.
start_observer = partial(start, "flexarm_control.nodes.observer")
start_controller = partial(start, "flexarm_control.nodes.controller")
start_observer_controller = partial(start, "flexarm_control.nodes.observer_controller")
start_goals = partial(start, "flexarm_control.nodes.goals")
start_excite = partial(start, "flexarm_control.nodes.excite")
start_shaper = partial(start, "flexarm_control.nodes.shaper")
