# SPDX-License-Identifier: Apache-2.0
"""Checks a `trajectory_msgs/JointTrajectory` and brings it to the arm's joint order."""

import operator
from array import array
from collections.abc import Mapping, Set
from dataclasses import dataclass, replace

import numpy as np

from flexarm_dynamics.errors import TrajectoryError
from flexarm_dynamics.shown import listed

from .streams import ADD, PLAIN, REFUSE, Coast, are_near, smoothed
from .values import (
    END_VELOCITY_TOLERANCE,
    MAX_MAGNITUDE,
    MAX_POINTS,
    NOT_NUMBERS,
    SECOND,
    SPEED_ROUNDING,
    UNITS,
    joint_limit,
    refuse_joint,
    seconds,
)

_FIELDS = ("time_from_start", "positions", "velocities", "accelerations", "effort")
_MAX_NS = 2**63 - 1


@dataclass(frozen=True, eq=False)
class JointTrajectoryData:
    """A trajectory that `validate` has passed; its arrays are read-only, their columns in the arm's order."""

    stamp_ns: int  # at which it starts [ns]; 0 means now, at the next sample
    joint_names: tuple  # the arm's n joints
    times_ns: np.ndarray  # of the points from the start, strictly increasing, (k,) int64 [ns]
    positions: np.ndarray  # (k, n) [rad]
    velocities: np.ndarray | None = None  # (k, n) [rad/s]; None: linear interpolation
    accelerations: np.ndarray | None = None  # (k, n) [rad/s^2]; None: cubic interpolation at most
    effort: np.ndarray | None = None  # (k, n) [N m], added to the torque; None: none
    coast: Coast | None = None  # how it comes to rest after a last point that moves
    first: np.ndarray | None = None  # position at time 0, (n,) [rad], if no point there is left

    @property
    def times(self) -> np.ndarray:
        """Times of the points from the start, (k,) [s]."""
        return self.times_ns / SECOND

    @property
    def fields(self) -> list:
        """Positions, then velocities and accelerations if given: one to three (k, n) arrays."""
        every = (self.positions, self.velocities, self.accelerations)
        return [values for values in every if values is not None]

    def repeats(self, other: "JointTrajectoryData") -> bool:
        """Whether `other` has the same joints, the same stamp and the same points, bit by bit."""
        if self.stamp_ns != other.stamp_ns or self.joint_names != other.joint_names:
            return False
        mine, others = (
            [t.times_ns, *t.fields, *([] if t.effort is None else ["effort", t.effort])]
            for t in (self, other)
        )
        same = len(mine) == len(others) and all(map(np.array_equal, mine, others))
        return same and self.coast == other.coast


