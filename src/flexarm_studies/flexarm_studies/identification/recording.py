# SPDX-License-Identifier: Apache-2.0
"""A recorded motion for identification: from a CSV file, or from the topics of a bag.

Row k of a recording holds the joint angles and strains at time k, and the torque that acted over the interval
that ends there, as `ArmState` carries it.
"""

from dataclasses import dataclass, replace

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from .. import tables

#: Stamps may be off their grid by this fraction of the period [-].
JITTER = 0.2
#: A shorter recording is none of a motion.
MIN_SAMPLES = 20
#: `JointTorque.ENABLED`.
ENABLED = 1
#: Samples after the first enabled torque (and before the last) that are left out: a safe action may still act.
MARGIN = 2


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded motion, without gaps.

    Attributes
    ----------
    period : float
        Time between two samples [s].
    position : ndarray, shape (s, n)
        Joint angles [rad].
    torque : ndarray, shape (s, n)
        Over the interval that ends at the sample; the first row is not used [N m].
    strain : ndarray, shape (s, g)
        In the order of the arm's gauges [-]; NaN where a gauge gave none.
    notes : tuple of str
        What was left out of it, and why.
    """

    period: float
    position: np.ndarray
    torque: np.ndarray
    strain: np.ndarray
    notes: tuple = ()

    @property
    def time(self):
        """From the first sample, shape (s,) [s]."""
        return self.period * np.arange(len(self.position))

    def part(self, samples):
        """Its first so many samples."""
        return replace(
            self,
            position=self.position[:samples],
            torque=self.torque[:samples],
            strain=self.strain[:samples],
        )


def uniform(arm, time, position, torque, strain, usable=None):
    """The longest stretch of samples without a gap, as a `Recording`.

    Parameters
    ----------
    arm : Arm
    time : ndarray, shape (s,)
        Ascending [s].
    position, torque, strain : ndarray, shape (s, n), (s, n), (s, g)
        [rad], [N m], [-].
    usable : ndarray of bool, shape (s,), optional
        Samples whose torque says what moved the arm.

    Raises
    ------
    FlexarmError
        For fewer than 20 samples, for joint angles that are not finite, and where no torque is known.
    """
    time, notes = np.asarray(time, float), []
    known = np.isfinite(torque).all(axis=1)
    usable = known if usable is None else known & usable
    if time.size >= MIN_SAMPLES and not known.any():
        hint = "the driver must report the torque that it applies"
        raise FlexarmError("is unknown (NaN) in every sample", field="joint_torque", hint=hint)
    steps = np.diff(time)
    if time.size < MIN_SAMPLES or not (steps > 0.0).all():
        limit = f"at least {MIN_SAMPLES}, with ascending stamps"
        raise FlexarmError("samples are no motion", value=time.size, limit=limit)
    period = float(np.median(steps))
    # Sample k is joined to k - 1 when the torque in between is known and lasted one period.
    joined = (np.abs(steps - period) <= JITTER * period) & usable[1:]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], joined.astype(int), [0]])))
    if not edges.size:
        raise FlexarmError("is unknown in one of every two samples in a row", field="joint_torque")
    starts, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - starts))
    keep = slice(int(starts[best]), int(ends[best]) + 1)
    kept = keep.stop - keep.start
    left = time.size - kept
    if kept < MIN_SAMPLES:
        problem = "samples are in the longest stretch without a gap"
        raise FlexarmError(problem, value=kept, limit=f"at least {MIN_SAMPLES}")
    if left > 2 * MARGIN + 2:
        notes.append(f"{left} of {time.size} samples left out: gaps, or torque not known")
    position = np.asarray(position, float)[keep]
    if not np.isfinite(position).all():
        raise FlexarmError("is not finite in some sample", field="joint_position")
    period = float((time[keep][-1] - time[keep][0]) / (kept - 1))
    strain = np.asarray(strain, float).reshape(time.size, len(arm.gauges))[keep]
    torque = np.nan_to_num(np.asarray(torque, float)[keep])
    return Recording(period, position, torque, strain, tuple(notes))


# CSV -------------------------------------------------------------------------------------------


def columns(arm):
    """Names of a CSV file's columns: ``t``, and per joint and gauge ``<joint>_position`` and so on."""
    names = ["t"]
    names += [f"{j}_position" for j in arm.joint_names]
    names += [f"{j}_torque" for j in arm.joint_names]
    return names + [f"{g}_strain" for g in arm.gauge_names]


def read_csv(path, arm):
    """Read a CSV file with `columns` in any order; others are ignored, those of gauges may be missing."""
    optional = [f"{g}_strain" for g in arm.gauge_names]
    table = tables.read_columns(path, columns(arm), optional)
    n = len(arm.joints)
    t, q, u, e = np.split(table, [1, 1 + n, 1 + 2 * n], axis=1)
    return uniform(arm, t[:, 0], q, u, e)


# Topics ----------------------------------------------------------------------------------------


def from_tables(states, torques, arm):
    """A recording from the tables of `arm_state` and, where there is one, of the `joint_torque` that answered it.

    With torques, only those samples count over which an enabled torque acted: the safe action before and after
    moves the arm in ways that no torque tells of. The tables `states` and `torques` are those of a bag's `Contents`:
    arrays ``session``, ``sequence``, ``stamp`` [ns], and ``columns``. Repeated samples are kept once.
    """
    if states is None or not states.stamp.size:
        raise FlexarmError("is not in the recording", field="arm_state")
    sessions, counts = np.unique(states.session, return_counts=True)
    session = sessions[counts.argmax()]
    rows = np.flatnonzero(states.session == session)[::-1]
    sequence, last = np.unique(states.sequence[rows], return_index=True)
    rows = rows[last]

    def column(name, width):
        values = states.columns.get(name)
        return np.full((rows.size, width), np.nan) if values is None else values[rows]

    position = column("joint_position", len(arm.joints))
    if not np.isfinite(position).all():
        raise FlexarmError("is empty or not finite in some sample", field="joint_position")
    usable = None
    if torques is not None:
        answered = (torques.session == session) & (torques.columns["mode"] == ENABLED)
        usable = _enabled(np.isin(sequence - 1, torques.sequence[answered]))
    time = 1e-9 * (states.stamp[rows] - states.stamp[rows[0]])
    torque = column("joint_torque", len(arm.joints))
    return uniform(arm, time, position, torque, column("strain", len(arm.gauges)), usable)


def _enabled(enabled):
    """Samples whose interval was under enabled torque, without `MARGIN` at either end, shape (s,) bool."""
    usable = enabled.copy()
    for k in range(1, MARGIN + 1):
        usable[k:] &= enabled[:-k]
        usable[:-k] &= enabled[k:]
    return usable
