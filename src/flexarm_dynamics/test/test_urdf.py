# SPDX-License-Identifier: Apache-2.0
"""Sections of bent links, and the URDF of rigid pieces: its own kinematics must put it where the model's arm is."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file, urdf
from flexarm_dynamics.arm.sections import Sections, chain_of
from flexarm_dynamics.errors import ModelError, ShapeError
from flexarm_dynamics.models import model
from flexarm_dynamics.models.chain import Chain

ARMS = ("R", "two_link", "long_reach")


def pose(arm_model, seed=1, slope=0.1):
    """Joint angles, and amplitudes that turn the links' tips by about `slope` [rad] each."""
    rng = np.random.default_rng(seed)
    links = {link.name: link for link in arm_model.arm.links}
    sizes = []
    for mode in arm_model.arm.modes:
        shapes = arm_model.mode_shapes(mode.link, mode.direction)
        twist = mode.direction == "twist"
        turn = shapes(1.0, 0 if twist else 1)[mode.number - 1]
        sizes.append(slope / abs(turn / (1.0 if twist else links[mode.link].length)))
    signs = rng.choice([-1.0, 1.0], arm_model.n_modes) * rng.uniform(0.5, 1.0, arm_model.n_modes)
    return rng.uniform(-1.0, 1.0, arm_model.n_joints), signs * sizes


def turn(axis, angle):
    """Rodrigues' formula."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def forward(text, values):
    """Frames of all links of a URDF, from its XML alone: name to (R, p)."""
    root = ET.fromstring(text)
    joints = {j.find("child").get("link"): j for j in root.iter("joint")}
    frames = {}

    def numbers(element, name):
        return np.array([float(v) for v in element.get(name, "0 0 0").split()])

    def frame(link):
        if link not in joints:
            return np.eye(3), np.zeros(3)
        if link not in frames:
            joint = joints[link]
            R, p = frame(joint.find("parent").get("link"))
            roll, pitch, yaw = numbers(joint.find("origin"), "rpy")
            p = p + R @ numbers(joint.find("origin"), "xyz")
            R = R @ turn((0, 0, 1), yaw) @ turn((0, 1, 0), pitch) @ turn((1, 0, 0), roll)
            if joint.get("type") != "fixed":
                R = R @ turn(numbers(joint.find("axis"), "xyz"), values[joint.get("name")])
            frames[link] = R, p
        return frames[link]

    return {e.get("name"): frame(e.get("name")) for e in root.iter("link")}


def posed(chain, q, delta):
    """Frames of all links of an arm's URDF at a pose."""
    values = dict(zip(chain.joint_names, chain.joint_values(q, delta), strict=True))
    return forward(chain.urdf(), values)


def tip_errors(arm_model, pieces, poses):
    """Distances of the URDF's tip from the model's, one for each pose (q, delta) [m]."""
    chain, tip = urdf.PieceChain(arm_model, pieces), f"{arm_model.arm.links[-1].name}_tip"
    return [
        np.linalg.norm(posed(chain, q, delta)[tip][1] - arm_model.tip_position(q, delta))
        for q, delta in poses
    ]


def of_constant_length(name):
    """A shipped arm whose links keep their length as they bend."""
    arm = arm_file.load(name)
    return Chain(replace(arm, model="chain", foreshortening=True, finite_slope=True))


