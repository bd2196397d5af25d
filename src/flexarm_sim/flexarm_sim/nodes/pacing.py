# SPDX-License-Identifier: Apache-2.0
"""Decides when the simulated arm advances by a period: on the grid of real time, or in lockstep with the controller."""

from flexarm_dynamics.parameters import parameter
from flexarm_ros.torque_gate import TorqueGate

#: In lockstep, after two controllers sent in turn, one is alone again after this many samples of the other's silence.
ALONE_SAMPLES = 100
#: In lockstep, periods without a message that are run before other calls are served.
AT_ONCE = 200
#: In lockstep, a state without an answer for this long is reported [s].
UNANSWERED = 5.0

PARAMETERS = (
    parameter("lockstep", False, read_only=True).described(
        "Advance by one period per torque that answers the last state, as fast as the machine allows; false: real time."
    ),
    parameter("pause_at", 0.0, "s", -1.0, 1e6).described(
        "In lockstep, pause at this simulated time, once, until `~/pause` is called with data false;"
        " negative, or a time that is past: never."
    ),
    parameter("resend_period", 0.1, "s", 0.01, 10.0, read_only=True).described(
        "In lockstep or paused: time without an answer after which the state is sent again (wall time)."
    ),
    parameter("real_time_factor", 1.0, "-", 0.001, 100.0, read_only=True).described(
        "In real time: seconds simulated per second of wall time."
    ),
    parameter("torque_timeout", 0.05, "s", 0.001, 10.0, read_only=True).described(
        "In real time: a torque that answers a state older than this is too late; the safe action follows."
    ),
    parameter("joint_states_rate", 50.0, "Hz", 0.1, 20000.0, read_only=True).described(
        "Rate of joint_states, in simulated time; at most the control rate."
    ),
)


class RealTime:
    """Advances at each period of the steady clock, whether a torque has come or not.

    Parameters
    ----------
    node : SimulatorNode

    Attributes
    ----------
    late : int
        Periods without a fresh torque.
    """

    name = "real time"

    def __init__(self, node):
        self._node = node
        self.late = 0

    def alone(self):
        """Silence of one controller after which the other one is alone, see `TorqueGate`; in simulated time [s]."""
        return TorqueGate.ALONE

    def connect(self, torques):
        """Make the grid of periods, and `joint_torque` between them, the control path."""
        node = self._node
        period = node.period / node.parameters["real_time_factor"]
        node.make_control_path(torques, period, self._on_period)

    def _on_period(self):
        node = self._node
        if not node.active or node.paused:
            return
        self.late += node.gate.late(node.now())
        was_safe = node.safe
        node.step()
        if node.safe and not was_safe:
            node.report("no fresh torque: the safe action is applied")

    def set_pause(self, time):
        """Nothing to do: real time pauses only on request."""

    def pauses_at(self, sequence):
        """Whether a pause begins at this sample."""
        return False

    def answered(self, message):
        """Nothing to do: the torque acts from the next period on."""

    def go_on(self):
        """Nothing to do: the clock goes on."""

    def resend(self):
        """Steady clock: in a pause, send the state again."""
        if self._node.active and self._node.paused:
            self._node.send(again=True)


class Lockstep:
    """Advances by one period for each torque that answers the newest state, as fast as the machine allows.

    Parameters
    ----------
    node : SimulatorNode
    """

    name = "lockstep"
    late = 0

    def __init__(self, node):
        self._node = node
        self._resent = 0  # how often the state was sent again since the last step
        self.set_pause(node.parameters["pause_at"])

    def alone(self):
        """Silence of one controller after which the other is alone, see `TorqueGate` [s]."""
        return (ALONE_SAMPLES - 0.5) * self._node.period  # rounding does not decide

    def connect(self, torques):
        """Make `joint_torque` the control path."""
        self._node.make_control_path(torques)

    def set_pause(self, time):
        """Pause at this simulated time [s], counted in samples: the same in every run; negative: never."""
        self._pause = round(time * 1e9 / self._node.sim.period_ns) if time >= 0.0 else None

    def pauses_at(self, sequence):
        """Whether a pause begins at this sample."""
        return sequence == self._pause

    def answered(self, message):
        """Advance when the message answers the awaited state.

        Answers to a state that was sent again are ignored. So is every answer during a pause: after the pause the state
        is sent again, and the controller answers from its cache.
        """
        node = self._node
        waited = message.session == node.gate.session and message.sequence == node.awaited
        if waited and not node.paused:
            self._step()
            self.go_on()

    def go_on(self):
        """Advance while there is no answer to wait for, because a fault held the message back.

        The last torque acts until it is too old.
        """
        for _ in range(AT_ONCE):
            if self._node.paused or self._node.awaited is not None:
                return
            self._step()

    def _step(self):
        self._resent = 0
        self._node.step()

    def resend(self):
        """Steady clock: send an unanswered state again, and report that nothing answers."""
        node = self._node
        if not node.active:
            return
        self._resent += 1
        if node.awaited is None:
            self.go_on()
            return
        node.send(again=True)
        if not node.paused and self._resent * node.parameters["resend_period"] >= UNANSWERED:
            node.report(
                f"no joint_torque answers state {node.sim.sequence} for {UNANSWERED:g} s: are observer and"
                " controller running, on this domain, with this arm?"
            )
