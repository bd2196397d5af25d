# SPDX-License-Identifier: Apache-2.0
r"""Computed torque with an integral, on the slow subsystem (10) of Siciliano & Book (1986).

.. math::
    \bar u = B^{-1}(x_c)\,[\ddot q_{ref} + k_v\dot e + k_p e + w - a(x_c)], \qquad
    \dot w = k_i e, \quad |w| \le w_{max}, \qquad e = q_{ref} - q .

This is the inverse dynamics of the rigid arm (a contains Coriolis, gravity and friction terms) with feedback (Luh,
Walker & Paul 1980; Sciavicco & Siciliano, *Modelling and control of robot manipulators*, ch. 6). With ``ki = 0`` and
``feedforward_at: state`` it is `model_following` (13) itself. It differs from that law in two things:

- The integral w removes the error at rest that a wrong payload, gravity or friction d causes; (13) leaves B d / kp.
  The loop is stable for ki < kp kv (Routh). w stops at its limit. While the slow torque is beyond a joint's limit, w
  does not grow in that direction.
- a and B are taken at x_c. This is the measured state or, with ``feedforward_at: reference``, the reference
  (q_ref, qd_ref). With the reference, no noise of measured speeds is fed back through Coulomb friction and Coriolis
  terms. But the terms are then cancelled only where the error is zero. A remainder of first order in the error is left
  to the gains.

The law assumes that a and B are known up to a slowly varying torque. Its error dynamics are linear with ``state`` only.
"""

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_subsystem

from .base import KP, KV, SlowLaw


class ComputedTorque(SlowLaw):
    """Inverse dynamics with PID feedback; see the module.

    Attributes
    ----------
    integral : ndarray, shape (n,)
        w [rad/s^2].

    Raises
    ------
    DesignError
        If ki is not below kp kv, because the error would grow.
    """

    PARAMETERS = (
        KP,
        KV,
        parameter("ki", [0.0], "1/s^3", 0.0, 1e8, length="joints").described(
            "Integral gain of computed torque, below kp kv; 0.0: none."
        ),
        parameter("integral_limit", [2.0], "rad/s^2", 0.0, 1e4, length="joints").described(
            "Largest acceleration that the integral of computed torque may add."
        ),
        parameter("feedforward_at", "state", choices=("state", "reference")).described(
            "Where computed torque evaluates inertia, Coriolis, gravity and friction: at the measured state or at the"
            " reference."
        ),
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.kp, self.kv, self.ki, self._most = (
            np.array(self.parameters[name]) for name in ("kp", "kv", "ki", "integral_limit")
        )
        self.at_reference = self.parameters["feedforward_at"] == "reference"
        self._check_stability()
        self._limit = model.arm.torque_limits
        n = model.n_joints
        self.integral, self._error, self._beyond = np.zeros(n), np.zeros(n), np.zeros(n)

    def _check_stability(self):
        unstable = (self.ki > 0.0) & (self.ki >= self.kp * self.kv)
        if unstable.any():
            i = int(np.argmax(unstable))
            raise DesignError(
                f"1/s^3 is not below kp kv: the error of {self.model.joint_names[i]} would grow",
                field=f"slow.ki[{i}]",
                value=float(self.ki[i]),
                limit=f"{self.kp[i] * self.kv[i]:g} 1/s^3",
                hint="lower slow.ki or raise slow.kp, slow.kv",
            )

    def error_gains(self):
        return None if self.at_reference or self.ki.any() else (self.kp, self.kv)

    def reset(self):
        for state in (self.integral, self._error, self._beyond):
            state[:] = 0.0

    def resume(self, other):
        if isinstance(other, ComputedTorque):
            np.clip(other.integral, -self._most, self._most, out=self.integral)
            self.integral *= self.ki > 0.0

    def advance(self, dt):
        # Where the torque is beyond its limit, an error that pushes further is not integrated.
        grows = np.where(self._beyond * self._error > 0.0, 0.0, self._error)
        self.integral += dt * self.ki * grows
        np.clip(self.integral, -self._most, self._most, out=self.integral)

    def torque(self, q, qd, reference, terms):
        np.subtract(reference.position, q, out=self._error)
        v = self.kp * self._error
        v += self.kv * (reference.velocity - qd)
        v += reference.acceleration
        v += self.integral
        if self.at_reference:
            terms = self.model.terms(reference.position, reference.velocity)
        a, B = slow_subsystem(terms)
        u = np.linalg.solve(B, v - a)
        self._beyond[:] = np.sign(u) * (np.abs(u) > self._limit)
        return u