# Sections --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ARMS)
def test_sections_are_where_the_model_says(shipped, name):
    m = shipped(name)
    q, delta = pose(m)
    sections = Sections(m, 4)
    frames = sections.frames(q, delta)
    np.testing.assert_allclose(frames[-1][1][-1], m.tip_position(q, delta), atol=1e-12)
    for link, places, (R, p) in zip(m.arm.links, sections.positions, frames, strict=True):
        assert len(places) == len(p) == (5 if link.flexible else 2)
        x = places[len(places) // 2]
        point = chain_of(m).point(link.name, x, q, delta)
        np.testing.assert_allclose(p[len(places) // 2], point, atol=1e-12)
        np.testing.assert_allclose(R @ R.transpose(0, 2, 1) - np.eye(3), 0.0, atol=1e-12)


def test_sections_of_a_linear_picture_grow_with_what_they_are_multiplied_by():
    m = of_constant_length("two_link")
    q, delta = np.zeros(2), np.array([0.02, 0.0, 0.0, 0.0])
    points = Sections(m, 4, linear=True).points
    once, ten = points(q, delta)[0], points(q, 10.0 * delta)[0]
    np.testing.assert_allclose(ten[:, 1], 10.0 * once[:, 1], atol=1e-15)
    np.testing.assert_allclose(ten[:, 0], once[:, 0], atol=1e-15)
    assert Sections(m, 4).points(q, delta)[0][-1, 0] < once[-1, 0]


def test_sections_refuse_a_state_of_another_arm(shipped):
    with pytest.raises(ShapeError, match="delta: "):
        Sections(shipped("two_link"), 2).frames([0.0, 0.0], [0.0])


# The chain of pieces ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ARMS)
def test_the_urdf_tip_comes_to_the_tip_of_links_that_keep_their_length(name):
    m = of_constant_length(name)
    poses = [pose(m, seed) for seed in (1, 2, 3)]
    errors = [sum(tip_errors(m, n, poses)) for n in (6, 12, 24)]
    bent = sum(np.linalg.norm(m.tip_position(q, d) - m.tip_position(q, 0.0 * d)) for q, d in poses)
    # Second order in the pieces' length; small beside what the arm is bent by.
    assert errors[1] < 0.35 * errors[0] and errors[2] < 0.35 * errors[1]
    assert errors[1] < 0.02 * bent


@pytest.mark.parametrize("name", ARMS)
def test_the_urdf_tip_of_the_first_order_model_is_off_by_second_order_in_the_deflection(
    shipped, name
):
    m = shipped(name)
    q, delta = pose(m)
    length = m.arm.reach
    whole, half = tip_errors(m, 16, [(q, delta), (q, 0.5 * delta)])
    assert 3.2 < whole / half < 4.8
    # 1/2 int y'^2 dx with slopes up to some 0.2 rad.
    assert whole < 0.04 * length


@pytest.mark.parametrize("name", ARMS)
def test_the_urdf_of_the_straight_arm_is_straight(shipped, name):
    m = shipped(name)
    q, _ = pose(m)
    assert tip_errors(m, 3, [(q, np.zeros(m.n_modes))])[0] < 1e-9


def test_the_urdf_turns_its_tip_as_the_model_does():
    m = of_constant_length("long_reach")
    q, delta = pose(m)
    R, _ = posed(urdf.PieceChain(m, 8), q, delta)["wrist_tip"]
    np.testing.assert_allclose(R, m.frames(q, delta)[0][-1], atol=1e-9)


def test_a_link_that_bends_and_does_not_twist_points_rightly_with_two_joints_a_junction(shipped):
    arm = arm_file.load("long_reach")
    links = [
        replace(link, flexible={k: v for k, v in link.flexible.items() if k != "twist"})
        for link in arm.links
    ]
    m = model.build(replace(arm, links=tuple(links), gauges=(), observed_modes=()))
    q, delta = pose(m)
    chain = urdf.PieceChain(m, 6)
    assert len(chain.joint_names) == 4 + 2 * 2 * 7
    R, _ = posed(chain, q, delta)["upper_tip"]
    wanted = Sections(m, 1).frames(q, delta)[1][0][-1]
    np.testing.assert_allclose(R[:, 0], wanted[:, 0], atol=1e-9)


# The file --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ("rigid", *ARMS))
def test_the_urdf_is_one_tree_with_unique_names_from_base_link(shipped, name):
    m = shipped(name)
    chain = urdf.PieceChain(m, 4)
    root = ET.fromstring(chain.urdf())
    links = [e.get("name") for e in root.iter("link")]
    joints = list(root.iter("joint"))
    children = [j.find("child").get("link") for j in joints]
    assert len(set(links)) == len(links) and links[0] == "base_link"
    assert len({j.get("name") for j in joints}) == len(joints)
    assert sorted(children) == sorted(links[1:])
    assert {j.find("parent").get("link") for j in joints} <= set(links)
    moving = [j.get("name") for j in joints if j.get("type") != "fixed"]
    assert sorted(moving) == sorted(chain.joint_names)
    assert chain.joint_names[: m.n_joints] == m.joint_names
    for joint in joints:
        if joint.get("type") == "revolute":
            limit = joint.find("limit")
            assert float(limit.get("lower")) < float(limit.get("upper"))


@pytest.mark.parametrize("name", ("rigid", *ARMS))
def test_inertials_are_those_of_the_arm(shipped, name):
    m = shipped(name)
    arm, text = m.arm, urdf.PieceChain(m, 5).urdf()
    bodies = {e.get("name"): e.find("inertial") for e in ET.fromstring(text).iter("link")}
    straight = forward(text, dict.fromkeys(urdf.PieceChain(m, 5).joint_names, 0.0))

    def mass(names):
        found = [bodies[n] for n in names if bodies[n] is not None]
        return sum(float(e.find("mass").get("value")) for e in found)

    for link in arm.links:
        own = [n for n in bodies if n == link.name or n.startswith(f"{link.name}_piece")]
        assert mass(own) == pytest.approx(link.mass, rel=1e-9)
        # The pieces' inertia about the link's base is the whole rod's m L^2/3, with the hub's about its axis.
        base, total = straight[link.name], np.zeros((3, 3))
        for n in own:
            if bodies[n] is None:
                continue
            tensor = {k: float(v) for k, v in bodies[n].find("inertia").attrib.items()}
            inertia = np.array(
                [[tensor["i" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"]
            )
            centre = [float(v) for v in bodies[n].find("origin").get("xyz").split()]
            r = base[0].T @ (straight[n][1] + straight[n][0] @ centre - base[1])
            total += inertia + mass([n]) * (r @ r * np.eye(3) - np.outer(r, r))
        joint = next(j for j, other in zip(arm.joints, arm.links, strict=True) if other is link)
        total -= joint.hub_inertia * np.outer(joint.axis, joint.axis)
        assert total[1, 1] == pytest.approx(link.mass * link.length**2 / 3.0, rel=1e-9)
        assert total[2, 2] == pytest.approx(link.mass * link.length**2 / 3.0, rel=1e-9)
    motors = sum(j.motor_mass for j in arm.joints[1:])
    whole = sum(link.mass for link in arm.links) + motors + arm.payload.mass
    assert mass(bodies) == pytest.approx(whole, rel=1e-9)


def test_names_that_meet_and_no_pieces_are_refused(shipped):
    m = shipped("two_link")
    with pytest.raises(ModelError, match="pieces of a link of two_link: 0 is too few"):
        urdf.PieceChain(m, 0)
    first, second = m.arm.links
    arm = replace(m.arm, links=(first, replace(second, name="link1_tip")), gauges=())
    with pytest.raises(ModelError, match="'link1_tip' is the name of two parts"):
        urdf.PieceChain(model.build(arm), 2).urdf()
