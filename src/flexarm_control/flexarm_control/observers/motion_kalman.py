# SPDX-License-Identifier: Apache-2.0
r"""Kalman filter of the strains of an arm whose joints are moved with unknown torque.

It needs no torque, because the joints' motion excites the links. The state is
:math:`x = (q, \delta, \dot q, \dot\delta, a, b, c)` with the joints' acceleration a, the gauges' bias b and the last
samples c of the noise that all gauges share. It obeys

.. math::
    \ddot q = a, \quad \dot a = -a/T + w_a, \quad
    \ddot\delta = M_{22}^{-1}\big(w_\delta - M_{21}a - h_2(q, \delta, \dot q, \dot\delta)\big), \quad
    \dot b = w_b, \quad c_k = \sum_l \alpha_l c_{k-l} + w_c,

where M and h are those of (2), with gravity and damping in h, and each w is white. Joint positions and strains are
measured,

.. math:: y = (q,\ g R\delta + b_0 + b + s c_k) + v,

with the arm file's gains g, biases :math:`b_0` and rows R (`strain_map`), and s the ``common_noise`` of each gauge. The
measured motion of the joints is the input; its noise is that of the encoders and of a. Step and update are those of
`motion` and `kalman`. All gauges are used, even if there are more than modes. A gauge that is lost, or reads nothing,
is left out.

Past innovations can predict the next one (``innovation_order``, `innovation_memory`). This improves predicted strains,
and leaves the state as it is.

The filter can tell a bias from a slow deflection only while the arm moves. At rest it knows no more of the bias than
``bias_deviation`` says.
"""

from dataclasses import replace

import numpy as np

from flexarm_dynamics.arm.strain_map import StrainMap, reading_rows
from flexarm_dynamics.errors import MessageError, ModelError, ParameterError
from flexarm_dynamics.linear import jacobian
from flexarm_dynamics.parameters import parameter

from .innovation_memory import InnovationMemory
from .kalman import NOISE, UNSTATED_STRAIN, Kalman, position_uncertainty
from .motion import DIFFERENCE, EXACT, Motion

_OF_STRAINS = {p.name: p for p in NOISE if p.name in ("strain_noise", "position_noise")}
#: Ratio of the variance of a missing reading to that of the gauge's noise.
NONE = 1e12
#: Past innovations are forgotten after a step that is longer than the last one by this factor.
GAP = 1.5


