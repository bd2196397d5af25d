# SPDX-License-Identifier: Apache-2.0
r"""Linear model following, (17) of Siciliano & Book (1986), for any number of joints.

.. math::
    \bar u = B^{-1}(q)\,[\ddot\theta_{ref} + k_v(\dot\theta_{ref} - \dot\theta) + k_p(\theta_{ref} - \theta)]

with B of the slow subsystem (10), whose inverse is the rigid arm's inertia: `m11` for one link. The
published law multiplies by ``1/h11``, with H = M^-1: the slow poles are then not where they were designed
(-2.14 +- 0.88j instead of the double pole -2.5 on the paper's arm). ``gain: h11`` reproduces that.

Assumes that the nonlinear terms a of (10) are small: no gravity, slow motion. Else use `model_following`.
"""

import numpy as np

from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_subsystem

from .base import KP, KV, SlowLaw


class LinearModelFollowing(SlowLaw):
    """The law (17); see the module."""

    PARAMETERS = (
        KP,
        KV,
        parameter("gain", "m11", choices=("m11", "h11")).described(
            "What multiplies the acceleration: m11, the inverse of B in (10), or h11, as published."
        ),
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.kp = np.array(self.parameters["kp"])
        self.kv = np.array(self.parameters["kv"])
        self.printed = self.parameters["gain"] == "h11"
        self._cached = (None, None, None)

    def B_inverse(self, terms):
        """The matrix in front of the bracket of (17), shape (n, n) [kg m^2]."""
        # M of (2) and gravity's K1, which B depends on besides, are each one object as long as they are constant.
        M, K1, inverse = self._cached
        if M is not terms.M or K1 is not terms.K1:
            n = terms.n
            B = terms.H[:n, :n] if self.printed else slow_subsystem(terms)[1]
            inverse = np.linalg.inv(B)
            self._cached = terms.M, terms.K1, inverse
        return inverse

    def nominal(self, terms, acceleration):
        return self.B_inverse(terms) @ acceleration

    def warnings(self):
        if any(self.model.arm.gravity):
            return (
                "slow.type linear_model_following does not compensate gravity: the arm sags; use"
                " model_following",
            )
        return ()

    def error_gains(self):
        return None if self.printed else (self.kp, self.kv)

    def torque(self, q, qd, reference, terms):
        v = reference.position - q
        v *= self.kp
        v += self.kv * (reference.velocity - qd)
        v += reference.acceleration
        return self.B_inverse(terms) @ v
