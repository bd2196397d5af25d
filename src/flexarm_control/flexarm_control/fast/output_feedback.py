# SPDX-License-Identifier: Apache-2.0
r"""Fast control from the modal amplitudes alone: an optimal gain on the estimate of a boundary-layer observer.

Over a sample of length h with constant u_f, the boundary layer (11), taken at one joint configuration, moves exactly by

.. math:: z_{k+1} = \Phi z_k + \Gamma u_k, \qquad y_k = C z_k = \delta_k - \bar\delta_k, \qquad C = [I\;0].

The law predicts the state over the time since the last sample, and corrects it with the amplitudes of this sample:

.. math::
    \hat z^-_k = \Phi \hat z_{k-1} + \Gamma u_{k-1}, \qquad
    \hat z_k = \hat z^-_k + L\,(y_k - C\hat z^-_k), \qquad u_k = K_f \hat z_k,

where K_f of (19), (20) is the gain of `lqr`. The rates are not used. With :math:`\rho = e^{-ph}` and the blocks of Phi,

.. math::
    L = \begin{bmatrix} (1-\rho^2)\,I \\
        (1-\rho)\,(\Phi_{22}\Phi_{12}^{-1} - \rho\,\Phi_{12}^{-1}\Phi_{11}) \end{bmatrix}

places the poles of the error, :math:`e_k = (I - LC)\Phi e_{k-1}`, at rho times those of Phi. In continuous time each
open fast pole moves to the left by p and keeps its frequency. So the error of a soft mode has two poles near -p. The
error of a stiff mode is only damped, which takes little correction. By the separation principle the closed loop has
these poles and those of Phi + Gamma K_f.

Proof of L: with the rates eliminated, the amplitudes obey :math:`y_{k+2} = a_1 y_{k+1} + a_0 y_k` with
:math:`a_1 = \Phi_{11} + \Phi_{12}\Phi_{22}\Phi_{12}^{-1}`,
:math:`a_0 = \Phi_{12}\Phi_{21} - \Phi_{12}\Phi_{22}\Phi_{12}^{-1}\Phi_{11}`. With this L their error obeys
:math:`e_{k+2} = \rho a_1 e_{k+1} + \rho^2 a_0 e_k`: the same equation, with every pole multiplied by rho.

The rate of the fastest mode can't be computed from amplitudes that are half its period apart (Phi12 is singular). If
lost samples leave a gap of more than 0.9 of that time, the law predicts and does not correct.
"""

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import sampled
from flexarm_dynamics.parameters import parameter

from .base import FastLaw
from .lqr import CONFIGURATION, WEIGHTS, dominant_mode, regulator


