# SPDX-License-Identifier: Apache-2.0
"""Holds a recorded motion for identification, from a CSV file or from the topics of a bag.

Row k of a recording holds the joint angles and strains at time k, and the torque that acted over the interval that ends
there, as in `ArmState`. Other measured signals are kept beside them.
"""

from dataclasses import dataclass, replace

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from .. import tables
from ..recordings import mapping as mappings

#: Stamps may be off their grid by this fraction of the period [-].
JITTER = 0.2
#: A shorter recording does not count as a motion.
MIN_SAMPLES = 20
#: `JointTorque.ENABLED`.
ENABLED = 1
#: Number of samples that are left out after the first enabled torque and before the last: a safe action may act there.
MARGIN = 2
#: Attributes of a `Recording` that have a row per sample: those of joints, and all.
OF_JOINTS = ("position", "velocity", "acceleration", "torque", "current")
SIGNALS = (*OF_JOINTS, "strain", "amplitude", "linear_acceleration", "angular_velocity")


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded motion, without gaps. Values that were not measured are NaN; a kind never measured is None.

    Attributes
    ----------
    period : float
        Time between two samples [s].
    position : ndarray, shape (s, n)
        Joint angles [rad].
    torque : ndarray, shape (s, n)
        Torque over the interval that ends at the sample; the first row is not used [N m].
    strain : ndarray, shape (s, g)
        In the order of the arm's gauges [-].
    notes : tuple of str
        What was left out of the recording, and why.
    velocity, acceleration, current : ndarray, shape (s, n), or None
        Of the joints [rad/s], [rad/s^2], [A].
    amplitude : ndarray, shape (s, m), or None
        Of the modes [m, rad].
    linear_acceleration, angular_velocity : ndarray, shape (s, i), or None
        Of the axes of IMUs [m/s^2], [rad/s].
    joint_names, gauge_names, mode_names, imu_names : tuple of str
        Names of the columns; empty if only the arm gives them.
    start : float
        Time of the first sample, as the source counts it [s].
    stamps : ndarray, shape (k,), or None
        Times of all samples of the source, as it counts them, including samples that were left out [s].
    held : tuple of str
        Joints that were not measured because they stand still.
    """

    period: float
    position: np.ndarray
    torque: np.ndarray
    strain: np.ndarray
    notes: tuple = ()
    velocity: np.ndarray | None = None
    acceleration: np.ndarray | None = None
    current: np.ndarray | None = None
    amplitude: np.ndarray | None = None
    linear_acceleration: np.ndarray | None = None
    angular_velocity: np.ndarray | None = None
    joint_names: tuple = ()
    gauge_names: tuple = ()
    mode_names: tuple = ()
    imu_names: tuple = ()
    start: float = 0.0
    stamps: np.ndarray | None = None
    held: tuple = ()

    @property
    def time(self):
        """From the first sample, shape (s,) [s]."""
        return self.period * np.arange(len(self.position))

    def part(self, samples):
        """Its first `samples` samples."""
        return self._cut(slice(0, samples))

    def between(self, start, end):
        """The samples from `start` to `end` [s], as the source counts the time.

        Raises
        ------
        FlexarmError
            For fewer than 20 samples.
        """
        # Half a period: stamps are rounded.
        first, last = np.ceil((np.array([start, end]) - self.start) / self.period - [0.5, -0.5])
        made = self._cut(slice(max(int(first), 0), max(int(last), 0)))
        if len(made.position) < MIN_SAMPLES:
            whole = self.start + self.period * len(self.position)
            raise FlexarmError(
                f"has {len(made.position)} samples", field=f"part {start:g}:{end:g} of the recording",
                limit=f"at least {MIN_SAMPLES}; it is from {self.start:g} to {whole:g} s",
            )  # fmt: skip
        return made

    def _cut(self, rows):
        signals = {name: getattr(self, name) for name in SIGNALS}
        cut = {name: values[rows] for name, values in signals.items() if values is not None}
        return replace(self, start=self.start + self.period * (rows.start or 0), **cut)

    def need_torque(self):
        """Refuse a recording without torque.

        Raises
        ------
        FlexarmError
        """
        if not np.isfinite(self.torque).any():
            hint = "the driver must report the torque that it applies"
            raise FlexarmError("is unknown (NaN) in every sample", field="joint_torque", hint=hint)


def kind_of(quantity):
    """Which of joint, gauge, mode and imu a quantity of `SIGNALS` belongs to."""
    return mappings.QUANTITIES[quantity][0]


def uniform(time, signals, usable=None, **more):
    """The longest stretch of samples without a gap, as a `Recording`.

    Parameters
    ----------
    time : ndarray, shape (k,)
        Ascending [s].
    signals : dict
        Names of `SIGNALS`, including ``position`` and ``strain``, to arrays with k rows.
    usable : ndarray of bool, shape (k,), optional
        Samples whose recorded torque is the one that moved the arm; None: all.
    more
        Further attributes of the `Recording`.

    Raises
    ------
    FlexarmError
        For fewer than 20 samples, and for joint angles that are not finite.
    """
    time, notes = np.asarray(time, float), []
    signals = {name: np.asarray(values, float) for name, values in signals.items()}
    signals.setdefault("torque", np.full(signals["position"].shape, np.nan))
    known = np.isfinite(signals["torque"]).all(axis=1)
    if known.any():
        signals["torque"] = np.nan_to_num(signals["torque"])
    else:  # the recorded signal is the motion itself
        known[:] = True
    usable = known if usable is None else known & usable
    steps = np.diff(time)
    if time.size < MIN_SAMPLES or not (steps > 0.0).all():
        limit = f"at least {MIN_SAMPLES}, with ascending stamps"
        raise FlexarmError("samples are no motion", value=time.size, limit=limit)
    period = float(np.median(steps))
    # Sample k follows k - 1 without a gap if the torque in between is known and lasted one period.
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
    signals = {name: values[keep] for name, values in signals.items()}
    if not np.isfinite(signals["position"]).all():
        raise FlexarmError("is not finite in some sample", field="joint_position")
    period = float((time[keep][-1] - time[keep][0]) / (kept - 1))
    stretch = {"start": float(time[keep][0]), "stamps": time, "notes": tuple(notes)}
    return Recording(period, **signals, **stretch, **more)


# CSV -------------------------------------------------------------------------------------------


def columns(arm):
    """Names of a CSV file's columns: ``t``, and per joint and gauge ``<joint>_position`` and so on."""
    names = ["t"]
    names += [f"{j}_position" for j in arm.joint_names]
    names += [f"{j}_torque" for j in arm.joint_names]
    return names + [f"{g}_strain" for g in arm.gauge_names]


