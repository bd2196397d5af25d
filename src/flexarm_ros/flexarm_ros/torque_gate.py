# SPDX-License-Identifier: Apache-2.0
"""Decides which `joint_torque` a driver may apply, and when it takes the safe action.

A torque acts while it answers a state of this session that names the torque's controller, and whose first publication
is not longer ago than the timeout. Otherwise the joints take their safe action: before the first such torque, without a
fresh torque, on DISABLED, after a message that can't be used, and while two controllers send.
"""

import numpy as np

from flexarm_dynamics.errors import MessageError

from .messages import TorqueReader

#: Sequence numbers on the topics are uint32.
WRAP = 2**32


class Controllers:
    """Detects a second controller: an id that comes back after another one, or two answers where one is due.

    A controller that was restarted has a new id and is accepted at once.

    Parameters
    ----------
    alone : float
        After two have sent, one must be silent for this long; in the unit of the given times [s].

    Attributes
    ----------
    ids : set of int
        All ids since `forget`.
    pair : tuple of int
        The last two that sent in turn, ascending; empty before.
    """

    #: Reasons: two ids in turn; one id with two torques for one state.
    SEVERAL = "several controllers publish joint_torque: stop all but one"
    RACED = (
        "two answers to one state under one controller_id: a second program publishes joint_torque"
    )

    def __init__(self, alone):
        self.alone = alone
        self.forget()

    def forget(self):
        """Start again without any controller."""
        self.ids, self.pair = set(), ()
        self._last, self._until, self._reason = None, -np.inf, ""
        self._withdrawn = -np.inf  # when a torque was last withdrawn

    def note(self, controller, now):
        """Note a message; return whether two send."""
        if controller != self._last:
            if controller in self.ids:
                self.pair = tuple(sorted((controller, self._last)))
                ids = ", ".join(map(str, self.pair))
                self._dispute(now, self.SEVERAL.replace("controllers", f"controllers ({ids})"))
            self._last = controller
            self.ids.add(controller)
        return self.several(now)

    def race(self, now):
        """Note that two torques answered one state under one id."""
        self._dispute(now, self.RACED)

    def withdraw(self, now):
        """Note DISABLED after a torque for the same state: once is a controller's stop, twice are two controllers."""
        if now - self._withdrawn < self.alone:
            self.race(now)
        self._withdrawn = now

    def _dispute(self, now, reason):
        self._until, self._reason = now + self.alone, reason

    def several(self, now):
        """Whether two send."""
        return now < self._until

    def doubt(self, now):
        """Why it is unknown which controller's torque is the right one; empty if it is known."""
        return self._reason if self.several(now) else ""


class TorqueLimit:
    """Clips torques to the limits of an `arm`'s joints.

    Attributes
    ----------
    clipped : int
        Number of torques that exceeded a limit.
    """

    def __init__(self, arm):
        self._limit = arm.torque_limits
        self._least = -self._limit
        self._torque = np.zeros(len(arm.joints))
        self.clipped = 0

    def clip(self, torque):
        """The torque within the limits, shape (n,) [N m]; valid until the next call."""
        # `np.clip` takes three times as long for a few values.
        np.maximum(torque, self._least, out=self._torque)
        np.minimum(self._torque, self._limit, out=self._torque)
        self.clipped += np.count_nonzero(self._torque != torque) > 0
        return self._torque


