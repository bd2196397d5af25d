# SPDX-License-Identifier: Apache-2.0
"""Simulates the driver that lies, between an arm without faults and its control, sample by sample, without ROS.

The arm is a `Simulator` with its safe actions. Its measurements go through a `FaultInjector`, which makes the lies.
Observer and controller answer each message as their nodes do. The torques go through the rules of
`flexarm_ros.torque_gate` (`Gate`); their age counts from the first time that a sample was sent.
"""

import numpy as np

from flexarm_control.loop.samples import ArmSample
from flexarm_dynamics.errors import MessageError
from flexarm_sim.fault_injector import FIELDS, FaultInjector, Sample

from ..loop import scenario as scenarios

#: Like the drivers' `torque_timeout` and the controller's `state_timeout` [s].
TORQUE_TIMEOUT, STATE_TIMEOUT = 0.05, 0.5
#: After a race (see `Gate`), no torque is accepted and the safe action acts for this long [s].
ALONE = 1.0
#: Rounding of times must not end a torque a sample early [s].
ROUNDING = 1e-9
#: Name of an array in a fault's sample to its name in an `ArmSample`.
_ARRAYS = {
    "joint_position": "position",
    "joint_velocity": "velocity",
    "joint_torque": "torque",
    "strain": "strain",
    "modal_amplitude": "amplitude",
    "modal_rate": "rate",
}


class Gate:
    """Decides which torque acts, by the rules of `flexarm_ros.torque_gate.TorqueGate`, which needs messages of ROS.

    Each sample names the controller whose answer to the previous sample was taken. Only this controller's answer to the
    sample acts, and no longer than `TORQUE_TIMEOUT` after the sample was first sent. A second answer to the same sample
    under the same name, with another torque, is a race: then the safe action acts for `ALONE`.

    Parameters
    ----------
    session : int
        Session of the states that are sent.

    Attributes
    ----------
    renews : bool
        A wrong gate: a sample that is sent again renews the time of its torque.
    """

    def __init__(self, session):
        self.renews = False
        self.begin(session)

    def begin(self, session):
        """Begin a new session: earlier torques no longer answer any sample."""
        self.session, self._sent, self._newest, self._answered = session, {}, -1, -1
        self._claimant, self._fresh_until = 0, -np.inf
        self._torque, self._answer, self._until, self._raced_until = None, None, -np.inf, -np.inf

    def names(self, time):
        """Id of the controller whose answer to a sample of this `time` [s] will act; 0: of none."""
        return self._claimant if time <= self._fresh_until + ROUNDING else 0

    def sent(self, sequence, time):
        """Note that a sample is sent at `time` [s]; in a correct gate, sending it again changes nothing."""
        if self.renews or sequence > self._newest:
            self._sent[sequence] = time, self.names(time)
            self._newest = sequence
        while self._sent and self._oldest() < time - TORQUE_TIMEOUT - ROUNDING:
            del self._sent[next(iter(self._sent))]

    def _oldest(self):
        """Time at which the oldest kept sample was sent [s]."""
        return next(iter(self._sent.values()))[0]

    def offer(self, session, sequence, controller, torque, time):
        """Take a controller's answer to a sample at a `time` [s]: a torque (n,) [N m], None for DISABLED."""
        if session != self.session or sequence not in self._sent or sequence < self._answered:
            return
        if time < self._raced_until:
            self._claimant, self._torque = 0, None
            return
        again = sequence == self._answered and controller == self._claimant and torque is not None
        if again and (self._answer is None or (torque != self._answer).any()):
            self._raced_until = time + ALONE
            self._claimant, self._torque = 0, None
            return
        sent, named = self._sent[sequence]
        self._answered, self._claimant, self._answer = sequence, controller, torque
        self._fresh_until = self._until = sent + TORQUE_TIMEOUT
        self._torque = torque if named == controller else None

    def torque(self, time):
        """The torque that acts at a `time` [s]; None: the safe action."""
        return self._torque if time <= self._until + ROUNDING else None


