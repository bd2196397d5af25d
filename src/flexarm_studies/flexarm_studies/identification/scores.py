# SPDX-License-Identifier: Apache-2.0
r"""Scores how well predicted strains explain measured ones, compared with model-free baselines and the noise ceiling.

The score is the variance accounted for (VAF) of each gauge, for the whole strain and for its part above a frequency
(Butterworth high pass of order four, without phase),

.. math:: \mathrm{VAF} = 1 - \frac{\mathrm{Var}(\varepsilon - \hat\varepsilon)}{\mathrm{Var}(\varepsilon)} .

Three baselines are linear regressions on the joint motion, fitted on the fitted part and scored on the scored part:
**quasi-static**, on the effect of the weight on a rigid arm, :math:`1, \cos a_i, \sin a_i` of the links' absolute
angles a; **rigid**, with its inertial terms, :math:`\ddot a_i` and, for each pair, :math:`\cos(a_j - a_i)\,\ddot a_i`,
:math:`\cos(a_j - a_i)\,\ddot a_j`, :math:`\sin(a_j - a_i)\,\dot a_i^2`, :math:`\sin(a_j - a_i)\,\dot a_j^2`; and
**FIR**, also on the same terms of past samples. For two joints these have 5, 11 and 211 coefficients. The ceiling is
the score of a perfect model, which is limited by the noise of the gauges at rest.
"""

import itertools

import numpy as np
from scipy.signal import butter, sosfiltfilt

from ..recordings import rest, ring_down
from ..recordings.summary import quiet_and_rings

#: Order of the high pass, and past samples of the FIR baseline.
ORDER, LAGS = 4, 20
#: Singular values of a regression below this, relative to the largest, count as zero [-].
SINGULAR = 1e-8


def high_passed(values, period, above):
    """The columns of `values` (s, g), high-passed with the corner `above` [Hz]; `period` is between rows [s]."""
    passes = butter(ORDER, above, "high", fs=1.0 / period, output="sos")
    return sosfiltfilt(passes, values, axis=0)


def explained(measured, predicted, part, period, above):
    """Scores of a prediction (s, g) on a `part`, a slice of samples.

    Parameters
    ----------
    measured, predicted : ndarray, shape (s, g)
        Strains [-]. Samples that were not measured are left out; for ``vaf_above``, straight lines replace them.
    part : slice
    period : float
        Time between samples [s].
    above : float
        Frequency [Hz].

    Returns
    -------
    dict
        ``vaf``, ``vaf_above`` [%], ``rms`` [-], each (g,).
    """
    error = measured - predicted
    both = [filled(values) for values in (measured, error)]
    fast, fast_error = (high_passed(values, period, above)[part] for values in both)
    known = np.isfinite(error[part])
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.nanvar(np.where(known, measured[part], np.nan), axis=0)
        vaf = 1.0 - np.nanvar(error[part], axis=0) / variance
        above_it = 1.0 - np.mean(fast_error**2, axis=0) / np.mean(fast**2, axis=0)
    rms = np.nanstd(error[part], axis=0)
    return {"vaf": 100.0 * vaf, "vaf_above": 100.0 * above_it, "rms": rms}


def filled(values):
    """The columns of `values` (s, g) with missing ones filled in by straight lines."""
    out, row = values.copy(), np.arange(len(values))
    for column in out.T:
        known = np.isfinite(column)
        column[~known] = np.interp(row[~known], row[known], column[known]) if known.any() else 0.0
    return out


def regressors(position, velocity, acceleration):
    """Terms of the quasi-static and of the rigid baseline, shapes (s, 1 + 2 n) and (s, r).

    Parameters
    ----------
    position, velocity, acceleration : ndarray, shape (s, n)
        Of the joints [rad], [rad/s], [rad/s^2].
    """
    a, rate, change = (np.cumsum(values, axis=1) for values in (position, velocity, acceleration))
    static = np.hstack([np.ones((len(a), 1)), np.cos(a), np.sin(a)])
    inertial = [change]
    for i, j in itertools.combinations(range(a.shape[1]), 2):
        c, s = np.cos(a[:, j] - a[:, i]), np.sin(a[:, j] - a[:, i])
        rows = (c * change[:, i], c * change[:, j], s * rate[:, i] ** 2, s * rate[:, j] ** 2)
        inertial.append(np.column_stack(rows))
    return static, np.hstack([static, *inertial])


def baselines(motion, measured, fitted):
    """Predictions without a model, shape (s, g), and their numbers of coefficients: a dict of name to both.

    Parameters
    ----------
    motion : tuple of ndarray, shape (s, n)
        Position, velocity, acceleration.
    measured : ndarray, shape (s, g)
    fitted : slice
        Samples of the regression.
    """
    static, rigid = regressors(*motion)
    late = [np.roll(rigid[:, 1:], k, axis=0) for k in range(LAGS + 1)]
    for k, rows in enumerate(late):
        rows[:k] = rigid[0, 1:]
    fir = np.hstack([rigid[:, :1], *late])
    sets = {"quasi-static": static, "rigid": rigid, "FIR": fir}
    return {name: (_regressed(X, measured, fitted), X.shape[1]) for name, X in sets.items()}


def _regressed(X, measured, fitted):
    size = np.maximum(np.linalg.norm(X[fitted], axis=0), 1e-300)
    out = np.full(measured.shape, np.nan)
    for c, column in enumerate(measured.T):
        known = np.isfinite(column[fitted])
        if known.any():
            A = (X[fitted] / size)[known]
            out[:, c] = X / size @ np.linalg.lstsq(A, column[fitted][known], SINGULAR)[0]
    return out


def ceiling(recording, measured, part, above):
    """Scores of a perfect model, from the noise in a `recording`'s longest rest without ringing; None if it has none.

    `measured` (s, g), `part` and `above` are as for `explained`.
    """
    found, _ = quiet_and_rings(recording, rest.stretches(recording))
    if found is None:
        return None
    quiet, noise, period = found.part, found.rms, recording.period
    values = filled(recording.strain)
    fast_noise = high_passed(values, period, above)[quiet].std(axis=0)
    fast = high_passed(filled(measured), period, above)[part]
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            "vaf": 100.0 * (1.0 - noise**2 / np.nanvar(measured[part], axis=0)),
            "vaf_above": 100.0 * (1.0 - fast_noise**2 / np.mean(fast**2, axis=0)),
            "rms": noise,
        }


def ring_downs(recording, predicted, noise):
    """Ring-downs of a recording, each beside that of the predicted strain, as pairs of `ring_down.RingDown`.

    Parameters
    ----------
    recording : Recording
    predicted : ndarray, shape (s, g)
    noise : ndarray, shape (g,)
        Of the gauges, rms [-].
    """
    found = ring_down.find(recording, rest.stretches(recording), noise)
    return [
        (r, ring_down.fit(predicted[r.part, r.gauge], recording.period, r.part, r.gauge))
        for r in found
    ]


def whiteness(error):
    """Correlation of residuals (s,) between successive samples, and its 95 % bound for white residuals."""
    e = error[np.isfinite(error)]
    e = e - e.mean()
    return float(e[1:] @ e[:-1] / max(e @ e, 1e-300)), 1.959964 / np.sqrt(max(e.size, 1))
