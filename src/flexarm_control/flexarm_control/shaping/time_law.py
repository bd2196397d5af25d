# SPDX-License-Identifier: Apache-2.0
r"""Finds a new time law for a straight motion from rest to rest, for the modes along its path, by a linear programme.

During motions of a few periods, the frequencies of an arm change. The path of the joints,
:math:`q = q_0 + \Delta\,\sigma(t)`, stays; :math:`\ddot\sigma` becomes piecewise linear between equal times, 0 at both
ends. At the configurations on the path, each mode obeys

.. math:: \ddot x + 2\zeta\omega(\sigma)\dot x + \omega(\sigma)^2 x = -\ddot\sigma, \qquad
    z(T) \approx \int_0^T \ddot\sigma(t)\,\sqrt{\frac{\omega(T)}{\omega(t)}}\;
    e^{\int_t^T(-\zeta\omega + j\omega_d)d\tau}\,dt,

to the first order of the method of Wentzel, Kramers and Brillouin. With :math:`\omega(\sigma(t))` along a known
:math:`\sigma`, the remaining amplitude z is linear in the accelerations, and

.. math:: \min \epsilon \quad\text{with}\quad |z_m(c)| \le \epsilon\, n_m(c),\;
    |\ddot\sigma| \le a,\; 0 \le \dot\sigma \le v,\; \dot\sigma(T) = 0,\; \sigma(T) = 1

is a linear programme over all modes m and factors c of their frequencies within the spread; v and a are the given
motion's own. n is the amplitude that the given motion leaves, at least `FLOOR` of its largest. At the measured
frequencies :math:`\epsilon` is at most `robust_shapers.AT_DESIGN` times as large. The programme is solved `ROUNDS`
times, each time along the previous solution. Every motion that a shaper can make of a straight one is such a time law,
too, except for the rounding of the accelerations. So no shaper leaves less.

Modes that come close on the way change their shapes, and pass energy to each other. Frequencies alone do not give the
amount. For what mode k passes to mode m, its form is

.. math:: C_{mk} = \int_0^T \dot\sigma(t)\, z_k(t)\, e^{\int_t^T(-\zeta_m\omega_m + j\omega_{d,m})d\tau}\,dt,

the first correction, times an unknown number of order 1. It is linear in the accelerations, too, with
:math:`\dot\sigma` of the previous solution; :math:`|C_{mk}| \le \epsilon\,n_m` / `COUPLED` keeps it small.

A drive at its torque limit does not follow its command. The `robust` shaper of the same modes spreads the
accelerations out. A new time law has no larger accelerations than that, if there is such a law. One that would leave
more vibration than the given motion, at any frequency within the spread, is not used.

Least exciting time laws of piecewise linear acceleration, for one constant mode, are an old use of linear programming
(Singh 2010, *Optimal Reference Shaping for Dynamical Systems*, chapter 5).
"""

import numpy as np
from scipy.optimize import linprog

from ..motions.robust_shapers import AT_DESIGN
from .piecewise import PiecewiseMotion
from .shaped_motion import ShapedMotion

#: Number of pieces of the acceleration per period of the lowest mode, and minimum and maximum of their total. More
#: pieces leave less vibration of the measured modes, and excite the others more.
PER_PERIOD, FEWEST, MOST = 7, 12, 80
#: Number of places at which the modes are evaluated, in each piece and in the given motion.
FINE, PLACES = 6, 400
#: Number of factors of the frequencies within the spread, and of directions around the circle.
FACTORS, DIRECTIONS = 9, 16
#: The given motion may leave almost nothing by chance; it counts as leaving at least this fraction of its largest [-].
FLOOR = 0.3
#: Weight of what one mode passes to another, and number of factors of the frequencies at which it is evaluated.
COUPLED, COUPLED_FACTORS = 10.0, 3
#: Number of solutions, each along the previous one.
ROUNDS = 3
#: A motion is straight if its distance from its line, relative to its length, is at most this [-].
STRAIGHT = 1e-4
#: First duration of a stop relative to what the largest acceleration needs, to which `modes.periods` are added; factor
#: for the next, longer one.
STOP, LONGER = 1.3, 1.3
#: Within the limits, a stop may accelerate this many times as much as the motion does [-].
HARDER = 1.3
#: Rounding of the speeds [-].
SLACK = 1e-9
#: A linear programme is given up after this many iterations; some 100 are usual. It is a count, not a time, so that
#: a busy computer finds the same motion.
ITERATIONS = 10_000