class OutputFeedback(FastLaw):
    """Optimal gain on the estimate of an observer that uses amplitudes alone; see the module.

    Attributes
    ----------
    K_f : ndarray, shape (n, 2m)
        Gain on the *estimated* deviation.
    predicted, estimate : ndarray, shape (2m,)
        Estimated deviation before and after the correction by the present sample [m, rad, m/s, rad/s].
    """

    PARAMETERS = (
        *WEIGHTS,
        CONFIGURATION,
        parameter("observer_pole", 100.0, "1/s", 1.0, 1e5).described(
            "How far left of an open fast pole the pole of its estimation error lies."
        ),
        parameter("period", 0.001, "s", 1e-5, 1.0).described(
            "Sampling period that the design is checked for; the law itself uses the true time between samples."
        ),
    )

    needs_rates = False

    #: Matrices are kept for this many different time steps; new ones take about 0.1 ms.
    KEPT = 64
    #: Longest time step that allows a correction, as a fraction of half a period of the fastest mode.
    MAX_PART = 0.9
    #: After this many samples in a row without a correction the law fails.
    BLIND = 20

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        q = self.configuration
        design = regulator(model, q, self.parameters)
        self.A2, self.B2, self.K_f = design.A2, design.B2, design.K_f
        m = model.n_modes
        poles, vectors = np.linalg.eig(self.A2) if m else (np.zeros(1), np.zeros((0, 1)))
        self._longest = self.MAX_PART * np.pi / max(poles.imag.max(), 1e-300)
        self._fastest = dominant_mode(model, vectors[:, np.argmax(poles.imag)]) if m else ""
        self.estimate, self.predicted = np.zeros(2 * m), np.zeros(2 * m)
        self._steps = {}
        self._check_period(q)
        self.reset()

    def _check_period(self, q):
        """Refuse a period at which the regulator, designed in continuous time, is unstable when sampled."""
        period = self.parameters["period"]
        Phi, Gamma, _ = self._step(period)
        self._refuse_long(period)
        poles = np.linalg.eigvals(Phi + Gamma @ self.K_f)
        if poles.size and not np.abs(poles).max() < 1.0:
            fastest = np.abs(np.linalg.eigvals(self.A2 + self.B2 @ self.K_f)).max()
            raise DesignError(
                f"at joint configuration {q.tolist()} closed fast poles of up to {fastest:.4g} rad/s are unstable in a"
                f" loop sampled every {period:g} s (largest pole {np.abs(poles).max():.4g})",
                field="fast.period",
                hint="lower fast.alpha and fast.q, raise fast.r, or sample faster",
            )

    def _refuse_long(self, dt):
        if dt > self._longest:
            raise DesignError(
                f"s between samples is more than {self.MAX_PART} of half a period of {self._fastest}",
                field="fast.period",
                value=dt,
                limit=f"{self._longest:.4g} s",
                hint="sample faster or leave that mode out of the controller's arm file",
            )

    def _step(self, dt):
        """Phi, Gamma and L for the time step dt; L = 0 for a step that is too long for a correction."""
        found = self._steps.get(dt)
        if found is not None:
            return found
        m = self.model.n_modes
        Phi, Gamma = sampled(self.A2, self.B2, dt)
        L = np.zeros((2 * m, m))
        if dt <= self._longest:
            rho = np.exp(-self.parameters["observer_pole"] * dt)
            inverse = np.linalg.inv(Phi[:m, m:])
            L[:m] = (1.0 - rho**2) * np.eye(m)
            L[m:] = (1.0 - rho) * (Phi[m:, m:] @ inverse - rho * inverse @ Phi[:m, :m])
        if len(self._steps) >= self.KEPT:
            self._steps.clear()
        self._steps[dt] = Phi, Gamma, L
        return Phi, Gamma, L

    def reset(self):
        self.estimate[:] = 0.0
        self.predicted[:] = 0.0
        self._u = np.zeros(self.model.n_joints)
        self._L = None  # no prediction yet
        self._blind = 0

    def advance(self, dt):
        Phi, Gamma, self._L = self._step(dt)
        np.dot(Phi, self.estimate, out=self.predicted)
        self.predicted += Gamma @ self._u
        self._blind = self._blind + 1 if dt > self._longest else 0
        if self._blind >= self.BLIND:
            self._refuse_long(dt)

    def torque(self, z_f, q):
        m = self.model.n_modes
        if self._L is None:  # the first sample: start from its amplitudes, at rest
            self.predicted[:m] = z_f[:m]
            np.copyto(self.estimate, self.predicted)
        else:
            np.dot(self._L, z_f[:m] - self.predicted[:m], out=self.estimate)
            self.estimate += self.predicted
        self._u = self.K_f @ self.estimate
        return self._u

    def gain(self, q):
        return None

    def state_space(self, dt):
        r"""Discrete compensator; its state w is the prediction for the present sample.

        .. math::
            w' = (\Phi + \Gamma K_f)[(I - LC) w + L C z_f], \qquad u_f = K_f[(I - LC) w + L C z_f].

        The law starts from w = (amplitudes of the first sample, 0). The columns of B and D for the rates are zero. A
        period `dt` that is too long for the fastest mode raises a `DesignError`.
        """
        self._refuse_long(dt)
        Phi, Gamma, L = self._step(dt)
        correct = np.hstack([L, np.zeros_like(L)])
        keep = np.eye(correct.shape[0]) - correct
        closed = Phi + Gamma @ self.K_f
        return closed @ keep, closed @ correct, self.K_f @ keep, self.K_f @ correct
