# SPDX-License-Identifier: Apache-2.0
r"""The paper's manifold, (9) of Siciliano & Book (1986): the quasi-steady state under the slow torque.

.. math:: \bar\delta = (H_{21}K_1 + H_{22}K_2)^{-1}(-H_{21}f_1 - H_{22}f_2 + H_{21}\bar u), \qquad \dot{\bar\delta} = 0

It is the limit mu = 0. The real deflections have rates and inertia. The fast control takes the effect of both for
vibration and works against the motion. The closer the time scales, the stronger this effect.
"""

from flexarm_dynamics.singular_perturbation import quasi_steady_state

from .base import Manifold


class QuasiSteady(Manifold):
    """Equation (9); see the module."""

    def update(self, q, qd, reference, terms, slow_torque):
        self.amplitude[:] = quasi_steady_state(terms, slow_torque)
