# SPDX-License-Identifier: Apache-2.0
"""Node `hardware`: the simulated arm behind drives, as the hardware of third-party controllers.

It receives and publishes `sensor_msgs/JointState` as ``joint_state_topic_hardware_interface`` of ros2_control needs
them. It is mock hardware whose links bend, and into which faults can be put.
"""

import time
from array import array

from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import parameter
from flexarm_ros import qos
from flexarm_ros.messages import StateWriter
from flexarm_ros.node import ERROR, OK, WARN, ArmNode, run
from flexarm_ros.start import leave

from .. import position_loop, simulator
from ..position_loop import PositionLoop
from . import faults

OWN = (
    parameter("joint_commands_topic", "robot_joint_commands", read_only=True).described(
        "Topic of the commands, as the parameter of the same name of joint_state_topic_hardware_interface."
    ),
    parameter("joint_states_topic", "robot_joint_states", read_only=True).described(
        "Topic of the states, likewise."
    ),
    parameter("lockstep", False, read_only=True).described(
        "Advance by one command period per command, as fast as commands come; false: real time."
    ),
)
PARAMETERS = (*simulator.PARAMETERS, *position_loop.PARAMETERS, *faults.PARAMETERS, *OWN)
#: At most this much lost real time is caught up [s].
BEHIND = 0.1


class HardwareNode(ArmNode):
    """Commands to the drives, periods of the simulated arm, states back."""

    def __init__(self):
        self.faults = None
        super().__init__("hardware", {"": PARAMETERS})
        self.add_on_set_parameters_callback(lambda new: faults.check(self.faults, new))

    def build(self):
        parameters = self.parameters
        self.arm = arm_file.load(parameters["arm"])
        parameters.resolve({"joints": len(self.arm.joints), "gauges": len(self.arm.gauges)})
        settings = parameters.values()
        self.sim = simulator.Simulator(parameters.group("", simulator.PARAMETERS))
        period = 1e-9 * self.sim.period_ns
        self.drives = PositionLoop(model.build(self.arm.known), period, settings)
        self.drives.begin(self.sim.position)
        self.faults = faults.Faults(self.arm, parameters)
        parameters.on_change(self._changed)
        self._samples = max(round(1.0 / (parameters["command_rate"] * period)), 1)
        self._writer, self._refused, self._commands, self._counted = StateWriter(self.arm), 0, 0, 0
        self._states = self.make_publisher(
            JointState,
            parameters["joint_states_topic"],
            qos.COMMAND,
            qos_overriding_options=qos.overridable(),
        )
        self._strains = self.make_publisher(
            Float64MultiArray, "strain", qos.COMMAND, qos_overriding_options=qos.overridable()
        )
        self.make_subscription(
            JointState,
            parameters["joint_commands_topic"],
            self._on_command,
            qos.COMMAND,
            qos_overriding_options=qos.overridable(),
        )
        if not parameters["lockstep"]:
            self.make_timer(self._samples * period, self._on_period)

    def _changed(self, names):
        if "faults" in names:
            self.faults.set(self.parameters["faults"])

    def start(self):
        self._due = time.monotonic()
        self.get_logger().info(
            f"arm {self.arm.name} behind drives: commands on {self.parameters['joint_commands_topic']}, states on"
            f" {self.parameters['joint_states_topic']}"
        )
        self._publish()

    # Commands in -------------------------------------------------------------------------------

    def _on_command(self, message):
        if not self.active:
            return
        try:
            self.drives.command(self.sim.time, *self._ordered(message))
        except MessageError as error:
            self._refused += 1
            self.report(f"command refused, the last one goes on: {error}")
            return
        self._commands += 1
        if self.parameters["lockstep"]:
            self._advance()

    def _ordered(self, message):
        """Position, velocity and effort of a command in the arm's order; None where a field is empty."""
        names = list(message.name)
        missing = [name for name in self.arm.joint_names if name not in names]
        if missing:
            raise MessageError(
                "is missing", field="name", value=missing[0], limit=", ".join(self.arm.joint_names)
            )
        order = [names.index(name) for name in self.arm.joint_names]
        out = []
        for field in ("position", "velocity", "effort"):
            values = getattr(message, field)
            if len(values) not in (0, len(names)):
                raise MessageError(
                    "values", field=field, value=len(values), limit=f"{len(names)} names"
                )
            out.append([values[i] for i in order] if len(values) else None)
        return out

    # States out --------------------------------------------------------------------------------

    def _on_period(self):
        """Real time: advance by as many periods as have passed, as far as `BEHIND` allows."""
        if not self.active:
            return
        now, period = time.monotonic(), self._samples * 1e-9 * self.sim.period_ns
        self._due = max(self._due, now - BEHIND)
        while self._due <= now:
            self._due += period
            self._advance()

    def _advance(self):
        """Advance by one period of the commands, and publish the state after it."""
        for _ in range(self._samples):
            self.sim.advance_with(self.drives.drive)
        self._publish()

    def _publish(self):
        sim, writer = self.sim, self._writer
        writer.head(sim.stamp_ns, 1, sim.sequence)
        writer.write("joint_position", sim.position)
        writer.write("joint_velocity", sim.velocity)
        writer.write("joint_torque", sim.torque)
        writer.write("strain", sim.strain)
        for sent in self.faults.outgoing(writer.message, sim.time):
            state = JointState(name=list(sent.joint_names))
            state.header.stamp = (
                sent.header.stamp if self.parameters["lockstep"] else self._now().to_msg()
            )
            state.position, state.velocity = sent.joint_position, sent.joint_velocity
            state.effort = sent.joint_torque
            self._strains.publish(Float64MultiArray(data=array("d", sent.strain)))
            self._states.publish(state)

    def diagnose(self):
        came, self._counted = self._commands - self._counted, self._commands
        values = {
            "commands per second": came,
            "commands refused": self._refused,
            "simulated time [s]": f"{self.sim.time:.3f}",
            "torque at its limit": ", ".join(
                name
                for name, at in zip(self.arm.joint_names, self.drives.saturated, strict=True)
                if at
            )
            or "-",
        }
        if str(self.faults):
            values["faults"] = str(self.faults)
        if self.sim.range.warning:
            return ERROR, self.sim.range.warning, values
        if not self._commands:
            return WARN, "no command yet: the drives hold the arm", values
        return OK, "", values


def main(args=None):
    """Entry point of ``ros2 run flexarm_sim hardware``."""
    leave(run(HardwareNode, args))
