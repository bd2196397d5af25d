# SPDX-License-Identifier: Apache-2.0
"""Writes a bag of the loop without ROS: the messages that the nodes would send, made by the nodes' own writers.

Nothing is sent: no middleware is started. The stamps and the times in the bag are those of the simulator.
"""

import math

from rclpy.serialization import serialize_message

from flexarm_ros.messages import (
    CompositeStateWriter,
    ObserverStateWriter,
    StateWriter,
    TorqueWriter,
)
from flexarm_studies.commands.options import new_path

from .recorder import BagWriter


class LoopBag:
    """Writes what a `ClosedLoop` does at every sample; a context manager.

    Parameters
    ----------
    folder : str or Path
        Of the bag; must not exist.
    loop : ClosedLoop
    arm : str
        Shipped name or path of the arm file, which goes into the bag.
    observer : str
        Name of the observer, as the node publishes it.
    """

    def __init__(self, folder, loop, arm, observer=""):
        self.folder, self._loop, self._observer = new_path(folder, "--bag"), loop, observer
        arm_ = loop.model.arm
        self._measured, self._estimate = StateWriter(arm_), StateWriter(arm_)
        self._torque, self._state = TorqueWriter(arm_, 1), CompositeStateWriter(loop.model)
        self._observed = ObserverStateWriter(arm_)
        self._sent = self._answered = None
        self._bag = BagWriter(self.folder, arm)
        loop.bag = self

    def measured(self, sample):
        """Write a sample as the simulator sends it."""
        if sample.key != self._sent:
            self._sent = sample.key
            self._put("arm_state", _fill(self._measured, sample, sample, sample.rate))

    def answered(self, sample, enabled):
        """Write what observer and controller computed from a sample."""
        loop, core, key = self._loop, self._loop.observer, sample.key
        if (*key, loop.controller.reason) == self._answered:
            return
        self._answered = (*key, loop.controller.reason)
        if loop.estimated.key == key:  # otherwise the observer has refused it
            message = _fill(self._estimate, sample, core, loop.estimated.rate)
            self._put("arm_state_estimate", message)
            health = core.gauges and core.gauges.health
            message = self._observed.fill(
                sample, self._observer, core.observer, sample.strain, health
            )
            self._put("observer/state", message)
        self._put("joint_torque", self._torque.answer(sample, enabled, loop.controller.torque))
        # There is no callback whose computing time could be measured.
        self._put("controller/state", self._state.fill(sample, loop.controller, math.nan))

    def _put(self, topic, message):
        self._bag.write(topic, self._loop.simulator.stamp_ns, bytes(serialize_message(message)))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._loop.bag = None
        self._bag.close()


def _fill(writer, sample, source, rate):
    """An `ArmState` of a sample; joint and modal values from `source`."""
    writer.head(sample.stamp_ns, sample.session, sample.sequence)
    writer.write("joint_position", source.position)
    known = source is not sample or sample.velocity_known
    writer.write("joint_velocity", source.velocity if known else None)
    writer.write("joint_torque", sample.torque)
    writer.write("strain", sample.strain)
    writer.write("modal_amplitude", source.amplitude)
    writer.write("modal_rate", rate)
    return writer.message
