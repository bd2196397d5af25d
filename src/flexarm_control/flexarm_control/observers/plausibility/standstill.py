# SPDX-License-Identifier: Apache-2.0
r"""Finds readings that stand still although they should not.

A reading is still while it is the same to the last bit. Quantised readings of an arm at rest are still, too, and so
is a simulated arm that is exactly at rest; therefore stillness alone is no evidence. It is

1. of a strain gauge, of a joint velocity that is not zero, or of the whole frame (all joints and gauges), when it
   lasts `ABRUPT` samples and began abruptly: over the `BEFORE` samples before, the reading changed by more than
   `TIMES` times its smallest change so far. A smooth motion that ends, or turns, changes by ever less before it is
   still: less than twice the step of a converter in a sample.
2. of a gauge whose noise is stated and has been seen: with the probability :math:`p =
   \mathrm{erf}(s/2\sqrt2\sigma)` of the most probable count, s its step, when it lasts N samples with :math:`p^N <
   10^{-14}`. The noise has been seen when the readings' rms in `jumps` is at least half of it.
3. of a joint, when the torque should have moved it. With :math:`\bar u` the torque less the arm's weight, and what
   the bent links do to joints that stand, :math:`M_{12}M_{22}^{-1}(K_2\delta + f_2)`, the rigid arm accelerates by
   :math:`a = M_{11}^{-1}\bar u`. Friction, and what weight, bending and the gauges' noise leave unsure, is up to
   :math:`\Delta u` of each joint, of those that turn as well, and may take :math:`|M_{11}^{-1}|\Delta u` from it: a
   joint that carries others feels what they do. What is left of a since the joint has been still is integrated: it
   should have turned by more than `TRAVEL` of its encoder's steps, or of its noise.
"""

import numpy as np
from scipy.special import erf

from ... import kernels
from ...arrays import finite, some
from .channels import UNSTATED_POSITION
from .jumps import DEVIATIONS

#: Samples that an abrupt stillness lasts until it is noticed; samples before it; and the ratio of changes.
ABRUPT, BEFORE, TIMES = 6, 8, 6.0
#: Steps of its encoder that the torque must move a joint by.
TRAVEL = 10.0
#: A change of a strain below this fraction of its noise is none.
SLIGHT = 1e-6
#: Probability of a false alarm in one run of samples.
RARE = 1e-14
#: Torque that friction which the arm file does not state may hold, as a fraction of the limit; and of the weight.
FRICTION, WEIGHT = 0.05, 0.4


