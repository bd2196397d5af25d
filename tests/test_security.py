# SPDX-License-Identifier: Apache-2.0
"""config/security/flexarm.policy.xml allows each node what it creates, and nothing else."""

import os
import re
import sys
import tty
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import rclpy
from trajectory_msgs.msg import JointTrajectory

from flexarm_control.nodes.controller import ControllerNode
from flexarm_control.nodes.goals import GoalsNode, kinds
from flexarm_control.nodes.observer import ObserverNode
from flexarm_ros.session import Session
from flexarm_sim.nodes.simulator import SimulatorNode
from flexarm_tools.running.processes import arguments, own_domain

sys.path.insert(
    0, str(Path(__file__).resolve().parents[1] / "examples" / "flexarm_driver_template")
)

from flexarm_driver_template.driver import DriverNode

POLICY = Path(__file__).resolve().parents[1] / "config" / "security" / "flexarm.policy.xml"
CLASSES = {
    "driver": DriverNode,
    "simulator": SimulatorNode,
    "observer": ObserverNode,
    "controller": ControllerNode,
    "goals": GoalsNode,
}
#: What `flexarm publish` is to the graph: a session of this name that publishes trajectories.
OPERATOR = "publish_trajectory"
#: What SROS 2 makes of a list: its elements' name, and the attributes that it may have (policy 0.2.0).
LISTS = {
    "topics": {"publish", "subscribe"},
    "services": {"request", "reply"},
    "actions": {"call", "execute"},
}
#: Topics and services that SROS 2 allows to one that may serve an action, below the action's name.
OF_ACTION = {
    "publish": ("feedback", "status"),
    "reply": ("cancel_goal", "get_result", "send_goal"),
}


def policy():
    """The root of the policy file."""
    return ElementTree.parse(POLICY).getroot()


def profile(enclave):
    """The profile of an enclave, and what it allows: {kind: absolute names}, of each kind."""
    (found,) = policy().findall(f"enclaves/enclave[@path='/flexarm/{enclave}']/profiles/profile")
    allowed = {kind: [] for kinds in LISTS.values() for kind in kinds}
    for names in found:
        for kind, rule in names.attrib.items():
            assert rule == "ALLOW"
            allowed[kind] += [absolute(name.text, found) for name in names]
    served = {
        f"/controller/{name}" for _, name in kinds()
    }  # those of control_msgs where it is installed
    for action in allowed["execute"]:
        for kind, parts in OF_ACTION.items():
            if action in served:
                allowed[kind] += [f"{action}/_action/{part}" for part in parts]
    return found, allowed


def absolute(name, found):
    """A name as SROS 2 resolves it: of the namespace, `~` of the node."""
    space = found.get("ns").rstrip("/")
    if name.startswith("/"):
        return name
    return f"{space}/{found.get('node')}{name[1:]}" if name.startswith("~") else f"{space}/{name}"


def test_the_policy_file_is_of_the_form_that_sros2_reads():
    root = policy()
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    assert [child.tag for child in root] == ["enclaves"]
    paths = [enclave.get("path") for enclave in root[0]]
    assert paths == [f"/flexarm/{name}" for name in (*CLASSES, "operator")]
    for found in root.iter("profile"):
        assert set(found.attrib) == {"ns", "node"}
        for names in found:
            assert names.attrib and set(names.attrib) <= LISTS[names.tag]
            assert {name.tag for name in names} == {names.tag[:-1]}
            for name in names:
                assert re.fullmatch(r"(~?/)?\w+(/\w+)*", name.text), name.text


@pytest.fixture(scope="module")
def created():
    """What each node has created: {node: {kind: names}}, from the graph."""
    with own_domain() as domain, Session("bystander", domain=domain) as session:
        line, port = os.openpty()
        tty.setraw(port)
        values = {"arm": "R", "port": os.ttyname(port), "lockstep": True, "design_process": False}
        rclpy.init(domain_id=domain, args=arguments(values))
        nodes = {}
        try:
            for name, node_class in CLASSES.items():
                nodes[name] = node_class()
                assert nodes[name].autostart()
            with Session(OPERATOR, domain=domain) as operator:
                operator.publisher(JointTrajectory, "joint_trajectory")
                known = [*nodes.values(), operator.node]
                session.wait_for("the graph", lambda: all(is_known(session.node, n) for n in known))
                found = {name: graph(session.node, name) for name in CLASSES}
                yield {**found, "operator": graph(session.node, OPERATOR)}
        finally:
            for node in nodes.values():
                if node.active:
                    node.stop()
                node.destroy_node()
            rclpy.try_shutdown()
            os.close(line)
            os.close(port)


def is_known(bystander, node):
    """Whether the graph has all that a node made itself."""
    if node.get_name() not in bystander.get_node_names():
        return False
    found = graph(bystander, node.get_name())
    topics = {p.topic_name for p in node.publishers}, {s.topic_name for s in node.subscriptions}
    return (
        topics[0] <= set(found["publish"])
        and topics[1] <= set(found["subscribe"])
        and {s.service_name for s in node.services} <= set(found["reply"])
    )


def graph(node, name):
    """Names of what a node has, by kind; from the graph, which alone knows what rcl creates by itself."""
    kinds = {
        "publish": node.get_publisher_names_and_types_by_node,
        "subscribe": node.get_subscriber_names_and_types_by_node,
        "reply": node.get_service_names_and_types_by_node,
        "request": node.get_client_names_and_types_by_node,
    }
    return {kind: sorted(n for n, _ in ask(name, "/")) for kind, ask in kinds.items()}


@pytest.mark.parametrize("name", CLASSES)
def test_each_node_may_do_what_it_does_and_nothing_else(created, name):
    found, allowed = profile(name)
    assert found.get("node") == name
    for kind, names in created[name].items():
        assert sorted(allowed[kind]) == names, f"{kind} of {name} in {POLICY.name}"


def test_the_operator_may_do_what_flexarm_publish_does(created):
    found, allowed = profile("operator")
    assert found.get("node") == OPERATOR
    for kind, names in created["operator"].items():
        assert set(names) <= set(allowed[kind]), f"{kind} of the operator in {POLICY.name}"
    assert sorted(allowed["reply"]) == created["operator"]["reply"]
