# SPDX-License-Identifier: Apache-2.0
"""Generates the reference of the joints, with holds, trajectories and stops, and the torque to add."""

import copy
from dataclasses import dataclass, replace

import numpy as np

from flexarm_dynamics.errors import TrajectoryError

from .path import FinishedPath, Path, SlowedPath, Slowing, around
from .request import JointTrajectoryData
from .scaling import ScaledPath, TimeLaw
from .values import (
    BRAKING_STEP,
    MAX_BRAKING,
    NOT_NUMBERS,
    SECOND,
    SPEED_ROUNDING,
    joint_limit,
    per_joint,
    refuse_joint,
    seconds,
)

#: Deceleration from a measured velocity, if none is given [rad/s^2].
GENTLE = 2.0
#: Minimum duration of that braking, over the period of the lowest bending mode.
BRAKING_PERIODS = 0.5
#: Braking may always take this distance [rad].
BEYOND = 0.02
#: A start that is farther ahead is assumed to be a stamp of another clock [ns].
FARTHEST_START = 3600 * SECOND
#: Maximum ratios of a stop's acceleration and jerk to the largest ones of the motion itself.
MORE = 1.15, 1.3
#: A motion that is slower than this fraction of what the joint could do is stopped faster than it would stop itself.
SLOW_FRACTION = 0.2
#: Minimum duration of a stop, over the period of the lowest bending mode: of a fast motion, and of a slow one.
PERIODS = 1.2, 1.5
#: A stop follows a motion to its end if the motion ends sooner than the stop, and goes farther than the stop by at most
#: this fraction of the stop's distance [-].
FARTHER = 0.2
#: Number of places on the remaining way at which this is judged; rounding [rad].
LOOKS, BEYOND_ROUNDING = 9, 1e-9
#: Minimum time in which speed scaling changes, or an effort fades [s].
MIN_RAMP = 0.1
#: A turn of a continuous joint [rad].
TURN = 2.0 * np.pi
#: Ratio of each duration that is tried for a stop to the one before, and the time law at the places where it is judged.
LONGER, _TABLE = 1.1, Slowing.table(33)[:, :, None]


@dataclass(frozen=True)
class Verdict:
    """The decision on an offered trajectory.

    A repeat is the last accepted trajectory again: neither an error nor a new start.
    """

    accepted: bool  # it will be followed
    reason: str  # why it is refused, or when it starts and which trajectory it replaces
    trajectory_id: int  # counted from 1; of the repeated trajectory for a repeat; 0 if refused
    repeat: bool = False
    joined: bool = False  # it is joined midway: its first points are left out


