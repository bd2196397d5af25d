r"""Feed-forward from a model that runs along: the nominal arm, simulated under a regulator of its own.

The slow manifold along the reference, :math:`s_{ref} = (q_{ref}, \bar\delta, \dot q_{ref}, \dot{\bar\delta})` with
its torque u_ref, would be a motion of the arm if it never jumped and its expansion in mu did not end. Both
it does: the rates of the deflections jump wherever the reference's jerk does, and a fast control that pulls the
real arm over such a jump kicks the joints, which return no faster than the slow poles. So the nominal arm
is simulated here instead, with the control model, under

.. math:: u_s = u_{ref} + K_s\,(s_{ref} - s),

where K_s is the optimal regulator of the *whole* arm, joints and bending, with prescribed degree of stability.
Nothing but the reference acts on it: neither noise, nor delay, nor an unknown payload limits its gains, and it
brings joints and bending to the reference in about a period of the slowest mode. (s, u_s) is a motion of the nominal
arm, sample by sample, within its torque limits; the composite control holds the real arm to it with the gains that
the real arm allows.

The regulator minimises :math:`\int e^{2\alpha t}(e^T Q e + u^T u)\,dt` of the joint errors e alone, with
:math:`Q^{1/2} = M_{11}\omega_1^2` and :math:`\alpha = 0.3\,\omega_1`, omega_1 the lowest bending frequency: the
joints are held about as stiffly as the softest mode is, which is what that mode can still follow.
"""

import numpy as np
from scipy.linalg import solve_discrete_are

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.fixed_step import METHODS, substeps

from ..full_order import linear_plant, sampled
from .base import Feedforward

#: Prescribed degree of stability of the regulator, over the lowest bending frequency.
DECAY = 0.3
#: Beyond this joint error the simulated arm begins anew on the reference [rad].
LOST = 1.0


def regulator(model, q, period):
    """Optimal gain K_s of the whole arm at rest in a configuration, shape (n, 2 (n + m)); see the module.

    Parameters
    ----------
    model : ArmModel
    q : ndarray, shape (n,)
        [rad]
    period : float
        Of the samples [s].

    Raises
    ------
    DesignError
        When the Riccati equation has no stabilising solution.
    """
    n = model.n_joints
    omega = float(model.frequencies(q)[0]) if model.n_modes else 10.0
    Phi, Gamma = sampled(*linear_plant(model, q), period)
    grow = np.exp(DECAY * omega * period)
    Q = np.zeros(Phi.shape)
    inertia = np.diag(model.terms(q, np.zeros(n)).M)[:n]
    Q[:n, :n] = np.diag((inertia * omega**2) ** 2)
    try:
        P = solve_discrete_are(grow * Phi, grow * Gamma, Q, np.eye(n))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(
            f"feedforward model: no regulator of {model.arm.name} at joint configuration {np.round(q, 4).tolist()}"
            f" ({error}); set feedforward: none"
        ) from None
    return np.linalg.solve(np.eye(n) + grow**2 * Gamma.T @ P @ Gamma, grow**2 * Gamma.T @ P @ Phi)


class ModelFeedforward(Feedforward):
    """The nominal arm, simulated beside the real one; see the module."""

    def __init__(self, model, manifold, settings):
        super().__init__(model, manifold, settings)
        n, m = model.n_joints, model.n_modes
        self.K = regulator(model, settings.configuration, settings.period)
        self._advance = model.stepper(METHODS["rk4"])
        self._substeps = substeps(model, settings.period, "rk4")
        self.state, self._error = np.zeros(2 * (n + m)), np.zeros(2 * (n + m))
        parts = np.split(self.state, [n, n + m, 2 * n + m])
        self.position, self.amplitude, self.velocity, self.rate = parts
        self._first = True

    def reset(self):
        self._first = True

    def resume(self, other):
        if isinstance(other, ModelFeedforward):
            self.state[:], self.torque[:] = other.state, other.torque
            self._first = other._first

    def wanted(self, reference):
        """State (2 (n + m),) and torque (n,) that the regulator holds the simulated arm to."""
        delta, rate, torque = self.manifold.along(reference)
        return np.concatenate([reference.position, delta, reference.velocity, rate]), torque

    def update(self, reference, dt):
        n = self.model.n_joints
        if not self._first and dt > 0.0:  # the torque of the last sample has acted since
            count = max(1, round(dt / self.settings.period)) * self._substeps
            self._advance(self.state, self.torque, dt / count, count)
        state, torque = self.wanted(reference)
        # Lost: not finite any more, or the reference is where the arm can't go.
        if self._first or not np.abs(state[:n] - self.position).max() < LOST:
            self.state[:] = state
            self._first = False
        np.subtract(state, self.state, out=self._error)
        np.add(torque, self.K @ self._error, out=self.torque)
        np.clip(self.torque, -self.limit, self.limit, out=self.torque)
        self.acceleration[:] = reference.acceleration
