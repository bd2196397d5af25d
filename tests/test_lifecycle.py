# SPDX-License-Identifier: Apache-2.0
"""Every node answers every transition in every state: a wrong one is refused with a word, and changes nothing."""

import os
import sys
import tty
from pathlib import Path
from unittest import mock

import pytest
import rclpy
from harness import Bench, Drive
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.lifecycle import TransitionCallbackReturn

from flexarm_control.nodes.controller import ControllerNode
from flexarm_control.nodes.excite import ExciteNode
from flexarm_control.nodes.observer import ObserverNode
from flexarm_control.nodes.observer_controller import nodes as observer_controller
from flexarm_sim.nodes.simulator import SimulatorNode
from flexarm_tools.adapters.ros2_control import AdapterNode
from flexarm_tools.running.processes import arguments, own_domain
from flexarm_tools.shape.node import ShapeNode

sys.path.insert(
    0, str(Path(__file__).resolve().parents[1] / "examples" / "flexarm_driver_template")
)

from flexarm_driver_template.driver import DriverNode

NODES = {
    "simulator": SimulatorNode,
    "observer": ObserverNode,
    "controller": ControllerNode,
    "observer in one process": lambda: observer_controller()[1],
    "controller in one process": lambda: observer_controller()[0],
    "excite": ExciteNode,
    "driver template": DriverNode,
    "ros2_control adapter": AdapterNode,
    "shape": ShapeNode,
}
#: State: transitions that are possible in it, and where they lead.
POSSIBLE = {
    "unconfigured": {1: "inactive", 5: "finalized"},
    "inactive": {2: "unconfigured", 3: "active", 6: "finalized"},
    "active": {4: "inactive", 7: "finalized"},
    "finalized": {},
}
LABELS = ("configure", "cleanup", "activate", "deactivate", "shutdown", "fly", "")
#: What every state has to refuse, and what brings the node to the next state.
WAY = (("unconfigured", 1), ("inactive", 3), ("active", 7), ("finalized", None))


@pytest.fixture
def made(monkeypatch):
    """Makes nodes by the names of `NODES`."""
    line, port = os.openpty()
    tty.setraw(port)
    values = {"arm": "R", "port": os.ttyname(port), "fast.type": "none", "design_process": False}
    nodes = []
    monkeypatch.setitem(os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")

    def make(name):
        nodes.append(NODES[name]())
        return nodes[-1]

    with own_domain() as domain:
        rclpy.init(args=arguments(values), domain_id=domain)
        yield make
        for node in nodes:
            if node.active:
                node.stop()
            node.destroy_node()
        rclpy.try_shutdown()
    os.close(line)
    os.close(port)


def call(node, kind, service, request):
    """What the service of a node answers."""
    name = f"{node.get_fully_qualified_name()}/{service}"
    (offered,) = (s for s in node.services if s.service_name == name)
    return offered.callback(request, kind.Response())


def change(node, number=0, label=""):
    """Ask for a transition; whether it succeeded."""
    wanted = Transition(id=number, label=label)
    return call(node, ChangeState, "change_state", ChangeState.Request(transition=wanted)).success


def state(node):
    """Label of the node's state."""
    return call(node, GetState, "get_state", GetState.Request()).current_state.label


@pytest.mark.parametrize("name", NODES)
def test_a_wrong_transition_is_refused_with_a_word_in_every_state(made, name):
    node = made(name)
    for here, onwards in WAY:
        assert state(node) == here
        before = node.active, len(node._made), list(node.timers)
        for number in (*range(10), 10, 60, 99, 255):
            if number not in POSSIBLE[here]:
                with mock.patch.object(node, "_logger") as log:
                    assert not change(node, number)
                assert f"transition {number}" in str(log.error.call_args_list)
        for label in LABELS:
            if not any(label and label in reached(here, n) for n in POSSIBLE[here]):
                with mock.patch.object(node, "_logger") as log:
                    assert not change(node, 0, label)
                assert f"transition {label or 0}" in str(log.error.call_args_list)
        assert state(node) == here
        assert before == (node.active, len(node._made), list(node.timers))
        if onwards:
            assert change(node, onwards)


def reached(here, number):
    """Labels under which a transition that is possible in a state can be asked for."""
    names = {1: "configure", 2: "cleanup", 3: "activate", 4: "deactivate"}
    return {names.get(number, "shutdown")}


@pytest.mark.parametrize("name", NODES)
def test_every_node_goes_all_ways_twice(made, name):
    node = made(name)
    for _ in range(2):
        for number, there in ((1, "inactive"), (3, "active"), (4, "inactive"), (2, "unconfigured")):
            assert change(node, number) and state(node) == there
    assert not node._made and not node.active


def test_over_dds_a_wrong_transition_is_answered_and_the_arm_goes_on(tmp_path):
    with Bench(tmp_path) as bench:
        bench.start("simulator", {"arm": "R", "lockstep": True, "pause_at": -1.0})
        drive = Drive(bench)
        for number, label in ((3, ""), (1, ""), (2, ""), (99, ""), (0, "fly")):
            wanted = Transition(id=number, label=label)
            assert not bench.call(ChangeState, "simulator/change_state", transition=wanted).success
        assert bench.lifecycle("simulator") == "active"
        drive.step(1.0)
        assert "activate) is not possible while active" in bench.log("simulator")
        assert "Traceback" not in bench.log("simulator")


class Breaks(ExciteNode):
    """A node whose methods fail where `broken` says so."""

    broken = ""

    def build(self):
        super().build()
        self._keep(self.destroy, "what")
        self.fail("build")

    def start(self):
        self.fail("start")

    def stop(self):
        self.fail("stop")

    def destroy(self, thing):
        self.fail("destroy")

    def fail(self, method):
        if self.broken == method:
            raise RuntimeError(f"{method} has failed")


@pytest.mark.parametrize(
    ("broken", "transitions", "there"),
    [
        ("build", {1: False}, "unconfigured"),
        ("start", {1: True, 3: False}, "inactive"),
        ("stop", {1: True, 3: True, 4: True}, "inactive"),
        ("destroy", {1: True, 2: True}, "unconfigured"),
    ],
)
def test_what_fails_in_a_transition_is_logged_and_leaves_the_node_usable(
    made, monkeypatch, broken, transitions, there
):
    monkeypatch.setitem(NODES, "breaks", Breaks)
    node = made("breaks")
    node.broken = broken
    for number, works in transitions.items():
        assert change(node, number) == works
    assert state(node) == there and not node.active
    assert f"{broken} has failed" in node.failure
    node.broken = ""
    if there == "unconfigured":
        assert change(node, 1)
    assert change(node, 3) and state(node) == "active"
    assert node.trigger_activate() == TransitionCallbackReturn.ERROR
