# SPDX-License-Identifier: Apache-2.0
"""Finds the modes that rang in an arm after a `RingingMotion`."""

import numpy as np

from ..identification.recording import SIGNALS, kind_of
from ..tables import write
from . import windows
from .fit import fit
from .windows import Window

#: Max. time from sending a motion to its begin [s].
LATEST = 0.5
#: Delays with which a channel may contain the swept position directly, because of the position loops [s].
LAGS = (0.0, 0.025, 0.05, 0.1, 0.15)


def rings(recording, motion, begin, wishes):
    """The windows that ring in a measurement.

    Parameters
    ----------
    recording : Recording
        With the joint positions.
    motion : RingingMotion
    begin : float
        Time when the motion was sent, as the recording counts it [s].
    wishes : Wishes

    Returns
    -------
    channels : Channels
    list of Window

    Raises
    ------
    FlexarmError
        For a recording without channels that may ring, or that ends too early.
    """
    found = windows.channels(recording, wishes.quantities or None)
    late = delay(found, motion, begin)
    parts = [found.rows(begin + late + a, begin + late + b) for a, b, _ in motion.free]
    made = windows.modes_of(found, parts, wishes.low, wishes.high)
    for a, b, joint in motion.swept:
        part = found.rows(begin + late + a, begin + late + b)
        time = found.seconds(np.arange(part.start, part.stop)) - begin - late
        way = lambda order, late: motion.derivative(order, time - late)[:, joint, None]  # noqa: B023, E731
        direct = [way(1, 0.0), *(way(0, late) for late in LAGS)]
        fitted = fit(
            found.values[part], found.period, wishes.low, wishes.high, way(2, 0.0), np.hstack(direct)
        )  # fmt: skip
        if fitted.modes:
            at = found.position[part].mean(axis=0)
            made.append(Window(found.seconds(part.start), found.seconds(part.stop - 1), at, fitted))
    return found, made


def delay(found, motion, begin):
    """Time from sending a motion until the joints follow it [s], from the largest correlation of positions.

    Parameters
    ----------
    found : Channels
    motion : RingingMotion
    begin : float
        [s]
    """
    time = found.seconds(np.arange(len(found.values))) - begin
    inside = (time >= -0.1) & (time <= motion.times[-1] + LATEST)
    measured = found.position[inside] - found.position[inside].mean(axis=0)
    best, late = -np.inf, 0.0
    for shift in np.arange(0.0, LATEST, found.period):
        wanted = motion.derivative(0, time[inside] - shift)
        alike = float((measured * (wanted - wanted.mean(axis=0))).sum())
        if alike > best:
            best, late = alike, float(shift)
    return late


def save(recording, path):
    """Write a recording as a CSV file whose first line has names, to be read again without a mapping.

    Parameters
    ----------
    recording : Recording
    path : str or Path
    """
    names, columns = ["t"], [recording.start + recording.time]
    for quantity in SIGNALS:
        values = getattr(recording, quantity)
        if values is None or not np.isfinite(values).any():
            continue
        for name, column in zip(
            getattr(recording, f"{kind_of(quantity)}_names"), values.T, strict=True
        ):
            names.append(f"{name}_{quantity}")
            columns.append(column)
    write(names, np.column_stack(columns), path)
