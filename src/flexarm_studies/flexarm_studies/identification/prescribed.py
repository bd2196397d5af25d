# SPDX-License-Identifier: Apache-2.0
r"""Predicts strains without torque: the joints' motors move as measured, and the links follow.

If the joint motion is prescribed, only the rows of (2) for links and transmissions are needed,

.. math::
    M_{22}(q, \delta)\,\ddot\delta + M_{21}(q, \delta)\,\ddot q + f_2 + K_2\delta + C_2\dot\delta = 0, \qquad
    \hat\varepsilon_c(t) = g_c R_c\,\delta(t - \tau_c) + b_c + d_c\,(t - t_m),

so torque, motor inertia and friction have no effect. The measured angles pass a low pass without phase and become a
cubic spline. Its acceleration is linear between samples, as the compiled stepper needs it. Position, velocity and
acceleration are consistent. The links start at rest under gravity.

Gauge c has gain g, bias b and drift d about the middle t_m of the recording; it is late by tau (early if negative).
Between samples, :math:`\delta` is the Hermite cubic of amplitudes and rates.
"""

import numpy as np
from scipy.interpolate import CubicSpline

from flexarm_dynamics.arm.strain_map import reading_rows
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.kernels.chain_data import ENGAGEMENT
from flexarm_dynamics.models import fixed_step, model
from flexarm_dynamics.models.chain import Chain

from ..recordings.motion import CORNER, low_passed

#: The linearly implicit method is stable for any stiffness and damping of a transmission that the fit tries.
METHOD = "implicit"
#: Largest phase per step of the fastest mode [rad]. A mode with more than `SHOWN` periods per sample [-] counts as
#: having `SHOWN`, because the samples do not show it. The error of a strain is below a tenth of a microstrain on arms
#: like TUDOR (tested).
PHASE, SHOWN = 0.06, 0.2
#: With play, a step is at most the time that the flanks take to engage at this speed [rad/s]. With sharp flanks the
#: error of a strain is then some hundredths of a microstrain rms (tested).
FLANK_SPEED = 1.5
#: Flanks that engage within a smaller angle than this [rad] do not make the steps shorter still: a fit may try any
#: play, and such a small play has little effect.
MIN_FLANK = 1e-4
#: The arms that the fit tries may have modes that are faster than the file's by this factor [-].
MARGIN = 1.4


class MotionPredictor:
    """Predicts the strains of a `recording` whose joint motion is prescribed.

    Parameters
    ----------
    arm : Arm
        All arms whose strains will be predicted have its structure.
    recording : Recording
    corner : float
        Of the low pass of the joint angles [Hz].

    Attributes
    ----------
    position, velocity, acceleration : ndarray, shape (s, n)
        The smoothed motion at the samples [rad], [rad/s], [rad/s^2].
    substeps : int
        Steps of integration per sample.

    Raises
    ------
    FlexarmError
        For an arm of another model than `chain`.
    """

    def __init__(self, arm, recording, corner=CORNER):
        self.recording, self.period = recording, recording.period
        built = _chain(arm)
        self.n, self.m = built.n_joints, built.n_modes
        spline = CubicSpline(recording.time, low_passed(recording, corner), bc_type="natural")
        motion = (np.ascontiguousarray(spline(recording.time, k)) for k in range(3))
        self.position, self.velocity, self.acceleration = motion
        self.middle = 0.5 * float(recording.time[-1])
        self.adapt(arm)

    def adapt(self, arm):
        """Set the `substeps` that the motion needs for this `arm`, and for arms with modes faster by up to `MARGIN`."""
        frequencies = driven_frequencies(_chain(arm), self.position[0])
        fastest = MARGIN * float(np.max(frequencies, initial=0.0))
        rings = min(fastest, SHOWN * 2.0 * np.pi / self.period)
        ways = [
            max(ENGAGEMENT * 0.5 * t.play + t.rounding, MIN_FLANK)
            for j in arm.joints
            if (t := j.transmission) and t.play
        ]
        rate = max(rings / PHASE, FLANK_SPEED / min(ways, default=np.inf))
        self.substeps = max(1, int(np.ceil(rate * self.period)))

    def states(self, arm, offset=None, samples=None):
        """Amplitudes and rates of the modes at the first `samples`, or at all.

        Parameters
        ----------
        arm : Arm
        offset : ndarray, shape (n,), optional
            Added to the measured angles [rad].
        samples : int, optional

        Returns
        -------
        delta, rate : ndarray, shape (s, m)
            NaN where the model diverges, or if none can be built for the arm.
        built : Chain or None
        """
        count = len(self.position) if samples is None else samples
        n, m = self.n, self.m
        states = np.full((count, 2 * (n + m)), np.nan)
        try:
            built = _chain(arm)
            position = self.position if offset is None else self.position + offset
            states[0, :n], states[0, n + m : 2 * n + m] = position[0], self.velocity[0]
            states[0, n : n + m], states[0, 2 * n + m :] = built.static_deflection(position[0]), 0.0
        except (FlexarmError, np.linalg.LinAlgError):
            return states[:, n : n + m], states[:, 2 * n + m :], None
        stepper = built.driven_stepper(fixed_step.METHODS[METHOD])
        drive = self.acceleration[:count]
        with np.errstate(all="ignore"):
            step = self.period / self.substeps
            stepper.trajectory(states, drive[:-1], drive[1:], step, self.substeps)
        return states[:, n : n + m], states[:, 2 * n + m :], built

    def strains(self, arm, delta, rate, built, delay=None, drift=None):
        """Readings of the gauges, shape (s, g) [-].

        Parameters
        ----------
        arm : Arm
            Its gauges are read.
        delta, rate, built
            Results of `states`.
        delay : ndarray, shape (g,), optional
            Time by which the channels are late [s].
        drift : ndarray, shape (g,), optional
            Drift of the readings [1/s].
        """
        gauges = arm.gauges
        out = np.full((len(delta), len(gauges)), np.nan)
        if built is None:
            return out
        rows = reading_rows(built, gauges)
        late = np.zeros(len(gauges)) if delay is None else np.asarray(delay, float)
        for c in range(len(gauges)):
            read, slope = delta @ rows[c], rate @ rows[c]
            out[:, c] = read if late[c] == 0.0 else shifted(read, slope, late[c], self.period)
        out += [g.bias for g in gauges]
        if drift is not None:
            out += np.outer(self.recording.time[: len(delta)] - self.middle, drift)
        return out


