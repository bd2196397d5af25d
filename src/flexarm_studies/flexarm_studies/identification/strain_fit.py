# SPDX-License-Identifier: Apache-2.0
r"""Fits an arm's parameters to strains alone, with the motion of its joints prescribed as measured.

With residuals :math:`e_k = \varepsilon_k - \hat\varepsilon_k(\theta)` of `prescribed`, the parameters minimise

.. math::
    \min_\theta \sum_k \bigl|L^{-1}(e_k - \rho\,e_{k-1})\bigr|^2, \qquad
    LL^T = \mathrm{Cov}(e_k - \rho\,e_{k-1}),

with a wide prior about the file's values. This is generalised least squares with an autoregression :math:`\rho` of
each gauge and a covariance between the gauges, both from the residuals (Ljung, System Identification, 1999, 7.4). The
residuals change slowly if the model lacks friction. They are the same in all gauges if the gauges share a source of
noise. Without the weights, the slow part would hide the vibration. Noise that a comparison of gauges removes would
count as noise of each gauge.

The sum has many minima. So the fit begins at several points; the first one is that of the arm file. At each point, a
linear regression gives gains and biases. Delays, offsets and drifts are held for the first steps. The fit continues
from the best point with all quantities. Intervals are those of `fit` (Newey and West). A combination of parameters
along which no strain changes is named, and one of these parameters keeps the file's value. A parameter whose interval
is too wide is named, too. It keeps its fitted value, because the values of the others depend on it.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from flexarm_dynamics.errors import FlexarmError

from ..recordings.motion import CORNER
from . import ring_damping
from .fit import NORMAL, robust_covariance
from .prescribed import MotionPredictor
from .quantities import held
from .strain_quantities import (
    OF_GAUGES,
    OF_RECORDING,
    Setup,
    changed,
    strain_quantities,
    value_of,
    with_offset,
)

#: Held unless the user frees them: strains can't distinguish them from others, or a ruler measures them.
HELD = ("links[*].mass_per_length", "gauges[*].position")
#: Difference step of the Jacobian, as a fraction of a quantity's scale [-].
STEP = 1e-7
#: Autoregression of the residuals before they are known [-], and their size, as a fraction of the signal [-].
FIRST_MEMORY, FIRST_NOISE = 0.9, 0.02
#: Longest correlation time of the residuals that the weights assume [s], even if the true one is longer. With an
#: autoregression of one, the level of a gauge would have no effect. An autoregression smaller than the true one acts
#: like any filter of the residuals: the values are still consistent, and the intervals allow for the remaining colour.
MAX_MEMORY_TIME = 0.5
#: Number of starts, and range of factors of stiffness and play from the second one on.
STARTS, RANGE = 6, (0.6, 1.7)
#: Kinds that a start varies, and kinds that are held during its first steps.
VARIED = ("EI", "transmission_stiffness", "transmission_play")
LATER = ("offset", "delay", "drift", "hub_inertia")
#: Each start is fitted to the first samples: this fraction of all, and at least this many seconds.
START_PART, START_SECONDS = 0.35, 10.0
#: Evaluations of a start, and of each pass with new weights; largest number of passes.
START_STEPS, PASS_STEPS, PASSES = 12, 20, 10
#: From the second pass on, secants replace derivatives for this number of evaluations, because one derivative by all
#: quantities costs as much as 25 evaluations. Far from the final values, secants are misleading.
BETWEEN = 3
#: Relative tolerance of the sum of squares in the first pass, whose weights are those of a poor fit.
FIRST_TOLERANCE = 1e-4
#: The passes end when a pass leaves at least the first fraction of the sum of squares, and the autoregression of its
#: residuals differs by at most the second number from the one in the weights [-].
SETTLED, SAME_MEMORY = 0.98, 0.01
#: Singular values of the Jacobian, with columns of unit length, below this count as zero [-].
SINGULAR = 1e-4
#: Deviation of the prior about the file's value, in scales [-]: values that strains hardly determine stay near it.
PRIOR = 1.0
#: A quantity belongs to a combination if its component of the singular vector has at least this size [-].
INVOLVED = 0.03
#: Smallest noise [-].
MIN_NOISE = 1e-9
#: Residual of a model that diverges, in deviations.
LOST = 1e4


@dataclass(frozen=True)
class Options:
    """How to fit.

    Attributes
    ----------
    hold, free : tuple of str
        Names, or patterns with ``*``, of quantities that keep the file's value, and of those of `HELD` that are fitted.
    limit : float
        A quantity is undetermined if its half-width exceeds this fraction of its value [-].
    starts : int
    corner : float
        Corner of the low pass of the joint angles [Hz].
    lead : int
        Samples at the beginning that are predicted, but not compared.
    ring_downs : bool
        Whether damping is finally fitted to the decay of ring-downs, see `ring_damping`.
    """

    hold: tuple = ()
    free: tuple = ()
    limit: float = 0.5
    starts: int = STARTS
    corner: float = CORNER
    lead: int = 0
    ring_downs: bool = False


@dataclass(frozen=True, eq=False)
class StrainFit:
    """Result of `identify_strains`.

    Attributes
    ----------
    arm : Arm
        With the fitted values, including the offsets of its joints.
    setup : Setup
        The same arm without the offsets, and how it was recorded.
    quantities : list of Quantity
    values, half_widths : ndarray, shape (p,)
        Values, and half-widths of the 95 % intervals, NaN where the file's value was kept [SI].
    covariance : ndarray, shape (p, p)
        Covariance of the values; zero where they are held.
    predicted, measured : ndarray, shape (s, g)
        Strains of the fit, and of the recording.
    noise, memory : ndarray, shape (g,)
        Rms of the part of the residuals that is new in each sample [-], and the residuals' autoregression [-].
    correlation : ndarray, shape (g, g)
        Correlation of that part between the gauges.
    held, undetermined : tuple of str
        Quantities kept on request or by default, and quantities that the strains do not determine. Of the latter, those
        with a half-width have fitted values.
    alike : tuple of tuple of str
        Combinations of quantities along which no strain changes. They include held quantities, unless the whole arm is
        held.
    starts : tuple of float
        Final sum of squares of each start; the fit continued from the smallest.
    warnings : tuple of str
    """

    arm: object
    setup: Setup
    quantities: list
    values: np.ndarray
    half_widths: np.ndarray
    covariance: np.ndarray
    predicted: np.ndarray
    measured: np.ndarray
    noise: np.ndarray
    memory: np.ndarray
    correlation: np.ndarray
    held: tuple = ()
    undetermined: tuple = ()
    alike: tuple = ()
    starts: tuple = ()
    warnings: tuple = ()


def identify_strains(arm, recording, options=None, run=None, state=None, report=None, threads=1):
    """Fit an arm's parameters to the strains of a recording, with its joint motion prescribed.

    Parameters
    ----------
    arm : Arm
    recording : Recording
        It should begin at rest, because the links start at rest.
    options : Options, optional
    run : callable, optional
        ``run(function, calls)`` yields (i, ``function(*calls[i])``), as `workers.results`; if not given, the calls run
        in this process, one by one.
    state : FitState, optional
        What the fit has found so far; an interrupted fit continues from there.
    report : callable, optional
        Called as ``report(label)`` at each step.
    threads : int
        Number of threads that compute derivatives; the results do not depend on it.

    Returns
    -------
    StrainFit

    Raises
    ------
    FlexarmError
        For a pattern that matches nothing, for an arm without gauges, for joints that do not move, and if no start can
        follow the motion.
    """
    options = options or Options()
    report = report or (lambda label: None)
    problem = StrainProblem(arm, recording, options, threads=threads)
    kept = {} if state is None else dict(state.starts)
    missing = [k for k in range(options.starts) if k not in kept]
    calls = [(arm, recording, options, k, threads if len(missing) == 1 else 1) for k in missing]
    run = run or (lambda f, c: ((i, f(*call)) for i, call in enumerate(c)))
    if missing:
        report(f"{len(missing)} starts")
    for i, (cost, values) in run(fit_start, calls):
        kept[missing[i]] = cost, list(values)
        report(f"start {missing[i] + 1} of {options.starts}: {cost:.6g}")
        if state is not None:
            state.keep_start(missing[i], cost, values)
    best = min(kept, key=lambda k: kept[k][0])
    if not kept[best][0] < 0.1 * LOST**2 * START_PART * problem.used:
        raise FlexarmError(
            "can't follow the motion from any start", field=arm.name,
            hint="correct masses and stiffnesses in the arm file",
        )  # fmt: skip
    problem.values = np.array(kept[best][1])
    if state is not None and state.best is not None:
        problem.take(state.best)
    problem.finish(report, state)
    if options.ring_downs:
        ring_damping.fit(problem, report)
        problem.weigh()
    return problem.result(tuple(kept[k][0] for k in sorted(kept)))


def fit_start(arm, recording, options, number, threads=1):
    """Fit from start `number`; return the sum of squares, which is comparable between starts, and values (p,)."""
    part = max(
        START_PART * (len(recording.position) - options.lead), START_SECONDS / recording.period
    )
    found = strain_quantities(arm, recording)
    problem = StrainProblem(arm, recording.part(options.lead + int(part)), options, found, threads)
    problem.begin(0)
    problem.weigh_each()  # in the same way for all starts, so their sums are comparable
    problem.begin(number)
    problem.solve(START_STEPS, 1e-3, LATER)
    return problem.cost, problem.values


class StrainProblem:
    """A fit in progress; see the module.

    Parameters
    ----------
    arm : Arm
    recording : Recording
    options : Options
    found : list of Quantity, optional
        The arm's quantities; if not given, those of `strain_quantities`.
    threads : int
        Number of threads that compute derivatives.
    """

    def __init__(self, arm, recording, options, found=None, threads=1):
        if not arm.gauges:
            raise FlexarmError("has no gauges", field=arm.name, hint="strains are fitted: add them")
        if not np.ptp(recording.position, axis=0).max() > 0.0:
            raise FlexarmError(
                "does not change", field="joint_position",
                hint="without torque, strains are fitted to the joints' motion: record one",
            )  # fmt: skip
        self.options, self.recording, self.threads = options, recording, threads
        self.predictor = MotionPredictor(arm, recording, options.corner)
        self.setup = Setup.of(arm)
        self.found = strain_quantities(arm, recording) if found is None else found
        self.scale = np.array([q.scale for q in self.found])
        self.low = np.array([q.low for q in self.found])
        self.file = np.array([value_of(self.setup, q) for q in self.found])
        self.values = self.file.copy()
        default = held(self.found, [p for p in HELD if _any(self.found, p)])
        names = (default - held(self.found, options.free)) | held(self.found, options.hold)
        self.held = tuple(q.name for q in self.found if q.name in names)
        self.free = np.array([q.name not in names for q in self.found], bool)
        self.measured = recording.strain
        self.known = np.isfinite(self.measured)
        self.known[: options.lead] = False
        self.used = int(self.known.sum())
        self.left_out, self.alike, self.warnings = [], (), list(recording.notes)
        g = self.measured.shape[1]
        spread = np.array([column[k].std() if k.any() else 1.0 for column, k in self._columns()])
        self.memory = np.full(g, FIRST_MEMORY)
        self.whiten = np.diag(1.0 / np.maximum(FIRST_NOISE * spread, MIN_NOISE))
        self.covariance_of_new = np.diag(np.maximum(FIRST_NOISE * spread, MIN_NOISE) ** 2)
        self.endless = np.zeros(g, bool)
        self.duration = max(float(recording.time[-1]), recording.period)
        self.cost = np.inf

    def _columns(self):
        return zip(self.measured.T, self.known.T, strict=True)

    # Residuals -------------------------------------------------------------------------------

    def at(self, values):
        """The `Setup` with these values of all quantities."""
        return changed(self.setup, self.found, values)

    def states(self, setup):
        """As `MotionPredictor.states`."""
        return self.predictor.states(setup.arm, setup.offset)

    def strains(self, setup, states):
        """As `MotionPredictor.strains`, from `states`."""
        drift = setup.drift / self.duration
        return self.predictor.strains(setup.arm, *states, setup.delay, drift)

    def new_part(self, e):
        """The part of residuals (s, g) that does not follow from the sample before; 0 where either is unknown."""
        out = np.empty_like(e)
        out[0] = e[0] * np.sqrt(1.0 - self.memory**2)
        out[1:] = e[1:] - self.memory * e[:-1]
        known = self.known.copy()
        known[1:] &= self.known[:-1] | (self.memory == 0.0)
        return np.where(known, out, 0.0)

    def weighted(self, e):
        """Residuals (s, g) with the weights of the sum of squares."""
        return self.new_part(np.where(self.known, e, 0.0)) @ self.whiten

    def made(self, values):
        """Strains of the model with these values, shape (s, g); NaN where it diverges."""
        setup = self.at(values)
        return self.strains(setup, self.states(setup))

    def residuals(self, values):
        """Weighted residuals, shape (s, g)."""
        return self.of_made(self.made(values))

    def of_made(self, made):
        """Weighted residuals of strains (s, g)."""
        r = self.weighted(self.measured - made)
        return np.clip(np.nan_to_num(r, nan=LOST), -LOST, LOST)

    def jacobian(self, values, which):
        """Derivative of `residuals` by the quantities with the indices `which`, scaled, shape (s, g, len(which))."""
        if not which.size:
            return np.zeros((*self.measured.shape, 0))
        return self.of_derivatives(self.derivatives(values, which))

    def of_derivatives(self, D):
        """Derivative of the weighted residuals, from that of the strains, both of shape (s, g, p)."""
        J = np.stack([self.weighted(-column) for column in np.moveaxis(D, 2, 0)], axis=2)
        return np.nan_to_num(J, nan=0.0, posinf=0.0, neginf=0.0)

    def derivatives(self, values, which):
        """Derivative of the strains by the quantities with the indices `which`, scaled, shape (s, g, len(which))."""
        setup = self.at(values)
        states = self.states(setup)
        base = self.strains(setup, states)
        out = np.zeros((*base.shape, len(which)))

        def fill(column):
            j, other = which[column], values.copy()
            other[j] += STEP * self.scale[j]
            moved = self.at(other)
            same = self.found[j].kind in OF_GAUGES
            made = self.strains(moved, states if same else self.states(moved))
            out[:, :, column] = (made - base) / STEP

        # The compiled integrators release the interpreter's lock.
        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(fill, range(len(which))))
        return out

    # The fit ---------------------------------------------------------------------------------

    def begin(self, number):
        """Take the values of a start: the file's, or values drawn for its `number`; gains and biases by regression."""
        self.values = self.file.copy()
        if number:
            random = np.random.default_rng(number)
            for j, q in enumerate(self.found):
                if q.kind in VARIED and self.free[j]:
                    self.values[j] *= np.exp(random.uniform(*np.log(RANGE)))
        self.regress()

    def regress(self):
        """Set the free gains and biases to those of a linear regression on the predicted strains."""
        setup, predicted = self.at(self.values), self.made(self.values)
        place = {(q.kind, *q.where): j for j, q in enumerate(self.found)}
        for c, gauge in enumerate(setup.arm.gauges):
            known, gain, bias = self.known[:, c], place.get(("gain", c)), place.get(("bias", c))
            if gain is None or not np.isfinite(predicted[known, c]).all() or not known.any():
                continue
            read = predicted[known, c] - gauge.bias
            X = np.column_stack([read * self.free[gain], np.full(read.size, self.free[bias])])
            target = self.measured[known, c]
            if not self.free[gain]:
                target = target - read
            factor, level = np.linalg.lstsq(X, target, rcond=None)[0]
            if self.free[gain] and factor > 0.0:
                self.values[gain] *= factor
            if self.free[bias]:
                self.values[bias] = level

    def solve(self, steps, tolerance, later=(), keep=None, between=0):
        """Least squares from the current values, in at most `steps` steps, to a relative `tolerance` of the sum.

        Quantities of the kinds `later` are held; ``keep()`` is called after each step; derivatives are computed anew
        after `between` evaluations.
        """
        self.predictor.adapt(self.at(self.values).arm)
        which = np.array(
            [j for j in np.flatnonzero(self.free) if self.found[j].kind not in later], int
        )
        if not which.size:
            self.cost = float(np.sum(self.residuals(self.values) ** 2))
            return
        low = self.low[which] / self.scale[which]
        start = np.maximum(self.values[which] / self.scale[which], low + 1e-6)

        def full(x):
            values = self.values.copy()
            values[which] = x * self.scale[which]
            return values

        middle = self.file[which] / self.scale[which]
        derivatives = lambda x: self.derivatives(full(x), which)  # noqa: E731
        secant = Secant(lambda x: self.made(full(x)), derivatives, between)

        def residuals(x):
            r = self.of_made(secant.value(x)).ravel()
            r = np.concatenate([r, (x - middle) / PRIOR])
            self.best = min(self.best, (float(r @ r), full(x)), key=_of)
            return r

        def jacobian(x):
            if keep is not None:  # once a step
                keep(*self.best)
            J = self.of_derivatives(secant.derivative(x)).reshape(-1, which.size)
            return np.vstack([J, np.eye(which.size) / PRIOR])

        self.best = (np.inf, None)
        while steps > 0:
            before = self.best[0]
            secant.forget()
            done = least_squares(
                residuals, start, jacobian, (low, np.full(start.size, np.inf)), x_scale="jac",
                max_nfev=steps, ftol=tolerance, xtol=1e-8, gtol=1e-12,
            )  # fmt: skip
            steps -= done.nfev
            start = self.best[1][which] / self.scale[which]
            if secant.fresh or not self.best[0] < (1.0 - tolerance) * before:
                break  # the secants are not the reason
        self.cost, self.values = self.best

    def left(self):
        """Residuals (s, g), 0 where nothing was measured; None while the model does not follow the motion."""
        self.predictor.adapt(self.at(self.values).arm)
        e = np.where(self.known, self.measured - self.made(self.values), 0.0)
        return e if np.isfinite(e).all() else None

    def weigh_each(self):
        """Weigh each gauge by its own residual: after a poor fit, what gauges share is vibration, not noise."""
        e = self.left()
        if e is not None:
            new = self.new_part(e)
            count = np.maximum((new != 0.0).sum(axis=0), 1)
            size = np.sqrt(np.sum(new**2, axis=0) / count)
            self.whiten = np.diag(1.0 / np.maximum(size, MIN_NOISE))

    def weigh(self):
        """Compute memory and covariance of the residuals, and the weights that follow from them."""
        e = self.left()
        if e is None:
            return
        both = self.known[1:] & self.known[:-1]
        power = np.maximum(np.sum(np.where(both, e[:-1] ** 2, 0.0), axis=0), 1e-300)
        product = np.sum(np.where(both, e[1:] * e[:-1], 0.0), axis=0)
        longest = np.exp(-self.recording.period / MAX_MEMORY_TIME)
        self.memory = np.clip(product / power, 0.0, longest)
        self.endless = self.memory == longest
        new = self.new_part(e)
        count = np.maximum((new != 0.0).sum(axis=0), 1)
        covariance = new.T @ new / np.sqrt(np.outer(count, count))
        covariance += np.diag(np.full(len(covariance), MIN_NOISE**2))
        self.covariance_of_new = covariance
        self.whiten = np.linalg.inv(np.linalg.cholesky(covariance)).T

    def finish(self, report, state):
        """Fit from the values of the best start: passes with new weights; parameters of equal effect are left out."""
        stage = 0 if state is None or state.best is None else state.best["stage"]
        self.weigh()
        settled = stage >= PASSES
        for number in range(stage, PASSES):
            memory = self.memory
            self.solve(
                PASS_STEPS, 1e-6 if number else FIRST_TOLERANCE, keep=self._keeper(state, number),
                between=BETWEEN if number else 0,
            )  # fmt: skip
            report(f"pass {number + 1} of {PASSES}: {self.cost:.6g}")
            if number == 0:
                self.leave_out_alike()
            self.weigh()
            if state is not None:
                state.keep_best(self.snapshot(number + 1))
            same = np.abs(self.memory - memory).max() < SAME_MEMORY
            settled = number > 0 and same and self.cost > SETTLED * self.used
            if settled:
                break
        if not settled:
            self.warnings.append(
                f"the fit has not settled after {PASSES} passes: its intervals may be too narrow; fit from other"
                " values (--starts), or hold what you know"
            )

    def _keeper(self, state, number):
        if state is None:
            return None

        def keep(cost, values):
            if values is not None:
                state.keep_best(self.snapshot(number) | {"values": list(values)})

        return keep

    def snapshot(self, stage):
        """Plain data from which the fit can continue."""
        return {
            "stage": stage,
            "values": [float(v) for v in self.values],
            "left_out": [(int(i), why) for i, why in self.left_out],
        }

    def take(self, snapshot):
        """Continue from a `snapshot`."""
        self.values = np.array(snapshot["values"], float)
        for index, why in snapshot["left_out"]:
            self.leave_out(index, why)

    # What is determined ----------------------------------------------------------------------

    def covariance(self):
        """Covariance of the free quantities, scaled."""
        which = np.flatnonzero(self.free)
        J, r = self.jacobian(self.values, which), self.residuals(self.values)
        return robust_covariance(J, r, self.used)

    def leave_out_alike(self):
        """Name combinations along which no strain changes; one free quantity in each keeps the file's value."""
        looked_at = self._looked_at()
        J = np.zeros((self.measured.size, len(self.found)))
        J[:, looked_at] = self.jacobian(self.values, looked_at).reshape(-1, looked_at.size)
        size = np.linalg.norm(J, axis=0)
        self.alike = tuple(
            tuple(self.found[j].name for j in involved)
            for involved in _null(J[:, looked_at], size[looked_at], looked_at)
        )  # fmt: skip
        while self.free.any():
            which = np.flatnonzero(self.free)
            combinations = _null(J[:, which], size[which], which)
            if not combinations:
                return
            least = min(combinations[0], key=lambda j: size[j])
            names = ", ".join(self.found[j].name for j in combinations[0])
            alone = len(combinations[0]) == 1
            self.leave_out(least, "it changes no strain" if alone else f"{names} act alike")

    def _looked_at(self):
        """Indices of the quantities whose combinations are named: all, or the free ones if the whole arm is held."""
        held_by_user = held(self.found, self.options.hold)
        parts = ("joints[", "links[", "payload.")
        whole = all(q.name in held_by_user for q in self.found if q.name.startswith(parts))
        return np.flatnonzero(self.free) if whole else np.arange(len(self.found))

    def leave_out(self, index, why):
        """Keep the file's value of a quantity; `why` is the reason in words."""
        self.left_out.append((index, why))
        self.free[index], self.values[index] = False, self.file[index]
        q = self.found[index]
        self.warnings.append(
            f"{q.name} is not determined by these strains and keeps the file's {self.file[index]:.6g} {q.unit}: {why};"
            " the others' intervals hold for that value"
        )

    def result(self, starts):
        """The result of the fit, whose `starts` ended with these sums of squares."""
        p, which = len(self.found), np.flatnonzero(self.free)
        covariance, widths = np.zeros((p, p)), np.full(p, np.nan)
        if which.size:
            block = self.covariance() * np.outer(self.scale[which], self.scale[which])
            covariance[np.ix_(which, which)] = block
            widths[which] = NORMAL * np.sqrt(np.diag(block))
        wide = self._wide(widths)
        self.warn_of_endless()
        setup = self.at(self.values)
        noise = np.sqrt(np.diag(self.covariance_of_new))
        return StrainFit(
            with_offset(setup.arm, setup.offset), setup, self.found, self.values, widths, covariance,
            self.made(self.values), self.measured, noise, self.memory,
            self.covariance_of_new / np.outer(noise, noise), self.held,
            tuple(self.found[i].name for i, _ in self.left_out) + wide, self.alike, starts,
            tuple(self.warnings),
        )  # fmt: skip

    def warn_of_endless(self):
        """Warn of gauges whose residuals are correlated for longer than `MAX_MEMORY_TIME`."""
        names = [
            n for n, slow in zip(self.setup.arm.gauge_names, self.endless, strict=True) if slow
        ]
        if names:
            self.warnings.append(
                f"what the model leaves of {', '.join(names)} changes slower than in {MAX_MEMORY_TIME:g} s: something"
                " slow is missing in the model, or a gauge drifts by more than a line; its level hardly counts"
            )

    def _wide(self, widths):
        """Names of quantities whose interval is wider than the limit, with a warning for each."""
        ratio = widths / np.maximum(np.abs(self.values), self.scale)
        wide = np.flatnonzero(np.nan_to_num(ratio) > self.options.limit)
        for j in wide:
            q = self.found[j]
            self.warnings.append(
                f"{q.name} is not determined by these strains: {self.values[j]:.4g} +- {widths[j]:.2g} {q.unit};"
                " hold it (--hold) where you know it"
            )
        return tuple(self.found[j].name for j in wide)


