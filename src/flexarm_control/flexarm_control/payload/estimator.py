# SPDX-License-Identifier: Apache-2.0
r"""Estimates the payload from strains and joint torques, by recursive least squares on (2).

For given mode shapes, (2) is affine in the payload, which is theta times that of the arm file. The regressor Y is the
difference of (2) for two payloads and for one. With it, the mode rows (s) and the joint rows (u) read

.. math::
    Y_s\,(\theta - 1) &= -\left(M_{21}\ddot q + M_{22}\ddot\delta + f_2 + C_2\dot\delta + K_2\delta\right), \\
    Y_u\,(\theta - 1) &= u - \left(M_{11}\ddot q + M_{12}\ddot\delta + f_1 + C_1\dot\delta + K_1\delta\right).

q, delta and u pass the same `LowPass`, which gives their derivatives. Each set of rows is solved by itself, with the
weights W (the modes' compliance, or one over the square of a joint's friction). Its sums over time forget with the time
constant `MEMORY`. The half width of a set's interval is

.. math::
    h_s &= \kappa\,\frac{|Y_s^TWK_2\delta|}{Y_s^TWY_s}
           + \sum_k\left|\frac{\partial\theta}{\partial\varepsilon_k}\right|\varepsilon_{0k} + 3\sigma_s, \\
    h_u &= \gamma\,\frac{|Y_u^TWu|}{Y_u^TWY_u} + \sum_j\frac{|Y_{uj}W_jF_j\,\mathrm{sgn}\,\dot q_j|}{Y_u^TWY_u}
           + 3\sigma_u,

for links that are stiffer by a fraction kappa (`STIFFNESS`), zero and noise epsilon_0 of each gauge, a drive whose
torque is higher by a fraction gamma (`DRIVE`), unmodelled friction F, and sigma of the residual. Sums are taken before
the magnitude, so an error that lowers theta while the arm accelerates and raises it while it brakes cancels.

The two sets check each other: a gauge that is dead, stuck or of the wrong sign changes only the first, a drive or
friction only the second. theta is the mean of both, weighted by one over the squares of the half widths,
and kept within the intersection of the intervals. It may be used if each interval is narrow enough, the intervals
overlap, the residuals are small, and theta is between 0 and its limit.
"""

import numpy as np

from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import parameter

from ..observers.plausibility.low_pass import LowPass
from ..observers.plausibility.strain_law import SETTLED, corner_of
from ..observers.plausibility.zero_drift import TOLERANCE, ZERO
from ..slow.payload_model import need_payload

OFF, REST, ONLINE = "off", "rest", "online"

PARAMETERS = (
    parameter("payload_estimate", OFF, choices=(OFF, REST, ONLINE), read_only=True).described(
        "Whether the payload is estimated from strains and torques. rest: while the arm rests under gravity; online:"
        " also in motion. The control takes the estimate over at rest, if the payload that it is designed for is"
        " outside the estimate's interval."
    ),
    parameter("payload_limit", 1.0 + TOLERANCE, "-", 1.0, 100.0, read_only=True).described(
        "Largest payload that is accepted, as a multiple of the arm file's: observer.payload_tolerance plus one."
    ),
)

#: Fractions by which links may be stiffer and drives stronger than in the arm file [-].
STIFFNESS, DRIVE = 0.15, 0.05
#: Unmodelled friction: as a fraction of the torque limit, plus a fraction of the file's Coulomb friction, at rest and
#: in motion [-].
UNSTATED, STICKING, SLIDING = 0.01, 1.0, 0.3
#: Time between two evaluations [s], and time constants of the sums [s]; their time counts only while they are updated.
INTERVAL, MEMORY = 0.008, {REST: 1.0, ONLINE: 3.0}
#: Joints that turn more slowly may stick [rad/s].
SLOW = 0.01
#: theta may be used if the half width of each set's interval, and that of the intersection of both, are at most this
#: times the larger of theta and 1 [-].
WIDE, NARROW = 2.0, 0.4
#: Fraction of the square of strains or torques that the fit may leave [-].
MISFIT = 0.04
#: Nothing is learnt while the strain due to one more payload is less than this fraction of the gauges' possible zeros,
#: both weighted as in the fit [-].
EXCITED = 0.1
#: The sums must have grown for this long [s].
LEARNT = 0.5


