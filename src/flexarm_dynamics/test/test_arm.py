# SPDX-License-Identifier: Apache-2.0
"""The plain data of an arm: names, order of the modal coordinates, arms with more modes."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Arm, Flexibility, Gauge, Joint, Link, Mode
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.errors import ModelError, UnknownComponentError
from flexarm_dynamics.models import model
from flexarm_dynamics.models.chain import Chain
from flexarm_dynamics.models.one_link import OneLink


def two_links():
    upper = Link(
        "upper", 1.0, 0.2, {"y": 8.0, "z": 8.0}, {"z": Flexibility(1), "y": Flexibility(2)}
    )
    fore = Link("fore", 0.5, 0.2, {"twist": 1.0}, {"twist": Flexibility(2)})
    gauges = (Gauge("a", "upper", 0.1, "y", 1e-3), Gauge("b", "fore", 0.1, "twist", 1e-3))
    return Arm("two", (Joint("j1"), Joint("j2")), (upper, fore), gauges=gauges)


def test_modes_are_named_by_link_direction_and_number():
    assert Mode("link1", "twist", 3).name == "link1_twist_mode3"


def test_modal_coordinates_go_link_by_link_direction_by_direction():
    """y before z before twist, whatever the order in the file."""
    assert two_links().mode_names == (
        "upper_y_mode1",
        "upper_y_mode2",
        "upper_z_mode1",
        "fore_twist_mode1",
        "fore_twist_mode2",
    )


def test_names_come_in_order():
    arm = two_links()
    assert arm.joint_names == ("j1", "j2")
    assert arm.gauge_names == ("a", "b")
    assert arm.link("fore") is arm.links[1]


def test_rotor_inertia_is_seen_through_the_gear_squared():
    joint = Joint("j", hub_inertia=0.1, rotor_inertia=2e-5, gear_ratio=-50.0)
    assert joint.inertia == pytest.approx(0.15, rel=1e-14)


def test_mass_of_a_link_is_that_of_its_beam():
    assert Link("l", 2.0, 0.3).mass == 0.6


def test_arms_cannot_be_changed():
    with pytest.raises(AttributeError):
        two_links().name = "other"


def test_more_modes_leave_gauges_and_observed_modes_as_they_are():
    arm = arm_file.load("one_link")
    more = arm.with_modes(5)
    assert len(more.modes) == 5
    assert more.observed_modes == ("link1_y_mode1", "link1_y_mode2")
    assert more.gauges == arm.gauges
    assert replace(more, links=arm.links) == arm
    assert len(arm.modes) == 2  # the first arm is as it was


def test_fewer_modes_are_not_observed_either():
    assert arm_file.load("one_link").with_modes(1).observed_modes == ("link1_y_mode1",)


def test_every_flexible_direction_of_every_link_gets_the_modes():
    arm = two_links().with_modes(3)
    assert [m.number for m in arm.modes] == [1, 2, 3] * 3
    rigid = replace(two_links(), links=(Link("a", 1.0, 1.0), Link("b", 1.0, 1.0)))
    assert rigid.with_modes(3) == rigid


def test_measured_frequencies_bound_the_number_of_modes():
    arm = arm_file.load("P3")
    assert arm.with_modes(1).links[0].flexible["y"].frequencies == (2.12,)
    with pytest.raises(
        ModelError,
        match="P3: link1 has 2 measured frequencies in y, so at most that many modes, not 3",
    ):
        arm.with_modes(3)


def test_the_first_modes_are_the_same_with_more(shipped):
    few, many = shipped("one_link"), shipped("one_link", 6)
    tips = [m.mode_shapes("link1", "y")(1.0) for m in (few, many)]
    np.testing.assert_allclose(tips[0], tips[1][:2], rtol=1e-12)
    gauges = few.arm.gauges
    np.testing.assert_allclose(gauge_rows(few, gauges), gauge_rows(many, gauges)[:, :2], rtol=1e-11)


def test_a_model_is_found_by_the_name_in_the_arm():
    arm = arm_file.load("one_link")
    assert type(model.build(arm)) is Chain
    assert type(model.build(replace(arm, model="one_link"))) is OneLink
    with pytest.raises(UnknownComponentError, match="did you mean 'one_link'"):
        model.build(replace(arm, model="one_lnik"))


def test_models_tell_their_size(shipped):
    arm_model = shipped("one_link", 4)
    assert (arm_model.n_joints, arm_model.n_modes) == (1, 4)
    assert arm_model.joint_names == ("joint1",)
    assert arm_model.mode_names[3] == "link1_y_mode4"
