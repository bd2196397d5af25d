# SPDX-License-Identifier: Apache-2.0
r"""Compares velocities with joint positions, and modal rates with modal amplitudes.

Over a window that began at sample 0, with the trapezoidal rule,

.. math::
    D = \sum_k \tfrac12(v_k + v_{k-1})\,h_k, \qquad
    |x - x_0 - D| \le s\max(|x - x_0|, |D|) + \tau|v - v_0| + 6\sqrt2\,\sigma + c + 2J|v|
    + \sum_k\left(\tfrac12|v_k - v_{k-1}|\,h_k + \tfrac14 G|\Delta u_k|\,h_k^2\right) + 6\sigma_v\sqrt{t\,h}

with :math:`\sigma`, c, J and :math:`G|\Delta u|` as in `jumps`, and :math:`\tau` by which a filtered rate may be late.
The sum is what the rule can miss: also that a step of the torque moves a light joint and its links to and fro between
two samples, which begin and end such a swing in the same phase when a mode is as fast as the sampling. Windows of
`WINDOWS` samples run at the same time; `PERSISTENT` samples in a row beyond the bound are evidence: a sign is wrong, a
scale by more than s, one of the two stands still, or the value drifts.
s is 10 %, and 50 % for an arm with a mode that turns by more than a radian in a sample: the rule misses its swings.
"""

import numpy as np

#: Lengths of the windows in samples; the short one is quick, the long one sees slow motion and coarse encoders.
WINDOWS = (20, 200)
#: Samples in a row beyond the bound.
PERSISTENT = 4
#: Ratio by which a rate may be wrong [-].
SCALE = 0.1
#: The same, and the factor of what the trapezoidal rule can miss, where modes are fast for the sampling [-].
FAST_SCALE, FAST_MISSED = 0.5, 2.0
#: Delay of a rate that its source has filtered [s].
LATE = 0.005
#: Standard deviations that noise may reach.
DEVIATIONS = 6.0


class Agreement:
    """Compares the rates of joints and modes with their values, by pairs.

    Parameters
    ----------
    channels : Channels

    Attributes
    ----------
    changed, driven : ndarray, shape (2, n + m)
        In each window: change of the value, and what the rate gives.
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
        self._noise = DEVIATIONS * np.sqrt(2.0) * c.noise[values] + self._count
        self._rate_noise = DEVIATIONS * c.noise[rates]
        size = values.size
        self._gain = c.gain[values]
        self.changed, self.driven, self._missed, self._between = np.zeros((4, len(WINDOWS), size))
        self._start, self._first = np.zeros((2, len(WINDOWS), size))
        self.reset()

    def reset(self):
        """Forget the past."""
        size = self.pairs.shape[1]
        self._last = None
        self._rate = np.full(size, np.nan)
        self._age, self._time = np.zeros(len(WINDOWS), int), np.zeros(len(WINDOWS))
        self._run = np.zeros(size, int)

    def update(self, value, dt, jitter, change):
        """Take a new sample.

        Parameters
        ----------
        value : ndarray, shape (N,)
            Readings.
        dt : float
            Since the last sample [s].
        jitter : float
            Of the stamps [s].
        change : ndarray, shape (n,)
            Step of the torque in that time [N m].

        Returns
        -------
        ndarray of int or None
            Pairs for which there is evidence; None in nearly all samples.
        """
        rate = value[self.pairs[1]]
        if not np.isfinite(rate).any():  # none is given
            self._last = None
            return None
        at = value[self.pairs[0]]
        if self._last is None:
            self._last = at
            self._start[:], self._first[:] = at, rate
            self.driven[:] = self._missed[:] = self._between[:] = 0.0
            self._age[:], self._time[:] = 0, 0.0
            self._rate = rate
            return None
        mean = 0.5 * dt * (rate + self._rate)
        self.driven += mean
        self._missed += np.abs(rate - self._rate) * (0.5 * dt)
        self._between += self._gain @ change * (0.25 * dt * dt)
        np.subtract(at, self._start, out=self.changed)
        self._last, self._rate = at, rate
        bound = np.maximum(np.abs(self.changed), np.abs(self.driven))
        fast = self.channels.fastest * dt > 1.0
        bound *= FAST_SCALE if fast else SCALE
        bound += FAST_MISSED * self._missed if fast else self._missed
        bound += self._between
        bound += LATE * np.abs(rate - self._first)
        bound += self._noise
        if jitter > 0.0:
            bound += 2.0 * jitter * np.abs(rate)
        for i in range(len(WINDOWS)):
            self._time[i] += dt
            bound[i] += self._rate_noise * np.sqrt(self._time[i] * dt)
        wrong = (np.abs(self.changed - self.driven) > bound).any(axis=0)
        self._run[~wrong] = 0
        self._run[wrong] += 1
        found = None
        if wrong.any():
            found = np.flatnonzero(self._run >= PERSISTENT)
            self._evidence = self.changed.copy(), self.driven.copy()
        self._renew(at, rate)
        return found if found is not None and found.size else None

    def _renew(self, at, rate):
        # A rate that comes again starts anew: its window began with NaN. The other pairs' windows go on.
        unknown = np.isnan(self.driven[0])
        if unknown.any():
            self._start[:, unknown], self._first[:, unknown] = at[unknown], rate[unknown]
            self.driven[:, unknown] = self._missed[:, unknown] = 0.0
            self._between[:, unknown] = 0.0
        for i, length in enumerate(WINDOWS):
            self._age[i] += 1
            if self._age[i] >= length:
                self._age[i], self._time[i] = 0, 0.0
                self._start[i], self._first[i] = at, rate
                self.driven[i] = self._missed[i] = self._between[i] = 0.0

    def stands(self, j):
        """Whether it is the value of pair j that does not change at all."""
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
