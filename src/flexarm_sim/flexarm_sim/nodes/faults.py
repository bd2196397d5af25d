# SPDX-License-Identifier: Apache-2.0
"""Handles the parameter `faults` of the simulator node, and the messages that it changes."""

from array import array

import numpy as np
from rcl_interfaces.msg import SetParametersResult

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import parameter
from flexarm_msgs.msg import ArmState
from flexarm_ros.messages import set_stamp, stamp_ns

from ..fault_injector import FIELDS, FaultInjector, Sample

PARAMETERS = (
    parameter("allow_faults", False, read_only=True).described(
        "Whether `faults` may be set, for tests of the nodes behind the simulator."
    ),
    parameter("faults", [], kind="string_array").described(
        'Faults put into arm_state, each "SIGNAL KIND [key=value ...]": docs/fault_injection.md.'
    ),
)


class Faults:
    """Turns the message of a sample into those that are published.

    Parameters
    ----------
    arm : Arm
    parameters : mapping
        Values of `PARAMETERS`.

    Attributes
    ----------
    restarted : bool
        Whether the last messages are the first of another session: the driver acts as if it had restarted.

    Raises
    ------
    ParameterError
        For faults that can't be used, or that are not allowed.
    """

    def __init__(self, arm, parameters):
        self.arm, self._parameters = arm, parameters
        self._injector = FaultInjector(arm)
        self.set(parameters["faults"])

    def __str__(self):
        return "; ".join(str(f) for f in self._injector.faults)

    def set(self, lines):
        """Replace the faults, all or none."""
        self._injector.set(self.allowed(lines))
        self.restarted, self._restarts = False, 0

    def allowed(self, lines):
        """The lines, if faults are allowed."""
        if lines and not self._parameters["allow_faults"]:
            hint = "start the simulator with allow_faults:=true to set them"
            raise ParameterError("not allowed", field="faults", hint=hint)
        return lines

    def reset(self):
        """Begin a new session: the times of the faults start again."""
        self._injector.reset()
        self.restarted, self._restarts = False, 0

    def outgoing(self, message, time):
        """The messages to publish for a true one: the true one, or what the faults make of it.

        `time` is that since the start of the session [s].
        """
        if not self._injector.faults:
            self.restarted = False
            return [message]
        names = {key: getattr(message, key) for key in set(FIELDS.values())}
        values = {
            key: np.array(getattr(message, key)) if len(getattr(message, key)) else None
            for key in FIELDS
        }
        true = Sample(message.sequence, stamp_ns(message.header.stamp), names, values)
        before, samples = self._restarts, self._injector.outgoing(true, time)
        self._restarts = self._injector.session
        self.restarted = self._restarts != before
        return [_message(message, sample, sample.session - before) for sample in samples]


def check(faults, parameters):
    """ROS callback: refuse faults that can't be set; types are checked elsewhere.

    `faults` is the node's `Faults`, None before it is configured; `parameters` are those to be set.
    """
    for given in parameters:
        lines = given.value if given.name == "faults" else None
        texts = isinstance(lines, list) and lines and all(isinstance(x, str) for x in lines)
        if faults is not None and texts:
            try:
                FaultInjector(faults.arm, faults.allowed(lines))
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def _message(true, sample, later):
    """A new `ArmState` with the values of a faulty sample, and a session number larger by `later` than the true one."""
    session = (true.session + later) % 2**32
    message = ArmState(session=session, sequence=sample.sequence)
    message.controller_id, message.trust, message.doubt = (
        true.controller_id,
        true.trust,
        true.doubt,
    )
    message.header.frame_id = true.header.frame_id
    set_stamp(message.header.stamp, sample.stamp_ns)
    for key, names in sample.names.items():
        setattr(message, key, names)
    for key, values in sample.values.items():
        setattr(message, key, array("d", () if values is None else values))
    return message
