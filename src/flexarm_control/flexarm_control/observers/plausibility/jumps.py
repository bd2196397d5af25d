# SPDX-License-Identifier: Apache-2.0
r"""Finds readings that no arm makes, by comparing each with the straight line through the ones before it.

With the time h to the last sample and T the baseline of the slope s, :math:`\rho = h/T`,

.. math::
    r = x_k - (x_{k-1} + s h), \qquad
    |r| \le 6\sigma\sqrt{1 + (1+\rho)^2 + \rho^2} + (1+\rho)(c + 2J|s|) + S\,(a + G|\Delta u| + 2e)

with the noise :math:`\sigma`, the encoder's step c, the stamps' jitter J (the largest recent deviation from the
mean period), the accelerations a and :math:`G|\Delta u|` of `channels`, and S = h(h+T)/2 for positions, (h+T)/2 for
rates. e is the largest excess of :math:`|r|/S` over the noise in the last 20 ms or so, since a motion that has begun
may go on. If the torque is unknown, or zero on every joint, so that brakes may act, :math:`\Delta u` is the largest
torque. Lost samples count as such a step, too, for the links; for the joints they count as the fraction `UNREPORTED` of
it. The noise is the larger of the value in `channels` and the rms of r so far. The first `LEARNT` samples are not
judged.

A reading beyond its bound is replaced by the line, for `BRIDGED` samples in a row; after that the jump counts as real.
"""

from math import exp, sqrt

import numpy as np

from ... import kernels
from ...arrays import some
from ...kernels import readings

#: Number of samples in a row whose reading is replaced; at the next one the jump counts as lasting.
BRIDGED = 3
#: Number of samples after a start that serve only to learn the noise.
LEARNT = 50
#: A bound is this many standard deviations [-], and this multiple of the excess [-].
DEVIATIONS, GROWTH = 6.0, 2.0
#: Times in which an excess, and one bridged reading, are forgotten [s].
EXCESS_TIME, RARE_TIME = 0.02, 1.0
#: If more readings of one sensor than this are bridged, each forgotten in `RARE_TIME`, they are no single outliers.
FREQUENT = 8.0
#: Deflections can't be extrapolated over more than this many samples, lost ones included. Nor can they over a gap with
#: lost samples in which the phase of the fastest mode turns by more than this [rad].
MAX_STEPS, MAX_TURN = 3, 0.5
#: Fraction of the largest torque that may have acted on the joints, unreported, in lost samples [-].
UNREPORTED = 0.1


