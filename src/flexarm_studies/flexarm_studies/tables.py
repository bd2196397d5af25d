# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers over time: reading torques and motions from CSV, writing results."""

import csv
import io
import math
import sys
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline

from flexarm_dynamics.errors import FlexarmError


class TableError(FlexarmError):
    """A table that can't be used; names the file and where in it."""


def read(path, prefix, names):
    """Rows of a CSV file with the columns ``t``, ``<prefix>1``, ``<prefix>2`` ...

    Parameters
    ----------
    path : str
    prefix : str
        ``tau`` or ``q``.
    names : sequence of str
        The joints, one column each.

    Returns
    -------
    times : ndarray, shape (k,)
        Not descending [s].
    values : ndarray, shape (k, n)

    Raises
    ------
    TableError
        Naming file, line and column, the value, and what is wanted.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = [(reader.line_num, row) for reader in [csv.reader(file)] for row in reader]
    except UnicodeDecodeError:
        raise TableError(f"{path}: not a text file") from None
    rows = [(line, [word.strip() for word in row]) for line, row in rows if any(row)]
    wanted = ["t"] + [f"{prefix}{i + 1}" for i in range(len(names))]
    if not rows:
        raise TableError(f"{path}: empty; its first line must be {','.join(wanted)}")
    line, header = rows[0]
    if sorted(header) != sorted(wanted):
        raise TableError(
            f"{path}:{line}: columns are {','.join(header)}, wanted {','.join(wanted)}: one per joint"
            f" ({', '.join(names)})"
        )
    order = [header.index(name) for name in wanted]
    table = np.empty((len(rows) - 1, len(wanted)))
    for k, (line, row) in enumerate(rows[1:]):
        if len(row) != len(wanted):
            raise TableError(f"{path}:{line}: {len(row)} values for {len(wanted)} columns")
        for column, i in enumerate(order):
            table[k, column] = _number(row[i], f"{path}:{line}: {wanted[column]}")
    if not table.size:
        raise TableError(f"{path}: no rows below the header")
    back = np.flatnonzero(np.diff(table[:, 0]) < 0.0)
    if back.size:
        k = back[0] + 1
        raise TableError(
            f"{path}:{rows[k + 1][0]}: t = {table[k, 0]:g} comes after {table[k - 1, 0]:g}; times must ascend"
        )
    return table[:, 0], table[:, 1:]


def _number(word, where):
    try:
        value = float(word)
    except ValueError:
        raise TableError(f"{where} is {word!r}, not a number") from None
    if not math.isfinite(value):
        raise TableError(f"{where} is {word}, not finite")
    return value


class Steps:
    """Values linear between rows; a repeated time is a step; held before the first row and after the last.

    Parameters
    ----------
    times : ndarray, shape (k,)
    values : ndarray, shape (k, n)
    """

    def __init__(self, times, values):
        self.times, self.values = times, values

    def right_of(self, t):
        """Value just after time t, shape (n,)."""
        return self._at(t, np.searchsorted(self.times, t, "right"))

    def left_of(self, t):
        """Value just before time t, shape (n,)."""
        return self._at(t, np.searchsorted(self.times, t, "left"))

    def _at(self, t, k):
        if k == 0:
            return self.values[0]
        if k == self.times.size:
            return self.values[-1]
        t0, t1 = self.times[k - 1], self.times[k]
        part = (t - t0) / (t1 - t0)
        return (1.0 - part) * self.values[k - 1] + part * self.values[k]


class Motion:
    """Joint motion through the rows of a table: a spline of degree five (three below six rows).

    Parameters
    ----------
    times : ndarray, shape (k,)
        Ascending.
    positions : ndarray, shape (k, n)
    where : str
        File, for messages.
    """

    def __init__(self, times, positions, where):
        twice = np.flatnonzero(np.diff(times) <= 0.0)
        if twice.size:
            raise TableError(
                f"{where}: t = {times[twice[0]]:g} is there twice; joints can't jump: one row per time"
            )
        if times.size < 4:
            raise TableError(f"{where}: {times.size} rows; at least 4 make a smooth motion")
        self.start, self.end = float(times[0]), float(times[-1])
        spline = make_interp_spline(times, positions, k=5 if times.size >= 6 else 3)
        self._derivatives = [spline, spline.derivative(), spline.derivative(2)]

    def __call__(self, t):
        """Position, velocity and acceleration at time t, each (n,)."""
        return [d(t) for d in self._derivatives]


def write(columns, rows, path=None):
    """Write rows as CSV to a file, its directory made, or to standard output."""
    out = io.StringIO()
    out.write(",".join(columns) + "\n")
    np.savetxt(out, rows, fmt="%.12g", delimiter=",")
    if path is None:
        sys.stdout.write(out.getvalue())
        return
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(out.getvalue(), encoding="utf-8")
