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
    """A gate whose states 0 to 3 were published at 0, 10, 20 and 30 ms; those after 0 name controller 1."""
    gate = TorqueGate(arm_file.load("R"), TIMEOUT)
    gate.begin(SESSION)
    assert gate.sent(0, 0.0) == 0
    assert gate.offer(torque(sequence=0, mode=JointTorque.DISABLED), 0.001) == gate.DISABLED
    for k in (1, 2, 3):
        assert gate.sent(k, 0.01 * k) == 1
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
    assert gate.torque(0.03) is None and gate.reason == gate.DISABLED
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
        ({"controller_id": 0}, "controller_id: 0 is no controller's"),
    ],
)
def test_what_cannot_be_used_brings_the_safe_action_at_once(gate, changes, reason):
    gate.offer(torque(sequence=2), 0.03)
    assert reason in gate.offer(torque(**changes), 0.031)
    assert gate.torque(0.031) is None and reason in gate.reason
    refused = changes.get("mode") != JointTorque.DISABLED
    assert gate.sent(4, 0.04) == (0 if refused else 1)
    if "controller_id" not in changes:
        assert gate.offer(torque(sequence=4), 0.041) == (gate.UNCONFIRMED if refused else "")
        assert gate.sent(5, 0.05) == 1
        assert gate.offer(torque(sequence=5), 0.051) == ""  # good ones are applied again


def test_torque_is_clipped_to_the_limit_and_counted(gate):
    assert gate.offer(torque(-1000.0), 0.031) == ""
    np.testing.assert_allclose(gate.torque(0.031), [-LIMIT])
    assert gate.clipped == 1


def test_two_controllers_in_turn_bring_the_safe_action_until_one_is_silent(gate):
    assert gate.offer(torque(controller_id=1, sequence=1), 0.031) == ""
    assert gate.offer(torque(controller_id=2, sequence=1), 0.032) == gate.UNCONFIRMED
    assert gate.torque(0.032) is None  # whose is the right one?
    assert "several controllers" in gate.offer(torque(controller_id=1, sequence=2), 0.033)
    assert gate.torque(0.033) is None
    for k in range(4, 120):  # one of them alone from now on
        now = 0.01 * k
        named = gate.sent(k, now)
        reason = gate.offer(torque(controller_id=1, sequence=k), now)
        assert (reason == "") == (now >= 0.043 + TorqueGate.ALONE)
        assert (named == 1) == (now >= 0.043 + TorqueGate.ALONE)
        assert (gate.torque(now) is None) == (reason != "")
        assert ("controllers (1, 2)" in gate.controllers.doubt(now)) == (now < 0.033 + gate.ALONE)


def test_a_new_session_forgets_torque_and_controllers(gate):
    gate.offer(torque(), 0.031)
    gate.begin(SESSION + 1)
    assert gate.torque(0.032) is None
    assert gate.offer(torque(), 0.033) == "torque for session 77, this is session 78"


def test_sequence_wraps_as_uint32(gate):
    gate.begin(SESSION)
    for k, at in ((2**32 - 2, 0.03), (2**32 - 1, 0.04), (0, 0.05)):
        gate.sent(k, at)
        if k == 2**32 - 2:
            assert gate.offer(torque(sequence=k), at) == gate.UNCONFIRMED
    assert gate.offer(torque(1.0, sequence=2**32 - 1), 0.051) == ""
    assert gate.offer(torque(2.0, sequence=0), 0.052) == ""
    np.testing.assert_array_equal(gate.torque(0.06), [2.0])


def test_only_the_answer_to_a_state_that_names_its_controller_acts():
    gate = TorqueGate(arm_file.load("R"), TIMEOUT)
    gate.begin(SESSION)
    assert gate.sent(0, 0.0) == 0 and gate.sent(1, 0.01) == 0
    assert gate.offer(torque(sequence=0), 0.011) == gate.UNCONFIRMED
    assert gate.torque(0.011) is None and gate.reason == gate.UNCONFIRMED
    assert gate.sent(2, 0.02) == 1
    assert gate.offer(torque(sequence=1), 0.021) == gate.UNCONFIRMED  # its state named none
    assert gate.sent(3, 0.03) == 1
    assert gate.offer(torque(sequence=2), 0.031) == ""
    np.testing.assert_array_equal(gate.torque(0.031), [1.0])
    # Nothing came for the timeout: the next states name none, and the claim is made anew.
    assert gate.sent(4, 0.08) == 0
    assert gate.offer(torque(sequence=4), 0.081) == gate.UNCONFIRMED
    assert gate.sent(5, 0.09) == 1
    assert gate.offer(torque(sequence=5), 0.091) == ""


