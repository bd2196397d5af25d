# SPDX-License-Identifier: Apache-2.0
"""Parameters that are set faster than laws can be designed: the newest counts, and the loop goes on."""

from types import SimpleNamespace

import pytest
from harness import PATIENT, Arm, Bench
from rcl_interfaces.srv import SetParameters

from flexarm_control.nodes import controller_designs
from flexarm_control.nodes.controller_designs import Designs
from flexarm_dynamics.errors import DesignError
from flexarm_ros.session import parameter_messages

RATE = 200.0  # [Hz] of the samples, and of the sets
COUNT = 200
#: The values that are set, one after the other.
VALUES = [6.26 + 0.01 * k for k in range(COUNT)]
#: Most requests without an answer [-]. A service keeps ten: of more, where a process waits for its turn, the oldest are
#: lost without an answer.
UNANSWERED = 8


class FakeNode:
    """As much of the controller node as `Designs` uses; what it hands over is done at once."""

    def __init__(self):
        self.now, self.taken, self.log = {"slow.kp": 0}, [], []
        self.parameters = SimpleNamespace(
            values=lambda: dict(self.now), on_change=lambda call: None
        )

    def hand_over(self, call, *args):
        call(*args)

    def get_logger(self):
        add = self.log.append
        return SimpleNamespace(error=add, warning=add, info=lambda text: None)

    def set_parameters_atomically(self, old):
        self.now |= {p.name: p.value for p in old}


class FakeDesigner:
    """Designs numbers; refuses negative ones."""

    closed = False

    def design(self, values):
        if values["slow.kp"] < 0:
            raise DesignError("is negative", field="slow.kp")
        return SimpleNamespace(value=values["slow.kp"], warnings=lambda: ())


@pytest.fixture
def designs():
    """A `Designs` whose thread does nothing until ``work()``."""
    node = FakeNode()
    core = SimpleNamespace(replace_law=lambda law: node.taken.append(law.value))
    made = Designs(node, core, FakeDesigner())
    made._thread.shutdown()
    tasks = []
    made._thread = SimpleNamespace(submit=tasks.append, shutdown=lambda **_: None)

    def change(value):
        node.now["slow.kp"] = value
        made.changed({"slow.kp"})

    def work():
        while tasks:
            tasks.pop(0)()

    made.change, made.work, made.node = change, work, node
    return made


def test_only_the_newest_of_many_changes_is_designed(designs):
    for value in range(1, 200):
        designs.change(value)
    designs.work()
    assert designs.node.taken == [199] and designs.node.log == []
    designs.change(7)
    designs.work()
    assert designs.node.taken == [199, 7]


def test_where_the_newest_is_refused_the_newest_good_one_counts(designs):
    for value in (3, 4, -5, -6):
        designs.change(value)
    designs.work()
    assert designs.node.taken == [4] and designs.node.now == {"slow.kp": 4}
    assert len(designs.node.log) == 2 and "-6" not in str(designs.node.taken)
    designs.change(-7)
    designs.work()
    assert designs.node.taken == [4] and designs.node.now == {"slow.kp": 4}


def test_a_change_that_comes_during_a_design_is_the_next(designs, monkeypatch):
    monkeypatch.setattr(controller_designs, "MAX_PAUSE", 0.0)
    design = designs._designer.design

    def interrupted(values):
        if values["slow.kp"] == 1:
            designs.change(2)
        return design(values)

    designs._designer.design = interrupted
    designs.change(1)
    designs.work()
    assert designs.node.taken == [1, 2]


def one_set(bench, value):
    """The answer to one set, once it has come."""
    message = parameter_messages({"slow.kp": [value]})
    asked = bench.ask(SetParameters, "controller/set_parameters", parameters=message)
    bench.wait_for("the answer", asked.poll)


def states_without_torque(bench, arm):
    """Numbers of the states, while all sets are made and for a second more, whose torque was older than the timeout."""
    asked, mark = [], len(arm.measured.messages)

    def all_asked():
        waiting = sum(not a.answer for a in asked)
        due = min(len(arm.measured.messages) - mark, COUNT)
        for _ in range(min(due - len(asked), UNANSWERED - waiting)):
            message = parameter_messages({"slow.kp": [VALUES[len(asked)]]})
            asked.append(bench.ask(SetParameters, "controller/set_parameters", parameters=message))
        return len(asked) == COUNT

    bench.wait_for("the sets", all_asked)
    bench.wait_for("all answers", lambda: all(a.answer for a in asked))
    assert all(a.answer.results[0].successful for a in asked)
    end = len(arm.measured.messages)
    bench.wait_for("a second more", lambda: len(arm.measured.messages) > end + RATE)
    # A state that names the controller: its torque is no older than the timeout.
    return [m.sequence for m in arm.measured.messages[mark:] if not m.controller_id]


@pytest.mark.real_time
def test_two_hundred_sets_at_200_hz_take_no_torque_away(tmp_path):
    with Bench(tmp_path) as bench:
        bench.ask_again = bench.patience
        bench.start_loop(arm="R", simulator={"rate": RATE}, controller=PATIENT)
        arm = Arm(bench)
        arm.wait_ready()
        bench.wait_for("torque", lambda: arm.measured.newest.controller_id)
        # The process that designs has started before the sets begin.
        one_set(bench, 6.25)
        # The machine may stand still for longer than the timeout, with sets or without: one time in four must be whole.
        lost = (states_without_torque(bench, arm) for _ in range(4))
        assert any(not numbers for numbers in lost)
        assert bench.get("controller", "slow.kp") == [VALUES[-1]]
        assert "refused" not in bench.log("controller")
