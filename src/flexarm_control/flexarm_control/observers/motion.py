# SPDX-License-Identifier: Apache-2.0
r"""Prediction of an arm's motion from sample to sample, for observers.

The state is x = (q, delta, qd, delta_d), with the equations of motion :math:`\dot x = f(x, u)`. A is the linearisation
of f at rest in the present configuration. A step of length h under constant torque is the exponential Euler
(Rosenbrock) step

.. math:: x_{k+1} = x_k + \Gamma f(x_k, u), \qquad \Gamma = \int_0^h e^{As}ds,

exact for any h if f is linear. f is affine in the torque, so most of a step can be computed before its torque is known
(`Motion.foresee`). The nonlinear parts of f (centrifugal and Coriolis forces, Coulomb friction,
gravity's curvature) are held over the step. Forces of spectral density S on joints and modes (white noise) add

.. math:: Q = \int_0^h e^{As}\,B S B^T e^{A^Ts}ds, \qquad B = \begin{bmatrix}0\\ M^{-1}\end{bmatrix}

to the covariance (Van Loan 1978). A and B are taken at rest with undeflected links, and with viscous friction only:
the gradient of Coulomb friction at rest is wrong for a moving joint.

A design belongs to a time step rounded to 10 us and a configuration rounded to 0.1 rad, so that it does not depend on
the past. The rest of the time step, at most 5 us, is corrected to second order of the linear motion. Linearisations
are kept per configuration. If there is one, a new time step takes only a short series and some products
(`flexarm_dynamics.sampling`), no matrix exponential. This matters because stamps may jitter, samples may get lost, and
a moving arm reaches a new configuration now and then.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg.lapack import dposv

from flexarm_dynamics.linear import state_matrix
from flexarm_dynamics.sampling import Sampling, Step

#: Step of the central differences of a joint angle, a deflection and their rates [rad, m, rad/s, m/s].
DIFFERENCE = 1e-5
#: Number of time steps that designs are kept for; a new one costs some 20 us.
KEPT = 256
#: Number of configurations that linearisations are kept for; a new one costs a millisecond or so.
CONFIGURATIONS = 64
#: A time step this close to a design's counts as the design's [s].
EXACT = 1e-12


def force_density(model, x, density):
    """B S B^T: density of the accelerations, shape (N, N), from that of the forces (n + m,)."""
    n, size = model.n_joints, x.size // 2
    inverse = np.linalg.inv(model.mass_matrix(x[:n], x[n:size]))
    out = np.zeros((2 * size, 2 * size))
    out[size:, size:] = (inverse * density) @ inverse.T
    return out


@dataclass(frozen=True)
class Foreseen:
    """A step before its torque is known; arrays of N = 2 (n + m) rows."""

    period: float  # that the step was designed for [s]
    step: Step
    torque: np.ndarray  # expected, (n,) [N m]
    state: np.ndarray  # after the step under that torque, (N,)
    rate: np.ndarray  # f under that torque, (N,)
    push: np.ndarray  # change of the accelerations with the torque, (n + m, n)
    moved: np.ndarray  # change of the state after the step with the torque, (N, n)


class Motion:
    """Predicts an arm's state; designs are kept.

    Parameters
    ----------
    model : ArmModel
    density : ndarray, shape (n + m,), optional
        Spectral density of the force on each joint [N^2 m^2 s] and mode [N^2 s, N^2 m^2 s].
    """

    def __init__(self, model, density=None):
        self.model, self.density = model, density
        self._n, self._size = model.n_joints, model.n_joints + model.n_modes
        self._onto_joints = np.eye(self._size, self._n)
        self._kept = lru_cache(KEPT)(self._design)
        self._linear = lru_cache(CONFIGURATIONS)(lambda *q: Sampling(*self.linearise(np.array(q))))

    def linearise(self, q):
        """A at rest in configuration q (n,) [rad], and the density of the noise on the state's rates, or None."""
        rest = np.concatenate([q, np.zeros(2 * self._size - self._n)])
        A = state_matrix(self.model, rest, coulomb=False, step=DIFFERENCE)
        if self.density is None:
            return A, None
        return A, force_density(self.model, rest, self.density)

    def design(self, dt, q):
        """The `Step` over dt [s] at rest in configuration q (n,) [rad]."""
        return self._design(dt, *np.asarray(q, float).tolist())

    def _design(self, dt, *q):
        return self._linear(*q).step(dt)

    def step_for(self, dt, position):
        """The kept `Step` for the rounded time step and configuration."""
        return self._kept(round(dt, 5), *np.round(position, 1).tolist())

    def advance(self, x, torque, dt, step):
        """The state after dt under constant torque (n,), shape (N,); `step` from `step_for`."""
        rate = self.model.derivative(x, torque)
        return _with_rest(x + step.Gamma @ rate, rate, dt, step)

    def foresee(self, x, torque, dt):
        """The `Foreseen` step over dt [s] from a state (N,), with an expected torque (n,) [N m]."""
        n, size = self._n, self._size
        rate = self.model.derivative(x, torque)
        push = dposv(self.model.mass_matrix(x[:n], x[n:size]), self._onto_joints)[1]
        step = self.step_for(dt, x[:n])
        state, moved = x + step.Gamma @ rate, step.Gamma[:, size:] @ push
        return Foreseen(round(dt, 5), step, torque.copy(), state, rate, push, moved)

    def go_on(self, foreseen, torque, dt):
        """As `advance`, with a `foreseen` step of that period."""
        change, step = torque - foreseen.torque, foreseen.step
        rate = foreseen.rate
        if abs(dt - step.length) > EXACT:
            rate = rate.copy()
            rate[self._size :] += foreseen.push @ change
        return _with_rest(foreseen.state + foreseen.moved @ change, rate, dt, step)


def _with_rest(out, rate, dt, step):
    """The result `out` of `step`, corrected for the rest of the time step dt [s]; `rate` is f before the step."""
    rest = dt - step.length
    if abs(rest) > EXACT:
        rate = step.Phi @ rate  # after the step
        out += rest * (rate + (0.5 * rest) * (step.A @ rate))
    return out