class Secant:
    r"""Values and derivatives of a function with expensive derivatives: Broyden's secants replace most of them.

    .. math:: D \leftarrow D + (y_1 - y_0 - D\,\Delta x)\,\Delta x^T / |\Delta x|^2

    Parameters
    ----------
    function, derivatives : callable
        ``function(x)`` of shape (s, g), ``derivatives(x)`` (s, g, p), for x (p,).
    between : int
        Number of new values after which derivatives are computed anew.
    """

    def __init__(self, function, derivatives, between):
        self._function, self._derivatives, self._between = function, derivatives, between
        self._last = self._at = None
        self._count = 0

    @property
    def fresh(self):
        """Whether the last derivatives are not secants."""
        return self._count == 0

    def forget(self):
        """Compute the next derivatives anew."""
        self._at = None

    def value(self, x):
        """The function at x; the value at the last x is kept."""
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = x.copy(), self._function(x)
            self._count += 1
        return self._last[1]

    def derivative(self, x):
        """Derivatives at x."""
        y = self.value(x)
        usable = self._at is not None and self._count <= self._between
        if not (usable and np.isfinite(y).all() and np.isfinite(self._at[1]).all()):
            D, self._count = self._derivatives(x), 0
        else:
            x0, y0, D = self._at
            step = x - x0
            D = D + (y - y0 - D @ step)[:, :, None] * (step / (step @ step))
        self._at = x.copy(), y, D
        return D


