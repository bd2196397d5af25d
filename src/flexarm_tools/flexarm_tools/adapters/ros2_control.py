# SPDX-License-Identifier: Apache-2.0
"""Adapter node: an arm behind ros2_control, or anything that speaks its topics, becomes a driver of flexarm.

`joint_states` and an array of strains in, `arm_state` out; `joint_torque` in, an array of efforts out, in the
order of the effort controller. A torque passes `TorqueGate`; without a fresh one the efforts are the safe
action's: zero, or against the joint's velocity.
"""

import math
import os
import time

import numpy as np
from rclpy.duration import Duration
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import MessageError, ParameterError
from flexarm_dynamics.parameters import Parameter
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros import qos
from flexarm_ros.messages import StateWriter, stamp_ns
from flexarm_ros.node import ARM, ERROR, OK, WARN, ArmNode, run
from flexarm_ros.start import leave
from flexarm_ros.torque_gate import TorqueGate

#: How long the last efforts, zero, are waited for to arrive.
LAST_WORD = Duration(seconds=0.2)


def _fixed(name, kind, default, description, unit="-", **limits):
    return Parameter(name, kind, default, description, unit, read_only=True, **limits)


PARAMETERS = (
    ARM,
    _fixed(
        "joint_state_topic", "string", "joint_states", "Where joint_state_broadcaster publishes."
    ),
    _fixed("strain_topic", "string", "strain", "Strains, std_msgs/Float64MultiArray [m/m]."),
    _fixed(
        "effort_topic",
        "string",
        "effort_controller/commands",
        "Where effort_controllers/JointGroupEffortController listens.",
    ),
    _fixed(
        "joint_names",
        "string_array",
        [""],
        "Names in joint_state_topic of the arm file's joints, in the arm file's order; empty: the same names.",
    ),
    _fixed(
        "effort_joints",
        "string_array",
        [""],
        "Joints of the effort controller in its order, by the arm file's names; empty: the arm file's order.",
    ),
    _fixed(
        "gauge_names",
        "string_array",
        [""],
        "Gauges in the order of strain_topic, by the arm file's names; empty: the arm file's order.",
    ),
    _fixed(
        "use_effort",
        "bool",
        False,
        "Whether the effort of joint_state_topic is the torque applied [N m]; false: the torque sent is reported.",
    ),
    _fixed(
        "torque_timeout",
        "float",
        0.05,
        "A torque that answers a state older than this is too late; the safe action follows.",
        "s",
        low=0.001,
        high=1.0,
    ),
    _fixed(
        "strain_timeout",
        "float",
        0.02,
        "Strains older than this are reported as NaN: missing.",
        "s",
        low=0.001,
        high=10.0,
    ),
    _fixed(
        "safe_action",
        "string",
        "damp",
        "Efforts without a fresh torque: damp, against the joint velocity; zero.",
        choices=("damp", "zero"),
    ),
    _fixed(
        "safe_damping",
        "float_array",
        [1.0],
        "Effort per joint velocity of the safe action damp, within the torque limits.",
        "N m s/rad",
        low=0.0,
        high=1e6,
        length="joints",
    ),
)


def permutation(what, given, wanted):
    """Where each of the `wanted` names stands in `given`; as it is where no names are given.

    `what` is the parameter's name, for the message.

    Raises
    ------
    ParameterError
        Where they are not the same names.
    """
    given = [n for n in given if n] or list(wanted)
    if sorted(given) != sorted(wanted):
        raise ParameterError(f"{what}: {given} are not the names of the arm file, {list(wanted)}")
    return np.array([given.index(n) for n in wanted], int)


