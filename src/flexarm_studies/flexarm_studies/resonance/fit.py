# SPDX-License-Identifier: Apache-2.0
r"""Fits frequencies and damping of modes in several channels by least squares, with intervals for coloured noise.

.. math:: y_c(t) = \sum_k \mathrm{Re}\{a_{kc} e^{p_k t} + b_{kc}\,(e^{p_k\cdot} * u)(t)\} + d_c u(t) + g_c + h_c t,
    \qquad p_k = -\sigma_k + j\omega_k

where the input u is the motion of a sweep; without an input it is free ringing. The coefficients a, b, d, g, h are
linear; the fit solves for them at every p (variable projection, Golub & Pereyra 1973). It starts from the poles of
`pencil`. A mode is left out if this improves the Bayesian information criterion.

The errors of :math:`\omega,\sigma` are :math:`(J'J)^{-1}J'SJ(J'J)^{-1}` with the Jacobian J and the covariance S of the
residuals. The J of a mode is narrow in frequency, so only S near the mode matters. S is the spectral density of the
residuals of all channels together, smoothed over some neighbouring spectral lines.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from . import pencil

TURN = 2.0 * np.pi
#: Largest and smallest damping ratio of a ringing mode [-].
MAX_DAMPING, MIN_DAMPING = 0.3, 1e-5
#: A mode is dropped if the half-width of its frequency's interval, over the frequency, is larger than this [-].
MAX_WIDTH = 0.1
#: A mode is left out if its rms is below this fraction of the largest in every channel [-].
MIN_PART = 0.02
#: ... and below this many times the rms that noise of the same density would cause in its place in every channel [-].
OVER_NOISE = 20.0
#: Poles of a sweep whose distance, over their size, is less than this are one mode [-].
SWEPT_TWIN = 0.08
#: Max. number of modes, and number of spectral lines on either side over which the residuals' spectrum is smoothed.
MAX_MODES, SMOOTHED = 6, 4
#: Samples per period of the highest frequency; if there are more, they are averaged.
PER_PERIOD = 4.0
#: Default of the highest frequency [Hz]; min. number of periods in a window.
HIGHEST, MIN_PERIODS = 30.0, 1.5
MIN_SAMPLES = 16
NORMAL = 1.959964


@dataclass(frozen=True, eq=False)
class Mode:
    """A mode that rings.

    Attributes
    ----------
    frequency, frequency_width : float
        Natural (undamped) frequency, and half of its 95 % interval [Hz].
    damping, damping_width : float
        Ratio, and half of its 95 % interval [-].
    amplitude : ndarray, shape (c,)
        Amplitude of its free ringing in each channel, at the first sample, in the channel's unit.
    """

    frequency: float
    frequency_width: float
    damping: float
    damping_width: float
    amplitude: np.ndarray

    @property
    def pole(self):
        r""":math:`-\sigma + j\omega` [1/s]."""
        size = TURN * self.frequency
        return complex(-self.damping * size, size * np.sqrt(1.0 - self.damping**2))


@dataclass(frozen=True, eq=False)
class Fit:
    """The modes of a window.

    Attributes
    ----------
    modes : tuple of Mode
        Ascending.
    explained : ndarray, shape (c,)
        Fraction of each channel's variance about a straight line that the fit explains [-].
    time : ndarray, shape (s,)
        Times of the samples of the fit, from the window's first sample [s].
    measured, fitted : ndarray, shape (s, c)
        In the channels' units.
    """

    modes: tuple
    explained: np.ndarray
    time: np.ndarray
    measured: np.ndarray
    fitted: np.ndarray


def fit(values, period, low=0.0, high=HIGHEST, motion=None, direct=None) -> Fit:
    """Find the modes of a window.

    Parameters
    ----------
    values : ndarray, shape (s, c)
        Finite.
    period : float
        [s]
    low, high : float
        Frequencies [Hz].
    motion : ndarray, shape (s, m), optional
        Input that moves the arm, for example accelerations of the joints; None: nothing moves it.
    direct : ndarray, shape (s, d), optional
        Signals of the motion that the channels contain directly, for example its speed and its position.

    Returns
    -------
    Fit
        Without modes if nothing rings, or if the window is too short.
    """
    block = max(int(1.0 / (PER_PERIOD * high * period)), 1)
    values, period = averaged(values, block), block * period
    motion = None if motion is None else averaged(motion, block)
    direct = None if direct is None else averaged(direct, block)
    count, time = len(values), period * np.arange(len(values))
    low, high = max(low, MIN_PERIODS / (period * max(count, 1))), min(high, 0.45 / period)
    about = _about_line(values)
    size = about.std(axis=0) if count else np.zeros(values.shape[1])
    live = size > 1e-9 * np.abs(values).max(axis=0, initial=1e-30)
    if count < MIN_SAMPLES or high <= low or not live.any():
        return Fit((), np.zeros(len(size)), time, values, values - about)
    problem = _Problem(values[:, live] / size[live], period, motion, direct)
    start = pencil.stable_poles(problem.ringing(), period, low, high, MAX_DAMPING)[:MAX_MODES]
    solution = _select(problem, start, low, high)
    fitted, explained = values - about, np.zeros(len(size))
    fitted[:, live] = values[:, live] - size[live] * solution.residual
    explained[live] = 1.0 - solution.residual.var(axis=0)
    modes = sorted(_modes(problem, solution, size, live, block), key=lambda m: m.frequency)
    return Fit(tuple(modes), explained, time, values, fitted)


def averaged(values, block):
    """Means of `block` rows of `values` (s, c) each: a sine stays a sine, without a filter's edge effects."""
    rows = len(values) // block
    return values[: rows * block].reshape(rows, block, values.shape[1]).mean(axis=1)