def shifted(values, slopes, delay, period):
    """A series (s,) delayed by `delay` [s], interpolated by cubics; beyond its ends it keeps the end values.

    The cubics have the `values` and the derivatives `slopes` [1/s] at the samples, one per `period` [s].
    """
    at = np.clip(np.arange(len(values)) - delay / period, 0.0, len(values) - 1.0)
    k = np.minimum(at.astype(int), len(values) - 2)
    x = at - k
    a, b, da, db = values[k], values[k + 1], period * slopes[k], period * slopes[k + 1]
    return (
        a * (1.0 + 2.0 * x) * (1.0 - x) ** 2 + da * x * (1.0 - x) ** 2
        + b * (3.0 - 2.0 * x) * x**2 + db * (x - 1.0) * x**2
    )  # fmt: skip


def driven_frequencies(built, position, delta=None):
    """Angular frequencies of links and transmissions with the motors held and play closed, ascending [rad/s].

    Parameters
    ----------
    built : Chain
    position : ndarray, shape (n,)
        [rad]
    delta : ndarray, shape (m,), optional
        Deflections at which the arm's stiffness is computed; if not given, the arm is straight.
    """
    from scipy.linalg import eigh

    n = built.n_joints
    if not built.n_modes:
        return np.zeros(0)
    M = built.mass_matrix(np.asarray(position, float), delta)[n:, n:]
    return np.sqrt(np.maximum(eigh(built.stiffness_matrix(), M, eigvals_only=True), 0.0))


def prescribed_torque(chain, state, acceleration):
    """Torque under which the joints have an acceleration while the modes move freely, shape (n,) [N m].

    Parameters
    ----------
    chain : Chain
    state : ndarray, shape (2 (n + m),)
    acceleration : ndarray, shape (n,)
        Of the joints [rad/s^2].
    """
    n, m = chain.n_joints, chain.n_modes
    q, delta, qd, delta_d = np.split(state, [n, n + m, 2 * n + m])
    M = chain.mass_matrix(q, delta)
    forces = chain.forces(q, qd, delta, delta_d)
    modal = np.linalg.solve(M[n:, n:], -forces[n:] - M[n:, :n] @ acceleration)
    return (
        M[:n, :n] @ acceleration
        + M[:n, n:] @ modal
        + forces[:n]
        + chain.friction(qd, delta, delta_d)
    )


def _chain(arm):
    built = model.build(arm)
    if not isinstance(built, Chain):
        raise FlexarmError(
            "can't have its motion prescribed", field=f"model of {arm.name}", value=arm.model, limit="chain",
            hint="write `model: chain` in the arm file",
        )  # fmt: skip
    return built
