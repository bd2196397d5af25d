# SPDX-License-Identifier: Apache-2.0
"""What a `trajectory_msgs/JointTrajectory` asks for, checked and in the arm's joint order."""

import operator
from array import array
from collections.abc import Mapping, Set
from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.errors import TrajectoryError

from .values import (
    END_VELOCITY_TOLERANCE,
    MAX_MAGNITUDE,
    MAX_POINTS,
    NOT_NUMBERS,
    SECOND,
    SPEED_ROUNDING,
    UNITS,
    joint_limit,
    seconds,
    show,
)

_FIELDS = ("time_from_start", "positions", "velocities", "accelerations", "effort")
_MAX_NS = 2**63 - 1


@dataclass(frozen=True, eq=False)
class JointTrajectoryData:
    """A trajectory that `validate` has passed; its arrays are read-only.

    Attributes
    ----------
    stamp_ns : int
        Stamp at which it starts [ns]; 0 means now, at the next sample.
    joint_names : tuple of str
        The arm's n joints, in the arm's order, which is that of the columns below.
    times_ns : (k,) int64 array
        Times of the points from the start, strictly increasing [ns].
    positions : (k, n) array
        Positions at the points [rad].
    velocities : (k, n) array or None
        Velocities at the points [rad/s]; None: linear interpolation.
    accelerations : (k, n) array or None
        Accelerations at the points [rad/s^2]; None: cubic interpolation at most.
    """

    stamp_ns: int
    joint_names: tuple
    times_ns: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray | None = None
    accelerations: np.ndarray | None = None

    @property
    def times(self) -> np.ndarray:
        """Times of the points from the start, (k,) [s]."""
        return self.times_ns / SECOND

    def repeats(self, other: "JointTrajectoryData") -> bool:
        """Whether `other` has the same joints, the same stamp and the same points, bit by bit."""
        if self.stamp_ns != other.stamp_ns or self.joint_names != other.joint_names:
            return False
        pairs = (
            (self.times_ns, other.times_ns),
            (self.positions, other.positions),
            (self.velocities, other.velocities),
            (self.accelerations, other.accelerations),
        )
        return all(
            a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs
        )


def validate(
    joint_names,
    arm_joint_names,
    stamp_ns,
    points,
    position_low=None,
    position_high=None,
    velocity_max=None,
) -> JointTrajectoryData:
    """Check a trajectory as it came from outside, and bring it to the arm's joint order.

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
        last four sequences in the order of `joint_names` [ns, rad, rad/s, rad/s^2]. Velocities
        and accelerations may be empty, but then in every point; effort must be empty.
    position_low, position_high : (n,) array_like, optional
        Limits of the positions in the arm's order [rad]; infinite where there is none.
    velocity_max : (n,) array_like, optional
        Limit of the speeds in the arm's order [rad/s]. Held against the given velocities and
        against the mean between two points, which no curve through both can stay below.

    Returns
    -------
    JointTrajectoryData
        The trajectory.

    Raises
    ------
    TrajectoryError
        Naming the joint, point or field, the value, the limit, and what to do.
    """
    arm_joint_names = tuple(arm_joint_names)
    order = _column_order(joint_names, arm_joint_names)
    columns = _columns(points)
    stamp_ns = _stamp(stamp_ns)
    times_ns = _times(columns[0], stamp_ns)
    fields = [
        _field(name, column, arm_joint_names, order)
        for name, column in zip(_FIELDS[1:4], columns[1:4], strict=True)
    ]
    _refuse_effort(columns[4])
    if fields[0] is None:
        raise TrajectoryError(
            "points[0].positions is empty: give the position of every joint in every point"
        )
    if fields[1] is None and fields[2] is not None:
        raise TrajectoryError(
            "points[0] has accelerations but no velocities: give both, or leave out the "
            "accelerations"
        )
    trajectory = JointTrajectoryData(stamp_ns, arm_joint_names, times_ns, *fields)
    _refuse_end_velocity(trajectory)
    _check_limits(trajectory, position_low, position_high, velocity_max)
    return trajectory


