# SPDX-License-Identifier: Apache-2.0
"""Measures a node's own work for `/diagnostics`: cheap for each sample, evaluated once a second.

`Percentiles` and `Gaps` are fed on the control path: no allocation there beyond Python's own small numbers, no
sorting, no clock. Percentiles are by nearest rank: the smallest value that at least the given per cent of values do not
exceed. So each is a value that occurred.
"""

import math

import numpy as np

#: Sequence numbers on the topics are uint32.
WRAP = 2**32


class Percentiles:
    """Percentiles of the newest values since they were last asked for.

    Parameters
    ----------
    capacity : int
        Number of the newest values that are kept; the largest value is that of all values.

    Attributes
    ----------
    count : int
        Values since the last `take`.
    """

    def __init__(self, capacity=4096):
        self._ring = np.zeros(capacity)
        self._largest = -math.inf
        self.count = 0

    def add(self, value):
        """Note one value; NaN is left out."""
        if value != value:
            return
        self._ring[self.count % self._ring.size] = value
        self.count += 1
        if value > self._largest:
            self._largest = value

    def take(self, *percents):
        """Percentiles of what was added since the last call, and its largest value; begin anew.

        Parameters
        ----------
        *percents : float
            Each in (0, 100].

        Returns
        -------
        tuple of float
            One for each of `percents`, then the largest; all NaN if nothing was added.
        """
        kept = min(self.count, self._ring.size)
        if not kept:
            return (math.nan,) * (len(percents) + 1)
        values = np.sort(self._ring[:kept])
        ranks = (max(math.ceil(percent / 100.0 * kept), 1) - 1 for percent in percents)
        taken = (*(float(values[rank]) for rank in ranks), float(self._largest))
        self.count, self._largest = 0, -math.inf
        return taken


class Latency:
    """Times of one step of the control path, as `/diagnostics` shows them.

    Parameters
    ----------
    name : str
        Of the values, such as "latency": "latency p50 [ms]", "latency p99 [ms]", "latency max [ms]".
    """

    def __init__(self, name="latency"):
        self._name, self._times = name, Percentiles()
        #: Note one time [s].
        self.add = self._times.add

    def values(self):
        """Texts by name, of the times since the last call; a dash if there were none."""
        p50, p99, largest = self._times.take(50.0, 99.0)
        named = {"p50": p50, "p99": p99, "max": largest}
        return {
            f"{self._name} {which} [ms]": "-" if math.isnan(time) else f"{1e3 * time:.3f}"
            for which, time in named.items()
        }


class Gaps:
    """Counts the samples that never came, by the gaps in their numbers.

    Attributes
    ----------
    lost : int
        Since the start.
    """

    #: A difference larger than this is not a gap: the source counts anew.
    FAR = 100_000

    def __init__(self):
        self.lost = 0
        self._session, self._sequence, self._before = None, 0, 0

    def add(self, session, sequence):
        """Note the number of one sample.

        A new session is no gap: numbers start again. A sample that is sent again or late does not change the count.

        `sequence` is the sample's number in its `session`.
        """
        if session != self._session:
            self._session, self._sequence = session, sequence
            return
        ahead = (sequence - self._sequence) % WRAP
        if 0 < ahead < self.FAR:
            self.lost += ahead - 1
        elif ahead == 0 or ahead > WRAP - self.FAR:
            return
        self._sequence = sequence

    def take(self):
        """Samples lost since the last call."""
        new, self._before = self.lost - self._before, self.lost
        return new
