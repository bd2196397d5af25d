# SPDX-License-Identifier: Apache-2.0
"""What must hold for every sample on the topics, whatever happens to the nodes."""

from collections import Counter

import numpy as np

from flexarm_msgs.msg import CompositeState, JointTorque
from flexarm_ros.messages import stamp_ns

#: Number of estimates that are kept for the torques that answer them.
KEPT = 4000
#: States in which the controller sends torque.
RUNNING = (
    CompositeState.READY,
    CompositeState.TRACKING,
    CompositeState.HOLDING,
    CompositeState.STOPPING,
)


class Invariants:
    """Checks messages in order of arrival, and keeps only what later checks need.

    Parameters
    ----------
    limit, rate : ndarray, shape (n,)
        Largest torque [N m], and its largest change per second [N m/s].

    Attributes
    ----------
    counts : Counter
        What was seen.
    broken : Counter
        How often each invariant did not hold.
    first : dict of str to str
        The first failure of each invariant.
    """

    def __init__(self, limit, rate):
        self.limit, self.rate = np.asarray(limit), np.asarray(rate)
        self.counts, self.broken, self.first = Counter(), Counter(), {}
        self._valid = {}  # (session, sequence) -> whether the estimate may be used
        self._answers = {}  # (session, sequence) -> the torque that answered it
        self._last = None  # the last torque

    def _demand(self, holds, what, text=""):
        if not holds:
            self.broken[what] += 1
            self.first.setdefault(what, text)

    @staticmethod
    def _cut(kept):
        while len(kept) > KEPT:
            del kept[next(iter(kept))]

    def estimate(self, msg):
        """A message of `arm_state_estimate`."""
        self.counts["estimates"] += 1
        values = (msg.joint_position, msg.joint_velocity, msg.modal_amplitude, msg.modal_rate)
        self._valid[msg.session, msg.sequence] = all(
            len(v) and np.isfinite(v).all() for v in values
        )
        self._cut(self._valid)

    def torque(self, msg):
        """A message of `joint_torque`."""
        u, key = np.array(msg.torque), (msg.session, msg.sequence)
        enabled = msg.mode == JointTorque.ENABLED
        self.counts["torques"] += 1
        self.counts["enabled"] += enabled
        where = f"state {msg.sequence} of session {msg.session}: {u.tolist()}"
        self._demand(np.isfinite(u).all(), "torque finite", where)
        self._demand(enabled or not u.any(), "disabled is zero", where)
        self._demand((np.abs(u) <= self.limit).all(), "torque within its limit", where)
        # Without the estimate, because it is late or lost, there is nothing to check.
        valid = self._valid.get(key, True)
        self._demand(valid or not enabled, "enabled with a valid state alone", where)
        last, self._last = (
            self._last,
            (msg.session, msg.sequence, stamp_ns(msg.header.stamp), u, enabled),
        )
        if last is not None and last[0] == msg.session and key != last[:2]:
            self._demand((msg.sequence - last[1]) % 2**32 < 2**31, "answers in order", where)
            dt = 1e-9 * (self._last[2] - last[2])
            if enabled and last[4] and dt > 0.0:
                most = self.rate * dt * (1.0 + 1e-9) + 1e-12
                self._demand((np.abs(u - last[3]) <= most).all(), "torque within its rate", where)
        self._answers[key] = u
        self._cut(self._answers)

    def state(self, msg):
        """A message of `controller/state`."""
        self.counts["states"] += 1
        self.counts[f"supervisor {msg.supervisor_state}"] += 1
        where = f"state {msg.sequence} of session {msg.session}: {list(msg.torque)}"
        off = msg.supervisor_state not in RUNNING
        self._demand(not off or not any(msg.torque), "no torque in fault", where)
        self._demand(np.isfinite(np.array(msg.reference_position)).all(), "reference finite", where)
