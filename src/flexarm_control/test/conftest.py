# SPDX-License-Identifier: Apache-2.0
"""Arms for the tests of the control package."""

from dataclasses import replace

import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.models import model


class Arms(dict):
    """Models of the shipped arms by name, each built when it is first used."""

    def __missing__(self, name):
        self[name] = model.build(arm_file.load(name))
        return self[name]


@pytest.fixture(scope="session")
def arms():
    """Models of the shipped arms by name."""
    return Arms()


@pytest.fixture(scope="session")
def arm_r(arms):
    """Model of the paper's arm, recommended data."""
    return arms["R"]


@pytest.fixture(scope="session")
def arm_p3(arms):
    """Model of the paper's arm, data that reproduces the published numbers."""
    return arms["P3"]


@pytest.fixture(scope="session")
def one_link(arms):
    """Fully derived arm of one flexible link."""
    return arms["one_link"]


@pytest.fixture(scope="session")
def two_link(arms):
    """Planar arm of two flexible links."""
    return arms["two_link"]


@pytest.fixture(scope="session")
def long_reach(arms):
    """Arm of four joints in space."""
    return arms["long_reach"]


@pytest.fixture(scope="session")
def rigid(arms):
    """Two rigid links under gravity."""
    return arms["rigid"]


@pytest.fixture(scope="session")
def lab(arms):
    """Model of arm R with four gauges for its two modes."""
    return arms["R_lab"]


@pytest.fixture(scope="session")
def heavy_arm():
    """Fully derived arm in a vertical plane, with joint friction."""
    arm = arm_file.load("one_link")
    joint = replace(arm.joints[0], friction=Friction(viscous=0.3, coulomb=0.2, smoothing=0.05))
    return model.build(replace(arm, joints=(joint,), gravity=(0.0, -9.81, 0.0)))
