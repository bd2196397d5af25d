# SPDX-License-Identifier: Apache-2.0
"""Base class of drivers: you write how to read a sample, apply torque, make the arm safe and close; the rest is here.

A driver publishes `arm_state` (and `joint_states`), receives `joint_torque`, and takes the safe action in doubt;
`TorqueGate` has the rules. The driver template, the adapter for ros2_control and the simulator are such drivers.
"""

import os
import threading
import time
import traceback
from array import array
from dataclasses import dataclass

import numpy as np
from sensor_msgs.msg import JointState

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError, MessageError
from flexarm_dynamics.parameters import parameter
from flexarm_msgs.msg import ArmState, JointTorque

from . import cdr, qos
from .messages import SECOND, StateWriter, set_stamp
from .node import ARM, ERROR, OK, WARN, ArmNode
from .torque_gate import WRAP, TorqueGate

#: A driver whose `read` returns nothing for this long reports an error; the next sample begins a new session [s].
SILENT = 0.5

TORQUE_TIMEOUT = parameter("torque_timeout", 0.05, "s", 0.001, 1.0, read_only=True).described(
    "A torque that answers a state older than this is too late; the safe action follows."
)
JOINT_STATES_RATE = parameter(
    "joint_states_rate", 50.0, "Hz", 0.1, 20000.0, read_only=True
).described("Rate of joint_states; at most the rate of the samples.")
#: Parameters of a driver; yours come after them. Without JOINT_STATES_RATE it does not publish joint_states.
PARAMETERS = (ARM, TORQUE_TIMEOUT, JOINT_STATES_RATE)


@dataclass(slots=True)
class Sample:
    """One measurement of the arm, in SI units and in the arm file's order; None: not measured.

    Attributes
    ----------
    number : int
        Counts the samples. A lost sample leaves a gap, and a number that does not rise begins a new session.
    stamp_ns : int or None
        Time of measurement on this machine's ROS clock [ns]. None: not known yet; the sample is not published, and the
        next sample with a time begins a new session.
    position : ndarray, shape (n,)
        [rad]
    velocity : ndarray, shape (n,), optional
        [rad/s]
    torque : ndarray, shape (n,), optional
        Applied over the interval that ends at the stamp [N m].
    strain : ndarray, shape (gauges,), optional
        Surface strain, tension positive [m/m]; NaN for a reading that failed.
    amplitude, rate : ndarray, shape (observed modes,), optional
        Modal amplitudes [m, rad] and rates; without them the observer maps the strains.
    """

    number: int
    stamp_ns: int | None
    position: np.ndarray
    velocity: np.ndarray | None = None
    torque: np.ndarray | None = None
    strain: np.ndarray | None = None
    amplitude: np.ndarray | None = None
    rate: np.ndarray | None = None


class Thinned:
    """Selects the samples for a topic of a lower rate: called with each stamp, it is true for those that are due.

    Parameters
    ----------
    rate : float
        Of that topic [Hz].
    """

    def __init__(self, rate):
        self._period, self._due = round(SECOND / rate), 0  # [ns]

    def __call__(self, stamp_ns, first):
        """Whether the sample of a stamp [ns] is due; the `first` of a session is."""
        if stamp_ns < self._due and not first:
            return False
        due = self._due + self._period
        self._due = due if due > stamp_ns and not first else stamp_ns + self._period
        return True


def new_session():
    """A random session number: each start of a driver is a session of its own."""
    return int.from_bytes(os.urandom(4), "little")


