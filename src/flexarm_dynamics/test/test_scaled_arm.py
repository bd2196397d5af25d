# SPDX-License-Identifier: Apache-2.0
"""An arm with another payload, stiffness or damping than its file says."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models import model

ARMS = ("R", "P3", "one_link", "two_link", "long_reach")


def terms(arm):
    q = np.zeros(len(arm.joints))
    return model.build(arm).terms(q, q)


@pytest.mark.parametrize("name", ARMS)
def test_factors_of_one_change_nothing(name):
    arm = arm_file.load(name)
    assert scaled(arm) == arm


def test_the_payloads_mass_and_inertia_are_scaled_and_its_place_is_not():
    payload = arm_file.load("long_reach").payload
    heavy = scaled(arm_file.load("long_reach"), payload=2.5).payload
    assert heavy.mass == 2.5 * payload.mass
    assert_array_equal(heavy.inertia, 2.5 * np.array(payload.inertia))
    assert heavy.offset == payload.offset


def test_the_rigid_inertia_grows_by_the_added_payload():
    arm = arm_file.load("one_link")
    added = terms(scaled(arm, payload=3.0)).M[0, 0] - terms(arm).M[0, 0]
    length, p = arm.links[0].length, arm.payload
    assert_allclose(added, 2.0 * (p.mass * length**2 + p.inertia[2][2]), rtol=1e-12)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("locked", [True, False])
def test_frequencies_go_with_the_root_of_the_stiffness(name, locked):
    arm = arm_file.load(name)
    soft = scaled(arm, stiffness=0.64)
    wanted = 0.8 * model.build(arm).frequencies(locked=locked)
    assert_allclose(model.build(soft).frequencies(locked=locked), wanted, rtol=1e-9)


@pytest.mark.parametrize("name", ["one_link", "two_link", "long_reach"])
def test_damping_is_scaled_alone(name):
    arm = arm_file.load(name)
    plain, damped = terms(arm), terms(scaled(arm, damping=4.0))
    assert np.abs(plain.C2).max() > 0.0
    assert_allclose(damped.C2, 4.0 * plain.C2, rtol=1e-12, atol=1e-15)
    assert_array_equal(damped.M, plain.M)
    assert_array_equal(damped.K2, plain.K2)
    assert not np.any(terms(scaled(arm, damping=0.0)).C2)


@pytest.mark.parametrize(
    ("name", "value", "limit"),
    [
        ("payload", -1.0, "not below 0, finite"),
        ("stiffness", 0.0, "above 0, finite"),
        ("damping", np.inf, "not below 0, finite"),
        ("payload", np.nan, "not below 0, finite"),
    ],
)
def test_impossible_factors_are_refused_by_name(name, value, limit):
    with pytest.raises(ModelError) as error:
        scaled(arm_file.load("R"), **{name: value})
    assert (error.value.field, error.value.limit) == (f"factor of the {name} of R", limit)
