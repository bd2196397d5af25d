# SPDX-License-Identifier: Apache-2.0
r"""A low-pass filter of torques: first-order filters in series, all with the same corner frequency.

.. math:: v_k = x_k + (v_{k-1} - x_k)\,e^{-\omega_c h}

Each filter is exact for an input that is constant over the sample, whatever its length h. Bending modes beyond the
corner then meet a small loop gain instead of a delayed torque (gain stabilisation).
"""

import numpy as np

from flexarm_dynamics.parameters import parameter

#: Number of filters in series.
POLES = 2

BANDWIDTH = parameter("bandwidth", 0.0, "rad/s", 0.0, 1e5).described(
    "Corner of the low-pass filter of the feedback torque; 0.0: no filter."
)


class LowPass:
    """The low-pass filter of n torques; without a corner it passes everything.

    Parameters
    ----------
    n : int
    corner : float
        [rad/s]; 0: no filter.
    """

    def __init__(self, n, corner):
        self._corner, self._kept, self._fresh = corner, 1.0, True
        self._states = np.zeros(POLES * n)  # of one filter after the other

    def reset(self):
        """Start again: the next input is passed unchanged."""
        self._fresh = True

    def resume(self, other):
        """Go on from the states of another filter, if it has any."""
        self._states[:] = other._states
        self._fresh = other._fresh or not other._corner

    def shift(self, torque):
        """Raise the output by a torque (n,) from now on, without delay, because the input rises by the same torque."""
        self._states += np.tile(torque, POLES)

    def advance(self, dt):
        """The next input comes `dt` [s] after the last one."""
        self._kept = np.exp(-self._corner * dt)

    def state_space(self, dt):
        r"""The four matrices of :math:`w' = A w + B x,\; v = C w + D x` for samples `dt` [s] apart."""
        n, kept = self._states.size // POLES, np.exp(-self._corner * dt)
        rows, through = np.zeros((n, POLES * n)), np.eye(n)
        A, B = np.zeros((POLES * n, POLES * n)), np.zeros((POLES * n, n))
        for k in range(POLES):
            here = slice(k * n, (k + 1) * n)
            rows, through = (1.0 - kept) * rows, (1.0 - kept) * through
            rows[:, here] += kept * np.eye(n)
            A[here], B[here] = rows, through
        return A, B, rows, through

    def __call__(self, torque):
        """Filter a torque, shape (n,), in place."""
        if not self._corner:
            return torque
        if self._fresh:
            self._fresh = False
            self._states[:] = np.tile(torque, POLES)
            return torque
        for state in self._states.reshape(POLES, -1):
            state -= torque
            state *= self._kept
            state += torque
            torque[:] = state
        return torque