def along(motion):
    """Progress of a straight motion from rest to rest on its line, with two derivatives; None for any other motion.

    Parameters
    ----------
    motion : PiecewiseMotion

    Returns
    -------
    callable or None
        ``progress(order, times)`` at times (k,), from 0 to 1 [-], [1/s], [1/s^2]. None also if points have positions
        only.
    """
    size = float(motion.angle @ motion.angle)
    if size == 0.0 or motion.fields == 1:
        return None
    progress = _progress(motion)
    times = np.linspace(motion.knots[0], motion.knots[-1], PLACES)
    sigma = progress(0, times)
    away = motion.position(times) - motion.start - sigma[:, None] * motion.angle
    ends = motion.knots[0], motion.knots[-1] - 1e-9
    still = np.abs(progress(1, np.array(ends))) * motion.duration
    straight = np.abs(away).max() <= STRAIGHT * np.sqrt(size)
    steady = (np.diff(sigma) >= -STRAIGHT).all() and (still <= STRAIGHT).all()
    return progress if straight and steady else None


def _progress(motion):
    size = float(motion.angle @ motion.angle)

    def progress(order, times):
        values = motion.derivative(order, times)
        return (values if order else values - motion.start) @ motion.angle / size

    return progress


def retimed(motion, modes, velocity=np.inf, acceleration=np.inf):
    """A straight motion with a new time law, longer by `modes.periods` of the lowest mode on the way.

    Parameters
    ----------
    motion : PiecewiseMotion
    modes : Modes
    velocity, acceleration : (n,) array_like
        Limits [rad/s], [rad/s^2]; the motion's own largest values are limits in any case.

    Returns
    -------
    PiecewiseMotion or None
        None if `along` gives None, or if there is no such time law within the limits.
    """
    found = solved(motion, modes, velocity, acceleration)
    return None if found is None else found[0].motion(found[2])


def solved(motion, modes, velocity=np.inf, acceleration=np.inf, plain=False):
    """Result of `retimed`: the programme, what the given motion leaves (as in `Line.norms`), and the accelerations.

    Parameters
    ----------
    motion, modes, velocity, acceleration
        As for `retimed`.
    plain : bool
        Consider the modes alone, whatever they pass to each other, with accelerations up to the limits.

    Returns
    -------
    tuple of Law, list of (factors,) ndarrays, and (N - 1,) ndarray; or None
    """
    progress = along(motion)
    if progress is None:
        return None
    line = Line(motion, modes, progress)
    norms = line.norms()
    if not min(norm.min() for norm in norms) > 0.0:
        return None
    limits = [
        min(own, _of_progress(motion, limit))
        for own, limit in zip(line.own, (velocity, acceleration), strict=True)
    ]
    law = Law(line, motion.duration + modes.periods / line.lowest, limits)
    sigma = progress(0, np.linspace(*motion.knots[[0, -1]], law.middles.size))
    if plain:
        x = law.solution(norms, sigma, coupled=False)
    else:
        x = law.solution(norms, sigma, _gentle(motion, modes))
        x = law.solution(norms, sigma) if x is None else x
    return None if x is None or law.worst(x, norms) > 1.0 else (law, norms, x)


def _of_progress(motion, limits):
    """Limits of the joints (n,) as one limit of the progress."""
    return float((np.asarray(limits) / np.maximum(np.abs(motion.angle), 1e-300)).min())


def _gentle(motion, modes):
    """Largest acceleration of the progress after the shaper of the same modes [1/s^2]."""
    shaped = ShapedMotion(motion, modes)
    knots = shaped.knots()
    bend = shaped.states(np.sort(np.concatenate([knots + 1e-12, knots - 1e-9])))[2]
    return float(np.abs(bend @ motion.angle).max() / (motion.angle @ motion.angle))


def leaves(motion, modes):
    """Amplitudes that a straight motion leaves in each mode, at factors of the frequencies over the spread.

    Parameters
    ----------
    motion : PiecewiseMotion
        On a straight line, as in `along` or from `retimed`.
    modes : Modes

    Returns
    -------
    list of (factors,) ndarrays
        The amplitudes |z|, with the measured frequencies in the middle [1/s].
    """
    return Line(motion, modes, _progress(motion)).remains()


