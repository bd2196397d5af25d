# SPDX-License-Identifier: Apache-2.0
"""Times of several tasks that take turns, so that what slows the computer slows all of them."""

import math
import time

import numpy as np


def round_robin(tasks, rounds, turn):
    """Measure tasks, by their names, in turns: time per call in each of so many `rounds` [s].

    In a turn a task is called as often as takes at least `turn` [s].
    """
    calls = {}
    for name, task in tasks.items():
        task()
        calls[name] = max(1, math.ceil(turn / max(_elapsed(task, 1), 1e-7)))
    times = {name: np.empty(rounds) for name in tasks}
    for i in range(rounds):
        for name, task in tasks.items():
            times[name][i] = _elapsed(task, calls[name]) / calls[name]
    return times


def _elapsed(task, calls):
    start = time.perf_counter()
    for _ in range(calls):
        task()
    return time.perf_counter() - start


def paired(times, over):
    """Median of the ratios ``times / over`` of turns next to each other."""
    return float(np.median(times / over))


def least(times):
    """Time of the best turn: the work is always the same, so the others were disturbed."""
    return float(np.min(times))
