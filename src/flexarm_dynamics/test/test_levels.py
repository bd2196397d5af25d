# SPDX-License-Identifier: Apache-2.0
"""Levels of the kinematics at which arms are simulated."""

from dataclasses import replace

import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models import levels


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