def stopped(motion, modes, time, acceleration=np.inf):
    """A motion of `retimed` up to a time, then to rest on its line; the stop removes the vibration excited before.

    Parameters
    ----------
    motion : PiecewiseMotion
    modes : Modes
    time : float
        [s]
    acceleration : (n,) array_like
        Limits [rad/s^2].

    Returns
    -------
    PiecewiseMotion
        The motion itself if no stop ends earlier, or if it is not straight.
    """
    progress = along(motion)
    if progress is None or time >= motion.knots[-1]:
        return motion
    line = Line(motion, modes, progress)
    state = [float(progress(order, np.array([time]))[0]) for order in range(3)]
    norms = [np.full(FACTORS, line.own[1] / (2.0 * np.pi * line.lowest))] * line.modes_count
    bend = max(min(HARDER * line.own[1], _of_progress(motion, acceleration)), line.own[1])
    duration = STOP * state[1] / bend + modes.periods / line.lowest
    while time + duration < motion.knots[-1]:
        law = Law(line, duration, (line.own[0], bend), state, time)
        x = law.solution(norms, np.full(law.middles.size, state[0]))
        if x is not None:
            states = law.states(x)
            states[1][-1] = 0.0
            stop = PiecewiseMotion.through(time + law.nodes, states[: motion.fields])
            return motion.then(stop)
        duration *= LONGER
    return motion


class Line:
    """The line of a motion, what the motion does on it, and the modes along it."""

    def __init__(self, motion, modes, progress):
        self.motion, self.progress, self._modes = motion, progress, modes
        knots = motion.knots
        ends = np.concatenate([self._cells(knots[-1])[0], knots[:-1] + 1e-12, knots[1:] - 1e-9])
        #: Largest speed and acceleration of the progress [1/s], [1/s^2].
        self.own = tuple(float(np.abs(progress(order, ends)).max()) for order in (1, 2))
        frequencies = self.at(progress(0, ends))[0]
        #: Lowest frequency on the way [Hz], number of modes.
        self.lowest, self.modes_count = float(frequencies.min()), frequencies.shape[1]

    def at(self, progress):
        """Frequencies (k, m) [Hz] and damping ratios (k, m) at places of the line (k,)."""
        motion = self.motion
        return self._modes.along(motion.start + progress[:, None] * motion.angle)

    def _cells(self, time):
        """Middles (k,) and durations (k,) of equal parts of the motion up to a time [s]."""
        first = self.motion.knots[0]
        step = (time - first) / PLACES
        return first + step * (np.arange(PLACES) + 0.5), np.full(PLACES, step)

    def history(self, time):
        """Progress, durations [s] and accelerations of the motion up to a time, in cells (k,)."""
        middles, steps = self._cells(time)
        return self.progress(0, middles), steps, self.progress(2, middles)

    def norms(self):
        """Amplitudes that the motion leaves of each mode, at least `FLOOR` of the largest, list of (factors,)."""
        return [np.maximum(values, FLOOR * values.max()) for values in self.remains()]

    def remains(self):
        """Amplitudes that the motion leaves of each mode, list of (factors,)."""
        progress, steps, bend = self.history(self.motion.knots[-1])
        return [np.abs(values[:, 0]) for values in self.left(progress, steps, bend[:, None])]

    def left(self, progress, steps, parts):
        """Complex amplitudes that accelerations (k, p) in cells of durations `steps` leave: by mode, (factors, p)."""
        sizes, turns = self._turning(progress, steps)
        found = []
        for size, turn in zip(sizes.T, turns.T, strict=True):
            phase = np.cumsum(turn)
            phase = phase[-1] - phase + 0.5 * turn
            found.append((size * np.exp(self._factors(FACTORS)[:, None] * phase)) @ parts)
        return found

    def coupled(self, progress, steps, parts):
        """What the other modes pass to each mode, as for `left`: list of (others and factors, p) complex."""
        sizes, turns = self._turning(progress, steps)
        after, way = np.cumsum(turns, axis=0), np.gradient(progress)[:, None]
        phases, count = after - 0.5 * turns, self.modes_count
        found = [[] for _ in range(count)]
        for factor in self._factors(COUPLED_FACTORS):
            ahead = way * np.exp(factor * (after[-1] - phases))
            for k in range(count):
                turned = np.exp(factor * phases[:, k : k + 1])
                each = sizes[:, k : k + 1] / turned * parts
                swings = turned * (np.cumsum(each, axis=0) - 0.5 * each)
                for m in range(count):
                    if m != k:
                        found[m].append(ahead[:, m] @ swings)
        return [np.reshape(rows, (-1, parts.shape[1])) for rows in found]

    def _factors(self, count):
        return np.linspace(1.0 - self._modes.spread, 1.0 + self._modes.spread, count)

    def _turning(self, progress, steps):
        """For each cell and mode, (k, m): the effect at the end of an acceleration of 1 [s], and the complex turn."""
        frequencies, dampings = self.at(progress)
        w = 2.0 * np.pi * frequencies
        turns = w * (-dampings + 1j * np.sqrt(1.0 - dampings**2)) * steps[:, None]
        return steps[:, None] * np.sqrt(w[-1] / w), turns


