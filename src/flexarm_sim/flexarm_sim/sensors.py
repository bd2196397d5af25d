# SPDX-License-Identifier: Apache-2.0
r"""Sensors of the simulated arm: encoders and strain gauges.

A gauge reads, for the plant's amplitudes :math:`\delta`,

.. math:: \varepsilon = g\,R\,\delta + b + w + n

with the drift w, a random walk whose change over a sample of length h has the variance ``drift**2 h``, and the
white noise n. The bridge rounds this to counts and saturates at the ends of its range. Counts and range always apply
if the arm file states them; noise and drift only on request.
"""

import numpy as np

from flexarm_dynamics.arm.strain_map import reading_rows


class Sensors:
    """Readings of encoders and gauges of a plant.

    Parameters
    ----------
    model : ArmModel
        The plant's model: gauges measure all of its modes.
    noise : bool
        Whether gauges have the noise and drift of the arm file.
    seed : int
        Seed of noise and drift.
    period : float
        Time between two readings, over which the bias drifts [s].
    """

    def __init__(self, model, noise=False, seed=0, period=0.0):
        arm = model.arm
        self.rows = reading_rows(model, arm.gauges)
        self.bias = np.array([g.bias for g in arm.gauges])
        self.sigma = np.array([g.noise if noise else 0.0 for g in arm.gauges])
        #: Rms change of the bias from one reading to the next, shape (gauges,) [-].
        self.walk = np.array([g.drift if noise else 0.0 for g in arm.gauges]) * np.sqrt(period)
        self._low, self._high = np.array([g.range for g in arm.gauges]).reshape(-1, 2).T
        self._count = np.array([g.step for g in arm.gauges])  # [-] strain per count
        self._counted = self._count > 0.0
        # Needed at every sample: finding this out from an array takes longer than rounding it.
        self._drifts, self._is_noisy = bool(self.walk.any()), bool(self.sigma.any())
        counts = np.array([j.encoder_counts for j in arm.joints], float)
        self._step = np.where(counts > 0, 2.0 * np.pi / np.where(counts > 0, counts, 1.0), 0.0)
        self._quantised = self._step > 0.0
        self._rounds, self._counts = bool(self._quantised.any()), bool(self._counted.any())
        self._seed = seed
        self.reset()

    def reset(self):
        """Start the noise again, and the drift from zero."""
        self._random = np.random.default_rng(self._seed)
        # A separate stream: with or without drift, an arm file has the same noise.
        self._walk_random = np.random.default_rng([self._seed, 1])
        self.drift = np.zeros_like(self.bias)
        self._first = True

    def position(self, q, out):
        """Encoder readings of the angles `q`, rounded to counts if the arm file states them, into `out` (n,) [rad]."""
        out[:] = q
        if self._rounds:
            quantised = self._quantised
            out[quantised] = self._step[quantised] * np.round(q[quantised] / self._step[quantised])
        return out

    def strain(self, delta, out):
        """Gauge readings for amplitudes `delta`, one period after the last ones, into `out` (gauges,) [-]."""
        np.dot(self.rows, delta, out=out)
        out += self.bias
        if self._drifts:
            if not self._first:
                self.drift += self.walk * self._walk_random.standard_normal(out.size)
            self._first = False
            out += self.drift
        if self._is_noisy:
            out += self.sigma * self._random.standard_normal(out.size)
        if self._counts:
            c = self._counted
            out[c] = self._count[c] * np.round(out[c] / self._count[c])
        np.maximum(out, self._low, out=out)
        return np.minimum(out, self._high, out=out)
