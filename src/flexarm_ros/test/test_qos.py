# SPDX-License-Identifier: Apache-2.0
"""Overrides of quality of service touch one topic, and what can't be used is refused by its name."""

import os

import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSReliabilityPolicy
from std_msgs.msg import Empty

from flexarm_dynamics.errors import ParameterError
from flexarm_ros import qos

RELIABLE, BEST_EFFORT = QoSReliabilityPolicy.RELIABLE, QoSReliabilityPolicy.BEST_EFFORT


@pytest.fixture(scope="module")
def publisher(domain):
    """Makes a publisher of /t, with overrides of its policies."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    nodes = []

    def publisher(**policies):
        name = "qos_overrides./t.publisher."
        given = [RosParameter(name + k, value=v) for k, v in policies.items()]
        node = Node(
            f"q{len(nodes)}", context=context, parameter_overrides=given, enable_rosout=False
        )
        nodes.append(node)

        def create(profile):
            options = qos.overridable()
            return node.create_publisher(Empty, "t", profile, qos_overriding_options=options)

        return qos.made(create, "t", qos.CONTROL_PATH)

    yield publisher
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_an_override_is_taken_and_the_shared_profile_stays(publisher):
    made = publisher(reliability="best_effort", depth=7, durability="transient_local")
    profile = made.qos_profile
    assert (profile.reliability, profile.depth) == (BEST_EFFORT, 7)
    assert profile.durability != qos.CONTROL_PATH.durability
    assert (qos.CONTROL_PATH.reliability, qos.CONTROL_PATH.depth) == (RELIABLE, 1)
    assert publisher().qos_profile == qos.CONTROL_PATH


@pytest.mark.parametrize(
    ("policies", "reason"),
    [({"reliability": "nonsense"}, "nonsense"), ({"depth": "deep"}, "expecting type 'INTEGER'")],
)
def test_an_override_that_cannot_be_used_names_the_topic(publisher, policies, reason):
    with pytest.raises(ParameterError, match=f"quality of service of t: .*{reason}"):
        publisher(**policies)


def test_advice_says_what_to_change_on_either_side():
    subscribing = qos.advice("/a/s", "reliability", publishes=False)
    assert "have it offer reliable" in subscribing
    assert subscribing.endswith("-p qos_overrides./a/s.subscription.reliability:=best_effort")
    publishing = qos.advice("/a/s", "durability", publishes=True)
    assert "have it ask for volatile" in publishing
    assert publishing.endswith("-p qos_overrides./a/s.publisher.durability:=transient_local")
    assert "qos_overrides" not in qos.advice("/d", "durability", publishes=True, overrides=False)
    assert "give both ends the same deadline" in qos.advice("/d", "deadline", publishes=True)