def _column_order(joint_names, arm_joint_names):
    """Return for each of the arm's joints its column in the message, as a list of int."""
    try:
        if isinstance(joint_names, Mapping | Set):  # which column is whose?
            raise TypeError
        names = list(joint_names)
    except TypeError:
        raise TrajectoryError(f"joint_names is {show(joint_names)}: give a list of names") from None
    listed = ", ".join(arm_joint_names)
    for name in names:
        if not isinstance(name, str) or name not in arm_joint_names:
            raise TrajectoryError(
                f"joint_names has {show(name)}, which is no joint of this arm: give {listed}"
            )
        if names.count(name) > 1:
            raise TrajectoryError(
                f"joint_names has {name!r} {names.count(name)} times: give each joint once"
            )
    for name in arm_joint_names:
        if name not in names:
            raise TrajectoryError(
                f"joint_names lacks {name!r}: give every joint of the arm ({listed})"
            )
    return [names.index(name) for name in arm_joint_names]


def _columns(points):
    """Turn the points into one list of k entries per field."""
    try:
        points = list(points)
    except TypeError:
        raise TrajectoryError(f"points is {show(points)}: give a list of points") from None
    if not points:
        raise TrajectoryError("empty trajectory: give at least one point")
    if len(points) > MAX_POINTS:
        raise TrajectoryError(
            f"{len(points)} points are more than the {MAX_POINTS} allowed: send fewer, "
            "farther apart"
        )
    if not set(map(type, points)) <= {tuple, list} or set(map(len, points)) != {len(_FIELDS)}:
        for index, point in enumerate(points):
            if not isinstance(point, tuple | list) or len(point) != len(_FIELDS):
                raise TrajectoryError(
                    f"points[{index}] is {show(point)}: give ({', '.join(_FIELDS)}) in each point"
                )
    return [[point[i] for point in points] for i in range(len(_FIELDS))]


def _stamp(stamp_ns):
    """Return the stamp as an int within the range of a ROS time [ns]."""
    try:
        stamp_ns = operator.index(stamp_ns)
    except TypeError:
        raise TrajectoryError(
            f"header.stamp is {show(stamp_ns)}: give integer nanoseconds, 0 for now"
        ) from None
    if not 0 <= stamp_ns <= _MAX_NS:
        raise TrajectoryError(
            f"header.stamp is {show(stamp_ns)} ns, outside 0 to {_MAX_NS} ns: use 0 for now"
        )
    return stamp_ns


def _times(column, stamp_ns):
    """Return the points' times as a read-only (k,) int64 array, strictly increasing [ns]."""
    try:
        times = np.fromiter(map(operator.index, column), np.int64, len(column))
    except NOT_NUMBERS:
        index, value = _first_failure(column, lambda value: np.int64(operator.index(value)))
        raise TrajectoryError(
            f"points[{index}].time_from_start is {show(value)}: give an integer below 2^63 [ns]"
        ) from None
    if times[0] < 0:
        raise TrajectoryError(
            f"points[0].time_from_start is {seconds(times[0])}: it must be at least 0 s"
        )
    late = np.flatnonzero(times[1:] <= times[:-1])
    if late.size:
        index = int(late[0]) + 1
        raise TrajectoryError(
            f"points[{index}].time_from_start is {seconds(times[index])}, not later than "
            f"points[{index - 1}] at {seconds(times[index - 1])}: times must strictly increase"
        )
    if stamp_ns + int(times[-1]) > _MAX_NS:
        raise TrajectoryError(
            f"the trajectory ends {seconds(times[-1])} after {seconds(stamp_ns)}, beyond "
            "2^63 ns: use an earlier stamp or shorter times"
        )
    times.flags.writeable = False
    return times


def _field(name, column, arm_joint_names, order):
    """Return a field of all points as a read-only (k, n) array in the arm's order, or None."""
    lengths = _lengths(name, column)
    n = len(order)
    bad = np.flatnonzero((lengths != n) & (lengths != 0))
    if bad.size:
        index = int(bad[0])
        allowed = f"{n}" if name == "positions" else f"{n} or none"
        raise TrajectoryError(
            f"points[{index}].{name} has length {lengths[index]}, for {n} joints: give {allowed}"
        )
    uneven = np.flatnonzero(lengths != lengths[0])
    if uneven.size:
        index = int(uneven[0])
        has, lacks = (index, 0) if lengths[index] else (0, index)
        raise TrajectoryError(
            f"points[{lacks}] has no {name}, points[{has}] has: give the same fields in every point"
        )
    if lengths[0] == 0:
        return None
    values = _numbers(name, column, n).reshape(len(column), n)[:, order]
    wild = np.argwhere(~(np.abs(values) <= MAX_MAGNITUDE))  # so written, it finds nan too
    if wild.size:
        index, joint = (int(i) for i in wild[0])
        raise TrajectoryError(
            f"points[{index}].{name} of joint {arm_joint_names[joint]} is "
            f"{values[index, joint]} {UNITS[name]}: it must be finite and at most "
            f"{MAX_MAGNITUDE:g} in magnitude"
        )
    values.flags.writeable = False
    return values