class Standstill:
    """Counts equal readings, and judges whether they can be true.

    Parameters
    ----------
    channels : Channels

    Attributes
    ----------
    still : ndarray of int, shape (n + g + n,)
        For how many samples each joint position, gauge and joint velocity has been the same.
    """

    def __init__(self, channels):
        c = self.channels = channels
        model = c.model
        size = 2 * c.n + c.g
        self.still = np.zeros(size, int)
        gauges = model.arm.gauges
        self._needed = np.array([_needed(g) for g in gauges], float)
        self._stated = np.array([g.uncertainty if g.noise > 0.0 else np.inf for g in gauges])
        parts = [np.full(c.n, UNSTATED_POSITION), c.noise[c.strain], c.noise[c.velocity]]
        self._tiny = SLIGHT * np.concatenate(parts)
        limits = np.where(np.isfinite(c.strength), c.strength, 0.0)
        coulomb = np.array([j.friction.coulomb for j in model.arm.joints])
        self._friction = 1.5 * coulomb + FRICTION * limits
        self._travel = TRAVEL * np.maximum(c.count, c.noise[c.position])
        self._gravity = any(model.arm.gravity)
        self._amplitude_noise = DEVIATIONS * c.noise[c.amplitude]
        self._gauges = slice(c.n, c.n + c.g)
        self._change, self._kernels = np.zeros(size), kernels.compiled()
        self.reset()

    def reset(self):
        """Forget the past."""
        c, size = self.channels, self.still.size
        self.still[:] = 0
        self._last = None
        self._changes = np.zeros((BEFORE, size))
        self._next = 0
        self._smallest = np.full(size, np.inf)
        self._speed, self._moved = np.zeros((2, c.n))
        self._inertia = self._weight = self._pushed = self._bent = None

    def update(self, readings, torque, noise, dt, amplitude=None):
        """Take a new sample.

        Parameters
        ----------
        readings : ndarray, shape (n + g + n,)
            Joint positions, strains and joint velocities as they came; NaN: not given.
        torque : ndarray, shape (n,)
            NaN: unknown.
        noise : ndarray, shape (g,)
            Rms of the gauges' readings so far.
        dt : float
            Since the last sample [s].
        amplitude : ndarray, shape (m,), optional
            Modal amplitudes.

        Returns
        -------
        joints : ndarray of int
            Joints that do not answer the torque.
        gauges : ndarray of int
            Gauges that stand still.
        velocities : ndarray of int
            Joint velocities that stand still.
        frame : bool
            Whether all joint positions and gauges stand still.
        """
        if self._last is None:
            self._last = readings.copy()
            return NONE, NONE, NONE, False
        change = self._change
        if not self._kernels.changed(readings, self._last, change):
            return self._all_moved(change)
        same = change == 0.0
        # A gauge at the end of its range stands still, too: `GaugeHealth` says what it is.
        same[self._gauges] &= ~self.channels.at_end(readings[self._gauges])
        if not some(same):
            return self._all_moved(change)
        self.still += 1
        self.still[~same] = 0
        np.fmin(self._smallest, change, out=self._smallest, where=~same)
        self._remember(change, same)
        return self._judge(readings, torque, noise, dt, amplitude)

    def _all_moved(self, change):
        """What `update` gives for readings of which none stands still."""
        self.still[:] = 0
        self._kernels.less(self._smallest, change)
        self._changes[self._next] = change
        self._next = (self._next + 1) % BEFORE
        self._inertia = None
        return NONE, NONE, NONE, False

    def _remember(self, change, same):
        """Keep the changes before a reading became still; those of a still one are kept as they are."""
        np.copyto(self._changes[self._next], change, where=~same)
        self._next = (self._next + 1) % BEFORE

    def _judge(self, readings, torque, noise, dt, amplitude):
        still, n, end = self.still, self.channels.n, self.channels.n + self.channels.g
        joints = NONE
        if some(still[:n]):
            joints = self._unmoved(readings[:n], torque, dt, amplitude)
        quiet = still >= ABRUPT
        if not some(quiet):
            return joints, NONE, NONE, False
        mean = self._changes.mean(axis=0)
        abrupt = quiet & (mean > TIMES * self._smallest) & (mean > self._tiny)
        # A joint that a brake has stopped is still at once; its velocity is zero then, and the links swing.
        frame = bool(end > n and quiet[:end].all() and abrupt[:end].any())
        silent = (noise >= 0.5 * self._stated) & (still[n:end] >= self._needed)
        gauges = np.flatnonzero(abrupt[n:end] | silent)
        velocities = np.flatnonzero(abrupt[end:] & (readings[end:] != 0.0))
        return joints, gauges, velocities, frame

    def _unmoved(self, position, torque, dt, amplitude):
        """Joints that the torque should have moved since they have been still."""
        still = self.still[: self.channels.n]
        if not finite(torque):
            return NONE
        if self._inertia is None:
            terms = self.channels.model.terms(position, np.zeros(position.size))
            size = position.size
            self._inertia = np.linalg.inv(terms.M[:size, :size])
            self._weight = terms.f1.copy() if self._gravity else np.zeros(size)
            across = np.linalg.solve(terms.M[size:, size:], terms.M[size:, :size]).T
            self._pushed, self._bent = across @ terms.f2 * self._gravity, across @ terms.K2
            self._noise = np.linalg.norm(self._bent * self._amplitude_noise, axis=1)
        bent = 0.0 * self._weight
        if amplitude is not None and finite(amplitude):
            bent = self._pushed + self._bent @ amplitude
        unsure = self._friction + WEIGHT * (np.abs(self._weight) + np.abs(bent)) + self._noise
        wanted = self._inertia @ (torque - self._weight + bent)
        left = np.maximum(np.abs(wanted) - np.abs(self._inertia) @ unsure, 0.0)
        if not some(torque):
            left[:] = 0.0  # nothing acts, or brakes do
        began = still <= 1
        self._speed[began] = self._moved[began] = 0.0
        self._speed += dt * np.sign(wanted) * left
        self._moved += dt * self._speed
        return np.flatnonzero((still >= ABRUPT) & (np.abs(self._moved) > self._travel))


def _needed(gauge):
    """Equal readings in a row that a gauge's noise rules out."""
    if not gauge.noise > 0.0:
        return np.inf
    if not gauge.step:
        return ABRUPT
    p = float(erf(gauge.step / (2.0 * np.sqrt(2.0) * gauge.noise)))
    return max(np.ceil(np.log(RARE) / np.log(p)), ABRUPT) if p < 1.0 else np.inf


NONE = np.zeros(0, int)
