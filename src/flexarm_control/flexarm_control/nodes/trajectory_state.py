# SPDX-License-Identifier: Apache-2.0
"""Topics and services of a joint_trajectory_controller beside its action: state, reference, and speed scaling.

They always exist in our own types. If control_msgs is installed, they also exist in its types, under the names that
such a controller has.
"""

import importlib

import numpy as np
from rclpy.parameter import Parameter
from trajectory_msgs.msg import JointTrajectoryPoint

from flexarm_dynamics.parameters import parameter
from flexarm_msgs.msg import JointTrajectoryControllerState
from flexarm_msgs.srv import QueryTrajectoryState
from flexarm_ros import qos
from flexarm_ros.messages import set_stamp, stamp_ns

STATE_PUBLISH_RATE = parameter(
    "state_publish_rate", 50.0, "Hz", 0.1, 1000.0, read_only=True
).described("Rate of trajectory_state and controller_state (wall time), while subscribed.")


def states():
    """Types and names of the topics of the state."""
    yield JointTrajectoryControllerState, "trajectory_state"
    if (theirs := _theirs("msg", "JointTrajectoryControllerState")) is not None:
        yield theirs, "controller_state"


def queries():
    """Types and names of the services that give the reference at a time."""
    yield QueryTrajectoryState, "query_trajectory_state"
    if (theirs := _theirs("srv", "QueryTrajectoryState")) is not None:
        yield theirs, "query_state"


def _theirs(module, name):
    """A type of control_msgs; None if it is not installed."""
    try:
        return getattr(importlib.import_module(f"control_msgs.{module}"), name, None)
    except ImportError:
        return None


class TrajectoryState:
    """The topics and services of a controller node.

    Parameters
    ----------
    node : ArmNode
        The controller.
    core : ArmController
    sample : ArmSample
        The state that it answered last.
    """

    def __init__(self, node, core, sample):
        self._node, self._core, self._sample = node, core, sample
        self._publishers = [
            (
                kind,
                node.make_publisher(
                    kind,
                    f"controller/{name}",
                    qos.COMMAND,
                    qos_overriding_options=qos.overridable(),
                ),
            )
            for kind, name in states()
        ]
        for kind, name in queries():
            node.make_service(kind, f"~/{name}", self._answer)
        if (kind := _theirs("msg", "SpeedScalingFactor")) is not None:
            node.make_subscription(
                kind,
                "controller/speed_scaling_input",
                self._scale,
                qos.COMMAND,
                qos_overriding_options=qos.overridable(),
            )
        node.make_timer(1.0 / node.parameters["state_publish_rate"], self._publish)

    def _publish(self):
        if self._core.reference.stamp_ns is None:
            return
        for kind, publisher in self._publishers:
            if publisher.get_subscription_count():
                publisher.publish(self._filled(kind()))

    def _filled(self, message):
        """The message with the controller's present state."""
        core, view = self._core, self._core.view()
        set_stamp(message.header.stamp, core.reference.stamp_ns)
        message.joint_names = list(core.model.joint_names)
        position, velocity = view["reference_position"], view["reference_velocity"]
        measured, rate = self._sample.position, self._sample.velocity
        message.reference = _point(position, velocity, view["reference_acceleration"])
        message.feedback = _point(measured, rate)
        message.error = _point(position - measured, velocity - rate)
        message.output = _point(effort=core.torque)
        if hasattr(message, "speed_scaling_factor"):
            message.speed_scaling_factor = float(core.reference.rate)
        return message

    def _answer(self, request, response):
        """Answer where the reference is at a time."""
        core, stamp = self._core, stamp_ns(request.time)
        last = core.reference.stamp_ns
        state = None if last is None else core.reference.look_at(stamp)
        response.success = state is not None and stamp >= last
        if state is None:
            response.message = "there is no reference yet: the controller has no valid state"
        elif stamp < last:
            response.message = f"{stamp} ns is past: the arm's clock shows {last} ns"
        else:
            response.name = list(core.model.joint_names)
            response.position, response.velocity, response.acceleration = state.tolist()
        return response

    def _scale(self, message):
        """Take a factor from the topic, as if the parameter were set."""
        given = Parameter("speed_scaling", value=float(message.factor))
        result = self._node.set_parameters([given])[0]
        if not result.successful:
            self._node.report(f"speed_scaling_input: {result.reason}")


def _point(position=(), velocity=(), acceleration=(), effort=()):
    values = (np.asarray(v, float).tolist() for v in (position, velocity, acceleration, effort))
    names = ("positions", "velocities", "accelerations", "effort")
    return JointTrajectoryPoint(**dict(zip(names, values, strict=True)))