class Readings:
    """Joint states and strains as others order and name them, in the arm file's order.

    Parameters
    ----------
    arm : Arm
    joint_names, gauge_names : sequence of str
        See `PARAMETERS`.
    strain_timeout : float
        [s]

    Raises
    ------
    ParameterError
    """

    def __init__(self, arm, joint_names=(), gauge_names=(), strain_timeout=0.02):
        names = [n for n in joint_names if n] or list(arm.joint_names)
        if len(names) != len(arm.joints) or len(set(names)) != len(names):
            raise ParameterError(
                f"joint_names: {names} are not one name each for the joints {list(arm.joint_names)}"
            )
        self._names, self._seen, self._order = names, None, None
        self._gauges = permutation("gauge_names", gauge_names, arm.gauge_names)
        self._strain_timeout = strain_timeout
        self.strain, self._strain_at = np.full(len(arm.gauges), np.nan), -math.inf

    def take_strain(self, values, now):
        """Keep strains that came now [s].

        Raises
        ------
        MessageError
            For another number than there are gauges.
        """
        if len(values) != self.strain.size:
            raise MessageError(f"strain has {len(values)} values for {self.strain.size} gauges")
        self.strain[:] = np.asarray(values)[self._gauges]
        self._strain_at = now

    def strain_at(self, now):
        """Strains in the arm file's order, (gauges,); NaN where they are too old or never came."""
        if now - self._strain_at > self._strain_timeout:
            self.strain[:] = np.nan
        return self.strain

    def joints(self, message, field):
        """Values of a field of a JointState, (n,); None where it is empty. Other joints may be in it too.

        Raises
        ------
        MessageError
            Where a joint of this arm or a value is missing.
        """
        if message.name != self._seen:
            missing = [n for n in self._names if n not in message.name]
            if missing:
                raise MessageError(
                    f"joint states of {list(message.name)} lack {', '.join(missing)}: set joint_names"
                )
            self._order = np.array([message.name.index(n) for n in self._names])
            self._seen = list(message.name)
        values = getattr(message, field)
        if not len(values):
            return None
        if len(values) != len(message.name):
            raise MessageError(f"{field} has {len(values)} values for {len(message.name)} names")
        return np.asarray(values, float)[self._order]


