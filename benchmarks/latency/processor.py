# SPDX-License-Identifier: Apache-2.0
"""Processor time of each process in the windows of ``flexarm latency``, beside those of the bare relay.

It is given per sample that the simulator sends, because a busy machine sends fewer samples than the rate demands.
"""

import time

import numpy as np

from flexarm_studies import markdown

#: Columns of the table.
ROLES = ("simulator", "observer", "controller")


def spent(pid):
    """Processor time of a process so far [s], of all its threads, including those that have ended.

    It is read from the process's CPU clock. Its id is computed from the `pid` as clock_getcpuclockid does on Linux.
    """
    return time.clock_gettime((~pid << 3) | 2)


class Meter:
    """Measures the processor time of several processes from its creation on.

    Parameters
    ----------
    processes : mapping of str to subprocess.Popen
    """

    def __init__(self, processes):
        self._pids = {name: process.pid for name, process in processes.items()}
        self._before = self._spent()

    def _spent(self):
        return {name: spent(pid) for name, pid in self._pids.items()}

    def taken(self):
        """Processor time of each process since this meter was made [s]."""
        return {name: now - self._before[name] for name, now in self._spent().items()}


def summary(windows, bare):
    """Medians over the rounds of the processor times of a chain.

    Parameters
    ----------
    windows, bare : sequence of dict
        Windows of the chain, and of the relay in the same rounds.

    Returns
    -------
    each : dict of str to float
        Time of each process per sample [ms].
    ratio : float
        Ratio of the time of all its processes to that of all the relay's processes in the same round.
    """
    mine, relay = ([_per_sample(w) for w in all_] for all_ in (windows, bare))
    each = {name: float(np.median([taken[name] for taken in mine])) for name in mine[0]}
    whole, base = ([sum(taken.values()) for taken in all_] for all_ in (mine, relay))
    return each, float(np.median(np.divide(whole, base)))


def _per_sample(window):
    samples = len(window["latencies"]) + window["missed"]
    return {name: 1e3 * seconds / samples for name, seconds in window["processor"].items()}


def table(rows):
    """Markdown table of rows of `measure.summary`: ms per sample; at 1 kHz that is the fraction of a core."""
    head = ("arm, rate", "processor time [ms]", *ROLES, "together", "of the relay's")
    lines = []
    for row in rows:
        taken = row["processor_ms"]
        both = taken.get("observer_controller")
        cells = [f"{taken[role]:.2f}" if role in taken else "" for role in ROLES]
        cells = cells if both is None else [cells[0], f"{both:.2f} both", ""]
        together = f"{sum(taken.values()):.2f}"
        lines.append([row["case"], row["chain"], *cells, together, f"{row['processor_ratio']:.2f}"])
    return "\n".join(markdown.table(head, lines))
