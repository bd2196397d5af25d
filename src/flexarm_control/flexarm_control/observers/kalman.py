# SPDX-License-Identifier: Apache-2.0
r"""Kalman filter of joints and modes, with noise levels in physical units.

The state x = (q, delta, qd, delta_d) moves as in `motion`, under the applied torque and under unknown white forces:
torques of density ``torque_noise`` at the joints, and ``modal_force_noise`` on the modes. Each sample measures the
joint positions and the modal amplitudes, y = C x = (q, delta) + v. Joint velocities are not needed.
With P the covariance of the error,

.. math::
    x^- &= x + \Gamma f(x, u), & P^- &= \Phi P\Phi^T + Q, \\
    S &= C P^- C^T + R, & K &= P^- C^T S^{-1}, \\
    x &= x^- + K\nu, \quad \nu = y - C x^-, & P &= (I - KC)P^-(I - KC)^T + K R K^T

(Joseph's form, which stays positive despite rounding). R contains the encoders' variance and, for the amplitudes, the
gauges' noise through the strain map: :math:`R_\delta = W\,\mathrm{diag}(\sigma_i^2)\,W^T` with its weighted inverse W,
which includes the gain. An encoder of N counts rounds to steps of :math:`2\pi/N`. Its variance step^2/12 is taken as
white. This is right while the joint moves by more than a step per sample, and wrong at rest.

Lost samples make the step longer: P grows accordingly, and the torque is held over the gap.
The normalised innovation squared :math:`\nu^T S^{-1}\nu` is chi-squared with n + m degrees of freedom if all
assumptions hold. `consistent` becomes False when more than a tenth of the last fifty or so exceed the 99.9 % bound;
then the noise levels are too low, or the model is wrong.

The recursion of P does not depend on the measurements. Once it has settled for a time step and configuration, gain and
covariance are kept until either changes.
"""

from contextlib import suppress
from functools import lru_cache, partial

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs
from scipy.special import gammaincinv

from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.parameters import parameter

from .base import Observer, need_torque
from .motion import Motion

NOISE = (
    parameter("strain_noise", 0.0, "strain", 0.0, 1e-2).described(
        "Noise of every gauge, rms; 0: from the arm file, rounding included, or 1e-6 if it has none."
    ),
    parameter("position_noise", 0.0, "rad", 0.0, 1.0).described(
        "Noise of the joint positions, rms; 0: from the arm file's encoder_counts, or 1e-5 rad if it has none."
    ),
    parameter("amplitude_noise", 1e-5, "m, rad", 1e-12, 1.0).described(
        "Noise of the modal amplitudes, rms, of an arm whose file has no gauges."
    ),
    parameter("torque_noise", [0.01], "N m s^0.5", 1e-9, 1e6, length="joints").described(
        "Unknown torque at each joint: root of the spectral density; for an error of rms s that lasts t: s sqrt(2 t)."
    ),
    parameter("modal_force_noise", 0.001, "N s^0.5, N m s^0.5", 0.0, 1e6).described(
        "Unknown force on every mode: root of the spectral density."
    ),
)

#: Noise if neither arm file nor parameter gives one: of a good bridge [strain], of a fine encoder [rad].
UNSTATED_STRAIN, UNSTATED_POSITION = 1e-6, 1e-5


