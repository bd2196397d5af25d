# SPDX-License-Identifier: Apache-2.0
"""Pictures of an arm: what the markers show; and every topic and field that the layouts name exists."""

import importlib
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from flexarm_control.loop.samples import ArmSample
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_ros.messages import StateWriter
from flexarm_tools.shape.amplitudes import Amplitudes
from flexarm_tools.shape.drawing import ARROW, Drawer, Trail
from flexarm_tools.shape.node import Markers

LAYOUTS = Path(__file__).resolve().parents[2] / "flexarm_bringup" / "layouts"
#: Topics of the nodes without a namespace; robot_description is robot_state_publisher's.
TOPICS = {
    "/arm_state": "flexarm_msgs/msg/ArmState",
    "/arm_state_estimate": "flexarm_msgs/msg/ArmState",
    "/controller/state": "flexarm_msgs/msg/CompositeState",
    "/observer/state": "flexarm_msgs/msg/ObserverState",
    "/joint_torque": "flexarm_msgs/msg/JointTorque",
    "/shape": "visualization_msgs/msg/MarkerArray",
    "/shape/joint_states": "sensor_msgs/msg/JointState",
    "/robot_description": "std_msgs/msg/String",
}


@pytest.fixture(scope="module")
def two_link():
    return model.build(arm_file.load("two_link"))


# Pictures --------------------------------------------------------------------------------------


def test_a_picture_shows_the_bent_arm_its_ghost_and_its_torques(two_link):
    q, delta = np.array([0.3, -0.5]), np.array([0.02, 0.001, -0.01, 0.0])
    picture = Drawer(two_link, 4).picture(q, delta, slow=[2.5, 0.0], fast=[-1.0, 1.0])
    np.testing.assert_allclose(picture.tip, two_link.tip_position(q, delta), atol=1e-12)
    np.testing.assert_allclose(picture.beam[-1], picture.tip)
    np.testing.assert_allclose(picture.ghost[-1], two_link.tip_position(q, 0.0 * delta), atol=1e-12)
    np.testing.assert_allclose(picture.joints[1], picture.beam[4], atol=1e-12)
    # Limits of 5 and 2 N m; the axes are z, the arm 1 m long.
    np.testing.assert_allclose(picture.slow[0, 1] - picture.joints[0], [0, 0, 0.5 * ARROW])
    np.testing.assert_allclose(picture.fast[0, 0], picture.slow[0, 1])
    np.testing.assert_allclose(picture.fast[0, 1] - picture.joints[0], [0, 0, 0.3 * ARROW])
    np.testing.assert_allclose(picture.fast[1, 1] - picture.joints[1], [0, 0, 0.5 * ARROW])


def test_a_picture_exaggerates_deflections_and_not_joints(two_link):
    q, delta = np.zeros(2), np.array([1e-4, 0.0, 0.0, 0.0])
    drawer = Drawer(two_link, 4)
    once, many = (drawer.picture(q, delta, exaggeration=e) for e in (1.0, 10.0))
    assert many.joints[1, 1] == pytest.approx(10.0 * once.joints[1, 1], rel=1e-9)
    np.testing.assert_allclose(many.ghost, once.ghost)
    assert drawer.picture(q, delta, exaggeration=0.0).tip[1] == 0.0


def test_tip_error_is_from_the_rigid_arm_at_the_reference(two_link):
    drawer = Drawer(two_link, 2)
    # The arm of 1 m turned by 0.01 rad.
    error = drawer.tip_error([0.01, 0.0], np.zeros(4), [0.0, 0.0])
    assert error == pytest.approx(2.0 * np.sin(0.005), rel=1e-9)


def test_a_trail_keeps_the_newest_points_and_begins_anew_with_the_session():
    trail = Trail(3, 0.1)
    for x in (0.0, 0.05, 0.2, 0.4, 0.6):
        trail.add([x, 0.0, 0.0], session=1)
    np.testing.assert_allclose(trail.points[:, 0], [0.2, 0.4, 0.6])
    trail.add([1.0, 0.0, 0.0], session=2)
    assert trail.points.shape == (1, 3)


def test_amplitudes_that_are_not_observed_are_zero():
    arm = arm_file.load("two_link")
    arm = type(arm)(**{**arm.__dict__, "observed_modes": ("link2_y_mode1", "link1_y_mode2")})
    writer = StateWriter(arm)
    writer.write("joint_position", [0.0, 0.0])
    amplitudes = Amplitudes(arm)
    sample = ArmSample(2, 4)
    assert not amplitudes.read(writer.message, sample).any()
    writer.write("modal_amplitude", [1.0, 2.0])
    assert amplitudes.read(writer.message, sample).tolist() == [0.0, 2.0, 1.0, 0.0]


