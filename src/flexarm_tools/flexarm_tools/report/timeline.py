# SPDX-License-Identifier: Apache-2.0
"""Puts samples in order on one time axis; joins topics; thins series for drawing. Plain arrays.

Session, sequence and stamp identify a sample; every answer to it copies them. The sequence counts samples and so shows
losses; the stamp is the time. If the two contradict each other, the clock has jumped, and the sequence is taken as
correct. A new session follows the one before without a gap.
"""

from dataclasses import dataclass

import numpy as np

#: The clock has jumped where stamp and sequence differ by more than either of these [s], [periods].
JUMP_SECONDS, JUMP_PERIODS = 0.5, 100
#: A sequence that falls back by more than this has restarted.
LATE = 1000
#: Sessions that alternate more often than this come from two sources at once.
MAX_CHANGES = 50
_ODD = np.uint64(0x9E3779B97F4A7C15)


def keys(stamp, session, sequence):
    """A key for each sample, equal in all topics for the same sample, shape (k,) uint64."""
    key = np.asarray(stamp).astype(np.uint64)
    key = key * _ODD + np.asarray(session).astype(np.uint64)
    return key * _ODD + np.asarray(sequence).astype(np.uint64)


@dataclass(frozen=True, eq=False)
class Timeline:
    """The order of samples.

    Attributes
    ----------
    rows : ndarray of int, shape (k,)
        Rows of the table in order, each sample once.
    time : ndarray, shape (k,)
        Since the first one [s].
    epoch : ndarray of int, shape (k,)
        Number of restarts of the source before the sample.
    index : ndarray of int, shape (k,)
        Samples since the epoch's first, lost ones included.
    period : float
        Time between two samples [s]; NaN for a single one.
    lost : int
        Missing samples.
    repeated : int
        Messages that repeat a sample.
    jumps : list of (int, float)
        Jumps of the clock: sample, and size [s].
    """

    rows: np.ndarray
    time: np.ndarray
    epoch: np.ndarray
    index: np.ndarray
    period: float
    lost: int
    repeated: int
    jumps: list

    @property
    def joined(self):
        """Whether each sample after the first directly follows the one before, shape (k - 1,) bool."""
        return (np.diff(self.epoch) == 0) & (np.diff(self.index) == 1)


def arrange(stamp, session, sequence):
    """A `Timeline` of samples in the order in which they were recorded.

    Parameters
    ----------
    stamp, session, sequence : ndarray, shape (k,)
        [ns], [-], [-]
    """
    _, first = np.unique(keys(stamp, session, sequence), return_index=True)
    first.sort()
    repeated = len(stamp) - len(first)
    epoch = _epochs(stamp[first], session[first], sequence[first])
    order = np.lexsort((sequence[first], epoch))
    rows, epoch = first[order], epoch[order]
    stamp, sequence = np.asarray(stamp)[rows], np.asarray(sequence)[rows]
    steps, counts, same = np.diff(stamp) * 1e-9, np.diff(sequence), np.diff(epoch) == 0
    counts = np.where(same, np.maximum(counts, 1), 1)
    usual = same & (steps > 0.0)
    period = float(np.median(steps[usual] / counts[usual])) if usual.any() else float("nan")
    safe = period if np.isfinite(period) else 0.0
    expected = counts * safe
    off = np.abs(steps - expected) > np.maximum(JUMP_SECONDS, JUMP_PERIODS * safe)
    jumped = same & (off | (steps <= 0.0))
    # If a silent source went on counting, there is a gap, not a jump.
    jumps = [(int(i) + 1, float(steps[i] - expected[i])) for i in np.flatnonzero(jumped)]
    steps = np.where(same & ~jumped, steps, expected)
    starts = np.concatenate([[0], np.flatnonzero(~same) + 1])
    total = np.concatenate([[0], np.cumsum(np.where(same, counts, 0))])
    index = total - total[starts][epoch]
    time = np.concatenate([[0.0], np.cumsum(steps)])
    return Timeline(
        rows, time, epoch, index, period, int((counts[same] - 1).sum()), repeated, jumps
    )


def _epochs(stamp, session, sequence):
    """Number of the source's restart to which each sample belongs, by order of arrival, shape (k,)."""
    if not len(stamp):
        return np.zeros(0, int)
    changed = np.diff(session) != 0
    different, number = np.unique(session, return_inverse=True)
    if changed.sum() > MAX_CHANGES and len(different) < 0.1 * changed.sum():
        return number.reshape(-1)  # two sources at once: one after the other
    back, later = np.diff(sequence), np.diff(stamp) > 0
    again = changed | ((back < 0) & later) | (back < -LATE)
    return np.concatenate([[0], np.cumsum(again)])


def match(wanted, given):
    """For each of `wanted` the last row of `given` with the same key, -1 where there is none, shape (k,)."""
    if not len(given):
        return np.full(len(wanted), -1)
    backwards = np.asarray(given)[::-1]
    different, last = np.unique(backwards, return_index=True)
    at = np.minimum(np.searchsorted(different, wanted), len(different) - 1)
    found = different[at] == wanted
    return np.where(found, len(backwards) - 1 - last[at], -1)


def stretches(mask):
    """Starts and ends (exclusive) of the runs of True, each shape (r,)."""
    edges = np.diff(np.concatenate([[0], np.asarray(mask, int), [0]]))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)


def thinned(time, values, bins):
    """The smallest and the largest value of each bin, in their order in time; gaps stay gaps.

    A line through them covers the same range as the series: no peak is lost.

    Parameters
    ----------
    time, values : ndarray, shape (k,)
        Ascending; NaN for no value.
    bins : int

    Returns
    -------
    time, values : ndarray, shape (at most 3 bins,)
    """
    time, values = np.asarray(time), np.asarray(values, float)
    if time.size <= 2 * bins:
        return time, values
    width = -(-time.size // bins)
    short = -time.size % width
    whole = np.concatenate([values, np.full(short, np.nan)]).reshape(-1, width)
    empty = np.isnan(whole).all(axis=1)
    holes = np.isnan(whole).any(axis=1) & ~empty
    if short and not np.isnan(whole[-1, : width - short]).any():
        holes[-1] = False
    low = np.where(np.isnan(whole), np.inf, whole).argmin(axis=1)
    high = np.where(np.isnan(whole), -np.inf, whole).argmax(axis=1)
    starts = np.arange(len(whole)) * width
    pair = np.sort(np.column_stack([low, high]), axis=1) + starts[:, None]
    out_t, out_v = time[pair], values[pair]
    # A bin with a gap in it ends with a break; an empty bin is a break.
    out_t = np.column_stack([out_t, out_t[:, 1]])
    out_v = np.column_stack([out_v, np.where(holes | empty, np.nan, out_v[:, 1])])
    keep = np.column_stack([~empty, ~empty & (low != high), holes | empty])
    return out_t[keep], out_v[keep]


def broken(time, values, limit):
    """A series with a NaN inserted wherever two samples are farther apart than `limit` [s]."""
    gaps = np.flatnonzero(np.diff(time) > limit)
    if not gaps.size:
        return time, values
    return (
        np.insert(np.asarray(time, float), gaps + 1, time[gaps] + 1e-9),
        np.insert(np.asarray(values, float), gaps + 1, np.nan),
    )
