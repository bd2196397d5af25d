# SPDX-License-Identifier: Apache-2.0
"""What was measured while an arm moved: from a CSV file, or from messages that were read from a bag.

Row k of a recording holds the joint angles and strains at time k, and the torque that acted over the interval
that ends there, as `ArmState` carries it.
"""

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.shown import listed, show

#: Stamps may be off their grid by this share of the period [-].
JITTER = 0.2
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

    Returns
    -------
    Recording

    Raises
    ------
    FlexarmError
        For fewer than 20 samples, for joint angles that are not finite, and where no torque is known.
    """
    time, notes = np.asarray(time, float), []
    known = np.isfinite(torque).all(axis=1)
    usable = known if usable is None else known & usable
    if time.size >= 20 and not known.any():
        raise FlexarmError(
            "joint_torque is unknown (NaN) in every sample: the driver must report the torque that it applies"
        )
    steps = np.diff(time)
    if time.size < 20 or not (steps > 0.0).all():
        raise FlexarmError(f"{time.size} samples; at least 20, with ascending stamps, are needed")
    period = float(np.median(steps))
    # Sample k is joined to k - 1 when the torque in between is known and lasted one period.
    joined = (np.abs(steps - period) <= JITTER * period) & usable[1:]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], joined.astype(int), [0]])))
    if not edges.size:
        raise FlexarmError("no two samples in a row whose torque is known")
    starts, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - starts))
    keep = slice(int(starts[best]), int(ends[best]) + 1)
    left = time.size - (keep.stop - keep.start)
    if keep.stop - keep.start < 20:
        raise FlexarmError(
            f"the longest stretch without a gap has {keep.stop - keep.start} samples; at least 20 are needed"
        )
    if left > 2 * MARGIN + 2:
        notes.append(f"{left} of {time.size} samples left out: gaps, or torque not known")
    position = np.asarray(position, float)[keep]
    if not np.isfinite(position).all():
        raise FlexarmError("joint_position is not finite in some sample")
    period = float((time[keep][-1] - time[keep][0]) / (keep.stop - keep.start - 1))
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
    """Read a CSV file with the columns of `columns`, in any order; columns of gauges may be missing.

    Raises
    ------
    FlexarmError
        For a column that is missing and for text that is no number, naming column and line.
    """
    path = Path(path)
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FlexarmError(f"{path}: can't be read as a table: {error}") from None
    if not rows:
        raise FlexarmError(
            f"{path}: empty; the first line names the columns: {', '.join(columns(arm))}"
        )
    head = [name.strip() for name in rows[0]]
    needed = columns(arm)
    optional = {f"{g}_strain" for g in arm.gauge_names}
    missing = [n for n in needed if n not in head and n not in optional]
    if missing:
        raise FlexarmError(f"{path}: no column {', '.join(missing)} (wanted: {', '.join(needed)})")
    table = np.full((len(rows) - 1, len(needed)), np.nan)
    for j, name in enumerate(needed):
        if name not in head:
            continue
        at = head.index(name)
        for i, row in enumerate(rows[1:]):
            try:
                table[i, j] = float(row[at])
            except (ValueError, IndexError):
                raise FlexarmError(f"{path} line {i + 2}: {name} is no number") from None
    n = len(arm.joints)
    t, q, u, e = np.split(table, [1, 1 + n, 1 + 2 * n], axis=1)
    return uniform(arm, t[:, 0], q, u, e)


def write_csv(path, recording, arm):
    """Write a recording as `read_csv` reads it."""
    table = np.column_stack(
        [recording.time, recording.position, recording.torque, recording.strain]
    )
    np.savetxt(path, table, delimiter=",", header=",".join(columns(arm)), comments="", fmt="%.17g")


# Messages --------------------------------------------------------------------------------------


def from_messages(states, torques, arm):
    """A recording from `ArmState` messages and, where there are some, the `JointTorque` that answered them.

    With torques, only those samples count over which an enabled torque acted: the safe action before and after
    moves the arm in ways that no torque tells of.

    Parameters
    ----------
    states, torques : sequence
        Messages, or what has their fields; repeats are kept once.
    arm : Arm

    Returns
    -------
    Recording

    Raises
    ------
    FlexarmError
    """
    if not states:
        raise FlexarmError("no arm_state in the recording")
    session = max((m.session for m in states), key=lambda s: sum(m.session == s for m in states))
    kept = {m.sequence: m for m in states if m.session == session}
    rows = [kept[k] for k in sorted(kept)]
    stamp = np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in rows])
    position = _in_order(rows, "joint_names", "joint_position", arm.joint_names, True)
    torque = _in_order(rows, "joint_names", "joint_torque", arm.joint_names, False)
    strain = _in_order(rows, "gauge_names", "strain", arm.gauge_names, False)
    usable = None
    if torques:
        usable = _enabled(rows, [m for m in torques if m.session == session])
    return uniform(arm, 1e-9 * (stamp - stamp[0]), position, torque, strain, usable)


def _in_order(rows, names, field, wanted, required):
    out = np.full((len(rows), len(wanted)), np.nan)
    for k, message in enumerate(rows):
        values, have = getattr(message, field), list(getattr(message, names))
        if len(values) == 0:
            continue
        if sorted(have) != sorted(wanted):
            raise FlexarmError(f"{names} {show(have)} are not this arm's: {listed(wanted)}")
        if len(values) != len(wanted):
            raise FlexarmError(f"{field} has {len(values)} values for {len(wanted)} {names}")
        out[k] = [values[have.index(name)] for name in wanted]
    if required and not np.isfinite(out).all():
        raise FlexarmError(f"{field} is empty or not finite in some sample")
    return out


def _enabled(rows, torques):
    """Samples whose interval was under enabled torque, but for `MARGIN` at either end."""
    answered = {m.sequence for m in torques if m.mode == ENABLED}
    enabled = np.array([m.sequence - 1 in answered for m in rows])
    usable = enabled.copy()
    for k in range(1, MARGIN + 1):
        usable[k:] &= enabled[:-k]
        usable[:-k] &= enabled[k:]
    return usable
