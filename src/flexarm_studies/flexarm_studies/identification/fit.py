# SPDX-License-Identifier: Apache-2.0
r"""Fits an arm's parameters (output-error method), with intervals that are valid for coloured residuals.

The fit finds the parameters :math:`\theta`, gauge biases and initial state x_0 whose prediction (`predictor`) is
closest to the measurement,

.. math:: \min_{\theta, x_0} \sum_k\sum_c w_{kc}\,(y_{kc} - \hat y_{kc})^2/\sigma_c^2 ,

where :math:`\sigma_c` of each channel follows from its residuals. An encoder that stays on one count for r samples has
made one measurement, not r, so each of these samples has the weight :math:`w = 1/r`. (Ljung, System Identification,
1999, 7.2 and 9.)

If the frequency of a vibration has a relative error s, prediction and measurement are in opposite phase after 1/(2 s)
periods. Over longer times the sum has other minima. So the fit begins with the first periods of the motion and
continues with longer and longer parts of it.

With the scores :math:`s_k = \sum_c J_{kc}^T r_{kc}`, the covariance is

.. math:: P = A^{-1} S A^{-1}, \quad A = J^T J, \quad
          S = \sum_{|l|\le L}\left(1 - \tfrac{|l|}{L + 1}\right)\sum_k s_k s_{k+l}^T

(Newey and West 1987; L by Andrews 1991 from the most coloured channel). For white residuals this is the usual
:math:`\sigma^2 (J^TJ)^{-1}`; the larger of the two variances is used. Intervals are :math:`\pm 1.96\sqrt{P_{ii}}`.

A parameter that the motion does not determine keeps the file's value. A parameter counts as such if its interval is
wider than a fraction of its value. The worst one is held first; then the others are fitted again.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import least_squares

from flexarm_dynamics.models import model

from .predictor import Predictor
from .quantities import changed, held, quantities

#: Two-sided 95 % of the normal distribution.
NORMAL = 1.959964
#: Difference step of the Jacobian, as a fraction of a quantity's scale [-].
STEP = 1e-7
#: Length of the first part that is fitted, in periods of the slowest mode, and growth factor from part to part [-].
FIRST_PERIODS, GROWTH = 1.0, 2.0
#: Standard deviation of the prior around the file's value in these parts, as a fraction of the scale [-].
PRIOR = 0.5
#: Largest value of a quantity, in multiples of its scale [-].
MAX_SCALED = 30.0
#: Smallest noise that a channel is assumed to have [rad], [strain].
MIN_NOISE = 1e-9
#: Noise assumed before any fit if none is stated, as a fraction of the signal [-].
ASSUMED = 1e-3
#: Smallest bandwidth of the covariance, in multiples of the third root of the number of samples [-].
LAG_FACTOR = 1.0
#: Largest correlation between neighbouring residuals that is used [-].
MAX_CORRELATION = 0.97
#: The model does not explain the motion if a channel's residual exceeds this fraction of the signal's deviation [-].
POOR = 0.05
#: Stiffnesses that are tried after a poor first fit, as factors of the file's stiffnesses [-].
TRIED = (0.4, 0.6, 1.6, 2.5)
#: Singular values of the Jacobian, with columns of unit length, below this count as zero [-].
SINGULAR = 1e-5
#: A quantity this close to its smallest value has that value, as a fraction of its scale [-].
AT_LIMIT = 1e-6
#: Two parameters with a larger correlation are named together [-].
TOGETHER = 0.95


@dataclass(frozen=True, eq=False)
class Identified:
    """Result of a fit.

    Attributes
    ----------
    arm : Arm
        The arm with the fitted values; quantities that are held or undetermined have the file's value.
    quantities : list of Quantity
        Of the arm, fitted or not.
    values, half_widths : ndarray, shape (p,)
        Values, and half-widths of the 95 % intervals, NaN where the file's value was kept [SI].
    covariance : ndarray, shape (p, p)
        Covariance of the values; zero where they are held.
    initial : ndarray, shape (2 (n + m),)
        Initial state.
    predicted : ndarray, shape (s, n + g)
        Joint angles and strains that the fitted model predicts.
    measured : ndarray, shape (s, n + g)
    noise : ndarray, shape (n + g,)
        Rms residual of each channel [rad], [strain].
    held, undetermined : tuple of str
        Quantities that keep the file's value on request, and because the motion does not determine them.
    warnings : tuple of str
    """

    arm: object
    quantities: list
    values: np.ndarray
    half_widths: np.ndarray
    covariance: np.ndarray
    initial: np.ndarray
    predicted: np.ndarray
    measured: np.ndarray
    noise: np.ndarray
    held: tuple = ()
    undetermined: tuple = ()
    warnings: tuple = field(default=())


def identify(arm, recording, hold=(), limit=0.5):
    """Fit an arm's parameters to a recorded motion.

    Parameters
    ----------
    arm : Arm
        Start of the fit; it also gives the values of everything that the motion does not determine.
    recording : Recording
    hold : sequence of str
        Names, or patterns with ``*``, of quantities that keep the file's value.
    limit : float
        A quantity is undetermined if its half-width exceeds this fraction of its value [-].

    Raises
    ------
    FlexarmError
        For a pattern that matches nothing, and if the model can't follow the motion at all.
    """
    problem = Problem(arm, recording, hold)
    problem.leave_out_singular()
    problem.fit()
    while (worst := problem.undetermined(limit)) is not None:
        problem.leave_out(worst)
        problem.refine()
    return problem.result()


class Problem:
    """A fit in progress; see the module."""

    def __init__(self, arm, recording, hold=()):
        self.arm, self.recording = arm, recording
        self.found = quantities(arm, recording)
        self.predictor = Predictor(arm, recording)
        names = held(self.found, hold)
        self.held = tuple(q.name for q in self.found if q.name in names)
        self.left_out, self.warnings = [], list(recording.notes)
        self.free = np.array([q.name not in names for q in self.found], bool)
        self.file = np.array([q.get(arm) for q in self.found])
        self.values, self.initial = self.file.copy(), self.predictor.guess(arm)
        self.measured = np.hstack([recording.position, recording.strain])
        self.weight = self._weights()
        self.noise = self._prior_noise()
        self.state_scale = self._state_scale()

    # Scales ----------------------------------------------------------------------------------

    def _weights(self):
        """Square roots of w, shape (s, n + g): a run on one count weighs as one sample; missing values have 0."""
        weight = np.isfinite(self.measured).astype(float)
        for c in range(self.predictor.n):
            reading = self.measured[:, c]
            edges = np.flatnonzero(np.diff(reading) != 0.0) + 1
            lengths = np.diff(np.concatenate([[0], edges, [reading.size]]))
            weight[:, c] /= np.sqrt(np.repeat(lengths, lengths))
        self.measured = np.nan_to_num(self.measured)
        return weight

    def _prior_noise(self):
        """Noise that each channel is assumed to have before any fit, rms."""
        spread = self.measured.std(axis=0)
        noise = np.maximum(ASSUMED * spread, MIN_NOISE)
        for c, joint in enumerate(self.arm.joints):
            if joint.encoder_counts:
                noise[c] = max(noise[c], 2.0 * np.pi / joint.encoder_counts / np.sqrt(12.0))
        for c, gauge in enumerate(self.arm.gauges, self.predictor.n):
            noise[c] = max(noise[c], gauge.uncertainty)
        return noise

    def _state_scale(self):
        """Scales of the initial state's angles, amplitudes and rates, from the ranges of the measurements."""
        m = self.predictor.m
        angle = np.maximum(np.ptp(self.recording.position, axis=0), 1e-3)
        link = max(link.length for link in self.arm.links)
        delta = np.full(m, 1e-2 * link)
        rate = np.maximum(np.abs(np.gradient(self.recording.position, axis=0)).max(0), 1e-4)
        return np.concatenate([angle, delta, rate / self.recording.period, 10.0 * delta])

    # Residuals -------------------------------------------------------------------------------

    @property
    def _scales(self):
        scales = np.array([q.scale for q in self.found])[self.free]
        return np.concatenate([scales, self.state_scale])

    def _point(self, x):
        """Values of all quantities and initial state, from scaled unknowns."""
        values, p = self.values.copy(), int(self.free.sum())
        values[self.free] = x[:p] * self._scales[:p]
        return values, x[p:] * self.state_scale

    def _unknowns(self):
        return np.concatenate([self.values[self.free], self.initial]) / self._scales

    def residuals(self, x, samples):
        """Weighted residuals (measured minus predicted), shape (samples, n + g)."""
        values, initial = self._point(x)
        arm = changed(self.arm, self.found, values)
        predicted = self.predictor.predict(arm, initial, samples)
        r = self.weight[:samples] * (self.measured[:samples] - predicted) / self.noise
        # A model that diverges gets a large, finite residual.
        return np.clip(np.nan_to_num(r, nan=1e6, posinf=1e6, neginf=-1e6), -1e6, 1e6)

    def jacobian(self, x, samples):
        """Derivative of `residuals` by forward differences, shape (samples, n + g, unknowns)."""
        values, initial = self._point(x)
        arm, p = changed(self.arm, self.found, values), int(self.free.sum())
        states, built = self.predictor.states(arm, initial, samples)
        base = self.predictor.outputs(arm, states, built)
        out = np.zeros((samples, base.shape[1], x.size))
        for j, index in enumerate(np.flatnonzero(self.free)):
            other = values.copy()
            other[index] += STEP * self.found[index].scale
            other = changed(self.arm, self.found, other)
            # Gains and biases do not affect the motion: the states are the same.
            same = self.found[index].kind in ("gain", "bias")
            made = (states, built) if same else self.predictor.states(other, initial, samples)
            out[:, :, j] = (self.predictor.outputs(other, *made) - base) / STEP
        for j in range(initial.size):
            other = initial.copy()
            other[j] += STEP * self.state_scale[j]
            moved = self.predictor.run(built, other, samples)
            out[:, :, p + j] = (self.predictor.outputs(arm, moved, built) - base) / STEP
        out *= -(self.weight[:samples] / self.noise)[:, :, None]
        return np.nan_to_num(out, nan=0.0, posinf=0.0, neginf=0.0)

    # The fit ---------------------------------------------------------------------------------

    def fit(self):
        """Fit longer and longer parts, then the whole; after a poor fit, start again from other stiffnesses."""
        self._fit_from(1.0)
        best = self._kept()
        stiff = any(q.kind == "EI" for q, free in zip(self.found, self.free, strict=True) if free)
        for factor in TRIED if self.poor() and stiff else ():
            self._fit_from(factor)
            if (now := self._kept())[3] < best[3]:
                best = now
            if not self.poor():
                break
        self.values, self.initial, self.noise, _ = best
        for channel in self.poor():
            self.warnings.append(
                f"{channel}: the fit leaves more than {100 * POOR:g} % of it; the model does not explain this"
                " motion, don't trust the intervals"
            )

    def _kept(self):
        """The current point and its cost. The cost uses the noise assumed before any fit, so fits are comparable."""
        noise, self.noise = self.noise, self._prior_noise()
        cost = float(np.sum(self.residuals(self._unknowns(), len(self.measured)) ** 2))
        self.noise = noise
        return self.values, self.initial, noise, cost

    def _fit_from(self, factor):
        stiff = np.array([q.kind == "EI" for q in self.found]) & self.free
        self.values = np.where(stiff, factor * self.file, self.file)
        self.initial, self.noise = self.predictor.guess(self.arm), self._prior_noise()
        for samples in self.parts():
            self._solve(samples, prior=True, tolerance=1e-2, most=8)
        self.refine()

    def refine(self):
        """Fit the whole motion, with noise estimated from the residuals."""
        whole = len(self.measured)
        for tolerance in (1e-4, 1e-7):
            self._solve(whole, prior=False, tolerance=tolerance, most=40)
            self._measure_noise()

    def parts(self):
        """Ends of the parts of the motion that are fitted first [samples]."""
        whole, r = len(self.measured), self.recording
        if not self.predictor.m:
            return []
        away = np.abs(r.torque - r.torque[1]).max(axis=1)
        active = np.flatnonzero(away[1:] > 0.05 * away.max()) if away.max() > 0.0 else [0]
        begin = int(active[0])
        built = model.build(self.arm)
        slowest = max(float(built.frequencies(r.position[0])[0]), 1e-3)
        span, ends = FIRST_PERIODS * 2.0 * np.pi / slowest / r.period, []
        while begin + span < whole:
            ends.append(max(begin + int(span), 20))
            span *= GROWTH
        return ends

    def _solve(self, samples, prior, tolerance, most):
        """Least squares from the current point; `prior` adds a weak prior around the file's values."""
        start, p = self._unknowns(), int(self.free.sum())
        scales = self._scales[:p]
        file = self.file[self.free] / scales
        first = self.residuals(start, samples)
        pull = (np.sqrt(np.mean(first**2)) if prior else 0.0) / PRIOR

        def residuals(x):
            return np.concatenate([self.residuals(x, samples).ravel(), pull * (x[:p] - file)])

        def jacobian(x):
            rows = self.jacobian(x, samples)
            return np.vstack([rows.reshape(-1, x.size), pull * np.eye(p, x.size)])

        low = np.array([q.low for q in self.found])[self.free] / scales
        bounds = (np.full(start.size, -np.inf), np.full(start.size, np.inf))
        bounds[0][:p], bounds[1][:p] = low, MAX_SCALED
        start[:p] = np.clip(start[:p], low + 1e-9, MAX_SCALED)
        solution = least_squares(
            residuals, start, jacobian, bounds, ftol=tolerance, xtol=1e-9, gtol=1e-10, max_nfev=most
        )
        self.values, self.initial = self._point(solution.x)

    def _measure_noise(self):
        r = self.residuals(self._unknowns(), len(self.measured)) * self.noise
        rms = np.sqrt(np.sum(r**2, axis=0) / np.maximum(np.sum(self.weight**2, axis=0), 1.0))
        self.noise = np.maximum(rms, MIN_NOISE)

    def poor(self):
        """Names of the channels that the fit does not explain."""
        names = (*self.arm.joint_names, *self.arm.gauge_names)
        used = self.weight.any(axis=0)
        known = zip(self.measured.T, self.weight.T > 0.0, strict=True)
        spread = np.array([y[k].std() if k.any() else 0.0 for y, k in known])
        floor = 3.0 * self._prior_noise()
        bad = used & (self.noise > np.maximum(POOR * spread, floor))
        return [name for name, b in zip(names, bad, strict=True) if b]

    # What is determined ----------------------------------------------------------------------

    def covariance(self):
        """Covariance of the free quantities and the initial state, scaled; see the module."""
        whole, x = len(self.measured), self._unknowns()
        J, r = self.jacobian(x, whole), self.residuals(x, whole)
        return robust_covariance(J, r, np.count_nonzero(self.weight))

    def undetermined(self, limit):
        """Index of the free quantity with the widest interval relative to its value; None if within `limit`."""
        if not self.free.any():
            return None
        cov, indices = self.covariance(), np.flatnonzero(self.free)
        widths = NORMAL * np.sqrt(np.diag(cov))[: indices.size]  # in scales
        values = np.abs(self.values[indices]) / np.array([self.found[i].scale for i in indices])
        ratio = widths / np.maximum(values, 1.0)
        worst = int(np.argmax(ratio))
        if not ratio[worst] > limit:
            return None
        deviation = np.sqrt(np.diag(cov))[: indices.size]
        alike = np.abs(cov[worst, : indices.size]) / (deviation[worst] * deviation)
        partners = [
            self.found[i].name
            for i in np.delete(indices, worst)[np.delete(alike, worst) > TOGETHER]
        ]
        why = f"its interval would be +-{100.0 * ratio[worst]:.3g} % of it"
        if partners:
            why += f", and it acts like {', '.join(partners)}"
        self._because = why
        return int(indices[worst])

    def leave_out_singular(self):
        """Leave out quantities that do not affect the measurements, or only in the same way as others."""
        while self.free.any():
            J = self.jacobian(self._unknowns(), len(self.measured))
            J = J.reshape(-1, J.shape[-1])
            size, p = np.linalg.norm(J, axis=0), int(self.free.sum())
            indices = np.flatnonzero(self.free)
            silent = np.flatnonzero(size[:p] <= 1e-12 * max(size.max(), 1e-300))
            if silent.size:
                self._because = "it affects nothing that was measured"
                self.leave_out(int(indices[silent[0]]))
                continue
            _, values, directions = np.linalg.svd(J / np.maximum(size, 1e-300), full_matrices=False)
            parts = np.abs(directions[-1])
            involved = np.flatnonzero(parts[:p] > 0.1)
            if values[-1] > SINGULAR * values[0] or not involved.size:
                return
            names = [self.found[indices[k]].name for k in involved]
            # The quantity with the smallest effect keeps the file's value.
            least = int(involved[np.argmin(size[involved])])
            self._because = f"{', '.join(names)} act alike on what was measured"
            self.leave_out(int(indices[least]))

    def leave_out(self, index):
        """Keep the file's value of a quantity."""
        name, kept = self.found[index].name, f"{self.file[index]:.6g} {self.found[index].unit}"
        self.left_out.append(name)
        self.free[index] = False
        self.values[index] = self.file[index]
        self.warnings.append(
            f"{name} is not determined by this motion and keeps the file's {kept}: {self._because};"
            " the others' intervals hold for that value"
        )

    def _end_at_limits(self):
        """Set quantities that ended just above their smallest value to that value."""
        low = np.array([q.low for q in self.found])
        close = self.free & (self.values - low < AT_LIMIT * np.array([q.scale for q in self.found]))
        self.values = np.where(close, low, self.values)

    def result(self):
        """The result of the fit so far."""
        p, indices = len(self.found), np.flatnonzero(self.free)
        covariance, widths = np.zeros((p, p)), np.full(p, np.nan)
        if indices.size:
            scales = np.array([self.found[i].scale for i in indices])
            block = self.covariance()[: indices.size, : indices.size] * np.outer(scales, scales)
            covariance[np.ix_(indices, indices)] = block
            widths[indices] = NORMAL * np.sqrt(np.diag(block))
        self._end_at_limits()
        arm = changed(self.arm, self.found, self.values)
        predicted = self.predictor.predict(arm, self.initial)
        return Identified(
            arm, self.found, self.values, widths, covariance, self.initial, predicted,
            np.where(self.weight > 0.0, self.measured, np.nan), self.noise, self.held,
            tuple(self.left_out), tuple(self.warnings),
        )  # fmt: skip


