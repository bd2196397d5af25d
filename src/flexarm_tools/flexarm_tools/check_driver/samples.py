# SPDX-License-Identifier: Apache-2.0
"""Holds recorded `ArmState` messages as arrays, and what a check finds."""

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np


class Verdict(str, Enum):
    """Outcome of a check. SKIPPED: the samples did not allow a judgement."""

    PASS = "PASS"
    WARN = "WARN"
    FAIL = "FAIL"
    SKIPPED = "SKIPPED"


class Finding(NamedTuple):
    """One check's result.

    Attributes
    ----------
    check : str
    verdict : Verdict
    text : str
        What was found, and what to do about it.
    """

    check: str
    verdict: Verdict
    text: str


@dataclass
class Samples:
    """N samples of a driver in the order of arrival; columns in the arm file's order.

    Attributes
    ----------
    arrival : ndarray, shape (N,)
        Time of arrival on a steady clock [s].
    clock : ndarray of int64, shape (N,)
        The same on the clock of the stamps [ns].
    stamp : ndarray of int64, shape (N,)
        [ns]
    session, sequence : ndarray of int64, shape (N,)
    position : ndarray, shape (N, joints)
        [rad]
    velocity : ndarray, shape (N, joints) or None
        [rad/s]; None where not published.
    torque : ndarray, shape (N, joints)
        [N m]; NaN where unknown.
    strain : ndarray, shape (N, gauges) or None
    amplitude : ndarray, shape (N, observed modes) or None
        Bending [m], twist [rad].
    """

    arrival: np.ndarray
    clock: np.ndarray
    stamp: np.ndarray
    session: np.ndarray
    sequence: np.ndarray
    position: np.ndarray
    velocity: np.ndarray | None
    torque: np.ndarray
    strain: np.ndarray | None
    amplitude: np.ndarray | None

    @property
    def size(self):
        """Number of samples N."""
        return self.stamp.size

    @property
    def time(self):
        """Stamps since the first, shape (N,) [s]."""
        return 1e-9 * (self.stamp - self.stamp[0])

    @property
    def period(self):
        """Median time between two samples by their stamps [s]; 0 where the sequence stands still."""
        steps = np.diff(self.sequence)
        advancing = steps > 0
        if not advancing.any():
            return 0.0
        return float(np.median(1e-9 * np.diff(self.stamp)[advancing] / steps[advancing]))


class Received(NamedTuple):
    """A message and its time of arrival."""

    message: object  # flexarm_msgs/ArmState
    arrival: float  # [s] steady clock
    clock: int  # [ns]


def samples(arm, received):
    """`Samples` of a list of `Received` whose names and lengths are right (see `check_layout`)."""
    messages = [h.message for h in received]

    def columns(field, names, wanted):
        first = messages[0]
        if not len(getattr(first, field)):
            return None
        order = [list(getattr(first, names)).index(n) for n in wanted]
        rows = [getattr(m, field) for m in messages]
        missing = np.full(len(wanted), np.nan)
        return np.array([np.asarray(r, float)[order] if len(r) else missing for r in rows])

    def head(values):
        return np.array(list(values), np.int64)

    torque = columns("joint_torque", "joint_names", arm.joint_names)
    position = columns("joint_position", "joint_names", arm.joint_names)
    return Samples(
        arrival=np.array([h.arrival for h in received]),
        clock=head(h.clock for h in received),
        stamp=head(m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec for m in messages),
        session=head(m.session for m in messages),
        sequence=head(m.sequence for m in messages),
        position=position,
        velocity=columns("joint_velocity", "joint_names", arm.joint_names),
        torque=np.full_like(position, np.nan) if torque is None else torque,
        strain=columns("strain", "gauge_names", arm.gauge_names),
        amplitude=columns("modal_amplitude", "mode_names", arm.observed_modes),
    )
