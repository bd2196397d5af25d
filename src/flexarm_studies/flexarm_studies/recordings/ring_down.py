# SPDX-License-Identifier: Apache-2.0
r"""Fits free vibration while the joints stand: frequency and damping of a gauge's reading.

.. math::
    \varepsilon(t) = e^{-\sigma t}(a\cos\omega t + b\sin\omega t) + c + dt,
    \qquad \zeta = \sigma/\sqrt{\sigma^2 + \omega^2}

is fitted by least squares; a, b, c, d are linear and solved for at every :math:`(\omega, \sigma)`. Intervals take into
account that residuals are correlated from sample to sample, :math:`e_k = \rho e_{k-1} + u_k`: with V their covariance
and J the derivatives by all six numbers, the covariance of the numbers is :math:`(J^TJ)^{-1}J^TVJ(J^TJ)^{-1}`. Six
numbers are fitted, so the residuals of few samples look whiter than the errors. :math:`\rho` is therefore found by the
restricted likelihood (Patterson and Thompson, Biometrika 58, 1971), which corrects for this.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import lfilter

#: Conditions of a ring-down: explained fraction of the variance, amplitude over noise, damping ratio, periods.
EXPLAINED, OVER_NOISE, MAX_DAMPING, MIN_PERIODS = 0.9, 5.0, 0.3, 1.5
#: Start of the fit: damping rate over frequency [-].
START = 0.01
NORMAL = 1.959964
#: Largest autoregression of the residuals.
MAX_MEMORY = 0.99


@dataclass(frozen=True)
class RingDown:
    """One ring-down.

    Attributes
    ----------
    part : slice
        The samples.
    gauge : int
        Index of the gauge with the largest amplitude over its noise.
    frequency, frequency_width : float
        Damped frequency, and half of its 95 % interval [Hz].
    damping, damping_width : float
        Damping ratio, and half of its 95 % interval [-].
    amplitude : float
        At the beginning [-].
    explained : float
        Explained fraction of the variance, without the straight line [-].
    """

    part: slice
    gauge: int
    frequency: float
    frequency_width: float
    damping: float
    damping_width: float
    amplitude: float
    explained: float


def find(recording, parts, noise):
    """The ring-downs of a recording.

    Parameters
    ----------
    recording : Recording
    parts : sequence of slice
        Samples at which the joints stand.
    noise : ndarray, shape (g,)
        Rms of each gauge at rest [-].

    Returns
    -------
    list of RingDown
    """
    found = []
    for part in parts:
        best, ratio = None, OVER_NOISE
        for gauge, rms in enumerate(noise):
            values = recording.strain[part, gauge]
            if not np.isfinite(values).all() or not rms > 0.0 or values.std() < rms:
                continue
            made = fit(values, recording.period, part, gauge)
            if _is_one(made, recording.period) and made.amplitude > ratio * rms:
                best, ratio = made, made.amplitude / rms
        if best is not None:
            found.append(best)
    return found


def _is_one(made, period):
    length = period * (made.part.stop - made.part.start)
    rings = 0.0 < made.damping < MAX_DAMPING and made.damping_width < MAX_DAMPING
    return rings and made.explained > EXPLAINED and made.frequency * length > MIN_PERIODS


def fit(values, period, part=None, gauge=0):
    """The `RingDown` closest to `values` (s,), one per `period` [s]; `part` and `gauge` are those of the values."""
    count, size_of = len(values), max(float(np.std(values)), 1e-300)
    values = (values - np.mean(values)) / size_of
    time = period * np.arange(count)
    line = np.column_stack([np.ones(count), time])
    straight = values - line @ np.linalg.lstsq(line, values, rcond=None)[0]
    begin = 2.0 * np.pi * _strongest(straight, period)

    def basis(x):
        decay = np.exp(np.clip(-x[1] * time, -50.0, 50.0))
        return np.column_stack([decay * np.cos(x[0] * time), decay * np.sin(x[0] * time), line])

    def residual(x):
        B = basis(x)
        return values - B @ np.linalg.lstsq(B, values, rcond=None)[0]

    scale = np.array([0.05, 0.02]) * begin
    made = least_squares(residual, [begin, START * begin], x_scale=scale, max_nfev=100)
    omega, sigma = abs(made.x[0]), made.x[1]
    linear = np.linalg.lstsq(basis(made.x), values, rcond=None)[0]
    left = float(np.mean(made.fun**2))
    width = NORMAL * np.sqrt(np.diag(covariance(np.hstack([made.jac, basis(made.x)]), made.fun)))
    total = float(np.var(values - line @ linear[2:]))
    size = np.hypot(omega, sigma)
    numbers = (
        omega / (2.0 * np.pi),
        width[0] / (2.0 * np.pi),
        sigma / size,
        width[1] * omega**2 / size**3,
        size_of * np.hypot(*linear[:2]),
        1.0 - left / max(total, 1e-300),
    )
    return RingDown(part, gauge, *map(float, numbers))


def covariance(J, error):
    """Covariance (p, p) of a fit with derivatives J (s, p), whose residuals (s,) are correlated in time."""
    count, unknowns = J.shape
    J, size = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300), np.linalg.norm(J, axis=0)
    if count <= unknowns or not np.any(error):
        return np.zeros((unknowns, unknowns))

    def new(values, memory):  # the part that does not follow from the sample before
        out = values.copy()
        out[0] *= np.sqrt(1.0 - memory**2)
        out[1:] -= memory * values[:-1]
        return out

    def left(memory):
        X, e = new(J, memory), new(error, memory)
        return X, np.sum((e - X @ np.linalg.lstsq(X, e, rcond=None)[0]) ** 2)

    def likelihood(memory):
        X, squares = left(memory)
        informed = np.linalg.slogdet(X.T @ X)[1]
        return informed - np.log(1.0 - memory**2) + (count - unknowns) * np.log(squares)

    memory = minimize_scalar(likelihood, bounds=(0.0, MAX_MEMORY), method="bounded").x
    variance = left(memory)[1] / (count - unknowns)
    root = lfilter([1.0], [1.0, -memory], J[::-1], axis=0)[::-1].copy()
    root[0] /= np.sqrt(1.0 - memory**2)
    inverse = np.linalg.pinv(J.T @ J)
    return variance * (inverse @ root.T @ root @ inverse) / np.outer(size, size)


def _strongest(values, period):
    """Frequency of the largest peak of a series, at least one period in it [Hz]."""
    size = 16 * len(values)
    power = np.abs(np.fft.rfft(values * np.hanning(len(values)), size))
    frequencies = np.fft.rfftfreq(size, period)
    power[frequencies < 1.0 / (period * len(values))] = 0.0
    return float(frequencies[np.argmax(power)])
