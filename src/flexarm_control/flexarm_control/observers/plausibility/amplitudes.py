# SPDX-License-Identifier: Apache-2.0
r"""Compares modal amplitudes with strains, if an arm's driver sends both.

The amplitudes stand for the strains :math:`R\delta` at the gauges, with the rows R of the strain map. The strains stand
for :math:`R W\varepsilon` with its inverse W, without the part that no amplitudes cause. Both pass the same `low_pass`:
:math:`s = F[R W\varepsilon]`, :math:`d = F[R\delta] - s`. With the means :math:`s_0`, :math:`d_0` over the first
`LEARNT` seconds, which contain the bias of gauges without calibration,

.. math:: |d - d_0| \le Z\varepsilon_{max} + S\,\widehat{|s - s_0|} + \tau\,\widehat{|\dot s|}

The bound allows 0.6 % of full scale (Z), half of the strain (S = `SHARE`), and the delay :math:`\tau` (`LATE`) of a
source that filters. Another model's shapes or a gauge's gain cause a difference below S, a wrong sign or a factor of
two one above it. The hat is the largest value over all gauges in the last `KEPT` seconds or so. `PERSISTENT` samples in
a row beyond the bound are evidence. This does not show which of the two is wrong.
"""

from math import exp

import numpy as np

from ... import kernels
from ...kernels import readings, strains
from .agreement import LATE
from .low_pass import LowPass
from .strain_law import corner_of
from .zero_drift import LEARNT, ZERO

#: Fraction of the strain by which the two may differ [-].
SHARE = 0.5
#: Time constant in which a large strain is forgotten [s].
KEPT = 0.2
#: Samples in a row beyond the bound.
PERSISTENT = 4


class SourceAmplitudes:
    """Judges the modal amplitudes of an arm's driver by its strains.

    Parameters
    ----------
    channels : Channels
    strain_map : StrainMap

    Attributes
    ----------
    bound : float
        Bound of the largest difference [strain].
    """

    def __init__(self, channels, strain_map):
        c = self._channels = channels
        self._rows, self._project = strain_map.rows, strain_map.rows @ strain_map.inverse
        self._floor = ZERO * max(g.full_scale for g in c.model.arm.gauges)
        self._low, self._kernels = LowPass(2 * c.g, corner_of(c.model)), kernels.compiled()
        self._state = np.zeros(3)
        self.reset()

    def reset(self):
        """Forget the past, the zeros included."""
        self._age, self._count, self._beyond = 0.0, 0, 0
        self._zero = np.zeros(2 * self._channels.g)
        self._state[:], self.bound = 0.0, self._floor

    @property
    def difference(self):
        """Largest difference over the gauges at the last sample [strain]."""
        return float(self._state[strains.DIFFERENCE])

    def update(self, value, dt):
        """Take the readings of a new sample.

        Parameters
        ----------
        value : ndarray, shape (N,)
            As from `Channels.read`. Without amplitudes or strains, or with a gauge at an end of its range, the past is
            forgotten.
        dt : float
            Time since the last sample [s].

        Returns
        -------
        bool
            Whether amplitudes and strains contradict each other.
        """
        c, low, state = self._channels, self._low, self._state
        low.weigh(dt)
        ways = self._count, low.corner, exp(-dt / KEPT), self._age + dt <= LEARNT
        found = self._kernels.source_amplitudes(
            value, c.g, self._project, self._rows, *c.range, low.weights, low.rows, self._zero, state, ways
        )  # fmt: skip
        if found != readings.FIT:
            if self._count:
                self.reset()
            return False
        self._count += 1
        self._age += dt
        difference, large, fast = state.tolist()
        self.bound = self._floor + SHARE * large + LATE * fast
        self._beyond = self._beyond + 1 if difference > self.bound else 0
        return self._beyond >= PERSISTENT
