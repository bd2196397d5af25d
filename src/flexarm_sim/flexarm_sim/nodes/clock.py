# SPDX-License-Identifier: Apache-2.0
"""Publishes `/clock`, simulated time for nodes with `use_sim_time`, unless another node publishes it."""

from rosgraph_msgs.msg import Clock as Message

from flexarm_dynamics.parameters import parameter
from flexarm_ros.driver import Thinned
from flexarm_ros.messages import set_stamp

PARAMETERS = (
    parameter("clock_rate", 100.0, "Hz", 0.0, 20000.0, read_only=True).described(
        "Rate of /clock, in simulated time; at most the control rate. It is published unless another node publishes"
        " it; of several simulators, the first by name publishes. 0: never."
    ),
)
TOPIC = "/clock"
#: Time between two checks for other publishers [s].
LOOK = 1.0
ARM_STATE = "flexarm_msgs/msg/ArmState"


class Clock:
    """Publishes the stamps of a simulator's samples.

    Parameters
    ----------
    node : SimulatorNode
    rate : float
        [Hz], greater than 0.
    """

    def __init__(self, node, rate):
        self._node, self._message = node, Message()
        self._due = Thinned(rate)
        self._publisher = node.make_publisher(Message, TOPIC, 10)
        self._silent = False
        self.look()
        node.make_timer(LOOK, self.look)

    def publish(self, stamp_ns, first):
        """Publish a stamp [ns] if it is due and has subscribers; `first` of a session: time may have gone back."""
        due = self._due(stamp_ns, first) and not self._silent
        if due and self._publisher.get_subscription_count():
            set_stamp(self._message.clock, stamp_ns)
            self._publisher.publish(self._message)

    def look(self):
        """Check which other nodes publish the clock."""
        node = self._node
        own = node.get_namespace(), node.get_name()
        ends = node.get_publishers_info_by_topic(TOPIC)
        # Before a node's name is known, its namespace is a word without a slash.
        others = {(end.node_namespace, end.node_name) for end in ends} - {own}
        others = {who for who in others if who[0].startswith("/")}
        ahead = sorted(who for who in others if not goes_first(own, who, self._simulates(who)))
        if bool(ahead) != self._silent:
            self._silent = bool(ahead)
            name = "/".join(ahead[0]).replace("//", "/") if ahead else ""
            text = f"{name} publishes /clock, this node does not" if ahead else "publishes /clock"
            node.get_logger().info(text)

    def _simulates(self, who):
        """Whether a node, as (namespace, name), is a simulator of flexarm: it publishes `arm_state`."""
        try:
            topics = self._node.get_publisher_names_and_types_by_node(who[1], who[0])
        except RuntimeError:  # rclpy's, for a name that the graph does not know
            return False
        return any(ARM_STATE in types for _, types in topics)


def goes_first(own, other, simulates):
    """Whether a simulator goes before another publisher of the clock.

    Parameters
    ----------
    own, other : tuple of str
        Namespace and name.
    simulates : bool
        Whether the other is such a simulator, too; it then decides the opposite.
    """
    return simulates and own < other
