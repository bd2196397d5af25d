# SPDX-License-Identifier: Apache-2.0
"""Which torque a driver may apply, and when it must not: the rules of `joint_torque`, without a clock of its own.

A torque acts while it answers a state of this session that was published no longer than the timeout ago. Else
the joints' safe action follows: before the first torque, without a fresh one, on DISABLED, on a message that
can't be used, and while two controllers send in turn.
"""

import numpy as np

from flexarm_dynamics.errors import MessageError

from .messages import TorqueReader


class Controllers:
    """Who sends: an id that comes back after another one is that of a second controller.

    A controller that was restarted has a new id, and is taken at once.

    Parameters
    ----------
    alone : float
        After two were heard in turn, one has to be silent for so long; in the unit of the times given [s].

    Attributes
    ----------
    ids : set of int
        Heard since `forget`.
    pair : tuple of int
        The last two that were heard in turn, ascending; empty before.
    """

    def __init__(self, alone):
        self.alone = alone
        self.forget()

    def forget(self):
        """Nobody has been heard."""
        self.ids, self.pair = set(), ()
        self._last, self._until = None, -np.inf

    def heard(self, controller, now):
        """Note a message; whether two send in turn."""
        if controller != self._last:
            if controller in self.ids:
                self._until = now + self.alone
                self.pair = tuple(sorted((controller, self._last)))
            self._last = controller
            self.ids.add(controller)
        return self.several(now)

    def several(self, now):
        """Whether two send in turn."""
        return now < self._until


class TorqueLimit:
    """Clips torques to the joints' limits.

    Parameters
    ----------
    arm : Arm

    Attributes
    ----------
    clipped : int
        Torques that went beyond a limit.
    """

    def __init__(self, arm):
        self._limit = np.array([j.limits.torque for j in arm.joints])
        self._torque = np.zeros(len(arm.joints))
        self.clipped = 0

    def clip(self, torque):
        """The torque within the limits, shape (n,) [N m]; valid until the next call."""
        np.clip(torque, -self._limit, self._limit, out=self._torque)
        self.clipped += bool((self._torque != torque).any())
        return self._torque


class TorqueGate:
    """Lets one controller's fresh torque through, clipped to the joints' limits.

    All times are of one steady clock, in seconds, given by the caller. Not safe for threads: a driver that reads
    its device in a thread of its own holds a lock around each call.

    Parameters
    ----------
    arm : Arm
        Whose names and torque limits count.
    timeout : float
        A torque is too late when it answers a state that was published longer ago [s].

    Attributes
    ----------
    reason : str
        Why the safe action is applied; empty while there is a torque.
    refused, clipped : int
        Messages that could not be used, and torques that went beyond a limit.
    """

    #: After two controllers were heard in turn, one has to be silent for so long [s].
    ALONE = 1.0

    def __init__(self, arm, timeout):
        self.timeout = timeout
        self._reader = TorqueReader(arm)
        self._limit, self._controllers = TorqueLimit(arm), Controllers(self.ALONE)
        self._torque = np.zeros(len(arm.joints))
        self.refused = self.clipped = 0
        self.begin(0)

    def begin(self, session):
        """A new session of the source: what was sent before answers nothing any more."""
        self.session = session
        self._sent = {}  # sequence -> time of its publication, oldest first
        self._answered = None
        self._until = -np.inf
        self._controllers.forget()
        self.reason = "no torque yet"

    def sent(self, sequence, now):
        """Note that the state `sequence` is published now."""
        self._sent[sequence] = now
        while next(iter(self._sent.values())) < now - self.timeout:
            del self._sent[next(iter(self._sent))]

    def offer(self, message, now):
        """Take a `JointTorque` message, or say why not.

        `now` is the driver's own steady clock [s].

        Returns
        -------
        str
            Why it is not applied; empty where it is.
        """
        if message.session != self.session:
            return f"torque for session {message.session}, this is session {self.session}"
        if self._controllers.heard(message.controller_id, now):
            return self._close("several controllers publish joint_torque: stop all but one")
        if message.sequence not in self._sent:
            return f"torque for state {message.sequence}, which is older than the timeout or was never sent"
        if self._answered is not None and (message.sequence - self._answered) % 2**32 >= 2**31:
            return f"torque for state {message.sequence} after that for {self._answered}"
        try:
            torque = self._reader.read(message)
        except MessageError as error:
            self.refused += 1
            return self._close(str(error))
        self._answered = message.sequence
        if torque is None:
            return self._close("the controller says DISABLED")
        self._torque[:] = self._limit.clip(torque)
        self.clipped = self._limit.clipped
        self._until = self._sent[message.sequence] + self.timeout
        self.reason = ""
        return ""

    def torque(self, now):
        """The torque to apply now, shape (n,) [N m]; None: the safe action."""
        if self._until >= now:
            return self._torque
        if not self.reason:
            self.reason = f"no fresh torque for {self.timeout:g} s"
        return None

    def _close(self, reason):
        self._until, self.reason = -np.inf, reason
        return reason
