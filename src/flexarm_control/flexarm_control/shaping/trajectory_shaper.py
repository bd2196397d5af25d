# SPDX-License-Identifier: Apache-2.0
r"""Shapes trajectories: what the node `shaper` does, without ROS.

The unshaped motion is kept as long as it still acts. A trajectory that replaces another one takes over from its own
start, and the whole is shaped, so that no vibration is left of either. The same holds for a stop: the unshaped
motion's own time slows down (see `trajectory.path.Slowing`), at most as hard as the limits of acceleration allow, and
the result is shaped. A motion with a new time law (`time_law`) needs no shaper. It stops by another time law; if a
trajectory replaces it, only the change is shaped.
"""

import copy
from dataclasses import dataclass, replace

import numpy as np

from flexarm_dynamics.errors import ParameterError, TrajectoryError
from flexarm_dynamics.parameters import parameter

from ..trajectory.path import Slowing
from ..trajectory.values import SECOND, SPEED_ROUNDING
from . import limited
from . import time_law as time_laws
from .modes import RETIMED, Modes
from .piecewise import PiecewiseMotion
from .shaped_motion import ShapedMotion

PARAMETERS = (
    parameter("velocity", [0.0], "rad/s", 0.0, 1e4, length="joints", read_only=True).described(
        "Largest speeds of the shaped motion, which is slowed down if it would exceed them; 0: not limited."
    ),
    parameter(
        "acceleration", [0.0], "rad/s^2", 0.0, 1e6, length="joints", read_only=True
    ).described(
        "Largest accelerations, likewise; 0: not limited. With a limit, trajectories must give velocities."
    ),
    parameter("jerk", [0.0], "rad/s^3", 0.0, 1e9, length="joints", read_only=True).described(
        "Largest jerks, for the time law jerk_limited."
    ),
)
#: Time laws of the unshaped motion: that of its points, or one of the two quickest of `limited`.
GIVEN, JERK_LIMITED, TIME_OPTIMAL = TIME_LAWS = "given", "jerk_limited", "time_optimal"
#: Limits that each quickest time law needs, and the library that computes it.
NEEDS = {
    JERK_LIMITED: (("velocity", "acceleration", "jerk"), "ruckig"),
    TIME_OPTIMAL: (("velocity", "acceleration"), "toppra"),
}
#: How far a point may be from the straight line of the time law jerk_limited [rad].
BESIDE = 1e-3
#: A shaped trajectory of more points is refused.
MAX_POINTS = 20_000
#: How far a first point at time 0 may be from where the joints are [rad].
START_TOLERANCE = 0.05
#: Number of attempts to slow a motion down to its limits; first and maximum fraction by which it is slowed down more
#: than needed. The fraction doubles with each attempt. A motion shaped with a slow mode comes near its limit by a
#: thousandth at a time.
ATTEMPTS, MARGIN, MOST = 60, 1e-9, 1e-3
#: Places in each piece at which its speed and acceleration are evaluated, as fractions of its length.
PLACES = np.linspace(0.0, 1.0 - 1e-6, 9)
#: Number of points of a stop, its shortest duration [s], and the ratio of the durations that are tried.
STOP_POINTS, MIN_STOP, LONGER = 24, 0.05, 1.15
#: Without limits a stop may accelerate this many times as much as the motion [-], and at least this much per rad/s of
#: speed [1/s].
STOP_ACCELERATION, STOP_RATE = 1.3, 4.0
#: If a motion replaces one under way, its first point is at least this much later than its time 0 [s].
HANDOVER = 0.01


@dataclass(frozen=True, eq=False)
class Shaped:
    """A shaped trajectory to send on.

    Attributes
    ----------
    start_ns : int
        Time from which its times count [ns].
    fresh : bool
        Whether nothing moves before `start_ns`; else it goes on from where the motion is then.
    times_ns : (k,) int64 ndarray
        Times of the points [ns].
    fields : list of (k, n) ndarrays
        Positions, then velocities and accelerations, as many as the unshaped trajectory has.
    end_ns : int
        Time at which the shaped motion ends [ns].
    added : float
        How much later it ends than the given trajectory [s].
    stretch : float
        Factor by which it was slowed down for its limits [-].
    """

    start_ns: int
    fresh: bool
    times_ns: np.ndarray
    fields: list
    end_ns: int
    added: float
    stretch: float


