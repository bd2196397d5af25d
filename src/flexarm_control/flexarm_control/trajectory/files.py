# SPDX-License-Identifier: Apache-2.0
"""Trajectories in files: the text of a `trajectory_msgs/JointTrajectory`, or a CSV table.

YAML (``.yaml``, ``.yml``), as `ros2 topic pub` takes it and `ros2 topic echo --once` prints it::

    joint_names: [joint1]
    points:
    - {positions: [0.0], velocities: [0.0], time_from_start: {sec: 0, nanosec: 0}}
    - {positions: [1.0], velocities: [0.0], time_from_start: {sec: 2, nanosec: 0}}

CSV (``.csv``): a header, then one row per point, the joints numbered in the arm's order::

    t,q1,qd1,qdd1
    0.0,0.0,0.0,0.0
    2.0,1.0,0.0,0.0

Time in s from the start, angles in rad; rates (``qd``) and accelerations (``qdd``) may be left out, and
choose the interpolation as in a message. Every file that is read is checked by `validate`.
"""

import csv
import math
import re
from itertools import chain
from pathlib import Path

import numpy as np
import yaml

from flexarm_dynamics.errors import TrajectoryError
from flexarm_dynamics.shown import listed

from .request import JointTrajectoryData, validate
from .values import NOT_NUMBERS, SECOND

