# SPDX-License-Identifier: Apache-2.0
"""Moves a running arm through its trajectory topic, to measure it."""

import time

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.resonance.motion import Arm

from ..recording import robot

#: Timeout for the first joint state, and for a controller to subscribe [s].
PATIENCE = 10.0
#: Time in which the hold that replaces a motion is reached [s].
HOLD = 0.2


class RunningArm(Arm):
    """An arm behind `joint_trajectory` and `joint_states`, with the other topics that are read.

    Parameters
    ----------
    session : Session
    topic, joint_states : str
        Of the trajectories, and of the joint states.
    imus : sequence of str
        Topics of `sensor_msgs/Imu`.
    arm_state : str
        Topic of an `ArmState`, for its strains; empty: none.

    Raises
    ------
    FlexarmError
        If no joint state comes, or no controller takes trajectories.
    """

    def __init__(
        self, session, topic="joint_trajectory", joint_states="joint_states", imus=(), arm_state=""
    ):
        from sensor_msgs.msg import Imu, JointState
        from trajectory_msgs.msg import JointTrajectory

        self._session, self._kind, self._read = session, JointTrajectory, 0
        self._joints = session.tap(JointState, joint_states, raw=True)
        self._taps = [(joint_states, robot.JOINTS, self._joints)]
        self._taps += [(name, robot.IMU, session.tap(Imu, name, raw=True)) for name in imus]
        if arm_state:
            from flexarm_msgs.msg import ArmState

            tap = session.tap(ArmState, arm_state, raw=True)
            self._taps.append((arm_state, robot.STATE, tap))
        hint = "is the driver running? name its topic with --joint-states"
        session.wait_for(joint_states, lambda: self._joints.messages, PATIENCE, hint)
        self.joint_names, self._position = (), None
        self.joint_names = tuple(self._message(self._joints.messages[0]).name)
        if not self.joint_names:
            raise FlexarmError("has no joint names in its first message", field=joint_states)
        self._publisher = session.publisher(JointTrajectory, topic)
        hint = "is the controller running? name its topic with --topic"
        count = self._publisher.get_subscription_count
        session.wait_for(f"a controller that takes {topic}", lambda: count() > 0, PATIENCE, hint)
        self._read, self.notes = len(self._joints.messages), []

    @staticmethod
    def _message(raw):
        from rclpy.serialization import deserialize_message
        from sensor_msgs.msg import JointState

        return deserialize_message(raw, JointState)

    def sample(self, patience):
        """As in `Arm`; the clock is that of this machine. Messages that lack one of the joints are skipped."""
        messages, end = self._joints.messages, time.monotonic() + patience
        while True:
            left = end - time.monotonic()
            if self._read >= len(messages) and (
                left <= 0.0 or not self._session.serve(left, lambda: self._read < len(messages))
            ):
                return None
            message = self._message(messages[self._read])
            self._read += 1
            order = {name: k for k, name in enumerate(message.name)}
            rows = [order.get(name) for name in self.joint_names]
            if None in rows or len(message.position) != len(message.name):
                continue
            self._stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            self._position = np.array(message.position)[rows]
            known = len(message.velocity) == len(message.name)
            velocity = np.array(message.velocity)[rows] if known else None
            return time.monotonic(), self._position, velocity

    def move(self, motion, start):
        """As in `Arm`."""
        self.begin = self._stamp
        self._publish(motion.times, np.asarray(start) + motion.positions, motion.velocities)

    def stop(self):
        """As in `Arm`: a hold at the last known position, which every trajectory controller takes, then a stop."""
        if self._position is not None and np.isfinite(self._position).all():
            self._publish(
                np.array([HOLD]), self._position[None], np.zeros((1, len(self.joint_names)))
            )
        self._publisher.publish(self._kind(joint_names=list(self.joint_names)))

    def _publish(self, times, positions, velocities):
        from builtin_interfaces.msg import Duration
        from trajectory_msgs.msg import JointTrajectoryPoint

        points = []
        for t, position, velocity in zip(times, positions, velocities, strict=True):
            seconds, rest = divmod(round(1e9 * float(t)), 10**9)
            points.append(
                JointTrajectoryPoint(
                    positions=position.tolist(), velocities=velocity.tolist(),
                    time_from_start=Duration(sec=seconds, nanosec=rest),
                )
            )  # fmt: skip
        self._publisher.publish(self._kind(joint_names=list(self.joint_names), points=points))

    def streams(self):
        """As in `Arm`; topics without a message are left out, with a note in `notes`.

        Raises
        ------
        FlexarmError
            For messages that can't be used.
        """
        self._session.poll()
        found = []
        for topic, kind, tap in self._taps:
            if tap.messages:
                found.append(robot.of_messages(topic, kind, tap.messages, self.notes))
            else:
                self.notes.append(f"{topic}: no message came")
        return found
