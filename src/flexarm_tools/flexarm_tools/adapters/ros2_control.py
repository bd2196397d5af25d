# SPDX-License-Identifier: Apache-2.0
"""Adapter node: makes an arm behind ros2_control, or anything that uses the same topics, a driver of flexarm.

It receives `joint_states` and an array of strains, and publishes `arm_state`. It receives `joint_torque`, and publishes
an array of efforts in the order of the effort controller. Without a fresh torque the efforts are those of the safe
action: zero, or against the joint's velocity.
"""

import math

import numpy as np
from rclpy.duration import Duration
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from flexarm_dynamics.errors import MessageError, ParameterError
from flexarm_dynamics.models.model import build
from flexarm_dynamics.parameters import parameter
from flexarm_ros import qos
from flexarm_ros.driver import SILENT, TORQUE_TIMEOUT, Driver, Sample
from flexarm_ros.messages import stamp_ns
from flexarm_ros.node import ARM, run
from flexarm_ros.start import leave
from flexarm_ros.torque_gate import WRAP
from flexarm_sim.damping import Damping

#: Timeout for delivering the last efforts, which are zero.
LAST_EFFORTS = Duration(seconds=0.2)


def _fixed(name, default, unit="-", low=None, high=None, **options):
    return parameter(name, default, unit, low, high, read_only=True, **options)


PARAMETERS = (
    ARM,
    _fixed("joint_state_topic", "joint_states").described(
        "Topic that joint_state_broadcaster publishes."
    ),
    _fixed("strain_topic", "strain").described("Strains, std_msgs/Float64MultiArray [m/m]."),
    _fixed("effort_topic", "effort_controller/commands").described(
        "Topic that effort_controllers/JointGroupEffortController subscribes to."
    ),
    _fixed("joint_names", [""]).described(
        "Names in joint_state_topic of the arm file's joints, in the arm file's order; empty: the same names."
    ),
    _fixed("effort_joints", [""]).described(
        "Joints of the effort controller in its order, by the arm file's names; empty: the arm file's order."
    ),
    _fixed("gauge_names", [""]).described(
        "Gauges in the order of strain_topic, by the arm file's names; empty: the arm file's order."
    ),
    _fixed("use_effort", False).described(
        "Whether the effort of joint_state_topic is the torque applied [N m]; false: the sent torque is reported."
    ),
    TORQUE_TIMEOUT,
    _fixed("strain_timeout", 0.02, "s", 0.001, 10.0).described(
        "Strains older than this are reported as NaN: missing."
    ),
    _fixed("safe_action", "damp", choices=("damp", "zero")).described(
        "Efforts without a fresh torque. damp: against the joint velocity; zero: none."
    ),
    _fixed("safe_damping", [1.0], "N m s/rad", 0.0, 1e6, length="joints").described(
        "Effort per joint velocity of the safe action damp, with torque and soft start of the arm file's damp."
    ),
)


def permutation(field, given, wanted):
    """Indices in `given` of the `wanted` names; without names, the order of `wanted`.

    Raises
    ------
    ParameterError
        For the parameter `field`, if the names are not the same.
    """
    given = [n for n in given if n] or list(wanted)
    if sorted(given) != sorted(wanted):
        raise ParameterError(
            "are not the names of the arm file", field=field, value=given, limit=list(wanted)
        )
    return np.array([given.index(n) for n in wanted], int)


class Readings:
    """Joint states and strains in the arm file's order, whatever the order and names of the sender.

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
                "are not one name for each joint",
                field="joint_names",
                value=names,
                limit=list(arm.joint_names),
            )
        self._names, self._seen, self._order = names, None, None
        self._gauges = permutation("gauge_names", gauge_names, arm.gauge_names)
        self._strain_timeout = strain_timeout
        self.strain, self._strain_at = np.full(len(arm.gauges), np.nan), -math.inf

    def take_strain(self, values, now):
        """Keep strains that arrive now [s].

        Raises
        ------
        MessageError
            If there are not as many as gauges.
        """
        if len(values) != self.strain.size:
            raise MessageError(
                "values", field="strain", value=len(values), limit=f"{self.strain.size} gauges"
            )
        self.strain[:] = np.asarray(values)[self._gauges]
        self._strain_at = now

    def strain_at(self, now):
        """Strains in the arm file's order, (gauges,); NaN if they are too old or never came."""
        if now - self._strain_at > self._strain_timeout:
            self.strain[:] = np.nan
        return self.strain

    def joints(self, message, field):
        """Values of a field of a JointState, (n,); None if it is empty. Other joints in the message are ignored.

        Raises
        ------
        MessageError
            If a joint of this arm or a value is missing.
        """
        if message.name != self._seen:
            missing = [n for n in self._names if n not in message.name]
            if missing:
                raise MessageError(
                    f"lacks {', '.join(missing)}",
                    field="name",
                    value=list(message.name),
                    hint="set joint_names",
                )
            self._order = np.array([message.name.index(n) for n in self._names])
            self._seen = list(message.name)
        values = getattr(message, field)
        if not len(values):
            return None
        if len(values) != len(message.name):
            raise MessageError(
                "values", field=field, value=len(values), limit=f"{len(message.name)} names"
            )
        return np.asarray(values, float)[self._order]