def read_csv(path, arm=None, mapping=None):
    """Read a CSV file.

    Parameters
    ----------
    path : str or Path
    arm : Arm, optional
        It gives the joints, gauges and modes to read, and their order. If not given, all are read in the file's order.
    mapping : Mapping, optional
        Meaning of the columns, see `recordings.mapping`; if not given, the names in the first line are used.

    Returns
    -------
    Recording

    Raises
    ------
    TableError
        With the file, the line, the column and the value.
    """
    lines, rows = tables.cells(path, "," if mapping is None else mapping.delimiter)
    if not rows:
        problem = "empty"
        raise tables.TableError(
            problem, field=str(path), hint="a row of numbers per sample is wanted"
        )
    header = rows[0] if _has_header(rows[0], mapping) else ()
    if header:
        lines, rows = lines[1:], rows[1:]
    if mapping is None:
        mapping = _named_columns(path, header, arm)
    names = _names(mapping, arm)
    made, time = {}, None
    for column in mapping.columns:
        values = _column(path, lines, rows, header, column, mapping.decimal)
        if column.quantity == "time":
            time = values
            continue
        kind = mappings.QUANTITIES[column.quantity][0]
        shape = len(rows), len(names[kind])
        block = made.setdefault(column.quantity, np.full(shape, np.nan))
        block[:, names[kind].index(column.of)] = values
    position = made.setdefault("position", np.full((len(rows), len(names["joint"])), np.nan))
    for joint, angle in mapping.held.items():
        if joint in names["joint"]:
            position[:, names["joint"].index(joint)] = angle
    made.setdefault("strain", np.full((len(rows), len(names["gauge"])), np.nan))
    if time is None:
        time = np.arange(len(rows)) / mapping.rate
    _check_ascending(path, lines, time)
    known = {f"{kind}_names": tuple(found) for kind, found in names.items()}
    return uniform(time, made, held=tuple(mapping.held), **known)


def _has_header(first, mapping):
    """Whether the first row has names: always without a mapping; else as it states, or if a cell is not a number."""
    if mapping is None:
        return True
    if mapping.header is not None:
        return mapping.header
    return not all(_is_number(word.replace(mapping.decimal, ".")) for word in first)


def _is_number(word):
    try:
        float(word or "nan")
    except ValueError:
        return False
    return True


def _named_columns(path, header, arm):
    """The mapping from the names in the first line; refused if something that the arm needs is missing."""
    made = mappings.by_names(header, arm)
    joints = arm.joint_names if arm is not None else made.names("joint")
    wanted = ["t", *(f"{joint}_position" for joint in joints)]
    missing = [name for name in wanted if name not in header]
    if missing or len(made.columns) < 2:
        wanted = wanted if joints else ["t", "<joint>_position", "<gauge>_strain"]
        raise tables.TableError(
            f"no column {', '.join(missing or wanted[1:2])} (wanted: {', '.join(wanted)})",
            field=str(path), hint="name the columns so, or say with --mapping what they are",
        )  # fmt: skip
    return made


