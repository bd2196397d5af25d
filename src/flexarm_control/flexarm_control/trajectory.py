"""Trajectories: what a `trajectory_msgs/JointTrajectory` asks for, and the reference it makes.

Read as the joint_trajectory_controller of ros2_controllers (Jazzy) reads it. The fields that the
points have choose the interpolation (with x the time since the segment's start, T its length):

===================================== ===================================================
positions                             linear: the velocity steps at the points
positions, velocities                 cubic Hermite: position and velocity continuous
positions, velocities, accelerations  quintic Hermite: acceleration continuous too
===================================== ===================================================

The first segment leads from the reference at the start to the first point, at its
`time_from_start`, with the same interpolation: the reference's own velocity (and acceleration)
begin it, so a new trajectory takes over smoothly. After the last point the reference holds it.

Where this is stricter than the joint_trajectory_controller: partial joint goals, velocities
without positions, fields that not every point has, and a start in the past are refused.

Time is the stamp of the samples, in integer nanoseconds; nothing here reads a clock.
"""

import operator
import reprlib
from array import array
from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.errors import TrajectoryError

MAX_POINTS = 10**6
# Beyond this a double resolves less than 1e-7 of the unit: no joint's value, but a wrong one.
MAX_MAGNITUDE = 1e9  # [rad], [rad/s], [rad/s^2]
# The joint_trajectory_controller's own bound: one step of single precision at 1.
END_VELOCITY_TOLERANCE = float(np.finfo(np.float32).eps)  # [rad/s]
BRAKING_STEP = 0.01  # [s]
MAX_BRAKING = 3600.0  # [s] of a stop: a longer one is a wrong deceleration
# Speeds derived from differences carry rounding; a limit met exactly must not be refused.
SPEED_ROUNDING = 1e-6  # [-]

_FIELDS = ("time_from_start", "positions", "velocities", "accelerations", "effort")
_UNITS = {"positions": "rad", "velocities": "rad/s", "accelerations": "rad/s^2"}
_MAX_NS = 2**63 - 1
_SECOND = 1_000_000_000  # [ns]
_NOT_NUMBERS = (TypeError, ValueError, OverflowError)  # what conversions to numbers raise
_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 80


def _show(value):
    """Write any value, cut short, for a message."""
    try:
        return _REPR.repr(value)
    except Exception:  # a value's own repr may raise, and an int too long for one does
        return f"a {type(value).__name__}"


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
        return self.times_ns / _SECOND

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


# --------------------------------------------------------------------------- validation


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
        names = list(joint_names)
    except TypeError:
        raise TrajectoryError(
            f"joint_names is {_show(joint_names)}: give a list of names"
        ) from None
    listed = ", ".join(arm_joint_names)
    for name in names:
        if not isinstance(name, str) or name not in arm_joint_names:
            raise TrajectoryError(
                f"joint_names has {_show(name)}, which is no joint of this arm: give {listed}"
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
        raise TrajectoryError(f"points is {_show(points)}: give a list of points") from None
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
                    f"points[{index}] is {_show(point)}: give ({', '.join(_FIELDS)}) in each point"
                )
    return [[point[i] for point in points] for i in range(len(_FIELDS))]


def _stamp(stamp_ns):
    """Return the stamp as an int within the range of a ROS time [ns]."""
    try:
        stamp_ns = operator.index(stamp_ns)
    except TypeError:
        raise TrajectoryError(
            f"header.stamp is {_show(stamp_ns)}: give integer nanoseconds, 0 for now"
        ) from None
    if not 0 <= stamp_ns <= _MAX_NS:
        raise TrajectoryError(
            f"header.stamp is {_show(stamp_ns)} ns, outside 0 to {_MAX_NS} ns: use 0 for now"
        )
    return stamp_ns


