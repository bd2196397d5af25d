# SPDX-License-Identifier: Apache-2.0
"""The plain data of an arm: names, order of the modal coordinates, arms with more modes."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Arm, Flexibility, Gauge, Joint, Link
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


def test_names_come_link_by_link_direction_by_direction():
    """y before z before twist, whatever the order in the file."""
    arm = two_links()
    assert arm.mode_names == (
        "upper_y_mode1",
        "upper_y_mode2",
        "upper_z_mode1",
        "fore_twist_mode1",
        "fore_twist_mode2",
    )
    assert (arm.joint_names, arm.gauge_names) == (("j1", "j2"), ("a", "b"))
    assert arm.link("fore") is arm.links[1]


def test_rotor_inertia_is_seen_through_the_gear_squared():
    joint = Joint("j", hub_inertia=0.1, rotor_inertia=2e-5, gear_ratio=-50.0)
    assert joint.inertia == pytest.approx(0.15, rel=1e-14)


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
    assert arm.with_modes(1).observed_modes == ("link1_y_mode1",)  # fewer are not observed either


def test_every_flexible_direction_of_every_link_gets_the_modes():
    arm = two_links().with_modes(3)
    assert [m.number for m in arm.modes] == [1, 2, 3] * 3
    rigid = replace(two_links(), links=(Link("a", 1.0, 1.0), Link("b", 1.0, 1.0)))
    assert rigid.with_modes(3) == rigid


@pytest.mark.parametrize(
    ("name", "count", "limit"),
    [
        ("two_link", 0, "1 to 20"),
        ("two_link", -1, "1 to 20"),
        ("two_link", 21, "1 to 20"),
        ("P3", 3, 2),
    ],
)
def test_a_number_of_modes_out_of_range_is_refused(name, count, limit):
    """Measured frequencies bound it too: P3 has two."""
    with pytest.raises(ModelError) as error:
        arm_file.load(name).with_modes(count)
    assert (error.value.value, error.value.limit) == (count, limit)
    assert error.value.field.startswith(f"modes of {name}")


def test_fewer_modes_take_the_first_of_the_measured_frequencies():
    assert arm_file.load("P3").with_modes(1).links[0].flexible["y"].frequencies == (2.12,)


def test_a_fuller_arm_knows_as_much_more_as_it_can():
    arm = two_links()
    most = arm.most_modes
    assert arm.fuller(most, False, False) == arm
    fuller = arm.fuller(most + 1, True, False)
    assert fuller == replace(arm.with_modes(most + 1), foreshortening=True)
    assert fuller.fuller(0, False, True) == replace(fuller, finite_slope=True)
    measured = arm_file.load("P3")  # as many modes as frequencies, and equations of its own
    assert measured.fuller(measured.most_modes + 1, True, True) == measured
    rigid = replace(arm, links=(Link("a", 1.0, 1.0), Link("b", 1.0, 1.0)))
    assert rigid.fuller(3, True, True) == rigid


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