class TorqueGate:
    """Lets one controller's fresh torque through, clipped to the joints' limits.

    A controller claims the arm by answering a state. From then on the states name it, and its answers to *those* act.
    So another program would have to read the states and to race the controller, which is detected. The claim ends when
    no answer has come for the timeout, with a message that can't be used, and with a message of another controller.

    It has no clock: the caller gives all times, in seconds of one steady clock. It is not thread-safe: a driver
    that reads its device in another thread holds a lock around each call.

    Parameters
    ----------
    arm : Arm
        Its joint names and torque limits apply.
    timeout : float
        A torque is too late if it answers a state that was first published longer ago than this [s].
    alone : float
        After two controllers have sent, one must be silent for this long [s].

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
    #: Reasons: a message had the mode DISABLED; the state that it answers did not name its controller.
    DISABLED = "the controller says DISABLED"
    UNCONFIRMED = "the controller's first answer: those to states with its controller_id act"

    def __init__(self, arm, timeout, alone=ALONE):
        self.timeout = timeout
        self.controllers = Controllers(alone)
        self._reader, self._limit = TorqueReader(arm), TorqueLimit(arm)
        self._torque, self._answer = np.zeros((2, len(arm.joints)))
        self.refused = 0
        self.begin(0)

    @property
    def clipped(self):
        """Number of torques that exceeded a limit."""
        return self._limit.clipped

    def begin(self, session):
        """Begin a new session of the source: earlier messages no longer answer any state."""
        self.session = session
        self._sent = {}  # sequence -> (time of its first publication, controller that it names), oldest first
        self._newest = self._answered = None
        self._enabled = False  # mode of the answer to the state `_answered`
        self._claimant = 0
        self._fresh_until = self._until = -np.inf
        self.controllers.forget()
        self.reason = "no torque yet"

    def controller_id(self, now):
        """Id of the controller whose answer to a state that is published now will act; 0: no controller."""
        return self._claimant if self._fresh_until >= now else 0

    def sent(self, sequence, now):
        """Note that the state `sequence` is published now; return the `controller_id` that it has to name.

        A state that is published again keeps its first time: a repetition is not a sign of life.
        """
        named = self.controller_id(now)
        if sequence in self._sent:
            self._sent[sequence] = self._sent[sequence][0], named
        elif self._newest is None or 0 < (sequence - self._newest) % WRAP < WRAP // 2:
            self._sent[sequence], self._newest = (now, named), sequence
            while next(iter(self._sent.values()))[0] < now - self.timeout:
                del self._sent[next(iter(self._sent))]
        return named

    def offer(self, message, now):
        """Accept a `JointTorque` message, or return why it is refused.

        `now` is the driver's own steady clock [s].

        Returns
        -------
        str
            Why it is not applied; empty if it is.
        """
        sequence, controller = message.sequence, message.controller_id
        if message.session != self.session:
            return f"torque for session {message.session}, this is session {self.session}"
        if self.controllers.note(controller, now):
            return self._drop(self.controllers.doubt(now))
        sent, named = self._sent.get(sequence, (-np.inf, 0))
        if sent < now - self.timeout:
            return f"torque for state {sequence}, which is older than the timeout or was never sent"
        if self._answered is not None and (sequence - self._answered) % WRAP >= WRAP // 2:
            return f"torque for state {sequence} after that for {self._answered}"
        try:
            torque = self._reader.read(message)
            if not controller:
                raise MessageError(
                    "is no controller's: draw one at random", field="controller_id", value=0
                )
        except MessageError as error:
            self.refused += 1
            return self._drop(str(error))
        if torque is not None and sequence == self._answered and controller == self._claimant:
            if not self._enabled:
                return f"torque for state {sequence} after DISABLED for it"
            if (torque != self._answer).any():
                self.controllers.race(now)
                return self._drop(self.controllers.doubt(now))
        if torque is None and sequence == self._answered and self._enabled:
            self.controllers.withdraw(now)
            if self.controllers.several(now):
                return self._drop(self.controllers.doubt(now))
        self._answered, self._enabled = sequence, torque is not None
        self._claimant, self._fresh_until = controller, sent + self.timeout
        if torque is None:
            return self._close(self.DISABLED)
        self._answer[:] = torque
        if named != controller:
            return self._close(self.UNCONFIRMED)
        self._torque[:] = self._limit.clip(torque)
        self._until, self.reason = self._fresh_until, ""
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
        """Take the safe action; the claim stays."""
        self._until, self.reason = -np.inf, reason
        return reason

    def _drop(self, reason):
        """Take the safe action, and end the claim."""
        self._claimant = 0
        return self._close(reason)
