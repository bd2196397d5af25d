# SPDX-License-Identifier: Apache-2.0
"""What a joint_trajectory_controller shows beside its action: its state, and the reference at a time."""

import re
import sys
import types

import pytest
from builtin_interfaces.msg import Time
from harness import PATIENT, Arm, trajectory
from in_process import InProcess
from std_msgs.msg import Float64

from flexarm_control.motions import profiles
from flexarm_msgs.msg import CompositeState, JointTrajectoryControllerState
from flexarm_msgs.srv import QueryTrajectoryState

J, MS = ["joint1"], 1_000_000


@pytest.fixture
def control_msgs(monkeypatch):
    """Modules in its place, with our own types: the wheels have no control_msgs."""
    monkeypatch.setattr(Float64, "factor", property(lambda self: self.data), raising=False)
    kinds = {
        "msg": {
            "JointTrajectoryControllerState": JointTrajectoryControllerState,
            "SpeedScalingFactor": Float64,  # a message of one number, too
        },
        "srv": {"QueryTrajectoryState": QueryTrajectoryState},
    }
    for name, types_ in kinds.items():
        module = types.ModuleType(f"control_msgs.{name}")
        module.__dict__.update(types_)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(sys.modules, "control_msgs", types.ModuleType("control_msgs"))


def test_the_state_and_the_reference_at_any_time_are_served_in_both_types(control_msgs):
    with InProcess() as bench:
        arm = standing(bench, "one_link")
        taps = [
            bench.tap(JointTrajectoryControllerState, f"controller/{name}")
            for name in ("trajectory_state", "controller_state")
        ]
        arm.offer(trajectory(J, (1.0, [0.3], [0.0], [0.0])))
        start = arm.now + MS
        arm.run(0.5)
        quintic = profiles.quintic(0.0, 0.3, 1.0)
        for tap in taps:
            state = tap.newest
            sent = state.header.stamp.sec * 10**9 + state.header.stamp.nanosec
            wanted = quintic.position((sent - start) * 1e-9)
            assert state.reference.positions[0] == pytest.approx(float(wanted[0]), abs=1e-9)
            assert state.error.positions[0] == pytest.approx(
                state.reference.positions[0] - state.feedback.positions[0]
            )
            assert state.output.effort[0] != 0.0
            assert state.speed_scaling_factor == 1.0
        for name in ("query_trajectory_state", "query_state"):
            ahead = start + 800 * MS
            answer = bench.call(QueryTrajectoryState, f"controller/{name}", time=_time(ahead))
            assert answer.success, answer.message
            assert list(answer.name) == J
            assert answer.position[0] == pytest.approx(float(quintic.position(0.8)[0]))
            assert answer.velocity[0] == pytest.approx(float(quintic.velocity(0.8)[0]))
            past = bench.call(QueryTrajectoryState, f"controller/{name}", time=_time(5 * MS))
            assert not past.success
            assert "5000000 ns is past: the arm's clock shows" in past.message
        assert arm.state.supervisor_state == CompositeState.TRACKING


def test_a_factor_on_the_topic_is_as_the_parameter(control_msgs):
    with InProcess() as bench:
        arm = standing(bench, "R")
        factor = bench.publisher(Float64, "controller/speed_scaling_input")
        for given in (0.5, 2.0, float("nan"), -1.0):
            factor.publish(Float64(data=given))
            arm.run(0.01)
            assert bench.get("controller", "speed_scaling") == 0.5
        assert re.search("speed_scaling_input: .*speed_scaling .*2.0", bench.log("controller"))


def standing(bench, name):
    """An arm of this name that has torque, in lockstep, at its tenth sample."""
    lockstep = {"lockstep": True, "pause_at": 0.01, "resend_period": 0.02}
    bench.start_loop(lockstep, controller={**PATIENT, "fast.type": "none"}, arm=name)
    arm = Arm(bench, pauses_at=10)
    arm.wait_standing()
    return arm


def _time(ns):
    return Time(sec=ns // 10**9, nanosec=ns % 10**9)
