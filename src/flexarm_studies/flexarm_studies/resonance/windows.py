# SPDX-License-Identifier: Apache-2.0
"""Finds the windows in which a recording rings freely, and the modes that ring in them."""

from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from ..identification.recording import SIGNALS, kind_of
from ..recordings import rest
from .fit import HIGHEST, Fit, fit

#: Quantities that ring while the joints rest, and their substitutes; the first available substitute is used.
RINGING = ("strain", "amplitude", "linear_acceleration", "angular_velocity")
INSTEAD = ("velocity", "position", "torque", "current")
#: The joints move if one goes farther than this [rad or m].
MOVES = 5e-3
#: A fit is used if it explains this fraction of some channel's variance.
EXPLAINED = 0.8
#: For the envelope, which is used if the recorded joints do not move or never rest: the length of its blocks [s]; its
#: minimum at the begin and at the end of a window, over the quietest fiftieth [-]; and the increase that counts as a
#: blow and ends a window [-].
BLOCK, BEGIN, END, RISE = 0.25, 2.0, 1.3, 1.6
#: A shorter window does not count [s].
SHORTEST = 0.3


@dataclass(frozen=True, eq=False)
class Channels:
    """The channels of a recording that may ring.

    Attributes
    ----------
    names, quantities : tuple of str
        Of each of the c channels.
    values : ndarray, shape (s, c)
        Values in SI; every channel has a value at each sample.
    start, period : float
        [s]
    position : ndarray, shape (s, n)
        Of the joints [rad].
    joint_names : tuple of str
        Names of the n joints.
    """

    names: tuple
    quantities: tuple
    values: np.ndarray
    start: float
    period: float
    position: np.ndarray
    joint_names: tuple

    def seconds(self, row):
        """Time of a row, as the recording counts it [s]."""
        return self.start + self.period * row

    def rows(self, begin, end):
        """The rows from `begin` to `end` [s], a slice.

        Raises
        ------
        FlexarmError
            If there are none.
        """
        first, last = (int(np.ceil((t - self.start) / self.period - 0.5)) for t in (begin, end))
        part = slice(max(first, 0), min(max(last, 0), len(self.values)))
        if part.stop - part.start < 2:
            limit = f"within {self.start:g} to {self.seconds(len(self.values)):g} s"
            raise FlexarmError("has no samples", field=f"window {begin:g}:{end:g}", limit=limit)
        return part


@dataclass(frozen=True, eq=False)
class Window:
    """A stretch of a recording that rings.

    Attributes
    ----------
    begin, end : float
        [s]
    configuration : ndarray, shape (n,)
        Mean joint positions [rad].
    fit : Fit
    """

    begin: float
    end: float
    configuration: np.ndarray
    fit: Fit


def channels(recording, quantities=None) -> Channels:
    """The channels of a recording that may ring.

    Parameters
    ----------
    recording : Recording
    quantities : sequence of str, optional
        Names of `SIGNALS`; if not given, all available ones of `RINGING`, or else the first available one of `INSTEAD`.

    Raises
    ------
    FlexarmError
        If no channel of these quantities has all its values.
    """
    found = {q: list(_of(recording, q)) for q in quantities or SIGNALS}
    if quantities is None:
        ringing = [q for q in RINGING if found[q]]
        quantities = ringing or [q for q in INSTEAD if found[q]][:1]
    chosen = [(name, q, column) for q in quantities for name, column in found[q]]
    if not chosen:
        hint = "strain, IMU, speeds or currents are wanted, without a missing value"
        raise FlexarmError("no channel that may ring", field="recording", hint=hint)
    names, of, columns = zip(*chosen, strict=True)
    return Channels(
        names, of, np.column_stack(columns), recording.start, recording.period,
        recording.position, recording.joint_names,
    )  # fmt: skip


def _of(recording, quantity):
    """Name and values of each channel of a quantity that varies and has no missing values."""
    values = getattr(recording, quantity)
    if values is None:
        return
    for name, column in zip(
        getattr(recording, f"{kind_of(quantity)}_names"), values.T, strict=True
    ):
        if name not in recording.held and np.isfinite(column).all() and np.ptp(column) > 0.0:
            yield name, column


def free(found, recording):
    """Stretches in which nothing moves the arm: its joints rest, or the envelope of the channels falls.

    Parameters
    ----------
    found : Channels
    recording : Recording

    Returns
    -------
    list of slice
    """
    position = recording.position
    if position.shape[1] and np.ptp(position, axis=0).max(initial=0.0) > MOVES:
        parts = rest.stretches(recording)
        if parts:
            return parts
    return falling(found.values, found.period)


def falling(values, period):
    """Stretches of `values` (s, c), a row per `period` [s], whose envelope falls and is above the quietest blocks."""
    block = max(round(BLOCK / period), 2)
    count = len(values) // block
    if count < 4:
        return []
    blocks = values[: count * block].reshape(count, block, -1)
    time = np.linspace(-1.0, 1.0, block)[:, None]
    moved = blocks - blocks.mean(axis=1, keepdims=True)
    slope = (moved * time).sum(axis=1) / (time**2).sum()
    level = (moved - slope[:, None] * time).std(axis=1)
    quiet = np.maximum(np.quantile(level, 0.02, axis=0), 1e-9 * level.max(axis=0) + 1e-300)
    over = (level / quiet).max(axis=1)
    parts, begin = [], None
    least = np.inf
    for k, now in enumerate(over):
        if begin is not None and (now > RISE * least or now < END):
            parts.append((begin, k))
            begin = None
        if begin is None and now > BEGIN and (k + 1 == count or over[k + 1] <= now):
            begin, least = k, np.inf
        least = min(least, now)
    if begin is not None:
        parts.append((begin, count))
    # The block with the blow does not belong to the free ringing.
    return [
        slice((a + 1) * block, b * block)
        for a, b in parts
        if (b - a - 1) * block * period > SHORTEST
    ]


def modes_of(found, parts, low=0.0, high=HIGHEST):
    """The windows that ring.

    Parameters
    ----------
    found : Channels
    parts : sequence of slice
    low, high : float
        Frequencies [Hz].

    Returns
    -------
    list of Window
    """
    windows = []
    for part in parts:
        made = fit(found.values[part], found.period, low, high)
        if made.modes and made.explained.max() > EXPLAINED:
            begin, end = found.seconds(part.start), found.seconds(part.stop - 1)
            windows.append(Window(begin, end, found.position[part].mean(axis=0), made))
    return windows