class _Set:
    """The sums of one set of rows."""

    def __init__(self, rows, size, memory):
        self._sums, self._whole, self._time = np.zeros(size), np.zeros(4), 0.0
        self.rows, self._memory = rows, memory

    def clear(self):
        self._sums[:], self._whole[:], self._time = 0.0, 0.0, 0.0

    def add(self, Y, r, W, measured, errors, dt):
        """Add rows Y x = r with the weights W; `errors` (size,) are x's numerators per unit of each possible error."""
        keep, WY = np.exp(-dt / self._memory), W * Y
        self._sums *= keep
        self._whole *= keep
        self._time += dt
        self._sums += dt * errors
        self._whole += dt * np.array([WY @ Y, WY @ r, W @ r**2, W @ measured**2])

    @property
    def known(self):
        """Whether the rows have been excited for long enough."""
        return self._time >= LEARNT

    def solve(self, scales, corner):
        """theta, the half width of its interval for errors of the size `scales`, and the misfit."""
        A, b, rr, total = self._whole
        misfit = max(rr - b * b / A, 0.0)
        independent = max(min(self._time, self._memory) * corner / 6.0, 1.0) * self.rows
        sigma = np.sqrt(misfit / A / independent)
        return (
            1.0 + b / A,
            np.abs(self._sums) @ scales / A + 3.0 * sigma,
            misfit / total if total > 0.0 else np.inf,
        )