def _times(column, stamp_ns):
    """Return the points' times as a read-only (k,) int64 array, strictly increasing [ns]."""
    try:
        times = np.fromiter(map(operator.index, column), np.int64, len(column))
    except _NOT_NUMBERS:
        index, value = _first_failure(column, lambda value: np.int64(operator.index(value)))
        raise TrajectoryError(
            f"points[{index}].time_from_start is {_show(value)}: give an integer below 2^63 [ns]"
        ) from None
    if times[0] < 0:
        raise TrajectoryError(
            f"points[0].time_from_start is {_seconds(times[0])}: it must be at least 0 s"
        )
    late = np.flatnonzero(times[1:] <= times[:-1])
    if late.size:
        index = int(late[0]) + 1
        raise TrajectoryError(
            f"points[{index}].time_from_start is {_seconds(times[index])}, not later than "
            f"points[{index - 1}] at {_seconds(times[index - 1])}: times must strictly increase"
        )
    if stamp_ns + int(times[-1]) > _MAX_NS:
        raise TrajectoryError(
            f"the trajectory ends {_seconds(times[-1])} after {_seconds(stamp_ns)}, beyond "
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
            f"{values[index, joint]} {_UNITS[name]}: it must be finite and at most "
            f"{MAX_MAGNITUDE:g} in magnitude"
        )
    values.flags.writeable = False
    return values


