r"""Controllers that are no composite control, with its interface: what `ArmController` calls.

`JointPid`, as the joint_trajectory_controller of ros2_controllers has it, each joint by itself,

.. math:: u_i = k_p e_i + \Big[k_i\!\int\! e_i\,dt\Big]_{\pm w} + k_d\dot e_i + f_v\dot q_{ref,i} + f_a\ddot q_{ref,i}
    + g_i(q_{ref}), \qquad e = q_{ref} - q,

the integral clamped at w [N m]. The weight g of the rigid arm at the reference is more than that controller has: no
arm under gravity could start without.

`FullStateLqr`, optimal on the whole arm with its bending, linear at rest in one configuration, in discrete time:

.. math:: u = u_{rigid}(q_{ref},\dot q_{ref},\ddot q_{ref}) + K\,(s_{ref} - s), \qquad
    \min\sum_k e^{2\alpha t_k}(s_k^TQs_k + u_k^TRu_k), \qquad s = (q, \delta, \dot q, \dot\delta),

about the reference: its joints, the deflections that its inertia forces and weight bend the arm by, and the torque of
the rigid arm's inverse dynamics.
"""

import numpy as np
from scipy.linalg import solve_discrete_are

from flexarm_control.full_order import linear_plant, sampled
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.singular_perturbation import slow_subsystem


class Rival:
    """What `ArmController` and `ClosedLoop` want of a control law.

    Parameters
    ----------
    model : ArmModel

    Attributes
    ----------
    slow_torque, fast_torque, torque : ndarray, shape (n,)
        [N m]; a rival has one torque, the slow one.
    quasi_steady : ndarray, shape (m,)
        Deflections that it holds the arm to [m, rad].
    """

    feedforward = None
    needs_rates = True
    limit = None

    def __init__(self, model):
        n, m = model.n_joints, model.n_modes
        self.model = model
        self.slow_torque, self.fast_torque = np.zeros(n), np.zeros(n)
        self.torque, self.quasi_steady = self.slow_torque, np.zeros(m)
        self._still = np.zeros(n)

    def reset(self):
        """A new session begins."""

    def resume(self, other):
        """Nothing is taken over."""

    def step(self, q, qd, delta, delta_d, reference, dt=0.0):
        """Torque for one sample, (n,) [N m]; as `CompositeControl.step`."""
        self.slow_torque[:] = self._torque(np.concatenate([q, delta, qd, delta_d]), reference, dt)
        return self.torque


class JointPid(Rival):
    """PID of each joint; see the module.

    Parameters
    ----------
    model : ArmModel
    gains : mapping of str to ndarray, shape (n,)
        ``p`` [N m/rad], ``i`` [N m/(rad s)], ``d`` [N m s/rad], ``i_clamp`` [N m], ``velocity`` [N m s/rad],
        ``acceleration`` [kg m^2].
    """

    def __init__(self, model, gains):
        super().__init__(model)
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
        return u + self.model.terms(reference.position, self._still).f1

    @property
    def K(self):
        """Feedback of s, integral left out, shape (n, 2 (n + m)): u = -K s."""
        n, m = self.model.n_joints, self.model.n_modes
        K = np.zeros((n, 2 * (n + m)))
        K[:, :n], K[:, n + m : 2 * n + m] = np.diag(self.gains["p"]), np.diag(self.gains["d"])
        return K

    def poles(self, q):
        """Poles of the arm under this law at rest in q, in continuous time [1/s]."""
        A, B = linear_plant(self.model, np.asarray(q, float), coulomb=False)
        return np.linalg.eigvals(A - B @ self.K)


class FullStateLqr(Rival):
    """Optimal feedback of joints and deflections; see the module.

    Parameters
    ----------
    model : ArmModel
    q : ndarray, shape (n,)
        Configuration of the design [rad].
    rate : float
        [Hz]
    sizes : sequence of float
        What is as bad as the largest torque: joint error [rad], joint rate [rad/s], modal rate [m/s, rad/s].
    decay : float
        alpha, the prescribed degree of stability [1/s].
    feedforward : float
        Share of the rigid arm's torque for the reference's acceleration [-].

    Raises
    ------
    DesignError
        When the Riccati equation has no stabilising solution.
    """

    def __init__(self, model, q, rate, sizes, decay=0.0, feedforward=1.0):
        super().__init__(model)
        self.K, self._share = lqr_gain(model, q, rate, sizes, decay), feedforward

    def _torque(self, s, reference, dt):
        n, m, model = self.model.n_joints, self.model.n_modes, self.model
        terms = model.terms(reference.position, reference.velocity)
        acceleration = self._share * reference.acceleration
        a, B = slow_subsystem(terms)
        inertia = terms.M[n:, :n] @ reference.acceleration
        self.quasi_steady[:] = np.linalg.solve(terms.K2, -inertia - terms.f2) if m else 0.0
        wanted = np.concatenate(
            [reference.position, self.quasi_steady, reference.velocity, np.zeros(m)]
        )
        return np.linalg.solve(B, acceleration - a) + self.K @ (wanted - s)


def slowest(plants, K, period):
    """Real part of the slowest pole of sampled plants (Phi, Gamma) under u = -K s, the worst of all [1/s]."""
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
    largest = np.array([joint.limits.torque for joint in model.arm.joints])
    R = np.diag(1.0 / np.where(np.isfinite(largest), largest, 1.0) ** 2)
    try:
        P = solve_discrete_are(Phi, Gamma, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(
            f"LQR of {model.arm.name}: no stabilising solution of the Riccati equation ({error}); other sizes"
        ) from None
    return np.linalg.solve(R + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi)
