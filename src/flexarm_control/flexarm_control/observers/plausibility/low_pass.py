# SPDX-License-Identifier: Apache-2.0
r"""A low-pass filter whose states give the first and second derivative of its output.

Three stages, :math:`\dot y_i = \omega(y_{i-1} - y_i)` with the input as :math:`y_0`, so that

.. math:: \dot y_3 = \omega(y_2 - y_3), \qquad \ddot y_3 = \omega^2(y_1 - 2y_2 + y_3) .

The input is taken as a straight line between two samples, whatever the time h between them. With
:math:`x = \omega h`, :math:`e_k = e^{-x}x^k/k!`, the step responses :math:`S_i = 1 - \sum_{k<i}e_k` and the ramp
responses :math:`R_i = 1 - \frac1x\sum_{k\le i}S_k`, a sample changes the states exactly to

.. math:: y_i^+ = R_i u^+ + (S_i - R_i)u + \sum_{k<i}e_k\,y_{i-k} .
"""

from math import exp

import numpy as np

from ... import kernels

#: Coefficients are kept while h changes by less than this ratio [-].
SAME = 1e-3


class LowPass:
    """Filters several signals in the same way.

    Parameters
    ----------
    size : int
        Number of signals N.
    corner : float
        omega [rad/s].

    Attributes
    ----------
    rows : ndarray, shape (5, N)
        Last sample, the one before it, and the states :math:`y_1` to :math:`y_3`.
    weights : ndarray, shape (3, 5)
        Weights of the sample, the one before it and the states in each new state.
    """

    def __init__(self, size, corner):
        self.corner = corner
        self.rows, self._kernels = np.zeros((5, size)), kernels.compiled()
        self.weights, self._dt = np.zeros((3, 5)), 0.0

    def start(self, signal):
        """Begin with a `signal`, shape (N,), as if it had been constant until now."""
        self.rows[:] = signal

    def clear(self, part):
        """Take the signals of the slice `part` as zero until now."""
        self.rows[:, part] = 0.0

    def update(self, signal, dt):
        """Take a new sample, shape (N,), `dt` [s] after the last."""
        self.weigh(dt)
        self._kernels.low_passed(self.rows, self.weights, signal)

    def weigh(self, dt):
        """Make `weights` for a sample `dt` [s] after the last."""
        if abs(dt - self._dt) <= SAME * dt:
            return
        x = self.corner * dt
        a = exp(-x)
        b = a * x
        c = 0.5 * b * x
        s1 = 1.0 - a
        s2 = s1 - b
        s3 = s2 - c
        r1 = 1.0 - s1 / x
        r2 = r1 - s2 / x
        r3 = r2 - s3 / x
        self.weights[:] = (
            (r1, s1 - r1, a, 0.0, 0.0),
            (r2, s2 - r2, b, a, 0.0),
            (r3, s3 - r3, c, b, a),
        )
        self._dt = dt

    @property
    def signal(self):
        """y_3, shape (N,)."""
        return self.rows[4]

    @property
    def first(self):
        """First derivative of `signal`, shape (N,)."""
        return self.corner * (self.rows[3] - self.rows[4])

    @property
    def second(self):
        """Second derivative of `signal`, shape (N,)."""
        rows = self.rows
        return self.corner**2 * (rows[2] - 2.0 * rows[3] + rows[4])
