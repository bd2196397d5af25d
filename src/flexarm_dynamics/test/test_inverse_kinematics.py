# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics: against triangles, against the forward kinematics of the bent arm, and at its limits."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.errors import ModelError, ShapeError
from flexarm_dynamics.models import inverse_kinematics as ik
from flexarm_dynamics.models.model import build

BENT = np.array([0.2, -0.3, 0.9, 0.2])


@pytest.fixture(scope="module")
def long_reach(shipped):
    return shipped("long_reach")


@pytest.mark.parametrize(("x", "y"), [(0.6, 0.3), (-0.2, 0.5), (0.1, -0.9)])
def test_two_straight_links_make_the_triangle_of_their_sides(shipped, x, y):
    """Law of cosines: cos q2 = (x^2 + y^2 - a^2 - b^2) / (2 a b), a = b = 0.5 m."""
    elbow = np.arccos((x * x + y * y - 0.5) / 0.5)
    for side in (1.0, -1.0):
        q2 = side * elbow
        q1 = np.arctan2(y, x) - np.arctan2(0.5 * np.sin(q2), 0.5 + 0.5 * np.cos(q2))
        found = ik.solve(shipped("two_link"), [x, y, 0.0], [q1 + 0.2, q2 - 0.1])
        turns = (found.q - [q1, q2] + np.pi) % (2.0 * np.pi) - np.pi
        np.testing.assert_allclose(turns, 0.0, atol=1e-8)


def test_a_stretched_arm_finds_the_way_out_of_its_singular_configuration(shipped):
    found = ik.solve(shipped("two_link"), [0.5, 0.0, 0.0], [0.0, 0.0])
    assert abs(abs(found.q[1]) - 2.0 * np.pi / 3.0) < 1e-8


@pytest.mark.parametrize("name", ["R", "P3", "one_link"])
def test_models_of_one_link_have_it_too(shipped, name):
    arm = shipped(name)
    tip = arm.tip_position(np.array([2.1]), np.zeros(arm.n_modes))
    np.testing.assert_allclose(ik.solve(arm, tip).q, [2.1], atol=1e-9)


def test_the_bent_arms_tip_is_at_the_point(long_reach):
    """The deflections from `static_deflection`, the tip from `frames`: nothing of the search."""
    target = ik.TipKinematics(long_reach).tip(BENT) + np.array([0.2, -0.3, 0.15])
    found = ik.solve(long_reach, target, BENT)
    tip = long_reach.frames(found.q, long_reach.static_deflection(found.q))[1][-1]
    np.testing.assert_allclose(tip, target, atol=1e-9)
    straight = ik.solve(long_reach, target, BENT, bent=False)
    np.testing.assert_allclose(long_reach.frames(straight.q)[1][-1], target, atol=1e-9)
    sag = np.linalg.norm(target - ik.TipKinematics(long_reach).tip(straight.q))
    assert sag > 0.1  # what is compensated


def test_an_arm_with_a_joint_to_spare_stays_near_its_start(long_reach):
    """Of all configurations with this tip, the one that is found is nearly the nearest to the start."""
    kinematics = ik.TipKinematics(long_reach, bent=False)
    target = kinematics.tip(BENT) + np.full(3, 0.05)
    found = ik.solve(long_reach, target, BENT, bent=False).q
    null = np.linalg.svd(kinematics.jacobian(found))[2][-1]
    moved = found - BENT
    assert np.abs(moved).max() < 0.15
    assert abs(null @ moved) < 0.05 * np.linalg.norm(moved)


@pytest.mark.parametrize("bent", [True, False])
def test_the_jacobian_is_that_of_the_tip(long_reach, bent):
    kinematics, small = ik.TipKinematics(long_reach, bent), 1e-5
    ahead = [kinematics.tip(BENT + small * e) for e in np.eye(4)]
    behind = [kinematics.tip(BENT - small * e) for e in np.eye(4)]
    expected = (np.array(ahead) - behind).T / (2.0 * small)
    np.testing.assert_allclose(kinematics.jacobian(BENT), expected, atol=1e-7)


def test_the_jacobian_of_the_closed_form_model_bends_too(heavy_one_link):
    kinematics, q, small = ik.TipKinematics(heavy_one_link), np.array([0.4]), 1e-5
    expected = (kinematics.tip(q + small) - kinematics.tip(q - small)) / (2.0 * small)
    np.testing.assert_allclose(kinematics.jacobian(q)[:, 0], expected, atol=1e-8)
    assert abs(kinematics.tip(q)[1] - ik.TipKinematics(heavy_one_link, False).tip(q)[1]) > 1e-3


@pytest.fixture(scope="module")
def heavy_one_link(shipped):
    return build(replace(shipped("one_link").arm, model="one_link", gravity=(0.0, -9.81, 0.0)))


def test_a_point_out_of_reach_is_refused_with_its_distance(shipped):
    arm = shipped("two_link")
    with pytest.raises(ModelError, match=r" 0\.2 m away") as error:
        ik.solve(arm, [1.2, 0.0, 0.0], [0.3, 0.2])
    assert (error.value.field, error.value.value) == ("tip of two_link", [1.2, 0.0, 0.0])
    with pytest.raises(ModelError, match=r"0\.1 m away"):  # out of the plane
        ik.solve(arm, [0.5, 0.5, 0.1], [0.3, 0.2])


def test_joint_limits_are_kept(shipped):
    arm = shipped("one_link").arm
    limits = replace(arm.joints[0].limits, position=(-1.0, 1.0))
    narrow = build(replace(arm, joints=(replace(arm.joints[0], limits=limits),)))
    L = arm.links[0].length
    np.testing.assert_allclose(ik.solve(narrow, [L * np.cos(0.9), L * np.sin(0.9), 0.0]).q, [0.9])
    # The chord between 1 rad and 1.5 rad.
    away = 2.0 * L * np.sin(0.25)
    with pytest.raises(ModelError, match=f"{away:.5g}.* m away, at q = \\[1\\] rad"):
        ik.solve(narrow, [L * np.cos(1.5), L * np.sin(1.5), 0.0])


def test_wrong_shapes_and_numbers_are_refused(shipped):
    arm = shipped("two_link")
    for target, start, field, shapes in (
        ([1.0, 0.0], None, "tip position", ((2,), (3,))),
        ([1.0, 0.0, 0.0], [0.0], "start", ((1,), (2,))),
    ):
        with pytest.raises(ShapeError) as error:
            ik.solve(arm, target, start)
        assert error.value.field == field
        assert (error.value.value, error.value.limit) == shapes
    with pytest.raises(ModelError, match=r"tip position: .* is not finite"):
        ik.solve(arm, [np.nan, 0.0, 0.0])
