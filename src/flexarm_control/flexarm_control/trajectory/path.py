# SPDX-License-Identifier: Apache-2.0
r"""Piecewise polynomials through the points of a trajectory, and stops along them.

A stop slows down the trajectory's own time: the reference is :math:`q_r(s(t))`, with :math:`\dot s` from 1 to 0. The
arm stays on its path, and is never faster than the motion. Over the stop's duration T, with x = t / T,

.. math:: \dot s = 1 - S(x), \qquad S(x) = 35 x^4 - 84 x^5 + 70 x^6 - 20 x^7,

whose first three derivatives are zero at both ends. Acceleration, jerk and snap of the reference,

.. math::
    \ddot q &= q_r^{(2)}\dot s^2 + q_r^{(1)}\ddot s \\
    q^{(3)} &= q_r^{(3)}\dot s^3 + 3 q_r^{(2)}\dot s\ddot s + q_r^{(1)} s^{(3)},

are then as continuous as those of the trajectory. So a slow manifold, which depends on them, moves without a step.

If a trajectory ends before such a stop would end, and hardly farther, it is followed to its end at its own speed. It
then comes to rest sooner, and the motion is the one that was planned for the links.
"""

import math

import numpy as np

from .. import kernels
from .values import SECOND

#: Places of a polynomial at which its acceleration and jerk are evaluated, as fractions of its length.
PLACES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
#: Velocity and acceleration at a smooth end are at most this fraction of the largest ones on the path [-].
SMOOTH = 1e-6


