# SPDX-License-Identifier: Apache-2.0
r"""The feed-forward's motion as an observer would see it.

An observer that has rates as filtered derivatives is late by 1 / omega_c, and a control that compares them with the
motion's own rates takes the lag for an error: on a motion that the model explains it would push against it. So the
motion's joint speeds and rates of deflections v pass the same filter, with the mean speed since the last sample in the
place of the difference of positions:

.. math:: r_k = d_k + (r_{k-1} - d_k)\,e^{-\omega_c h}, \qquad d_k = \tfrac12 (v_k + v_{k-1}) .

Where the arm follows the motion both are equal, and no error is left. A motion that is put to another place makes no
speed.
"""

import numpy as np


class SeenMotion:
    """A `Feedforward` with filtered `velocity` and `rate`; see the module.

    Parameters
    ----------
    motion : Feedforward
    joint_corner, rate_corner : float
        Of the observer's filters of joint speeds and of rates of deflections [rad/s]; 0.0: not filtered.

    Attributes
    ----------
    velocity : ndarray, shape (n,)
        [rad/s]
    rate : ndarray, shape (m,)
        [m/s, rad/s]
    """

    def __init__(self, motion, joint_corner, rate_corner):
        n, m = motion.velocity.size, motion.rate.size
        self._motion, self._count = motion, n
        self._corners = np.repeat([joint_corner, rate_corner], [n, m])
        self._plain = self._corners == 0.0
        self._now, self._last, self._mean, self._seen = np.zeros((4, n + m))
        self.velocity, self.rate = self._seen[:n], self._seen[n:]
        self._step, self._keep = 0.0, np.zeros(n + m)

    @property
    def position(self):
        """Joints of the motion, (n,) [rad]."""
        return self._motion.position

    @property
    def amplitude(self):
        """Its deflections, (m,) [m, rad]."""
        return self._motion.amplitude

    def reset(self):
        """The motion begins anew."""
        self._step = 0.0

    def take(self, other):
        """Go on as another one, of the same motion, would."""
        for mine, its in ((self._last, other._last), (self._seen, other._seen)):
            mine[:] = its

    def update(self, dt):
        """Move on to the motion's present sample, `dt` [s] after the last one; 0: the first one."""
        now, last, mean, seen, n = self._now, self._last, self._mean, self._seen, self._count
        now[:n], now[n:] = self._motion.velocity, self._motion.rate
        if dt > 0.0:
            if dt != self._step:
                np.exp(-dt * self._corners, out=self._keep)
                self._keep[self._plain] = 0.0
                self._step = dt
            np.add(now, last, out=mean)
            mean *= 0.5
            np.copyto(mean, now, where=self._plain)
            seen -= mean
            seen *= self._keep
            seen += mean
        else:
            seen[:] = now
        last[:] = now
