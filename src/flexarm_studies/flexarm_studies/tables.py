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
    """Times (k,), not descending [s], and values (k, n) of a CSV file with the columns ``t``, ``<prefix>1`` ...

    The `prefix` is ``tau`` or ``q``; the `names` are those of the joints, one column each.
    """
    wanted = ["t"] + [f"{prefix}{i + 1}" for i in range(len(names))]
    lines, header, rows = _rows(path, wanted)
    if sorted(header) != sorted(wanted):
        raise TableError(
            f"columns are {','.join(header)}, wanted {','.join(wanted)}: one per joint ({', '.join(names)})",
            field=f"{path}:{lines[0]}",
        )
    for line, row in zip(lines[1:], rows, strict=True):
        if len(row) != len(wanted):
            raise TableError(f"{len(row)} values for {len(wanted)} columns", field=f"{path}:{line}")
    table = _numbers(path, lines, header, rows, wanted, finite=True)
    if not table.size:
        raise TableError("no rows below the header", field=str(path))
    back = np.flatnonzero(np.diff(table[:, 0]) < 0.0)
    if back.size:
        k = back[0] + 1
        raise TableError(
            f"t = {table[k, 0]:g} comes after {table[k - 1, 0]:g}; times must ascend",
            field=f"{path}:{lines[k + 1]}",
        )
    return table[:, 0], table[:, 1:]


def read_columns(path, wanted, optional=()):
    """The `wanted` columns of a CSV file in any order, shape (k, len(wanted)); others in the file are ignored.

    Those of them that are `optional` may be missing: NaN. A file that is no table, a missing column, and text that is
    no number, with its line and column, are refused.
    """
    lines, header, rows = _rows(path, wanted)
    missing = [n for n in wanted if n not in header and n not in optional]
    if missing:
        raise TableError(
            f"no column {', '.join(missing)} (wanted: {', '.join(wanted)})", field=str(path)
        )
    return _numbers(path, lines, header, rows, wanted)


def _rows(path, wanted):
    """Line numbers, header and rows of a CSV file, without empty lines."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = [(reader.line_num, row) for reader in [csv.reader(file)] for row in reader]
    except UnicodeDecodeError:
        raise TableError("not a text file", field=str(path)) from None
    except (OSError, csv.Error) as error:
        raise TableError(f"can't be read as a table: {error}", field=str(path)) from None
    rows = [(line, [word.strip() for word in row]) for line, row in rows if any(row)]
    if not rows:
        raise TableError(f"empty; its first line must be {','.join(wanted)}", field=str(path))
    return [line for line, _ in rows], rows[0][1], [row for _, row in rows[1:]]


def _numbers(path, lines, header, rows, wanted, finite=False):
    """The wanted columns, shape (k, len(wanted)); NaN for one that is not there."""
    table = np.full((len(rows), len(wanted)), np.nan)
    for j, name in enumerate(wanted):
        if name not in header:
            continue
        at = header.index(name)
        for i, row in enumerate(rows):
            where = f"{path}:{lines[i + 1]}: {name}"
            try:
                table[i, j] = float(row[at])
            except IndexError:
                raise TableError("is missing", field=where) from None
            except ValueError:
                raise TableError("is not a number", field=where, value=row[at]) from None
            if finite and not math.isfinite(table[i, j]):
                raise TableError("is not finite", field=where, value=float(row[at]))
    return table


class Steps:
    """`values` (k, n) linear between `times` (k,); a repeated time is a step; the first and the last are held."""

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
    """Joint motion through the `positions` (k, n) at `times` (k,): a spline of degree five, or three below six rows.

    `where` is the file, for messages.
    """

    def __init__(self, times, positions, where):
        twice = np.flatnonzero(np.diff(times) <= 0.0)
        if twice.size:
            problem = f"t = {times[twice[0]]:g} is there twice; joints can't jump: one row per time"
            raise TableError(problem, field=where)
        if times.size < 4:
            raise TableError(f"{times.size} rows; at least 4 make a smooth motion", field=where)
        self.start, self.end = float(times[0]), float(times[-1])
        spline = make_interp_spline(times, positions, k=5 if times.size >= 6 else 3)
        self._derivatives = [spline, spline.derivative(), spline.derivative(2)]

    def __call__(self, t):
        """Position, velocity and acceleration at time t, each (n,)."""
        return [d(t) for d in self._derivatives]


def write(columns, rows, path=None):
    """Write rows as CSV, with twelve significant digits, to a file, its directory made, or to standard output."""
    out = io.StringIO()
    np.savetxt(out, rows, fmt="%.12g", delimiter=",", header=",".join(columns), comments="")
    if path is None:
        sys.stdout.write(out.getvalue())
        return
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(out.getvalue(), encoding="utf-8")