def test_markers_have_the_pictures_points_one_id_each_and_no_arrow_without_torque(two_link):
    drawer = Drawer(two_link, 4)
    picture = drawer.picture(np.zeros(2), np.array([0.02, 0, 0, 0]), [1.0, 0.0], [0.0, 0.0])
    markers = Markers(drawer.reach, 2)
    header = Header(frame_id="base_link")
    array = markers.fill(picture, np.zeros((1, 3)), header)
    by_name = {(m.ns, m.id): m for m in array.markers}
    assert len(by_name) == len(array.markers)
    assert all(m.header.frame_id == "base_link" and m.color.a > 0 for m in array.markers)
    beam = by_name["beam", 0]
    assert beam.type == Marker.LINE_STRIP and len(beam.points) == len(picture.beam)
    assert [beam.points[-1].x, beam.points[-1].y] == picture.tip[:2].tolist()
    assert by_name["slow_torque", 0].action == Marker.ADD
    assert by_name["slow_torque", 0].points[1].z == picture.slow[0, 1, 2]
    assert by_name["slow_torque", 1].action == by_name["fast_torque", 0].action == Marker.DELETE
    assert by_name["trail", 0].action == Marker.DELETE


# Layouts ---------------------------------------------------------------------------------------


def get_message(name):
    """The class of a message type, such as "std_msgs/msg/Header"."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def check_path(topic, path):
    """Assert that a message of a topic has a field: dots between, [i] on arrays, a number at the end."""
    assert topic in TOPICS, topic
    kind = get_message(TOPICS[topic]).get_fields_and_field_types()
    names = path.split(".")
    for i, name in enumerate(names):
        field, index = re.fullmatch(r"(\w+)(\[\d+\])?", name).groups()
        assert field in kind, f"{topic} has no {path}"
        found = kind[field]
        assert ("sequence" in found or found.endswith("]")) == bool(index), f"{topic} {path}: index"
        if i < len(names) - 1:
            inner = re.search(r"\w+/\w+", found)[0].replace("/", "/msg/")
            kind = get_message(inner).get_fields_and_field_types()


def test_the_check_of_paths_knows_right_from_wrong():
    check_path("/arm_state", "header.stamp.sec")
    check_path("/shape/joint_states", "position[3]")
    for topic, path in (("/arm", "strain[0]"), ("/arm_state", "strains[0]"), ("/arm_state", "strain"),
                        ("/controller/state", "compute_time[0]"), ("/arm_state", "header.frame")):  # fmt: skip
        with pytest.raises(AssertionError):
            check_path(topic, path)


def test_the_rviz_layout_names_topics_and_namespaces_that_exist():
    layout = yaml.safe_load((LAYOUTS / "flexarm.rviz").read_text())
    displays = layout["Visualization Manager"]["Displays"]
    kinds = {
        "MarkerArray": ("Topic", "visualization_msgs"),
        "RobotModel": ("Description Topic", "std_msgs"),
    }
    shown = 0
    for display in displays:
        kind = display["Class"].split("/")[1]
        if kind in kinds:
            field, package = kinds[kind]
            assert TOPICS[display[field]["Value"]].startswith(package)
            shown += 1
    assert shown == 2
    spaces = {m.ns for m in Markers(1.0, 1).message.markers}
    assert spaces == set(displays[1]["Namespaces"])


def test_the_plotjuggler_layout_names_fields_that_exist():
    root = ET.parse(LAYOUTS / "plotjuggler.xml").getroot()
    topics = [e.get("name") for e in root.iter("topic")]
    assert topics and set(topics) <= set(TOPICS)
    curves = [e.get("name") for e in root.iter("curve")]
    for curve in curves:
        topic = next(t for t in sorted(topics, key=len, reverse=True) if curve.startswith(t + "/"))
        check_path(topic, curve[len(topic) + 1 :].replace("/", "."))
    assert len(curves) >= 10


def test_the_foxglove_layout_names_fields_that_exist_and_shows_every_panel():
    layout = json.loads((LAYOUTS / "foxglove.json").read_text())
    panels = layout["configById"]

    def leaves(node):
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(panels)
    paths = [p["value"] for panel in panels.values() for p in panel.get("paths", ())]
    paths += [panel["topicPath"] for panel in panels.values() if "topicPath" in panel]
    assert len(paths) >= 10
    for path in paths:
        check_path(*path.split(".", 1))
    topics = [t for panel in panels.values() for t in panel.get("topics", {})]
    assert topics and set(topics) <= set(TOPICS)