YAML_SUFFIXES = (".yaml", ".yml")
SUFFIXES = (".csv", *YAML_SUFFIXES)
#: CSV prefix of each field of a point.
_PREFIXES = {"positions": "q", "velocities": "qd", "accelerations": "qdd"}
_POINT_KEYS = (*_PREFIXES, "effort", "time_from_start")
# The C loader is some ten times faster, but not available everywhere.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def read(
    path, joint_names, position_low=None, position_high=None, velocity_max=None
) -> JointTrajectoryData:
    """Read a trajectory from a file, with stamp 0, so that it starts when it is offered.

    Parameters
    ----------
    path : str or path
        Ends in .csv, .yaml or .yml.
    joint_names : sequence of str
        The arm's n joints; a CSV file's columns are numbered in this order.
    position_low, position_high, velocity_max : (n,) array_like, optional
        Limits, as for `validate` [rad], [rad], [rad/s].

    Raises
    ------
    TrajectoryError
        It names the file, the line and column (CSV) or the point and field (YAML), and the value.
    """
    path, joint_names = Path(path), tuple(joint_names)
    reader = _reader(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise TrajectoryError(str(error.strerror or error), field=str(path)) from None
    except UnicodeDecodeError:
        raise TrajectoryError("is no text file", field="path", value=str(path)) from None
    except ValueError as error:  # a path with a zero byte
        raise TrajectoryError(f"can't be read: {error}", field="path", value=str(path)) from None
    try:
        names, points, lines = reader(text, joint_names)
    except TrajectoryError as error:
        error.field = f"{path}{error.field}"
        raise
    try:
        return validate(names, joint_names, 0, points, position_low, position_high, velocity_max)
    except TrajectoryError as error:
        error.field = f"{path}: {_with_lines(error.field, lines)}"
        error.problem = _with_lines(error.problem, lines)
        raise


def write(path, trajectory):
    """Write a trajectory to a file; `read` gives its joints, times and fields back bit by bit.

    Stamp and effort, and the `coast` and `first` of a stream, are not written.

    Parameters
    ----------
    path : str or path
        Ends in .csv, .yaml or .yml; overwritten.
    trajectory : JointTrajectoryData

    Raises
    ------
    TrajectoryError
        If the path ends in something else.
    OSError
        If it can't be written.
    """
    path = Path(path)
    text = _csv_text if _reader(path) is _from_csv else _yaml_text
    path.write_text(text(trajectory), encoding="utf-8")


def _reader(path):
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        problem, limit = "has the wrong suffix", ", ".join(SUFFIXES)
        raise TrajectoryError(problem, field="path", value=str(path), limit=limit)
    return _from_csv if suffix == ".csv" else _from_yaml


def _with_lines(text, lines):
    """Name the file's lines in place of points, if it has lines."""
    if not lines:
        return text
    return re.sub(r"points\[(\d+)\]", lambda match: f"line {lines[int(match[1])]}", text)


# CSV -------------------------------------------------------------------------------------------
# The fields of errors begin with what follows the file's name: ":3: q2", or ": points[0]".


def _from_csv(text, joint_names):
    reader = csv.reader(text.splitlines())
    try:
        rows = [(reader.line_num, [word.strip() for word in row]) for row in reader]
    except csv.Error as error:
        raise TrajectoryError(f"no CSV table: {error}", field=f":{reader.line_num}") from None
    rows = [(line, row) for line, row in rows if any(row)]
    hint = f"give a header {_wanted(joint_names)}, then points"
    if not rows:
        raise TrajectoryError("empty", field=":1", hint=hint)
    line, header = rows[0]
    columns = _csv_columns(header, joint_names, line)
    points = []
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise TrajectoryError(
                "is the wrong number of values",
                field=f":{line}",
                value=len(row),
                limit=f"{len(header)} columns",
            )
        values = [_csv_number(w, h, line) for w, h in zip(row, header, strict=True)]
        fields = [[values[i] for i in columns[field]] for field in _PREFIXES]
        points.append((_csv_time(values[columns["t"]], line), *fields, []))
    if not points:
        raise TrajectoryError("no points", field=f":{line}", hint=hint)
    return joint_names, points, [line for line, _ in rows[1:]]


def _wanted(joint_names):
    n = len(joint_names)
    parts = [f"{prefix}1..{prefix}{n}" if n > 1 else f"{prefix}1" for prefix in _PREFIXES.values()]
    return f"t,{parts[0]}[,{parts[1]}[,{parts[2]}]]"


def _csv_columns(header, joint_names, line):
    """Indices of the columns of t and of each field; missing fields have none."""
    count = range(1, len(joint_names) + 1)
    fields = {field: [f"{prefix}{i}" for i in count] for field, prefix in _PREFIXES.items()}
    known = {"t"}.union(*fields.values())
    where, hint = f":{line}", f"give {_wanted(joint_names)} for {listed(joint_names)}"
    for word in header:
        if word not in known:
            raise TrajectoryError("is no known column", field=where, value=word, hint=hint)
        if header.count(word) > 1:
            problem = f"is the name of {header.count(word)} columns"
            raise TrajectoryError(problem, field=where, value=word)
    for field in ("velocities", "accelerations"):
        if not set(header).intersection(fields[field]):
            fields[field] = []
    for name in (*chain(*fields.values()), "t"):
        if name not in header:
            raise TrajectoryError("is no column here", field=where, value=name, hint=hint)
    columns = {field: [header.index(name) for name in names] for field, names in fields.items()}
    return columns | {"t": header.index("t")}


def _csv_number(word, column, line):
    field = f":{line}: {column}"
    try:
        value = float(word)
    except ValueError:
        raise TrajectoryError("is not a number", field=field, value=word) from None
    if not math.isfinite(value):
        raise TrajectoryError("is not finite", field=field, value=word)
    return value


def _csv_time(value, line):
    field, hint = f":{line}: t", "use shorter times"
    if abs(value) > 9e9:
        raise TrajectoryError("s is beyond 2^63 ns", field=field, value=value, hint=hint)
    return round(value * SECOND)


def _csv_text(trajectory):
    n, fields = len(trajectory.joint_names), trajectory.fields
    prefixes = tuple(_PREFIXES.values())[: len(fields)]
    rows = [["t", *(f"{prefix}{i + 1}" for prefix in prefixes for i in range(n))]]
    for time, values in zip(trajectory.times_ns.tolist(), np.hstack(fields).tolist(), strict=True):
        rows.append([_decimal(time), *map(repr, values)])
    return "".join(",".join(row) + "\n" for row in rows)


def _decimal(time_ns):
    whole, part = divmod(time_ns, SECOND)
    return f"{whole}.{part:09d}".rstrip("0") + ("0" if not part else "")


# YAML ------------------------------------------------------------------------------------------


def _from_yaml(text, joint_names):
    try:
        # `ros2 topic echo` ends each message with a line of dashes.
        documents = [d for d in yaml.load_all(text, _LOADER) if d is not None]
    except Exception as error:
        # Not only YAML's own errors: PyYAML raises others for a scalar that does not fit its tag, and for endless
        # nesting.
        mark = getattr(error, "problem_mark", None)
        raise TrajectoryError(
            f"no YAML: {getattr(error, 'problem', None) or error}",
            field=f":{mark.line + 1}" if mark else "",
        ) from None
    if len(documents) != 1:
        raise TrajectoryError("trajectories", field="", value=len(documents), hint="give one")
    top = _mapping(documents[0], "", ("header", "joint_names", "points"))
    for key in ("joint_names", "points"):
        if not isinstance(top.get(key), list):
            raise TrajectoryError("is no list", field=f": {key}", value=top.get(key))
    points = [_yaml_point(point, f": points[{i}]") for i, point in enumerate(top["points"])]
    return top["joint_names"], points, None


def _mapping(value, field, keys):
    """Return a mapping with known keys, or refuse the value."""
    known = ", ".join(keys)
    if not isinstance(value, dict):
        raise TrajectoryError("is no mapping", field=field, value=value, hint=f"give {known}")
    for key in value:
        if key not in keys:
            raise TrajectoryError("is no known key", field=field, value=key, limit=known)
    return value


def _yaml_point(point, field):
    _mapping(point, field, _POINT_KEYS)
    values = [_yaml_values(point.get(f), f"{field}.{f}") for f in (*_PREFIXES, "effort")]
    time = point.get("time_from_start", {})
    time = _mapping(time, f"{field}.time_from_start", ("sec", "nanosec"))
    for key, value in time.items():
        if isinstance(value, bool) or not isinstance(value, int):
            where = f"{field}.time_from_start.{key}"
            raise TrajectoryError("is no integer", field=where, value=value)
    return time.get("sec", 0) * SECOND + time.get("nanosec", 0), *values


def _yaml_values(values, field):
    if values is None:
        return []
    if not isinstance(values, list):
        hint = "give one number per joint"
        raise TrajectoryError("is no list", field=field, value=values, hint=hint)
    out = []
    for i, value in enumerate(values):
        try:
            if isinstance(value, bool):
                raise TypeError
            # YAML 1.1 reads 1e-3 (no dot) as text, but the number is meant.
            out.append(float(value))
        except NOT_NUMBERS:
            raise TrajectoryError("is not a number", field=f"{field}[{i}]", value=value) from None
    return out


def _yaml_text(trajectory):
    points = []
    for time, *values in zip(trajectory.times_ns.tolist(), *trajectory.fields, strict=True):
        sec, nanosec = divmod(time, SECOND)
        point = {name: row.tolist() for name, row in zip(_PREFIXES, values, strict=False)}
        points.append(point | {"time_from_start": {"sec": sec, "nanosec": nanosec}})
    message = {"joint_names": list(trajectory.joint_names), "points": points}
    return yaml.dump(message, Dumper=_DUMPER, sort_keys=False, default_flow_style=None, width=1000)