class ReferenceGenerator:
    """Generates the joints' reference: holds, follows trajectories, stops.

    The newest accepted trajectory wins. From its start on it replaces the one that is followed. A trajectory that was
    accepted earlier and has not begun is replaced at once. One exception: a trajectory that only waits for the next
    sample still begins if the newer one starts later.

    Parameters
    ----------
    joint_names : sequence of str
        The arm's n joints.
    start_tolerance : float
        How far a first point at `time_from_start` 0 may be from the reference [rad].
    velocity_max : (n,) array_like, optional
        Limit of the mean speed between the reference at the start and the first point [rad/s].
    period : float
        Period of the lowest bending mode [s]; a stop takes longer, and so hardly excites it. 0: there is no such mode.
    continuous : (n,) array_like of bool, optional
        Joints that turn without an end; a trajectory is moved by whole turns to the nearest one.

    Attributes
    ----------
    position, velocity, acceleration : (n,) arrays
        The reference at the last sampled stamp [rad], [rad/s], [rad/s^2]; overwritten in place.
    effort : (n,) array
        Torque to add there [N m].
    speed_scaling : float
        Factor on the time of trajectories, from 0 to 1; see `scale`.
    active : bool
        Whether a trajectory is being followed, from its start until its end.
    finished : bool
        Whether the trajectory last followed has reached its end, which is held.
    stopping : bool
        Whether a stop is braking.
    accepted_id : int
        The number of the last accepted trajectory; 0: none since the reset.
    joins : bool
        Whether a trajectory whose start is past, and whose end is not, is followed from now on; else it is refused.
    """

    def __init__(
        self, joint_names, start_tolerance=0.01, velocity_max=None, period=0.0, continuous=None
    ):
        self.joint_names = tuple(joint_names)
        if not 0.0 <= start_tolerance < np.inf:
            raise TrajectoryError(
                "rad is out of range",
                field="start_tolerance",
                value=start_tolerance,
                limit="finite, at least 0",
            )
        self._start_tolerance = float(start_tolerance)
        if velocity_max is not None:
            velocity_max = joint_limit("velocity_max", velocity_max, self.joint_names)
        self._velocity_max = velocity_max
        if not 0.0 <= period <= MAX_BRAKING:
            raise TrajectoryError(
                "s is out of range",
                field="period",
                value=period,
                limit=f"0 to {MAX_BRAKING:g} s",
            )
        self._period = float(period)
        n = len(self.joint_names)
        self._continuous = np.zeros(n, bool) if continuous is None else np.array(continuous, bool)
        self.joins, self.speed_scaling = False, 1.0
        self.effort = np.zeros(n)
        self._state = np.zeros((3, n))
        self._scratch, self._near = np.zeros((3, n)), np.zeros((3, n))
        self.position, self.velocity, self.acceleration = self._state
        self.reset()

    def reset(self):
        """Forget everything: the state, the trajectories and their numbers."""
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
        self.effort[:] = 0.0

    def start(self, position, stamp_ns, velocity=None, deceleration=GENTLE):
        r"""Hold a measured position, or brake from the arm's present motion; earlier trajectories are forgotten.

        With a velocity v the reference goes on in its direction from the position, and comes to rest as in `stop`,
        v T / 2 farther, after :math:`T = \max_j 35 |v_j| / (16 D_j)`, or half of `period` if that is longer. If half of
        `period` would move a joint out of the range of the trajectory that is given up, T is shorter, but not shorter
        than the first value.

        Parameters
        ----------
        position : (n,) array_like
            [rad]
        stamp_ns : int
            Stamp from which this holds [ns].
        velocity : (n,) array_like, optional
            [rad/s]; zero, or not given: hold.
        deceleration : float or (n,) array_like
            D, greater than 0 [rad/s^2].

        Raises
        ------
        TrajectoryError
            If a number can't be used, or the stop takes more than `MAX_BRAKING`.
        """
        names = self.joint_names
        position = _finite("joint_position", position, names, "rad", "hold the joint")
        path = None
        if velocity is not None:
            velocity = _finite("joint_velocity", velocity, names, "rad/s", "brake the joint")
            if velocity.any():
                bound = _decelerations(deceleration, names)
                shortest = self._least_braking(position, velocity)
                path = _straight(position, velocity, bound, stamp_ns, shortest, names)
        self._drop_all()
        self._state[:] = 0.0
        self._state[0] = position
        if path is not None:
            self._state[1] = velocity
            self._path, self.stopping = path, True
        self._last_ns = stamp_ns

    def _least_braking(self, position, velocity):
        """Minimum braking time of `start` that protects the links [s]; shorter if it leads out of the trajectory."""
        least = BRAKING_PERIODS * self._period
        if not (self.active and least > 0.0):
            return least
        places = np.vstack([self._path.places, self._path.end])
        left = np.where(
            velocity > 0.0, places.max(axis=0) - position, position - places.min(axis=0)
        )
        speed, left = np.abs(velocity), np.maximum(left, BEYOND)
        beyond = 0.5 * speed * least > left
        return float((2.0 * left[beyond] / speed[beyond]).min(initial=least))

    def offer(self, trajectory: JointTrajectoryData, judge=None) -> Verdict:
        """Accept a validated trajectory, or return why it is refused; then it changes nothing.

        ``judge(trajectory, start)`` may refuse it with a `TrajectoryError`, too; `start` is that of `start_of`.
        """
        if self.repeats(trajectory):
            return Verdict(
                False, f"repeat of trajectory {self.accepted_id}", self.accepted_id, repeat=True
            )
        try:
            ahead = self.ahead(trajectory)
            self._check(ahead)
            if judge is not None:
                judge(ahead, self._scratch.copy())
        except TrajectoryError as error:
            return Verdict(False, str(error), 0)
        verdict = self._accept(ahead)
        self._last_accepted = trajectory
        if ahead.stamp_ns != trajectory.stamp_ns:
            late = seconds(self._last_ns - trajectory.stamp_ns)
            reason = f"joined {late} after its start: {verdict.reason}"
            verdict = replace(verdict, reason=reason, joined=True)
        return verdict

    def ahead(self, trajectory):
        """The trajectory as it is followed: continuous joints go the short way; a joined one loses its past points.

        A trajectory that is joined (see `joins`) starts now, without its past points. If the arm is not on its path
        within the start tolerance, it has at least the lowest mode's period to get there: earlier points are left out,
        except for the last one. If nothing changes, this is the trajectory itself. Any thread may ask.
        """
        now, start = self._last_ns, trajectory.stamp_ns
        if now is None or trajectory.joint_names != self.joint_names:
            return trajectory  # `_check` refuses it
        late = self.joins and 0 < start < now and now - start < trajectory.times_ns[-1]
        if not (late or self._continuous.any()):
            return trajectory
        here = self.start_of(0 if late else start)
        if not late:
            return self._short_way(trajectory, trajectory.positions[0], here[0])
        state = np.zeros((3, len(self.joint_names)))
        path = Path.of(trajectory)
        path.begin(start, np.array([trajectory.positions[0], state[1], state[2]]))
        path.evaluate(now, state)
        away = state[0] - here[0]
        away -= self._turns(away)
        on_its_way = (np.abs(away) <= self._start_tolerance).all()
        left = rest_of(trajectory, now, 0.0 if on_its_way else self._period)
        return self._short_way(left, state[0], here[0])

    def _turns(self, angle):
        """Whole turns of the continuous joints in an angle (n,) [rad]."""
        return np.where(self._continuous, TURN * np.round(angle / TURN), 0.0)

    def _short_way(self, trajectory, first, here):
        """The trajectory moved by whole turns, so that `first` is near to `here`, each (n,) [rad]."""
        turns = self._turns(first - here)
        if not turns.any():
            return trajectory
        positions = trajectory.positions - turns
        positions.flags.writeable = False
        first = None if trajectory.first is None else trajectory.first - turns
        return replace(trajectory, positions=positions, first=first)

    def repeats(self, trajectory):
        """Whether a trajectory is the last accepted one again."""
        return self._last_accepted is not None and trajectory.repeats(self._last_accepted)

    def start_of(self, stamp_ns):
        """State (3, n) that a trajectory with `stamp_ns` (0: now) starts from; None while there is none.

        It works on a copy, so any thread may ask. For stamp 0 the reference goes on until the trajectory is offered.
        """
        if self._last_ns is None:
            return None
        other = copy.deepcopy(self)
        other._reference_at_start(stamp_ns)
        return other._scratch

    @property
    def path(self):
        """The `Path` that is followed, or was to its end; None while a position is held."""
        return self._path

    @property
    def stamp_ns(self):
        """The last sampled stamp [ns]."""
        return self._last_ns

    @property
    def rate(self):
        """How fast the time of trajectories goes at the last stamp [-], on its way to `speed_scaling`."""
        path = self._path
        if path is not None and path.scaled and path.trajectory_id and self.active:
            return path.law.at(self._last_ns)[1]
        return self.speed_scaling

    @property
    def resting(self):
        """State (3, n) of a reference that will not move until a new trajectory comes; None while it will."""
        if self.pending or self.active or self.stopping or self._last_ns is None:
            return None
        return self._state.copy()

    @property
    def pending(self):
        """Whether an accepted trajectory has not begun."""
        return self._pending is not None or self._starting is not None

    def overdue(self, stamp_ns):
        """Whether a trajectory with an explicit start waits, and a stamp is past that start."""
        return self._pending is not None and stamp_ns > self._pending.start_ns

    def _check(self, trajectory):
        """Refuse a trajectory that can't be followed from here."""
        if self._last_ns is None:
            raise TrajectoryError("no state yet", hint="offer it once the arm's state is known")
        if trajectory.joint_names != self.joint_names:
            raise TrajectoryError(
                "are not the joints of this arm",
                field="joint_names",
                value=trajectory.joint_names,
                limit=", ".join(self.joint_names),
                hint="validate it for this arm",
            )
        if 0 < trajectory.stamp_ns < self._last_ns:
            raise TrajectoryError(
                f"ns is {seconds(self._last_ns - trajectory.stamp_ns)} in the past"
                f"{', and so is its end' if self.joins else ''}: the arm's clock shows {seconds(self._last_ns)}",
                field="header.stamp",
                value=trajectory.stamp_ns,
                hint="use stamp 0 for now",
            )
        if trajectory.stamp_ns - self._last_ns > FARTHEST_START:
            raise TrajectoryError(
                f"ns is {seconds(trajectory.stamp_ns - self._last_ns)} ahead: the arm's clock shows"
                f" {seconds(self._last_ns)}, and the stamp may be of another clock",
                field="header.stamp",
                value=trajectory.stamp_ns,
                limit=f"{seconds(FARTHEST_START)} ahead",
                hint="use stamp 0 for now, or a stamp of arm_state plus the wait",
            )
        self._reference_at_start(trajectory.stamp_ns)
        at_once = trajectory.first is not None
        first = trajectory.first if at_once else trajectory.positions[0]
        distance = np.abs(first - self._scratch[0])
        time = 0.0 if at_once else int(trajectory.times_ns[0]) / SECOND
        field, names = "points[0].positions", self.joint_names
        if time == 0.0:
            far = distance > self._start_tolerance
            problem = "rad away from the reference, at time_from_start 0, is beyond start_tolerance"
            hint = "give the first point a time_from_start > 0"
            refuse_joint(field, far, distance, names, problem, self._start_tolerance, hint)
        elif self._velocity_max is not None:
            limit = self._velocity_max
            fast = distance > time * limit * (1.0 + SPEED_ROUNDING)
            problem = "rad/s on average from the reference is beyond the speed limit"
            hint = "give the first point a later time_from_start"
            refuse_joint(field, fast, distance / time, names, problem, limit, hint)

    def _reference_at_start(self, stamp_ns):
        """Fill the scratch state with the reference that a trajectory of this stamp starts from."""
        if stamp_ns == 0:
            self._reference_at(self._path, self._last_ns)
            return
        path = self._path
        if self._starting is not None:  # it is assumed to begin at the last sample's stamp
            self._reference_at(path, self._last_ns)
            path = self._starting
            path.begin(self._last_ns, self._scratch)
        self._reference_at(path, stamp_ns)

    def _accept(self, trajectory):
        path = Path.of(trajectory, self.accepted_id + 1)
        replaced = self._pending
        self._pending = None
        if trajectory.stamp_ns == 0:
            replaced = self._starting or replaced
            self._starting = path
            reason = "starts at the next sample"
        else:
            path.start_ns = trajectory.stamp_ns
            self._pending = path
            reason = f"starts at {seconds(trajectory.stamp_ns)}"
        if replaced is not None:
            reason += f"; replaces trajectory {replaced.trajectory_id}, which had not started"
        self.accepted_id = path.trajectory_id
        return Verdict(True, reason, path.trajectory_id)

    def sample(self, stamp_ns):
        """Fill `position`, `velocity`, `acceleration` and the flags for a stamp `stamp_ns` of the arm's clock [ns].

        The same stamps after the same calls give the same bits. A stamp may be earlier than the last; before the start
        of the followed trajectory, the reference is the state at that start.
        """
        if self._last_ns is None:
            hint = "call start with the measured position first"
            raise TrajectoryError("no state yet", hint=hint)
        pending = self._pending
        if pending is not None and stamp_ns >= pending.start_ns:
            # A trajectory that still waits for its first sample would begin later: it is dropped.
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
        if path.pushes:
            path.effort(stamp_ns, self.effort)
        else:
            self.effort[:] = 0.0
        of_trajectory = path.trajectory_id > 0
        self.active = moving and of_trajectory
        self.finished = not moving and of_trajectory
        self.stopping = moving and not of_trajectory

    def near(self, offset):
        """State (position, velocity, acceleration), (3, n), at an `offset` [s] from the last sampled stamp.

        It is on the polynomial of that stamp, continued beyond its ends, so that derivatives of the reference can be
        computed. Overwritten by the next call.
        """
        if self._path is None:
            np.copyto(self._near, self._state)
        else:
            self._path.near(self._last_ns, offset, self._near)
        return self._near

    def around(self, step, out):
        """Fill `out` (p, 3, n) with states at offsets `step` [s] apart, as of `near`; the middle one is 0."""
        if self._path is None:
            out[:] = self._state
        else:
            around(self._path, self._last_ns, 0.0, step, out)

    def _follow(self, path, start_ns):
        """Change to a path, from the reference at its start and with the factor on the time."""
        before, factor = self._path, self.speed_scaling
        law = TimeLaw(start_ns, 0.0, factor)
        if before is not None and before.scaled and before.trajectory_id:
            begin, law = before.own(start_ns), before.law.since(start_ns)
        else:
            moving = self._moves_at(start_ns)
            begin = self._scratch
            if moving and factor != 1.0:
                law = TimeLaw(start_ns).changed(start_ns, factor, max(self._period, MIN_RAMP))
        path.begin(start_ns, begin, self._effort_at(start_ns))
        scaled = law.ramps or law.level != 1.0
        self._path = ScaledPath(path, law) if scaled else path

    def _effort_at(self, stamp_ns):
        """Effort (n,) of the path that is followed at a stamp [N m]."""
        out = np.zeros_like(self.effort)
        if self._path is not None and self._path.pushes:
            self._path.effort(stamp_ns, out)
        return out

    def scale(self, factor, deceleration=GENTLE, given=True):
        """Let the time of trajectories go at a factor from 0 to 1 from now on; see module `scaling`.

        A trajectory that is followed changes to the factor within the time of a `stop`. Stops are not scaled.

        Parameters
        ----------
        factor : float
            [-]; 0: the arm rests on its way.
        deceleration : float or (n,) array_like
            As for `stop` [rad/s^2].
        given : bool or (n,) array_like of bool
            As for `stop`.

        Raises
        ------
        TrajectoryError
            If the factor is not within 0 and 1; then nothing changes.
        """
        if not 0.0 <= factor <= 1.0:
            raise TrajectoryError(
                "is out of range", field="speed_scaling", value=factor, limit="0 to 1"
            )
        if factor == self.speed_scaling:
            return
        self.speed_scaling, path = float(factor), self._path
        if path is None or not (path.trajectory_id and self.active):
            return
        now = self._last_ns
        bound = _decelerations(deceleration, self.joint_names)
        limits = _limits(path, bound, np.asarray(given, dtype=bool), self._period)
        try:
            duration = _braking_time(path, now, *limits) / SECOND
        except TrajectoryError:  # a stop would fail here, but a slower motion is possible
            duration = MAX_BRAKING
        law = path.law if path.scaled else TimeLaw(now, path.elapsed(now))
        law = law.changed(now, self.speed_scaling, max(duration, MIN_RAMP))
        self._path = ScaledPath(path.followed, law, min(path.kept, path.pace(now)))

    def look_at(self, stamp_ns):
        """State (3, n) of the present or coming reference at a stamp `stamp_ns` [ns]; None while there is none.

        From its start on, an accepted trajectory that waits gives the state. The call changes nothing.
        """
        if self._last_ns is None:
            return None
        self._reference_at_start(stamp_ns)
        pending, state = self._pending, self._scratch
        if pending is not None and stamp_ns >= pending.start_ns:
            self._reference_at_start(pending.start_ns)
            pending.begin(pending.start_ns, self._scratch, self._effort_at(pending.start_ns))
            pending.evaluate(stamp_ns, state)
        return state.copy()

    def _reference_at(self, path, stamp_ns):
        """Fill the scratch state with the reference that a path gives at a stamp."""
        if path is None:
            np.copyto(self._scratch, self._state)  # at rest: the hold since start()
        else:
            path.evaluate(stamp_ns, self._scratch)

    def stop(self, stamp_ns, deceleration, given=True):
        """Bring the reference to rest along its path, then hold; cancel all trajectories.

        The trajectory's own time is slowed down (module `path`) over a time T of at least `PERIODS` of the lowest
        bending mode. T is the first value of a geometric sequence with which, on all of the way,

        - if the deceleration D is given: slowing down takes at most D,
        - otherwise: acceleration and jerk are at most `MORE` times the motion's own largest, or, for a slow motion,
          what slowing down with `SLOW_FRACTION` D takes.

        The bounds hold for every joint. If the trajectory ends before the stop, without a jump, and no more than
        `FARTHER` of the stop's distance farther, it is followed to its end at its own speed. Any other trajectory that
        ends before the stop ends the stop, too. A stop within a stop only cancels trajectories that wait.

        Parameters
        ----------
        stamp_ns : int
            The stamp at which braking begins [ns].
        deceleration : float or (n,) array_like
            D, greater than 0 [rad/s^2].
        given : bool or (n,) array_like of bool
            Whether D was requested; otherwise it is what the joint could do.

        Raises
        ------
        TrajectoryError
            If there is no state yet, a deceleration is not finite and above 0, or the stop takes more than
            `MAX_BRAKING`.
        """
        if self._last_ns is None:
            raise TrajectoryError("no state yet", hint="there is no reference to stop")
        bound = _decelerations(deceleration, self.joint_names)
        effort = self._effort_at(stamp_ns)
        moving, path = self._moves_at(stamp_ns), self._path
        if moving and path.trajectory_id:
            limits = _limits(path, bound, np.asarray(given, dtype=bool), self._period)
            path = _stopped(path, stamp_ns, _braking_time(path, stamp_ns, *limits))
        elif not moving and effort.any():
            path, moving = self._fading(effort, stamp_ns), True
        self._drop_all()
        self.effort[:] = effort
        self._path = path if moving else None
        self.stopping = moving
        if not moving:
            np.copyto(self._state, self._scratch)
        self._last_ns = max(self._last_ns, stamp_ns)

    def _fading(self, effort, stamp_ns):
        """A path at rest in the scratch state, on which an effort fades."""
        time_ns = round(max(self._period, MIN_RAMP) * SECOND)
        path = Path([time_ns], [self._scratch[:1].copy()])
        path.begin(stamp_ns, self._scratch, effort)
        return path

    def _moves_at(self, stamp_ns):
        """Whether the reference moves at a stamp; its state goes to the scratch state."""
        path, state = self._path, self._scratch
        if path is None:
            np.copyto(state, self._state)
            return False
        return path.evaluate(stamp_ns, state) and bool(state[1:].any())


