# SPDX-License-Identifier: Apache-2.0
r"""The laws of the baselines: PID of each joint, full-state LQR; `ArmController` calls them like a composite control.

`JointPid` is the law of the joint_trajectory_controller of ros2_controllers, for each joint by itself,

.. math:: u_i = k_p e_i + \Big[k_i\!\int\! e_i\,dt\Big]_{\pm w} + k_d\dot e_i + f_v\dot q_{ref,i} + f_a\ddot q_{ref,i}
    + g_i(q_{ref}), \qquad e = q_{ref} - q,

with the integral clamped at w [N m]. That controller has no term g, the weight of the rigid arm at the reference; it is
added because without it no arm under gravity could start.

`FullStateLqr` is optimal for the whole arm with its bending, linearised at rest in one configuration, in discrete time:

.. math:: u = u_{rigid}(q_{ref},\dot q_{ref},\ddot q_{ref}) + K\,(s_{ref} - s), \qquad
    \min\sum_k e^{2\alpha t_k}(s_k^TQs_k + u_k^TRu_k), \qquad s = (q, \delta, \dot q, \dot\delta),

about the reference, which consists of its joint motion, the deflections under its inertia forces and weight, and the
torque of the rigid arm's inverse dynamics.
"""

import numpy as np
from scipy.linalg import solve_discrete_are

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import linear_plant, sampled
from flexarm_dynamics.singular_perturbation import slow_subsystem


class Baseline:
    """What `ArmController` and `ClosedLoop` need from a control law.

    `seen` stores results of `along`; laws of the same arm that run the same motion may share it.

    Attributes
    ----------
    slow_torque, fast_torque, torque : ndarray, shape (n,)
        [N m]; a baseline has only the slow one.
    quasi_steady : ndarray, shape (m,)
        Deflections that are the goal of its control [m, rad].
    """

    feedforward = None
    needs_rates, free = True, False
    limit, fast_fraction = None, 1.0
    #: Number of points of a reference that `along` stores.
    MAX_STORED = 20000

    def __init__(self, model, seen=None):
        n, m = model.n_joints, model.n_modes
        self.model, self._seen = model, {} if seen is None else seen
        self.slow_torque, self.fast_torque = np.zeros(n), np.zeros(n)
        self.torque, self.quasi_steady = self.slow_torque, np.zeros(m)
        self._still = np.zeros(n)

    def reset(self):
        """Begin a new session."""

    def resume(self, other):
        """Take nothing over from another law."""

    def take_delay(self, delay):
        """Take no notice of the measured delay of the torque."""

    def step(self, q, qd, delta, delta_d, reference, dt=0.0):
        """Torque for one sample, (n,) [N m]; as `CompositeControl.step`."""
        self.slow_torque[:] = self._torque(np.concatenate([q, delta, qd, delta_d]), reference, dt)
        return self.torque

    def along(self, reference):
        """`_along` of a point of the reference, computed once."""
        key = b"".join(
            x.tobytes() for x in (reference.position, reference.velocity, reference.acceleration)
        )
        found = self._seen.get(key)
        if found is None:
            found = self._along(reference)
            if len(self._seen) < self.MAX_STORED:
                self._seen[key] = found
        return found


