# SPDX-License-Identifier: Apache-2.0
"""Observer and controller in one process: the estimate reaches the controller by a call, not by a message.

The two nodes are those of `observer` and `controller`, with their names, parameters, services and topics. Only the
subscription to `arm_state_estimate` is missing. The topic is published after the torque, if it has subscribers.
"""

from flexarm_ros.node import run
from flexarm_ros.start import leave

from .controller import ControllerNode
from .observer import ObserverNode

ESTIMATE = "arm_state_estimate"


class CalledController(ControllerNode):
    """The controller, which is handed each estimate by `take`."""

    def make_subscription(self, kind, topic, callback, *args, **kwargs):
        if topic == ESTIMATE:
            self.take = callback
            return None
        return super().make_subscription(kind, topic, callback, *args, **kwargs)

    def make_control_path(self, subscription, *args, **kwargs):
        # The control path of this process is the observer's subscription.
        if subscription is not None:
            super().make_control_path(subscription, *args, **kwargs)

    def take(self, message):
        """Take an estimate; when the node is configured, its callback replaces this method."""


class Handover:
    """Takes the place of the publisher of estimates.

    Parameters
    ----------
    publisher : Publisher
    controller : CalledController
    """

    def __init__(self, publisher, controller):
        self._publisher, self._controller = publisher, controller

    def publish(self, message):
        """Have the controller answer, then publish if the topic has subscribers."""
        self._controller.take(message)
        if self._publisher.get_subscription_count():
            self._publisher.publish(message)


class CallingObserver(ObserverNode):
    """The observer, which calls a controller of this process with each estimate.

    Parameters
    ----------
    controller : CalledController
    """

    def __init__(self, controller):
        super().__init__()
        self._controller = controller

    def make_publisher(self, kind, topic, *args, **kwargs):
        publisher = super().make_publisher(kind, topic, *args, **kwargs)
        return Handover(publisher, self._controller) if topic == ESTIMATE else publisher


def nodes():
    """Both nodes; the controller is ready before the observer sends it anything."""
    controller = CalledController()
    return controller, CallingObserver(controller)


def main(args=None):
    """Entry point of ``ros2 run flexarm_control observer_controller``."""
    leave(run(nodes, args))
