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
choose the interpolation as in a message. What is read is what `validate` passes, nothing else.
"""

import csv
import math
import re
from pathlib import Path

import yaml

from flexarm_dynamics.errors import TrajectoryError

from .request import JointTrajectoryData, validate
from .values import NOT_NUMBERS, SECOND, show

YAML_SUFFIXES = (".yaml", ".yml")
SUFFIXES = (".csv", *YAML_SUFFIXES)
#: CSV prefix of each field of a point.
_PREFIXES = {"positions": "q", "velocities": "qd", "accelerations": "qdd"}
_POINT_KEYS = (*_PREFIXES, "effort", "time_from_start")
# The C loader is some ten times faster, and not everywhere there.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def read(
    path, joint_names, position_low=None, position_high=None, velocity_max=None
) -> JointTrajectoryData:
    """Read a trajectory from a file.

    Parameters
    ----------
    path : str or path
        Ends in .csv, .yaml or .yml.
    joint_names : sequence of str
        The arm's n joints; a CSV file's columns are numbered in this order.
    position_low, position_high, velocity_max : (n,) array_like, optional
        Limits, as for `validate` [rad], [rad], [rad/s].

    Returns
    -------
    JointTrajectoryData
        With stamp 0: it starts when it is offered.

    Raises
    ------
    TrajectoryError
        Naming the file, the line and column (CSV) or the point and field (YAML), the value, and what
        is wanted.
    """
    path, joint_names = Path(path), tuple(joint_names)
    reader = _reader(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise TrajectoryError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise TrajectoryError(f"{path}: not a text file") from None
    except ValueError as error:  # a path with a zero byte
        raise TrajectoryError(f"{show(str(path))}: {error}") from None
    try:
        names, points, lines = reader(text, joint_names)
    except TrajectoryError as error:
        raise TrajectoryError(f"{path}{error}") from None
    try:
        return validate(names, joint_names, 0, points, position_low, position_high, velocity_max)
    except TrajectoryError as error:
        raise TrajectoryError(f"{path}: {_with_lines(str(error), lines)}") from None


def write(path, trajectory):
    """Write a trajectory to a file; `read` gives it back bit by bit, its stamp aside.

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
        raise TrajectoryError(
            f"{path}: a trajectory's file ends in {', '.join(SUFFIXES)}: name it so"
        )
    return _from_csv if suffix == ".csv" else _from_yaml


def _with_lines(message, lines):
    """Name the file's lines in the place of points, where it has lines."""
    if not lines:
        return message
    return re.sub(r"points\[(\d+)\]", lambda match: f"line {lines[int(match[1])]}", message)


# CSV -------------------------------------------------------------------------------------------


def _from_csv(text, joint_names):
    reader = csv.reader(text.splitlines())
    try:
        rows = [(reader.line_num, [word.strip() for word in row]) for row in reader]
    except csv.Error as error:
        raise TrajectoryError(f":{reader.line_num}: not a CSV table: {error}") from None
    rows = [(line, row) for line, row in rows if any(row)]
    if not rows:
        raise TrajectoryError(f": empty: give a header {_wanted(joint_names)}, then points")
    line, header = rows[0]
    columns = _csv_columns(header, joint_names, line)
    points = []
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise TrajectoryError(f":{line}: {len(row)} values for {len(header)} columns")
        values = [_csv_number(w, h, line) for w, h in zip(row, header, strict=True)]
        fields = [[values[i] for i in columns[field]] for field in _PREFIXES]
        points.append((_csv_time(values[columns["t"]], line), *fields, []))
    if not points:
        raise TrajectoryError(f":{line}: no points below the header")
    return joint_names, points, [line for line, _ in rows[1:]]


def _wanted(joint_names):
    n = len(joint_names)
    parts = [f"{prefix}1..{prefix}{n}" if n > 1 else f"{prefix}1" for prefix in _PREFIXES.values()]
    return f"t,{parts[0]}[,{parts[1]}[,{parts[2]}]]"


def _csv_columns(header, joint_names, line):
    """Where t and each field's columns are; fields that are not there have none."""
    count = range(1, len(joint_names) + 1)
    fields = {
        field: [f"{prefix}{i}" for i in count if f"{prefix}{i}" in header]
        for field, prefix in _PREFIXES.items()
    }
    known = {"t"}.union(*fields.values())
    hint = f"wanted {_wanted(joint_names)} for {', '.join(joint_names)}"
    for word in header:
        if word not in known:
            raise TrajectoryError(f":{line}: unknown column {show(word)}: {hint}")
        if header.count(word) > 1:
            raise TrajectoryError(f":{line}: column {word} is there {header.count(word)} times")
    for field, names in fields.items():
        prefix = _PREFIXES[field]
        if (names or field == "positions") and len(names) < len(joint_names):
            lacks = next(f"{prefix}{i}" for i in count if f"{prefix}{i}" not in header)
            raise TrajectoryError(f":{line}: no column {lacks}: {hint}")
    if "t" not in header:
        raise TrajectoryError(f":{line}: no column t: {hint}")
    return {"t": header.index("t")} | {
        field: [header.index(name) for name in names] for field, names in fields.items()
    }