def _about_line(values):
    line = np.column_stack([np.ones(len(values)), np.linspace(-1.0, 1.0, len(values))])
    return values - line @ np.linalg.lstsq(line, values, rcond=None)[0]


class _Problem:
    """The linear part of the fit at given poles."""

    def __init__(self, values, period, motion, direct):
        self.values, self.period, self.motion = values, period, motion
        self.time = period * np.arange(len(values))
        self.weight = np.ones(values.shape[1])
        line = [np.ones(len(values)), np.linspace(-1.0, 1.0, len(values))]
        self.fixed = np.column_stack(
            [*line, *(part for part in (motion, direct) if part is not None)]
        )

    @property
    def per_mode(self):
        """Number of parameters of a mode."""
        inputs = 0 if self.motion is None else self.motion.shape[1]
        return 2 + 2 * self.values.shape[1] * (1 + inputs)

    def ringing(self):
        """The signals that should be free ringing, for the start, shape (s, c)."""
        if self.motion is None:
            return _about_line(self.values)
        return impulse_responses(self.values, self.motion)

    def basis(self, poles):
        """Columns of the linear part, shape (s, 2 + m + k)."""
        columns = [self.fixed]
        for pole in poles:
            parts = [
                np.exp(np.clip(pole.real, -50.0, 50.0) * self.time + 1j * pole.imag * self.time)
            ]
            if self.motion is not None:
                parts += list(_through(pole, self.motion, self.period).T)
            columns += [f(part)[:, None] for part in parts for f in (np.real, np.imag)]
        return np.hstack(columns)

    def residual(self, poles):
        """What the linear part does not explain (s, c), weighted; and the coefficients of that part."""
        B, target = self.basis(poles), self.values * self.weight
        coefficients = np.linalg.lstsq(B, target, rcond=1e-10)[0]
        return target - B @ coefficients, coefficients / self.weight


@dataclass
class _Solution:
    poles: np.ndarray
    residual: np.ndarray  # without weights
    coefficients: np.ndarray
    jacobian: np.ndarray | None = None  # weighted, (s, c, 2 k)


