# SPDX-License-Identifier: Apache-2.0
"""Motions as piecewise polynomials, as a joint_trajectory_controller interpolates the points of a trajectory.

Points with positions alone are joined by lines, with velocities by cubic, with accelerations by quintic Hermite
polynomials, see `flexarm_control.trajectory`. A motion rests before its first knot and after its last one.
"""

import math

import numpy as np

from ..motions.profiles import Motion
from ..trajectory.path import hermite

#: Number of coefficients of a polynomial, of degree 5 at most.
ORDER = 6
#: Time between the two knots of a motion at rest [s].
MOMENT = 1e-3


class PiecewiseMotion(Motion):
    """A motion of polynomials from knot to knot.

    Parameters
    ----------
    knots : (k + 1,) ndarray
        Ascending times [s].
    coefficients : (k, 6, n) ndarray
        c_0 ... c_5 of each piece: the position is sum_i c_i x^i, x from the piece's first knot [s].
    fields : int
        Number of fields that its points have: 1: positions; 2: also velocities; 3: also accelerations.
    end : (n,) ndarray, optional
        Exact end position; if not given, that of the last polynomial [rad].
    """

    def __init__(self, knots, coefficients, fields, end=None):
        self.knots, self.coefficients, self.fields = knots, coefficients, fields
        # Coefficients of velocity and acceleration, and the ends, beyond which the motion is constant.
        self._derived = [coefficients]
        for order in (1, 2):
            factors = [math.perm(i, order) for i in range(order, ORDER)]
            derived = np.zeros_like(coefficients)
            derived[:, : ORDER - order] = coefficients[:, order:] * np.array(factors)[:, None]
            self._derived.append(derived)
        self.start = coefficients[0, 0].copy()
        length = np.array([knots[-1] - knots[-2]])
        self.end = self._piece(0, np.array([-1]), length)[0] if end is None else end.copy()
        self.angle = self.end - self.start
        self.duration = float(knots[-1] - knots[0])

    @classmethod
    def through(cls, times, states):
        """Return the motion through points.

        Parameters
        ----------
        times : (k,) ndarray
            Ascending [s].
        states : sequence of m (k, n) ndarrays
            Positions, then velocities, then accelerations.
        """
        lengths = np.diff(times)[:, None]
        made = hermite(lengths, [s[:-1] for s in states], [s[1:] for s in states])
        coefficients = np.zeros((len(lengths), ORDER, states[0].shape[1]))
        for i, values in enumerate(made):
            coefficients[:, i] = values
        return cls(np.array(times, float), coefficients, len(states), states[0][-1])

    @property
    def mixed(self):
        """Whether some pieces need more fields than the points will have."""
        return bool(self.coefficients[:, 2 * self.fields :].any())

    @classmethod
    def resting(cls, position, time):
        """Return the motion that stands at a position (n,) [rad]; its knots are at a `time` and a moment later [s]."""
        position = np.asarray(position, float)
        coefficients = np.zeros((1, ORDER, position.size))
        coefficients[0, 0] = position
        return cls(np.array([time, time + MOMENT]), coefficients, 3)

    def derivative(self, order, t):
        t = np.asarray(t, float)
        flat = np.atleast_1d(t)
        piece = np.searchsorted(self.knots, flat, side="right") - 1
        inside = np.clip(piece, 0, len(self.coefficients) - 1)
        out = self._piece(order, inside, flat - self.knots[inside])
        out[flat < self.knots[0]] = 0.0 if order else self.start
        out[flat >= self.knots[-1]] = 0.0 if order else self.end
        return out if t.ndim else out[0]

    def _piece(self, order, piece, x):
        """Derivative, of an `order`, of pieces (k,) at x (k,) from their first knots [s], (k, n)."""
        c, x = self._derived[order][piece], x[:, None]
        out = c[:, -1].copy()
        for i in reversed(range(ORDER - 1)):
            out *= x
            out += c[:, i]
        return out

    def since(self, time):
        """Return the motion without the pieces that have ended by a time [s]; at least one is left."""
        first = min(int(np.searchsorted(self.knots[1:], time, side="right")), len(self.knots) - 2)
        return PiecewiseMotion(self.knots[first:], self.coefficients[first:], self.fields, self.end)

    def until(self, time):
        """Return the motion up to a time [s], which must be later than its first knot."""
        count = int(np.searchsorted(self.knots, time, side="left"))
        knots = np.append(self.knots[:count], time)
        coefficients = self.coefficients[: count if count < len(self.knots) else None]
        if count == len(self.knots):  # the motion ends before this time, and then holds its end
            hold = np.zeros((1, *coefficients.shape[1:]))
            hold[0, 0] = self.end
            coefficients = np.concatenate([coefficients, hold])
        return PiecewiseMotion(knots, coefficients[: len(knots) - 1], self.fields)

    def then(self, other):
        """Return this motion up to the first knot of another one, and that one from there on."""
        before = self.until(other.knots[0])
        return PiecewiseMotion(
            np.concatenate([before.knots[:-1], other.knots]),
            np.concatenate([before.coefficients, other.coefficients]),
            min(self.fields, other.fields),
            other.end,
        )
