# SPDX-License-Identifier: Apache-2.0
r"""Resolved acceleration control (Luh, Walker & Paul 1980) of the tip, on the slow subsystem (10).

.. math::
    \bar u &= B^{-1}(\bar x)\,[y - a(\bar x)], \\
    b &= \ddot x_{ref} + \kappa_v(\dot x_{ref} - \dot x) + \kappa_p(x_{ref} - x) - \dot J\dot q, \\
    y &= y_0 + J^{*}(b - J y_0), \qquad y_0 = \ddot q_{ref} + k_v\dot e + k_p e .

Here x is the tip of the straight arm and J (3, n) the Jacobian of its position. x_ref and its derivatives follow from
the joints' reference by the same kinematics. Where J has full rank, the tip's error obeys
:math:`\ddot e_x = -\kappa_v\dot e_x - \kappa_p e_x` whatever the joints do. In the directions that do not move the tip
(the null space, for redundant arms) the joints follow their own law y_0.

:math:`J^*` is the damped inverse of Nakamura & Hanafusa (1986), :math:`\sigma/(\sigma^2 + \lambda^2)` for each
singular value. The damping :math:`\lambda^2 = \varepsilon^2 - \sigma^2` sets in where sigma is below epsilon and grows
towards the singularity. The inverse is thus 1/sigma above epsilon and sigma/epsilon^2 below. Below, the tip's law has
the weight (sigma/epsilon)^2 and y_0 has the rest. So no special case is needed for a stretched arm, or for
directions in which a planar arm or a single joint can't move its tip.

The law assumes that a and B are as in the arm file, and that the arm is on the same side of a singularity as its
reference (elbow up or down). Otherwise the tip arrives with the other elbow.
"""

import numpy as np

from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_subsystem

from .base import KP, KV, SlowLaw
from .rigid_arm import Tip


class ResolvedAcceleration(SlowLaw):
    """Resolved acceleration of tip and null space; see the module."""

    PARAMETERS = (
        KP,
        KV,
        parameter("tip_kp", 6.25, "1/s^2", 0.0, 1e6).described(
            "Position gain of the tip in resolved acceleration."
        ),
        parameter("tip_kv", 5.0, "1/s", 0.0, 1e4).described(
            "Velocity gain of the tip in resolved acceleration."
        ),
        parameter("singularity", 0.05, "-", 1e-6, 1.0).described(
            "Singular value of the tip's Jacobian, as a fraction of the arm's reach, below which resolved acceleration"
            " hands over to the joints' gains."
        ),
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.kp, self.kv = np.array(self.parameters["kp"]), np.array(self.parameters["kv"])
        self.tip_kp, self.tip_kv = self.parameters["tip_kp"], self.parameters["tip_kv"]
        self.tip = Tip(model.arm)
        self._smallest = self.parameters["singularity"] * self.tip.reach  # [m]

    def damped_inverse(self, J):
        """J* (n, 3) of the module [1/m]."""
        U, sigma, Vt = np.linalg.svd(J, full_matrices=False)
        gain = sigma / np.maximum(sigma, self._smallest) ** 2
        return (Vt.T * gain) @ U.T

    def acceleration(self, q, qd, reference):
        """y, the desired joint acceleration, shape (n,) [rad/s^2]."""
        x, J, bias = self.tip.at(q, qd)
        x_ref, J_ref, bias_ref = self.tip.at(reference.position, reference.velocity)
        b = J_ref @ reference.acceleration + bias_ref - bias
        b += self.tip_kv * (J_ref @ reference.velocity - J @ qd) + self.tip_kp * (x_ref - x)
        y = reference.acceleration + self.kv * (reference.velocity - qd)
        y += self.kp * (reference.position - q)
        return y + self.damped_inverse(J) @ (b - J @ y)

    def torque(self, q, qd, reference, terms):
        a, B = slow_subsystem(terms)
        return np.linalg.solve(B, self.acceleration(q, qd, reference) - a)
