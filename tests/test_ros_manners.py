# SPDX-License-Identifier: Apache-2.0
"""What ROS users count on: namespaces apart, incompatible QoS is reported, use_sim_time without a /clock."""

import time
from itertools import pairwise

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from harness import Arm, Bench
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rosgraph_msgs.msg import Clock

from flexarm_msgs.msg import ArmState, JointTorque

STARTED = time.time()
LINE = ("simulator", "observer", "controller")
BEST_EFFORT = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)
TRANSIENT_LOCAL = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
#: One topic of one node is overridden; all the others keep their profiles.
OVERRIDE = {"qos_overrides./b/observer/state.publisher.durability": "transient_local"}


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """Two arms in lockstep, in namespaces a and b, both pausing at a sample, with a ROS time that stands."""
    common = {"arm": "R", "fast.type": "none", "use_sim_time": True, "lockstep": True}
    with Bench(tmp_path_factory.mktemp("log")) as bench:
        for side in "ab":
            for name in LINE:
                own = {"pause_at": 0.1, "state_timeout": 60.0, **OVERRIDE}
                if name == "simulator":
                    own["clock_rate"] = 0.0
                key = f"{side}_{name}"
                bench.start(name, {**common, **own}, key=key, remaps=[f"__ns:=/{side}"])
        pair = Arm(bench, "a/", pauses_at=100), Arm(bench, "b/", pauses_at=100)

        def stand():
            return all(arm.ready() and arm.state.sequence == arm.pauses_at for arm in pair)

        bench.wait_for("both arms to stand", stand, patience=4 * bench.PATIENCE)  # six processes
        yield pair


def logged(bench, text):
    """Lines of the log of b's observer that have a text in them."""
    return [line for line in bench.log("b_observer").splitlines() if text in line]


def shown(bench):
    """The newest diagnostics of b's observer, in an array."""
    return bench.diagnostics("b/observer")[-1]


def test_an_end_of_a_topic_with_incompatible_qos_is_logged_once_and_shown_until_it_leaves(arms):
    bench = arms[0].bench
    bench.wait_for("diagnostics", lambda: bench.diagnostics("b/observer"))
    assert not logged(bench, "qos_overrides")
    publisher = bench.node.create_publisher(ArmState, "b/arm_state", BEST_EFFORT)
    subscription = bench.node.create_subscription(
        ArmState, "b/arm_state_estimate", lambda message: None, TRANSIENT_LOCAL
    )
    names = {
        "incompatible QoS on /b/arm_state": "-p qos_overrides./b/arm_state.subscription.reliability:=best_effort",
        "incompatible QoS on /b/arm_state_estimate": "-p qos_overrides./b/arm_state_estimate.publisher.durability"
        ":=transient_local",
    }

    def both():
        values = {v.key: v.value for v in shown(bench).values}
        return all(what in values.get(name, "") for name, what in names.items())

    bench.wait_for("both in the diagnostics", both)
    assert shown(bench).level >= DiagnosticStatus.WARN
    assert all(what in shown(bench).message for what in names.values())
    seen = len(bench.diagnostics("b/observer"))
    bench.wait_for("two more", lambda: len(bench.diagnostics("b/observer")) > seen + 1)
    assert [len(logged(bench, what)) for what in names.values()] == [1, 1]
    bench.node.destroy_publisher(publisher)
    bench.node.destroy_subscription(subscription)
    bench.wait_for("neither", lambda: "qos_overrides" not in shown(bench).message)


def test_an_override_of_one_topic_leaves_the_others_as_they_are(arms):
    node = arms[0].bench.node
    durability = {
        topic: node.get_publishers_info_by_topic(f"/b/{topic}")[0].qos_profile.durability
        for topic in ("observer/state", "arm_state_estimate", "arm_state", "controller/state")
    }
    assert durability.pop("observer/state") == QoSDurabilityPolicy.TRANSIENT_LOCAL
    assert set(durability.values()) == {QoSDurabilityPolicy.VOLATILE}


def test_use_sim_time_without_a_clock_stops_nothing_and_diagnostics_have_a_stamp(arms):
    bench = arms[0].bench
    assert bench.get("b/observer", "use_sim_time") is True
    assert not bench.node.get_publishers_info_by_topic("/clock")
    nodes = {f"{side}/{name}" for side in "ab" for name in LINE}
    bench.wait_for(
        "diagnostics of all nodes", lambda: all(bench.diagnostics(name) for name in nodes)
    )
    arrays = bench.tap(DiagnosticArray, "/diagnostics").messages
    assert all(a.header.stamp.sec > STARTED - 60 for a in arrays)


def test_one_arm_whose_observer_is_killed_stands_and_the_other_goes_on(arms):
    a, b = arms
    bench = a.bench
    a.pause(False)
    bench.wait_for("arm a to go on", lambda: a.measured.newest.sequence > 300)
    if "a_observer" in bench.processes.running:  # else this is a second try
        bench.kill("a_observer")
    standing = a.measured
    bench.wait_for(
        "arm a to stand",
        lambda: (
            len(standing.messages) > 8 and len({m.sequence for m in standing.messages[-8:]}) == 1
        ),
    )
    stands = standing.newest.sequence
    b.pause(False)
    # In lockstep no sample follows without the torque of the one before. A busy reader loses messages of either topic.
    newest = (b.measured, b.torques)
    bench.wait_for("arm b to go on", lambda: all(tap.newest.sequence > 300 for tap in newest))
    assert standing.newest.sequence == stands
    assert {m.mode for m in b.torques.messages if m.sequence >= 100} == {JointTorque.ENABLED}
    assert len({m.session for m in b.measured.messages}) == 1


def test_one_simulator_of_two_publishes_the_clock_until_another_node_does(tmp_path):
    clock = {"rate": 200.0, "clock_rate": 50.0}
    with Bench(tmp_path) as bench:
        clocks, states = bench.tap(Clock, "/clock"), bench.tap(ArmState, "a/arm_state")
        for side in "ab":
            bench.start("simulator", {"arm": "R", **clock}, key=side, remaps=[f"__ns:=/{side}"])
        silent = "/a/simulator publishes /clock, this node does not"
        bench.wait_for("b to be silent", lambda: silent in bench.log("b"))
        clocks.messages.clear()
        states.messages.clear()
        bench.wait_for("stamps of a", lambda: len(clocks.messages) > 20)
        stamps = [m.clock.sec * 10**9 + m.clock.nanosec for m in clocks.messages]
        assert {b - a for a, b in pairwise(stamps)} == {20_000_000}
        bench.wait_for("the states", lambda: raw_ns(states.newest) > stamps[-1])
        assert set(stamps[1:]) <= {raw_ns(m) for m in states.messages}
        other = bench.node.create_publisher(Clock, "/clock", 10)
        name = bench.node.get_fully_qualified_name()
        bench.wait_for("a to be silent", lambda: f"{name} publishes /clock" in bench.log("a"))
        bench.node.destroy_publisher(other)
        bench.wait_for("a again", lambda: bench.log("a").rstrip().endswith("]: publishes /clock"))


def raw_ns(state):
    """The stamp of an arm's state [ns]."""
    return state.header.stamp.sec * 10**9 + state.header.stamp.nanosec