def _lengths(name, column):
    """Return how many values each point has in this field, (k,) int array."""
    try:
        return np.fromiter(map(len, column), np.int64, len(column))
    except _NOT_NUMBERS:
        index, value = _first_failure(column, len)
        raise TrajectoryError(
            f"points[{index}].{name} is {_show(value)}: give a sequence of numbers, empty for none"
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
    except _NOT_NUMBERS:
        index, value = _first_failure(column, lambda values: array("d", iter(values)))
        raise TrajectoryError(
            f"points[{index}].{name} is {_show(value)}: give {n} numbers"
        ) from None
    return np.frombuffer(numbers)


def _first_failure(column, convert):
    """Return index and value of the first entry that `convert` can't take."""
    for index, value in enumerate(column):
        try:
            convert(value)
        except _NOT_NUMBERS:
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
        low = _limit("position_low", position_low, names)
        _refuse_outside("position", positions, positions < low, low, names)
    if position_high is not None:
        high = _limit("position_high", position_high, names)
        _refuse_outside("position", positions, positions > high, high, names)
    if velocity_max is None:
        return
    limit = _limit("velocity_max", velocity_max, names)
    if trajectory.velocities is not None:
        velocities = trajectory.velocities
        _refuse_outside("velocity", velocities, np.abs(velocities) > limit, limit, names)
    mean = np.diff(positions, axis=0) / (np.diff(trajectory.times_ns) / _SECOND)[:, None]
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


def _limit(name, values, joint_names):
    """Return limits as an (n,) float array without nan."""
    values = _per_joint(name, values, joint_names)
    if np.isnan(values).any():
        joint = joint_names[int(np.argmax(np.isnan(values)))]
        raise TrajectoryError(f"{name} of joint {joint} is nan: give inf where there is no limit")
    return values


def _per_joint(name, values, joint_names):
    """Return one float per joint, (n,)."""
    try:
        values = np.array(values, dtype=float)
    except _NOT_NUMBERS:
        raise TrajectoryError(f"{name} is {_show(values)}: give one number per joint") from None
    if values.shape != (len(joint_names),):
        raise TrajectoryError(
            f"{name} has shape {values.shape}, the joints have ({len(joint_names)},): give one "
            "number per joint"
        )
    return values


def _seconds(time_ns):
    """Write nanoseconds as seconds, exactly, without trailing zeros."""
    time_ns = int(time_ns)
    whole, part = divmod(abs(time_ns), _SECOND)
    decimals = f".{part:09d}".rstrip("0") if part else ""
    return f"{'-' if time_ns < 0 else ''}{whole}{decimals} s"


# --------------------------------------------------------------------------- interpolation


def _hermite(duration, before, after):
    """Return the coefficients of the polynomials between two states.

    The polynomial of degree 2m - 1 that meets m given derivatives at either end (m = 1: linear,
    2: cubic, 3: quintic), e.g. Biagiotti & Melchiorri (2008), sections 2.1.1, 2.1.4, 2.1.6.

    Parameters
    ----------
    duration : float or array
        T [s], of a shape that broadcasts against the states.
    before, after : sequences of m arrays
        Position [rad], velocity [rad/s] and acceleration [rad/s^2] at either end, all (..., n).

    Returns
    -------
    list of 2 m arrays
        c_0 ... c_{2m-1}, so that the position is sum_i c_i x^i for 0 <= x <= T.
    """
    t, step = duration, after[0] - before[0]
    if len(before) == 1:
        return [before[0], step / t]
    v0, v1 = before[1], after[1]
    if len(before) == 2:
        return [
            before[0],
            v0,
            (3.0 * step - (2.0 * v0 + v1) * t) / t**2,
            (-2.0 * step + (v0 + v1) * t) / t**3,
        ]
    a0, a1 = before[2], after[2]
    return [
        before[0],
        v0,
        0.5 * a0,
        (20.0 * step - (8.0 * v1 + 12.0 * v0) * t - (3.0 * a0 - a1) * t**2) / (2.0 * t**3),
        (-30.0 * step + (14.0 * v1 + 16.0 * v0) * t + (3.0 * a0 - 2.0 * a1) * t**2) / (2.0 * t**4),
        (12.0 * step - 6.0 * (v1 + v0) * t - (a0 - a1) * t**2) / (2.0 * t**5),
    ]


class _Path:
    """A piecewise polynomial from the reference at its start to its last point.

    Knot 0 is the start, knot i the i-th point; segment i leads from knot i to knot i + 1. The
    coefficients of all segments but the first are made here, those of the first in `begin`,
    when the reference at the start is known. A first point at time 0 leaves segment 0 with no
    length, and it is never evaluated.

    Parameters
    ----------
    times_ns : (k,) int64 array
        Times of the points from the start [ns].
    derivatives : sequence of m (k, n) arrays
        Positions, then velocities, then accelerations.
    trajectory_id : int
        Whose path it is; 0: a stop's.
    """

    def __init__(self, times_ns, derivatives, trajectory_id=0):
        k, n = derivatives[0].shape
        order = 2 * len(derivatives)
        self.trajectory_id = trajectory_id
        self.start_ns = 0
        self.duration_ns = int(times_ns[-1])
        self._first = [values[0] for values in derivatives]
        self._end = np.zeros((3, n))
        self._end[0] = derivatives[0][-1]
        self._knots_ns = np.concatenate(([0], times_ns))
        self._coefficients = np.zeros((k, order, n))
        if k > 1:
            lengths = (np.diff(times_ns) / _SECOND)[:, None]
            before = [values[:-1] for values in derivatives]
            after = [values[1:] for values in derivatives]
            for i, values in enumerate(_hermite(lengths, before, after)):
                self._coefficients[1:, i] = values
        # The current segment's, for position, velocity and acceleration side by side: one
        # Horner scheme then serves the three. d/dx of sum c_i x^i has (i + 1) c_{i+1}.
        self._stack = np.zeros((order, 3, n))
        self._rows = tuple(self._stack[::-1])
        self._once = np.arange(1.0, order)[:, None]
        self._twice = self._once[:-1] * self._once[1:]
        self._x = np.zeros(())
        self._forget_segment()

    def _forget_segment(self):
        self._segment, self._low_ns, self._high_ns = -1, 0, 0

    def begin(self, start_ns, reference):
        """Start at a stamp [ns] from a (3, n) reference state; may be called again."""
        self.start_ns = start_ns
        self._forget_segment()
        length_ns = int(self._knots_ns[1])
        if length_ns > 0:
            before = reference[: len(self._first)]
            for i, values in enumerate(_hermite(length_ns / _SECOND, before, self._first)):
                self._coefficients[0, i] = values

    def evaluate(self, stamp_ns, out):
        """Fill `out` (3, n) with the state at a stamp; return whether it is before the end."""
        elapsed_ns = stamp_ns - self.start_ns
        if elapsed_ns < 0:
            elapsed_ns = 0  # before the start nothing is known but the state at the start
        if elapsed_ns >= self.duration_ns:
            np.copyto(out, self._end)
            return False
        if not self._low_ns <= elapsed_ns < self._high_ns:
            self._enter_segment(elapsed_ns)
        x = self._x
        x[()] = (elapsed_ns - self._low_ns) / _SECOND
        rows = self._rows
        np.multiply(rows[0], x, out)
        for row in rows[1:-1]:
            np.add(out, row, out)
            np.multiply(out, x, out)
        np.add(out, rows[-1], out)
        return True

    def _enter_segment(self, elapsed_ns):
        """Find the segment of a time before the end, and lay out its coefficients."""
        segment = self._segment + 1
        knots = self._knots_ns
        if elapsed_ns < self._high_ns or elapsed_ns >= knots[segment + 1]:
            # not the next one; side="right" steps over a segment 0 without length
            segment = int(np.searchsorted(knots, elapsed_ns, side="right")) - 1
        self._segment = segment
        self._low_ns, self._high_ns = int(knots[segment]), int(knots[segment + 1])
        c, stack = self._coefficients[segment], self._stack
        stack[:, 0] = c
        np.multiply(c[1:], self._once, out=stack[:-1, 1])
        np.multiply(c[2:], self._twice, out=stack[:-2, 2])


# --------------------------------------------------------------------------- reference


@dataclass(frozen=True)
class Verdict:
    """What became of an offered trajectory.

    Attributes
    ----------
    accepted : bool
        Whether it will be followed.
    reason : str
        Why it is refused, or when it starts and what it replaces.
    trajectory_id : int
        Its number, counted from 1; of a repeat, the number of what it repeats; 0 if refused.
    repeat : bool
        Whether it is the last accepted one again: no error, and no new start.
    """

    accepted: bool
    reason: str
    trajectory_id: int
    repeat: bool = False


class ReferenceGenerator:
    """The joints' reference: holds, follows trajectories, stops.

    The newest accepted trajectory wins: from its start on it replaces what is followed, and at
    once what was accepted before and has not begun, except that a trajectory which only waits
    for the next sample is still begun when the newer one starts later.

    Parameters
    ----------
    joint_names : sequence of str
        The arm's n joints.
    start_tolerance : float
        How far a first point at `time_from_start` 0 may be from the reference [rad].
    velocity_max : (n,) array_like, optional
        Limit of the mean speed between the reference at the start and the first point [rad/s].

    Attributes
    ----------
    position, velocity, acceleration : (n,) arrays
        The reference at the last sampled stamp [rad], [rad/s], [rad/s^2]; overwritten in place.
    active : bool
        A trajectory is being followed: from its start until its end.
    finished : bool
        The trajectory last followed has reached its end, which is held.
    stopping : bool
        A stop is braking.
    accepted_id : int
        The number of the last accepted trajectory; 0: none since the reset.
    """

    def __init__(self, joint_names, start_tolerance=0.01, velocity_max=None):
        self.joint_names = tuple(joint_names)
        if not 0.0 <= start_tolerance < np.inf:
            raise TrajectoryError(
                f"start_tolerance is {start_tolerance} rad: it must be finite and at least 0"
            )
        self._start_tolerance = float(start_tolerance)
        self._velocity_max = (
            None if velocity_max is None else _limit("velocity_max", velocity_max, self.joint_names)
        )
        n = len(self.joint_names)
        self._state = np.zeros((3, n))
        self._scratch = np.zeros((3, n))
        self.position, self.velocity, self.acceleration = self._state
        self.reset()

    def reset(self):
        """Forget everything: the state, the trajectories, their numbers, what is a repeat."""
        self._state[:] = 0.0
        self._last_ns = None
        self.accepted_id = 0
        self._drop_all()

    def _drop_all(self):
        self._path = None
        self._starting = None  # begins at the next sample
        self._pending = None  # begins at its own start_ns
        self._last_accepted = None
        self.active = self.finished = self.stopping = False

    def start(self, position, stamp_ns):
        """Hold a measured position from a stamp on; trajectories before it are forgotten.

        Parameters
        ----------
        position : (n,) array_like
            The measured joint positions [rad].
        stamp_ns : int
            The stamp of the measurement [ns].

        Raises
        ------
        TrajectoryError
            If the position has another shape or is not finite.
        """
        position = _per_joint("the position to hold", position, self.joint_names)
        if not np.isfinite(position).all():
            joint = int(np.argmin(np.isfinite(position)))
            raise TrajectoryError(
                f"the position of joint {self.joint_names[joint]} is {position[joint]} rad: "
                "a finite measurement is needed to hold it"
            )
        self._drop_all()
        self._state[:] = 0.0
        self._state[0] = position
        self._last_ns = stamp_ns

    def offer(self, trajectory: JointTrajectoryData) -> Verdict:
        """Take a validated trajectory, or say why not.

        Parameters
        ----------
        trajectory : JointTrajectoryData
            From `validate`, for the same joints.

        Returns
        -------
        Verdict
            The decision. What is refused changes nothing.
        """
        if self._last_ns is None:
            return Verdict(False, "no state yet: offer it once the arm's state is known", 0)
        if trajectory.joint_names != self.joint_names:
            return Verdict(
                False,
                f"the trajectory is for {', '.join(trajectory.joint_names)}, this is "
                f"{', '.join(self.joint_names)}: validate it for this arm",
                0,
            )
        if self._last_accepted is not None and trajectory.repeats(self._last_accepted):
            return Verdict(
                False, f"repeat of trajectory {self.accepted_id}", self.accepted_id, repeat=True
            )
        if 0 < trajectory.stamp_ns < self._last_ns:
            late_ns = self._last_ns - trajectory.stamp_ns
            return Verdict(
                False,
                f"starts at {_seconds(trajectory.stamp_ns)}, {_seconds(late_ns)} in the past; "
                "use stamp 0 for now",
                0,
            )
        jump = self._refuse_jump(trajectory)
        return Verdict(False, jump, 0) if jump else self._accept(trajectory)

    def _refuse_jump(self, trajectory):
        """Return why the first point can't be reached from the reference at the start, or ''."""
        if trajectory.stamp_ns == 0:
            self._reference_at(self._path, self._last_ns)
        else:
            path = self._path
            if self._starting is not None:  # as if the next sample were at the last one's stamp
                self._reference_at(path, self._last_ns)
                path = self._starting
                path.begin(self._last_ns, self._scratch)
            self._reference_at(path, trajectory.stamp_ns)
        distance = np.abs(trajectory.positions[0] - self._scratch[0])
        first = int(trajectory.times_ns[0]) / _SECOND
        if first == 0.0:
            joint = int(np.argmax(distance))
            if distance[joint] <= self._start_tolerance:
                return ""
            return (
                f"points[0] at time_from_start 0 is {distance[joint]:.6g} rad from the reference "
                f"of joint {self.joint_names[joint]} at the start, more than start_tolerance "
                f"{self._start_tolerance:g} rad: give the first point a time_from_start > 0"
            )
        if self._velocity_max is None:
            return ""
        fast = np.flatnonzero(distance > first * self._velocity_max * (1.0 + SPEED_ROUNDING))
        if not fast.size:
            return ""
        joint = int(fast[0])
        return (
            f"joint {self.joint_names[joint]} would move at {distance[joint] / first:.6g} rad/s on "
            f"average to reach points[0], beyond its limit of {self._velocity_max[joint]:g} "
            "rad/s: give the first point a later time_from_start"
        )

    def _accept(self, trajectory):
        derivatives = [
            values
            for values in (trajectory.positions, trajectory.velocities, trajectory.accelerations)
            if values is not None
        ]
        path = _Path(trajectory.times_ns, derivatives, self.accepted_id + 1)
        replaced = self._pending
        self._pending = None
        if trajectory.stamp_ns == 0:
            replaced = self._starting or replaced
            self._starting = path
            reason = "starts at the next sample"
        else:
            path.start_ns = trajectory.stamp_ns
            self._pending = path
            reason = f"starts at {_seconds(trajectory.stamp_ns)}"
        if replaced is not None:
            reason += f"; replaces trajectory {replaced.trajectory_id}, which had not started"
        self.accepted_id = path.trajectory_id
        self._last_accepted = trajectory
        return Verdict(True, reason, path.trajectory_id)

    def sample(self, stamp_ns):
        """Fill `position`, `velocity`, `acceleration` and the flags for a stamp [ns].

        The same stamps after the same calls give the same bits. An earlier stamp than the last
        is allowed; before the start of what is followed, the state at that start is given.

        Raises
        ------
        TrajectoryError
            If there is no state yet.
        """
        if self._last_ns is None:
            raise TrajectoryError("no state yet: call start with the measured position first")
        pending = self._pending
        if pending is not None and stamp_ns >= pending.start_ns:
            # One that still waits for its first sample would begin after this: it never does.
            self._starting = self._pending = None
            self._follow(pending, pending.start_ns)
        elif self._starting is not None:
            starting, self._starting = self._starting, None
            self._follow(starting, stamp_ns)
        self._last_ns = stamp_ns
        path = self._path
        if path is None:
            return
        moving = path.evaluate(stamp_ns, self._state)
        of_trajectory = path.trajectory_id > 0
        self.active = moving and of_trajectory
        self.finished = not moving and of_trajectory
        self.stopping = moving and not of_trajectory

    def _follow(self, path, start_ns):
        """Leave what is followed for a path, from the reference at that moment."""
        self._reference_at(self._path, start_ns)
        path.begin(start_ns, self._scratch)
        self._path = path

    def _reference_at(self, path, stamp_ns):
        """Fill the scratch state with the reference that a path gives at a stamp."""
        if path is None:
            np.copyto(self._scratch, self._state)  # at rest: the hold since start()
        else:
            path.evaluate(stamp_ns, self._scratch)

    def stop(self, stamp_ns, deceleration):
        """Bring the reference to rest from what it is at a stamp, then hold.

        Each joint's velocity follows the cubic from its present velocity v and acceleration a to
        rest, the position its integral, over the shortest time T in which no acceleration
        exceeds D = max(deceleration, |a|): with w = v / T and v >= 0 that is
        (3 w + a)^2 = 3 D (2 w + a), from a = 0 T = 1.5 |v| / D. T is rounded up to the next
        `BRAKING_STEP`: a joint that is nearly at rest while it accelerates may move on by up to
        |a| T^2 / 12.

        All trajectories are cancelled; offered again, they are new.

        Parameters
        ----------
        stamp_ns : int
            The stamp at which braking begins [ns].
        deceleration : float or (n,) array_like
            Bound of the deceleration, greater than 0 [rad/s^2].

        Raises
        ------
        TrajectoryError
            If there is no state yet, or a deceleration is not finite and above 0.
        """
        if self._last_ns is None:
            raise TrajectoryError("no state yet: there is no reference to stop")
        bound = _decelerations(deceleration, self.joint_names)
        self._reference_at(self._path, stamp_ns)
        path = _braking_path(self._scratch, bound, self.joint_names)
        path.begin(stamp_ns, self._scratch)
        self._drop_all()
        self._path = path
        self._last_ns = max(self._last_ns, stamp_ns)


def _decelerations(deceleration, joint_names):
    """Return the decelerations as an (n,) array, all finite and above 0 [rad/s^2]."""
    try:
        values = np.broadcast_to(np.asarray(deceleration, dtype=float), (len(joint_names),))
    except _NOT_NUMBERS:
        raise TrajectoryError(
            f"deceleration is {_show(deceleration)}: give a number, or one per joint"
        ) from None
    good = (values > 0.0) & (values < np.inf)
    if not good.all():
        joint = int(np.argmin(good))
        raise TrajectoryError(
            f"deceleration of joint {joint_names[joint]} is {values[joint]} rad/s^2: it must be "
            "finite and above 0"
        )
    return values


def _braking_path(state, deceleration, joint_names):
    """Return the path that brakes every joint as `ReferenceGenerator.stop` says.

    Its points are the moments at which a joint comes to rest. Between them the polynomials are
    quartics, which the quintic interpolation reproduces.
    """
    position, velocity, acceleration = state
    a = np.where(velocity < 0.0, -acceleration, acceleration)  # along the motion
    bound = np.maximum(deceleration, np.abs(a))
    w = (bound - a + np.sqrt(bound * (bound + a))) / 3.0
    # Rounded up, all segments have at least one step: in nanoseconds the differences of nearby
    # positions would leave no digits for the accelerations.
    steps = np.maximum(np.ceil(np.abs(velocity) / w / BRAKING_STEP), 1.0)
    longest = int(np.argmax(steps))
    if not steps[longest] * BRAKING_STEP <= MAX_BRAKING:
        raise TrajectoryError(
            f"joint {joint_names[longest]} would take {steps[longest] * BRAKING_STEP:.6g} s to "
            f"stop from {velocity[longest]:.6g} rad/s, more than {MAX_BRAKING:g} s: give a higher "
            "deceleration"
        )
    durations_ns = np.rint(steps * (BRAKING_STEP * _SECOND)).astype(np.int64)
    times_ns = np.unique(durations_ns)
    length = durations_ns / _SECOND
    x = np.minimum(times_ns[:, None] / _SECOND, length)
    # Of the velocity, b_0 + b_1 x + b_2 x^2 + b_3 x^3: the cubic Hermite, one order down.
    rest = np.zeros_like(velocity)
    b0, b1, b2, b3 = _hermite(length, (velocity, acceleration), (rest, rest))
    moving = x < length
    return _Path(
        times_ns,
        (
            position + x * (b0 + x * (b1 / 2.0 + x * (b2 / 3.0 + x * b3 / 4.0))),
            np.where(moving, b0 + x * (b1 + x * (b2 + x * b3)), 0.0),
            np.where(moving, b1 + x * (2.0 * b2 + x * 3.0 * b3), 0.0),
        ),
    )