class AdapterNode(ArmNode):
    """Others' messages to `arm_state`, `joint_torque` to their efforts."""

    def __init__(self):
        super().__init__("driver", {"": PARAMETERS})

    def build(self):
        self.arm = arm_file.load(self.parameters["arm"])
        n = len(self.arm.joints)
        self.parameters.resolve({"joints": n})
        p = {d.name: self.parameters[d.name] for d in PARAMETERS}
        self._readings = Readings(self.arm, p["joint_names"], p["gauge_names"], p["strain_timeout"])
        # From the arm file's order to the effort controller's.
        self._effort_order = np.argsort(
            permutation("effort_joints", p["effort_joints"], self.arm.joint_names)
        )
        self._gate = TorqueGate(self.arm, p["torque_timeout"])
        self._gate.begin(int.from_bytes(os.urandom(4), "little"))
        self._damping = np.array(p["safe_damping"]) * (p["safe_action"] == "damp")
        self._limit = np.array([j.limits.torque for j in self.arm.joints])
        self._use_effort = p["use_effort"]
        self._velocity, self._position, self._stamp = np.zeros(n), None, None
        self._moved_at = -math.inf
        self._applied, self._sequence, self._before = np.zeros(n), 0, 0
        self._refusal = ""
        self._writer = StateWriter(self.arm)
        self._make_topics(p)

    def _make_topics(self, p):
        options = qos.overridable()
        self._state_pub = self.make_publisher(
            ArmState, "arm_state", qos.LINE, qos_overriding_options=options
        )
        self._effort_pub = self.make_publisher(Float64MultiArray, p["effort_topic"], qos.LINE)
        # Best effort: a reader that matches whoever publishes.
        self.make_subscription(
            Float64MultiArray, p["strain_topic"], self._on_strain, qos_profile_sensor_data
        )
        self.make_subscription(
            JointTorque, "joint_torque", self._on_torque, qos.LINE, qos_overriding_options=options
        )
        self.make_subscription(
            JointState, p["joint_state_topic"], self._on_joint_state, qos_profile_sensor_data
        )
        self.make_timer(p["torque_timeout"] / 2.0, self._watch)

    # In -------------------------------------------------------------------------------------------

    def _on_strain(self, msg):
        try:
            self._readings.take_strain(msg.data, time.monotonic())
        except MessageError as error:
            self.report(str(error))

    def _on_joint_state(self, msg):
        if not self.active:
            return
        now, readings = time.monotonic(), self._readings
        stamp = stamp_ns(msg.header.stamp)
        try:
            position = readings.joints(msg, "position")
            velocity, effort = readings.joints(msg, "velocity"), readings.joints(msg, "effort")
            if position is None:
                raise MessageError("joint states have no positions")
        except MessageError as error:
            self._refusal = str(error)
            self.report(str(error))
            return
        if self._stamp is not None and stamp <= self._stamp:
            return  # sent again
        self._refusal = ""
        self._note_velocity(position, velocity, stamp, now)
        self._position, self._stamp = position, stamp
        writer = self._writer
        writer.head(stamp, self._gate.session, self._sequence)
        writer.write("joint_position", position)
        writer.write("joint_velocity", velocity)
        writer.write("joint_torque", effort if self._use_effort else self._applied)
        writer.write("strain", readings.strain_at(now) if self.arm.gauges else None)
        writer.write("modal_amplitude", None)
        self._gate.sent(self._sequence, now)
        self._state_pub.publish(writer.message)
        self._sequence = (self._sequence + 1) % 2**32
        self._watch()

    def _note_velocity(self, position, velocity, stamp, now):
        """The newest velocity, for damping; from positions where it is not measured."""
        if velocity is None and self._stamp is not None:
            velocity = (position - self._position) / (1e-9 * (stamp - self._stamp))
        if velocity is not None and np.isfinite(velocity).all():
            self._velocity, self._moved_at = velocity, now

    # Out ------------------------------------------------------------------------------------------

    def _on_torque(self, msg):
        if not self.active:
            return
        now = time.monotonic()
        refused = self._gate.offer(msg, now)
        if refused:
            self.report(refused)
        torque = self._gate.torque(now)
        self._send(self._safe(now) if torque is None else torque)

    def _watch(self):
        """Without a fresh torque the safe action goes on with each joint state, and with the timer."""
        if self.active:
            now = time.monotonic()
            if self._gate.torque(now) is None:
                self._send(self._safe(now))

    def _safe(self, now):
        """Efforts of the safe action; zero where the velocity is not known any more."""
        if now - self._moved_at > self._gate.timeout:
            return np.zeros(self._limit.size)
        return np.clip(-self._damping * self._velocity, -self._limit, self._limit)

    def _send(self, torque):
        self._applied[:] = torque
        self._effort_pub.publish(Float64MultiArray(data=torque[self._effort_order].tolist()))

    def stop(self):
        self._gate.begin(self._gate.session)
        self._send(np.zeros(self._limit.size))
        # The effort controller goes on with the last efforts: these must arrive before the node is gone.
        self._effort_pub.wait_for_all_acked(LAST_WORD)

    def diagnose(self):
        done, self._before = self._sequence - self._before, self._sequence
        gate = self._gate
        values = {
            "samples per second": done,
            "torques refused": gate.refused,
            "torques clipped": gate.clipped,
        }
        if self._refusal:
            return ERROR, self._refusal, values
        if not done:
            return ERROR, f"nothing on {self.parameters['joint_state_topic']}", values
        if self.arm.gauges and np.isnan(self._readings.strain).any():
            return ERROR, f"no fresh strain on {self.parameters['strain_topic']}", values
        if gate.reason:
            return WARN, f"{gate.reason}: the safe action is applied", values
        return OK, "", values


def main(args=None):
    """Entry point of ``ros2 run flexarm_bringup ros2_control_adapter``."""
    leave(run(AdapterNode, args))


if __name__ == "__main__":
    main()
