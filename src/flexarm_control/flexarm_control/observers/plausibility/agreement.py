# SPDX-License-Identifier: Apache-2.0
r"""Compares velocities with joint positions, and modal rates with modal amplitudes.

Over a window that began at sample 0, with the trapezoidal rule,

.. math::
    D = \sum_k \tfrac12(v_k + v_{k-1})\,h_k, \qquad
    |x - x_0 - D| \le s\max(|x - x_0|, |D|) + \tau|v - v_0| + 6\sqrt2\,\sigma + c + 2J|v|
    + \sum_k\left(\tfrac12|v_k - v_{k-1}|\,h_k + \tfrac14 G|\Delta u_k|\,h_k^2\right) + 6\sigma_v\sqrt{t\,h}

with :math:`\sigma`, c, J and :math:`G|\Delta u|` as in `jumps`; :math:`\tau` is the largest delay of a filtered rate.
The sum is what the rule can miss. This includes a step of the torque that moves a light joint and its links to and fro
between two samples: if a mode is as fast as the sampling, such a swing begins and ends in the same phase. Windows of
`WINDOWS` samples run at the same time. `PERSISTENT` samples in a row beyond the bound are evidence of an error: a sign
is wrong, a scale is wrong by more than s, one of the two stands still, or the value drifts.

s is 10 %. It is 35 % if the phase of a mode turns by more than a radian in a sample: then the rule misses this mode's
swings, but the check still finds a factor of two. If the phase of a mode turns by more than `ALIASED` in a sample, the
next mode, which the model may not have, can be near the sampling frequency. A light joint that swings with it is in the
same phase in many samples in a row, and its velocity then differs from the mean motion of its position. In this case s
counts only once a window has `LONG` samples; before, s is 1, which finds only a wrong sign.
"""

import numpy as np

from ... import kernels
from ...kernels import readings

#: Lengths of the windows in samples; the short one is quick, the long one is for slow motion and coarse encoders.
WINDOWS = (20, 200)
#: Samples in a row beyond the bound.
PERSISTENT = 4
#: Ratio by which a rate may be wrong [-].
SCALE = 0.1
#: For modes that are fast for the sampling: the same ratio, and a factor on what the trapezoidal rule can miss [-].
FAST_SCALE, FAST_MISSED = 0.35, 2.0
#: If a mode's phase turns by more than this per sample, the next mode may be aliased [rad]; number of samples from
#: which on a window then counts fully.
ALIASED, LONG = 2.0, 100
#: Delay of a rate that its source has filtered [s].
LATE = 0.005
#: Number of standard deviations that noise may reach.
DEVIATIONS = 6.0


class Agreement:
    """Compares the rates of joints and modes with their values, by pairs.

    Parameters
    ----------
    channels : Channels

    Attributes
    ----------
    changed, driven : ndarray, shape (2, n + m)
        In each window, the change of the value, and the change that the rate gives.
    pairs : ndarray of int, shape (2, n + m)
        Index of each value, and of its rate.
    """

    def __init__(self, channels):
        c = self.channels = channels
        index = np.arange(c.size)
        values = np.concatenate([index[c.position], index[c.amplitude]])
        rates = np.concatenate([index[c.velocity], index[c.rate]])
        self.pairs = np.stack([values, rates])
        self._count = np.concatenate([c.count, np.zeros(c.m)])
        difference = DEVIATIONS * np.sqrt(2.0) * c.noise[values] + self._count
        self._noise = np.stack([difference, DEVIATIONS * c.noise[rates]])
        size = values.size
        self._gain, self._kernels = np.ascontiguousarray(c.gain[values]), kernels.compiled()
        self._windows = np.zeros((6, len(WINDOWS), size))
        self.changed, self.driven = self._windows[readings.CHANGED], self._windows[readings.DRIVEN]
        self._ages, self._evidence = np.zeros((2, len(WINDOWS))), np.zeros((2, len(WINDOWS), size))
        self._rate = np.zeros(size)
        self.reset()

    def reset(self):
        """Forget the past."""
        self._begun = False
        self._run = np.zeros(self.pairs.shape[1], int)

    def update(self, value, dt, jitter, change):
        """Take a new sample.

        Parameters
        ----------
        value : ndarray, shape (N,)
            Readings.
        dt : float
            Time since the last sample [s].
        jitter : float
            Jitter of the stamps [s].
        change : ndarray, shape (n,)
            Step of the torque in that time [N m].

        Returns
        -------
        ndarray of int or None
            Pairs for which there is evidence; None in nearly all samples.
        """
        if not self._begun:
            self._begun = self._kernels.is_given(value, self.pairs[1])
            self._kernels.begin_agreement(value, self.pairs, self._rate, self._windows, self._ages)
            return None
        turn = self.channels.fastest * dt
        scale, missed = (FAST_SCALE, FAST_MISSED) if turn > 1.0 else (SCALE, 1.0)
        factors = scale, missed, LATE, LONG if turn > ALIASED else 0
        verdict = self._kernels.agree(
            value, self.pairs, dt, jitter, change, self._gain, factors, self._noise, WINDOWS, self._rate,
            self._windows, self._ages, self._run, self._evidence,
        )  # fmt: skip
        if verdict != readings.BEYOND:
            self._begun = verdict != readings.UNKNOWN
            return None
        found = np.flatnonzero(self._run >= PERSISTENT)
        return found if found.size else None

    def stands(self, j):
        """Whether the value of pair j does not change at all."""
        return not self._evidence[0][:, j].any()

    def words(self, j):
        """What is wrong with pair j, without its name."""
        changed, driven = (both[:, j] for both in self._evidence)
        i = int(np.argmax(np.abs(changed - driven)))
        changed, driven = changed[i], driven[i]
        numbers = f"the position changed by {changed:.3g}, the velocity gives {driven:.3g}"
        if j >= self.channels.n:
            numbers = f"the amplitude changed by {changed:.3g}, the rate gives {driven:.3g}"
        if changed * driven < 0.0:
            return f"has the wrong sign: {numbers}"
        return f"is wrong: {numbers}"
