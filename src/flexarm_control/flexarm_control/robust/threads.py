# SPDX-License-Identifier: Apache-2.0
"""Calls compiled functions on many rows, with a part of the rows on each processor.

A compiled function does not hold the interpreter's lock while it runs.
"""

import os
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache

#: Work up to this stays on one processor. The measure of work is the sum of N^3 over all rows.
SMALL = 3e4


def count():
    """Number of threads: one for each processor that this process may use, but at most ``OMP_NUM_THREADS``.

    The libraries of linear algebra follow the same rule. The number is 1 in nodes and in ``make test``, where several
    processes share the machine.
    """
    free = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    given = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    return min(free, max(int(given), 1)) if given.isdecimal() else free


@cache
def _pool(threads):
    return ThreadPoolExecutor(threads, "design")


if hasattr(os, "register_at_fork"):  # a forked child has only one thread
    os.register_at_fork(after_in_child=_pool.cache_clear)


def in_parts(calls):
    """Call compiled functions with parts of their arrays, one part of all rows on each processor.

    Parameters
    ----------
    calls : sequence of tuple
        A function, its arrays, and the number N of states of each row. The arrays have equally many rows. A row's
        results depend only on the same row of the arrays, and take a time of about N^3.
    """
    total = sum(len(arrays[0]) * size**3 for _, arrays, size in calls)
    parts = [[] for _ in range(count() if total > SMALL else 1)]
    begin = 0.0
    for function, arrays, size in calls:
        rows, first = len(arrays[0]), 0
        for k, part in enumerate(parts, 1):
            end = rows if k == len(parts) else round((total * k / len(parts) - begin) / size**3)
            end = min(max(end, first), rows)
            if end > first:
                part.append((function, tuple(array[first:end] for array in arrays)))
            first = end
        begin += rows * size**3
    running = [_pool(len(parts) - 1).submit(_run, part) for part in parts[1:]]
    try:
        _run(parts[0])
    finally:
        wait(running)
    for one in running:
        one.result()


def _run(calls):
    for function, arrays in calls:
        function(*arrays)
