# SPDX-License-Identifier: Apache-2.0
r"""A low pass of torques: filters of first order with one corner, one after the other.

.. math:: v_k = x_k + (v_{k-1} - x_k)\,e^{-\omega_c h}

of each, exact for an input that is constant over the sample, whatever its length h. Bending modes beyond the corner
meet a small loop gain in place of a delayed torque (gain stabilisation).
"""

import numpy as np

from flexarm_dynamics.parameters import parameter

#: Filters one after the other.
POLES = 2

BANDWIDTH = parameter("bandwidth", 0.0, "rad/s", 0.0, 1e5).described(
    "Corner of the low pass of the feedback's torque; 0.0: none."
)


class LowPass:
    """The low pass of n torques; without a corner it passes all.

    Parameters
    ----------
    n : int
    corner : float
        [rad/s]; 0: none.
    """

    def __init__(self, n, corner):
        self._corner, self._kept = corner, None
        self._states = np.zeros((POLES, n))

    def reset(self):
        """Begin anew: the next input is passed as it is."""
        self._kept = None

    def resume(self, other):
        """Go on from another one's states."""
        self._states[:] = other._states
        self._kept = other._kept if self._corner else None

    def advance(self, dt):
        """The next input comes `dt` [s] after the last one."""
        self._kept = np.exp(-self._corner * dt)

    def state_space(self, dt):
        r"""Of samples `dt` [s] apart: :math:`w' = A w + B x,\; v = C w + D x`; four matrices."""
        n, kept = self._states.shape[1], np.exp(-self._corner * dt)
        rows, through = np.zeros((n, POLES * n)), np.eye(n)
        A, B = np.zeros((POLES * n, POLES * n)), np.zeros((POLES * n, n))
        for k in range(POLES):
            here = slice(k * n, (k + 1) * n)
            rows, through = (1.0 - kept) * rows, (1.0 - kept) * through
            rows[:, here] += kept * np.eye(n)
            A[here], B[here] = rows, through
        return A, B, rows, through

    def __call__(self, torque):
        """Pass a torque, shape (n,), in place."""
        if not self._corner:
            return torque
        for state in self._states:
            if self._kept is None:
                state[:] = torque
            else:
                state -= torque
                state *= self._kept
                state += torque
                torque[:] = state
        return torque