def rest_of(trajectory, now_ns, least):
    """The points of a trajectory that are at least a time `least` ahead, or its last point, as one that starts now.

    Parameters
    ----------
    trajectory : JointTrajectoryData
        It ends after `now_ns`.
    now_ns : int
        [ns]
    least : float
        [s]
    """
    times_ns = trajectory.times_ns - (now_ns - trajectory.stamp_ns)
    first = int(np.searchsorted(times_ns, max(round(least * SECOND), 1)))
    left = slice(min(first, times_ns.size - 1), None)
    kept = {
        name: values[left]
        for name in ("positions", "velocities", "accelerations", "effort")
        if (values := getattr(trajectory, name)) is not None
    }
    return replace(trajectory, stamp_ns=now_ns, times_ns=times_ns[left], first=None, **kept)


def _decelerations(deceleration, joint_names):
    """Return the decelerations as an (n,) array, all finite and above 0 [rad/s^2]."""
    field = "deceleration"
    try:
        values = np.broadcast_to(np.asarray(deceleration, dtype=float), (len(joint_names),))
    except NOT_NUMBERS:
        hint = "give a number, or one per joint"
        raise TrajectoryError("is no number", field=field, value=deceleration, hint=hint) from None
    bad = ~((values > 0.0) & (values < np.inf))
    refuse_joint(field, bad, values, joint_names, "rad/s^2 is out of range", "finite, above 0")
    return values


