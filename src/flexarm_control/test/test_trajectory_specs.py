# SPDX-License-Identifier: Apache-2.0
"""Motions written in a line are those of their families; what can't be read is refused by name."""

import numpy as np
import pytest

from flexarm_control.motions import profiles, shapers
from flexarm_control.trajectory import files, specs
from flexarm_dynamics.errors import NOT_GIVEN, FlexarmError


def agrees(trajectory, profile):
    points = profiles.sample(profile, trajectory.times_ns.size)
    np.testing.assert_allclose(trajectory.times, points.times, rtol=0, atol=1e-9)
    for name in ("positions", "velocities", "accelerations"):
        np.testing.assert_array_equal(getattr(trajectory, name), getattr(points, name))


def test_a_spec_is_the_familys_motion(arm_r, two_link):
    agrees(specs.from_spec("paper", arm_r), profiles.paper_profile())
    spec = specs.from_spec("quintic:to=1.57,duration=2.5", arm_r, [0.2])
    agrees(spec, profiles.quintic(0.2, 1.57, 2.5))
    text = "smooth: to=0.5;-0.3, from=0.1;0, duration=3, smoothness=4"
    agrees(specs.from_spec(text, two_link), profiles.smooth([0.1, 0.0], [0.5, -0.3], 3.0, 4))
    spec = specs.from_spec("quintic:to=0.4,shaper=zvd,shape_modes=1,points=51", two_link)
    shaper = shapers.for_arm(two_link, [0.4, 0.4], "zvd", 1)
    agrees(spec, shaper.apply(profiles.quintic([0, 0], [0.4, 0.4], 2.0)))
    assert spec.times_ns.size == 51


def test_load_takes_a_file_or_a_spec(tmp_path, arm_r):
    written = specs.load("smooth:to=1,duration=1", arm_r)
    files.write(tmp_path / "motion.csv", written)
    assert specs.load(str(tmp_path / "motion.csv"), arm_r).repeats(written)


@pytest.mark.parametrize(
    ("text", "field", "value"),
    [
        ("cubic", "motion", "cubic"),
        ("", "motion", ""),
        ("quintic:to", "quintic", "to"),
        ("quintic:to=", "quintic", "to="),
        ("quintic:to=1,to=2", "quintic", "to"),
        ("quintic:smoothness=3", "quintic", "smoothness"),
        ("smooth:smoothness=2.5", "smoothness", "2.5"),
        ("smooth:to=1;2", "to", "1;2"),
        ("smooth:to=x", "to", "x"),
        ("smooth:duration=two", "duration", "two"),
        ("quintic:shape-modes=1", "shape-modes", NOT_GIVEN),
        ("quintic:shaper=fir", "shaper", "fir"),
        ("quintic:shaper=zv,shape-modes=3", "shaper modes", 3),
        ("quintic:points=1", "points", 1),
        ("line:duration=2", "line", NOT_GIVEN),
        ("line:tip=1;2", "tip", "1;2"),
    ],
)
def test_what_cant_be_read_is_refused_naming_it(arm_r, text, field, value):
    with pytest.raises(FlexarmError) as error:
        specs.load(text, arm_r)
    assert (error.value.field, error.value.value) == (field, value)


@pytest.mark.parametrize(
    ("text", "field"),
    [("quintic:to=4", "positions"), ("quintic:to=3,duration=0.2", "velocities")],
)
def test_a_motion_beyond_the_arms_limits_is_refused(one_link, text, field):
    with pytest.raises(FlexarmError, match=rf"points\[\d+\]\.{field} of joint joint1: .* limit"):
        specs.from_spec(text, one_link)