class JointPid(Baseline):
    """PID of each joint; see the module.

    The `gains`, each (n,), are ``p`` [N m/rad], ``i`` [N m/(rad s)], ``d`` [N m s/rad], ``i_clamp`` [N m],
    ``velocity`` [N m s/rad] and ``acceleration`` [kg m^2].
    """

    def __init__(self, model, gains, seen=None):
        super().__init__(model, seen)
        self.gains = {name: np.asarray(value, float) for name, value in gains.items()}
        self.integral, self._error = np.zeros(model.n_joints), np.zeros(model.n_joints)

    def reset(self):
        self.integral[:] = 0.0
        self._error[:] = 0.0

    def _torque(self, s, reference, dt):
        n, m, k = self.model.n_joints, self.model.n_modes, self.gains
        np.subtract(reference.position, s[:n], out=self._error)
        self.integral += dt * k["i"] * self._error
        np.clip(self.integral, -k["i_clamp"], k["i_clamp"], out=self.integral)
        u = k["p"] * self._error + self.integral
        u += k["d"] * (reference.velocity - s[n + m : 2 * n + m])
        u += k["velocity"] * reference.velocity + k["acceleration"] * reference.acceleration
        return u + self.along(reference)

    def _along(self, reference):
        """Weight of the rigid arm, (n,) [N m]."""
        return self.model.terms(reference.position, self._still).f1.copy()

    @property
    def K(self):
        """Feedback of s, without the integral, shape (n, 2 (n + m)): u = -K s."""
        n, m = self.model.n_joints, self.model.n_modes
        K = np.zeros((n, 2 * (n + m)))
        K[:, :n], K[:, n + m : 2 * n + m] = np.diag(self.gains["p"]), np.diag(self.gains["d"])
        return K

    def poles(self, q):
        """Poles of the arm under this law at rest in q, in continuous time [1/s]."""
        A, B = linear_plant(self.model, np.asarray(q, float), coulomb=False)
        return np.linalg.eigvals(A - B @ self.K)


class FullStateLqr(Baseline):
    """Optimal feedback of joints and deflections; see the module.

    Parameters
    ----------
    model : ArmModel
    q : ndarray, shape (n,)
        Configuration of the design [rad].
    rate : float
        [Hz]
    sizes : sequence of float
        Values that cost as much as the largest torque: joint error [rad], joint rate [rad/s], modal rate [m/s, rad/s].
    decay : float
        alpha, the prescribed degree of stability [1/s].
    feedforward : float
        Fraction of the rigid arm's torque for the reference's acceleration [-].
    seen : dict, optional
        As in `Baseline`.
    """

    def __init__(self, model, q, rate, sizes, decay=0.0, feedforward=1.0, seen=None):
        super().__init__(model, seen)
        self.K, self._feedforward = lqr_gain(model, q, rate, sizes, decay), feedforward

    def _torque(self, s, reference, dt):
        bent, still, moving = self.along(reference)
        self.quasi_steady[:] = bent
        wanted = np.concatenate(
            [reference.position, bent, reference.velocity, np.zeros(self.model.n_modes)]
        )
        return still + self._feedforward * moving + self.K @ (wanted - s)

    def _along(self, reference):
        """Quasi-static deflections (m,), torque without acceleration and torque for acceleration, each (n,) [N m]."""
        n, m = self.model.n_joints, self.model.n_modes
        terms = self.model.terms(reference.position, reference.velocity)
        a, B = slow_subsystem(terms)
        inertia = terms.M[n:, :n] @ reference.acceleration
        bent = np.linalg.solve(terms.K2, -inertia - terms.f2) if m else np.zeros(0)
        return bent, np.linalg.solve(B, -a), np.linalg.solve(B, reference.acceleration)


def slowest(plants, K, period):
    """Real part of the slowest pole of all sampled plants (Phi, Gamma) under u = -K s [1/s]."""
    radius = max(np.abs(np.linalg.eigvals(Phi - Gamma @ K)).max() for Phi, Gamma in plants)
    return float(np.log(radius) / period)


def lqr_gain(model, q, rate, sizes, decay=0.0):
    """K of `FullStateLqr`, shape (n, 2 (n + m)); raises DesignError."""
    n, m = model.n_joints, model.n_modes
    Phi, Gamma = sampled(*linear_plant(model, np.asarray(q, float), coulomb=False), 1.0 / rate)
    grown = np.exp(decay / rate)
    Phi, Gamma = grown * Phi, grown * Gamma
    joint, speed, modal = (1.0 / size**2 for size in sizes)
    Q = np.diag(np.repeat([joint, 0.0, speed, modal], [n, m, n, m]))
    largest = model.arm.torque_limits
    R = np.diag(1.0 / np.where(np.isfinite(largest), largest, 1.0) ** 2)
    try:
        P = solve_discrete_are(Phi, Gamma, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        problem = f"the Riccati equation has no stabilising solution: {error}"
        raise DesignError(
            problem, field=f"LQR of {model.arm.name}", hint="try other sizes"
        ) from None
    return np.linalg.solve(R + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi)
