# SPDX-License-Identifier: Apache-2.0
"""Statistics of the observer node, and the diagnosis that it publishes once a second."""

from math import isnan

import numpy as np

from flexarm_ros.node import ERROR, OK, WARN
from flexarm_ros.statistics import Gaps, Latency, Percentiles

#: Warn when more than this fraction of a second's samples is lost.
MAX_LOST = 0.01


class ObserverStatistics:
    """Counts of samples, and measures of the innovations.

    Parameters
    ----------
    modes : int
        Number of the arm's modes.
    """

    def __init__(self, modes):
        self._samples, self._samples_before = 0, 0
        self._refused, self._refused_before, self._refusal = 0, 0, ""
        self._latency, self._gaps = Latency(), Gaps()
        self._innovation, self._squared = Percentiles(), Percentiles()
        self._size = np.zeros(modes)

    def received(self, message):
        """Count an `ArmState`, and the samples lost before it."""
        self._gaps.add(message.session, message.sequence)

    def refused(self, error):
        """Count a refused sample."""
        self._refused += 1
        self._refusal = str(error)

    def estimated(self, observer, seconds):
        """Count an estimate, which took this long [s]."""
        self._samples += 1
        self._latency.add(seconds)
        self._squared.add(observer.innovation_squared)
        if observer.innovation.size == self._size.size:
            np.abs(observer.innovation, out=self._size)
            self._innovation.add(self._size.max(initial=0.0))

    def diagnose(self, core, name, active):
        """Level, message and values of the last second; `core` is the `ArmObserver`, whose observer has this `name`.

        `active` is whether the node is active.
        """
        observer = core.observer
        rate, self._samples_before = self._samples - self._samples_before, self._samples
        refused, self._refused_before = self._refused - self._refused_before, self._refused
        lost = self._gaps.take()
        values = {
            "observer": name,
            "samples per second": rate,
            "samples refused": self._refused,
            "samples lost": self._gaps.lost,
            **self._latency.values(),
            "converged": observer.converged,
            **self._innovations(),
            **{f"outliers replaced, {name}": n for name, n in core.monitor.bridged.items()},
            **observer.parameters_estimated,
        }
        doubt = core.monitor.doubts.text if core.settings["plausibility"] else ""
        gauges = "; ".join(core.gauges.warnings()) if core.gauges else ""
        many_lost = lost > MAX_LOST * (rate + lost)
        for wrong, level, message in (
            (not active, OK, "not active"),
            (refused, ERROR, f"{refused} states refused: {self._refusal}"),
            (not rate, ERROR, "no usable arm_state: start the simulator or driver"),
            (doubt, ERROR, doubt),
            (not observer.converged, WARN, "not converged yet"),
            (gauges, WARN, gauges),
            (not observer.consistent, WARN, "innovations are larger than the noise explains: "
             "raise observer noise levels, or correct the arm file"),
            (many_lost, WARN, f"{lost} of {rate + lost} samples lost on their way from the driver"),
        ):  # fmt: skip
            if wrong:
                return level, message, values
        return OK, "", values

    def _innovations(self):
        """Measured minus predicted amplitude in the last second, if the observer predicts one."""
        (largest,) = self._innovation.take()
        median, squared = self._squared.take(50.0)
        values = {}
        if not isnan(largest):
            values["largest innovation [m, rad]"] = f"{largest:.3g}"
        if not isnan(squared):
            values["normalised innovation squared p50"] = f"{median:.3g}"
            values["normalised innovation squared max"] = f"{squared:.3g}"
        return values