class Kalman(Observer):
    """Kalman filter; see the module.

    Attributes
    ----------
    state : ndarray, shape (N,)
        (q, delta, qd, delta_d).
    covariance : ndarray, shape (N, N)
        Covariance of the error of `state`.
    measurement_covariance : ndarray, shape (n + m, n + m)
        R.
    """

    PARAMETERS = NOISE
    NAME = "kalman"

    #: Assumed rms error of the rates at the first sample [rad/s, m/s].
    START = 1.0
    #: The estimate has converged once no rate's variance falls by more than this fraction per sample.
    SETTLED = 0.1
    #: P has settled once no variance changes by more than this fraction per sample.
    STEADY = 1e-9
    #: Inconsistent if more than a fraction `TOO_MANY` of the last 1/`RECENT` innovations are beyond this quantile.
    QUANTILE, TOO_MANY, RECENT = 0.999, 0.1, 0.02

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        n, m = model.n_joints, model.n_modes
        self._n, self._p = n, n + m
        self.innovation = np.zeros(m)
        self.covariance_diagonal = np.zeros(2 * m)
        self.joint_position, self.joint_velocity = np.zeros(n), np.zeros(n)
        # Torque and period of the last sample; the next one is assumed to have the same.
        self._torque, self._period = np.zeros(n), 0.0
        self._assume()
        self.state, self.covariance = np.zeros(2 * self._p), np.zeros((2 * self._p,) * 2)
        self._forget_gain()
        self._beyond = 0.0
        self._prepare()

    def _assume(self):
        """Set R, the density of the forces, and the bound of the innovations, from the parameters."""
        model, m = self.model, self._p - self._n
        strain_map = StrainMap(model) if model.arm.gauges else None
        self._covariance_without = lru_cache(
            partial(measurement_covariance, model, self.parameters, strain_map)
        )
        self.measurement_covariance = self._covariance_without(())
        noise = [*self.parameters["torque_noise"], *[self.parameters["modal_force_noise"]] * m]
        self.density = np.square(np.array(noise, float))
        self._bound = self._bound_of(self._p)
        self._measured = np.zeros(self._p)

    def _bound_of(self, count):
        """The bound of the normalised innovation squared of `count` measurements."""
        return float(2.0 * gammaincinv(0.5 * max(count, 1), self.QUANTILE))  # of chi-square

    def _prepare(self):
        self.motion = Motion(self.model, self.density)

    def reset(self):
        super().reset()
        self.consistent, self._beyond = True, 0.0
        self._forget_gain()

    def resume(self, other):
        if not isinstance(other, Kalman) or other.state.size < self.state.size:
            self.reset()  # it has no estimate of the joints: the next sample is the first
            return
        super().resume(other)
        size = self.state.size
        self.state[:] = other.state[:size]
        self.covariance[:] = other.covariance[:size, :size]
        self._forget_gain()
        self._publish()

    def leave_out(self, lost):
        """As `Observer.leave_out`: R becomes that of the remaining gauges."""
        super().leave_out(lost)
        self.measurement_covariance = self._covariance_without(lost)
        self._steady = False

    def rest_at(self, amplitude):
        """As `Observer.rest_at`: the old bias, which looked like motion, affects no later innovation."""
        n, p = self._n, self._p
        self.state[n:p], self.state[p : 2 * p] = amplitude, 0.0
        self._foreseen = None
        self._publish()

    def update(self, sample, dt):
        measured = self._measured
        measured[: self._n], measured[self._n :] = sample.position, sample.amplitude
        if self._elapsed < 0.0:
            self._start(sample)
            return
        need_torque(sample.torque, f"observer.type {self.NAME}", "use motion_kalman")
        self._advance(sample.torque, dt)

    def _advance(self, torque, dt):
        """Predict over dt [s] and correct by `_measured`."""
        before = (
            None if self.converged else self.covariance.diagonal()[self._p : 2 * self._p].copy()
        )
        x, step = self._predict(torque, dt)
        # Nothing is assigned before everything is computed: a failure changes nothing.
        innovation = self._measured - self._output(x)
        if step is not self._step or not self._steady:
            self._recursion(step)
        self._innovations(innovation)
        weighted = dpotrs(self._root, innovation, lower=1)[0]
        self.state[:] = x + innovation @ self._gain_transposed
        self.innovation_squared = float(innovation @ weighted)
        self._judge()
        self._publish()
        self._torque[:], self._period = torque, dt
        self._elapsed += dt
        if not self.converged:
            after = self.covariance.diagonal()[self._p : 2 * self._p]
            self.converged = bool(np.all(after >= (1.0 - self.SETTLED) * before))

    def _start(self, sample):
        p = self._p
        self.state[:p], self.state[p:] = self._measured, 0.0
        self.state[p : p + self._n] = sample.velocity
        self.covariance[:] = 0.0
        self.covariance[:p, :p] = self.measurement_covariance
        np.fill_diagonal(self.covariance[p:, p:], self.START**2)
        self.innovation[:], self.innovation_squared = 0.0, float("nan")
        self._elapsed = 0.0
        self._publish()

    def _predict(self, torque, dt):
        """The predicted state, and the step for the covariance."""
        foreseen, self._foreseen = self._foreseen, None
        if foreseen is None or foreseen.period != round(dt, 5):
            foreseen = self.motion.foresee(self.state, self._torque, dt)
        return self.motion.go_on(foreseen, torque, dt), foreseen.step

    def _foresee(self):
        """Begin the prediction of the next sample; its torque and time step are assumed to be those of this one."""
        self._foreseen = self.motion.foresee(self.state, self._torque, self._period)

    def _innovations(self, innovation):
        """Publish the innovation of a sample (measurements,)."""
        self.innovation[:] = innovation[self._n :]

    def _output(self, x):
        """C x: the measured part of a state (N,), or of the columns of a matrix (N, k)."""
        return x[: self._p]

    def look_ahead(self):
        step = self._step
        if step is None:
            return
        self._foresee()
        if not self.converged or self._steady:
            return
        with suppress(MessageError):  # if the sample comes as assumed, it raises this error itself
            self._ahead = step, self.measurement_covariance, self._corrected(step)

    def _recursion(self, step):
        """Covariance after a step and a measurement, and the gain."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None and ahead[0] is step and ahead[1] is self.measurement_covariance:
            P, root, gain, same = ahead[2]
        else:
            P, root, gain, same = self._corrected(step)
        self._steady = same and step is self._step
        self._step, self._root, self._gain_transposed = step, root, gain
        self.covariance[:] = P

    def _corrected(self, step):
        """Covariance after a step and a measurement, root of the innovation's, K^T, and whether variances settled."""
        R = self.measurement_covariance
        P = step.Phi @ self.covariance @ step.Phi.T
        P += step.Q
        seen = self._output(P)
        root, failed = dpotrf(self._output(seen.T) + R, lower=1)
        if failed:
            raise MessageError(
                "is not positive definite",
                field="covariance of the innovation",
                hint="the time step is too long for this arm's model, or a noise level is too small",
            )
        gain = dpotrs(root, seen, lower=1)[0]  # K^T
        P = P - gain.T @ seen
        P -= (self._output(P.T).T - gain.T @ R) @ gain
        P = 0.5 * (P + P.T)
        variance, last = P.diagonal(), self.covariance.diagonal()
        same = bool(np.all(np.abs(variance - last) <= self.STEADY * variance))
        return P, root, gain, same

    def _forget_gain(self):
        self._step, self._steady, self._root, self._gain_transposed = None, False, None, None
        self._ahead = self._foreseen = None  # the results of `look_ahead`

    def _judge(self):
        self._beyond += self.RECENT * (float(self.innovation_squared > self._bound) - self._beyond)
        self.consistent = self._beyond <= self.TOO_MANY

    def _publish(self):
        n, p, x = self._n, self._p, self.state
        self.joint_position[:], self.amplitude[:] = x[:n], x[n:p]
        self.joint_velocity[:], self.rate[:] = x[p : p + n], x[p + n : 2 * p]
        m, variance = p - n, self.covariance.diagonal()
        self.covariance_diagonal[:m] = variance[n:p]
        self.covariance_diagonal[m:] = variance[p + n : 2 * p]