class Law:
    """The linear programme of one time law, in the accelerations x (N - 1,) at the inner nodes.

    Parameters
    ----------
    line : Line
    duration : float
        [s]
    limits : sequence of 2 floats
        Limits of speed and acceleration of the progress [1/s], [1/s^2].
    state : sequence of 3 floats, optional
        Progress, speed and acceleration at which a stop begins; if not given, the motion is from rest to the end of the
        line.
    time : float, optional
        Time at which the stop begins [s].
    """

    def __init__(self, line, duration, limits, state=None, time=None):
        self._line, self.limits, self._stops = line, limits, state is not None
        self._state = np.zeros(3) if state is None else np.array(state)
        self._past = line.history(time) if self._stops else (np.zeros(0),) * 3
        self.count = int(np.clip(np.ceil(PER_PERIOD * duration * line.lowest), FEWEST, MOST))
        self._step = duration / self.count
        self.nodes = self._step * np.arange(self.count + 1)
        cells = self.count * FINE
        self.middles = duration * (np.arange(cells) + 0.5) / cells
        hats = np.array([np.interp(self.middles, self.nodes, h) for h in np.eye(self.count + 1)]).T
        # Columns: the acceleration at the start, then the inner ones; the first column has the past, too.
        self._parts = np.zeros((self._past[0].size + cells, self.count))
        self._parts[: self._past[0].size, 0] = self._past[2]
        self._parts[self._past[0].size :] = hats[:, :-1] * np.append(
            self._state[2], np.ones(self.count - 1)
        )
        self._steps = np.append(self._past[1], np.full(cells, duration / cells))
        self._way, self._speed = _integrals(self.count, self._step)
        across = np.eye(self.count + 1)
        middle = self._speed[:-1] + self._step / 8.0 * (3.0 * across[:-1] + across[1:])
        self._speeds = np.vstack([self._speed[1:], middle])
        #: What x adds to the speeds at and between the nodes, and to speed and progress at the end.
        self.inner = self._speeds[:, 1:-1]
        self.ends = np.stack([self._speed[-1, 1:-1], self._way[-1, 1:-1]])

    def states(self, x):
        """Positions, velocities and accelerations of the joints at the nodes, three (N + 1, n) arrays."""
        motion, (sigma, speed, _) = self._line.motion, self._state
        bend = self._all(x)
        sigma = sigma + speed * self.nodes + self._way @ bend
        along = sigma, speed + self._speed @ bend, bend
        states = [values[:, None] * motion.angle for values in along]
        states[0] += motion.start
        return states

    def motion(self, x):
        """The motion from rest to rest by accelerations x, slowed down if its speed is too high between nodes."""
        given = self._line.motion
        # Between two nodes the speed is a parabola, whose top may be above both.
        slower = max(self.top(x) / self.limits[0], 1.0)
        made = [values / slower**order for order, values in enumerate(self.states(x))]
        made[0][-1], made[1][-1] = given.end, 0.0
        return PiecewiseMotion.through(given.knots[0] + slower * self.nodes, made[: given.fields])

    def left(self, x, line):
        """Complex amplitude that a unit of each acceleration of x leaves in a `line`'s modes, along x, (m, N - 1)."""
        found = line.left(self._middle_progress(x), self._steps, self._parts)
        return np.array([values[FACTORS // 2, 1:] for values in found])

    def _middle_progress(self, x):
        bend = self._all(x)
        sigma = self._state[0] + self._state[1] * self.nodes + self._way @ bend
        return np.interp(self.middles, self.nodes, sigma)

    def _all(self, x):
        return np.concatenate([[self._state[2]], x, [0.0]])

    def top(self, x):
        """Largest speed of the progress, also between nodes."""
        bend = self._all(x)
        speed = self._state[1] + self._speed @ bend
        before, after = bend[:-1], bend[1:]
        falls = (before > 0.0) & (after < 0.0)
        rise = 0.5 * self._step * before**2 / np.where(falls, before - after, np.inf)
        return float(np.maximum(speed[:-1] + rise, speed[1:]).max())

    def solution(self, norms, sigma, acceleration=np.inf, coupled=True):
        """The accelerations x that leave the least vibration; None if there are none within the limits.

        Parameters
        ----------
        norms : list of (factors,) ndarrays
            Units in which the remaining amplitude of each mode counts.
        sigma : (k,) ndarray
            Progress to begin with, at the middles.
        acceleration : float
            A further limit beside `limits` [1/s^2].
        coupled : bool
            Whether to keep small what modes pass to each other.
        """
        x, acceleration = None, min(acceleration, self.limits[1])
        for _ in range(ROUNDS):
            along = np.append(self._past[0], sigma), self._steps, self._parts
            handed = self._line.coupled(*along) if coupled else []
            x = self._programme(self._line.left(*along), handed, norms, acceleration)
            if x is None:
                return None
            sigma = self._middle_progress(x)
        return x

    def worst(self, x, norms):
        """The largest fraction of `norms` that accelerations x leave, over all modes and factors of frequencies."""
        along = np.append(self._past[0], self._middle_progress(x)), self._steps, self._parts
        made = np.append(1.0, x)
        left = (np.abs(values @ made) for values in self._line.left(*along))
        return float(max((v / norm).max() for v, norm in zip(left, norms, strict=True)))

    def _programme(self, left, coupled, norms, acceleration):
        """Solve one linear programme; returns its x, or None if the limits contradict each other."""
        around = np.exp(-2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)
        parts = [v / norm[:, None] for v, norm in zip(left, norms, strict=True)]
        handed = [COUPLED / np.median(n) * v for v, n in zip(coupled, norms, strict=False)]
        every = np.concatenate([*parts, *handed])
        rows = np.real(around[:, None, None] * every).reshape(-1, self.count)
        wanted = np.ones(len(every))
        wanted[FACTORS // 2 : FACTORS * len(left) : FACTORS] = AT_DESIGN
        wanted = np.tile(wanted, DIRECTIONS)
        _, speed, bend = self._state
        velocity = self.limits[0]
        inner, own = self.inner, speed + self._speeds[:, 0] * bend
        none = np.zeros((len(inner), 1))
        upper = [
            np.column_stack([rows[:, 1:], -wanted]),
            np.hstack([inner, none]),
            np.hstack([-inner, none]),
        ]
        bounds = [-rows[:, 0], velocity * (1.0 + SLACK) - own, own + SLACK * velocity]
        way = self._way[-1]
        ahead = 1.0 - self._state[0] - speed * self.nodes[-1] - way[0] * bend
        ends, values = [np.append(self.ends[0], 0.0)], [-speed - self._speed[-1, 0] * bend]
        if self._stops:
            upper.append(np.append(self.ends[1], 0.0)[None])
            bounds.append([ahead])
        else:
            ends.append(np.append(self.ends[1], 0.0))
            values.append(ahead)
        cost = np.zeros(self.count)
        cost[-1] = 1.0
        made = linprog(
            cost, np.vstack(upper), np.concatenate(bounds), np.stack(ends), values,
            bounds=[(-acceleration, acceleration)] * (self.count - 1) + [(0.0, None)],
            method="highs", options={"maxiter": ITERATIONS},
        )  # fmt: skip
        return made.x[:-1] if made.success else None


def _integrals(count, step):
    """Matrices of progress and speed at the nodes from the accelerations there, two (N + 1, N + 1)."""
    speed, way = (np.zeros((count + 1, count + 1)) for _ in range(2))
    for k in range(count):
        speed[k + 1], way[k + 1] = speed[k], way[k] + step * speed[k]
        speed[k + 1, k : k + 2] += 0.5 * step
        way[k + 1, k : k + 2] += step**2 * np.array([1.0 / 3.0, 1.0 / 6.0])
    return way, speed
