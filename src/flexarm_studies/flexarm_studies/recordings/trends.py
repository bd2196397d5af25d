# SPDX-License-Identifier: Apache-2.0
r"""Finds drift and delay of the gauges of a recording, without a model of the arm.

To good accuracy, the motion of a rigid arm causes the strain

.. math::
    \varepsilon = \sum_p \Big(g_p + \sum_i h_{pi}\ddot q_i + \sum_{i\le j} c_{pij}\dot q_i\dot q_j\Big)\pi_p(q),
    \qquad \pi_p = \prod_i\{1, \cos q_i, \sin q_i\}

(the weight's moment is exactly such a sum). The regressors are these terms, a line in time, and the strain's own rate,
all below a corner well under the bending. The line is then the drift, and the rate's coefficient is minus the delay: a
channel that is late by :math:`\tau` reads :math:`\varepsilon(t - \tau)\approx\varepsilon - \tau\dot\varepsilon`.
Intervals are those of Newey and West (1987), because the residual is as slow as the motion. A gear with play or
friction looks like a delay, too.
"""

import itertools

import numpy as np

from .rest import CORNER, derivative, low_passed

#: The corner is this fraction of the frequency of the slowest vibration [-]; that frequency if none was found [Hz].
BELOW, UNKNOWN = 1.0 / 6.0, 3.0
#: Minimum number of periods of the corner for each regressor; otherwise there are no results.
PER_REGRESSOR = 0.4
#: Largest delay between two channels that is searched for [s].
LONGEST = 0.25
NORMAL = 1.959964


def drift_and_delay(recording, vibration=None):
    """What the gauges of a recording do in addition to following the motion.

    Parameters
    ----------
    recording : Recording
    vibration : float, optional
        Frequency of the slowest vibration [Hz].

    Returns
    -------
    drift, drift_width : ndarray, shape (g,)
        From the recording's start to its end, and half of its 95 % interval [-]; NaN if the motion does not determine
        it.
    delay, delay_width : ndarray, shape (g,)
        Delay of the strain after the motion, and half of its 95 % interval [s].
    """
    period, g = recording.period, recording.strain.shape[1]
    out = np.full((4, g), np.nan)
    corner = BELOW * (vibration or UNKNOWN)
    regressors = _rigid(recording)
    count, length = regressors.shape[1] + 2, period * len(regressors)
    if count * PER_REGRESSOR > length * corner or not np.isfinite(regressors).all():
        return out
    line = np.linspace(-0.5, 0.5, len(regressors))[:, None]
    for i, strain in enumerate(recording.strain.T):
        if not np.isfinite(strain).all():
            continue
        rate = derivative(low_passed(strain[:, None], period, CORNER), period)
        slow = low_passed(np.hstack([regressors, line, rate, strain[:, None]]), period, corner)
        value, width = regression(slow[:, :-1], slow[:, -1], int(1.5 / corner / period))
        out[:, i] = value[-2], width[-2], -value[-1], width[-1]
    return out


def _rigid(recording):
    """Regressors of the module's equation, shape (s, p), of the joints that move."""
    period = recording.period
    q = low_passed(recording.position, period, CORNER)
    q = q[:, np.ptp(q, axis=0) > 1e-3]
    qd = derivative(q, period)
    qdd = derivative(qd, period)
    ones = np.ones(len(q))
    waves = [(ones, np.cos(column), np.sin(column)) for column in q.T]
    products = [np.prod(chosen, axis=0) for chosen in itertools.product(*waves)] or [ones]
    pairs = itertools.combinations_with_replacement(qd.T, 2)
    motions = [ones, *qdd.T, *(a * b for a, b in pairs)]
    return np.column_stack([p * m for m in motions for p in products])


def regression(X, y, lags):
    """Least squares: coefficients, and halves of their 95 % intervals for residuals correlated over `lags` samples.

    Parameters
    ----------
    X : ndarray, shape (s, p)
        Regressors.
    y : ndarray, shape (s,)
    lags : int

    Returns
    -------
    value, width : ndarray, shape (p,)
    """
    inverse = np.linalg.pinv(X, rcond=1e-9)
    value = inverse @ y
    scores = inverse * (y - X @ value)
    variance = np.sum(scores**2, axis=1)
    for lag in range(1, lags + 1):
        product = np.sum(scores[:, lag:] * scores[:, :-lag], axis=1)
        variance += 2.0 * (1.0 - lag / (lags + 1.0)) * product
    return value, NORMAL * np.sqrt(np.maximum(variance, 0.0))


def lag(later, earlier, period):
    """Delay of one series after another, and their correlation at that delay.

    Parameters
    ----------
    later, earlier : ndarray, shape (s,)
    period : float
        Of both [s].

    Returns
    -------
    delay : float
        Delay of `later` after `earlier`, interpolated between samples by a parabola [s].
    alike : float
        Their correlation at that delay [-].
    """
    most = int(LONGEST / period)
    a, b = later - later.mean(), earlier - earlier.mean()
    shifts = np.arange(-most, most + 1)
    inner = slice(most, len(a) - most)
    cut = b[inner]
    size = np.sqrt(
        np.sum(cut**2) * np.array([np.sum(a[most + k : len(a) - most + k] ** 2) for k in shifts])
    )
    product = np.array([a[most + k : len(a) - most + k] @ cut for k in shifts]) / np.maximum(
        size, 1e-300
    )
    k = int(np.argmax(np.abs(product)))
    if not 0 < k < shifts.size - 1:
        return float(shifts[k] * period), float(product[k])
    before, peak, after = product[k - 1 : k + 2]
    curve = before - 2.0 * peak + after
    part = 0.5 * (before - after) / curve if curve else 0.0
    return float((shifts[k] + part) * period), float(peak)
