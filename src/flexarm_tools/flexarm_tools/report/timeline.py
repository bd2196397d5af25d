# SPDX-License-Identifier: Apache-2.0
"""Puts samples in order and on one axis of time; joins topics; thins series for drawing. Plain arrays.

A sample is known by session, sequence and stamp, which every answer to it copies. The sequence counts, so that it
tells what was lost; the stamp tells the time. Where the two contradict each other, the clock has jumped, and the
sequence is believed. A session that begins anew goes on right after the one before.
"""

from dataclasses import dataclass

import numpy as np

#: Stamps may be off the sequence's by so much before the clock is said to have jumped [s], [periods].
JUMP_SECONDS, JUMP_PERIODS = 0.5, 100
#: A sequence that falls back by more than this begins anew.
LATE = 1000
#: Sessions that take turns more often than this are two sources.
MOST_SESSIONS = 50
_ODD = np.uint64(0x9E3779B97F4A7C15)


def keys(stamp, session, sequence):
    """A number for each sample, equal for what belongs to the same one, shape (k,) uint64."""
    key = np.asarray(stamp).astype(np.uint64)
    key = key * _ODD + np.asarray(session).astype(np.uint64)
    return key * _ODD + np.asarray(sequence).astype(np.uint64)


@dataclass(frozen=True, eq=False)
class Timeline:
    """The order of samples.

    Attributes
    ----------
    rows : ndarray of int, shape (k,)
        Rows of the table, each sample once, in order.
    time : ndarray, shape (k,)
        From the first one [s].
    epoch : ndarray of int, shape (k,)
        Counts starts of the source.
    index : ndarray of int, shape (k,)
        Samples since the epoch's first, those that were lost counted.
    period : float
        Between two samples [s]; NaN for a single one.
    lost : int
        Samples that are missing.
    repeated : int
        Messages that told the same once more.
    jumps : list of (int, float)
        Where the clock jumped: sample, and by how much [s].
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
        """Whether each sample but the first directly follows the one before, shape (k - 1,) bool."""
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
    # A source that was silent and counted on is a gap, not a jump.
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
    """Which start of the source each sample belongs to, by order of arrival, shape (k,)."""
    if not len(stamp):
        return np.zeros(0, int)
    changed = np.diff(session) != 0
    different, number = np.unique(session, return_inverse=True)
    if changed.sum() > MOST_SESSIONS and len(different) < 0.1 * changed.sum():
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
    """The least and the greatest of each bin, in the order in which they came; gaps stay gaps.

    What is drawn through them covers all that the series covers: no peak is lost.

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
    # A bin with a hole in it ends with a break, and one that is empty is one.
    out_t = np.column_stack([out_t, out_t[:, 1]])
    out_v = np.column_stack([out_v, np.where(holes | empty, np.nan, out_v[:, 1])])
    keep = np.column_stack([~empty, ~empty & (low != high), holes | empty])
    return out_t[keep], out_v[keep]


def broken(time, values, limit):
    """A series with a NaN put in wherever two samples are farther apart than `limit` [s]."""
    gaps = np.flatnonzero(np.diff(time) > limit)
    if not gaps.size:
        return time, values
    return (
        np.insert(np.asarray(time, float), gaps + 1, time[gaps] + 1e-9),
        np.insert(np.asarray(values, float), gaps + 1, np.nan),
    )
