# SPDX-License-Identifier: Apache-2.0
r"""Model following that learns the payload (Slotine & Li 1987), on the slow subsystem (10).

The rigid arm's inverse dynamics are affine in the payload's mass and inertia. These are p times those of the arm file,
with the same centre of mass. The regressor Y is the torque that one more payload takes, the difference of two rigid
arms. C has Christoffel's form, so that Mdot - 2C is skew-symmetric. With a, B, C of the arm with the estimated payload,

.. math::
    s &= \dot e + \Lambda e, \qquad \dot q_r = \dot q_{ref} + \Lambda e, \qquad e = q_{ref} - q, \\
    \bar u &= B_{\hat p}^{-1}(\bar x)\,[\ddot q_r + \Lambda_2 s - a_{\hat p}(\bar x)] + C_{\hat p}(\bar x)\,s, \\
    \dot{\hat p} &= \gamma\,Y^T s, \qquad Y = \Delta M\,\ddot q_r + \Delta C\,\dot q_r + \Delta g, \qquad
    0 \le \hat p \le p_{max} \text{ by projection}.

:math:`V = \tfrac12 s^TM_ps + (\hat p - p)^2/2\gamma` has :math:`\dot V = -s^TM_{\hat p}\Lambda_2 s \le 0` (for
joints of equal rates). Therefore s and with it the error go to zero for every payload, and :math:`\hat p \to p` if the
motion excites it. -Lambda and -Lambda_2 are the poles of `kp` and `kv`, :math:`(\sigma + \Lambda)(\sigma +
\Lambda_2) = \sigma^2 + k_v\sigma + k_p`. With the payload known, the law is model following (13) plus C s; C s is
zero for one joint.

The estimate is part of the law's `model`, so that the slow manifold bends the links as that payload would. Otherwise
the fast control would work against any payload other than the arm file's, and mislead the estimate.

There is no leakage: at rest without gravity Y is zero and the estimate stays. The estimate is kept from one trajectory
to the next and forgotten when a session begins. The law does not adapt while the slow torque is beyond a joint's limit,
nor to an s within `dead_zone`: these errors do not come from the payload.

gamma is normalised so that `adaptation_gain` means the same for every arm. Under a steady acceleration A of one joint
the estimate's error obeys :math:`\ddot{\tilde p} + \Lambda_2\dot{\tilde p} + \Gamma A^2\tilde p = 0`. Under gravity,
gamma is lowered so that the weight alone adds no more than :math:`\Lambda_2^2` to the last factor.

The law assumes that everything except the payload is known, and that the payload in the arm file is not zero, since the
estimate is a multiple of it.
"""

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_subsystem

from .base import KP, KV, SlowLaw
from .payload_model import PayloadModel, need_payload
from .rigid_arm import rigid_arm

#: Number of configurations over which the adaptation gain is normalised.
CONFIGURATIONS = 64


