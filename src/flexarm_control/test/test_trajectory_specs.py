# SPDX-License-Identifier: Apache-2.0
"""Motions written in a line are those of their families; what can't be read is refused by name."""

import numpy as np
import pytest

from flexarm_control.motions import profiles, shapers
from flexarm_control.trajectory import files, specs
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model


@pytest.fixture(scope="module")
def two_link():
    return model.build(arm_file.load("two_link"))


def agrees(trajectory, profile):
    points = profiles.sample(profile, trajectory.times_ns.size)
    np.testing.assert_allclose(trajectory.times, points.times, rtol=0, atol=1e-9)
    for name in ("positions", "velocities", "accelerations"):
        np.testing.assert_array_equal(getattr(trajectory, name), getattr(points, name))


def test_a_spec_is_the_familys_motion(arm_r, two_link):
    agrees(specs.from_spec("paper", arm_r), profiles.paper_profile())
    agrees(
        specs.from_spec("quintic:to=1.57,duration=2.5", arm_r, [0.2]),
        profiles.quintic(0.2, 1.57, 2.5),
    )
    agrees(
        specs.from_spec("smooth: to=0.5;-0.3, from=0.1;0, duration=3, smoothness=4", two_link),
        profiles.smooth([0.1, 0.0], [0.5, -0.3], 3.0, 4),
    )
    spec = specs.from_spec("quintic:to=0.4,shaper=zvd,shape_modes=1,points=51", two_link)
    shaper = shapers.for_arm(two_link, [0.4, 0.4], "zvd", 1)
    agrees(spec, shaper.apply(profiles.quintic([0, 0], [0.4, 0.4], 2.0)))
    assert spec.times_ns.size == 51


def test_load_takes_a_file_or_a_spec(tmp_path, arm_r):
    written = specs.load("smooth:to=1,duration=1", arm_r)
    files.write(tmp_path / "motion.csv", written)
    assert specs.load(str(tmp_path / "motion.csv"), arm_r).repeats(written)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cubic", r"motion 'cubic': give a file that ends in .* or one of paper, quintic, smooth"),
        ("", "motion ''"),
        ("quintic:to", r"'to' is no setting: write name=value"),
        ("quintic:to=", r"'to=' is no setting"),
        ("quintic:to=1,to=2", r"to is given twice"),
        ("quintic:smoothness=3", r"quintic has no smoothness: it takes to, from"),
        ("smooth:smoothness=2.5", r"smoothness '2\.5': write an integer"),
        ("smooth:to=1;2", r"to '1;2': 1 finite angles, one per joint are wanted"),
        ("smooth:to=x", r"to 'x': write numbers"),
        ("smooth:duration=two", r"duration 'two': write a number"),
        ("quintic:shape-modes=1", r"shape-modes without shaper"),
        ("quintic:shaper=fir", r"shaper 'fir': there are zv, zvd"),
        ("quintic:shaper=zv,shape-modes=3", r"R: a shaper of 3 modes; the arm has 2"),
        ("quintic:points=1", r"points is 1: give 2 to"),
        ("line:duration=2", r"line wants tip"),
        ("line:tip=1;2", r"tip '1;2': 3 finite coordinates"),
    ],
)
def test_what_cant_be_read_is_refused_naming_it(arm_r, text, message):
    with pytest.raises(FlexarmError, match=message):
        specs.load(text, arm_r)


def test_a_motion_beyond_the_arms_limits_is_refused():
    arm = model.build(arm_file.load("one_link"))
    with pytest.raises(FlexarmError, match=r"position of joint joint1 is .* beyond its limit"):
        specs.from_spec("quintic:to=4", arm)
    with pytest.raises(FlexarmError, match=r"velocity of joint joint1 is .* beyond its limit"):
        specs.from_spec("quintic:to=3,duration=0.2", arm)
