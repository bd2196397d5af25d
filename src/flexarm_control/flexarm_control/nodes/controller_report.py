# SPDX-License-Identifier: Apache-2.0
"""Reports of the controller node to its user: log lines when the supervisor's state changes, and diagnostics."""

from math import isnan

from flexarm_ros.node import ERROR, OK, WARN
from flexarm_ros.statistics import Latency, Percentiles

from ..loop.supervisor import State

#: Fraction by which the rate of states may differ from the design's.
OTHER_RATE = 0.2
#: Warning about a design with which the arm does not come back from its torque limits.
SWINGS = "at the torque limits the arm may swing: give motions more time"
#: Warning about a design with which a vibration grows while some joints stick and others slide.
HUNTS = "because of friction the arm may hunt: start with a lower design.speed, or a larger design.effort"


class Report:
    """Counts samples, and puts the state of the controller into words.

    Parameters
    ----------
    node : ArmNode
        Node whose log and parameters are used.
    core : ArmController
    design : Default or None
        Design of the control; None: its parameters were given.
    """

    def __init__(self, node, core, design=None):
        self._node, self._core, self._design = node, core, design
        self._delays, self._delays_seen = Percentiles(), core.torque_delay.count
        self._latency, self._logged = Latency(), core.state
        self._samples = self._samples_before = 0
        self._saturated = self._saturated_before = self._interruptions = 0

    def answered(self, took):
        """Count a sample; `took` is the time from its message to its torque [s]."""
        self._latency.add(took)
        self._samples += 1
        measured = self._core.torque_delay
        if measured.count != self._delays_seen:
            self._delays_seen = measured.count
            self._delays.add(measured.delay)
        self._saturated += self._core.saturated
        if self._core.interruptions != self._interruptions:
            self._interruptions = self._core.interruptions
            self._node.get_logger().warning(self._core.reason)
        if self._core.state != self._logged:
            self.log_state()

    def log_state(self):
        """Log the supervisor's state, if a user needs to know it."""
        state, was, reason = self._core.state, self._logged, self._core.supervisor.reason
        self._logged = state
        log = self._node.get_logger()
        if state == State.FAULT:
            log.error(f"fault, torque disabled until ~/recover is called: {reason}")
        elif state == State.INACTIVE and was != State.FAULT:
            log.error(f"torque disabled: {reason}")
        elif state == State.STOPPING:
            log.warning(f"stopping: {reason}")

    def diagnose(self, last_change=""):
        """Level, message and values for `/diagnostics`, of the time since the last call.

        `last_change` is that of `Designs`.
        """
        rate, self._samples_before = self._samples - self._samples_before, self._samples
        saturated = self._saturated - self._saturated_before
        self._saturated_before = self._saturated
        core, parameters = self._core, self._node.parameters
        median, longest = self._delays.take(50.0)
        values = {
            "state": core.state.name,
            "slow law": parameters["slow.type"],
            "fast law": parameters["fast.type"],
            "slow manifold": parameters["manifold.type"],
            "feed-forward": parameters["feedforward"],
            "samples per second": rate,
            **self._latency.values(),
            "torque delay p50 [ms]": _milliseconds(median),
            "torque delay max [ms]": _milliseconds(longest),
            **self._of_design(),
            **self._of_payload(),
            "states lost": core.missed,
            "states too late": core.late,
            "interruptions": core.interruptions,
            "stops": core.supervisor.stops,
            "faults": core.supervisor.faults,
            "fast control": "on" if core.fast_enabled else "off",
            "saturated samples": self._saturated,
            "trajectory": core.trajectory_id,
            "last parameters set": last_change or "-",
        }
        return *self._level(saturated, rate, median), values

    def _of_design(self):
        design = self._design
        if design is None:
            return {}
        speed = f"{design.speed:g}"
        if design.slowed:
            speed += ", lowered because of the torque limits"
        speed = "; ".join([speed, *self._design_warnings()])
        return {
            "designed for a delay of [ms]": _milliseconds(design.delay),
            "bears a delay of [ms]": _milliseconds(design.bears_delay),
            "speed of the design": speed,
        }

    def _design_warnings(self):
        """What the design itself does not hold."""
        design = self._design
        if design is None:
            return []
        return [SWINGS] * (not design.comes_back) + [HUNTS] * design.hunts

    def _of_payload(self):
        found = self._core.payload
        if found is None:
            return {}
        interval = f"{found.value:.3f}, {found.low:.3f} to {found.high:.3f}"
        return {
            "payload estimate": "-" if isnan(found.value) else interval,
            "payload estimate is": f"not used: {found.reason}" if found.reason else "usable",
            "payload in use": f"{self._core.payload_scale:.3f}",
        }

    def _not_as_designed(self, delay):
        """How the loop differs from the design's, beyond what the design bears; `delay` is the measured one [s]."""
        design, period = self._design, self._core.period
        if design is None:
            return ""
        if delay > design.bears_delay:
            return (
                f"torque acts {_milliseconds(delay)} ms after its measurement, the design bears"
                f" {_milliseconds(design.bears_delay)}: shorten the way, or start with design.delay {delay:.2g}"
            )
        rate = self._node.parameters["rate"]
        if period and abs(1.0 / period - rate) > OTHER_RATE * rate:
            return (
                f"{1.0 / period:.4g} states per second, the control is designed for {rate:g}: start observer and"
                f" controller with rate {1.0 / period:.1f}"
            )
        return ""

    def _level(self, saturated, rate, delay):
        core = self._core
        if not self._node.active:
            return OK, "not active"
        if core.state == State.FAULT:
            return ERROR, f"{core.supervisor.reason}: fix it, then call ~/recover"
        if core.state == State.INACTIVE:
            return ERROR, core.reason or "no arm_state_estimate yet: start the observer"
        if why := self._not_as_designed(delay):
            return WARN, why
        if saturated:
            return WARN, f"torque at its limit in {saturated} of {rate} samples"
        if core.reason:
            return WARN, core.reason
        if not core.fast_enabled:
            return WARN, "the fast control is off: call ~/enable_fast with data true"
        if warnings := self._design_warnings():
            return WARN, "; ".join(warnings)
        return OK, ""


def _milliseconds(time):
    """A time [s] in milliseconds, as text; a dash if there is none."""
    return "-" if isnan(time) else f"{1e3 * time:.3f}"