class MotionKalman(Kalman):
    """Kalman filter without torque; see the module.

    Attributes
    ----------
    state, covariance : ndarray, shape (N,), (N, N)
        (q, delta, qd, delta_d, a, b, c).
    strain_innovation : ndarray, shape (g,)
        Measured minus predicted strain; NaN for a gauge that is left out.
    strain_error : ndarray, shape (g,)
        `strain_innovation` minus its prediction from past innovations.
    memory : InnovationMemory
    parameters_estimated : dict
        Bias of each gauge beyond the arm file's.
    """

    NAME = "motion_kalman"
    PARAMETERS = (
        _OF_STRAINS["strain_noise"],
        _OF_STRAINS["position_noise"],
        parameter("common_noise", [0.0], "strain", 0.0, 1e-2, length="gauges").described(
            "Noise of each gauge that comes from one source, such as a supply, rms; strain_noise is the rest."
        ),
        parameter("common_memory", [0.0], "-", -2.0, 2.0).described(
            "Coefficients of the common noise on its last samples, newest first; [0.0]: it is white."
        ),
        parameter("jerk_noise", [20.0], "rad s^-2.5", 1e-6, 1e6, length="joints").described(
            "Unknown change of each joint's acceleration: root of the spectral density."
        ),
        parameter("acceleration_time", 0.1, "s", 1e-3, 1e3).described(
            "Time constant with which a joint's acceleration is forgotten."
        ),
        parameter(
            "bending_force_noise", [0.1], "N s^0.5, N m s^0.5", 0.0, 1e6, length="modes"
        ).described("Unknown force on each mode: root of the spectral density."),
        parameter("bias_deviation", 1e-5, "strain", 0.0, 1e-2).described(
            "Deviation of the gauges' bias from the arm file's at the start, rms."
        ),
        parameter("bias_noise", 1e-6, "strain s^-0.5", 0.0, 1e-2).described(
            "Random walk of the bias, per root of a second, or the arm file's drift if that is larger."
        ),
        parameter("innovation_order", 0, "-", 0, 64).described(
            "Number of past innovations of all gauges from which strains are also predicted, with coefficients that"
            " are learnt online; 0: none."
        ),
    )

    def __init__(self, model, parameters):
        if not model.arm.gauges:
            hint = "give the arm file its gauges, or use observer.type kalman"
            problem = f"of {model.arm.name} are none, and observer.type {self.NAME} filters strains"
            raise ModelError(problem, field="gauges", hint=hint)
        super().__init__(model, parameters)

    def _assume(self):
        """Do nothing: `_prepare` sets the noise, together with the state."""

    def _prepare(self):
        model, values = self.model, self.parameters
        arm, n, p = model.arm, self._n, self._p
        self._g = g = len(arm.gauges)
        memory = np.array(values["common_memory"], float)
        self.motion = PrescribedMotion(model, values, g, memory)
        size = self.motion.size
        self._bias = slice(2 * p + n, 2 * p + n + g)
        self._map = StrainMap(model)
        self._stated = np.array([gauge.bias for gauge in arm.gauges])
        self._C = np.zeros((n + g, size))
        self._C[:n, :n] = np.eye(n)
        self._C[n:, n:p] = reading_rows(model, arm.gauges)
        self._C[n:, self._bias] = np.eye(g)
        self._C[n:, self._bias.stop] = self._shared = np.array(values["common_noise"], float)
        noise = [
            values["strain_noise"] or gauge.uncertainty or UNSTATED_STRAIN for gauge in arm.gauges
        ]
        noise = [position_uncertainty(j, values["position_noise"]) for j in arm.joints] + noise
        self._full = np.square(noise)
        self.state, self.covariance = np.zeros(size), np.zeros((size, size))
        self._measured, self.strain_innovation = np.zeros(n + g), np.full(g, np.nan)
        self.strain_error, self._last_dt = np.full(g, np.nan), np.inf
        size_of_noise = np.sqrt(self._full[n:] + self._shared**2)
        self.memory = InnovationMemory(size_of_noise, values["innovation_order"])
        self.innovation = np.zeros(0)
        self._left_out()

    def _left_out(self, missing=()):
        """Set R and the bound of the innovations, without lost gauges and those whose readings are `missing`."""
        self._out = tuple(sorted({*self.gauges_lost, *missing}))
        variance = self._full.copy()
        variance[[self._n + i for i in self._out]] *= NONE
        self.measurement_covariance = np.diag(variance)
        self._bound = self._bound_of(self._n + self._g - len(self._out))
        self._steady = False

    def leave_out(self, lost):
        self.gauges_lost = lost
        self._left_out()

    def resume(self, other):
        if isinstance(other, MotionKalman) and other.state.size == self.state.size:
            super().resume(other)
        else:
            self.reset()

    def rest_at(self, amplitude):
        """As `Observer.rest_at`: what the gauges read beyond these amplitudes is their bias."""
        n, p, bias = self._n, self._p, self._bias
        self.state[n:p], self.state[p : 2 * p] = amplitude, 0.0
        without = self.state.copy()
        without[bias] = 0.0
        read = self._measured[n:] - (self._C @ without)[n:]
        self.state[bias] = np.where(np.isin(np.arange(self._g), self._out), self.state[bias], read)
        self._publish()

    def _take(self, sample):
        """Set the measurement y; gauges that read nothing count as left out."""
        if sample.strain is None:
            hint = "have the driver send strain, or use another observer.type"
            raise MessageError(
                f"is not given, and observer.type {self.NAME} filters it", field="strain", hint=hint
            )
        strain = sample.strain - self._stated
        missing = tuple(int(i) for i in np.flatnonzero(~np.isfinite(strain)))
        if tuple(sorted({*self.gauges_lost, *missing})) != self._out:
            self._left_out(missing)
        self._measured[: self._n], self._measured[self._n :] = (
            sample.position,
            np.nan_to_num(strain),
        )

    def update(self, sample, dt):
        self._take(sample)
        if self._elapsed < 0.0:
            self._start(sample)
            return
        if dt > GAP * self._last_dt:
            self.memory.forget_past()
        self._last_dt = dt
        self._advance(sample.torque, dt)

    def _start(self, sample):
        n, p, bias = self._n, self._p, self._bias
        P, values = self.covariance, self.parameters
        inverse = self._map.inverse_without(self._out)
        if inverse is None:
            names = ", ".join(self.model.arm.gauge_names[i] for i in self._out)
            problem = (
                f"without {names} the gauges don't give all modes, which the first sample needs"
            )
            raise MessageError(problem, field="strain")
        self.state[:] = 0.0
        self.state[:n], self.state[p : p + n] = sample.position, sample.velocity
        self.state[n:p] = inverse @ self._measured[n:]
        P[:] = 0.0
        P[:n, :n] = self.measurement_covariance[:n, :n]
        # An amplitude mapped with an inverse W is wrong by W (b + v).
        variance = np.full(self._g, values["bias_deviation"] ** 2)
        noise = np.diag(self._full[n:] + variance) + np.outer(self._shared, self._shared)
        P[n:p, n:p] = inverse @ noise @ inverse.T
        P[n:p, bias] = -inverse * variance
        P[bias, n:p] = P[n:p, bias].T
        P[bias, bias] = np.diag(variance)
        np.fill_diagonal(P[p : 2 * p, p : 2 * p], self.START**2)
        np.fill_diagonal(P[2 * p : 2 * p + n, 2 * p : 2 * p + n], self.START**2)
        np.fill_diagonal(P[bias.stop :, bias.stop :], 1.0)
        self.strain_innovation[:], self.innovation_squared = np.nan, float("nan")
        self.strain_error[:] = np.nan
        self.memory.forget_past()
        self._elapsed = 0.0
        self._publish()

    def _predict(self, torque, dt):
        step = self.motion.step_for(dt, self.state[: self._n])
        return self.motion.advance(self.state, torque, dt, step), step

    def _foresee(self):
        """Do nothing: the prediction needs no torque, and `_predict` makes it as a whole."""

    def _output(self, x):
        return self._C @ x

    def _innovations(self, innovation):
        """Set the strains' innovation and error of a sample, and learn from it; a gauge that is left out has none."""
        innovation[[self._n + i for i in self._out]] = 0.0
        self.strain_innovation[:] = innovation[self._n :]
        self.strain_innovation[list(self._out)] = np.nan
        self.strain_error[:] = self.strain_innovation - self.memory.predict()
        self.memory.take(self.strain_innovation)

    def _publish(self):
        super()._publish()
        for name, value in zip(self.model.arm.gauge_names, self.state[self._bias], strict=True):
            self.parameters_estimated[f"bias of {name} [strain]"] = float(value)


