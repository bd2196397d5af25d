# SPDX-License-Identifier: Apache-2.0
r"""Reduced-order Luenberger observer of the modal rates, from the boundary layer's model (11).

Over a sample of length h with constant torque u, the fast subsystem moves exactly by

.. math::
    \begin{bmatrix}\delta\\ \dot\delta\end{bmatrix}_k
    = \begin{bmatrix}\Phi_{11}&\Phi_{12}\\ \Phi_{21}&\Phi_{22}\end{bmatrix}
      \begin{bmatrix}\delta\\ \dot\delta\end{bmatrix}_{k-1}
    + \begin{bmatrix}\Gamma_1\\ \Gamma_2\end{bmatrix} u .

The amplitudes are measured. The rates are predicted, and corrected by the prediction error of the amplitudes,

.. math::
    \hat{\dot\delta}_k = \Phi_{21}\delta_{k-1} + \Phi_{22}\hat{\dot\delta}_{k-1} + \Gamma_2 u
    + L\,[\delta_k - \Phi_{11}\delta_{k-1} - \Phi_{12}\hat{\dot\delta}_{k-1} - \Gamma_1 u],

with :math:`L = (\Phi_{22} - e^{-p h}I)\Phi_{12}^{-1}`. This leaves the error
:math:`e_k = e^{-ph}e_{k-1}`: one pole p for all modes and for any time step up to a quarter period of the
fastest mode. Over a longer gap (lost samples) the rates are predicted but not corrected, L = 0.

The joint torque is the applied one, from the sample. Friction and gravity, which are in g2 of (6), act with it. So u
stands for (u - f1, f2) at the sample's joint position and velocity, constant over the sample.
"""

from functools import lru_cache

import numpy as np

from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.sampling import Sampling
from flexarm_dynamics.singular_perturbation import fast_subsystem

from .base import Observer, need_torque


class Luenberger(Observer):
    """Reduced-order observer with one prescribed pole; see the module."""

    PARAMETERS = (
        parameter("pole", 300.0, "1/s", 1.0, 1e5).described(
            "Decay rate of the estimation error: observer poles at -pole."
        ),
    )

    SETTLING = 5.0
    #: Designs are kept for this many different time steps and configurations; a new one takes about 0.1 ms.
    KEPT = 64

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.pole = self.parameters["pole"]
        # One design per time step and configuration rounded to 0.1 rad, so that it does not depend on the past.
        self._kept = lru_cache(self.KEPT)(lambda dt, *q: self.design(dt, q))
        self._linear = lru_cache(self.KEPT)(self._linearised)
        self.innovation = np.zeros(model.n_modes)
        # Beyond a quarter period of the fastest mode its rate can't be found from the amplitudes: Phi12 gets singular.
        self._max_step = 0.5 * np.pi / model.frequencies().max(initial=1e-9)

    def design(self, dt, q):
        """Transition of (11) over dt, and the gain L, at rest in configuration q.

        Returns
        -------
        Phi : ndarray, shape (2m, 2m)
        Gamma : ndarray, shape (2m, n + m)
            Columns for u - f1 and for f2 of (2).
        L : ndarray, shape (m, m)
        """
        m = self.model.n_modes
        fast, forces = self._linear(*np.asarray(q, float).tolist())
        step = fast.step(dt)
        Phi, Gamma = step.Phi, step.Gamma @ forces
        decay = np.exp(-self.pole * dt)
        if dt > self._max_step:
            return Phi, Gamma, np.zeros((m, m))
        L = np.linalg.solve(Phi[:m, m:].T, (Phi[m:, m:] - decay * np.eye(m)).T).T
        return Phi, Gamma, L

    def _linearised(self, *q):
        """The `Sampling` of (11) in a configuration, and its force matrix (2m, n + m)."""
        m, n = self.model.n_modes, self.model.n_joints
        terms = self.model.terms(np.array(q), np.zeros(n))
        _, _, H21, H22 = terms.partition()
        forces = np.vstack([np.zeros((m, n + m)), np.hstack([H21, -H22])])
        return Sampling(fast_subsystem(terms)[0].copy()), forces

    def update(self, sample, dt):
        if self._elapsed < 0.0:
            self.amplitude[:] = sample.amplitude
            self.rate[:] = 0.0
            self.innovation[:] = 0.0
            self._elapsed = 0.0
            return
        need_torque(sample.torque, "observer.type luenberger", "use filtered_derivative")
        m = self.amplitude.size
        Phi, Gamma, L = self._kept(dt, *np.round(sample.position, 1).tolist())
        terms = self.model.terms(sample.position, sample.velocity)
        predicted = Phi @ np.concatenate([self.amplitude, self.rate])
        predicted += Gamma @ np.concatenate([sample.torque - terms.f1, terms.f2])
        np.subtract(sample.amplitude, predicted[:m], out=self.innovation)
        self.rate[:] = predicted[m:] + L @ self.innovation
        self.amplitude[:] = sample.amplitude
        if not self.converged:
            self._elapsed += dt
            self.converged = self._elapsed * self.pole >= self.SETTLING