def _finite(field, values, joint_names, unit, need):
    """Return one finite number per joint, (n,)."""
    values = per_joint(field, values, joint_names)
    problem, hint = f"{unit} is not finite", f"it is needed to {need}"
    refuse_joint(field, ~np.isfinite(values), values, joint_names, problem, hint=hint)
    return values


def _straight(position, velocity, deceleration, stamp_ns, shortest, joint_names):
    """The path of `ReferenceGenerator.start` with a velocity."""
    times = Slowing.MAX_SLOPE * np.abs(velocity) / deceleration
    problem, hint = "s to stop is too long", "give a higher deceleration"
    slow = ~(times <= MAX_BRAKING)
    refuse_joint("braking time", slow, times, joint_names, problem, MAX_BRAKING, hint)
    duration_ns = round(max(times.max(), shortest, BRAKING_STEP) * SECOND)
    ahead = Path([duration_ns], [(position + velocity * (duration_ns / SECOND))[None]])
    ahead.begin(stamp_ns, np.array([position, velocity, 0.0 * velocity]))
    return SlowedPath(ahead, stamp_ns, duration_ns)


def _limits(path, deceleration, given, period):
    """Limits of a stop: bounds (n,) of slowing down, acceleration [rad/s^2] and jerk [rad/s^3]; minimum time [s]."""
    speed, acceleration, jerk = path.peaks()
    slow = SLOW_FRACTION * deceleration
    # Time scale of the motion itself [s].
    scale = np.divide(speed, acceleration, out=np.zeros_like(speed), where=acceleration > 0.0).max()
    low, high = (factor * period for factor in PERIODS)
    shortest = max(min(max(low, 1.2 * scale or np.inf), high), BRAKING_STEP)
    # Jerk of a stop that has this deceleration and the shortest time.
    with np.errstate(over="ignore"):  # infinite is no bound
        quick = slow * Slowing.MAX_BEND / (Slowing.MAX_SLOPE * shortest)
    bounds = (
        np.where(given, deceleration, np.inf),
        np.where(given, np.inf, np.maximum(MORE[0] * acceleration, slow)),
        np.where(given, np.inf, np.maximum(MORE[1] * jerk, quick)),
    )
    return bounds, shortest