def _lengths(name, column):
    """Return how many values each point has in this field, (k,) int array."""
    try:
        return np.fromiter(map(len, column), np.int64, len(column))
    except NOT_NUMBERS:
        index, value = _first_failure(column, len)
        raise TrajectoryError(
            f"points[{index}].{name} is {show(value)}: give a sequence of numbers, empty for none"
        ) from None


def _numbers(name, column, n):
    """Return the values of all points, n each, one after the other, as a flat float array."""
    # array() rather than numpy: it refuses None and strings, which numpy would convert; and it
    # copies the array('d') of a ROS message whole.
    numbers = array("d")

    def read(column):
        for values in column:
            numbers.extend(values)
        if len(numbers) != n * len(column):  # its len() has lied
            raise ValueError

    try:
        read(column)
    except NOT_NUMBERS:
        index, value = _first_failure(column, lambda values: array("d", iter(values)))
        raise TrajectoryError(
            f"points[{index}].{name} is {show(value)}: give {n} numbers"
        ) from None
    return np.frombuffer(numbers)


def _first_failure(column, convert):
    """Return index and value of the first entry that `convert` can't take."""
    for index, value in enumerate(column):
        try:
            convert(value)
        except NOT_NUMBERS:
            return index, value
    raise TrajectoryError("a value can't be read as a number: give lists of plain numbers")


def _refuse_effort(column):
    filled = np.flatnonzero(_lengths("effort", column))
    if filled.size:
        raise TrajectoryError(
            f"points[{int(filled[0])}].effort is not empty: effort is not used here, the torque "
            "is computed from the motion; leave it empty"
        )


def _refuse_end_velocity(trajectory):
    # As the joint_trajectory_controller by default: the hold after the last point has velocity
    # zero, and a step down to it would shake the links.
    if trajectory.velocities is None:
        return
    moving = np.flatnonzero(np.abs(trajectory.velocities[-1]) > END_VELOCITY_TOLERANCE)
    if moving.size:
        joint = int(moving[0])
        raise TrajectoryError(
            f"the last point's velocity of joint {trajectory.joint_names[joint]} is "
            f"{trajectory.velocities[-1, joint]} rad/s: it must be 0, the arm holds there"
        )


def _check_limits(trajectory, position_low, position_high, velocity_max):
    """Refuse points outside the limits, and pairs that no speed within the limit connects."""
    names, positions = trajectory.joint_names, trajectory.positions
    if position_low is not None:
        low = joint_limit("position_low", position_low, names)
        _refuse_outside("position", positions, positions < low, low, names)
    if position_high is not None:
        high = joint_limit("position_high", position_high, names)
        _refuse_outside("position", positions, positions > high, high, names)
    if velocity_max is None:
        return
    limit = joint_limit("velocity_max", velocity_max, names)
    if trajectory.velocities is not None:
        velocities = trajectory.velocities
        _refuse_outside("velocity", velocities, np.abs(velocities) > limit, limit, names)
    mean = np.diff(positions, axis=0) / (np.diff(trajectory.times_ns) / SECOND)[:, None]
    fast = np.argwhere(np.abs(mean) > limit * (1.0 + SPEED_ROUNDING))
    if fast.size:
        index, joint = (int(i) for i in fast[0])
        raise TrajectoryError(
            f"from points[{index}] to points[{index + 1}] joint {names[joint]} would move at "
            f"{mean[index, joint]:.6g} rad/s on average, beyond its limit of "
            f"{limit[joint]:g} rad/s: give it more time"
        )


def _refuse_outside(what, values, outside, limit, names):
    if not outside.any():
        return
    index, joint = (int(i) for i in np.argwhere(outside)[0])
    unit = "rad" if what == "position" else "rad/s"
    raise TrajectoryError(
        f"points[{index}]: {what} of joint {names[joint]} is {values[index, joint]:.9g} {unit}, "
        f"beyond its limit of {limit[joint]:.9g} {unit}: stay within"
    )