def _solve(problem, poles):
    """Least squares from these poles, with the channels weighted by their residuals."""
    x = np.array([[p.imag, -p.real] for p in poles]).ravel()
    omega = np.repeat([p.imag for p in poles], 2)
    scale, bounds = omega * np.tile([0.05, 0.02], len(poles)), None
    if len(poles):  # outside of these, a fit goes to another mode, or to none
        low, high = (omega * np.tile(by, len(poles)) for by in ([0.7, -0.1], [1.4, 1.0]))
        bounds = low, high
        x = np.clip(x, low + 1e-6 * omega, high - 1e-6 * omega)
    jacobian = None
    for _ in range(2 if len(poles) else 0):
        rest = problem.residual(_poles(x))[0] / problem.weight
        level = rest.std(axis=0)
        problem.weight = 1.0 / np.maximum(level, 1e-9 + 1e-3 * level.max())
        made = least_squares(
            lambda x: problem.residual(_poles(x))[0].ravel(),
            x,
            x_scale=scale,
            bounds=bounds,
            max_nfev=30,
        )
        x = made.x
        jacobian = made.jac.reshape(*problem.values.shape, -1)
    poles = _poles(x)
    rest, coefficients = problem.residual(poles)
    return _Solution(poles, rest / problem.weight, coefficients, jacobian)


def _poles(x):
    return -x[1::2] + 1j * x[::2]


def _criterion(problem, solution):
    """The information criterion of a solution: the smaller, the better."""
    level = np.maximum(solution.residual.var(axis=0), 1e-24)
    count = len(problem.values)
    return count * np.log(level).sum() + problem.per_mode * len(solution.poles) * np.log(count)


def _select(problem, start, low, high):
    """Fit all possible modes, then leave out one after the other while this improves the criterion."""
    solution = _solve(problem, start)
    while len(solution.poles):
        odd = _odd(problem, solution, low, high)
        if odd is None:
            without = [
                _fixed(problem, np.delete(solution.poles, k)) for k in range(len(solution.poles))
            ]
            least = int(np.argmin([_criterion(problem, w) for w in without]))
            if _criterion(problem, without[least]) > _criterion(problem, solution):
                return solution
            odd = least
        solution = _solve(problem, list(np.delete(solution.poles, odd)))
    return solution


def _fixed(problem, poles):
    rest, coefficients = problem.residual(poles)
    return _Solution(poles, rest / problem.weight, coefficients)


def _odd(problem, solution, low, high):
    """Index of a pole that is not that of a ringing mode; None if all are."""
    poles = solution.poles
    ratio, hertz = -poles.real / np.abs(poles), poles.imag / TURN
    bad = (ratio < MIN_DAMPING) | (ratio > MAX_DAMPING) | (hertz < low) | (hertz > high)
    widths = _widths(problem, solution)
    for k, most in enumerate((MAX_WIDTH, MAX_DAMPING)):
        bad |= ~(np.abs(widths[:, k, k]) < (most * poles.imag / NORMAL) ** 2)
    if bad.any():
        # The most damped one first. Two bad poles that cancel each other have large parts, so modes look small.
        return int(np.argmax(np.where(bad, ratio, -1.0)))
    power = _power(problem, solution)
    bad = (power < MIN_PART**2 * power.max(axis=0)).all(axis=1)
    density = np.abs(np.einsum("faa->fa", _density(problem, solution)))
    at = np.minimum(np.rint(2.0 * len(problem.values) * problem.period * hertz), len(density) - 1)
    # White noise contributes this much to the two columns of a mode.
    noise = 2.0 * density[np.maximum(at, 0).astype(int)] / problem.weight**2
    bad |= (power < OVER_NOISE * noise).all(axis=1)
    if bad.any():
        return int(np.argmax(bad))
    close = np.abs(np.subtract.outer(poles, poles)) + np.diag(np.full(len(poles), np.inf))
    # A delay or a drive that is not in the model causes a twin of a swept mode, with more damping.
    same = 0.5 * pencil.SAME if problem.motion is None else SWEPT_TWIN
    twin = (close < same * np.abs(poles)[:, None]).any(axis=1)
    return int(np.argmax(np.where(twin, ratio, -1.0))) if twin.any() else None


def _power(problem, solution):
    """Sum of squares of each mode's part of each channel, shape (k, c)."""
    B, first = problem.basis(solution.poles), problem.fixed.shape[1]
    each = (B.shape[1] - first) // len(solution.poles)
    parts = [slice(first + each * k, first + each * (k + 1)) for k in range(len(solution.poles))]
    return np.array([((B[:, s] @ solution.coefficients[s]) ** 2).sum(axis=0) for s in parts])