def _of(pair):
    return pair[0]


def _any(found, pattern):
    try:
        held(found, [pattern])
    except FlexarmError:
        return False
    return True


def _null(J, size, indices):
    """Combinations of columns of J, lists of `indices`, whose effect cancels; `size` (p,) is the columns' length."""
    silent = size <= 1e-9 * max(size.max(initial=0.0), 1e-300)
    if silent.any() or not size.size:
        return [[int(j)] for j in indices[silent]]
    _, values, directions = np.linalg.svd(J / size, full_matrices=False)
    null = directions[values < SINGULAR * values[0]]
    return [[int(indices[k]) for k in np.flatnonzero(np.abs(row) > INVOLVED)] for row in null]


def predict(found, recording, options, middle=None):
    """Strains (s, g) that a `StrainFit` predicts for another recording, or for a longer part of the same.

    Parameters
    ----------
    found : StrainFit
    recording : Recording
    options : Options
        Those of the fit.
    middle : float, optional
        Time in this recording at which the drift is zero [s]; None: the readings do not drift.
    """
    setup = found.setup
    predictor = MotionPredictor(setup.arm, recording, options.corner)
    predictor.middle = 0.0 if middle is None else middle
    duration = max((len(found.measured) - 1) * recording.period, recording.period)
    drift = None if middle is None else setup.drift / duration
    states = predictor.states(setup.arm, setup.offset)
    return predictor.strains(setup.arm, *states, setup.delay, drift)


def of_recording(found):
    """What a `StrainFit` found about the recording, not about the arm: name to value."""
    pairs = zip(found.quantities, found.values, strict=True)
    return {q.name: float(v) for q, v in pairs if q.kind in OF_RECORDING}


def with_noise(found):
    """The fitted arm with the noise of its gauges, that is, the new part of each residual."""
    gauges = (
        replace(g, noise=float(s)) for g, s in zip(found.arm.gauges, found.noise, strict=True)
    )
    return replace(found.arm, gauges=tuple(gauges))
