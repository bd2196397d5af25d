# SPDX-License-Identifier: Apache-2.0
"""Times of several tasks that take turns, so that what slows the computer slows all of them."""

import math
import time

import numpy as np


def round_robin(tasks, rounds, turn):
    """Measure `tasks`, a mapping of names to functions, in turns; return the time per call in each of the `rounds` [s].

    In a turn, a task is called repeatedly for at least `turn` [s].
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
    """Median of the ratios ``times / over`` of neighbouring turns."""
    return float(np.median(times / over))


def least(times):
    """Time of the best turn. The work is always the same, so slower turns were disturbed by other programs."""
    return float(np.min(times))