def robust_covariance(J, r, used):
    """Covariance (p, p) of the unknowns of a least-squares fit with coloured residuals; see the module.

    Parameters
    ----------
    J : ndarray, shape (s, c, p)
        Derivative of the residuals; overwritten.
    r : ndarray, shape (s, c)
        Weighted residuals.
    used : int
        Number of measurements.
    """
    whole, unknowns = len(r), J.shape[-1]
    size = np.sqrt(np.sum(J**2, axis=(0, 1)))
    size[size == 0.0] = 1.0
    J /= size
    flat = J.reshape(-1, unknowns)
    bread = np.linalg.pinv(flat.T @ flat, rcond=1e-15, hermitian=True)  # of white residuals
    scores = np.einsum("kcx,kc->kx", J, r)
    lags = min(bandwidth(r), whole // 4)
    meat = scores.T @ scores
    for lag in range(1, lags + 1):
        gamma = scores[lag:].T @ scores[:-lag]
        meat += (1.0 - lag / (lags + 1.0)) * (gamma + gamma.T)
    robust = bread @ meat @ bread
    variance = np.maximum(np.diag(robust), 1e-300)
    grow = np.sqrt(np.maximum(np.diag(bread) / variance, 1.0))
    grow *= np.sqrt(used / max(used - unknowns, 1))
    return robust * np.outer(grow, grow) / np.outer(size, size)


def bandwidth(r):
    r"""Lags L of the covariance for residuals (s, c).

    L is :math:`1.1447\,(\alpha s)^{1/3}` with
    :math:`\alpha = 4\rho^2/(1 - \rho^2)^2` of the channel with the largest correlation :math:`\rho` from one
    sample to the next.
    """
    power = np.maximum(np.sum(r**2, axis=0), 1e-300)
    rho = np.clip(np.max(np.abs(np.sum(r[1:] * r[:-1], axis=0)) / power), 0.0, MAX_CORRELATION)
    alpha = 4.0 * rho**2 / (1.0 - rho**2) ** 2
    third = len(r) ** (1.0 / 3.0)
    return int(np.ceil(max(1.1447 * alpha ** (1.0 / 3.0), LAG_FACTOR) * third))
