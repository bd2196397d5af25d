# SPDX-License-Identifier: Apache-2.0
r"""The paper's reconstructing filter: a derivative with a first-order low-pass filter.

.. math:: \hat{\dot\delta}(s) = \frac{\omega_c s}{s + \omega_c}\,\delta(s)

It is discretised exactly for a deflection that moves linearly between samples, with the sample's own time step h:

.. math::
    \hat{\dot\delta}_k = s_k + (\hat{\dot\delta}_{k-1} - s_k)\,e^{-\omega_c h},
    \qquad s_k = (\delta_k - \delta_{k-1})/h .

It needs no model. A slow rate is delayed by 1/omega_c + omega_c h^2/12, and noise is amplified by omega_c.
(Sangveraphunsiri 1984 after Siciliano & Book 1986.)
"""

from flexarm_dynamics.parameters import parameter

from .. import kernels
from .base import Observer


class FilteredDerivative(Observer):
    """First-order filtered derivative; see the module."""

    PARAMETERS = (
        parameter("bandwidth", 1000.0, "rad/s", 1.0, 1e6).described(
            "Corner frequency of the filtered derivative."
        ),
    )

    #: Number of time constants after which the start is forgotten.
    SETTLING = 5.0

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.bandwidth = self.parameters["bandwidth"]
        self._filter = kernels.compiled().filtered_derivative

    def update(self, sample, dt):
        if self._elapsed < 0.0:
            self.amplitude[:] = sample.amplitude
            self.rate[:] = 0.0
            self._elapsed = 0.0
            return
        self._filter(sample.amplitude, dt, self.bandwidth, self.amplitude, self.rate)
        if not self.converged:
            self._elapsed += dt
            self.converged = self._elapsed * self.bandwidth >= self.SETTLING