class AdaptiveModelFollowing(SlowLaw):
    """Model following with an estimate of the payload; see the module.

    Attributes
    ----------
    payload_scale : float
        The estimate: the payload as a multiple of the arm file's.
    learning : float
        Rate of the estimate at the last sample [1/s].
    model : PayloadModel
        The arm with that payload; the `terms` that `torque` gets are taken from it.

    Raises
    ------
    DesignError
        If the arm file's payload is zero, or kp and kv give oscillating poles.
    """

    learns = True
    PARAMETERS = (
        KP,
        KV,
        parameter("adaptation_gain", 0.3, "s^2", 0.0, 1e4).described(
            "How fast adaptive model following learns: squared frequency of the estimate per squared acceleration; 0.0:"
            " not at all."
        ),
        parameter("payload_scale_max", 5.0, "-", 1.0, 1e3).described(
            "Upper bound of adaptive model following's payload estimate, as a multiple of the arm file's payload."
        ),
        parameter("dead_zone", 0.02, "rad/s", 0.0, 10.0).described(
            "Adaptive model following does not adapt to a combined error s below this, such as bending and noise cause."
        ),
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.kp, self.kv = np.array(self.parameters["kp"]), np.array(self.parameters["kv"])
        self._rates()
        need_payload(model, "adaptive_model_following")
        self.model = PayloadModel(model)
        self._one = rigid_arm(model.arm)
        self._two = self._one.with_payload(2.0)
        self._at_rest = np.zeros(model.n_joints)
        self.gamma = self._normalised_gain()
        self._most, self._dead_zone = (
            self.parameters["payload_scale_max"],
            self.parameters["dead_zone"],
        )
        self._limit = model.arm.torque_limits
        self.learning = 0.0

    @property
    def payload_scale(self):
        """The estimate, as a multiple of the arm file's payload [-]."""
        return self.model.scale

    def _rates(self):
        """Set Lambda and Lambda_2, (n,) [1/s]."""
        kp, kv = self.kp, self.kv
        root = kv**2 - 4.0 * kp
        if root.min() < 0.0:
            i = int(np.argmin(root))
            raise DesignError(
                f"1/s with slow.kp[{i}] = {kp[i]:g} 1/s^2 makes {self.model.joint_names[i]} oscillate",
                field=f"slow.kv[{i}]",
                value=float(kv[i]),
                limit=f"at least {2.0 * kp[i] ** 0.5:g}",
                hint="adaptive_model_following needs real poles",
            )
        root = np.sqrt(root)
        self.surface, self.approach = 0.5 * (kv - root), 0.5 * (kv + root)

    def _normalised_gain(self):
        """gamma of the module [1/(N m s) per rad/s], from the largest regressor over configurations."""
        inertia = weight = 0.0
        random = np.random.default_rng(0)
        for q in random.uniform(-np.pi, np.pi, (CONFIGURATIONS, self.model.n_joints)):
            M = self._one.mass_matrix(q)
            extra = self._two.mass_matrix(q) - M
            heavy = self._difference(q, self._at_rest)
            inertia = max(inertia, np.linalg.norm(extra @ np.linalg.solve(M, extra), 2))
            weight = max(weight, heavy @ np.linalg.solve(M, heavy))
        if not inertia > 0.0:
            raise DesignError(
                f"no joint of arm {self.model.arm.name} moves it: adaptive_model_following has nothing to learn",
                field="payload",
            )
        gain = self.parameters["adaptation_gain"]
        slowest = max(self.approach.min(), 1e-6)
        return gain / (inertia + gain * weight / slowest**2)

    def _difference(self, q, qd):
        """Velocity and gravity torque that one more payload takes, shape (n,) [N m]."""
        return self._two.forces(q, qd) - self._one.forces(q, qd)

    @staticmethod
    def _coriolis(forces, q, v, w):
        """C(q, v) w in Christoffel's form: the symmetric bilinear form of the quadratic form C(q, v) v."""
        return 0.25 * (forces(q, v + w) - forces(q, v - w))

    def error_gains(self):
        # C s is zero for a single joint.
        return (self.kp, self.kv) if self.model.n_joints == 1 else None

    def regressor(self, q, qd, speed, acceleration):
        """Y of the module for qd_r and qdd_r: torque that one more payload takes, shape (n,) [N m]."""
        extra = self._two.mass_matrix(q) - self._one.mass_matrix(q)
        Y = extra @ acceleration + self._difference(q, self._at_rest)
        if q.size > 1:
            Y += self._coriolis(self._difference, q, qd, speed)
        return Y

    def reset(self):
        self.model.scale, self.learning = 1.0, 0.0

    def resume(self, other):
        if isinstance(other, AdaptiveModelFollowing):
            self.model.scale = min(other.payload_scale, self._most)

    def advance(self, dt):
        scale = self.model.scale + dt * self.learning
        self.model.scale = min(max(scale, 0.0), self._most)

    def torque(self, q, qd, reference, terms):
        error, rate = reference.position - q, reference.velocity - qd
        s = rate + self.surface * error
        speed = qd + s  # qd_r
        acceleration = reference.acceleration + self.surface * rate  # qdd_r
        a, B = slow_subsystem(terms)
        u = np.linalg.solve(B, acceleration + self.approach * s - a)
        if q.size > 1:
            u += self._coriolis(self._one.forces, q, qd, s)
            u += (self.model.scale - 1.0) * self._coriolis(self._difference, q, qd, s)
        beyond = (np.abs(u) > self._limit).any()
        beyond_zone = s - np.clip(s, -self._dead_zone, self._dead_zone)
        Y = self.regressor(q, qd, speed, acceleration)
        self.learning = 0.0 if beyond else self.gamma * float(Y @ beyond_zone)
        return u
