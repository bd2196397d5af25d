# SPDX-License-Identifier: Apache-2.0
"""Measuring a running arm: messages out and in, with an arm behind a position loop in place of the middleware."""

from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from flexarm_dynamics.errors import FlexarmError
from flexarm_msgs.msg import ArmState
from flexarm_ros.messages import set_stamp
from flexarm_studies.recordings import streams
from flexarm_studies.resonance import study
from flexarm_studies.resonance.measured import rings
from flexarm_studies.resonance.motion import STEP, Bounds, RingingMotion, design, measure
from flexarm_studies.resonance.simulated import SimulatedArm
from flexarm_tools.resonance.live import RunningArm


class Played:
    """A session whose messages come from a simulated arm: the part of `Session` that is used."""

    def __init__(self, away=lambda position: position):
        self.arm, self.taps, self.sent, self._away = SimulatedArm("one_link"), {}, [], away

    def tap(self, kind, topic, raw):
        assert raw
        self.taps[topic] = SimpleNamespace(kind=kind, messages=[])
        return self.taps[topic]

    def publisher(self, kind, topic):
        return SimpleNamespace(publish=self._take, get_subscription_count=lambda: 1)

    def _take(self, message):
        self.sent.append(message)
        if len(message.points) > 1:
            times = [
                p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points
            ]
            position = np.array([p.positions[1:] for p in message.points])
            velocity = np.array([p.velocities[1:] for p in message.points])
            self.arm.move(RingingMotion(np.array(times), position, velocity, (), ()), np.zeros(1))

    def serve(self, seconds, until):
        while not until():
            time, position, _ = self.arm.sample(seconds)
            strain = self.arm._rows[-1][2]
            joint = JointState(
                name=["gripper", "joint1"], position=[0.0, float(self._away(position)[0])]
            )
            state = ArmState(
                joint_names=["joint1"], joint_position=position.tolist(), gauge_names=["root", "middle"],
                strain=strain.tolist(),
            )  # fmt: skip
            for topic, message in (("joint_states", joint), ("arm_state", state)):
                set_stamp(message.header.stamp, round(1e9 * time))
                if topic in self.taps:
                    self.taps[topic].messages.append(bytes(serialize_message(message)))
        return True

    def wait_for(self, what, until, patience, hint):
        self.serve(patience, until)

    def poll(self):
        pass


@pytest.fixture
def clock(monkeypatch):
    """Time passes with the joint states, and not with this machine."""

    def of(session):
        monkeypatch.setattr("time.monotonic", lambda: session.arm._simulator.time)
        return session

    return of


def test_the_motion_goes_out_as_one_trajectory_and_the_strains_ring(clock):
    session = clock(Played())
    arm = RunningArm(session, arm_state="arm_state")
    motion = design(STEP, [1], 2, Bounds(), rest=3.0)
    measure(arm, motion, Bounds())
    (message,) = session.sent
    assert message.joint_names == ["gripper", "joint1"] and message.header.stamp.sec == 0
    assert max(p.positions[1] for p in message.points) == pytest.approx(0.045, abs=1e-3)
    assert all(p.positions[0] == 0.0 and len(p.velocities) == 2 for p in message.points)
    found, windows = rings(streams.join(arm.streams()), motion, arm.begin, study.Wishes())
    assert found.names == ("root", "middle") and len(windows) == 2
    assert windows[0].fit.modes[0].frequency == pytest.approx(2.038, abs=0.005)


def test_an_arm_that_runs_away_gets_a_hold_where_it_was_seen_and_a_stop(clock):
    session = clock(Played())
    arm = RunningArm(session)
    motion = design(STEP, [1], 2, Bounds(), rest=3.0)
    session._away = lambda position: position + 10.0 * (session.arm.begin is not None) * np.ones(1)
    session.arm.begin = None
    with pytest.raises(FlexarmError, match="measured travel of joint1: 10"):
        measure(arm, motion, Bounds())
    _, hold, stop = session.sent
    assert len(hold.points) == 1 and hold.points[0].positions[1] == pytest.approx(10.0, abs=0.1)
    assert list(hold.points[0].velocities) == [0.0, 0.0] and not stop.points
