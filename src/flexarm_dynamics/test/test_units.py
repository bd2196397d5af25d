# SPDX-License-Identifier: Apache-2.0
"""Conversion from ft, lbf, s to SI."""

import pytest

from flexarm_dynamics.arm.units import (
    DIMENSIONS,
    FOOT,
    POUND_FORCE,
    POUND_FORCE_FOOT,
    SI_UNIT,
    to_si,
)


def test_base_units_are_exact():
    assert FOOT == 0.3048
    assert POUND_FORCE == 4.4482216152605
    assert pytest.approx(0.45359237 * 9.80665, rel=1e-15) == POUND_FORCE
    assert POUND_FORCE_FOOT == POUND_FORCE * FOOT


@pytest.mark.parametrize(
    "dimension, factor",
    [
        ("none", 1.0),
        ("angle", 1.0),
        ("frequency", 1.0),
        ("length", 0.3048),
        ("acceleration", 0.3048),
        ("mass", 14.593902937206364),  # slug
        ("inertia", 1.3558179483314003),
        ("torque", 1.3558179483314003),
        ("viscous", 1.3558179483314003),
        ("mass_per_length", 47.88025898033584),
        ("density", 515.3788183931961),  # slug/ft^3
        ("stress", 47.88025898033584),  # lbf/ft^2
        ("stiffness", 0.4132533106513042),  # lbf ft^2
    ],
)
def test_imperial_factors_are_those_of_the_tables_and_si_stays_as_it_is(dimension, factor):
    assert to_si("imperial", dimension) == pytest.approx(factor, rel=1e-13)
    assert to_si("si", dimension) == 1.0


def test_every_dimension_has_a_unit_for_messages():
    assert set(DIMENSIONS) == set(SI_UNIT)
    assert len(DIMENSIONS) == 14