def _stopped(path, stamp_ns, duration_ns):
    """The path of a stop from a stamp on, with a duration, both in [ns]; see module `path`."""
    slowed = SlowedPath(path, stamp_ns, duration_ns)
    left_ns = path.start_ns + path.duration_ns - stamp_ns
    if path.scaled or left_ns > duration_ns or not path.ends_smoothly:
        return slowed
    begin, end = slowed.begin_state[0], slowed.end
    state, beyond = np.zeros((3, begin.size)), np.zeros_like(begin)
    for ahead_ns in np.linspace(0.5 * min(duration_ns, 2 * left_ns), left_ns, LOOKS).astype(int):
        path.near(stamp_ns + int(ahead_ns), 0.0, state)
        np.maximum(beyond, np.abs(state[0] - end), out=beyond)
    finishes = (beyond <= FARTHER * np.abs(end - begin) + BEYOND_ROUNDING).all()
    return FinishedPath(path, stamp_ns) if finishes else slowed


def _braking_time(path, stamp_ns, limits, shortest):
    """Time of a stop from a stamp on [ns], as in `ReferenceGenerator.stop`."""
    begin, rate = max(path.elapsed(stamp_ns), 0.0), path.rate(stamp_ns)
    rates = np.array([rate, rate**2, rate**3])[:, None, None]

    def fits(time):
        covered, speed, change, bend = _TABLE
        v, a, j = rates * path.derivatives(begin + rate * time * covered[:, 0])
        slowing = v * (change / time)
        total = a * speed**2 + slowing
        jerk = j * speed**3 + 3.0 * a * speed * change / time + v * bend / time**2
        found = (slowing, total, jerk)
        return all((np.abs(x) <= y).all() for x, y in zip(found, limits, strict=True))

    time = shortest
    while not fits(time):
        time *= LONGER
        if time > MAX_BRAKING:
            if begin + rate * MAX_BRAKING < path.duration_ns / SECOND:
                raise TrajectoryError(
                    "s are not enough for a stop",
                    field="braking time",
                    value=MAX_BRAKING,
                    hint="give a higher deceleration",
                )
            break  # the path itself ends before that
    return round(time * SECOND)
