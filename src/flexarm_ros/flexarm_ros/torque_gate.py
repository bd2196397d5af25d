# SPDX-License-Identifier: Apache-2.0
"""The rules of `joint_torque`: which torque a driver may apply, and when it takes the safe action.

A torque acts while it answers a state of this session that was published no longer than the timeout ago.
Otherwise the joints take their safe action: before the first torque, without a fresh one, on DISABLED, after a
message that can't be used, and while two controllers send in turn.
"""

import numpy as np

from flexarm_dynamics.errors import MessageError

from .messages import TorqueReader


class Controllers:
    """Notices a second controller: an id that comes back after another one.

    A controller that was restarted has a new id and is accepted at once.

    Parameters
    ----------
    alone : float
        After two have sent in turn, one must be silent for this long; in the unit of the times given [s].

    Attributes
    ----------
    ids : set of int
        All ids since `forget`.
    pair : tuple of int
        The last two that sent in turn, ascending; empty before.
    """

    def __init__(self, alone):
        self.alone = alone
        self.forget()

    def forget(self):
        """Start again without any controller."""
        self.ids, self.pair = set(), ()
        self._last, self._until = None, -np.inf

    def note(self, controller, now):
        """Note a message; return whether two send in turn."""
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
    """Clips torques to the limits of an `arm`'s joints.

    Attributes
    ----------
    clipped : int
        Number of torques that exceeded a limit.
    """

    def __init__(self, arm):
        self._limit = arm.torque_limits
        self._torque = np.zeros(len(arm.joints))
        self.clipped = 0

    def clip(self, torque):
        """The torque within the limits, shape (n,) [N m]; valid until the next call."""
        np.clip(torque, -self._limit, self._limit, out=self._torque)
        self.clipped += bool((self._torque != torque).any())
        return self._torque


class TorqueGate:
    """Lets one controller's fresh torque through, clipped to the joints' limits.

    It has no clock: the caller gives all times, in seconds of one steady clock. It is not thread-safe: a driver
    that reads its device in another thread holds a lock around each call.

    Parameters
    ----------
    arm : Arm
        Its joint names and torque limits apply.
    timeout : float
        A torque is too late when it answers a state that was published longer ago than this [s].
    alone : float
        After two controllers have sent in turn, one must be silent for this long [s].

    Attributes
    ----------
    session : int
        Session of the states that are published.
    controllers : Controllers
        The controllers that sent in this session.
    reason : str
        Why the safe action is taken; empty while there is a torque.
    refused, clipped : int
        Number of messages that could not be used, and of torques that exceeded a limit.
    """

    #: Default of `alone` [s].
    ALONE = 1.0
    #: Reasons: two controllers send in turn; a message had the mode DISABLED.
    SEVERAL = "several controllers publish joint_torque: stop all but one"
    DISABLED = "the controller says DISABLED"

    def __init__(self, arm, timeout, alone=ALONE):
        self.timeout = timeout
        self.controllers = Controllers(alone)
        self._reader, self._limit = TorqueReader(arm), TorqueLimit(arm)
        self._torque = np.zeros(len(arm.joints))
        self.refused = 0
        self.begin(0)

    @property
    def clipped(self):
        """Number of torques that exceeded a limit."""
        return self._limit.clipped

    def begin(self, session):
        """Begin a new session of the source: earlier messages answer nothing any more."""
        self.session = session
        self._sent = {}  # sequence -> time of its publication, oldest first
        self._answered = None
        self._fresh_until = self._until = -np.inf
        self.controllers.forget()
        self.reason = "no torque yet"

    def sent(self, sequence, now):
        """Note that the state `sequence` is published now."""
        self._sent[sequence] = now
        while next(iter(self._sent.values())) < now - self.timeout:
            del self._sent[next(iter(self._sent))]

    def offer(self, message, now):
        """Accept a `JointTorque` message, or say why not.

        `now` is the driver's own steady clock [s].

        Returns
        -------
        str
            Why it is not applied; empty where it is.
        """
        if message.session != self.session:
            return f"torque for session {message.session}, this is session {self.session}"
        if self.controllers.note(message.controller_id, now):
            ids = ", ".join(map(str, self.controllers.pair))
            return self._close(self.SEVERAL.replace("controllers", f"controllers ({ids})"))
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
        self._fresh_until = self._sent[message.sequence] + self.timeout
        if torque is None:
            return self._close(self.DISABLED)
        self._torque[:] = self._limit.clip(torque)
        self._until = self._fresh_until
        self.reason = ""
        return ""

    def torque(self, now):
        """The torque to apply now, shape (n,) [N m]; None: take the safe action."""
        if self._until >= now:
            return self._torque
        if not self.reason:
            self.reason = f"no fresh torque for {self.timeout:g} s"
        return None

    def late(self, now):
        """Whether a controller has answered in this session, but not within the timeout."""
        return self._answered is not None and self._fresh_until < now

    def _close(self, reason):
        self._until, self.reason = -np.inf, reason
        return reason
