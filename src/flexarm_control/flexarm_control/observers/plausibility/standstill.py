# SPDX-License-Identifier: Apache-2.0
r"""Finds readings that stand still although they should not.

A reading is still while it is the same to the last bit. Quantised readings of an arm at rest are still, too, and so
is a simulated arm that is exactly at rest. Therefore stillness alone is no evidence. It is evidence

1. for a strain gauge, a joint velocity that is not zero, or the whole frame (all joints and gauges), if it lasts
   `ABRUPT` samples and began abruptly. Abruptly means: in the `BEFORE` samples before, the reading changed on average
   by more than `TIMES` times its smallest change so far, and so it did in one of the last two. In a frame, one reading
   that stops abruptly is enough. A smooth motion that ends or turns changes ever less before it is still: by less than
   twice the step of a converter in a sample. If both of the last two changes are smaller, a fast vibration may be
   turning. It does not stay still for twice `ABRUPT` samples, so stillness counts only after these.
2. for a gauge whose noise is stated and has been seen, if it lasts N samples with :math:`p^N < 10^{-14}`. Here
   :math:`p = \mathrm{erf}(s/2\sqrt2\sigma)` is the probability of the most probable count, with the gauge's step s.
   The noise has been seen if the readings' rms in `jumps` is at least half of it.
3. for a joint, if the torque should have moved it. Let :math:`\bar u` be the torque minus the arm's weight, plus the
   effect of the bent links on joints that stand, :math:`M_{12}M_{22}^{-1}(K_2\delta + f_2)`. The rigid arm then
   accelerates by :math:`a = M_{11}^{-1}\bar u`. Friction, the uncertainty of weight and bending, and the gauges' noise
   amount to at most :math:`\Delta u` at each joint, also at joints that turn. They may reduce a by
   :math:`|M_{11}^{-1}|\Delta u`, since a joint that carries others feels their effect. What is left of a is integrated
   twice from the time when the joint became still. There is evidence if this angle is more than `TRAVEL` steps of the
   joint's encoder, or `TRAVEL` times its noise.
"""

import numpy as np
from scipy.special import erf

from ... import kernels
from ...arrays import finite, some
from .channels import UNSTATED_POSITION
from .jumps import DEVIATIONS

#: Samples after which an abrupt stillness is noticed; samples before it that are compared; and the ratio of changes.
ABRUPT, BEFORE, TIMES = 6, 8, 6.0
#: Number of encoder steps by which the torque must move a joint.
TRAVEL = 10.0
#: A change of a strain below this fraction of its noise counts as none.
SLIGHT = 1e-6
#: Probability of a false alarm in one run of samples.
RARE = 1e-14
#: Torque of friction that the arm file may lack, as a fraction of the limit; and uncertain fraction of the weight.
FRICTION, WEIGHT = 0.05, 0.4


class Standstill:
    """Counts equal readings, and judges whether they can be true.

    Parameters
    ----------
    channels : Channels

    Attributes
    ----------
    still : ndarray of int, shape (n + g + n,)
        Number of samples for which each joint position, gauge and joint velocity has been the same.
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
        self._middle, self._half = np.zeros(size), np.full(size, np.inf)
        self._middle[c.n : c.n + c.g], self._half[c.n : c.n + c.g] = c.range
        self._last, self._same = np.zeros((2, size)), np.zeros(size, bool)
        self._gauges = np.stack([np.zeros(c.g), self._stated, self._needed])
        self._found, self._no_amplitude = np.zeros(size, bool), np.full(c.m, np.nan)
        self._kernels = kernels.compiled()
        self.reset()

    def reset(self):
        """Forget the past."""
        c, size = self.channels, self.still.size
        self.still[:] = 0
        self._begun = False
        self._changes = np.zeros((BEFORE, size))
        self._next = 0
        self._smallest = np.full(size, np.inf)
        self._moved = np.zeros((2, c.n))
        self._inertia = None

    def update(self, readings, torque, noise, dt, amplitude=None):
        """Take a new sample.

        Parameters
        ----------
        readings : ndarray, shape (n + g + n,)
            Joint positions, strains and joint velocities as received; NaN: not given.
        torque : ndarray, shape (n,)
            Torque; NaN: unknown.
        noise : ndarray, shape (g,)
            Rms noise of the gauges' readings so far.
        dt : float
            Time since the last sample [s].
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
        if not self._begun:
            self._begun, self._last[0] = True, readings
            return NOTHING
        some_still = self._kernels.changed(
            readings, self._last, self._middle, self._half, self._same
        )
        self._kernels.follow_changes(
            self._last[1], self._same, self.still, self._smallest, self._changes[self._next]
        )
        self._next = (self._next + 1) % BEFORE
        if not some_still:
            self._inertia = None
            return NOTHING
        return self._judge(readings, torque, noise, dt, amplitude)

    def _judge(self, readings, torque, noise, dt, amplitude):
        still, n, end = self.still, self.channels.n, self.channels.n + self.channels.g
        joints = NONE
        if some(still[:n]):
            joints = self._unmoved(readings[:n], torque, dt, amplitude)
        self._gauges[0] = noise
        frame = self._kernels.stopped(
            readings, still, self._smallest, self._changes, self._next, self._tiny, self._gauges, (ABRUPT, TIMES),
            self._found,
        )  # fmt: skip
        if not frame and not some(self._found):
            return joints, NONE, NONE, False
        gauges = np.flatnonzero(self._found[n:end])
        return joints, gauges, np.flatnonzero(self._found[end:]), frame

    def _unmoved(self, position, torque, dt, amplitude):
        """Joints that the torque should have moved since they became still."""
        n = self.channels.n
        if not finite(torque):
            return NONE
        if self._inertia is None:
            self._hold(position)
        amplitude = self._no_amplitude if amplitude is None else amplitude
        friction, found = (self._friction, WEIGHT), self._found[:n]
        moved = self._kernels.follow_joints(
            dt, torque, amplitude, self._inertia, self._held, self._bent, friction, self._travel, self.still[:n],
            ABRUPT, self._moved, found,
        )  # fmt: skip
        return np.flatnonzero(found) if moved else NONE

    def _hold(self, position):
        """Set inertia, weight and effect of the bent links for joints that stand at a `position` (n,) [rad]."""
        n = self.channels.n
        terms = self.channels.model.terms(position, np.zeros(n))
        self._inertia = np.linalg.inv(terms.M[:n, :n])
        across = np.linalg.solve(terms.M[n:, n:], terms.M[n:, :n]).T
        self._bent = across @ terms.K2
        weight, pushed = terms.f1 * self._gravity, across @ terms.f2 * self._gravity
        noise = np.linalg.norm(self._bent * self._amplitude_noise, axis=1)
        self._held = np.stack([weight, pushed, noise])


def _needed(gauge):
    """Number of equal readings in a row that a gauge's noise rules out."""
    if not gauge.noise > 0.0:
        return np.inf
    if not gauge.step:
        return ABRUPT
    p = float(erf(gauge.step / (2.0 * np.sqrt(2.0) * gauge.noise)))
    return max(np.ceil(np.log(RARE) / np.log(p)), ABRUPT) if p < 1.0 else np.inf


NONE = np.zeros(0, int)
NOTHING = NONE, NONE, NONE, False