def hermite(duration, before, after):
    """Return the coefficients of the polynomials between two states.

    Each polynomial has degree 2m - 1 and meets m given derivatives at either end (m = 1: linear,
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


def _derivatives(coefficients, x):
    """Velocity, acceleration and jerk, (3, k, n), of polynomials (k, order, n) at x (k, 1) [s]."""
    order = coefficients.shape[1]
    out = np.zeros((3, len(coefficients), coefficients.shape[2]))
    for nu in range(1, 4):
        for i in reversed(range(nu, order)):
            out[nu - 1] *= x
            out[nu - 1] += math.perm(i, nu) * coefficients[:, i]
    return out


def _peaks(coefficients, lengths):
    """Largest speed, acceleration and jerk, (3, n), of polynomials (k, order, n) over lengths (k, 1) [s]."""
    found = np.zeros((3, coefficients.shape[2]))
    for fraction in PLACES:
        size = np.abs(_derivatives(coefficients, fraction * lengths)).max(axis=1)
        np.maximum(found, size, out=found)
    return found


class Path:
    """A piecewise polynomial from the reference at its start to its last point.

    Knot 0 is the start, knot i the i-th point; segment i leads from knot i to knot i + 1. `begin`
    computes the coefficients of the first segment, when the reference at the start is known; the
    constructor computes all others. With a first point at time 0, segment 0 has no length and is
    never evaluated.

    Parameters
    ----------
    times_ns : (k,) int64 array
        Times of the points from the start [ns].
    derivatives : sequence of m (k, n) arrays
        Positions, then velocities, then accelerations.
    trajectory_id : int
        Number of the path's trajectory; 0: a stop.
    coast : Coast, optional
        How it comes to rest after a last point that moves.
    effort : (k, n) array, optional
        Effort at the points [N m], linear between them and from the start's; the last one is held, or fades in the
        coast.

    """

    #: Whether the path's time differs from the arm's.
    scaled = False
    #: Largest fraction of a plan's bending beside the slow manifold that may still be there [-].
    kept = 1.0
    #: Number of the piece after the end, where the last state is held.
    END = -1

    def __init__(self, times_ns, derivatives, trajectory_id=0, coast=None, effort=None):
        k, n = derivatives[0].shape
        order = 2 * len(derivatives)
        self._efforts = None if effort is None else np.vstack([np.zeros(n), effort])
        self.trajectory_id = trajectory_id
        self.start_ns = 0
        self.begin_state = np.zeros((3, n))
        self.duration_ns = int(times_ns[-1])
        self._rest_peaks = np.zeros((3, n))
        self._first = [values[0] for values in derivatives]
        self._end = np.zeros((3, n))
        self._end[0] = derivatives[0][-1]
        self._knots_ns = np.concatenate(([0], times_ns))
        self._coefficients = np.zeros((k, order, n))
        if k > 1:
            lengths = (np.diff(times_ns) / SECOND)[:, None]
            before = [values[:-1] for values in derivatives]
            after = [values[1:] for values in derivatives]
            for i, values in enumerate(hermite(lengths, before, after)):
                self._coefficients[1:, i] = values
            self._rest_peaks = _peaks(self._coefficients[1:], lengths)
        if coast is not None:
            self._add(coast, [values[-1] for values in derivatives])
        order = self._coefficients.shape[1]
        # Coefficients of the current segment, for position, velocity and acceleration side by side,
        # so that one Horner scheme evaluates all three. d/dx of sum c_i x^i has (i + 1) c_{i+1}.
        self._stack = np.zeros((order, 3, n))
        self._once = np.arange(1.0, order)[:, None]
        self._twice = self._once[:-1] * self._once[1:]
        # The last evaluated state. Most stamps are evaluated twice: by the look ahead and by the sample.
        self._last = np.zeros((3, n))
        self._forget_segment()

    @classmethod
    def of(cls, trajectory, trajectory_id=0):
        """The path of a `JointTrajectoryData`, with a number."""
        return cls(
            trajectory.times_ns,
            trajectory.fields,
            trajectory_id,
            trajectory.coast,
            trajectory.effort,
        )

    def _add(self, coast, last):
        """Come to rest after the `last` point: its position, velocity and perhaps acceleration, each (n,)."""
        pieces, self._end[0] = coast.coefficients(*last, *[0.0 * last[0]] * (3 - len(last)))
        more, (k, order, n) = np.array(pieces), self._coefficients.shape
        before = self._coefficients
        self._coefficients = np.zeros((k + len(more), max(order, more.shape[1]), n))
        self._coefficients[:k, :order] = before
        self._coefficients[k:, : more.shape[1]] = more
        times = np.cumsum(coast.times_ns)
        lengths = np.array(coast.times_ns)[:, None] / SECOND
        np.maximum(self._rest_peaks, _peaks(more, lengths), out=self._rest_peaks)
        if self._efforts is not None:
            held = [self._efforts[-1]] * (len(times) - 1)
            self._efforts = np.vstack([self._efforts, *held, np.zeros(n)])
        self._knots_ns = np.concatenate((self._knots_ns, self.duration_ns + times))
        self.duration_ns = int(self._knots_ns[-1])

    @property
    def followed(self):
        """The path that is followed: this one."""
        return self

    @property
    def pushes(self):
        """Whether there is an effort on the way."""
        return self._efforts is not None

    def effort(self, stamp_ns, out):
        """Fill `out` (n,) with the effort at a stamp [N m]."""
        elapsed_ns = min(max(stamp_ns - self.start_ns, 0), self.duration_ns)
        knots = self._knots_ns
        i = min(int(np.searchsorted(knots, elapsed_ns, side="right")), len(knots) - 1)
        x = (elapsed_ns - knots[i - 1]) / max(knots[i] - knots[i - 1], 1)
        out[:] = (1.0 - x) * self._efforts[i - 1] + x * self._efforts[i]

    def rate(self, stamp_ns):
        """How fast the path's time goes [-]."""
        return 1.0

    def elapsed(self, stamp_ns):
        """Time of this path at a stamp, from its start [s]."""
        return (stamp_ns - self.start_ns) / SECOND

    def pace(self, stamp_ns, offset=0.0):
        """How fast the time of the path that is followed goes, `offset` [s] from a stamp [-]."""
        return 1.0

    def piece(self, stamp_ns):
        """Number of the polynomial at a stamp; `END` at the end and after it."""
        elapsed_ns = max(stamp_ns - self.start_ns, 0)
        if elapsed_ns >= self.duration_ns:
            return self.END
        if not self._low_ns <= elapsed_ns < self._high_ns:
            self._enter_segment(elapsed_ns)
        return self._segment

    def peaks(self):
        """Largest speed, acceleration and jerk of every joint on the path, (3, n) [rad/s], [rad/s^2], [rad/s^3].

        Jumps between polynomials are left out. Six places of each polynomial are evaluated, so that the values are
        right to a few thousandths.
        """
        first = self._knots_ns[1:2, None] / SECOND
        return np.maximum(_peaks(self._coefficients[:1], first), self._rest_peaks)

    @property
    def ends_smoothly(self):
        """Whether velocity and acceleration are zero at the end, compared with the largest on the path."""
        last = _derivatives(self._coefficients[-1:], self.lengths[-1:, None])[:2, 0]
        return bool((np.abs(last) <= SMOOTH * self.peaks()[:2]).all())

    @property
    def starts(self):
        """Where each polynomial begins, from the start of the path, (k,) [s]."""
        return self._knots_ns[:-1] / SECOND

    @property
    def lengths(self):
        """Duration of each polynomial, (k,) [s]."""
        return np.diff(self._knots_ns) / SECOND

    @property
    def places(self):
        """Positions at which the polynomials begin, (k, n) [rad]."""
        return self._coefficients[:, 0]

    @property
    def end(self):
        """Position that is held after the end, (n,) [rad]."""
        return self._end[0]

    def at_places(self, pieces, fractions):
        """Position, velocity and acceleration, (k, p, 3, n), of k `pieces` at p `fractions` of their lengths."""
        c, lengths = self._coefficients[pieces], self.lengths[pieces][:, None]
        out = np.empty((len(c), len(fractions), 3, c.shape[2]))
        for i, fraction in enumerate(fractions):
            x = fraction * lengths
            out[:, i, 0] = sum(c[:, k] * x**k for k in range(c.shape[1]))
            out[:, i, 1], out[:, i, 2], _ = _derivatives(c, x)
        return out

    def derivatives(self, elapsed):
        """Velocity, acceleration and jerk, (3, k, n), at times (k,) from the start [s]; zero after the end."""
        elapsed_ns = np.clip(np.rint(elapsed * SECOND), 0.0, self.duration_ns).astype(np.int64)
        over = elapsed_ns >= self.duration_ns
        segment = np.searchsorted(self._knots_ns, elapsed_ns, side="right") - 1
        segment[over] = 0
        x = ((elapsed_ns - self._knots_ns[segment]) / SECOND)[:, None]
        out = _derivatives(self._coefficients[segment], x)
        out[:, over] = 0.0
        return out

    def _forget_segment(self):
        self._segment, self._low_ns, self._high_ns = -1, 0, 0
        self._last_ns = -1

    def begin(self, start_ns, reference, effort=None):
        """Start at a stamp [ns] from a (3, n) reference state and an effort (n,), if any; may be called again."""
        self.start_ns = start_ns
        if effort is not None and self._efforts is None and effort.any():
            self._efforts = np.zeros((len(self._knots_ns), effort.size))
        if self._efforts is not None:
            self._efforts[0] = 0.0 if effort is None else effort
        self.begin_state = np.array(reference)
        self._forget_segment()
        length_ns = int(self._knots_ns[1])
        if length_ns > 0:
            before = reference[: len(self._first)]
            for i, values in enumerate(hermite(length_ns / SECOND, before, self._first)):
                self._coefficients[0, i] = values

    def evaluate(self, stamp_ns, out):
        """Fill `out` (3, n) with the state at a stamp; return whether it is before the end."""
        elapsed_ns = stamp_ns - self.start_ns
        if elapsed_ns < 0:
            elapsed_ns = 0  # before the start: the state at the start
        if elapsed_ns >= self.duration_ns:
            np.copyto(out, self._end)
            return False
        if elapsed_ns == self._last_ns:
            np.copyto(out, self._last)
            return True
        if not self._low_ns <= elapsed_ns < self._high_ns:
            self._enter_segment(elapsed_ns)
        self._horner((elapsed_ns - self._low_ns) / SECOND, out)
        np.copyto(self._last, out)
        self._last_ns = elapsed_ns
        return True

    def near(self, stamp_ns, offset, out):
        """Fill `out` (3, n) with the state `offset` [s] from `stamp_ns`, on the polynomial at that stamp.

        Returns whether the stamp is before the end. After it the state is that of the end, at any offset.
        """
        elapsed_ns = max(stamp_ns - self.start_ns, 0)
        if elapsed_ns >= self.duration_ns:
            np.copyto(out, self._end)
            return False
        if not self._low_ns <= elapsed_ns < self._high_ns:
            self._enter_segment(elapsed_ns)
        self._horner((elapsed_ns - self._low_ns) / SECOND + offset, out)
        return True

    def around(self, stamp_ns, offset, step, out):
        """Fill `out` (p, 3, n) with states as of `near`, at offsets `step` [s] apart; the middle one is `offset`."""
        elapsed_ns = max(stamp_ns - self.start_ns, 0)
        if elapsed_ns >= self.duration_ns:
            out[:] = self._end
            return
        if not self._low_ns <= elapsed_ns < self._high_ns:
            self._enter_segment(elapsed_ns)
        x = (elapsed_ns - self._low_ns) / SECOND + offset
        kernels.compiled().horners(self._stack, x, step, out)

    def _horner(self, x, out):
        kernels.compiled().horner(self._stack, x, out)

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