class Jumps:
    """Judges each reading by the ones before it.

    Parameters
    ----------
    channels : Channels

    Attributes
    ----------
    bridged : ndarray of int, shape (N,)
        Number of readings that were replaced since the observer was made.
    """

    def __init__(self, channels):
        self.channels = c = channels
        # A slope over several samples has a delay, which is worth it only if readings are rounded.
        self.span = 4 if c.count.any() else 1
        self.bridged = np.zeros(c.size, int)
        # Joints are extrapolated over any number of lost samples.
        self._far = np.zeros(c.size, bool)
        self._far[c.position] = self._far[c.velocity] = True
        # The torque of lost samples is unknown; it moves the links soon, the joints later.
        strength = np.where(np.isfinite(c.strength), c.strength, 0.0)
        lost = (c.gain @ strength) * np.where(self._far, UNREPORTED, 1.0)
        counts = np.zeros((2, c.size))
        counts[0, c.position] = counts[1, c.velocity] = c.count
        self._fixed = np.vstack([c.noise, c.push, c.is_rate, lost, counts])
        self._rows, self._torques = np.zeros((9, c.size)), np.zeros((4, c.n))
        self._value = self._rows[readings.CAME]
        self._line, self._bound = self._rows[readings.LINE], self._rows[readings.BOUND]
        self._residual, self._square = self._rows[readings.RESIDUAL], self._rows[readings.SQUARE]
        self._excess = self._rows[readings.EXCESS]
        self._replaced, self._kernels = np.zeros(c.size, bool), kernels.compiled()
        self.reset()

    def reset(self):
        """Forget the past: the next sample is the first."""
        size = self.channels.size
        self._past = np.full((self.span + 1, size), np.nan)
        self._times = np.zeros(self.span + 1)
        self._rows[:], self._often = 0.0, np.zeros(size)
        self._counts = np.zeros((2, size), int)
        self._run, self._grace = self._counts
        self._seen, self.period, self.jitter = 0, 0.0, 0.0
        self._unseen = 0.0
        self._torques[readings.LAST], self._torques[readings.CHANGE] = (
            np.nan,
            self.channels.strength,
        )

    def judge(self, value, torque, dt, steps):
        """Judge the readings of a new sample; only `take` remembers them.

        Parameters
        ----------
        value : ndarray, shape (N,)
            Readings; NaN: not given. Replaced readings are written into it.
        torque : ndarray, shape (n,)
            Torque applied until the sample [N m].
        dt : float
            Time since the last sample [s].
        steps : int
            Number of samples since then, lost ones included.

        Returns
        -------
        outliers : ndarray of int or None
            Indices of the readings that were replaced.
        lasting : ndarray of int or None
            Indices of those that jumped for good, which stay as they are; None in nearly all samples.
        """
        c, past, times = self.channels, self._past, self._times
        self._kernels.arrive(value, torque, c.strength, self._rows, self._torques)
        self._dt, self._steps = dt, steps
        self._late = abs(dt - steps * self.period) if self.period else 0.0
        self._outliers = self._lasting = None
        self._new_unseen = 0.0
        if self._seen < 2:
            return None, None
        self._new_unseen = 1.0 if steps > 1 else 0.5 * self._unseen
        first = max(self.span - self._seen + 1, 0)
        rho = dt / (times[-1] - times[first])
        self._spread = sqrt(1.0 + (1.0 + rho) ** 2 + rho * rho)
        beyond = self._kernels.judge_jumps(
            value, past, times, first, (dt, self._new_unseen), max(self.jitter, self._late), self.torque_change,
            self._fixed, c.gain, GROWTH, DEVIATIONS, self._rows,
        )  # fmt: skip
        if not beyond or self._seen < LEARNT:
            return None, None
        return self._sort_out(value, self._residual > self._bound)

    @property
    def _gap(self):
        """Whether too much time was lost before this sample to extrapolate the deflections by a line."""
        lost = self._steps > 1 and self.channels.fastest * self._dt > MAX_TURN
        return lost or self._steps > MAX_STEPS

    def _sort_out(self, value, wrong):
        wrong &= self._grace == 0
        if self._gap:
            wrong &= self._far
        if not wrong.any():
            return None, None
        lasting = wrong & (self._run >= BRIDGED)
        outliers = np.flatnonzero(wrong & ~lasting)
        value[outliers] = self._line[outliers]
        self._outliers, self._lasting = outliers, np.flatnonzero(lasting)
        return outliers, self._lasting if self._lasting.size else None

    def take(self, value, stamp):
        """Remember the sample that was judged last.

        Parameters
        ----------
        value : ndarray, shape (N,)
            Readings, as `judge` left them.
        stamp : float
            Time of the sample, from any origin [s].
        """
        dt = self._dt
        if self._seen >= 2:
            self._learn(dt)
        self._kernels.remember(value, stamp, self._past, self._times, self._torques)
        if self._lasting is not None and self._lasting.size:
            # The reading goes on from the new level; its slope shows in the next samples.
            self._past[:, self._lasting] = value[self._lasting]
            self._grace[self._lasting] = self.span + 2
            self._excess[self._lasting] = 0.0
        if self._gap:
            # The slope over the gap is not that of the present motion.
            self._grace[~self._far] = self.span + 2
        self._unseen = self._new_unseen
        self._seen += 1
        each = dt / self._steps
        if self._seen == 2:
            self.period = each
        elif self._seen > 2:
            self.period += 0.02 * (each - self.period)
            self.jitter = max(self._late, 0.995 * self.jitter)

    def _learn(self, dt):
        """Update noise and excess from the residuals of readings that were not replaced."""
        if self._outliers is not None:
            self._replaced[self._outliers] = True
            self.bridged[self._outliers] += 1
        self._kernels.learn_jumps(
            self._rows, self._replaced, self._counts, self._often, self._spread, self._seen < LEARNT,
            1.0 / min(self._seen, 1000), exp(-dt / EXCESS_TIME), exp(-dt / RARE_TIME),
        )  # fmt: skip

    @property
    def torque_change(self):
        """Step of the torque before the sample that was judged last, (n,); a large one if it is unknown [N m]."""
        return self._torques[readings.NEW_CHANGE]

    @property
    def rms(self):
        """Rms noise of the readings so far, by their residuals, shape (N,)."""
        return np.sqrt(self._square)

    def line(self, i):
        """Expected value of reading i."""
        return self._line[i]

    def read(self, i):
        """Actual value of reading i."""
        return self._value[i]

    def bound(self, i):
        """How far reading i may lie from the line."""
        return self._bound[i]

    @property
    def frequent(self):
        """Indices of the readings that were replaced too often lately."""
        return np.flatnonzero(self._often > FREQUENT) if some(self._often) else ()
