# SPDX-License-Identifier: Apache-2.0
r"""A new time law for a straight motion from rest to rest, made for the modes along the way: a linear programme.

Motions of a few periods change the frequencies of an arm while they last. The way of the joints,
:math:`q = q_0 + \Delta\,\sigma(t)`, stays; :math:`\ddot\sigma` becomes piecewise linear between equal times, 0 at both
ends. Each mode obeys, at the configurations that it passes,

.. math:: \ddot x + 2\zeta\omega(\sigma)\dot x + \omega(\sigma)^2 x = -\ddot\sigma, \qquad
    z(T) \approx \int_0^T \ddot\sigma(t)\,\sqrt{\frac{\omega(T)}{\omega(t)}}\;
    e^{\int_t^T(-\zeta\omega + j\omega_d)d\tau}\,dt,

to the first order of the method of Wentzel, Kramers and Brillouin. With :math:`\omega(\sigma(t))` along a known
:math:`\sigma`, the amplitude z that is left is linear in the accelerations, and

.. math:: \min \epsilon \quad\text{with}\quad |z_m(c)| \le \epsilon\, n_m(c),\;
    |\ddot\sigma| \le a,\; 0 \le \dot\sigma \le v,\; \dot\sigma(T) = 0,\; \sigma(T) = 1

is a linear programme over all modes m and factors c of their frequencies within the spread; v and a are the given
motion's own. n is what the given motion leaves, at least `FLOOR` of its largest, and :math:`\epsilon` at the measured
frequencies is `robust_shapers.AT_DESIGN` times as large at most. The programme is solved `ROUNDS` times, each along the
solution before. Every motion that a shaper can make of a straight one is such a time law, too, but for the rounding of
the accelerations, so that no less is left by a shaper.

Time laws of piecewise linear acceleration that are least exciting, for one constant mode, are an old use of linear
programming (Singh 2010, *Optimal Reference Shaping for Dynamical Systems*, chapter 5).
"""

import numpy as np
from scipy.optimize import linprog

from ..motions.robust_shapers import AT_DESIGN
from .piecewise import PiecewiseMotion

#: Pieces of the acceleration per period of the lowest mode, at least so many in all, and at most. More of them leave
#: less of the modes that are measured, and excite more of those that are not.
PER_PERIOD, FEWEST, MOST = 7, 12, 80
#: Places in each piece at which the modes are looked at, and in the given motion.
FINE, PLACES = 6, 400
#: Factors of the frequencies within the spread, and directions around the circle.
FACTORS, DIRECTIONS = 9, 16
#: The given motion may leave next to nothing by chance: it counts for this fraction of its largest at least [-].
FLOOR = 0.3
#: Solutions, each along the one before.
ROUNDS = 3
#: A motion is straight if it stays this close to its line, over its length [-].
STRAIGHT = 1e-4
#: A linear programme is given up after this time [s].
PATIENCE = 1.0


def along(motion):
    """Progress of a motion on its line at times (k,), its first two derivatives too; None where it is not straight.

    Parameters
    ----------
    motion : PiecewiseMotion

    Returns
    -------
    callable or None
        ``progress(order, times)``, from 0 to 1 [-], [1/s], [1/s^2].
    """
    size = float(motion.angle @ motion.angle)
    if size == 0.0 or motion.fields == 1:
        return None

    def progress(order, times):
        values = motion.derivative(order, times)
        return (values if order else values - motion.start) @ motion.angle / size

    times = np.linspace(motion.knots[0], motion.knots[-1], PLACES)
    sigma = progress(0, times)
    away = motion.position(times) - motion.start - sigma[:, None] * motion.angle
    ends = motion.knots[0], motion.knots[-1] - 1e-9
    still = np.abs(progress(1, np.array(ends))) * motion.duration
    straight = np.abs(away).max() <= STRAIGHT * np.sqrt(size)
    steady = (np.diff(sigma) >= -STRAIGHT).all() and (still <= STRAIGHT).all()
    return progress if straight and steady else None


def retimed(motion, modes, velocity=np.inf, acceleration=np.inf):
    """A straight motion with a new time law, longer by `modes.periods` of the lowest mode on the way.

    Parameters
    ----------
    motion : PiecewiseMotion
    modes : Modes
    velocity, acceleration : (n,) array_like
        Limits [rad/s], [rad/s^2]; the motion's own largest hold in any case.

    Returns
    -------
    PiecewiseMotion or None
        None where the motion is not straight, or there is no such time law within the limits.
    """
    progress = along(motion)
    if progress is None:
        return None
    problem = _Problem(motion, progress, modes)
    limits = [
        min(own, float((np.asarray(limit) / np.maximum(np.abs(motion.angle), 1e-300)).min()))
        for own, limit in zip(problem.own, (velocity, acceleration), strict=True)
    ]
    found = problem.solution(*limits)
    if found is None:
        return None
    sigma, speed, bend = problem.nodes(found)
    # Between two nodes the speed is a parabola, whose top may be above both.
    slower = max(_top(speed, bend, problem.step) / limits[0], 1.0)
    states = [motion.start + sigma[:, None] * motion.angle]
    states += [speed[:, None] * motion.angle / slower, bend[:, None] * motion.angle / slower**2]
    states[0][-1], states[1][-1] = motion.end, 0.0
    times = motion.knots[0] + slower * problem.step * np.arange(sigma.size)
    return PiecewiseMotion.through(times, states[: motion.fields])


def _top(speed, bend, step):
    """Largest speed of an acceleration that is linear between nodes."""
    before, after = bend[:-1], bend[1:]
    falls = (before > 0.0) & (after < 0.0)
    rise = 0.5 * step * before**2 / np.where(falls, before - after, np.inf)
    return float(np.maximum(speed[:-1] + rise, speed[1:]).max())


