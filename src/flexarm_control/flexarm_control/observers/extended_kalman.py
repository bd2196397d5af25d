# SPDX-License-Identifier: Apache-2.0
r"""Extended Kalman filter of joints, modes, and unknown parameters of the arm: payload and joint friction.

The state of `kalman` is augmented by parameters, each a slow random walk:

.. math::
    \dot x = f(x, u, \theta), \qquad \dot\theta = w, \qquad
    \theta = (s,\ b_1 \ldots b_n,\ c_1 \ldots c_n)

where s is the scale of the payload's mass and inertia. Each joint has the friction torque
:math:`b_i\dot q_i + c_i\tanh(\dot q_i/\epsilon_i)` instead of the arm file's. Mass matrix and forces are affine in s.
Let :math:`M_1, a_1` be mass matrix and acceleration of the arm file's arm, and :math:`M_2, a_2` those of the arm with
twice the payload (same mode shapes). Then the acceleration is exactly

.. math:: a = [(2 - s)M_1 + (s - 1)M_2]^{-1}[(2 - s)M_1a_1 + (s - 1)M_2a_2] .

The prediction is the exponential Euler step of `motion` on f, with the Jacobian :math:`\partial(f, w)/\partial(x,
\theta)` at the estimate itself, by central differences, recomputed every ``relinearise`` seconds.
Measurement and update are those of `kalman`. Estimates stay within bounds: no negative mass or friction.

A parameter is found only if the motion excites it: at rest neither friction nor payload is observable. A
linearisation takes milliseconds, so use this observer on records or for slowly sampled arms; see docs/observers.md.
"""

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import jacobian
from flexarm_dynamics.parameters import Parameter, parameter
from flexarm_dynamics.sampling import discretise

from .kalman import NOISE, Kalman
from .motion import DIFFERENCE, force_density


def _flag(name, default, what):
    return Parameter(name, "bool", default, f"Whether to estimate {what}.")


def _size(name, default, unit, what):
    return Parameter(name, "float", default, what, unit=unit, low=0.0, high=1e6)


#: Bounds of the estimates: scale of the payload [-], viscous [N m s/rad] and Coulomb friction [N m].
MAX_SCALE, MAX_FRICTION = 20.0, 1e6