class PrescribedMotion(Motion):
    """Predicts the state of `MotionKalman`; the torque is not used.

    Parameters
    ----------
    model : ArmModel
    values : mapping
        Checked values of `MotionKalman.PARAMETERS`.
    gauges : int
        Number of gauges.
    memory : ndarray, shape (k,)
        Coefficients of the shared noise.

    Attributes
    ----------
    size : int
        N.

    Raises
    ------
    ParameterError
        If the shared noise would grow.
    """

    def __init__(self, model, values, gauges, memory):
        super().__init__(model)
        self._values, self._gauges, self._memory = values, gauges, memory
        n, p = self._n, self._size
        self._moving = 2 * p + n  # (q, delta, qd, delta_d, a)
        self.size = self._moving + gauges + memory.size
        drift = np.array([gauge.drift for gauge in model.arm.gauges])
        self._bias_walk = np.maximum(drift, values["bias_noise"]) ** 2
        self._companion = np.eye(memory.size, k=-1)
        self._companion[0] = memory
        if np.abs(np.linalg.eigvals(self._companion)).max() >= 1.0:
            hint = "it has to die away: smaller coefficients"
            value = [float(v) for v in memory]
            raise ParameterError(
                "is a noise that grows", field="common_memory", value=value, hint=hint
            )
        self._fresh = self._innovation_fraction()

    def _innovation_fraction(self):
        """Variance of w_c for a c of variance one, from the stationary covariance."""
        from scipy.linalg import solve_discrete_lyapunov

        drive = np.zeros_like(self._companion)
        drive[0, 0] = 1.0
        return 1.0 / solve_discrete_lyapunov(self._companion, drive)[0, 0]

    def derivative(self, x):
        """Time derivative of (q, delta, qd, delta_d, a)."""
        model, n, p = self.model, self._n, self._size
        q, delta, qd, delta_d = x[:n], x[n:p], x[p : p + n], x[p + n : 2 * p]
        a = x[2 * p :]
        M = model.mass_matrix(q, delta)
        force = M[n:, :n] @ a + modal_forces(model, q, qd, delta, delta_d)
        bent = -np.linalg.solve(M[n:, n:], force)
        return np.concatenate([qd, delta_d, a, bent, -a / self._values["acceleration_time"]])

    def linearise(self, q):
        n, p, moving, values = self._n, self._size, self._moving, self._values
        rest = np.zeros(moving)
        rest[:n] = q
        A, S = np.zeros((2, self.size, self.size))
        A[:moving, :moving] = jacobian(self.derivative, rest, DIFFERENCE)
        inverse = np.linalg.inv(self.model.mass_matrix(q, np.zeros(p - n))[n:, n:])
        force = np.square(values["bending_force_noise"])
        S[p + n : 2 * p, p + n : 2 * p] = (inverse * force) @ inverse.T
        jerk = np.arange(2 * p, moving)
        S[jerk, jerk] = np.square(values["jerk_noise"])
        bias = np.arange(moving, moving + self._gauges)
        S[bias, bias] = self._bias_walk
        return A, S

    def _design(self, dt, *q):
        step = super()._design(dt, *q)
        # The shared noise changes from sample to sample, however long the time between them.
        last = slice(self._moving + self._gauges, self.size)
        Phi, Q = step.Phi.copy(), step.Q.copy()
        Phi[last, last] = self._companion
        Q[last.start, last.start] = self._fresh
        return replace(step, Phi=Phi, Q=Q)

    def advance(self, x, torque, dt, step):
        """The state after dt, shape (N,); the `torque` is not used."""
        moving = self._moving
        out = step.Phi @ x
        rate = self.derivative(x[:moving])
        out[:moving] = x[:moving] + step.Gamma[:moving, :moving] @ rate
        rest = dt - step.length
        if abs(rest) > EXACT:
            out[:moving] += rest * (step.Phi[:moving, :moving] @ rate)
        return out


def modal_forces(model, q, qd, delta, delta_d):
    """h_2 of (2): the modal forces at zero acceleration, shape (m,)."""
    n = model.n_joints
    if hasattr(model, "forces"):  # of a chain: much cheaper than all terms
        return model.forces(q, qd, delta, delta_d)[n:]
    t = model.terms(q, qd, delta, delta_d)
    return t.f2 + t.C2 @ delta_d + t.K2 @ delta
