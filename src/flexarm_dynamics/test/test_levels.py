# SPDX-License-Identifier: Apache-2.0
"""Levels of the kinematics at which arms are simulated."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models import levels, model
from flexarm_dynamics.models.chain import Chain


@pytest.fixture(scope="module")
def two_link():
    return arm_file.load("two_link")


@pytest.mark.parametrize("level", levels.LEVELS[1:])
def test_an_arm_is_at_the_level_asked_for_whatever_its_file_states(two_link, level):
    for start in (two_link, replace(two_link, foreshortening=True, finite_slope=True)):
        assert levels.level_of(levels.at_level(start, level)) == level
        assert levels.level_of(levels.simulated(start, level)) == level


def test_what_is_no_level_or_not_of_the_model_is_refused(two_link):
    with pytest.raises(ModelError, match="level: 'exact' is unknown"):
        levels.at_level(two_link, "exact")
    with pytest.raises(ModelError, match="of R supports neither foreshortening nor finite slope"):
        levels.at_level(arm_file.load("R"), "stiffening")
    assert levels.at_level(arm_file.load("R"), "first_order") == arm_file.load("R")


@pytest.mark.parametrize(
    ("torque", "velocity", "level"),
    [
        (1e-9, 1e-3, "first_order"), (1e-4, np.inf, "stiffening"),
        (1.0, 1.0, "finite_slope"), (np.inf, 1.0, "finite_slope"),
    ],
)  # fmt: skip
def test_the_level_follows_from_what_the_joints_can_do(two_link, torque, velocity, level):
    joints = tuple(
        replace(j, limits=replace(j.limits, torque=torque, velocity=velocity))
        for j in two_link.joints
    )
    arm = replace(two_link, joints=joints)
    assert levels.level_of(levels.simulated(arm)) == level
    # The file's flags are the least.
    finest = replace(arm, foreshortening=True, finite_slope=True)
    assert levels.level_of(levels.simulated(finest)) == "finite_slope"
    first, stiffening = levels.neglected(arm)
    assert (first <= levels.NEGLIGIBLE, stiffening <= levels.NEGLIGIBLE) == {
        "first_order": (True, True), "stiffening": (False, True), "finite_slope": (False, False)
    }[level]  # fmt: skip


def test_what_is_known_of_a_run_takes_the_place_of_the_limits(two_link):
    still = levels.Drive(torque=np.zeros(2), velocity=np.zeros(2))
    assert levels.level_of(levels.simulated(two_link, drive=still)) == "first_order"
    falls = replace(two_link, gravity=(0.0, -9.81, 0.0))
    assert levels.level_of(levels.simulated(falls, drive=still)) == "finite_slope"
    slow = levels.Drive(acceleration=np.full(2, 1e-4), velocity=np.full(2, 1e-4))
    assert levels.level_of(levels.simulated(two_link, drive=slow)) != "finite_slope"


@pytest.mark.parametrize("name", ["R", "P3", "rigid"])
def test_arms_with_kinematics_of_their_own_or_rigid_ones_stay_as_they_are(name):
    arm = arm_file.load(name)
    assert levels.simulated(arm) is arm
    assert not levels.Range(model.build(arm)).check(
        *(np.full(size, 9.0) for size in (len(arm.joints),) * 2), None
    )


def test_estimates_are_those_of_a_bent_beam(two_link):
    """The foreshortening of the tip against the model's own; the next terms against arcsine and root."""
    arm = two_link
    chain = Chain(levels.at_level(arm, "stiffening"))
    delta = np.array([0.0, 0.0, 0.03, -0.004])
    short, angle, _ = levels.Slopes(chain).neglected(delta)
    length = arm.reach
    origins = sum(j.origin_xyz[0] for j in arm.joints)
    assert short == pytest.approx(
        length + origins - chain.tip_position(np.zeros(2), delta)[0], rel=1e-6
    )
    slope = levels.Slopes(chain).of(delta)[1].max()
    bent = levels.Slopes(chain).deflection(delta)[1]
    assert angle == pytest.approx((1.0 / np.sqrt(1.0 - slope**2) - 1.0) * bent, rel=0.1)


def test_a_level_that_leaves_its_range_reports_it_once(two_link):
    q, qd = np.zeros(2), np.array([1.0, 0.0])
    for level, slope in (("first_order", 0.05), ("stiffening", 0.2), ("finite_slope", 0.6)):
        chain = Chain(levels.at_level(two_link, level))
        unit = levels.Slopes(chain).of(np.eye(4)[0]).max()
        inside, bent = levels.Range(chain), slope / unit * np.eye(4)[0]
        assert not inside.check(q, qd, 0.02 * bent) and inside.warning == ""
        assert inside.error > 0.0
        assert inside.check(q, qd, bent) and not inside.check(q, qd, bent)
        assert f"level {level} of two_link leaves out some" in inside.warning
        inside.reset()
        assert inside.warning == "" and inside.error == 0.0


def test_first_order_counts_the_bending_that_stiffening_would_prevent(two_link):
    """A link that spins at its own bending frequency has lost its stiffness: all of its bending is in doubt."""
    chain = Chain(two_link)
    omega = chain.frequencies(locked=True)[0]
    delta = 1e-4 * np.eye(4)[0]
    errors = []
    for speed in (0.0, omega):
        inside = levels.Range(chain)
        inside.check(np.zeros(2), np.array([speed, 0.0]), delta)
        errors.append(inside.error)
    bent = levels.Slopes(chain).deflection(delta).sum()
    assert errors[0] < 1e-3 * bent < 0.3 * bent < errors[1]
