# SPDX-License-Identifier: Apache-2.0
"""Sets the quality of service on the control path: reliable, volatile, newest sample only; parameters override it.

A publisher and a subscription with incompatible policies exchange nothing, without an error: `Mismatches` reports them.
"""

import copy
from dataclasses import dataclass

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSPolicyKind,
    QoSProfile,
    QoSReliabilityPolicy,
)
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions

from flexarm_dynamics.errors import ParameterError

CONTROL_PATH = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.VOLATILE,
)

#: For trajectories: when several are sent at once, none may be lost.
COMMAND = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.VOLATILE,
)

#: What a parameter ``qos_overrides.<topic>.<publisher|subscription>.<policy>`` may change.
OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)
#: Policies of which a publisher may offer less than a subscription requests: (lower value, higher value).
VALUES = {"reliability": ("best_effort", "reliable"), "durability": ("volatile", "transient_local")}


def overridable():
    """Let a user change the policies by ``qos_overrides.<topic>.<publisher|subscription>.…``."""
    return QoSOverridingOptions(OVERRIDABLE)


def made(create, topic, profile):
    """Call ``create(profile)`` for a publisher or subscription of `topic` with a profile of its own.

    rclpy writes overrides into the profile that it is given; if topics shared a profile, the others would get them,
    too.

    Raises
    ------
    ParameterError
        For an override that can't be used.
    """
    try:
        return create(copy.copy(profile))
    except (RuntimeError, ParameterException, InvalidQosOverridesError) as error:
        raise ParameterError(f"quality of service of {topic}: {error}") from error


def advice(topic, policy, publishes, overrides=True):
    """What is wrong between the two ends of a topic, and what to change.

    Parameters
    ----------
    topic : str
        With its namespace.
    policy : str
        Such as "reliability".
    publishes : bool
        Whether this node's end is the publisher.
    overrides : bool
        Whether this end has ``qos_overrides`` parameters.
    """
    other = "subscriber" if publishes else "publisher"
    if policy not in VALUES:
        return f"nothing is exchanged with a {other} of {topic}: give both ends the same {policy}"
    less, more = VALUES[policy]
    if publishes:
        text = (
            f"a subscriber of {topic} gets nothing: it asks for {policy} {more}, offered is {less};"
        )
        text += f" have it ask for {less}"
        here = f"publisher.{policy}:={more}"
    else:
        text = f"nothing comes from a publisher of {topic}: it offers {policy} {less}, asked for is {more};"
        text += f" have it offer {more}"
        here = f"subscription.{policy}:={less}"
    if overrides:
        text += f", or start this node with -p qos_overrides.{topic}.{here}"
    return text


@dataclass
class _Mismatch:
    end: object  # publisher or subscription of this node
    policy: str
    publishes: bool
    text: str
    seen: bool = False  # whether the other end has been found in the graph


class Mismatches:
    """Publishers and subscriptions of other nodes that are incompatible with those of a `node`."""

    def __init__(self, node):
        self._node = node
        self._found = {}

    def callbacks(self, publishes, overrides):
        """Event callbacks for a new publisher or subscription, and the function that takes it once it exists."""
        ends = []

        def incompatible(event):
            if ends:  # destroyed ends have no more events
                policy = QoSPolicyKind(int(event.last_policy_kind)).name.lower()
                self._note(ends[0], policy, publishes, overrides)

        kind = PublisherEventCallbacks if publishes else SubscriptionEventCallbacks
        return kind(incompatible_qos=incompatible), ends.append

    def _note(self, end, policy, publishes, overrides):
        topic = end.topic_name
        key = topic, policy, publishes
        if key not in self._found:
            text = advice(topic, policy, publishes, overrides)
            self._found[key] = _Mismatch(end, policy, publishes, text)
            self._node.get_logger().warning(text)

    def forget(self, ends):
        """Forget publishers and subscriptions that are destroyed."""
        gone = {id(end) for end in ends}
        self._found = {k: m for k, m in self._found.items() if id(m.end) not in gone}

    def texts(self):
        """The present mismatches, by topic, without those that were fixed or whose other end has left."""
        self._found = {k: m for k, m in self._found.items() if self._lasts(m)}
        return {topic: m.text for (topic, _, _), m in self._found.items()}

    def _lasts(self, mismatch):
        """Whether an incompatible other end still exists; an end that is not discovered yet counts."""
        node, end = self._node, mismatch.end
        look = (
            node.get_subscriptions_info_by_topic
            if mismatch.publishes
            else node.get_publishers_info_by_topic
        )
        there = any(
            _apart(mismatch.policy, end.qos_profile, other.qos_profile)
            for other in look(end.topic_name)
        )
        gone = mismatch.seen and not there
        mismatch.seen |= there
        return not gone


def _apart(policy, own, other):
    """Whether these may be the two ends that don't match in a policy; policies with an order are compared by value."""
    return policy not in VALUES or getattr(own, policy) != getattr(other, policy)