def around(path, stamp_ns, offset, step, out):
    """As `Path.around`, for any path."""
    if type(path) is Path:
        path.around(stamp_ns, offset, step, out)
        return
    centre = len(out) // 2
    for i, state in enumerate(out):
        path.near(stamp_ns, offset + (i - centre) * step, state)


class Slowing:
    """Time law of a stop: s(t) with its derivatives, from s' = 1 to rest; see the module.

    Parameters
    ----------
    duration : float
        T [s].
    """

    #: Largest S', at x = 1/2, and largest S'' [-].
    MAX_SLOPE, MAX_BEND = 35.0 / 16.0, 84.0 / 25.0 * math.sqrt(5.0)

    def __init__(self, duration):
        self.duration = duration

    def at(self, elapsed):
        """s [s] and its first two derivatives [-], [1/s] at a time since the stop began [s]."""
        x = elapsed / self.duration
        if x <= 0.0:
            return elapsed, 1.0, 0.0
        if x >= 1.0:
            return 0.5 * self.duration, 0.0, 0.0
        covered, speed, change, _ = slowing(x)
        return covered * self.duration, speed, change / self.duration

    @staticmethod
    def table(count):
        """At `count` places x from 0 to 1: s / T and its first three derivatives by x, (4, count) [-]."""
        return np.array(slowing(np.linspace(0.0, 1.0, count)))


