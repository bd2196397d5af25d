# SPDX-License-Identifier: Apache-2.0
r"""Linear model following, (17) of Siciliano & Book (1986), for any number of joints.

.. math::
    \bar u = B^{-1}(q)\,[\ddot\theta_{ref} + k_v(\dot\theta_{ref} - \dot\theta) + k_p(\theta_{ref} - \theta)]

The inverse of B of the slow subsystem (10) is the rigid arm's inertia, `m11` for one link. The published law
multiplies by ``1/h11`` instead, with H = M^-1. The slow poles are then not where they were designed
(-2.14 +- 0.88j instead of the double pole -2.5 on the paper's arm). ``gain: h11`` reproduces that.

The law assumes that the nonlinear terms a of (10) are small: no gravity, slow motion. Otherwise use `model_following`.
"""

import numpy as np

from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_subsystem

from .. import kernels
from .base import KP, KV, SlowLaw


class LinearModelFollowing(SlowLaw):
    """The law (17); see the module."""

    PARAMETERS = (
        KP,
        KV,
        parameter("gain", "m11", choices=("m11", "h11")).described(
            "Factor of the acceleration: m11, the inverse of B in (10), or h11, as published."
        ),
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.kp = np.array(self.parameters["kp"])
        self.kv = np.array(self.parameters["kv"])
        self._pull, self._damp, self._v = -self.kp, -self.kv, np.zeros(model.n_joints)
        self.printed = self.parameters["gain"] == "h11"
        self._cached = (None, None, None)

    def B_inverse(self, terms):
        """The matrix in front of the bracket of (17), shape (n, n) [kg m^2]."""
        # B depends on M of (2) and on gravity's K1. Each stays the same object as long as it is constant.
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

    def nominal_at(self, q, qd, acceleration):
        return self._inverse_at(q, qd) @ acceleration

    def torque(self, q, qd, reference, terms):
        return self.B_inverse(terms) @ self._wanted(q, qd, reference)

    def torque_at(self, q, qd, reference):
        return self._inverse_at(q, qd) @ self._wanted(q, qd, reference)

    def _inverse_at(self, q, qd):
        """`B_inverse` at joint positions and velocities; computes terms only if it may change with them."""
        if self.model.same_inertia and self._cached[2] is not None:
            return self._cached[2]
        return self.B_inverse(self.model.terms(q, qd))

    def _wanted(self, q, qd, reference):
        """The bracket of (17), (n,) [rad/s^2]; overwritten by the next call."""
        kernels.compiled().wanted_acceleration(
            q, qd, reference.position, reference.velocity, reference.acceleration, self._pull, self._damp, self._v
        )  # fmt: skip
        return self._v
