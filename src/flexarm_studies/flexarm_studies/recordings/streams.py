# SPDX-License-Identifier: Apache-2.0
"""Joins signals with separate clocks, such as joint states and an IMU, to one `Recording` on the fastest one's grid.

Between samples, a cubic through the four samples around is used. A gap in any signal is a gap of the recording.
"""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from flexarm_dynamics.errors import FlexarmError

from ..identification.recording import JITTER, MIN_SAMPLES, OF_JOINTS, kind_of, uniform

#: More samples than this can't be a measurement.
MAX_SAMPLES = 10_000_000


@dataclass(frozen=True, eq=False)
class Stream:
    """Signals that are sampled together.

    Attributes
    ----------
    name : str
        Its name in messages, for example its topic.
    time : ndarray, shape (k,)
        Stamps [s].
    signals : dict
        Name of a signal, one of `SIGNALS`, to its array (k, w).
    names : dict
        ``joint``, ``imu``, ``gauge``, to the w names of the columns.
    """

    name: str
    time: np.ndarray
    signals: dict
    names: dict


def join(streams):
    """Join some streams to one `Recording`.

    Parameters
    ----------
    streams : sequence of Stream

    Raises
    ------
    FlexarmError
        For a stream that is too short, whose values are not finite or change by more than can be computed with, or
        that has no time in common with the others.
    """
    cleaned = [_ascending(stream) for stream in streams]
    if not cleaned:
        raise FlexarmError("has no samples", field="recording")
    begin = max(s.time[0] for s in cleaned)
    end = min(s.time[-1] for s in cleaned)
    periods = [float(np.median(np.diff(s.time))) for s in cleaned]
    fastest = int(np.argmin(periods))
    period, notes = periods[fastest], []
    count = (end - begin) / period
    if not MIN_SAMPLES <= count <= MAX_SAMPLES:
        where = ", ".join(f"{s.name}: {s.time[0]:.6g} to {s.time[-1]:.6g} s" for s in cleaned)
        limit = f"{MIN_SAMPLES} to {MAX_SAMPLES} samples in common"
        raise FlexarmError(f"have no usable time in common ({where})", field="streams", limit=limit)
    grid = begin + period * np.arange(int(count) + 1)
    grid = grid[grid <= end]
    keep = np.ones(grid.size, bool)
    made, names = {}, {}
    for stream, own in zip(cleaned, periods, strict=True):
        keep &= _covered(stream.time, own, grid)
        for quantity, values in stream.signals.items():
            made.setdefault(quantity, []).append(_at(grid, stream, quantity, values))
        for kind, of in stream.names.items():
            names.setdefault(kind, []).extend(of)
    if len(cleaned) > 1:
        notes.append(f"{len(cleaned)} streams on the grid of {cleaned[fastest].name}")
    signals = {q: np.hstack(columns)[keep] for q, columns in made.items()}
    signals.setdefault("position", np.zeros((int(keep.sum()), 0)))
    signals.setdefault("strain", np.zeros((int(keep.sum()), 0)))
    found = uniform(grid[keep], signals, **{f"{k}_names": tuple(v) for k, v in names.items()})
    return replace(found, notes=(*notes, *found.notes))


def _at(grid, stream, quantity, values):
    """The `values` of a stream's quantity, interpolated at the times of a grid."""
    found = np.full(1, np.nan)
    with np.errstate(all="ignore"), suppress(ValueError):  # raised if a slope is not finite
        found = Akima1DInterpolator(stream.time, values, axis=0)(grid)
    if not np.isfinite(found).all():
        field = f"{stream.name}: {quantity}"
        hint = "remove the samples that no sensor can have measured"
        raise FlexarmError("changes by too much between samples", field=field, hint=hint)
    return found


def _ascending(stream):
    """A stream without samples that repeat or go back, and without quantities that are not all finite."""
    time = np.asarray(stream.time, float)
    usable = np.isfinite(time)
    newest = np.maximum.accumulate(np.where(usable, time, -np.inf))
    usable &= np.concatenate([[True], time[1:] > newest[:-1]]) if time.size else usable
    if usable.sum() < MIN_SAMPLES:
        limit = f"at least {MIN_SAMPLES}, with ascending stamps"
        raise FlexarmError(
            "samples can be used", field=stream.name, value=int(usable.sum()), limit=limit
        )
    signals = {q: np.asarray(v, float)[usable] for q, v in stream.signals.items()}
    for quantity, values in signals.items():
        if quantity == "position" and not np.isfinite(values).all():
            joint = int(np.argmin(np.isfinite(values).all(axis=0)))
            field = f"{stream.name}: position of {stream.names[kind_of(quantity)][joint]}"
            raise FlexarmError("is not finite in some sample", field=field)
    known = {q: v for q, v in signals.items() if v.shape[1] and np.isfinite(v).all()}
    if not known:
        raise FlexarmError("has no quantity with all its values", field=stream.name)
    return Stream(stream.name, time[usable], known, stream.names)


def _covered(time, period, grid):
    """Which times of the grid are not in a gap, shape (k,) bool."""
    after = np.clip(np.searchsorted(time, grid), 1, time.size - 1)
    return time[after] - time[after - 1] <= 2.0 * (1.0 + JITTER) * period


def of_joints(name, time, joint_names, **signals):
    """A `Stream` of joints.

    Parameters
    ----------
    name : str
    time : ndarray, shape (k,)
        [s]
    joint_names : sequence of str
    signals
        Of ``position``, ``velocity``, ``torque``, ``current``: (k, n).

    Raises
    ------
    FlexarmError
        For a quantity that joints do not have.
    """
    for quantity in signals:
        if quantity not in OF_JOINTS:
            limit = ", ".join(OF_JOINTS)
            raise FlexarmError("is none of joints", field="quantity", value=quantity, limit=limit)
    return Stream(name, time, signals, {"joint": tuple(joint_names)})


def of_imu(name, time, acceleration, velocity):
    """A `Stream` of an IMU, its axes named after it.

    Parameters
    ----------
    name : str
    time : ndarray, shape (k,)
        [s]
    acceleration, velocity : ndarray, shape (k, 3)
        Linear [m/s^2], angular [rad/s].
    """
    axes = tuple(f"{name.strip('/').replace('/', '_')}_{axis}" for axis in "xyz")
    return Stream(
        name,
        time,
        {"linear_acceleration": acceleration, "angular_velocity": velocity},
        {"imu": axes},
    )