class PayloadEstimator:
    """Estimates theta of the module, sample by sample.

    Parameters
    ----------
    model : ArmModel
        Model of the arm file's arm.
    mode : str
        `REST` or `ONLINE`.
    limit : float
        Largest theta that is accepted [-].

    Attributes
    ----------
    value, low, high : float
        theta and its interval [-]; NaN while there is none.
    strain, torque : (float, float)
        theta of each set of rows, and the half width of its interval.
    reason : str
        Why theta may not be used; empty when it may.
    """

    def __init__(self, model, mode, limit):
        need_payload(model, f"payload_estimate: {mode}")
        if not model.n_modes:
            raise DesignError(
                f"weighs the payload by how it bends the links, and arm {model.arm.name} does not bend",
                field="payload_estimate",
                value=mode,
                hint="write off",
            )
        self.mode, self.limit = mode, limit
        self._n, self._m = n, m = model.n_joints, model.n_modes
        self._one, self._two = model, model.with_payload(2.0)
        self._corner = corner_of(model)
        self._now, self._low = np.zeros(2 * n + m), LowPass(2 * n + m, self._corner)
        gauges = model.arm.gauges
        # Amplitudes (m, g) for an error of each gauge; without gauges nothing is known of them.
        self._map = StrainMap(model).inverse if gauges else np.zeros((m, 0))
        zero = [ZERO * g.full_scale + g.noise for g in gauges]
        self._scales = np.array([STIFFNESS, *zero]), np.array([DRIVE, *np.ones(n)])
        arm = model.arm
        self._coulomb = np.array([joint.friction.coulomb for joint in arm.joints])
        limits = np.where(np.isfinite(arm.torque_limits), arm.torque_limits, 0.0)
        self._unstated = np.maximum(UNSTATED * limits, 1e-6)
        memory = MEMORY[mode]
        self._sets = _Set(m, 1 + len(gauges), memory), _Set(n, 1 + n, memory)
        self.discard("nothing has been learnt yet")
        self.restart()

    def discard(self, reason):
        """Forget what was learnt, for a `reason`."""
        for each in self._sets:
            each.clear()
        self.value = self.low = self.high = np.nan
        self.strain = self.torque = np.nan, np.nan
        self.reason = reason

    def restart(self):
        """Begin again: the next sample does not follow the last one."""
        self._fresh, self._since, self._settling = True, 0.0, 0.0

    def note(self, position, amplitude, torque, dt):
        """Take a sample's positions (n,), amplitudes (m,) and the torque (n,) until then, `dt` [s] after the last."""
        n, now = self._n, self._now
        now[:n], now[n : n + self._m], now[n + self._m :] = position, amplitude, torque
        if self._fresh or dt <= 0.0:
            self._low.start(now)
            self._fresh, self._since, self._settling = False, 0.0, SETTLED / self._corner
            return
        self._low.update(now, dt)
        self._since += dt
        self._settling -= dt

    def update(self, resting):
        """Learn from the noted samples, if it is time to; `resting`: the reference does not move."""
        if self._fresh or self._since < INTERVAL:
            return
        dt, self._since = self._since, 0.0
        n, m = self._n, self._m
        q, delta, u = np.split(self._low.signal, [n, n + m])
        first, second = self._low.first, self._low.second
        still = resting and np.abs(first[:n]).max() < SLOW
        if self._settling > 0.0 or not (still or self.mode == ONLINE):
            return
        motion = second[: n + m], first[n : n + m], delta
        one, two = (model.terms(q, first[:n]) for model in (self._one, self._two))
        need, spring = _inverse(one, *motion), one.K2 @ delta
        Y = _inverse(two, *motion) - need
        need[:n] -= u
        strains, torques = self._sets
        W = 1.0 / np.diag(one.K2)
        WY = W * Y[n:]
        errors = np.concatenate([[WY @ spring], (WY @ one.K2) @ self._map])
        if not WY @ Y[n:] > EXCITED * (np.abs(errors[1:]) @ self._scales[0][1:]):
            if np.isnan(self.value):
                self.reason = "the payload hardly strains the links"
            return
        strains.add(Y[n:], -need[n:], W, spring, errors, dt)
        speed = first[:n]
        moves = np.abs(speed) >= SLOW
        F = self._unstated + np.where(moves, SLIDING, STICKING) * self._coulomb
        W = 1.0 / F**2
        WY = W * Y[:n]
        rubs = WY * F * np.where(moves, np.sign(speed), 1.0)
        torques.add(Y[:n], -need[:n], W, u, np.array([WY @ u, *rubs]), dt)
        if all(each.known for each in self._sets):
            self._judge()

    def _judge(self):
        """Set value, interval and reason from the sums."""
        found = [s.solve(e, self._corner) for s, e in zip(self._sets, self._scales, strict=True)]
        (s, h_s, misfit_s), (u, h_u, misfit_u) = found
        self.strain, self.torque = (s, h_s), (u, h_u)
        self.low, self.high = max(s - h_s, u - h_u), min(s + h_s, u + h_u)
        weights = 1.0 / h_s**2, 1.0 / h_u**2
        value = (weights[0] * s + weights[1] * u) / sum(weights)
        self.value = float(np.clip(value, max(self.low, 0.0), max(self.high, 0.0)))
        self.reason = self._why_not(h_s, h_u, misfit_s, misfit_u)

    def _why_not(self, h_s, h_u, misfit_s, misfit_u):
        size = max(self.value, 1.0)
        sets = ("strains", *self.strain, misfit_s), ("torques", *self.torque, misfit_u)
        for name, theta, half, _ in sets:
            if not half <= WIDE * size:
                return f"{name} give {theta:.2f} +- {half:.2f}: the payload moves them too little"
        if self.low > self.high:
            (s, h_s), (u, h_u) = self.strain, self.torque
            both = f"strains give {s:.2f} +- {h_s:.2f}, torques {u:.2f} +- {h_u:.2f}"
            return f"{both}: check gauges, stiffness and friction"
        for name, _, _, misfit in sets:
            if not misfit <= MISFIT:
                return f"{name} do not fit any payload: {100.0 * misfit**0.5:.0f} % are left"
        if not 0.5 * (self.high - self.low) <= NARROW * size:
            return f"{self.low:.2f} to {self.high:.2f} is too wide"
        if not (self.high >= 0.0 and self.value <= self.limit):
            return f"{self.low:.2f} to {self.high:.2f} is not within 0 and payload_limit {self.limit:g}"
        return ""


def _inverse(terms, acceleration, rate, delta):
    """Left-hand side of (2), shape (n + m,), without the torque."""
    out = terms.M @ acceleration
    out[: terms.n] += terms.f1 + terms.C1 @ rate + terms.K1 @ delta
    out[terms.n :] += terms.f2 + terms.C2 @ rate + terms.K2 @ delta
    return out