@dataclass(frozen=True, eq=False)
class Plan:
    """A shaped trajectory that is ready and not yet taken.

    Attributes
    ----------
    motion, quiet : PiecewiseMotion
        The unshaped motion, and the one that leaves no vibration, if there is one.
    shaped : ShapedMotion
    epoch_ns : int
        Time from which their times count [ns].
    result : Shaped
        Trajectory to send on.
    """

    motion: PiecewiseMotion
    quiet: PiecewiseMotion
    shaped: ShapedMotion
    epoch_ns: int
    result: Shaped


class TrajectoryShaper:
    """Shapes trajectories, one after the other or one into the other.

    Parameters
    ----------
    modes : Modes
    joint_names : sequence of str
        n joints.
    limits : mapping
        Checked values of `PARAMETERS`.
    time_law : str
        One of `TIME_LAWS`; all but the first need limits.

    Raises
    ------
    ParameterError
        If the time law needs a limit that is not given.
    DesignError
        If its library is not installed.
    """

    def __init__(self, modes: Modes, joint_names, limits, time_law=GIVEN):
        self.modes, self.joint_names = modes, tuple(joint_names)
        self._law, self._limits = time_law, limits
        if time_law != GIVEN:
            _refuse_without(time_law, limits)
        self._velocity, self._acceleration = (
            np.where(np.array(limits[name]) > 0.0, limits[name], np.inf)
            for name in ("velocity", "acceleration")
        )
        self._epoch_ns = 0
        self._motion = self._shaped = self._quiet = None

    @property
    def takes_long(self):
        """Whether a trajectory or a stop may take seconds to compute; then better in a thread, with a `snapshot`."""
        return self.modes.kind == RETIMED or self._law == TIME_OPTIMAL

    def snapshot(self):
        """A copy of this shaper as it is now; plans that are taken here later do not change it."""
        return copy.copy(self)

    # Where it is -----------------------------------------------------------------------------

    def _seconds(self, time_ns):
        return (time_ns - self._epoch_ns) / SECOND

    def moving(self, now_ns):
        """Whether the shaped motion is under way, or still to come."""
        return self._shaped is not None and self._seconds(now_ns) < self._shaped.end

    def state(self, now_ns):
        """Position, velocity and acceleration of the shaped motion, (3, n); None before the first trajectory."""
        if self._shaped is None:
            return None
        return self._shaped.states(np.array([self._seconds(now_ns)]))[:, 0]

    def forget(self):
        """Forget the motion, since others moved the joints; the next trajectory begins at the measured positions."""
        self._motion = self._shaped = self._quiet = None

    # Trajectories ----------------------------------------------------------------------------

    def offer(self, trajectory, now_ns, measured=None) -> Shaped:
        """Shape a trajectory, and take it at once: see `prepared`.

        Parameters
        ----------
        trajectory, now_ns, measured
            As for `prepared`.
        """
        return self.take(self.prepared(trajectory, now_ns, measured))

    def take(self, plan, now_ns=0) -> Shaped:
        """Move as planned from now on.

        Parameters
        ----------
        plan : Plan
            A plan of this shaper for the motion that is under way.
        now_ns : int
            A fresh motion that was to begin before this time begins at this time [ns].
        """
        result = plan.result
        late = max(now_ns - result.start_ns, 0) if result.fresh else 0
        self._motion, self._quiet, self._shaped = plan.motion, plan.quiet, plan.shaped
        self._epoch_ns = plan.epoch_ns + late
        return replace(
            result,
            start_ns=result.start_ns + late,
            end_ns=result.end_ns + late,
            added=result.added + late / SECOND,
        )

    def prepared(self, trajectory, now_ns, measured=None, quick=False) -> Plan:
        """Shape a trajectory, from now on or from its own start; nothing changes before it is taken.

        Parameters
        ----------
        trajectory : JointTrajectoryData
            Checked trajectory.
        now_ns : int
            [ns]
        measured : (n,) array_like, optional
            Where the joints are [rad].
        quick : bool
            Shape without a new time law: this takes only milliseconds.

        Raises
        ------
        TrajectoryError
            If it is over, can't begin where the joints are, can't be kept within the limits, or gets too many points;
            then nothing changes.
        """
        start_ns = max(trajectory.stamp_ns, now_ns) if trajectory.stamp_ns else now_ns
        moving = self.moving(now_ns)
        epoch_ns = self._epoch_ns if moving else now_ns
        start = (start_ns - epoch_ns) / SECOND
        late = (start_ns - trajectory.stamp_ns) if trajectory.stamp_ns else 0
        given = trajectory.times_ns - late
        if given[-1] < 0:
            raise TrajectoryError(
                "s ago is when it ended",
                field="header.stamp",
                value=-float(given[-1]) / SECOND,
                hint="use an earlier stamp, or 0 for now",
            )
        keep = given >= 0
        times = given[keep] / SECOND
        fields = [values[keep] for values in trajectory.fields]
        before = self._motion if moving else None
        begin = self._begin(before, start, times, fields, measured)
        if self._law != GIVEN:
            times, fields = self._quickest(begin, fields[0])
        quiet = self._replaced(start, quick) if moving else None
        motion, stretch = self._within_limits(before, quiet, begin, start, times, fields)
        now, last = (now_ns - epoch_ns) / SECOND, start + times[-1]
        motion = motion.since(now - self.modes.max_duration - 2.0 * self.modes.delay)
        fresh = before is None
        if fresh and self.modes.kind == RETIMED and not quick:
            quiet = time_laws.retimed(motion, self.modes, self._velocity, self._acceleration)
            motion = motion if quiet is None else quiet
        begin = start if fresh else now
        return self._planned(motion, quiet, epoch_ns, begin, last, stretch, fresh)

    def _replaced(self, start, quick):
        """The motion that leaves no vibration if another one takes over at `start` [s]; None if there is none."""
        if quick or self._quiet is None or self._quiet is not self._motion:
            return self._quiet
        return time_laws.stopped(self._quiet, self.modes, start, self._acceleration)

    def _begin(self, before, start, times, fields, measured):
        """State (3, n) at which the trajectory begins."""
        first = fields[0][0]
        if before is not None:
            own = np.stack([before.derivative(order, start) for order in range(3)])
        elif self._motion is not None or measured is not None:
            own = np.zeros((3, first.size))
            own[0] = self._rest(measured)
        elif times[0] > 0.0:
            raise TrajectoryError(
                "s is after the start, and where the joints are is unknown",
                field="points[0].time_from_start",
                value=float(times[0]),
                hint="begin at time 0 with where the joints are, or publish joint states",
            )
        else:
            own = np.zeros((3, first.size))
            own[0] = first
        if times[0] == 0.0:
            away = np.abs(first - own[0])
            joint = int(np.argmax(away))
            if away[joint] > START_TOLERANCE:
                raise TrajectoryError(
                    f"rad is not where the joint is: {own[0][joint]:g}",
                    field=f"points[0].positions of joint {self.joint_names[joint]}",
                    value=float(first[joint]),
                    limit=f"within {START_TOLERANCE:g}",
                    hint="begin where the joints are, or later than at time 0",
                )
            for order, values in enumerate(fields):
                own[order] = values[0]
        return own

    def _quickest(self, begin, positions):
        """Times (k,) [s] and fields (k, n) of the quickest motion from a state (3, n) through positions (k, n)."""
        points = np.vstack([begin[:1], positions])
        limits = [self._limits[name] for name in NEEDS[self._law][0]]
        if self._law == JERK_LIMITED:
            self._refuse_bent(points)
            motion = limited.jerk_limited(begin, points[-1], *limits)
        else:
            self._refuse_moving(begin)
            motion = limited.time_optimal(points, *limits)
        return motion.knots, list(motion.states(motion.knots)[: motion.fields])

    def _refuse_bent(self, points):
        """Refuse points (k, n) that are not on the straight line from the first to the last."""
        way = points[-1] - points[0]
        part = np.clip((points - points[0]) @ way / max(way @ way, 1e-300), 0.0, 1.0)
        away = np.abs(points - points[0] - part[:, None] * way)
        point, joint = np.unravel_index(int(np.argmax(away)), away.shape)
        if away[point, joint] > BESIDE:
            raise TrajectoryError(
                "rad beside the straight line to the last point",
                field=f"points[{point - 1}].positions of joint {self.joint_names[joint]}",
                value=float(away[point, joint]),
                limit=f"at most {BESIDE:g} with the time law {JERK_LIMITED}",
                hint=f"send one straight line at a time, or set time_law to {TIME_OPTIMAL}",
            )

    def _refuse_moving(self, begin):
        """Refuse a state (3, n) that is not at rest."""
        joint = int(np.argmax(np.abs(begin[1])))
        if begin[1, joint]:
            raise TrajectoryError(
                f"rad/s at the start: the time law {TIME_OPTIMAL} begins at rest",
                field=f"velocity of joint {self.joint_names[joint]}",
                value=float(begin[1, joint]),
                hint="wait for the end of the motion under way, or stop it",
            )

    def _rest(self, measured):
        """Where the joints rest (n,): the end of the last motion, unless they were moved since."""
        if self._motion is None:
            return measured
        end = self._motion.end
        moved = measured is not None and (np.abs(measured - end) > START_TOLERANCE).any()
        return measured if moved else end

    def _within_limits(self, before, quiet, begin, start, times, fields):
        """The unshaped motion, slowed down if the shaped one would exceed its limits, and the factor."""
        if np.isfinite(self._acceleration).any() and len(fields) == 1:
            raise TrajectoryError(
                "are not given: speeds step, and no limit of acceleration can be kept",
                field="points[0].velocities",
                hint="give velocities, or no limits.acceleration",
            )
        stretch = 1.0
        for attempt in range(ATTEMPTS):
            motion = _joined(before, begin, start, times * stretch, _slower(fields, stretch))
            excess = self._excess(motion, quiet, start)
            if excess <= 1.0 + SPEED_ROUNDING:
                return motion, stretch
            stretch *= excess * (1.0 + min(MARGIN * 2.0**attempt, MOST))
        raise TrajectoryError(
            "times slower is still too fast",
            field="trajectory",
            value=float(f"{stretch:.3g}"),
            hint="raise limits.velocity or limits.acceleration, or give it a start with less speed",
        )

    def _excess(self, motion, quiet, start):
        """Factor by which time must be stretched; 1 or less if the limits are kept from `start` on."""
        if np.isinf(self._velocity).all() and np.isinf(self._acceleration).all():
            return 1.0
        shaped = ShapedMotion(motion, self.modes, quiet)
        knots = shaped.knots()
        knots = knots[np.searchsorted(knots, start) :]
        lengths = np.diff(knots)[:, None] * PLACES[1]
        places = (knots[:-1, None] + np.diff(knots)[:, None] * PLACES).ravel()
        _, v, a = shaped.states(places).reshape(3, len(lengths), PLACES.size, -1)
        speed = np.abs(v).max(axis=(0, 1))
        # Between two places where the acceleration changes sign, it is taken as linear, as it is for cubic pieces.
        before, after = a[:, :-1], a[:, 1:]
        turns = before * after < 0.0
        top = v[:, :-1] + 0.5 * lengths[:, :, None] * before**2 / np.where(
            turns, before - after, np.inf
        )
        speed = np.maximum(speed, np.abs(top).max(axis=(0, 1)))
        by_speed = (speed / self._velocity).max()
        by_acceleration = np.sqrt((np.abs(a).max(axis=(0, 1)) / self._acceleration).max())
        return float(max(by_speed, by_acceleration))

    def stop(self, now_ns):
        """Stop at once: see `prepared_stop`.

        Parameters
        ----------
        now_ns : int
            [ns]

        Returns
        -------
        Shaped or None
        """
        plan = self.prepared_stop(now_ns)
        return None if plan is None else self.take(plan)

    def prepared_stop(self, now_ns, quick=False):
        """Stop on the unshaped motion's own path, and shape it; None if nothing moves.

        Parameters
        ----------
        now_ns : int
            [ns]
        quick : bool
            Stop without a new time law. A new one takes longer to compute, but stops sooner.

        Returns
        -------
        Plan or None
        """
        if not self.moving(now_ns):
            return None
        start, motion, quiet = self._seconds(now_ns), self._motion, self._quiet
        if quiet is motion and quiet is not None and not quick:
            quiet = stopped = time_laws.stopped(quiet, self.modes, start, self._acceleration)
        elif start >= motion.knots[-1]:  # only the shaper's own delay is left
            stopped = motion
        else:
            stopped = self._slowed(motion, quiet, start)
        last = stopped.knots[-1]
        return self._planned(stopped, quiet, self._epoch_ns, start, last, 1.0, fresh=False)

    def _slowed(self, motion, quiet, start):
        """The motion up to `start` [s], then along its own path to rest, no harder than allowed.

        If the shaped motion can't stop within its limits before it ends, it goes on as it is.
        """
        ahead = np.linspace(start, motion.knots[-1], 200)
        speed, acceleration = (np.abs(motion.derivative(k, ahead)).max(axis=0) for k in (1, 2))
        own = np.maximum(STOP_ACCELERATION * acceleration, STOP_RATE * speed)
        allowed = np.where(np.isfinite(self._acceleration), np.inf, own)
        duration = MIN_STOP
        while start + duration < motion.knots[-1]:
            elapsed, states = _along(motion, start, duration)
            if (np.abs(states[2]) <= allowed * (1.0 + 1e-3) + 1e-9).all():
                stopped = motion.then(
                    PiecewiseMotion.through(start + elapsed, states[: motion.fields])
                )
                if self._excess(stopped, quiet, start) <= 1.0 + SPEED_ROUNDING:
                    return stopped
            duration *= LONGER
        return motion

    def _planned(self, motion, quiet, epoch_ns, begin, last, stretch, fresh):
        """Shape a whole motion, and write its part from a time on."""
        shaped = ShapedMotion(motion, self.modes, quiet)
        knots = shaped.knots()
        knots = knots[knots > begin + (0.0 if fresh else HANDOVER)]
        if fresh:
            knots = np.concatenate([[begin], knots])
        elif not knots.size:
            knots = np.array([begin + HANDOVER])
        if knots.size > MAX_POINTS:
            raise TrajectoryError(
                "are too many after shaping",
                field="points",
                value=knots.size,
                limit=f"at most {MAX_POINTS}",
                hint="send fewer: a quintic polynomial joins them",
            )
        times_ns = np.rint((knots - begin) * SECOND).astype(np.int64)
        # At the rounded times, since between points microseconds apart the rounding would be an acceleration.
        states = shaped.states(begin + times_ns / SECOND)[: motion.fields]
        states[0][-1], states[1:, -1] = motion.end, 0.0
        begin_ns, end_ns = (epoch_ns + round(t * SECOND) for t in (begin, shaped.end))
        added = float(shaped.end - last)
        result = Shaped(begin_ns, fresh, times_ns, list(states), end_ns, added, stretch)
        return Plan(motion, quiet, shaped, epoch_ns, result)