def validate(
    joint_names,
    arm_joint_names,
    stamp_ns,
    points,
    position_low=None,
    position_high=None,
    velocity_max=None,
    held=None,
    streaming=PLAIN,
) -> JointTrajectoryData:
    """Check an untrusted trajectory, and bring it to the arm's joint order.

    Parameters
    ----------
    joint_names : sequence of str
        The message's joints, each of the arm's exactly once, in any order.
    arm_joint_names : sequence of str
        The arm's n joints.
    stamp_ns : int
        Start [ns]; 0 means now.
    points : sequence
        One `(time_from_start_ns, positions, velocities, accelerations, effort)` per point, the
        last four sequences in the order of `joint_names` [ns, rad, rad/s, rad/s^2, N m].
        Velocities, accelerations and effort may be empty, but then in every point.
    position_low, position_high : (n,) array_like, optional
        Limits of the positions in the arm's order [rad]; infinite where there is none.
    velocity_max : (n,) array_like, optional
        Limit of the speeds in the arm's order [rad/s]. It applies to the given velocities and to
        the mean speed between two points, since no curve through both can stay below it everywhere.
    held : (n,) array_like, optional
        Positions of joints that the message leaves out [rad]; if not given, it must name all joints.
    streaming : Streaming
        Whether the end may move, how near positions are smoothed, and how effort is treated.

    Raises
    ------
    TrajectoryError
        It names the point, field and joint, the value, the limit, and what to do.
    """
    arm_joint_names = tuple(arm_joint_names)
    order = _column_order(joint_names, arm_joint_names, held is not None)
    columns = _columns(points)
    stamp_ns = _stamp(stamp_ns)
    times_ns = _times(columns[0], stamp_ns)
    fields = [
        _field(name, column, arm_joint_names, order, held)
        for name, column in zip(_FIELDS[1:4], columns[1:4], strict=True)
    ]
    effort = _effort(columns[4], arm_joint_names, order, streaming.effort)
    if fields[0] is None:
        raise TrajectoryError(
            "is empty", field="points[0].positions", hint="give the position of every joint"
        )
    if fields[1] is None and fields[2] is not None:
        raise TrajectoryError(
            "has accelerations but no velocities",
            field="points[0]",
            hint="give both, or leave out the accelerations",
        )
    trajectory = JointTrajectoryData(stamp_ns, arm_joint_names, times_ns, *fields, effort=effort)
    _check_limits(trajectory, position_low, position_high, velocity_max)
    if fields[1] is None:
        return _smoothed(trajectory, streaming)
    if not streaming.moving_end:
        _refuse_end_velocity(trajectory)
    elif (np.abs(fields[1][-1]) > END_VELOCITY_TOLERANCE).any():
        trajectory = replace(trajectory, coast=streaming.coast(fields[1][-1]))
        _check_rest(trajectory, position_low, position_high)
    return trajectory


def _effort(column, arm_joint_names, order, treatment):
    """Effort of all points, (k, n) [N m], if it is added; otherwise it is refused, or left out (None)."""
    if treatment == ADD:
        return _field("effort", column, arm_joint_names, order, None)
    filled = np.flatnonzero(_lengths("effort", column))
    if filled.size and treatment == REFUSE:
        raise TrajectoryError(
            "is not empty",
            field=f"points[{int(filled[0])}].effort",
            hint="leave it empty: the torque is computed from the motion; or set effort_in_points to add or ignore",
        )
    return None


def _smoothed(trajectory, streaming):
    """A trajectory of positions alone, smoothed as `streaming` requires if they are near."""
    if not streaming.smoothing or not are_near(trajectory.times_ns, streaming.smoothing):
        return trajectory
    times_ns, fields = smoothed(trajectory.times_ns, trajectory.positions, streaming.window)
    effort = trajectory.effort
    if effort is not None:
        before = np.clip(times_ns, *trajectory.times_ns[[0, -1]])
        effort = np.stack([np.interp(before, trajectory.times_ns, e) for e in effort.T], axis=1)
    for values in (times_ns, *fields):
        values.flags.writeable = False
    return JointTrajectoryData(
        trajectory.stamp_ns,
        trajectory.joint_names,
        times_ns,
        *fields,
        effort,
        first=None if trajectory.times_ns[0] else trajectory.positions[0],
    )


def _check_rest(trajectory, position_low, position_high):
    """Refuse a last point from which the arm would come to rest outside of the limits."""
    names, last = trajectory.joint_names, trajectory.times_ns.size - 1
    state = [values[-1] for values in trajectory.fields]
    _, rest = trajectory.coast.coefficients(*state, *[0.0 * state[0]] * (3 - len(state)))
    rest = rest[None]
    for side, limit, beyond in (
        ("below", position_low, np.less),
        ("above", position_high, np.greater),
    ):
        if limit is not None:
            problem = f"rad is where the arm would come to rest after it, {side} the limit"
            hint = "slow down before the limit, or lower cmd_timeout"
            limit = np.asarray(limit, float)
            refuse_joint("positions", beyond(rest, limit), rest, names, problem, limit, hint, last)


