# SPDX-License-Identifier: Apache-2.0
"""Errors carry fields, have one rendering, and travel between processes."""

import pickle

import numpy as np
import pytest

from flexarm_dynamics import errors
from flexarm_dynamics.errors import (
    NOT_GIVEN,
    ArmFileError,
    FlexarmError,
    MessageError,
    ParameterError,
    check_finite,
)

KINDS = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, FlexarmError)
]


@pytest.mark.parametrize(
    "given, text",
    [
        ({}, "is wrong"),
        ({"field": "links[0].length"}, "links[0].length: is wrong"),
        ({"value": 7.0}, "7.0 is wrong"),
        ({"value": None}, "None is wrong"),
        ({"limit": "at most 5"}, "is wrong (at most 5)"),
        ({"hint": "write 5.0"}, "is wrong; write 5.0"),
        (
            {"field": "kp", "value": 7.0, "limit": "at most 5", "hint": "write 5.0"},
            "kp: 7.0 is wrong (at most 5); write 5.0",
        ),
    ],
)
def test_an_error_is_written_out_in_one_way(given, text):
    error = FlexarmError("is wrong", **given)
    assert str(error) == text
    assert error.problem == "is wrong" and error.field == given.get("field", "")
    assert error.value is given.get("value", NOT_GIVEN)
    assert (error.limit, error.hint) == (given.get("limit"), given.get("hint", ""))


def test_a_long_value_is_cut_short():
    assert len(str(ParameterError("is no number", field="kp", value="x" * 10_000))) < 300


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_an_error_travels_whole(kind):
    given = {"value": [1.0], "limit": "three", "hint": "write three"}
    made = (
        kind("links", "is short", **given)
        if kind is ArmFileError
        else kind("is short", field="links", **given)
    )
    again = pickle.loads(pickle.dumps(made))
    assert (
        pickle.loads(pickle.dumps(kind("a", "b") if kind is ArmFileError else kind("a"))).value
        is NOT_GIVEN
    )
    assert type(again) is kind and vars(again) == vars(made) and str(again) == str(made)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e6, -1e12])
def test_a_measurement_that_is_none_is_refused_with_its_joint(bad):
    check_finite(np.array([9.9e5, -9.9e5]), ("a", "b"), "joint_position")
    with pytest.raises(MessageError) as error:
        check_finite(np.array([1.0, bad, np.nan]), ("a", "b", "c"), "joint_position")
    assert error.value.field == "joint_position of b"
    np.testing.assert_equal(error.value.value, bad)
    assert error.value.limit == (errors.MAX_MEASUREMENT if np.isfinite(bad) else None)