def _refuse_without(time_law, limits):
    """Refuse a time law whose limits, a mapping, are not all given, or whose library is missing."""
    names, library = NEEDS[time_law]
    for name in names:
        joints = np.flatnonzero(np.asarray(limits[name]) <= 0.0)
        if joints.size:
            raise ParameterError(
                f"of joint {joints[0]} is not given",
                field=f"limits.{name}",
                hint=f"time_law {time_law} needs {', '.join('limits.' + n for n in names)}",
            )
    limited.library(library)


def _along(motion, start, duration):
    """Times since the stop (k,) [s], and position, velocity, acceleration (3, k, n), of a stop of a duration."""
    slowing = Slowing(duration)
    elapsed = np.linspace(0.0, duration, STOP_POINTS + 1)
    s, rate, bend = np.array([slowing.at(x) for x in elapsed]).T
    p, v, a = (motion.derivative(order, start + s) for order in range(3))
    rate, bend = rate[:, None], bend[:, None]
    return elapsed, np.stack([p, v * rate, a * rate**2 + v * bend])


def _slower(fields, stretch):
    """Positions, velocities and accelerations at a slower pace."""
    return [values / stretch**order for order, values in enumerate(fields)]


def _joined(before, begin, start, times, fields):
    """The unshaped motion: the motion `before`, then the points from a state `begin` (3, n) at `start` [s]."""
    if times[0] > 0.0:
        times = np.concatenate([[0.0], times])
        fields = [np.vstack([b, values]) for b, values in zip(begin, fields, strict=False)]
    if len(times) == 1:
        motion = PiecewiseMotion.resting(fields[0][0], start)
    else:
        motion = PiecewiseMotion.through(start + times, fields)
    return motion if before is None else before.then(motion)