class LyingDriver:
    """One run of an arm whose driver lies.

    Parameters
    ----------
    scenario : Scenario
        Arm, observer and controller; without delay, loss and jitter.
    faults : sequence of str
        Lines of `fault_injector`, their times counted from the session's start.
    begin : float
        From this time on samples go through the faults; before, they are as measured [s].

    Attributes
    ----------
    refuses : bool
        The drives do not take the torque: the safe action acts, and the message reports this.
    spoofed : ndarray or None
        Torque (n,) of another sender, which is sent under the controller's name, session and sequence [N m].
    controller_id : int
        Id of the controller that is running.
    answers : bool
        Whether there is a controller that answers.
    trust, reason : int, str
        What the device itself reports about its samples, as in `ArmState`.
    last_new : float
        Time at which the last new sample was answered [s].
    off : dict of str to list of (float, float)
        For each field that a fault falsifies: time, and largest error.
    doubt : str
        The sensor that the observer doubts in the last estimate.
    """

    def __init__(self, scenario, faults=(), begin=0.0):
        self.scenario, self.gate = scenario, Gate(1)
        self.loop = loop = scenarios.loop_of(scenario)
        self.period = 1e-9 * loop.simulator.period_ns
        self.injector = FaultInjector(loop.model.arm, faults)
        arm = loop.model.arm
        self._names = {
            "joint_names": list(arm.joint_names),
            "gauge_names": list(arm.gauge_names),
            "mode_names": list(arm.observed_modes),
        }
        self._begin, self.last_new, self._last_key = begin, 0.0, None
        self.refuses, self.spoofed, self.controller_id, self.answers = False, None, 1, True
        self.trust, self.reason, self.doubt = ArmSample.TRUSTED, "", ""
        self.off = {}
        loop.controller.controller_id = self.controller_id

    @property
    def time(self):
        """Since the start of the session [s]."""
        return self.loop.simulator.time

    def answer(self):
        """Measure, lie, and let observer and controller answer; return the torque that acts next, or None."""
        true, time = self.loop.measure(), self.time
        true.controller_id = 0 if self.refuses else self.gate.names(time)
        true.trust, true.doubt = self.trust, self.reason
        for message in self._messages(true, time):
            if message.session == self._own_session:
                self.gate.sent(message.sequence, time)
            self._answered(message, time)
        self._watch(time)
        return None if self.refuses else self.gate.torque(time)

    def advance(self, torque):
        """Advance the arm by one period under the torque that acts."""
        self.loop.simulator.advance(torque)

    @property
    def _own_session(self):
        return 1 + self.injector.session

    def _messages(self, true, time):
        """The messages that are sent for a sample, in order."""
        if not self.injector.faults or time < self._begin - 1e-9:
            return [_sample(true, _fields(true, self._names))]
        out = self.injector.outgoing(_fields(true, self._names), time)
        if self._own_session != self.gate.session:
            self.gate.begin(self._own_session)  # the driver has restarted
        for s in out[:1]:
            self._note_lies(true, s, time)
        return [_sample(true, s) for s in out]

    def _note_lies(self, true, given, time):
        for signal in {f.signal for f in self.injector.faults} & set(FIELDS):
            right, wrong = getattr(true, _ARRAYS[signal]), given.values[signal]
            if right is not None and wrong is not None and wrong.shape == right.shape:
                size = float(np.abs(wrong - right).max(initial=0.0))
                self.off.setdefault(signal, []).append((time, size))

    def _answered(self, message, time):
        """Let observer and controller handle one message, as their nodes do."""
        loop, controller = self.loop, self.loop.controller
        if not self.answers:
            return
        if message.key != self._last_key:  # a repetition is not a sign of life
            self.last_new, self._last_key = time, message.key
        try:
            estimate = loop.estimate(message)
            self.doubt = estimate.doubt
            enabled = controller.step(estimate)
        except MessageError as error:
            controller.distrust(str(error))
            self.doubt, enabled = str(error), False
        if enabled is not None:
            self._send(message.key, controller.torque.copy() if enabled else None)

    def _send(self, key, torque):
        """Send the controller's answer to a sample; a spoofed one comes right after it."""
        self.gate.offer(*key, self.controller_id, torque, self.time)
        if self.spoofed is not None:
            self.gate.offer(*key, self.controller_id, self.spoofed, self.time)

    def _watch(self, time):
        """Do as the controller's node, which notices that the states have stopped."""
        if time - self.last_new > STATE_TIMEOUT and self.loop.controller.enabled:
            self.loop.controller.distrust(f"no arm_state_estimate for {STATE_TIMEOUT:g} s")
            self._send(self._last_key, None)


def _fields(sample, names):
    """An `ArmSample` as a sample of the fault injector."""
    values = {name: getattr(sample, attribute) for name, attribute in _ARRAYS.items()}
    if not sample.velocity_known:
        values["joint_velocity"] = None
    return Sample(sample.sequence, sample.stamp_ns, names, {k: values[k] for k in FIELDS}).copy()


def _sample(true, given):
    """A new `ArmSample` of what the fault injector gives for the `true` one."""
    out = ArmSample(true.position.size)
    out.stamp_ns, out.session, out.sequence = (
        given.stamp_ns,
        true.session + given.session,
        given.sequence,
    )
    for name, attribute in _ARRAYS.items():
        setattr(out, attribute, given.values[name])
    out.velocity_known = out.velocity is not None
    if out.velocity is None:
        out.velocity = np.zeros_like(true.velocity)
    out.controller_id, out.trust, out.doubt = true.controller_id, true.trust, true.doubt
    return out