class AdapterNode(Driver):
    """A driver whose samples are others' joint states, and whose torques are the efforts of another controller."""

    def __init__(self):
        super().__init__("driver", PARAMETERS)

    def open(self):
        p, n = {d.name: self.parameters[d.name] for d in PARAMETERS}, len(self.arm.joints)
        self._readings = Readings(self.arm, p["joint_names"], p["gauge_names"], p["strain_timeout"])
        # From the arm file's order to the effort controller's.
        self._effort_order = np.argsort(
            permutation("effort_joints", p["effort_joints"], self.arm.joint_names)
        )
        self._damping = np.array(p["safe_damping"]) * (p["safe_action"] == "damp")
        self._limit = self.arm.torque_limits
        self._soft, self._damps, self._settled = Damping(build(self.arm)), False, None
        self._velocity, self._moved_at = np.zeros(n), -math.inf
        self._applied, self._sequence = np.zeros(n), 0
        self._position = self._stamp = self._arrived = None

    def connect(self, torques):
        # All topics are served in the same way: none of them alone is the control path.
        topic = self.parameters
        self._efforts = self.make_publisher(
            Float64MultiArray, topic["effort_topic"], qos.CONTROL_PATH
        )
        # Best effort: compatible with any publisher.
        self.make_subscription(
            Float64MultiArray, topic["strain_topic"], self._on_strain, qos_profile_sensor_data
        )
        self.make_subscription(
            JointState, topic["joint_state_topic"], self._on_joint_state, qos_profile_sensor_data
        )
        self.make_timer(self.gate.timeout / 2.0, self.watch)

    def start(self):
        """Nothing to start: samples come as messages."""

    # Topics to samples -------------------------------------------------------------------------

    def _on_strain(self, msg):
        try:
            self._readings.take_strain(msg.data, self.now())
        except MessageError as error:
            self.report(str(error))

    def _on_joint_state(self, msg):
        if not self.active:
            return
        try:
            sample = self._sample(msg, stamp_ns(msg.header.stamp))
        except MessageError as error:
            self.fault = str(error)
            self.report(self.fault)
            return
        if sample is not None:
            self.fault = ""
            self.publish(sample)
            self.watch()

    def _sample(self, msg, stamp):
        """A message as a sample; None if it was sent again."""
        readings, now = self._readings, self.now()
        position = readings.joints(msg, "position")
        velocity, effort = readings.joints(msg, "velocity"), readings.joints(msg, "effort")
        if position is None:
            raise MessageError("is empty", field="position")
        if self._stamp is not None:
            if now - self._arrived > SILENT or self._stamp - stamp > 1e9 * SILENT:
                self._forget()  # the source was silent, or its clock went back: it may have restarted
            elif stamp <= self._stamp:
                return None
        self._note_velocity(position, velocity, stamp, now)
        self._position, self._stamp, self._arrived = position, stamp, now
        number, self._sequence = self._sequence, (self._sequence + 1) % WRAP
        torque = effort if self.parameters["use_effort"] else self._applied
        strain = readings.strain_at(now) if self.arm.gauges else None
        return Sample(number, stamp, position, velocity, torque, strain)

    def _forget(self):
        """Begin a new session."""
        self._stamp, self._sequence = None, 0
        self.begin_session()

    def _note_velocity(self, position, velocity, stamp, now):
        """Keep the newest velocity for damping; if it is not measured, compute it from the positions."""
        if velocity is None and self._stamp is not None:
            velocity = (position - self._position) / (1e-9 * (stamp - self._stamp))
        if velocity is not None and np.isfinite(velocity).all():
            self._velocity, self._moved_at = velocity, now

    # Torque to efforts -------------------------------------------------------------------------

    def apply(self, torque):
        self._settle(False)
        self._send(torque)

    def make_safe(self):
        """Damp each joint; send zero efforts if the velocity is no longer known."""
        self._settle(True)
        known, soft = self.now() - self._moved_at <= self.gate.timeout, self._soft
        damping, velocity = self._damping * known, self._velocity
        soft.act(0.0, velocity * known)
        bound = soft.torque(soft.elapsed, soft.speed)
        bound = np.where(soft.coefficient > 0.0, self._limit, bound)
        self._send(np.clip(-damping * velocity, -bound, bound))

    def _settle(self, damps):
        """Note what acted until now, and whether the joints are damped from now on."""
        now, before = self.now(), self._settled
        time = 0.0 if before is None else now - before
        if self._damps:
            self._soft.act(time, np.zeros(self._limit.size))
        else:
            self._soft.release(time)
        self._damps, self._settled = damps, now

    def _send(self, torque):
        self._applied[:] = torque
        self._efforts.publish(Float64MultiArray(data=torque[self._effort_order].tolist()))

    def stop(self):
        self._forget()
        self.apply(np.zeros(self._limit.size))
        # The effort controller keeps the last efforts: they must arrive before the node is gone.
        self._efforts.wait_for_all_acked(LAST_EFFORTS)

    def problem(self, samples):
        if self.fault:
            return self.fault
        if not samples:
            return f"nothing on {self.parameters['joint_state_topic']}"
        if self.arm.gauges and np.isnan(self._readings.strain).any():
            return f"no fresh strain on {self.parameters['strain_topic']}"
        return ""


def main(args=None):
    """Entry point of ``ros2 run flexarm_bringup ros2_control_adapter``."""
    leave(run(AdapterNode, args))


if __name__ == "__main__":
    main()
