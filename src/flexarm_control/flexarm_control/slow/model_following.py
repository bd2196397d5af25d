# SPDX-License-Identifier: Apache-2.0
r"""Model following with compensation, the general form (13)-(14) of Siciliano & Book (1986).

.. math::
    \bar u &= B^\dagger(\bar x)\,[-a(\bar x) + v], \qquad
    v = \Lambda_0 q + \Lambda_1\dot q + \hat u, \\
    \hat u &= \ddot\theta_{ref} - \Lambda_0\theta_{ref} - \Lambda_1\dot\theta_{ref} .

The last line is the inverse of the reference model (14). The slow subsystem (10) then follows the
reference perfectly: the error obeys e'' = Lambda_1 e' + Lambda_0 e, with Lambda_0 = -diag(kp) and
Lambda_1 = -diag(kv), and stays zero once it is zero.

The law assumes that a(x) and B(x) are known: gravity, friction and payload are as in the arm file.
"""

import numpy as np

from flexarm_dynamics.singular_perturbation import slow_torque

from .. import kernels
from .base import KP, KV, SlowLaw


class ModelFollowing(SlowLaw):
    """The law (13) with (14); see the module."""

    PARAMETERS = (KP, KV)

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.Lambda0 = -np.array(self.parameters["kp"])
        self.Lambda1 = -np.array(self.parameters["kv"])
        self._v = np.zeros(model.n_joints)

    def error_gains(self):
        return -self.Lambda0, -self.Lambda1

    def torque(self, q, qd, reference, terms):
        return slow_torque(terms, self._wanted(q, qd, reference))

    def torque_at(self, q, qd, reference):
        return self.model.slow_torque(q, qd, self._wanted(q, qd, reference))

    def nominal_at(self, q, qd, acceleration):
        return self.model.slow_torque(q, qd, acceleration)

    def _wanted(self, q, qd, reference):
        """v, the desired acceleration of the slow subsystem, (n,) [rad/s^2]; overwritten by the next call."""
        kernels.compiled().wanted_acceleration(
            q, qd, reference.position, reference.velocity, reference.acceleration, self.Lambda0, self.Lambda1, self._v
        )  # fmt: skip
        return self._v