def _density(problem, solution):
    """Spectral density of the weighted residuals, smoothed over some lines: variance per sample, shape (f, c, c)."""
    rest = solution.residual * problem.weight
    count, channels = rest.shape
    spectrum = np.fft.rfft(rest, 2 * count, axis=0)
    density = np.einsum("fa,fb->fab", spectrum, spectrum.conj()).reshape(len(spectrum), -1)
    # Twice the lines, because the series is padded; each mode takes two degrees of freedom near it.
    lines = 2 * SMOOTHED + 1
    kernel = np.ones(2 * lines - 1) / (2 * lines - 1)
    smooth = np.apply_along_axis(lambda v: np.convolve(v, kernel, "same"), 0, density)
    return smooth.reshape(-1, channels, channels) / count * lines / (lines - 2)


def _widths(problem, solution):
    """Covariance of (omega, sigma) of each mode, shape (k, 2, 2)."""
    J = solution.jacobian
    count, _, k = J.shape
    flat = J.reshape(-1, k)
    inverse = np.linalg.pinv(flat.T @ flat)
    moved = np.fft.rfft(J, 2 * count, axis=0)
    twice = np.full(len(moved), 2.0)
    twice[0] = twice[-1] = 1.0
    density = _density(problem, solution)
    middle = np.einsum("f,fai,fab,fbj->ij", twice, moved.conj(), density, moved, optimize=True)
    whole = inverse @ (middle.real / (2 * count)) @ inverse
    return np.array([whole[i : i + 2, i : i + 2] for i in range(0, k, 2)])


def _modes(problem, solution, size, live, block):
    """The modes of a solution; `size` (c,) and `block` undo scaling and averaging, `live` (c,) chooses channels."""
    if not len(solution.poles):
        return
    widths = _widths(problem, solution)
    first = problem.fixed.shape[1]
    each = (solution.coefficients.shape[0] - first) // len(solution.poles)
    for k, pole in enumerate(solution.poles):
        own = solution.coefficients[first + each * k : first + each * k + 2]
        # The mean over a block of samples is smaller than the first sample of the block.
        steps = np.exp(pole * problem.period / block * np.arange(block)).mean()
        amplitude = np.zeros(len(size))
        amplitude[live] = size[live] * np.hypot(*own) / abs(steps)
        omega, sigma, length = pole.imag, -pole.real, abs(pole)
        by = np.array([[omega, sigma], [-omega * sigma / length, omega**2 / length]]) / length
        width = NORMAL * np.sqrt(np.abs(np.diag(by @ widths[k] @ by.T)))
        # `by` has the derivatives of |p|, and of sigma / |p| times |p|.
        yield Mode(
            length / TURN,
            float(width[0]) / TURN,
            sigma / length,
            float(width[1]) / length,
            amplitude,
        )


def _through(pole, motion, period):
    """The motion (s, m), linear between samples, filtered by 1 / (s - pole), shape (s, m), complex."""
    z = pole * period
    grown = np.exp(z)
    # First-order hold: exact for straight lines between the samples.
    new, old = (grown - 1.0 - z) / z**2, (grown * (z - 1.0) + 1.0) / z**2
    return period * lfilter([new, old], [1.0, -grown], motion.astype(complex), axis=0)


def impulse_responses(values, motion, floor=1e-3):
    """Impulse responses of the channels to each column of a motion, by spectral division.

    Parameters
    ----------
    values : ndarray, shape (s, c)
    motion : ndarray, shape (s, m)
        At rest at both ends.
    floor : float
        Floor of the motion's power, relative to the largest power; where the power is lower, the response fades [-].

    Returns
    -------
    ndarray, shape (s // 2, c * m)
    """
    count = len(values)
    size = 2 * count
    out = np.fft.rfft(_about_line(values), size, axis=0)
    found = []
    for column in motion.T:
        moved = np.fft.rfft(column, size)
        power = np.abs(moved) ** 2
        response = out * (moved.conj() / (power + floor * power.max()))[:, None]
        found.append(np.fft.irfft(response, size, axis=0)[: count // 2])
    found = np.hstack(found)
    return found / np.maximum(found.std(axis=0), 1e-300)
