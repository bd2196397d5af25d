# SPDX-License-Identifier: Apache-2.0
"""Arms for the tests of the control package."""

from dataclasses import replace

import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.models import model


@pytest.fixture(scope="session")
def arm_r():
    """Model of the paper's arm, recommended data."""
    return model.build(arm_file.load("R"))


@pytest.fixture(scope="session")
def arm_p3():
    """Model of the paper's arm, data that reproduces the published numbers."""
    return model.build(arm_file.load("P3"))


@pytest.fixture(scope="session")
def lab():
    """Model of arm R with four gauges for its two modes."""
    return model.build(arm_file.load("R_lab"))


@pytest.fixture(scope="session")
def heavy_arm():
    """Fully derived arm in a vertical plane, with joint friction."""
    arm = arm_file.load("one_link")
    joint = replace(arm.joints[0], friction=Friction(viscous=0.3, coulomb=0.2, smoothing=0.05))
    return model.build(replace(arm, joints=(joint,), gravity=(0.0, -9.81, 0.0)))
