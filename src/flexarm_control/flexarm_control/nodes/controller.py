# SPDX-License-Identifier: Apache-2.0
"""Controller node: `arm_state_estimate` and `joint_trajectory` in, `joint_torque` and `controller/state` out."""

import sys
from time import perf_counter

from rclpy.duration import Duration
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import sizes
from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_ros import cdr, qos, scheduling
from flexarm_ros.messages import CompositeStateWriter, StateReader, TorqueWriter
from flexarm_ros.node import ArmNode, run
from flexarm_ros.start import leave

from ..composite import assembly
from ..composite.designer import Designer
from ..loop.arm_controller import ArmController
from ..loop.samples import ArmSample
from ..robust.default import default, is_cached, is_wanted, task
from . import controller_parameters
from .controller_designs import Designs
from .controller_report import Report
from .trajectory_inbox import TrajectoryInbox
from .trajectory_state import TrajectoryState

#: Timeout for delivering the final DISABLED message.
LAST_MESSAGE_TIMEOUT = Duration(seconds=0.2)

parameter_groups = controller_parameters.groups


class ControllerNode(ArmNode):
    """Messages to arrays, one call of `ArmController`, arrays to messages."""

    def __init__(self):
        super().__init__("controller", parameter_groups())
        # A thread that designs gives the interpreter's lock to the control path within this time; the default is 5 ms.
        sys.setswitchinterval(1e-4)
        self._workers = ()

    def build(self):
        parameters, log = self.parameters, self.get_logger()
        self.arm = arm = arm_file.load(parameters["arm"])
        self.model = model.build(arm.known)
        parameters.resolve(sizes(self.model))
        self._close_workers()
        process = parameters["design_process"]
        designer = Designer(self.model, log.warning, process, scheduling.spare())
        self._workers = (designer,)
        self.design = self._default(designer)
        values = parameters.values()
        law = assembly.control(self.model, values)
        for warning in law.warnings():
            log.warning(warning)
        limits = controller_parameters.of_limits(values)
        self.core = ArmController(self.model, law, limits, parameters["start_tolerance"])
        self.core.warm_up()
        self._report = Report(self, self.core, self.design)
        self._inbox = TrajectoryInbox(self, self.core, designer)
        self._designs = Designs(self, self.core, designer)
        self._workers = designer, self._designs, self._inbox
        self._states, self._reader = cdr.Reader(ArmState), StateReader(arm)
        self._sample = ArmSample(len(arm.joints), self.model.n_modes)
        self._torque = TorqueWriter(arm)
        self._torque_bytes = cdr.Writer(self._torque.message)
        self.core.controller_id = self._torque.message.controller_id
        self._state = CompositeStateWriter(self.model)
        self._synchronised = parameters["synchronised_clocks"]
        self._ticks, self._seen = 0, False
        self._make_topics()

    def _default(self, designer):
        """The `Default` for an arm without laws, with its parameters adopted; None for an arm with laws."""
        parameters, arm = self.parameters, self.arm
        if not is_wanted(parameters["arm"], parameters.given, parameters["design.type"]):
            return None
        wanted = task(arm, parameters.values())

        def make():
            return default(arm, *wanted, lambda _, *task: designer.find(*task))

        if not is_cached(arm, *wanted):
            designer.start()  # in this thread: the process ends with the thread that starts it
        found = self.wait_for(make, f"designing the control of {arm.name}")
        parameters.adopt(found.parameters)
        return found

    def _close_workers(self):
        for worker in self._workers:
            worker.close()
        self._workers = ()

    def _make_topics(self):
        self._torque_pub = self.make_publisher(JointTorque, "joint_torque")
        self._state_pub = self.make_publisher(CompositeState, "controller/state")
        states = self.make_subscription(ArmState, "arm_state_estimate", self._on_state, raw=True)
        self.make_control_path(states)
        # fmt: off
        self.make_subscription(
            JointTrajectory, "joint_trajectory", self._inbox.receive, qos.COMMAND, raw=True,
            qos_overriding_options=qos.overridable(),
        )
        # fmt: on
        self.make_service(Trigger, "~/stop", self._on_stop)
        self.make_service(Trigger, "~/recover", self._on_recover)
        self.make_service(SetBool, "~/enable_fast", self._on_enable_fast)
        self.make_timer(self.parameters["state_timeout"] / 5.0, self._watch)
        TrajectoryState(self, self.core, self._sample)

    # Control path ----------------------------------------------------------------------------

    def _on_state(self, raw):
        if not self.active:
            return
        started = perf_counter()
        sample, core = self._sample, self.core
        try:
            self._reader.read(self._states(raw), sample)
            now = self.get_clock().now().nanoseconds if self._synchronised else None
            enabled = core.step(sample, now)
        except MessageError as error:
            core.distrust(str(error))
            enabled = False
        if enabled is None:
            return
        if core.alive:
            self._ticks, self._seen = 0, True
        self._send(enabled)
        took = perf_counter() - started
        if self._state_pub.get_subscription_count():
            self._state_pub.publish(self._filled(took))
        self._report.answered(took)
        if enabled:
            core.answered_by.look_ahead()
            core.learn()
            if (payload := core.payload_wanted) is not None:
                self._designs.carry(payload)

    def _watch(self):
        """Notice, by the steady clock, that the states have stopped."""
        self._ticks += 1
        if self._ticks < 6 or not self._seen or not self.active:
            return
        self._seen = False
        timeout = self.parameters["state_timeout"]
        self.core.distrust(
            f"no arm_state_estimate for {timeout:g} s: are the driver (or simulator) and the observer"
            " running?"
        )
        self._answer_again()

    def _send(self, enabled):
        """Publish the torque, or that there is none, as the answer to the last state."""
        self._torque.answer(self._sample, enabled, self.core.torque)
        self._torque_pub.publish(self._torque_bytes())

    def _filled(self, took):
        """controller/state as it is now; `took` [s]."""
        return self._state.fill(self._sample, self.core, took, self._designs.last_change)

    def _answer_again(self):
        """Publish torque and controller/state again as answers to the last state, since they have changed."""
        self._send(self.core.enabled)
        self._state_pub.publish(self._filled(0.0))
        self._report.log_state()

    # Services --------------------------------------------------------------------------------

    def _on_stop(self, request, response):
        core = self.core
        response.success = True
        if core.brake("~/stop was called"):
            response.message = f"{core.state.name}: the arm is brought to rest and held"
        else:
            response.message = f"{core.state.name}: there is no torque, the safe action acts"
        return response

    def _on_recover(self, request, response):
        was = self.core.supervisor.reason
        response.success = self.core.recover()
        if response.success:
            response.message = f"left the fault ({was}): torque with the next valid state"
            self.get_logger().info(response.message)
            self._answer_again()
        else:
            response.message = f"not in fault: {self.core.state.name}"
        return response

    def _on_enable_fast(self, request, response):
        self.core.enable_fast(request.data)
        response.success = True
        response.message = f"fast control {'on' if request.data else 'off: the arm rings'}"
        self.get_logger().info(response.message)
        return response

    # Life cycle ------------------------------------------------------------------------------

    def start(self):
        self._inbox.warm_up()
        slow, fast = self.parameters["slow.type"], self.parameters["fast.type"]
        self.get_logger().info(
            f"arm {self.arm.name}, {'designed: ' if self.design else ''}slow {slow}, fast {fast}: torque with the first"
            " valid state"
        )

    def stop(self):
        self.core.disable("the controller was stopped")
        self._send(False)
        # Messages that are not delivered when a node ends are lost.
        self._torque_pub.wait_for_all_acked(LAST_MESSAGE_TIMEOUT)

    def destroy_node(self):
        """End the threads and the process of the designs, then the node."""
        self._close_workers()
        super().destroy_node()

    def diagnose(self):
        return self._report.diagnose(self._designs.last_change)


def main(args=None):
    """Entry point of ``ros2 run flexarm_control controller``."""
    leave(run(ControllerNode, args))
