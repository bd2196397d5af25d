# SPDX-License-Identifier: Apache-2.0
"""Piecewise polynomials through the points of a trajectory, evaluated on the control path."""

import numpy as np

from .values import SECOND


def hermite(duration, before, after):
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


class Path:
    """A piecewise polynomial from the reference at its start to its last point.

    Knot 0 is the start, knot i the i-th point; segment i leads from knot i to knot i + 1. The
    coefficients of the first segment are computed in `begin`, when the reference at the start is
    known, those of all others here. With a first point at time 0, segment 0 has no length and is
    never evaluated.

    Parameters
    ----------
    times_ns : (k,) int64 array
        Times of the points from the start [ns].
    derivatives : sequence of m (k, n) arrays
        Positions, then velocities, then accelerations.
    trajectory_id : int
        The trajectory of the path; 0: a stop.
    """

    def __init__(self, times_ns, derivatives, trajectory_id=0):
        k, n = derivatives[0].shape
        order = 2 * len(derivatives)
        self.trajectory_id = trajectory_id
        self.start_ns = 0
        self.begin_state = np.zeros((3, n))
        self.duration_ns = int(times_ns[-1])
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
        # Coefficients of the current segment, for position, velocity and acceleration side by side,
        # so that one Horner scheme evaluates all three. d/dx of sum c_i x^i has (i + 1) c_{i+1}.
        self._stack = np.zeros((order, 3, n))
        self._rows = tuple(self._stack[::-1])
        self._once = np.arange(1.0, order)[:, None]
        self._twice = self._once[:-1] * self._once[1:]
        self._x = np.zeros(())
        # The last evaluated state: most stamps are evaluated twice, ahead of time and when sampled.
        self._last = np.zeros((3, n))
        self._forget_segment()

    def _forget_segment(self):
        self._segment, self._low_ns, self._high_ns = -1, 0, 0
        self._last_ns = -1

    def begin(self, start_ns, reference):
        """Start at a stamp [ns] from a (3, n) reference state; may be called again."""
        self.start_ns = start_ns
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
        """Fill `out` (3, n) with the state `offset` [s] from a stamp, on the polynomial at that stamp."""
        elapsed_ns = max(stamp_ns - self.start_ns, 0)
        if elapsed_ns >= self.duration_ns:
            np.copyto(out, self._end)
            return
        if not self._low_ns <= elapsed_ns < self._high_ns:
            self._enter_segment(elapsed_ns)
        self._horner((elapsed_ns - self._low_ns) / SECOND + offset, out)

    def _horner(self, x, out):
        self._x[()] = x
        rows = self._rows
        np.multiply(rows[0], self._x, out)
        for row in rows[1:-1]:
            np.add(out, row, out)
            np.multiply(out, self._x, out)
        np.add(out, rows[-1], out)

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
