# SPDX-License-Identifier: Apache-2.0
r"""Finds the quickest motion from rest to rest that leaves at most the wanted vibration, within speed and acceleration.

The acceleration is linear between its values a at equal times. The remaining vibration of a mode is linear in a, so

.. math:: \min_{a,\rho}\ \rho \quad\text{with}\quad |a_i| \le a_{max},\; 0 \le v_i \le v_{max},\; v(T) = 0,\;
    s(T) = D,\; \Bigl|\int_0^T a\,e^{p(T-t)}dt\Bigr| \le \rho\,w_p\,\frac{4a_{max}}{|p|}

is a linear programme for each duration T, with the modulus bounded by an octagon. Bisection finds the shortest T with
:math:`\rho \le 1`. The trapezoidal motion within the same limits leaves :math:`4a_{max}/|p|` if its four corners excite
the mode in phase. :math:`w_p` is the wanted residual of the mode.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from flexarm_dynamics.errors import FlexarmError

#: Times per period of the fastest mode, and their minimum and maximum total number.
PER_PERIOD, FEWEST, MOST = 10, 40, 160
#: Number of poles of each mode that are evaluated, and steps of the bisection.
POLES, STEPS = 12, 9
_SIDES = 8
#: Timeout of one programme, which takes some 10 ms [s].
PATIENCE = 10.0


@dataclass(frozen=True)
class Move:
    """A motion from rest to rest, and its limits.

    Attributes
    ----------
    distance : float
        [rad or m]
    velocity, acceleration : float
        Limits, in the unit of distance times [1/s], [1/s^2].
    """

    distance: float
    velocity: float
    acceleration: float

    def __post_init__(self):
        """Refuse values that are not above 0.

        Raises
        ------
        FlexarmError
        """
        for name in ("distance", "velocity", "acceleration"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                raise FlexarmError(
                    "is out of range", field=f"move: {name}", value=value, limit="above 0"
                )

    @property
    def duration(self):
        """Duration of the trapezoidal motion, which is the quickest [s]."""
        if self.velocity**2 >= self.distance * self.acceleration:
            return 2.0 * np.sqrt(self.distance / self.acceleration)
        return self.distance / self.velocity + self.velocity / self.acceleration


def least_exciting_duration(move, poles, wanted, longer):
    """Duration of the quickest motion that leaves at most the wanted residuals, and the residuals of this motion.

    Parameters
    ----------
    move : Move
    poles : sequence of ndarray
        Poles of each mode, over its spread [1/s].
    wanted : sequence of float
        Residual of each mode [-].
    longer : float
        Time by which the motion may be longer than the trapezoidal motion [s].

    Returns
    -------
    duration : float
        [s]
    residuals : list of float
        Of each mode [-].

    Raises
    ------
    FlexarmError
        If there is no such motion within the limits.
    """
    thin = [p[:: max(len(p) // POLES, 1)] for p in poles]
    low, high = move.duration, move.duration + longer
    best = solve(move, thin, wanted, high)
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        made = solve(move, thin, wanted, middle)
        if made is not None and max(made[1] / np.asarray(wanted)) <= 1.0:
            high, best = middle, made
        else:
            low = middle
    if best is None:
        raise FlexarmError("has no least exciting time law", field="move", hint="raise its limits")
    return high, list(best[1])


def solve(move, poles, wanted, duration):
    """The acceleration that leaves least vibration in a given duration; None if the limits contradict each other.

    Parameters
    ----------
    move : Move
    poles, wanted
        As for `least_exciting_duration`.
    duration : float
        [s]

    Returns
    -------
    acceleration : ndarray, shape (N + 1,)
        At equally spaced times from 0 to the duration [1/s^2].
    residuals : ndarray, shape (m,)
        Largest residual of each mode [-].
    """
    fastest = max(np.abs(p).max() for p in poles) / (2.0 * np.pi)
    count = int(np.clip(np.ceil(PER_PERIOD * duration * fastest), FEWEST, MOST))
    step = duration / count
    time = step * np.arange(count + 1)
    # Speed after each step and distance at the end, for piecewise linear acceleration in units of the limit.
    unit = move.acceleration
    speed = step * np.tril(np.ones((count + 1, count + 1)), -1)
    speed[1:, 0] = np.diag(speed, -1).copy() / 2.0
    np.fill_diagonal(speed[1:, 1:], step / 2.0)
    way = step * (duration - time)
    kernels = [_kernel(p, time, step, duration) * np.abs(p)[:, None] / 4.0 for p in poles]
    turns = np.exp(2j * np.pi * np.arange(_SIDES) / _SIDES) / np.cos(np.pi / _SIDES)
    rows = np.vstack(
        [
            np.real(np.multiply.outer(turns, k / w)).reshape(-1, count + 1)
            for k, w in zip(kernels, wanted, strict=True)
        ]
    )
    inner = slice(1, count)
    upper = np.vstack(
        [np.column_stack([rows[:, inner], -np.ones(len(rows))])]
        + [np.column_stack([sign * speed[1:, inner], np.zeros(count)]) for sign in (1.0, -1.0)]
    )
    bound = np.concatenate(
        [np.zeros(len(rows)), np.full(count, move.velocity / unit), np.zeros(count)]
    )
    equal = np.zeros((2, count))
    equal[0, :-1], equal[1, :-1] = speed[-1, inner], way[inner]
    made = linprog(
        np.append(np.zeros(count - 1), 1.0), A_ub=upper, b_ub=bound, A_eq=equal, b_eq=[0.0, move.distance / unit],
        bounds=[(-1.0, 1.0)] * (count - 1) + [(0.0, None)],
        # The dual simplex method cycles if the residual can be zero, that is, if the time is long enough.
        method="highs-ipm", options={"time_limit": PATIENCE},
    )  # fmt: skip
    if made.x is None:
        return None
    acceleration = np.zeros(count + 1)
    acceleration[inner] = made.x[:-1]
    left = np.array([np.abs(k @ acceleration).max() for k in kernels])
    return unit * acceleration, left


def _kernel(poles, time, step, duration):
    """What each hat function of a piecewise linear acceleration leaves at each pole, shape (k, N + 1)."""
    half = poles * step / 2.0
    hat = step * (np.sinh(half) / half) ** 2
    return hat[:, None] * np.exp(np.multiply.outer(poles, duration - time))
