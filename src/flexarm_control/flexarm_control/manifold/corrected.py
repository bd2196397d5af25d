# SPDX-License-Identifier: Apache-2.0
r"""The integral manifold of the slow motion, to any order in mu.

On the slow manifold the joints move as the slow law requires, :math:`\ddot q_s = a + B\bar u`, and the deflections
move with them. The modal rows of (2) along that motion,

.. math:: M_{21}\ddot q_s + M_{22}\ddot\delta + f_2 + C_2\dot\delta + K_2\delta = 0,

have one solution that does not vibrate. K_2 is of order 1/mu^2, so this solution follows from the fixed-point iteration

.. math::
    \delta^{(0)} &= -K_2^{-1}(M_{21}\ddot q_s + f_2), \qquad \dot\delta^{(0)} = 0 \\
    \dot\delta^{(k+1)} &= \tfrac{d}{dt}\delta^{(k)} \\
    \delta^{(k+1)} &= \delta^{(0)} - K_2^{-1}\bigl(M_{22}\tfrac{d}{dt}\dot\delta^{(k)} + C_2\dot\delta^{(k)}\bigr),

the expansion of the integral manifold (Sobolev 1984; Spong, Khorasani & Kokotovic 1987 for flexible joints) in
z = (delta, delta_d). Order 0 is the paper's (9), order 1 adds the rates, order 2 the inertia of the bending; the
error is of order mu^(k+1). The joint rows of (2) give the torque with which the joints move as the slow law requires:

.. math:: u = \bar u + M_{12}\ddot\delta + C_1\dot\delta + K_1(\delta - \delta^{(0)}) .

The derivatives are taken along the slow motion through the present state, by central differences over
`expansion.step`. The reference is known, and under the slow law the tracking error decays by
:math:`\ddot e = -k_v\dot e - k_p e`. So the manifold is valid off the reference, too, and the slow poles stay where
they were placed. docs/theory.md has the derivation, docs/control.md the measured powers of mu.
"""

import numpy as np
from scipy.linalg import expm

from flexarm_dynamics.parameters import parameter

from .base import Manifold
from .expansion import expand, reach, step


class CorrectedManifold(Manifold):
    """The integral manifold; see the module."""

    PARAMETERS = (
        parameter("order", 2, "-", 0, 6).described(
            "Order of the corrected manifold in mu: 0 is the paper's, 1 adds the rates of the deflections, 2 their"
            " inertia; every two orders more need two more derivatives of the reference."
        ),
    )

    def __init__(self, model, slow, parameters):
        super().__init__(model, slow, parameters)
        self.order = self.parameters["order"]
        self._reach, self._step = reach(self.order), step(self.order)
        self._flow = self._error_flow()

    def _error_flow(self):
        """Matrices from the tracking error (e, de/dt) now to that at each stencil point; None without a linear law."""
        gains = self.slow.error_gains()
        if gains is None:
            return None
        kp, kv = gains
        n = self.model.n_joints
        A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(kp), -np.diag(kv)]])
        return {i: expm(A * i * self._step) for i in range(-self._reach, self._reach + 1)}

    def update(self, q, qd, reference, terms, slow_torque):
        here = slow_acceleration(terms, slow_torque)
        error = np.concatenate([reference.position - q, reference.velocity - qd])
        extra, motions = (
            here - reference.acceleration,
            np.empty((2 * self._reach + 1, 3, here.size)),
        )
        for i, motion in enumerate(motions):
            if i == self._reach:
                motion[:] = q, qd, here
            else:
                motion[:] = self._motion(i - self._reach, reference, error, extra)
        found = expand(self.model.terms_along(motions), motions[:, 2], self.order)
        self.amplitude[:], self.rate[:] = found.delta, found.rate
        self.feedforward[:] = found.beyond

    def _motion(self, j, reference, error, extra):
        """Position, velocity, acceleration of the slow motion at a point of the stencil, (3, n)."""
        motion, t, n = reference.near(j * self._step).copy(), j * self._step, self.model.n_joints
        if self._flow is None:
            # For another kind of law, the acceleration that it adds to the reference's is taken as constant.
            motion[0] += -error[:n] - t * error[n:] + 0.5 * t * t * extra
            motion[1] += -error[n:] + t * extra
            motion[2] += extra
            return motion
        later = self._flow[j] @ error
        kp, kv = self.slow.error_gains()
        motion[0] -= later[:n]
        motion[1] -= later[n:]
        motion[2] += kp * later[:n] + kv * later[n:]
        return motion


def slow_acceleration(terms, slow_torque):
    """Acceleration of the slow subsystem (10), from the joint rows of (2) with the modes at rest, shape (n,)."""
    M, n = terms.M, terms.n
    if not terms.K1.any():
        return np.linalg.solve(M[:n, :n], slow_torque - terms.f1)
    lift = np.linalg.solve(terms.K2.T, terms.K1.T).T
    right = slow_torque - terms.f1 + lift @ terms.f2
    return np.linalg.solve(M[:n, :n] - lift @ M[n:, :n], right)