class _Problem:
    """The linear programme of one motion, in the accelerations x (N - 1,) at the inner nodes."""

    def __init__(self, motion, progress, modes):
        self._motion, self._modes = motion, modes
        first, span = motion.knots[0], motion.duration
        middle = (np.arange(PLACES) + 0.5) / PLACES
        self._given = first + span * middle
        self._progress, self._bend = (progress(order, self._given) for order in (0, 2))
        ends = np.concatenate([self._given, motion.knots[:-1] + 1e-12, motion.knots[1:] - 1e-9])
        self.own = tuple(float(np.abs(progress(order, ends)).max()) for order in (1, 2))
        lowest = self._frequencies(self._progress)[0].min()
        duration = span + modes.periods / lowest
        self.count = int(np.clip(np.ceil(PER_PERIOD * duration * lowest), FEWEST, MOST))
        self.step = duration / self.count
        self._fine = duration * (np.arange(self.count * FINE) + 0.5) / (self.count * FINE)
        nodes = self.step * np.arange(self.count + 1)
        hats = np.eye(self.count + 1)[1:-1]
        self._hats = np.array([np.interp(self._fine, nodes, hat) for hat in hats]).T
        self._matrices = [matrix[:, 1:-1] for matrix in _integrals(self.count, self.step)]
        # The speed in the middle of each piece.
        across = np.eye(self.count + 1)[:, 1:-1]
        self._middle = self._matrices[1][:-1] + self.step / 8.0 * (3.0 * across[:-1] + across[1:])

    def _frequencies(self, progress):
        """Frequencies (k, m) [Hz] and damping ratios (k, m) at places of the line (k,)."""
        motion = self._motion
        return self._modes.along(motion.start + progress[:, None] * motion.angle)

    def nodes(self, x):
        """Progress, its speed and its acceleration at all nodes (N + 1,)."""
        sigma, speed = (matrix @ x for matrix in self._matrices)
        return sigma, speed, np.concatenate([[0.0], x, [0.0]])

    def solution(self, velocity, acceleration):
        """The accelerations that leave least within limits of the progress [1/s], [1/s^2]; None: there are none."""
        given = self._left(self._progress, self._given, self._bend[:, None])
        norms = [np.abs(left[:, 0]) for left in given]
        norms = [np.maximum(norm, FLOOR * norm.max()) for norm in norms]
        if not min(norm.min() for norm in norms) > 0.0:
            return None
        sigma = np.interp(
            self._fine / self._fine[-1], np.linspace(0.0, 1.0, PLACES), self._progress
        )
        x = None
        for _ in range(ROUNDS):
            left = self._left(sigma, self._fine, self._hats)
            x = self._programme(left, norms, velocity, acceleration)
            if x is None:
                return None
            nodes = self.nodes(x)[0]
            sigma = np.interp(self._fine, self.step * np.arange(nodes.size), nodes)
        return x

    def _left(self, progress, times, parts):
        """What accelerations (k, p) at equal times leave of each mode, list of (factors, p) complex."""
        frequencies, dampings = self._frequencies(progress)
        step = times[1] - times[0]
        factors = np.linspace(1.0 - self._modes.spread, 1.0 + self._modes.spread, FACTORS)
        found = []
        for frequency, damping in zip(frequencies.T, dampings.T, strict=True):
            w = 2.0 * np.pi * frequency
            pole = w * (-damping + 1j * np.sqrt(1.0 - damping**2))
            phase = np.cumsum(pole) * step
            phase = phase[-1] - phase + 0.5 * step * pole
            size = step * np.sqrt(w[-1] / w)
            found.append((size * np.exp(factors[:, None] * phase)) @ parts)
        return found

    def _programme(self, left, norms, velocity, acceleration):
        """Solve one linear programme; its x, None where the limits contradict each other."""
        around = np.exp(-2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)
        rows = [
            np.real(around[:, None, None] * (values / norm[:, None])).reshape(-1, values.shape[1])
            for values, norm in zip(left, norms, strict=True)
        ]
        wanted = np.ones(FACTORS)
        wanted[FACTORS // 2] = AT_DESIGN
        rows, limits = np.concatenate(rows), np.tile(wanted, DIRECTIONS * len(left))
        sigma, speed = self._matrices
        places = np.vstack([speed[1:], self._middle])
        none = np.zeros((len(places), 1))
        upper = np.vstack(
            [
                np.column_stack([rows, -limits]),
                np.hstack([places, none]),
                np.hstack([-places, none]),
            ]
        )
        bounds = np.concatenate(
            [np.zeros(len(rows)), np.full(len(places), velocity), np.zeros(len(places))]
        )
        ends = np.column_stack([np.stack([speed[-1], sigma[-1]]), np.zeros(2)])
        cost = np.zeros(self.count)
        cost[-1] = 1.0
        made = linprog(
            cost, upper, bounds, ends, [0.0, 1.0],
            bounds=[(-acceleration, acceleration)] * (self.count - 1) + [(0.0, None)],
            method="highs", options={"time_limit": PATIENCE},
        )  # fmt: skip
        return made.x[:-1] if made.success else None


def _integrals(count, step):
    """Progress and speed at the nodes by the accelerations there, two (N + 1, N + 1) matrices."""
    speed, way = (np.zeros((count + 1, count + 1)) for _ in range(2))
    for k in range(count):
        speed[k + 1], way[k + 1] = speed[k], way[k] + step * speed[k]
        speed[k + 1, k : k + 2] += 0.5 * step
        way[k + 1, k : k + 2] += step**2 * np.array([1.0 / 3.0, 1.0 / 6.0])
    return way, speed