def measurement_covariance(model, parameters, strain_map, lost):
    """R of joint positions and modal amplitudes, shape (n + m, n + m) [rad^2, m^2].

    `parameters` are those of `NOISE`. `strain_map` is the model's, None without gauges. `lost` has the indices of
    gauges that are left out of the amplitudes.
    """
    n, m = model.n_joints, model.n_modes
    out = np.zeros((n + m, n + m))
    for i, joint in enumerate(model.arm.joints):
        out[i, i] = position_uncertainty(joint, parameters["position_noise"]) ** 2
    if not m:
        return out
    if not model.arm.gauges:
        out[n:, n:] = parameters["amplitude_noise"] ** 2 * np.eye(m)
        return out
    gauges, given = model.arm.gauges, parameters["strain_noise"]
    stated = [given or g.uncertainty or UNSTATED_STRAIN for g in gauges]
    inverse = strain_map.inverse_without(lost)
    weighted = inverse * np.array(stated)
    out[n:, n:] = weighted @ weighted.T
    return out


def position_uncertainty(joint, stated):
    """Rms error of a joint's position [rad]: the `stated` one if above 0, else that of the `joint`'s encoder."""
    if stated > 0.0:
        return stated
    if joint.encoder_counts > 0:
        return 2.0 * np.pi / joint.encoder_counts / np.sqrt(12.0)
    return UNSTATED_POSITION
