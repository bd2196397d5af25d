# SPDX-License-Identifier: Apache-2.0
"""Finds where the joints of a recording stand still, and the noise of its gauges there, with its common part."""

from dataclasses import dataclass

import numpy as np

#: Corner of the low pass before speeds are taken from angles [Hz], at most this fraction of the rate.
CORNER, OF_RATE = 10.0, 0.2
#: A joint stands if it is slower than this fraction of the 99th percentile of its speed [-] ...
SLOW = 0.05
#: ... or slower than this number of steps of its encoder per second.
STEPS = 10.0
#: Order of the autoregression of the noise that gauges share.
MEMORY = 4
#: A shorter stretch does not count as rest [s].
MIN_REST = 0.6


def low_passed(values, period, corner):
    """The columns of `values` (s, k) below a `corner` [Hz], without phase; `period` is between rows [s]."""
    from scipy.signal import butter, sosfiltfilt

    corner = min(corner, OF_RATE / period)
    return sosfiltfilt(butter(2, corner, fs=1.0 / period, output="sos"), values, axis=0)


def derivative(values, period):
    """Rates of the columns of `values` (s, k) by central differences, shape (s, k); `period` is between rows [s]."""
    return np.gradient(values, period, axis=0)


def step_of(values):
    """Smallest change between successive rows of `values` (s,), the step of an encoder or converter; 0 without one."""
    change = np.abs(np.diff(values))
    change = change[change > 1e-9 * np.abs(values).max(initial=0.0)]
    return float(change.min()) if change.size else 0.0


def still(recording):
    """Samples at which every joint stands, shape (s,) bool."""
    position, period = recording.position, recording.period
    speed = np.abs(derivative(low_passed(position, period, CORNER), period))
    floor = STEPS * np.array([step_of(column) for column in position.T])
    return (speed <= np.maximum(SLOW * np.percentile(speed, 99.0, axis=0), floor)).all(axis=1)


def stretches(recording):
    """Rests of at least `MIN_REST`, a list of slices of samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still(recording).astype(int), [0]])))
    least = MIN_REST / recording.period
    return [
        slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > least
    ]


@dataclass(frozen=True, eq=False)
class Noise:
    """Readings of the gauges while nothing moves.

    Attributes
    ----------
    part : slice
        The samples.
    rms : ndarray, shape (g,)
        About a straight line [-]; NaN for a gauge that misses values.
    correlation : ndarray, shape (g, g)
        Between the gauges [-].
    corrected : ndarray, shape (g,)
        Rms of each gauge without the part that the others explain by linear regression [-].
    shared, own : ndarray, shape (g,)
        Rms of the first principal component of all gauges in each gauge, and of the rest [-].
    memory : ndarray, shape (4,)
        Autoregression of that component, newest sample first [-].
    """

    part: slice
    rms: np.ndarray
    correlation: np.ndarray
    corrected: np.ndarray
    shared: np.ndarray
    own: np.ndarray
    memory: np.ndarray


def noise(recording, part):
    """The `Noise` of the gauges in a `part` of a recording, a slice of samples at rest."""
    values = recording.strain[part]
    g, time = values.shape[1], np.linspace(-1.0, 1.0, len(values))
    line = np.column_stack([np.ones(time.size), time])
    known = np.isfinite(values).all(axis=0)
    rest = values[:, known] - line @ np.linalg.lstsq(line, values[:, known], rcond=None)[0]
    rms, corrected, shared, own = np.full((4, g), np.nan)
    correlation, memory = np.full((g, g), np.nan), np.full(MEMORY, np.nan)
    rms[known] = rest.std(axis=0)
    live = known.copy()
    live[known] = rms[known] > 0.0
    rest = rest[:, live[known]]
    if rest.size:
        correlation[np.ix_(live, live)] = np.atleast_2d(np.corrcoef(rest.T))
        # With a covariance C, the part of one variable that the others do not explain has the variance 1 / (C^-1)_ii.
        inverse = np.linalg.pinv(np.atleast_2d(np.cov(rest.T, bias=True)), hermitian=True)
        corrected[live] = 1.0 / np.sqrt(np.diag(inverse))
        shared[live], own[live], memory = _shared(rest)
    return Noise(part, rms, correlation, corrected, shared, own, memory)


def _shared(rest):
    """Rms of the first principal component in each gauge's noise (s, g), of what is left, and its autoregression."""
    size = rest.std(axis=0)
    source = (rest / size) @ np.linalg.svd(rest / size, full_matrices=False)[2][0]
    source /= source.std()
    load = rest.T @ source / len(source)
    past = np.column_stack([source[MEMORY - 1 - k : len(source) - 1 - k] for k in range(MEMORY)])
    memory = np.linalg.lstsq(past, source[MEMORY:], rcond=None)[0]
    return np.abs(load), (rest - np.outer(source, load)).std(axis=0), memory