def _column_order(joint_names, arm_joint_names, partial):
    """Return for each of the arm's joints its column in the message, a list of int; -1 where it is left out."""
    field = "joint_names"
    try:
        if isinstance(joint_names, Mapping | Set):  # they have no order
            raise TypeError
        names = list(joint_names)
    except TypeError:
        raise TrajectoryError("is no list of names", field=field, value=joint_names) from None
    known = listed(arm_joint_names)
    for name in names:
        if not isinstance(name, str) or name not in arm_joint_names:
            raise TrajectoryError(
                "is no joint of this arm", field=field, value=name, hint=f"give {known}"
            )
        if names.count(name) > 1:
            raise TrajectoryError(
                f"is given {names.count(name)} times",
                field=field,
                value=name,
                hint="give each joint once",
            )
    for name in arm_joint_names:
        if name not in names and not (partial and names):
            raise TrajectoryError("is missing", field=field, value=name, hint=f"give {known}")
    return [names.index(name) if name in names else -1 for name in arm_joint_names]


def _columns(points):
    """Turn the points into one list of k entries per field."""
    try:
        points = list(points)
    except TypeError:
        raise TrajectoryError("is no list of points", field="points", value=points) from None
    if not points:
        raise TrajectoryError("empty trajectory", field="points", hint="give at least one point")
    if len(points) > MAX_POINTS:
        raise TrajectoryError(
            "are too many",
            field="points",
            value=len(points),
            limit=MAX_POINTS,
            hint="send fewer, farther apart",
        )
    kinds, size = tuple | list, len(_FIELDS)
    for index, point in enumerate(points):
        if not isinstance(point, kinds) or len(point) != size:
            hint = f"give ({', '.join(_FIELDS)})"
            raise TrajectoryError("is no point", field=f"points[{index}]", value=point, hint=hint)
    return [[point[i] for point in points] for i in range(len(_FIELDS))]


def _stamp(stamp_ns):
    """Return the stamp as an int within the range of a ROS time [ns]."""
    rest = {
        "field": "header.stamp",
        "value": stamp_ns,
        "hint": "give integer nanoseconds, 0 for now",
    }
    try:
        stamp_ns = operator.index(stamp_ns)
    except TypeError:
        raise TrajectoryError("is no integer", **rest) from None
    if not 0 <= stamp_ns <= _MAX_NS:
        raise TrajectoryError("is out of range", limit=f"0 to {_MAX_NS} ns", **rest)
    return stamp_ns


def _times(column, stamp_ns):
    """Return the points' times as a read-only (k,) int64 array, strictly increasing [ns]."""
    try:
        times = np.fromiter(map(operator.index, column), np.int64, len(column))
    except NOT_NUMBERS:
        raise _unreadable(
            "time_from_start",
            column,
            lambda value: np.int64(operator.index(value)),
            "is no integer below 2^63 [ns]",
        ) from None

    def refuse(index, problem, **rest):
        raise TrajectoryError(
            f"s {problem}",
            field=f"points[{index}].time_from_start",
            value=int(times[index]) / SECOND,
            **rest,
        )

    if times[0] < 0:
        refuse(0, "is negative", limit="at least 0 s")
    late = np.flatnonzero(times[1:] <= times[:-1])
    if late.size:
        index = int(late[0])
        before = f"points[{index}] at {seconds(times[index])}"
        refuse(index + 1, f"is not later than {before}", hint="times must strictly increase")
    if stamp_ns + int(times[-1]) > _MAX_NS:
        hint = "use an earlier stamp or shorter times"
        refuse(times.size - 1, f"after {seconds(stamp_ns)} is beyond 2^63 ns", hint=hint)
    times.flags.writeable = False
    return times