def _names(mapping, arm):
    """Names of what was measured, in the arm's order or, without an arm, the file's; unknown names are refused."""
    names = {kind: mapping.names(kind) for kind in mappings.KINDS}
    if arm is None:
        return names
    known = {kind: mappings.names_in(arm, kind) or () for kind in names}
    known["imu"] = names["imu"]  # no arm file has them
    for kind, found in names.items():
        # A joint that stands still need not be in the arm's model.
        foreign = [n for n in found if n not in known[kind] and n not in mapping.held]
        if foreign:
            problem, limit = f"is no {kind} of {arm.name}", ", ".join(known[kind]) or "it has none"
            hint = "give it the arm file's name in the mapping"
            raise tables.TableError(problem, field=kind, value=foreign[0], limit=limit, hint=hint)
    missing = [n for n in known["joint"] if n not in names["joint"]]
    if missing:
        hint = "give its column in the mapping, or its angle under held if it stands still"
        field = f"position of {missing[0]}"
        raise tables.TableError("is not in the mapping", field=field, hint=hint)
    return known


def _column(path, lines, rows, header, column, decimal):
    """Values of one column in SI, shape (k,)."""
    if isinstance(column.at, int):
        index = column.at - 1
        width = len(rows[0]) if rows else 0
        if rows and index >= width:
            problem, limit = "is no column of the file", f"it has {width}"
            field = f"{path}: column of {column.name}"
            hint = "correct the number, or give the delimiter"
            raise tables.TableError(problem, field=field, value=column.at, limit=limit, hint=hint)
        title = f"column {column.at}, {column.name}"
    else:
        if column.at not in header:
            limit = ", ".join(header) or "it has no names"
            field, hint = f"{path}: column of {column.name}", "correct the name, or give the number"
            problem = "is not in the first line"
            raise tables.TableError(problem, field=field, value=column.at, limit=limit, hint=hint)
        index, title = header.index(column.at), column.at
    blank = column.quantity not in ("time", "position")
    return column.factor * tables.numbers(path, lines, rows, index, title, blank, decimal)


def _check_ascending(path, lines, time):
    back = np.flatnonzero(np.diff(time) <= 0.0)
    if back.size:
        k = int(back[0]) + 1
        raise tables.TableError(
            f"comes after {time[k - 1]:g}; times must ascend", field=f"{path}:{lines[k]}: time [s]",
            value=float(time[k]), hint="leave the row out, or cut the file there",
        )  # fmt: skip


# Topics ----------------------------------------------------------------------------------------


def from_tables(states, torques, arm):
    """A recording from the tables of `arm_state` and, if there is one, of the `joint_torque` that answered it.

    If there are torques, only samples are used whose interval had an enabled torque. Before and after, the safe action
    moves the arm, and no recorded torque shows this. The tables `states` and `torques` are those of a bag's `Contents`:
    arrays ``session``, ``sequence``, ``stamp`` [ns], and ``columns``. Repeated samples are kept once. Only
    ``joint_names``, ``gauge_names`` and ``mode_names`` of the `arm` are used.
    """
    if states is None or not states.stamp.size:
        raise FlexarmError("is not in the recording", field="arm_state")
    sessions, counts = np.unique(states.session, return_counts=True)
    session = sessions[counts.argmax()]
    rows = np.flatnonzero(states.session == session)[::-1]
    sequence, last = np.unique(states.sequence[rows], return_index=True)
    rows = rows[last]
    names = {
        f"{kind}_names": tuple(getattr(arm, f"{kind}_names")) for kind in ("joint", "gauge", "mode")
    }
    n, g = len(names["joint_names"]), len(names["gauge_names"])

    def column(name, width):
        values = states.columns.get(name)
        return np.full((rows.size, width), np.nan) if values is None else values[rows]

    position = column("joint_position", n)
    if not np.isfinite(position).all():
        raise FlexarmError("is empty or not finite in some sample", field="joint_position")
    usable = None
    if torques is not None:
        answered = (torques.session == session) & (torques.columns["mode"] == ENABLED)
        usable = _enabled(np.isin(sequence - 1, torques.sequence[answered]))
    time = 1e-9 * (states.stamp[rows] - states.stamp[rows[0]])
    signals = {
        "position": position,
        "torque": column("joint_torque", n),
        "strain": column("strain", g),
    }
    for field, name in (("joint_velocity", "velocity"), ("modal_amplitude", "amplitude")):
        if field in states.columns:
            signals[name] = states.columns[field][rows]
    return uniform(time, signals, usable, **names)


def _enabled(enabled):
    """Samples whose interval had an enabled torque, without `MARGIN` samples at either end, shape (s,) bool."""
    usable = enabled.copy()
    for k in range(1, MARGIN + 1):
        usable[k:] &= enabled[:-k]
        usable[:-k] &= enabled[k:]
    return usable