def _csv_number(word, column, line):
    try:
        value = float(word)
    except ValueError:
        raise TrajectoryError(f":{line}: {column} is {show(word)}, not a number") from None
    if not math.isfinite(value):
        raise TrajectoryError(f":{line}: {column} is {show(word)}, not finite")
    return value


def _csv_time(value, line):
    if abs(value) > 9e9:
        raise TrajectoryError(f":{line}: t is {value:g} s, beyond 2^63 ns: use shorter times")
    return round(value * SECOND)


def _csv_text(trajectory):
    n = len(trajectory.joint_names)
    fields = [f for f in _PREFIXES if getattr(trajectory, f) is not None]
    header = ["t"] + [f"{_PREFIXES[f]}{i + 1}" for f in fields for i in range(n)]
    rows = [",".join(header)]
    for k, time in enumerate(trajectory.times_ns.tolist()):
        values = [v for f in fields for v in getattr(trajectory, f)[k].tolist()]
        rows.append(",".join([_decimal(time), *map(repr, values)]))
    return "\n".join(rows) + "\n"


def _decimal(time_ns):
    whole, part = divmod(time_ns, SECOND)
    return f"{whole}.{part:09d}".rstrip("0") + ("0" if not part else "")


# YAML ------------------------------------------------------------------------------------------


def _from_yaml(text, joint_names):
    try:
        # `ros2 topic echo` ends each message with a line of dashes.
        documents = [d for d in yaml.load_all(text, _LOADER) if d is not None]
    except Exception as error:
        # Not YAML's own errors alone: PyYAML lets others through on a scalar that is not what its tag says, and
        # on endless nesting.
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        raise TrajectoryError(
            f"{line}: not YAML: {getattr(error, 'problem', None) or error}"
        ) from None
    if len(documents) != 1:
        raise TrajectoryError(f": {len(documents)} trajectories: give one")
    top = _mapping(documents[0], ": the file", ("header", "joint_names", "points"))
    for key in ("joint_names", "points"):
        if not isinstance(top.get(key), list):
            raise TrajectoryError(f": {key} is {show(top.get(key))}: give a list")
    points = [_yaml_point(point, f": points[{i}]") for i, point in enumerate(top["points"])]
    return top["joint_names"], points, None


def _mapping(value, where, keys):
    if not isinstance(value, dict):
        raise TrajectoryError(f"{where} is {show(value)}: give {', '.join(keys)}")
    for key in value:
        if key not in keys:
            raise TrajectoryError(f"{where} has {show(key)}: known are {', '.join(keys)}")
    return value


def _yaml_point(point, where):
    _mapping(point, where, _POINT_KEYS)
    fields = [_yaml_values(point.get(f), f"{where}.{f}") for f in (*_PREFIXES, "effort")]
    time = point.get("time_from_start", {})
    time = _mapping(time, f"{where}.time_from_start", ("sec", "nanosec"))
    for key, value in time.items():
        if isinstance(value, bool) or not isinstance(value, int):
            raise TrajectoryError(
                f"{where}.time_from_start.{key} is {show(value)}: give an integer"
            )
    return time.get("sec", 0) * SECOND + time.get("nanosec", 0), *fields


def _yaml_values(values, where):
    if values is None:
        return []
    if not isinstance(values, list):
        raise TrajectoryError(f"{where} is {show(values)}: give a list, one number per joint")
    out = []
    for i, value in enumerate(values):
        try:
            # YAML 1.1 takes 1e-3 (no dot) for text; a person means the number.
            out.append(value if isinstance(value, float) else _yaml_number(value))
        except NOT_NUMBERS:
            raise TrajectoryError(f"{where}[{i}] is {show(value)}, not a number") from None
    return out


def _yaml_number(value):
    if isinstance(value, bool):
        raise TypeError
    return float(value)


def _yaml_text(trajectory):
    fields = [f for f in _PREFIXES if getattr(trajectory, f) is not None]
    points = []
    for k, time in enumerate(trajectory.times_ns.tolist()):
        sec, nanosec = divmod(time, SECOND)
        point = {f: getattr(trajectory, f)[k].tolist() for f in fields}
        points.append(point | {"time_from_start": {"sec": sec, "nanosec": nanosec}})
    message = {"joint_names": list(trajectory.joint_names), "points": points}
    return yaml.dump(message, Dumper=_DUMPER, sort_keys=False, default_flow_style=None, width=1000)
