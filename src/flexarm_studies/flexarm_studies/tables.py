# SPDX-License-Identifier: Apache-2.0
"""Handles tables of numbers over time: reads torques and motions from CSV, writes results."""

import csv
import io
import sys
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline

from flexarm_dynamics.errors import FlexarmError


class TableError(FlexarmError):
    """A table that can't be used; names the file and the place in it."""


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
    table = _numbers(path, lines, header, rows, wanted)
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


def has_columns(path, *names):
    """Whether a path is that of a CSV file whose first line has columns with these names."""
    if not Path(path).is_file():
        return False
    try:
        with open(path, encoding="utf-8-sig") as file:
            header = next(csv.reader([file.readline()]), [])
    except (UnicodeDecodeError, csv.Error):
        return False
    return set(names) <= {word.strip() for word in header}


def cells(path, delimiter=","):
    """Line numbers and words of the rows of a text file, without empty lines and lines that begin with ``#``.

    Parameters
    ----------
    path : str or Path
    delimiter : str, optional
        Separator between words; several blanks count as one. None: the first of ``; tab , blank`` that is found in the
        first line.

    Returns
    -------
    lines : list of int
    rows : list of list of str

    Raises
    ------
    TableError
        For a file that is not text.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            text = ["" if line.lstrip()[:1] == "#" else line for line in file]
        first = next((line for line in text if line.strip()), "")
        if delimiter is None:
            delimiter = next((d for d in ";\t, " if d in first.strip()), ",")
        reader = csv.reader(text, delimiter=delimiter, skipinitialspace=delimiter == " ")
        rows = [(reader.line_num, [word.strip() for word in row]) for row in reader]
    except UnicodeDecodeError:
        raise TableError("not a text file", field=str(path)) from None
    except (OSError, csv.Error) as error:
        raise TableError(f"can't be read as a table: {error}", field=str(path)) from None
    rows = [(line, row) for line, row in rows if any(row)]
    return [line for line, _ in rows], [row for _, row in rows]


def _rows(path, wanted):
    """Line numbers, header and rows of a CSV file, without empty lines."""
    lines, rows = cells(path)
    if not rows:
        raise TableError(f"empty; its first line must be {','.join(wanted)}", field=str(path))
    return lines, rows[0], rows[1:]


def _numbers(path, lines, header, rows, wanted):
    """The wanted columns, shape (k, len(wanted)), finite."""
    found = [numbers(path, lines[1:], rows, header.index(n), n, blank=False) for n in wanted]
    return np.column_stack(found)


def numbers(path, lines, rows, at, name, blank=True, decimal="."):
    """Column `at` of `rows`, shape (k,); for messages, `lines` are their line numbers and `name` is that of the column.

    With `blank` an empty cell and ``nan`` are NaN; otherwise they are refused, like any other number that is not
    finite. The `decimal` sign may be a comma.
    """
    try:
        values = np.array([float(row[at].replace(decimal, ".") or "nan") for row in rows])
    except (IndexError, ValueError):
        numbered = zip(lines, rows, strict=True)
        values = np.array([_number(path, *row, at, name, decimal) for row in numbered], float)
    wrong = np.flatnonzero(np.isinf(values) if blank else ~np.isfinite(values))
    if wrong.size:
        k, hint = int(wrong[0]), "correct it, or leave the row out"
        field = f"{path}:{lines[k]}: {name}"
        raise TableError("is not finite", field=field, value=float(values[k]), hint=hint)
    return values


def _number(path, line, row, at, name, decimal):
    where = f"{path}:{line}: {name}"
    if at >= len(row):
        hint = f"the row has {len(row)} cells: complete it or leave it out"
        raise TableError("is missing", field=where, hint=hint)
    try:
        return float(row[at].replace(decimal, ".") or "nan")
    except ValueError:
        hint = "correct it, or leave the cell empty"
        raise TableError("is not a number", field=where, value=row[at], hint=hint) from None


class Steps:
    """`values` (k, n) linear between `times` (k,); a repeated time is a step; the first and the last are held."""

    def __init__(self, times, values):
        self.times, self.values = times, values

    @property
    def largest(self):
        """Largest size of each value, shape (n,)."""
        return np.abs(self.values).max(axis=0)

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
    """Joint motion through the `positions` (k, n) at `times` (k,): a spline of degree five; three below six rows.

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
    """Write rows as CSV with twelve significant digits, to a file, whose directory is made, or to standard output."""
    out = io.StringIO()
    np.savetxt(out, rows, fmt="%.12g", delimiter=",", header=",".join(columns), comments="")
    if path is None:
        sys.stdout.write(out.getvalue())
        return
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(out.getvalue(), encoding="utf-8")
