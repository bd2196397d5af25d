# SPDX-License-Identifier: Apache-2.0
"""Records the states of a running arm, and the torques that answer them."""

import time

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification.recording import from_messages

#: Wait for the first state [s], and for the torques of the last [s].
PATIENCE = 10.0


class Tap:
    """Keeps the raw messages of `arm_state` and `joint_torque` of one arm.

    Parameters
    ----------
    node : rclpy.node.Node
        Whose executor does not serve them: `poll` does.
    """

    def __init__(self, node):
        from flexarm_msgs.msg import ArmState, JointTorque

        from ..recording.recorder import DEEP

        self.raw = {"arm_state": [], "joint_torque": []}
        self._subscriptions = {
            topic: node.create_subscription(kind, topic, lambda raw: None, DEEP, raw=True)
            for topic, kind in (("arm_state", ArmState), ("joint_torque", JointTorque))
        }

    def poll(self):
        """Take what has come since the last call."""
        for topic, subscription in self._subscriptions.items():
            handle = subscription.handle
            with handle:
                while (taken := handle.take_message(subscription.msg_type, True)) is not None:
                    self.raw[topic].append(bytes(taken[0]))

    def publishers(self, topic):
        """How many publish a topic."""
        return self._subscriptions[topic].get_publisher_count()

    def messages(self):
        """The messages, topic to list."""
        from rclpy.serialization import deserialize_message

        return {
            topic: [deserialize_message(raw, self._subscriptions[topic].msg_type) for raw in kept]
            for topic, kept in self.raw.items()
        }


class Graph:
    """A node of this process with a `Tap`, as a context."""

    def __init__(self, name, namespace=""):
        import rclpy
        from rclpy.node import Node

        self._context = rclpy.Context()
        rclpy.init(context=self._context, args=[])
        self.node = Node(
            name,
            context=self._context,
            namespace=namespace,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self.tap = Tap(self.node)

    def wait_for(self, condition, seconds, problem):
        """Poll until `condition` holds.

        Raises
        ------
        FlexarmError
            With `problem`, after so many seconds.
        """
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise FlexarmError(problem)
            time.sleep(0.01)
            self.tap.poll()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        import rclpy

        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)


def stamp(raw):
    """Stamp of a serialised message [ns]."""
    from ..recording.recorder import raw_stamp_ns

    return raw_stamp_ns(raw)


def record(arm, seconds, namespace=""):
    """A `Recording` of so many seconds, by the stamps, of a running arm.

    Raises
    ------
    FlexarmError
        When no states come, or they stop.
    """
    if not 0.0 < seconds < 3600.0:
        raise FlexarmError(f"--live {seconds:g}: from 0 to 3600 s")
    with Graph("identify", namespace) as graph:
        states = graph.tap.raw["arm_state"]
        silence = f"no arm_state for {PATIENCE:g} s: start the driver (or simulator)"
        graph.wait_for(lambda: states, PATIENCE, silence)
        first = stamp(states[0])
        patience = PATIENCE + 5.0 * seconds
        graph.wait_for(
            lambda: stamp(states[-1]) - first >= 1e9 * seconds,
            patience,
            f"the states did not come to {seconds:g} s within {patience:g} s",
        )
        messages = graph.tap.messages()
    return from_messages(messages["arm_state"], messages["joint_torque"], arm)