def test_a_stranger_with_another_id_is_not_applied_and_ends_the_claim(gate):
    assert gate.offer(torque(2.0, sequence=2), 0.03) == ""
    assert gate.offer(torque(9.0, controller_id=5), 0.031) == gate.UNCONFIRMED
    assert gate.torque(0.031) is None
    assert gate.sent(4, 0.04) == 5
    assert "controllers (1, 5)" in gate.offer(torque(2.0), 0.041)
    assert gate.sent(5, 0.05) == 0
    for controller in (1, 5):
        assert gate.offer(torque(9.0, sequence=4, controller_id=controller), 0.051)
    assert gate.torque(0.051) is None


@pytest.mark.parametrize("values", [(2.0, 9.0), (1000.0, 1001.0)], ids=["", "both clipped"])
def test_two_torques_for_one_state_under_one_id_are_a_race(gate, values):
    assert gate.offer(torque(values[0]), 0.031) == ""
    assert gate.offer(torque(values[0]), 0.032) == ""  # sent again
    assert "two answers to one state" in gate.offer(torque(values[1]), 0.033)
    assert gate.torque(0.033) is None and gate.controllers.doubt(0.034) == Controllers.RACED
    for k in range(4, 120):
        now = 0.01 * k
        named = gate.sent(k, now)
        assert (gate.offer(torque(sequence=k), now) == "") == (named == 1)
        assert (named == 1) == (now >= 0.043 + TorqueGate.ALONE)


def test_disabled_may_follow_a_torque_for_the_same_state_but_no_torque_follows_disabled(gate):
    assert gate.offer(torque(), 0.031) == ""
    assert gate.offer(torque(mode=JointTorque.DISABLED), 0.032) == gate.DISABLED
    assert gate.offer(torque(), 0.033) == "torque for state 3 after DISABLED for it"
    assert gate.torque(0.033) is None and not gate.controllers.several(0.033)
    assert gate.sent(4, 0.04) == 1  # it is still the one whose torque would act
    assert gate.offer(torque(sequence=4), 0.041) == ""


def test_a_torque_that_is_withdrawn_again_and_again_is_a_race():
    gate = TorqueGate(arm_file.load("R"), TIMEOUT)
    gate.begin(SESSION)
    acted = []
    for k in range(2000):  # a stranger sends torque under the id of a controller that says DISABLED
        now = 0.001 * k
        gate.sent(k, now)
        gate.offer(torque(9.0, sequence=k), now)
        acted.append(gate.torque(now) is not None)
        gate.offer(torque(sequence=k, mode=JointTorque.DISABLED), now)
        assert gate.torque(now) is None
    assert sum(acted) <= 4 and gate.controllers.doubt(now) == Controllers.RACED


def test_a_state_that_is_published_for_ever_keeps_no_torque(gate):
    now = 0.031
    while now < 0.03 + TIMEOUT:
        assert gate.offer(torque(), now) == ""
        np.testing.assert_array_equal(gate.torque(now), [1.0])
        now += 0.001
        gate.sent(3, now)
    for _ in range(100):
        now += 0.001
        gate.sent(3, now)
        assert "older than the timeout" in gate.offer(torque(), now)
        assert gate.torque(now) is None and gate.controller_id(now) == 0
    gate.sent(4, now)  # and once it was forgotten
    gate.sent(3, now + 0.001)
    assert "older than the timeout" in gate.offer(torque(), now + 0.001)
    assert gate.sent(5, now + 0.002) == 0


def test_the_confirmation_of_a_state_that_is_sent_again_counts():
    gate = TorqueGate(
        arm_file.load("R"), TIMEOUT
    )  # in lockstep a state is sent until it is answered
    gate.begin(SESSION)
    gate.sent(0, 0.0)
    assert gate.offer(torque(sequence=0), 0.0) == gate.UNCONFIRMED
    assert gate.sent(0, 0.001) == 1
    assert gate.offer(torque(sequence=0), 0.001) == ""
    assert gate.torque(TIMEOUT) is not None and gate.torque(TIMEOUT + 0.0005) is None


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
