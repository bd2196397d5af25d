# SPDX-License-Identifier: Apache-2.0
"""Excitation node: `arm_state` in, `joint_torque` out in place of the controller, for identification."""

from rclpy.duration import Duration

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import parameter
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros.messages import StateReader, TorqueWriter
from flexarm_ros.node import ARM, ERROR, OK, ArmNode, run
from flexarm_ros.start import leave

from ..loop.samples import ArmSample
from ..motions import excitation_run
from ..motions.excitation_run import ExcitationRun, Stage

PARAMETERS = (
    parameter("state_timeout", 0.5, "s", 0.01, 3600.0, read_only=True).described(
        "The excitation stops after this time without a state."
    ),
    parameter("readers", 1, "-", 0, 100, read_only=True).described(
        "Number of subscribers to joint_torque to wait for before answering: the driver, and a recorder."
    ),
    parameter("recorder", "", read_only=True).described(
        "Node that must subscribe to joint_torque before a state is answered; empty: none."
    ),
)

#: Timeout for delivering the final DISABLED message.
FINAL_TIMEOUT = Duration(seconds=0.2)


def parameter_groups():
    """Declared parameters of this node, by prefix."""
    return {"": (ARM, *excitation_run.PARAMETERS, *PARAMETERS)}


class ExciteNode(ArmNode):
    """Messages to arrays, one call of `ExcitationRun`, arrays to messages."""

    def __init__(self):
        super().__init__("excite", parameter_groups())

    def build(self):
        parameters = self.parameters
        self.arm = arm_file.load(parameters["arm"])
        settings = parameters.group("", excitation_run.PARAMETERS)
        self.core = ExcitationRun(model.build(self.arm.known), settings)
        self._reader, self._sample = StateReader(self.arm), ArmSample(len(self.arm.joints))
        self._torque = TorqueWriter(self.arm)
        self._ticks, self._seen, self._reported_end = 0, False, False
        self._connected = False
        self._torque_pub = self.make_publisher(JointTorque, "joint_torque")
        self.make_control_path(self.make_subscription(ArmState, "arm_state", self._on_state))
        self.make_timer(parameters["state_timeout"] / 5.0, self._watch)

    def _on_state(self, msg):
        if not self.active:
            return
        self._ticks, self._seen = 0, True
        if not self._connected:
            self._connected = self._has_readers()
            if not self._connected:
                return
        try:
            self._reader.read(msg, self._sample)
            enabled = self.core.step(self._sample)
        except MessageError as error:
            self.core.stop(str(error))
            enabled = False
        self._torque_pub.publish(self._torque.answer(self._sample, enabled, self.core.torque))
        self._report_end()

    def _has_readers(self):
        """Whether all required readers of the torque are connected; other subscribers don't count as the recorder."""
        if self._torque_pub.get_subscription_count() < self.parameters["readers"]:
            return False
        name = self.parameters["recorder"]
        if not name:
            return True
        readers = self.get_subscriptions_info_by_topic(self._torque_pub.topic_name)
        return any(reader.node_name == name for reader in readers)

    def _report_end(self):
        """Log once how the excitation ended."""
        if self._reported_end or self.core.stage in (Stage.SETTLING, Stage.SHAKING):
            return
        self._reported_end = True
        if self.core.stage is Stage.DONE:
            self.get_logger().info("excitation complete; torque disabled")
        else:
            self.get_logger().error(f"excitation stopped: {self.core.reason}")

    def _watch(self):
        """Stop when no state has come for `state_timeout`, by the steady clock."""
        self._ticks += 1
        # Before the excitation there is no torque to disable.
        if self._ticks < 6 or not self._seen or self.core.stage is not Stage.SHAKING:
            return
        self._seen = False
        self._end(
            f"no arm_state for {self.parameters['state_timeout']:g} s: is the driver running?"
        )

    def _end(self, reason):
        self.core.stop(reason)
        self._torque_pub.publish(self._torque.answer(self._sample, False, self.core.torque))
        self._report_end()

    def start(self):
        kind = self.parameters["kind"]
        self.get_logger().info(
            f"arm {self.arm.name}: {kind} of {self.core.duration:.3g} s after rest"
        )

    def stop(self):
        self._end("the node was stopped")
        # Messages that are not delivered when a node ends are lost.
        self._torque_pub.wait_for_all_acked(FINAL_TIMEOUT)

    def diagnose(self):
        core = self.core
        values = {"stage": core.stage.value, "kind": self.parameters["kind"]}
        if core.stage is Stage.STOPPED:
            return ERROR, core.reason, values
        return OK, core.stage.value, values


def main(args=None):
    """Entry point of ``ros2 run flexarm_control excite``."""
    leave(run(ExciteNode, args))