def _field(name, column, arm_joint_names, order, held):
    """Return a field of all points as a read-only (k, n) array in the arm's order, or None."""
    lengths = _lengths(name, column)
    given = np.array(order) >= 0
    n = int(given.sum())
    bad = np.flatnonzero((lengths != n) & (lengths != 0))
    if bad.size:
        index = int(bad[0])
        raise TrajectoryError(
            "is the wrong number of values",
            field=f"points[{index}].{name}",
            value=int(lengths[index]),
            limit=f"{n} joints",
            hint=f"give {n}" if name == "positions" else f"give {n} or none",
        )
    uneven = np.flatnonzero(lengths != lengths[0])
    if uneven.size:
        index = int(uneven[0])
        has, lacks = (index, 0) if lengths[index] else (0, index)
        raise TrajectoryError(
            f"is empty, that of points[{has}] is not",
            field=f"points[{lacks}].{name}",
            hint="give the same fields in every point",
        )
    if lengths[0] == 0:
        return None
    numbers = _numbers(name, column, n).reshape(len(column), n)
    values = numbers[:, order]  # a copy
    if n < len(order):
        values[:, ~given] = np.asarray(held, float)[~given] if name == "positions" else 0.0
    wild = ~(np.abs(values) <= MAX_MAGNITUDE)  # so written, it finds nan too
    problem = f"{UNITS[name]} is not finite or too large"
    refuse_joint(name, wild, values, arm_joint_names, problem, MAX_MAGNITUDE)
    values.flags.writeable = False
    return values


def _lengths(name, column):
    """Return how many values each point has in this field, (k,) int array."""
    try:
        return np.fromiter(map(len, column), np.int64, len(column))
    except NOT_NUMBERS:
        raise _unreadable(
            name, column, len, "is no sequence of numbers", "give an empty one for none"
        ) from None


def _numbers(name, column, n):
    """Return the values of all points, n each, one after the other, as a flat float array."""
    # array() instead of numpy: it refuses None and strings, which numpy would convert; and it
    # copies the array('d') of a ROS message as a whole.
    numbers = array("d")
    try:
        for values in column:
            numbers.extend(values)
        if len(numbers) != n * len(column):  # some len() did not fit its sequence
            raise ValueError
    except NOT_NUMBERS:
        raise _unreadable(
            name, column, lambda values: array("d", iter(values)), f"is no list of {n} numbers"
        ) from None
    return np.frombuffer(numbers)


def _unreadable(name, column, convert, problem, hint=""):
    """Return the error of the first point whose field `convert` can't take."""
    for index, value in enumerate(column):
        try:
            convert(value)
        except NOT_NUMBERS:
            return TrajectoryError(problem, field=f"points[{index}].{name}", value=value, hint=hint)
    return TrajectoryError(problem, field=f"points[].{name}", hint="give lists of plain numbers")


def _refuse_end_velocity(trajectory):
    # Like the joint_trajectory_controller by default: the hold after the last point has velocity
    # zero, and a step down to it would excite the links.
    if trajectory.velocities is None:
        return
    end = trajectory.velocities[-1:]
    moving = np.abs(end) > END_VELOCITY_TOLERANCE
    problem = "rad/s is not zero at the last point"
    hint = "the arm holds there; for a stream set allow_nonzero_velocity_at_trajectory_end"
    names, last = trajectory.joint_names, trajectory.times_ns.size - 1
    refuse_joint("velocities", moving, end, names, problem, 0.0, hint, last)


def _check_limits(trajectory, position_low, position_high, velocity_max):
    """Refuse points outside the limits, and pairs that no speed within the limit connects."""
    names, positions = trajectory.joint_names, trajectory.positions
    if position_low is not None:
        low = joint_limit("position_low", position_low, names)
        refuse_joint("positions", positions < low, positions, names, "rad is below the limit", low)
    if position_high is not None:
        high = joint_limit("position_high", position_high, names)
        refuse_joint(
            "positions", positions > high, positions, names, "rad is above the limit", high
        )
    if velocity_max is None:
        return
    limit = joint_limit("velocity_max", velocity_max, names)
    if trajectory.velocities is not None:
        speeds = np.abs(trajectory.velocities)
        problem = "rad/s is beyond the speed limit"
        refuse_joint("velocities", speeds > limit, trajectory.velocities, names, problem, limit)
    mean = np.diff(positions, axis=0) / (np.diff(trajectory.times_ns) / SECOND)[:, None]
    fast = np.abs(mean) > limit * (1.0 + SPEED_ROUNDING)
    problem = "rad/s on average from the point before is beyond the speed limit"
    refuse_joint("positions", fast, mean, names, problem, limit, "give it more time", 1)
