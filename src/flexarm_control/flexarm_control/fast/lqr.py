# SPDX-License-Identifier: Apache-2.0
r"""Optimal fast control with prescribed degree of stability, (18)-(20) of Siciliano & Book (1986).

.. math::
    J = \int_0^\infty e^{2\alpha t}\,[z_f^T Q z_f + u_f^T R u_f]\,dt, \qquad
    u_f = K_f z_f = -R^{-1}B_2^T V z_f,

with V the stabilising solution of

.. math:: 0 = V(A_2 + \alpha I) + (A_2 + \alpha I)^T V - V B_2 R^{-1} B_2^T V + Q .

(The published (18) has exp(-alpha tau); the published Riccati equation (20) is that of exp(+2 alpha t).)
A2 and B2 of (11) are taken at one joint configuration, the end of the trajectory; the motion causes no new design.
Every eigenvalue of the closed boundary layer has a real part below -alpha.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eig

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import fast_subsystem, is_stabilisable

from .base import FastLaw

#: Q, R and alpha of (18), declared alike in every law that solves (20).
WEIGHTS = (
    parameter("q", [1.0], "1/m^2, s^2/m^2", 0.0, 1e12, length="z").described(
        "Diagonal of Q in (18): modal amplitudes, then modal rates."
    ),
    parameter("r", [1.0], "1/(N m)^2", 1e-9, 1e12, length="joints").described(
        "Diagonal of R in (18)."
    ),
    parameter("alpha", 5.0, "1/s", 0.0, 1e3).described(
        "Prescribed degree of stability: the closed-loop fast poles lie left of -alpha."
    ),
)

#: Configuration of a law with a single design.
CONFIGURATION = parameter("configuration", [0.0], "rad", -100.0, 100.0, length="joints").described(
    "Joint configuration that the gain is designed for: the end of the trajectory."
)


@dataclass(frozen=True)
class Regulator:
    """Boundary layer (11) in one joint configuration and its optimal gain."""

    A2: np.ndarray  # (2m, 2m)
    B2: np.ndarray  # (2m, n)
    V: np.ndarray  # (2m, 2m), solution of (20)
    K_f: np.ndarray  # (n, 2m)


def regulator(model, q, parameters):
    """Solve (20) in joint configuration q; not for the control path. Without modes the arrays are empty.

    Parameters
    ----------
    model : ArmModel
    q : ndarray, shape (n,)
        [rad]
    parameters : mapping
        Checked values of `WEIGHTS`.

    Raises
    ------
    DesignError
        If the torques can't reach a mode that has to be faster, or (20) has no stabilising solution.
    """
    alpha = parameters["alpha"]
    A2, B2 = fast_subsystem(model.terms(q, np.zeros(model.n_joints)))
    if A2.size == 0:
        return Regulator(A2, B2, A2, B2.T)
    ok, worst = is_stabilisable(A2, B2, alpha)
    if not ok:
        raise DesignError(
            f"at joint configuration {q.tolist()} the torques can't reach {least_reached(model, A2, B2, alpha)},"
            f" which must decay faster than {alpha} 1/s (smallest singular value {worst:.2g})",
            field="fast.alpha",
            hint="lower fast.alpha or leave that mode out of the controller's arm file",
        )
    K_f, V = _solve(A2 + alpha * np.eye(A2.shape[0]), B2, q, parameters)
    poles = np.linalg.eigvals(A2 + B2 @ K_f)
    worst = poles.real.max()
    if not worst < -alpha - 1e-9 * np.abs(poles).max():  # rounding may put an undamped pole there
        raise DesignError(
            f"at joint configuration {q.tolist()} the closed boundary layer's slowest pole is at {worst:.4g} 1/s, not"
            f" left of -alpha = {-alpha}",
            field="fast",
            hint="raise fast.q or lower fast.alpha",
        )
    return Regulator(A2, B2, V, K_f)


def _solve(shifted, B2, q, parameters):
    """K_f and V of (20) for A2 + alpha I."""
    # The import takes most of a second, so only a design of this law waits for it.
    import control

    try:
        gain, V, _ = control.lqr(shifted, B2, np.diag(parameters["q"]), np.diag(parameters["r"]))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(
            f"at joint configuration {q.tolist()} the Riccati equation (20) has no stabilising solution for"
            f" q = {list(parameters['q'])}, r = {list(parameters['r'])}, alpha = {parameters['alpha']}: {error}",
            field="fast",
        ) from None
    return -np.asarray(gain), np.asarray(V)


def least_reached(model, A2, B2, margin):
    """Name of the modal coordinate that dominates the eigenvector that B2 reaches least, of poles right of -margin."""
    poles, left, right = eig(A2, left=True)
    reach = np.linalg.norm(left.conj().T @ B2, axis=1)
    reach[poles.real < -margin - 1e-9 * np.linalg.norm(A2)] = np.inf
    return dominant_mode(model, right[:, np.argmin(reach)])


def dominant_mode(model, vector):
    """Name of the modal coordinate with the largest amplitude in an eigenvector of (11)."""
    return model.mode_names[int(np.argmax(np.abs(vector[: model.n_modes])))]


class Lqr(FastLaw):
    """Constant gain at the final configuration; see the module."""

    PARAMETERS = (*WEIGHTS, CONFIGURATION)

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        design = regulator(model, self.configuration, self.parameters)
        self.A2, self.B2, self.V, self.K_f = design.A2, design.B2, design.V, design.K_f
