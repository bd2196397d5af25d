# SPDX-License-Identifier: Apache-2.0
"""What the controller node tells its user: the log's lines when the supervisor's state changes, and diagnostics."""

from flexarm_ros.node import ERROR, OK, WARN
from flexarm_ros.statistics import Latency

from ..loop.supervisor import State


class Report:
    """Counts samples, and puts the state of the controller into words.

    Parameters
    ----------
    node : ArmNode
        Its log and parameters.
    core : ArmController
    """

    def __init__(self, node, core):
        self._node, self._core = node, core
        self._latency, self._logged = Latency(), core.state
        self._samples = self._samples_before = 0
        self._saturated = self._saturated_before = self._interruptions = 0

    def answered(self, took):
        """Count a sample; `took` is the time from its message to its torque [s]."""
        self._latency.add(took)
        self._samples += 1
        self._saturated += self._core.saturated
        if self._core.interruptions != self._interruptions:
            self._interruptions = self._core.interruptions
            self._node.get_logger().warning(self._core.reason)
        if self._core.state != self._logged:
            self.log_state()

    def log_state(self):
        """Log the supervisor's state, where a user needs to know it."""
        state, was, reason = self._core.state, self._logged, self._core.supervisor.reason
        self._logged = state
        log = self._node.get_logger()
        if state == State.FAULT:
            log.error(f"fault, torque disabled until ~/recover is called: {reason}")
        elif state == State.INACTIVE and was != State.FAULT:
            log.error(f"torque disabled: {reason}")
        elif state == State.STOPPING:
            log.warning(f"stopping: {reason}")

    def diagnose(self):
        """Level, message and values for `/diagnostics`, of the time since the last call."""
        rate, self._samples_before = self._samples - self._samples_before, self._samples
        saturated = self._saturated - self._saturated_before
        self._saturated_before = self._saturated
        core, parameters = self._core, self._node.parameters
        values = {
            "state": core.state.name,
            "slow law": parameters["slow.type"],
            "fast law": parameters["fast.type"],
            "slow manifold": parameters["manifold.type"],
            "feed-forward": parameters["feedforward"],
            "samples per second": rate,
            **self._latency.values(),
            "states lost": core.missed,
            "states too late": core.late,
            "interruptions": core.interruptions,
            "stops": core.supervisor.stops,
            "faults": core.supervisor.faults,
            "fast control": "on" if core.fast_enabled else "off",
            "saturated samples": self._saturated,
            "trajectory": core.trajectory_id,
        }
        return *self._level(saturated, rate), values

    def _level(self, saturated, rate):
        core = self._core
        if not self._node.active:
            return OK, "not active"
        if core.state == State.FAULT:
            return ERROR, f"{core.supervisor.reason}: fix it, then call ~/recover"
        if core.state == State.INACTIVE:
            return ERROR, core.reason or "no arm_state_estimate yet: start the observer"
        if saturated:
            return WARN, f"torque at its limit in {saturated} of {rate} samples"
        if core.reason:
            return WARN, core.reason
        if not core.fast_enabled:
            return WARN, "the fast control is off: call ~/enable_fast with data true"
        return OK, ""
