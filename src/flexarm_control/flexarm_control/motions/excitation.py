# SPDX-License-Identifier: Apache-2.0
r"""Excitation by a motion: the linear response of the fast subsystem (11) along the motion.

The slow torque of the motion is that of the reduced model (10), :math:`\bar u = B^{-1}(\ddot q - a)`; with it the
deflections have the quasi-steady state :math:`\bar\delta` (9). The deviation :math:`z_f = z - \bar z` follows
(11), driven only by the motion of that state,

.. math:: \dot z_f = A_2 z_f - \frac{d}{dt}\begin{bmatrix}\bar\delta\\0\end{bmatrix},\qquad z_f(0) = 0,

with :math:`A_2` along the motion, or at one configuration. It is measured by its energy,
:math:`E = \frac12\delta_f^T K\delta_f + \frac12\dot\delta_f^T H_{22}^{-1}\dot\delta_f` (joints free), which
treats metres and radians of all modes alike. There is no fast control here; a fast control would have to remove this
energy.
"""

from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import sampled
from flexarm_dynamics.singular_perturbation import (
    fast_subsystem,
    quasi_steady_state,
    slow_subsystem,
)


@dataclass(frozen=True, eq=False)
class Excitation:
    """Excitation of the modes by a motion, by the linear theory."""

    times: np.ndarray  # from 0 to the motion's end, (k,) [s]
    torque: np.ndarray  # slow torque, (k, n) [N m]
    energy: np.ndarray  # of the deviation z_f, (k,) [J]

    @property
    def residual(self):
        """Energy left at the motion's end [J]."""
        return float(self.energy[-1])

    @property
    def transient(self):
        """Mean energy along the motion [J]."""
        return float(np.mean(self.energy))

    @property
    def peak_torque(self):
        """Largest torque of each joint, (n,) [N m]."""
        return np.abs(self.torque).max(axis=0)


def along(model, profile, configuration=None, points=801) -> Excitation:
    """Return the excitation by a motion.

    Parameters
    ----------
    model : ArmModel
    profile : Motion
    configuration : (n,) array_like, optional
        Configuration at which (11) is taken [rad]; along the motion if not given.
    points : int
        Number of points of time; the quasi-steady state is linear between them.
    """
    times = np.linspace(0.0, profile.duration, points)
    q, qd, qdd = profile.states(times)
    torque, steady = np.empty_like(q), np.empty((points, model.n_modes))
    for k in range(points):
        torque[k], steady[k] = reduced(model, q[k], qd[k], qdd[k])
    if configuration is not None:
        q, qd = np.asarray(configuration, float)[None], np.zeros((1, model.n_joints))
    response = FastResponse(model, times[1] - times[0], q, qd)
    return Excitation(times, torque, response.energy(response.deviation(steady)))


def reduced(model, q, qd, qdd):
    """Slow torque (n,) [N m] and quasi-steady amplitudes (m,) [m, rad] of a motion: (10) and (9)."""
    terms = model.terms(q, qd)
    if not model.n_modes:
        return terms.M @ qdd + terms.f1, np.zeros(0)
    a, B = slow_subsystem(terms)
    torque = np.linalg.solve(B, qdd - a)
    return torque, quasi_steady_state(terms, torque)


class FastResponse:
    """The response of (11) to a quasi-steady state that moves, on a grid of time.

    It is exact for a state that is linear between the grid's points and an A2 that is constant there.

    Parameters
    ----------
    model : ArmModel
    step : float
        Step of the grid [s].
    q, qd : (k, n) arrays
        Joint angles and rates at the grid's points [rad], [rad/s]; one row stands for all.
    """

    def __init__(self, model, step, q, qd):
        self.m = m = model.n_modes
        if not m:
            return
        # The middle of each step; a single row stands for all.
        q, qd = (0.5 * (x[1:] + x[:-1]) if len(x) > 1 else x for x in (q, qd))
        A2 = np.zeros((len(q), 2 * m, 2 * m))
        self.root = np.zeros((len(q), 2 * m, 2 * m))  # E = |root z|^2 / 2
        self.root[:, :m, :m] = np.linalg.cholesky(model.stiffness_matrix()).T
        for k, state in enumerate(zip(q, qd, strict=True)):
            terms = model.terms(*state)
            A2[k] = fast_subsystem(terms)[0]
            H22 = terms.partition()[3]
            self.root[k, m:, m:] = np.linalg.cholesky(np.linalg.inv(0.5 * (H22 + H22.T))).T
        with np.errstate(all="ignore"):
            self.propagate, integral = sampled(A2, np.eye(2 * m), step)
        if not (np.isfinite(self.propagate).all() and np.isfinite(integral).all()):
            raise DesignError(
                f"of {model.arm.name} makes the joints so fast that the links lose their stiffness in this model",
                field="motion",
                hint="take a longer duration",
            )
        self.drive = -integral[:, :, :m] / step

    def deviation(self, steady):
        """Return z_f at the grid's points, (k, 2m) or (k, 2m, c).

        Parameters
        ----------
        steady : (k, m) or (k, m, c) array
            Quasi-steady amplitudes; the last axis are c motions side by side.
        """
        out = np.zeros((steady.shape[0], 2 * self.m, *steady.shape[2:]))
        for k, change in enumerate(np.diff(steady, axis=0) if self.m else ()):
            i = min(k, len(self.propagate) - 1)
            out[k + 1] = self.propagate[i] @ out[k] + self.drive[i] @ change
        return out

    def weighed(self, deviation):
        """Deviations (k, 2m, c), weighted such that E is half of their square, (k, 2m, c)."""
        steps = np.minimum(np.arange(deviation.shape[0]), len(self.root) - 1)
        return self.root[steps] @ deviation

    def energy(self, deviation):
        """Energy of deviations (k, 2m), shape (k,) [J]."""
        if not self.m:
            return np.zeros(deviation.shape[0])
        return 0.5 * np.sum(self.weighed(deviation[:, :, None]) ** 2, axis=(1, 2))
