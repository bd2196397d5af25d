r"""Optimal fast control with prescribed degree of stability, (18)-(20) of Siciliano & Book (1986).

.. math::
    J = \int_0^\infty e^{2\alpha t}\,[z_f^T Q z_f + u_f^T R u_f]\,dt, \qquad
    u_f = K_f z_f = -R^{-1}B_2^T V z_f,

with V the stabilising solution of

.. math:: 0 = V(A_2 + \alpha I) + (A_2 + \alpha I)^T V - V B_2 R^{-1} B_2^T V + Q .

(Print has exp(-alpha tau) in (18); its Riccati equation (20) is that of exp(+2 alpha t).) A2 and B2 of (11)
are taken at one joint configuration, the trajectory's end, so that no Riccati equation is solved under way.
Every eigenvalue of the closed boundary layer has a real part below -alpha.
"""

import numpy as np
from scipy.linalg import eig

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import Parameter
from flexarm_dynamics.singular_perturbation import fast_subsystem, is_stabilisable

from .base import FastLaw


class Lqr(FastLaw):
    """Constant gain at the final configuration; see the module."""

    PARAMETERS = (
        Parameter(
            "q",
            "float_array",
            [1.0],
            "Diagonal of Q in (18): modal amplitudes, then modal rates.",
            unit="1/m^2, s^2/m^2",
            low=0.0,
            high=1e12,
            length="z",
        ),
        Parameter(
            "r",
            "float_array",
            [1.0],
            "Diagonal of R in (18).",
            unit="1/(N m)^2",
            low=1e-9,
            high=1e12,
            length="joints",
        ),
        Parameter(
            "alpha",
            "float",
            5.0,
            "Prescribed degree of stability: closed fast poles lie left of -alpha.",
            unit="1/s",
            low=0.0,
            high=1e3,
        ),
        Parameter(
            "configuration",
            "float_array",
            [0.0],
            "Joint configuration of the design: the end of the trajectory.",
            unit="rad",
            low=-100.0,
            high=100.0,
            length="joints",
        ),
    )

    def __init__(self, model, parameters):
        # Takes most of a second to import: only who designs this law waits for it.
        import control

        super().__init__(model, parameters)
        q = np.array(self.parameters["configuration"])
        alpha = self.parameters["alpha"]
        self.A2, self.B2 = fast_subsystem(model.terms(q, np.zeros(model.n_joints)))
        ok, worst = is_stabilisable(self.A2, self.B2, alpha)
        if not ok:
            raise DesignError(
                f"fast.alpha: at joint configuration {q.tolist()} the torques can't reach"
                f" {self._least_reached()}, which must decay faster than {alpha} 1/s (smallest singular"
                f" value {worst:.2g}); lower fast.alpha or leave that mode out of the controller's arm file"
            )
        shifted = self.A2 + alpha * np.eye(self.A2.shape[0])
        Q, R = np.diag(self.parameters["q"]), np.diag(self.parameters["r"])
        try:
            gain, self.V, _ = control.lqr(shifted, self.B2, Q, R)
        except (np.linalg.LinAlgError, ValueError, control.ControlException) as error:
            raise DesignError(
                f"fast: the Riccati equation (20) has no stabilising solution for q = {np.diag(Q).tolist()},"
                f" r = {np.diag(R).tolist()}, alpha = {alpha}: {error}"
            ) from None
        self._K_f = -np.asarray(gain)
        poles = np.linalg.eigvals(self.A2 + self.B2 @ self._K_f)
        worst = poles.real.max()
        if (
            not worst < -alpha - 1e-9 * np.abs(poles).max()
        ):  # rounding may put an undamped pole there
            raise DesignError(
                f"fast: the closed boundary layer's slowest pole is at {worst:.4g} 1/s, not left of"
                f" -alpha = {-alpha}; raise fast.q or lower fast.alpha"
            )

    def _least_reached(self):
        """Name of the modal coordinate that dominates the eigenvector B2 reaches least."""
        _, left, right = eig(self.A2, left=True)
        i = np.argmin(np.linalg.norm(left.conj().T @ self.B2, axis=1))
        return self.model.mode_names[int(np.argmax(np.abs(right[: self.model.n_modes, i])))]

    def torque(self, z_f, q):
        return self._K_f @ z_f

    @property
    def K_f(self):
        return self._K_f