class ExtendedKalman(Kalman):
    """Kalman filter with parameters of the arm in its state; see the module.

    Attributes
    ----------
    state, covariance : ndarray, shape (N + k,), (N + k, N + k)
        (q, delta, qd, delta_d), then the k parameters.
    parameters_estimated : dict
        The parameters and their deviations, by name and unit.
    """

    NAME = "extended_kalman"
    PARAMETERS = (
        *NOISE,
        _flag("estimate_payload", True, "the scale of the payload's mass and inertia"),
        _flag("estimate_viscous", True, "viscous friction of the joints"),
        _flag("estimate_coulomb", False, "Coulomb friction of the joints"),
        _size("payload_deviation", 1.0, "-", "Initial deviation of the payload's scale from 1, rms."),
        _size("viscous_deviation", 0.5, "N m s/rad", "Initial deviation of viscous friction from the file's, rms."),
        _size("coulomb_deviation", 0.2, "N m", "Initial deviation of Coulomb friction from the file's, rms."),
        _size("payload_drift", 1e-3, "s^-0.5", "Random walk of the payload's scale, per root of a second."),
        _size("viscous_drift", 1e-3, "N m s^0.5/rad", "Random walk of viscous friction."),
        _size("coulomb_drift", 1e-3, "N m s^-0.5", "Random walk of Coulomb friction."),
        parameter("relinearise", 0.01, "s", 0.0, 1.0).described(
            "Time between computations of the Jacobians; 0.0: at every sample."
        ),
    )  # fmt: skip

    def _prepare(self):
        model, values = self.model, self.parameters
        self._friction = model.friction_table().copy()
        # Name, first value, deviation, drift and largest value of each parameter; and where each kind is.
        rows, self._at = [], {}

        def add(kind, names, first, largest):
            if values[f"estimate_{kind}"]:
                self._at[kind] = slice(len(rows), len(rows) + len(names))
                more = values[f"{kind}_deviation"], values[f"{kind}_drift"], largest
                rows.extend((name, value, *more) for name, value in zip(names, first, strict=True))

        add("payload", ["payload scale [-]"], [1.0], MAX_SCALE)
        self._heavier = _twice_loaded(model) if rows else None
        for column, (kind, unit) in enumerate((("viscous", "N m s/rad"), ("coulomb", "N m"))):
            names = [f"{kind} friction of {j} [{unit}]" for j in model.joint_names]
            add(kind, names, self._friction[:, column], MAX_FRICTION)
        self.names = tuple(name for name, *_ in rows)
        numbers = np.array([row[1:] for row in rows], float).reshape(-1, 4)
        self._first, self._deviation, self._drift, self._high = numbers.T
        size = 2 * self._p + len(rows)
        self.state, self.covariance = np.zeros(size), np.zeros((size, size))
        self._design, self._age = None, 0.0
        self._report()

    def reset(self):
        super().reset()
        self._design, self._age = None, 0.0

    def resume(self, other):
        same = isinstance(other, ExtendedKalman) and other.names == self.names
        if same:
            super().resume(other)
            self._report()
        else:
            self.reset()

    def _start(self, sample):
        N = 2 * self._p
        super()._start(sample)
        self.state[N:] = self._first
        np.fill_diagonal(self.covariance[N:, N:], self._deviation**2)
        self._report()

    def update(self, sample, dt):
        super().update(sample, dt)
        parameters = self.state[2 * self._p :]
        np.clip(parameters, 0.0, self._high, out=parameters)
        self._report()

    def _report(self):
        N = 2 * self._p
        deviation = np.sqrt(np.diagonal(self.covariance)[N:])
        for name, value, sigma in zip(self.names, self.state[N:], deviation, strict=True):
            self.parameters_estimated[name] = float(value)
            self.parameters_estimated[f"{name}, deviation"] = float(sigma)

    def derivative(self, x, torque):
        """Time derivative of the augmented state, shape (N + k,)."""
        model, n, p = self.model, self._n, self._p
        N, speed = 2 * p, x[p : p + n]
        theta = x[N:]
        viscous, coulomb, smoothing = self._friction.T
        viscous = theta[self._at["viscous"]] if "viscous" in self._at else viscous
        coulomb = theta[self._at["coulomb"]] if "coulomb" in self._at else coulomb
        friction = viscous * speed + coulomb * np.tanh(speed / smoothing)
        net = torque + model.friction(speed) - friction  # the model subtracts its own friction
        out = np.zeros(x.size)
        out[:N] = model.derivative(x[:N], net)
        if self._heavier is not None:
            s, q, delta = theta[0], x[:n], x[n:p]
            one = (2.0 - s) * model.mass_matrix(q, delta)
            two = (s - 1.0) * self._heavier.mass_matrix(q, delta)
            force = one @ out[p:N] + two @ self._heavier.derivative(x[:N], net)[p:]
            out[p:N] = np.linalg.solve(one + two, force)
        return out

    def _predict(self, torque, dt):
        self._age += dt
        design, relinearise = self._design, self.parameters["relinearise"]
        if design is None or self._age > relinearise - 0.5 * dt or dt != design.length:
            design = self._linearised(torque, dt)
            self._design, self._age = design, 0.0
        return self.state + design.Gamma @ self.derivative(self.state, torque), design

    def _foresee(self):
        """Do nothing: `_predict` computes the whole step, with the estimated parameters."""

    def _linearised(self, torque, dt):
        """The step, linearised at the estimate under this torque."""
        N, x = 2 * self._p, self.state
        density = np.zeros((x.size, x.size))
        density[:N, :N] = force_density(self.model, x[:N], self.density)
        np.fill_diagonal(density[N:, N:], self._drift**2)
        A = jacobian(lambda at: self.derivative(at, torque), x, DIFFERENCE)
        return discretise(A, dt, density)


def _twice_loaded(model):
    """The arm with twice its payload and the same mode shapes; the equations of motion are affine in the payload."""
    payload = model.arm.payload
    if not payload.mass > 0.0:
        raise DesignError(
            f"of {model.arm.name} has no scale that could be estimated",
            field="payload.mass",
            value=payload.mass,
            hint="give the arm file the expected payload, or set observer.estimate_payload to false",
        )
    return model.with_payload(2.0)
