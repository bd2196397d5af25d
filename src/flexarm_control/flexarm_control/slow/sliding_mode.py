# SPDX-License-Identifier: Apache-2.0
r"""Sliding mode with a boundary layer (Slotine 1985; Slotine & Li 1991, ch. 7), on the slow subsystem (10).

.. math::
    s &= \dot e + \Lambda e, \qquad \ddot q_r = \ddot q_{ref} + \Lambda\dot e, \qquad e = q_{ref} - q, \\
    \bar u &= B^{-1}(\bar x)\,[\ddot q_r - a(\bar x) + k(\bar x)\,\mathrm{sat}(s/\phi)].

The arm's own a', B' may differ from the model's by

.. math:: |a_i - a'_i| \le F_i, \qquad \|B'B^{-1} - 1\|_\infty \le \rho < 1,

where `disturbance_bound` gives F (payload's weight, friction, a push) and `inertia_error` gives rho. With

.. math::
    k_i = F_i + \eta_i + \rho\,(w + K), \qquad w = \|\ddot q_r - a\|_\infty, \qquad
    K = \frac{\max_i(F_i + \eta_i) + \rho w}{1 - \rho},

every joint outside its layer fulfils the sliding condition :math:`\tfrac12\tfrac{d}{dt}s_i^2 \le -\eta_i|s_i|`.
K is the largest k_i. So k_i also covers the other joints' switching, which acts through the wrong inertia. s reaches
the layer within :math:`(|s_i(0)| - \phi_i)/\eta_i` and stays in it. Inside, :math:`|e_i|` falls to
:math:`\phi_i/\Lambda_i`.

Inside the layer the law is linear, with bandwidth k/phi. If the layer is too thin, that bandwidth excites the fast
subsystem, which (10) neglects; `warnings` names the width to take.
"""

import numpy as np

from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_subsystem

from .base import SlowLaw

#: The layer's bandwidth should stay below this fraction of the links' lowest frequency with locked joints.
SEPARATION = 1.0 / 3.0


class SlidingMode(SlowLaw):
    """Sliding mode for bounded errors of the model; see the module."""

    PARAMETERS = (
        parameter("lambda", [2.5], "1/s", 0.0, 1e4, length="joints").described(
            "Rate at which the error decays on the sliding surface."
        ),
        parameter("eta", [0.5], "rad/s^2", 1e-6, 1e4, length="joints").described(
            "Minimum rate at which the sliding surface is approached."
        ),
        parameter("disturbance_bound", [0.5], "rad/s^2", 0.0, 1e4, length="joints").described(
            "Bound of the unmodelled acceleration of the joint, for sliding mode."
        ),
        parameter("inertia_error", 0.0, "-", 0.0, 0.95).described(
            "Bound of the relative error of the inertia, for sliding mode: largest row sum of B' B^-1 - 1."
        ),
        parameter("boundary_layer", [0.4], "rad/s", 1e-6, 1e3, length="joints").described(
            "Half width of the boundary layer around the sliding surface, in which sliding mode is linear."
        ),
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.slope, self._eta, bound, self.phi = (
            np.array(self.parameters[name])
            for name in ("lambda", "eta", "disturbance_bound", "boundary_layer")
        )
        self.rho = self.parameters["inertia_error"]
        self._sure = bound + self._eta

    def warnings(self):
        if not self.model.n_modes:
            return ()
        fast = self.model.frequencies(locked=True)[0]
        bandwidth = self.switching_gain(np.zeros(self.model.n_joints)) / self.phi
        i = int(np.argmax(bandwidth))
        if bandwidth[i] <= SEPARATION * fast:
            return ()
        return (
            f"slow.boundary_layer[{i}]: {self.phi[i]:g} rad/s gives sliding mode a bandwidth of {bandwidth[i]:.3g}"
            f" rad/s on {self.model.joint_names[i]}, too near the links' lowest frequency of {fast:.3g} rad/s: it"
            f" excites the bending; take at least {bandwidth[i] * self.phi[i] / (SEPARATION * fast):.2g}",
        )

    def switching_gain(self, acceleration):
        """k of the module for the acceleration that the model has to supply, qdd_r - a; (n,) [rad/s^2]."""
        asked = self.rho * np.abs(acceleration).max()
        most = (self._sure.max() + asked) / (1.0 - self.rho)
        return self._sure + asked + self.rho * most

    def torque(self, q, qd, reference, terms):
        error, rate = reference.position - q, reference.velocity - qd
        s = rate + self.slope * error
        a, B = slow_subsystem(terms)
        v = reference.acceleration + self.slope * rate - a
        v += self.switching_gain(v) * np.clip(s / self.phi, -1.0, 1.0)
        return np.linalg.solve(B, v)
