# SPDX-License-Identifier: Apache-2.0
"""What a driver may apply: fresh, finite, of this session, of one controller, within limits."""

import math

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_msgs.msg import JointTorque
from flexarm_ros.torque_gate import Controllers, TorqueGate, TorqueLimit

SESSION, TIMEOUT = 77, 0.05
LIMIT = 13.558179483314  # [N m] 10 lbf ft


@pytest.fixture
def gate():
    """A gate whose states 0 to 3 were published at 0, 10, 20 and 30 ms."""
    gate = TorqueGate(arm_file.load("R"), TIMEOUT)
    gate.begin(SESSION)
    for k in range(4):
        gate.sent(k, 0.01 * k)
    return gate


def torque(value=1.0, sequence=3, **changes):
    fields = {
        "session": SESSION,
        "sequence": sequence,
        "controller_id": 1,
        "mode": JointTorque.ENABLED,
        "joint_names": ["joint1"],
        "torque": [value],
    }
    return JointTorque(**{**fields, **changes})


def test_a_fresh_torque_passes_until_the_state_it_answers_is_too_old(gate):
    assert gate.torque(0.03) is None and gate.reason == "no torque yet"
    assert gate.offer(torque(), 0.031) == ""
    np.testing.assert_array_equal(gate.torque(0.03 + TIMEOUT), [1.0])
    assert gate.torque(0.0301 + TIMEOUT) is None
    assert gate.reason == "no fresh torque for 0.05 s"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"session": SESSION + 1}, "torque for session 78, this is session 77"),
        ({"sequence": 4}, "torque for state 4, which is older than the timeout or was never sent"),
        ({"sequence": 1}, "torque for state 1 after that for 2"),
    ],
)
def test_what_answers_another_state_is_left_aside_and_the_torque_before_goes_on(
    gate, changes, reason
):
    gate.offer(torque(2.0, sequence=2), 0.03)
    assert gate.offer(torque(9.0, **changes), 0.031) == reason
    np.testing.assert_array_equal(gate.torque(0.04), [2.0])
    assert gate.torque(0.071) is None  # state 2 was published at 20 ms: it stays as old as it is


def test_a_torque_for_a_state_older_than_the_timeout_is_left_aside(gate):
    gate.sent(4, 0.055)
    assert "older than the timeout" in gate.offer(torque(sequence=0), 0.056)
    assert gate.torque(0.056) is None


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"mode": JointTorque.DISABLED}, "the controller says DISABLED"),
        ({"mode": 7}, "mode: 7 is no mode"),
        ({"torque": [math.nan]}, "torque of joint1: nan N m is no torque"),
        ({"torque": [math.inf]}, "torque of joint1: inf"),
        ({"torque": []}, "torque: is empty"),
        ({"joint_names": ["elbow"]}, "missing joint1; unknown elbow"),
    ],
)
def test_what_cannot_be_used_brings_the_safe_action_at_once(gate, changes, reason):
    gate.offer(torque(sequence=2), 0.03)
    assert reason in gate.offer(torque(**changes), 0.031)
    assert gate.torque(0.031) is None and reason in gate.reason
    assert gate.offer(torque(), 0.032) == ""  # the next good one is applied again


def test_torque_is_clipped_to_the_limit_and_counted(gate):
    assert gate.offer(torque(-1000.0), 0.031) == ""
    np.testing.assert_allclose(gate.torque(0.031), [-LIMIT])
    assert gate.clipped == 1


def test_two_controllers_in_turn_bring_the_safe_action_until_one_is_silent(gate):
    assert gate.offer(torque(controller_id=1, sequence=1), 0.031) == ""
    assert gate.offer(torque(controller_id=2, sequence=1), 0.032) == ""  # one that was restarted
    assert "several controllers" in gate.offer(torque(controller_id=1, sequence=2), 0.033)
    assert gate.torque(0.033) is None
    for k in range(4, 120):  # one of them alone from now on
        now = 0.01 * k
        gate.sent(k, now)
        reason = gate.offer(torque(controller_id=1, sequence=k), now)
        assert (reason == "") == (now >= 0.033 + TorqueGate.ALONE)


def test_a_new_session_forgets_torque_and_controllers(gate):
    gate.offer(torque(), 0.031)
    gate.begin(SESSION + 1)
    assert gate.torque(0.032) is None
    assert gate.offer(torque(), 0.033) == "torque for session 77, this is session 78"


def test_sequence_wraps_as_uint32(gate):
    gate.sent(2**32 - 1, 0.04)
    gate.sent(0, 0.05)
    assert gate.offer(torque(1.0, sequence=2**32 - 1), 0.051) == ""
    assert gate.offer(torque(2.0, sequence=0), 0.052) == ""
    np.testing.assert_array_equal(gate.torque(0.06), [2.0])


def test_controllers_are_distinguished_in_any_unit_of_time():
    seen = Controllers(alone=100)
    assert not seen.note(7, 0) and not seen.note(8, 1)  # 8: the same one, restarted
    assert seen.pair == ()
    assert seen.note(7, 2) and seen.pair == (7, 8)
    assert seen.note(7, 101) and not seen.note(7, 102)
    seen.forget()
    assert seen.ids == set() and not seen.note(8, 103)


def test_a_limit_clips_each_joint_and_counts_torques():
    limit = TorqueLimit(arm_file.load("two_link"))
    np.testing.assert_array_equal(limit.clip(np.array([5.0, -2.0])), [5.0, -2.0])
    assert limit.clipped == 0
    np.testing.assert_array_equal(limit.clip(np.array([9.0, -2.5])), [5.0, -2.0])
    assert limit.clipped == 1
