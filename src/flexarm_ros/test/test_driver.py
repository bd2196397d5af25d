# SPDX-License-Identifier: Apache-2.0
"""The base class of drivers: sessions and sequences, fresh torque, the safe action, errors of the device."""

import os

import numpy as np
import pytest
import rclpy
from rclpy.serialization import deserialize_message

from flexarm_dynamics.errors import FlexarmError
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros.driver import Driver, Sample
from flexarm_ros.node import ERROR, OK, WARN


class FakeArm(Driver):
    """A driver without a device or a thread: its samples are given by the test, its clock stands still."""

    def open(self):
        self.actions, self.states, self.time, self.broken = [], [], 0.0, ""

    def connect(self, torques):
        self.state_publisher.publish = self.note

    def note(self, raw):
        message = deserialize_message(raw, ArmState)
        self.states.append((message.session, message.sequence))
        self.newest = message

    def start(self):
        """Start without a thread."""

    def now(self):
        return self.time

    def read(self):
        self._reading = False  # one turn of the thread
        if self.broken:
            raise FlexarmError(self.broken)
        yield from self.coming

    def apply(self, torque):
        if self.broken:
            raise FlexarmError(self.broken)
        self.actions.append(torque.tolist())

    def make_safe(self):
        self.actions.append("safe")

    def close(self):
        self.actions.append("closed")

    def reads(self, *numbers, stamp_ns=1):
        """What the reading thread does with samples of these numbers."""
        self.coming = [Sample(n, stamp_ns, np.zeros(1)) for n in numbers]
        self._reading = True
        self._read()

    def answer(self, torque, **changes):
        """Answer the newest state."""
        session, sequence = self.states[-1]
        names = {"session": session, "sequence": sequence, "joint_names": ["joint1"]}
        fields = {"mode": JointTorque.ENABLED, "controller_id": 1, "torque": [torque]}
        self._on_torque(JointTorque(**{**names, **fields, **changes}))


@pytest.fixture
def arm(monkeypatch):
    monkeypatch.setitem(os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    rclpy.init(args=["--ros-args", "-p", "arm:=R"])
    node = FakeArm()
    assert node.autostart()
    yield node
    node.destroy_node()
    rclpy.shutdown()


def claim(arm, controller_id=1):
    """Two samples: the controller answers the first one, the second names it."""
    arm.reads(1)
    arm.answer(0.0, controller_id=controller_id)
    assert arm.newest.controller_id == 0 and arm.actions[-1] == "safe"
    arm.reads(2)
    assert arm.newest.controller_id == controller_id


def test_lost_samples_are_gaps_and_a_device_that_restarts_begins_a_session(arm):
    arm.reads(5, stamp_ns=None)  # its time is not known yet: not published
    arm.reads(6, 7, 9)
    arm.reads(2, 3)
    sessions = [session for session, _ in arm.states]
    assert [sequence for _, sequence in arm.states] == [0, 1, 3, 0, 1]
    assert len(set(sessions[:3])) == len(set(sessions[3:])) == 1 and sessions[0] != sessions[3]


def test_a_torque_acts_until_it_is_too_old_and_the_safe_action_follows(arm):
    claim(arm)
    arm.answer(2.0)
    assert arm.actions[-1] == [2.0] and arm.diagnose()[:2] == (OK, "")
    arm.time = 0.05
    arm.watch()
    assert arm.actions[-1] == [2.0]
    arm.time = 0.051
    arm.watch()
    assert arm.actions[-1] == "safe"
    assert arm.diagnose()[:2] == (WARN, "no fresh torque for 0.05 s: the safe action is applied")


def test_the_end_of_a_safe_action_is_logged_with_its_length(arm, monkeypatch):
    logged = []
    monkeypatch.setattr(arm, "report", lambda text, info=False: logged.append(text))
    claim(arm)
    arm.answer(2.0)
    arm.time = 0.06
    arm.watch()
    arm.time = 0.31
    arm.reads(3)
    arm.answer(2.0)  # to a state that names no controller
    arm.reads(4)
    arm.answer(2.0)
    assert arm.actions[-1] == [2.0]
    acts = [text for text in logged if "acts" in text]
    assert acts == [
        "the torque of a controller acts",
        "torque acts again, after 0.25 s of the safe action",
    ]


def test_two_controllers_are_an_error(arm):
    claim(arm)
    for controller_id in (1, 2, 1):
        arm.answer(2.0, controller_id=controller_id)
    assert arm.actions[-1] == "safe"
    arm.reads(3)
    assert arm.newest.controller_id == 0 and arm.newest.trust == ArmState.DISTRUSTED
    assert "several controllers (1, 2)" in arm.newest.doubt
    level, message, values = arm.diagnose()
    assert (level, message) == (ERROR, arm.newest.doubt) and values["samples per second"] == 3
    arm.time += 1.1
    arm.reads(4)
    assert (arm.newest.trust, arm.newest.doubt) == (ArmState.TRUSTED, "")


def test_one_state_published_for_ever_has_no_torque(arm):
    claim(arm)
    held = Sample(1, 1, np.zeros(1))
    for _ in range(100):
        arm.answer(2.0)
        assert (arm.actions[-1] == [2.0]) == (arm.time <= 0.05)
        arm.time += 0.001
        arm.publish(held)
    arm.watch()
    assert arm.actions[-1] == "safe" and arm.newest.controller_id == 0


def test_whatever_may_have_moved_the_zero_begins_a_session(arm):
    def session(*numbers, **stamp):
        arm.reads(*numbers, **stamp)
        return arm.newest.session

    first = session(1)
    arm.time += 0.5
    assert session(2) == first
    arm.time += 0.501
    silent = session(3)
    arm.reads(4, stamp_ns=None)
    clock = session(5)
    arm.trigger_deactivate()
    arm.trigger_activate()
    again = session(6)
    arm.begin_session()
    by_hand = session(7)
    assert len({first, silent, clock, again, by_hand}) == 5


def test_errors_of_the_device_are_shown_until_a_sample_comes(arm):
    claim(arm)
    arm.broken = "the line is cut"
    arm.answer(2.0)
    assert arm.diagnose()[:2] == (ERROR, "the line is cut")
    arm.broken = ""
    arm.reads(3)
    assert arm.diagnose()[0] == OK
    arm.broken = "the line is cut again"
    arm.reads(4)
    assert arm.diagnose()[:2] == (ERROR, "the line is cut again")


def test_a_driver_that_stops_leaves_the_arm_safe_and_closes_the_device(arm):
    claim(arm)
    arm.answer(2.0)
    assert arm.actions[-1] == [2.0]
    arm.trigger_deactivate()
    assert arm.actions[-1] == "safe"
    arm.answer(2.0)
    assert arm.actions[-1] == "safe"  # an inactive driver applies nothing
    arm.trigger_cleanup()
    assert arm.actions[-1] == "closed"