class Driver(ArmNode):
    """A node between the topics and an arm. Subclasses implement the methods of the first group.

    `read` runs in a thread of its own. `apply` and `make_safe` run in the node's thread, or in that of `read`, under a
    lock: never two at a time. The other methods of this group run in the node's thread, without the lock. A driver
    whose samples come as ROS messages, or that moves on its own grid of time, overrides `connect`, `start` and `stop`.
    It calls `publish` itself, and `begin_session` if the device has restarted.

    Parameters
    ----------
    name : str
        Of the node.
    parameters : sequence of Parameter
        `PARAMETERS` and the driver's own.

    Attributes
    ----------
    arm : Arm
        From the parameter `arm`, when `open` is called.
    gate : TorqueGate
    fault : str
        Why the device can't be used; empty if it can.
    safe : bool
        Whether the last action was the safe one.
    """

    def __init__(self, name="driver", parameters=PARAMETERS):
        super().__init__(name, {"": parameters})

    # What a driver implements ------------------------------------------------------------------

    def open(self):
        """Open the device, by `self.parameters` and `self.arm`; raise a FlexarmError to refuse."""

    def read(self):
        """Wait for the device, at most `SILENT` seconds; return an iterable of the `Sample`s that have come.

        Raises
        ------
        FlexarmError
            If the device is gone: reading ends, and `/diagnostics` shows the error.
        """
        raise NotImplementedError

    def apply(self, torque):
        """Apply torque, shape (n,) [N m], until the next call: finite and within the joints' limits."""
        raise NotImplementedError

    def make_safe(self):
        """Take the joints' safe action; called again and again while there is no fresh torque."""
        raise NotImplementedError

    def close(self):
        """Close the device."""

    def details(self):
        """More values for `/diagnostics`: name to value."""
        return {}

    def problem(self, samples):
        """What is wrong with the device, `samples` of which came in the last second; empty: nothing."""
        return self.fault

    # Made from the parameters ------------------------------------------------------------------

    def build(self):
        parameters = self.parameters
        self.arm = arm_file.load(parameters["arm"])
        parameters.resolve({"joints": len(self.arm.joints), "gauges": len(self.arm.gauges)})
        self.fault, self.safe, self._safe_since = "", True, None
        self._published, self._before = 0, 0
        self._first = self._last = self._arrived = self._thread = None
        self._reading = False
        self._lock = threading.RLock()
        self.open()
        self._keep(lambda _: self.close(), self)
        self.gate = self.make_gate()
        self.gate.begin(new_session())
        self.writer = StateWriter(self.arm)
        self.state_bytes, self.torques = cdr.Writer(self.writer.message), cdr.Reader(JointTorque)
        self.state_publisher = self.make_publisher(ArmState, "arm_state")
        self._joint_state = JointState(name=list(self.arm.joint_names))
        rate = parameters.group("").get("joint_states_rate")
        self._joint_publisher = rate and self.make_publisher(
            JointState, "joint_states", 10, qos_overriding_options=qos.overridable()
        )
        self._joints_due = rate and Thinned(rate)
        self.connect(self.make_subscription(JointTorque, "joint_torque", self._on_torque, raw=True))

    def make_gate(self):
        """The `TorqueGate` with this driver's timeout."""
        return TorqueGate(self.arm, self.parameters["torque_timeout"])

    def connect(self, torques):
        """Make the subscription of `joint_torque` the control path, and monitor its timeout."""
        self.make_control_path(torques)
        # The torque also ends if the samples stop.
        self.make_timer(self.gate.timeout / 2.0, self.watch)

    def now(self):
        """Steady clock on which the age of torques is measured [s]."""
        return time.monotonic()

    def start(self):
        self._first = (
            None  # the device may have been restarted, or moved to another zero, meanwhile
        )
        self._reading = True
        self._thread = threading.Thread(target=self._read, name="device", daemon=True)
        self._thread.start()
        self.get_logger().info(f"arm {self.arm.name}")

    def stop(self):
        self._reading = False
        if self._thread is not None:
            self._thread.join()
        self.begin_session()
        with self._lock:
            self.actuate()

    def begin_session(self):
        """Begin a new session: the device has restarted, or its zeros may have changed.

        There is no torque until a controller has answered in the new session; a controller that was in motion goes into
        fault. A new session begins automatically with each activation, and with a sample whose number does not rise,
        that comes after `SILENT` seconds without any, or that follows a sample without a time.
        """
        with self._lock:
            self._first = None  # stamps begin anew with the next sample
            self.gate.begin(new_session())

    # Device to topics --------------------------------------------------------------------------

    def _read(self):
        """In a thread: publish each sample as it comes."""
        arrived = self.now()
        while self._reading:
            try:
                for sample in self.read():
                    arrived = self.now()
                    self._number(sample)
                    self.fault = ""
            except Exception as error:  # a mistake in `read` must not pass unnoticed either
                known = isinstance(error, FlexarmError)
                self.fault = str(error) if known else traceback.format_exc()
                self.get_logger().error(f"reading has ended: {self.fault}")
                return
            if self.now() - arrived >= SILENT:
                self.fault = f"the device sends nothing for {SILENT:g} s"

    def _number(self, sample):
        """Publish a sample of the device with its sequence in the session."""
        now = self.now()
        if self._last is not None and (
            sample.number <= self._last or sample.stamp_ns is None or now - self._arrived > SILENT
        ):
            self._first = None  # the device has restarted, or may have
        self._last, self._arrived = sample.number, now
        if sample.stamp_ns is None:
            return
        if self._first is None:
            self.begin_session()
            self._first = sample.number
        sample.number = (sample.number - self._first) % WRAP
        self.publish(sample)
        self.watch()

    def publish(self, sample):
        """Publish a `Sample` whose number is its sequence in the session, and note the time."""
        with self._lock:
            self.fill(sample, self.gate.sent(sample.number, self.now()))
            self.state_publisher.publish(self.state_bytes())
        self.publish_joints(sample)

    def fill(self, sample, controller_id):
        """Write a sample into the message of `arm_state`, and the id of the controller whose answer to it will act."""
        writer = self.writer
        writer.head(sample.stamp_ns, self.gate.session, sample.number, controller_id)
        doubt = self.gate.controllers.doubt(self.now())
        writer.trust(ArmState.DISTRUSTED if doubt else ArmState.TRUSTED, doubt)
        writer.write("joint_position", sample.position)
        writer.write("joint_velocity", sample.velocity)
        writer.write("joint_torque", sample.torque)
        writer.write("strain", sample.strain)
        writer.write("modal_amplitude", sample.amplitude)
        writer.write("modal_rate", sample.rate)
        self._published += 1

    def publish_joints(self, sample):
        """Publish `joint_states` when it is due, for RViz and the like."""
        if self._joint_publisher is None:
            return
        due = self._joints_due(sample.stamp_ns, sample.number == 0)
        if due and self._joint_publisher.get_subscription_count():
            message = self._joint_state
            set_stamp(message.header.stamp, sample.stamp_ns)
            message.position = array("d", sample.position)
            message.velocity = array("d", () if sample.velocity is None else sample.velocity)
            message.effort = array("d", () if sample.torque is None else sample.torque)
            self._joint_publisher.publish(message)

    # Topic to device ---------------------------------------------------------------------------

    def _on_torque(self, raw):
        if not self.active:
            return
        try:
            message = self.torques(raw)
        except MessageError as error:
            self.gate.refused += 1
            self.refused(str(error))
            return
        with self._lock:
            refusal = self.gate.offer(message, self.now())
            self.answered(message)
        if refusal and refusal != self.gate.UNCONFIRMED:
            self.refused(refusal)

    def answered(self, message):
        """Act on a message that the gate has seen."""
        self.actuate()

    def refused(self, reason):
        """Log why a message is not applied."""
        self.report(reason)

    def actuate(self):
        """Apply the torque that acts now, or take the safe action."""
        torque = self.gate.torque(self.now())
        self._note_safe(torque is None)
        try:
            if self.safe:
                self.make_safe()
            else:
                self.apply(torque)
        except FlexarmError as error:
            self.fault = str(error)

    def _note_safe(self, safe):
        """Note whether the safe action acts, and log when it ends."""
        if safe and not self.safe:
            self._safe_since = self.now()
        elif self.safe and not safe:
            if self._safe_since is None:
                text = "the torque of a controller acts"
            else:
                lasted = max(self.now() - self._safe_since, 0.0)
                text = f"torque acts again, after {lasted:.3g} s of the safe action"
            self.report(text, info=True)
        self.safe = safe

    def watch(self):
        """Take the safe action when the torque has become too old."""
        if self.active:
            with self._lock:
                if self.gate.torque(self.now()) is None:
                    self.actuate()

    def diagnose(self):
        done, self._before = self._published - self._before, self._published
        values = {
            "samples per second": done,
            "torques refused": self.gate.refused,
            "torques clipped": self.gate.clipped,
            **self.details(),
        }
        return *self.judge(done), values

    def judge(self, samples):
        """Level and message for `/diagnostics`; `samples` were published in the last second."""
        gate = self.gate
        problem = self.problem(samples) or gate.controllers.doubt(self.now())
        if problem:
            return ERROR, problem
        if gate.reason:
            return WARN, f"{gate.reason}: the safe action is applied"
        return OK, ""