def slowing(x):
    """s / T, its rate 1 - S, and the next two derivatives, at x = t / T from 0 to 1 [-]."""
    y, x4 = 1.0 - x, x * x * x * x
    return (
        x - x4 * x * (7.0 - x * (14.0 - x * (10.0 - 2.5 * x))),
        1.0 - x4 * (35.0 - x * (84.0 - x * (70.0 - 20.0 * x))),
        -140.0 * (x * y) ** 3,
        -420.0 * (x * y) ** 2 * (y - x),
    )


class SlowedPath:
    """A path that is slowed down to rest; see the module. It ends with the path, if that ends first.

    Parameters
    ----------
    path : Path or ScaledPath
        A path that has begun and is not changed any more.
    start_ns : int
        Stamp at which slowing begins [ns].
    duration_ns : int
        Duration of the slowing [ns].
    """

    trajectory_id = 0

    def __init__(self, path, start_ns, duration_ns):
        self._way, self.start_ns, self.duration_ns = path, start_ns, duration_ns
        self.followed, self.scaled = path.followed, path.scaled
        self.kept = path.kept
        self._slowing = Slowing(duration_ns / SECOND)
        self._begin_ns = max(start_ns - path.start_ns, 0)
        self.begin_state, self._end = np.zeros((2, *path.begin_state.shape))
        path.evaluate(start_ns, self.begin_state)
        path.near(*self._place(0.5 * self._slowing.duration), self._end)
        self._end[1:] = 0.0

    @property
    def end(self):
        """Position that is held after the end, (n,) [rad]."""
        return self._end[0]

    def _place(self, s):
        """Stamp of the path, and remainder [s], at a time s of the path since the stop began [s]."""
        whole = int(s * SECOND)
        return self._way.start_ns + self._begin_ns + whole, s - whole / SECOND

    def _at(self, stamp_ns, offset=0.0):
        """The `_place` of a time `offset` [s] from a stamp."""
        since = max(stamp_ns - self.start_ns, 0) / SECOND + offset
        return self._place(self._slowing.at(since)[0])

    def elapsed(self, stamp_ns):
        """Time of the path at a stamp, from the path's start [s]."""
        place, rest = self._at(stamp_ns)
        return self._way.elapsed(place) + rest

    def speed(self, stamp_ns, offset=0.0):
        """How fast the path's time goes, s', `offset` [s] from a stamp [-]."""
        return self._slowing.at((stamp_ns - self.start_ns) / SECOND + offset)[1]

    def pace(self, stamp_ns, offset=0.0):
        """How fast the time of the path that is followed goes, `offset` [s] from a stamp [-]."""
        return self.speed(stamp_ns, offset) * self._way.pace(*self._at(stamp_ns, offset))

    @property
    def pushes(self):
        """Whether there is an effort on the way."""
        return self._way.pushes

    def effort(self, stamp_ns, out):
        """Fill `out` (n,) with the effort at a stamp [N m]: the path's, in proportion to its speed."""
        self._way.effort(self._at(stamp_ns)[0], out)
        out *= self.speed(stamp_ns)

    def piece(self, stamp_ns):
        """Number of the path's polynomial at a stamp; `Path.END` at the end and after it."""
        if max(stamp_ns - self.start_ns, 0) >= self.duration_ns:
            return Path.END
        return self._way.piece(self._at(stamp_ns)[0])

    def evaluate(self, stamp_ns, out):
        """Fill `out` (3, n) with the state at a stamp; return whether it is before the end."""
        return self.near(stamp_ns, 0.0, out)

    def near(self, stamp_ns, offset, out):
        """Fill `out` (3, n) with the state `offset` [s] from `stamp_ns`, on the path's polynomial at that stamp.

        Returns whether the stamp is before the end. After it the state is that of the end, at any offset.
        """
        elapsed_ns = max(stamp_ns - self.start_ns, 0)
        if elapsed_ns >= self.duration_ns:
            np.copyto(out, self._end)
            return False
        now = elapsed_ns / SECOND
        s, speed, change = self._slowing.at(now)
        place, rest = self._place(s)
        if offset:
            later, speed, change = self._slowing.at(now + offset)
            rest += later - s
        moving = self._way.near(place, rest, out)
        at_rate(out, speed, change)
        return moving


class FinishedPath:
    """A path that is followed to its end as a stop: it comes to rest there sooner than if it were slowed down.

    Parameters
    ----------
    path : Path
        A path that has begun and is not changed any more.
    start_ns : int
        Stamp of the stop [ns].
    """

    trajectory_id, scaled, kept = 0, False, 1.0

    def __init__(self, path, start_ns):
        self.followed, self.start_ns = path, start_ns
        self.duration_ns = path.start_ns + path.duration_ns - start_ns
        self.begin_state = np.zeros_like(path.begin_state)
        path.evaluate(start_ns, self.begin_state)
        self.elapsed, self.piece, self.pace = path.elapsed, path.piece, path.pace
        self.effort = path.effort
        self.evaluate, self.near = path.evaluate, path.near

    @property
    def pushes(self):
        """Whether there is an effort on the way."""
        return self.followed.pushes


def at_rate(state, rate, change):
    """Convert a state (3, n) from a path's own time to the arm's, for a rate [-] and its change [1/s]."""
    _, velocity, acceleration = state
    acceleration *= rate * rate
    acceleration += change * velocity
    velocity *= rate
