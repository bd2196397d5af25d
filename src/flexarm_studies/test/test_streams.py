# SPDX-License-Identifier: Apache-2.0
"""Streams with clocks of their own become one recording, or are refused by name."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.recordings import streams


def joints(rate=125.0, seconds=4.0, start=100.0):
    time = start + np.arange(int(seconds * rate)) / rate
    swing = np.sin(2.0 * np.pi * 3.0 * (time - 100.0))
    return streams.of_joints(
        "joint_states", time, ["a", "b"], position=np.column_stack([swing, 0.0 * swing])
    )


def imu(rate=400.0, seconds=4.0, start=100.2):
    time = start + np.arange(int(seconds * rate)) / rate
    swing = np.cos(2.0 * np.pi * 3.0 * (time - 100.0))[:, None] * [1.0, 0.0, 2.0]
    return streams.of_imu("/tip/imu", time, swing, np.full_like(swing, np.nan))


def test_the_fastest_gives_the_grid_and_the_others_are_between_their_samples():
    made = streams.join([joints(), imu()])
    time = made.start + made.time
    assert made.period == pytest.approx(1.0 / 400.0) and made.start == pytest.approx(100.2)
    assert made.joint_names == ("a", "b") and made.imu_names == tuple(f"tip_imu_{x}" for x in "xyz")
    np.testing.assert_allclose(
        made.position[:, 0], np.sin(2.0 * np.pi * 3.0 * (time - 100.0)), atol=2e-3
    )
    np.testing.assert_allclose(
        made.linear_acceleration[:, 2], 2.0 * np.cos(6.0 * np.pi * (time - 100.0)), atol=1e-6
    )
    assert made.angular_velocity is None and "2 streams on the grid of /tip/imu" in made.notes


def test_a_gap_in_one_is_a_gap_of_all():
    whole = imu()
    keep = (whole.time < 101.0) | (whole.time > 101.5)
    broken = streams.Stream(
        whole.name, whole.time[keep], {q: v[keep] for q, v in whole.signals.items()}, whole.names
    )
    made = streams.join([joints(), broken])
    assert made.start == pytest.approx(101.5, abs=0.01) and any(
        "gaps" in note for note in made.notes
    )


def test_repeated_and_late_samples_are_left_out():
    whole = joints()
    order = np.r_[0:100, 90:100, 100 : len(whole.time)]
    again = streams.Stream(
        "again", whole.time[order], {"position": whole.signals["position"][order]}, whole.names
    )
    np.testing.assert_allclose(
        streams.join([again]).position, streams.join([whole]).position, atol=1e-12
    )


@pytest.mark.parametrize(
    "made, message",
    [
        (lambda: [], "has no samples"),
        (lambda: [joints(seconds=0.1)], "joint_states: 12 samples can be used"),
        (lambda: [joints(), imu(start=500.0)], "no usable time in common"),
        (
            lambda: [
                streams.of_joints("j", np.arange(99.0), ["a"], position=np.full((99, 1), np.nan))
            ],
            "position of a",
        ),
        (
            lambda: [streams.of_imu("i", np.arange(99.0), *[np.full((99, 3), np.inf)] * 2)],
            "no quantity",
        ),
        (
            lambda: [streams.of_imu("i", np.full(99, 5.0), *[np.zeros((99, 3))] * 2)],
            "1 samples can be used",
        ),
        (
            lambda: [streams.of_joints("j", np.arange(99.0), ["a"], strain=np.zeros((99, 1)))],
            "none of joints",
        ),
        (  # the slope at the end is more than a number of 64 bits
            lambda: [
                streams.of_joints(
                    "j", 0.01 * np.arange(22), ["a"], position=4.5e305 * np.eye(22)[:, 21:]
                )
            ],
            "j: position.* changes by too much between samples.*remove",
        ),
    ],
)
def test_what_can_not_be_joined_is_refused_by_name(made, message):
    with pytest.raises(FlexarmError, match=message):
        streams.join(made())


numbers = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(numbers, numbers), max_size=60), st.booleans())
def test_any_numbers_make_a_recording_or_an_error_with_a_name(rows, grow):
    """Times and values as they come; with `grow`, times that ascend with the values as they come."""
    table = np.array(rows, float).reshape(-1, 2)
    time = np.arange(len(table)) * 0.01 if grow else table[:, 0]
    try:
        made = streams.join([streams.of_joints("odd", time, ["a"], position=table[:, 1:])])
    except FlexarmError as error:
        assert str(error)
        return
    assert np.isfinite(made.position).all() and made.period > 0.0
