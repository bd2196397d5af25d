r"""Reduced-order Luenberger observer of the modal rates, from the boundary layer's model (11).

Over a sample of length h under constant torque u the fast subsystem moves exactly by

.. math::
    \begin{bmatrix}\delta\\ \dot\delta\end{bmatrix}_k
    = \begin{bmatrix}\Phi_{11}&\Phi_{12}\\ \Phi_{21}&\Phi_{22}\end{bmatrix}
      \begin{bmatrix}\delta\\ \dot\delta\end{bmatrix}_{k-1}
    + \begin{bmatrix}\Gamma_1\\ \Gamma_2\end{bmatrix} u_{k-1} + \begin{bmatrix}\gamma_1\\ \gamma_2\end{bmatrix} .

The amplitudes are measured, the rates are predicted and corrected by the prediction error of the amplitudes,

.. math::
    \hat{\dot\delta}_k = \Phi_{21}\delta_{k-1} + \Phi_{22}\hat{\dot\delta}_{k-1} + \Gamma_2 u + \gamma_2
    + L\,[\delta_k - \Phi_{11}\delta_{k-1} - \Phi_{12}\hat{\dot\delta}_{k-1} - \Gamma_1 u - \gamma_1],

with :math:`L = (\Phi_{22} - e^{-p h}I)\Phi_{12}^{-1}`, which leaves the error
:math:`e_k = e^{-ph}e_{k-1}`: one pole p for all modes, whatever the time step.

The joint torque is the one that was applied, from the sample; less friction; gravity (g2 of
(6)) enters as constant over the sample.
"""

import numpy as np
from scipy.linalg import expm

from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.parameters import Parameter
from flexarm_dynamics.singular_perturbation import state_space

from .base import Observer


class Luenberger(Observer):
    """Reduced-order observer with one prescribed pole; see the module."""

    PARAMETERS = (
        Parameter(
            "pole",
            "float",
            300.0,
            "Decay rate of the estimation error: observer poles at -pole.",
            unit="1/s",
            low=1.0,
            high=1e5,
        ),
    )

    SETTLING = 5.0
    #: Designs are kept for this many different time steps (jitter in a real-time loop is rounded to 10 us).
    KEPT = 64

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.pole = self.parameters["pole"]
        self._designs = {}
        self._elapsed = -1.0
        self.innovation = np.zeros(model.n_modes)

    def reset(self):
        super().reset()
        self._elapsed = -1.0

    def design(self, dt, q, qd):
        """Transition of (11) over dt and the gain L; at rest, in configuration q.

        Returns
        -------
        Phi : ndarray, shape (2m, 2m)
        Gamma : ndarray, shape (2m, n + 1)
            Columns for the torques and for g2 of (6).
        L : ndarray, shape (m, m)
        """
        m, n = self.model.n_modes, self.model.n_joints
        s = state_space(self.model.terms(q, qd))
        big = np.zeros((2 * m + n + 1, 2 * m + n + 1))
        big[: 2 * m, : 2 * m] = s.A2
        big[: 2 * m, 2 * m : 2 * m + n] = s.B2
        big[: 2 * m, -1] = s.g2
        flow = expm(big * dt)
        Phi, Gamma = flow[: 2 * m, : 2 * m], flow[: 2 * m, 2 * m :]
        decay = np.exp(-self.pole * dt)
        L = np.linalg.solve(Phi[:m, m:].T, (Phi[m:, m:] - decay * np.eye(m)).T).T
        return Phi, Gamma, L

    def _design_for(self, dt, sample):
        # One design per (time step, configuration to 0.1 rad): arms with constant matrices make one.
        key = (round(dt * 1e5), *np.round(sample.position, 1).tolist())
        found = self._designs.get(key)
        if found is None:
            if len(self._designs) >= self.KEPT:
                self._designs.clear()
            found = self.design(dt, sample.position, np.zeros_like(sample.velocity))
            self._designs[key] = found
        return found

    def update(self, sample, dt):
        if self._elapsed < 0.0:
            self.amplitude[:] = sample.amplitude
            self.rate[:] = 0.0
            self.innovation[:] = 0.0
            self._elapsed = 0.0
            return
        if not np.all(np.isfinite(sample.torque)):
            raise MessageError(
                "joint_torque is unknown (NaN), and observer.type luenberger predicts with it: have the"
                " driver report the applied torque, or use filtered_derivative"
            )
        m = self.amplitude.size
        Phi, Gamma, L = self._design_for(dt, sample)
        predicted = Phi @ np.concatenate([self.amplitude, self.rate])
        predicted += Gamma[:, :-1] @ (sample.torque - self.model.friction(sample.velocity))
        predicted += Gamma[:, -1]
        np.subtract(sample.amplitude, predicted[:m], out=self.innovation)
        self.rate[:] = predicted[m:] + L @ self.innovation
        self.amplitude[:] = sample.amplitude
        if not self.converged:
            self._elapsed += dt
            self.converged = self._elapsed * self.pole >= self.SETTLING
