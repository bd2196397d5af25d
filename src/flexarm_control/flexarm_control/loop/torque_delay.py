# SPDX-License-Identifier: Apache-2.0
r"""Measures how long after a state's stamp the torque that answers it acts, from the torques that the driver reports.

A driver reports the mean torque over the interval that ends at a sample's stamp. With u_j the answer to sample j, held
until the next one acts, and a delay of (k + f) periods, 0 <= f < 1, it reports at sample j + 1

.. math:: r_{j+1} = (1 - f)\,u_{j-k} + f\,u_{j-k-1} .

Over a block of samples, f follows for each k by least squares, and the k with the smallest residual is the delay. A
lost state has no answer, so the torque before it goes on. A torque that hardly changes does not show the delay. Nor
does one that fits no k. If a driver reports the torque at the stamp, and not the mean before it, the delay looks
shorter by up to a period.

The control relies on the delay that is `known`. For it, the means over the block are subtracted, so that an offset of
what the driver reports does not count. A gain does: if the torque changes smoothly, a gain of 1.01 looks like a delay
of several periods. So only blocks count that fit well, and whose torque changes by much from sample to sample. At rest
it does so because the sensors have noise.
"""

from collections import deque

import numpy as np

#: Longest delay that is considered, in periods; samples in a block; and periods that are remembered.
LAGS, BLOCK, SENT = 32, 16, 128
#: A k fits if its residual is at most this fraction of the torque's change from sample to sample, both as sums of
#: squares [-].
FITS = 0.5
#: Smallest change of the torque from sample to sample that shows a delay, as a fraction of the torque's size [-].
CHANGES = 1e-8
#: The delay is known from blocks whose residual is at most the first number times the torque's change and deviation
#: from its mean, as sums of squares, and whose change is at least the second number times this deviation [-]. It is the
#: median of the last `MEDIAN` of these blocks, and of `LEAST` at least.
FITS_WELL, CHANGES_MUCH, MEDIAN, LEAST = 0.05, 0.1, 5, 3
#: A period that differs from the last one by more than this fraction begins a new block [-].
SAME = 0.2


class TorqueDelay:
    """Measures the delay; see the module.

    Parameters
    ----------
    n : int
        Number of joints.

    Attributes
    ----------
    delay : float
        Delay of the last block that shows one [s]; NaN before the first.
    count : int
        Number of blocks that have shown a delay.
    known : float
        Delay that the control can rely on [s]; NaN: not known.
    """

    def __init__(self, n):
        self.delay, self.count, self.known = np.nan, 0, np.nan
        self._last = deque(maxlen=MEDIAN)
        self._sent = np.zeros((SENT, n))  # by periods, the newest at `_now`
        self._reported, self._at = np.zeros((BLOCK, 1, n)), np.zeros((BLOCK, 1), int)
        self._ages = np.arange(LAGS + 2)
        self._u = np.zeros((BLOCK, LAGS + 2, n))
        self._rest, self._change = np.zeros((2, BLOCK, LAGS + 1, n))
        self._period = 0.0
        self.begin()

    def begin(self):
        """Begin after an interruption; torques sent before it do not count."""
        self._now = self._size = 0

    def note(self, torque):
        """Remember the torque (n,) [N m] that answers the present sample."""
        self._now += 1
        self._sent[self._now % SENT] = torque

    def add(self, reported, count, period):
        """Note what a driver reports at a sample; call it before `note`.

        Parameters
        ----------
        reported : ndarray, shape (n,)
            Torque applied since the previous sample [N m].
        count : int
            Number of periods since the last sample that came.
        period : float
            Length of a period [s].
        """
        if not abs(period - self._period) <= SAME * self._period:
            self._period = period
            self.begin()
        if not self._now:
            return
        for _ in range(min(count - 1, SENT)):
            self.note(self._sent[self._now % SENT])
        if self._size == BLOCK:
            self._size = 0
        self._reported[self._size, 0], self._at[self._size] = reported, self._now
        self._size += 1

    def judge(self):
        """Take the delay from a complete block, if it shows one; call once the torque is sent."""
        if self._size < BLOCK:
            return
        self._size = 0
        first = int(self._at[0, 0])
        if first <= LAGS + 1 or self._now - first + LAGS + 2 > SENT:
            return
        u, r, d = self._u, self._rest, self._change
        np.take(self._sent, (self._at - self._ages) % SENT, axis=0, out=u)
        np.subtract(self._reported, u[:, :-1], out=r)
        np.subtract(u[:, 1:], u[:, :-1], out=d)
        sums = np.array([np.einsum("ikn,ikn->k", x, y) for x, y in ((r, r), (r, d), (d, d))])
        delay, rest, change = self._fitted(*sums)
        least = CHANGES**2 * np.vdot(self._reported, self._reported)
        if change > least and rest <= FITS * change:
            self.delay = delay
            self.count += 1
        r, d = r.mean(axis=0), d.mean(axis=0)
        means = [np.einsum("kn,kn->k", x, y) for x, y in ((r, r), (r, d), (d, d))]
        self._rely_on(*self._fitted(*(sums - BLOCK * np.array(means))), least)

    def _fitted(self, rest, both, change):
        """Delay [s] of the k with the smallest residual, the residual, and the torque's change from sample to sample.

        For each k, (LAGS + 1,): sums of squares of what is left without f, and of the changes, and their product.
        """
        f = np.clip(both / np.maximum(change, 1e-300), 0.0, 1.0)
        rest = rest - f * (2.0 * both - f * change)
        k = int(np.argmin(rest))
        return float((k + f[k]) * self._period), rest[k], change[k]

    def _rely_on(self, delay, rest, change, least):
        """Take the block for `known`, if it fits well without means, and its torque changes much."""
        reported = self._reported - self._reported.mean(axis=0)
        varies = np.vdot(reported, reported)
        fits = rest <= FITS_WELL * min(change, varies)
        if fits and change > least and change >= CHANGES_MUCH**2 * varies:
            self._last.append(delay)
            if len(self._last) >= LEAST:
                self.known = float(np.median(self._last))
