# SPDX-License-Identifier: Apache-2.0
"""Trajectories: what is refused, how the points are joined, when the reference changes."""

from array import array

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_control.trajectory import (
    MAX_MAGNITUDE,
    MAX_POINTS,
    ReferenceGenerator,
    Verdict,
    validate,
)
from flexarm_control.trajectory.reference import FARTHEST_START
from flexarm_dynamics.errors import NOT_GIVEN, TrajectoryError

S = 10**9  # [ns]
MS = 10**6  # [ns]
ARM = ("a", "b")


def point(time, positions, velocities=(), accelerations=(), effort=()):
    """One point; time in seconds."""
    return (round(time * S), positions, velocities, accelerations, effort)


def one(points, stamp=0):
    """A trajectory for one joint `a`, from (time, position, velocity, acceleration) rows."""
    rows = [point(row[0], *([value] for value in row[1:])) for row in points]
    return validate(["a"], ["a"], round(stamp * S), rows)


def held(position=0.0, stamp=0, **options):
    """A generator of one joint that holds a position since a stamp [s]."""
    generator = ReferenceGenerator(["a"], **options)
    generator.start([position], round(stamp * S))
    return generator


def at(generator, time):
    """Sample at a time [s]: (position, velocity, acceleration) of joint 0."""
    generator.sample(round(time * S))
    return generator.position[0], generator.velocity[0], generator.acceleration[0]


def following(rows, *times, start=0.0, stamp=0.0):
    """A generator that holds a position, has accepted a trajectory, and is sampled at the times."""
    generator = held(start)
    assert generator.offer(one(rows, stamp)).accepted
    for time in times:
        at(generator, time)
    return generator


# --------------------------------------------------------------------------- validation


def test_columns_come_in_the_order_of_the_arm():
    points = [point(0.5, [1.0, 2.0], [3.0, 4.0], [5.0, 6.0]), point(1.25, [7, 8], [0, 0], [9, 10])]
    trajectory = validate(["b", "a"], ARM, 5, points)
    assert (trajectory.joint_names, trajectory.stamp_ns) == (ARM, 5)
    assert_array_equal(trajectory.times_ns, [500 * MS, 1250 * MS])
    assert_array_equal(trajectory.times, [0.5, 1.25])
    assert_array_equal(trajectory.positions, [[2, 1], [8, 7]])
    assert_array_equal(trajectory.velocities, [[4, 3], [0, 0]])
    assert_array_equal(trajectory.accelerations, [[6, 5], [10, 9]])


@pytest.mark.parametrize("fields", [1, 2, 3])
def test_joints_that_are_left_out_stay_where_they_are_held(fields):
    given = [point(1, *[[0.5]] * fields)]
    if fields > 1:
        given.append(point(2, *[[0.5], [0.0], [0.0]][:fields]))
    whole = validate(["b"], ARM, 0, given, held=[0.3, 9.0])
    np.testing.assert_array_equal(whole.positions[:, 0], 0.3)
    np.testing.assert_array_equal(whole.positions[:, 1], 0.5)
    for values in whole.fields[1:]:
        np.testing.assert_array_equal(values[:, 0], 0.0)
        assert values[0, 1] == 0.5
    # A joint that is held beyond a limit stays refused by name; and an empty list of joints is no motion.
    with pytest.raises(TrajectoryError, match="joint a"):
        validate(["b"], ARM, 0, given, [-0.1, -9.0], [0.1, 9.0], held=[0.3, 0.0])
    with pytest.raises(TrajectoryError, match="joint_names"):
        validate([], ARM, 0, [point(1, [])], held=[0.3, 0.0])
    with pytest.raises(TrajectoryError, match="is missing"):
        validate(["b"], ARM, 0, given)


def test_arrays_of_ros_messages_are_read():
    empty = array("d")
    trajectory = validate(ARM, ARM, 0, [(S, array("d", [1.0, 2.0]), empty, empty, empty)])
    assert_array_equal(trajectory.positions, [[1, 2]])
    assert trajectory.velocities is None and trajectory.accelerations is None


def test_arrays_can_not_be_changed_after_the_check():
    trajectory = one([(1, 0.5, 0.0, 0.0)])
    for values in (trajectory.times_ns, *trajectory.fields):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1


GOOD = point(1, [0.0, 0.0])
NAMES, POINTS, STAMP = "joint_names", "points", "header.stamp"
NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("names", "stamp", "points", "field", "value"),
    [
        (["a"], 0, [GOOD], NAMES, "b"),
        (["a", "c"], 0, [GOOD], NAMES, "c"),
        (["a", "b", "a"], 0, [GOOD], NAMES, "a"),
        (None, 0, [GOOD], NAMES, None),
        ({"a": 0, "b": 1}, 0, [GOOD], NAMES, {"a": 0, "b": 1}),
        ({"a", "b"}, 0, [GOOD], NAMES, {"a", "b"}),
        ([["a"], "b"], 0, [GOOD], NAMES, ["a"]),
        ([b"a", "b"], 0, [GOOD], NAMES, b"a"),
        (ARM, 0, [], POINTS, NOT_GIVEN),
        (ARM, 0, None, POINTS, None),
        (ARM, 0, [GOOD, 3], "points[1]", 3),
        (ARM, 0, [GOOD[:4]], "points[0]", GOOD[:4]),
        (ARM, 0, [GOOD] * (MAX_POINTS + 1), POINTS, MAX_POINTS + 1),
        (ARM, 1.0, [GOOD], STAMP, 1.0),
        (ARM, -1, [GOOD], STAMP, -1),
        (ARM, 2**63, [GOOD], STAMP, 2**63),
        (ARM, 2**63 - 1, [GOOD], "points[0].time_from_start", 1.0),
        (ARM, 0, [(1.5, [0, 0], [], [], [])], "points[0].time_from_start", 1.5),
        (ARM, 0, [GOOD, (2**64, [0, 0], [], [], [])], "points[1].time_from_start", 2**64),
        (ARM, 0, [point(-0.5, [0, 0])], "points[0].time_from_start", -0.5),
        (ARM, 0, [GOOD, GOOD], "points[1].time_from_start", 1.0),
        (ARM, 0, [GOOD, point(0.5, [0, 0])], "points[1].time_from_start", 0.5),
        (ARM, 0, [point(1, [])], "points[0].positions", NOT_GIVEN),
        (ARM, 0, [point(1, [], [0, 0])], "points[0].positions", NOT_GIVEN),
        (ARM, 0, [GOOD, point(2, [1])], "points[1].positions", 1),
        (ARM, 0, [GOOD, point(2, [])], "points[1].positions", NOT_GIVEN),
        (ARM, 0, [GOOD, point(2, None)], "points[1].positions", None),
        (ARM, 0, [GOOD, point(2, range(10**30))], "points[1].positions", range(10**30)),
        (ARM, 0, [GOOD, point(2, "12")], "points[1].positions", "12"),
        (ARM, 0, [GOOD, point(2, [None, 1])], "points[1].positions", [None, 1]),
        (ARM, 0, [GOOD, point(2, [[1], 1])], "points[1].positions", [[1], 1]),
        (ARM, 0, [GOOD, point(2, [10**400, 1])], "points[1].positions", [10**400, 1]),
        (ARM, 0, [point(1, [0, 0], [0])], "points[0].velocities", 1),
        (ARM, 0, [GOOD, point(2, [0, 0], [0, 0])], "points[0].velocities", NOT_GIVEN),
        (ARM, 0, [point(1, *[[0, 0]] * 3), point(2, *[[0, 0]] * 2)], "points[1].accelerations", NOT_GIVEN),
        (ARM, 0, [point(1, [0, 0], [], [0, 0])], "points[0]", NOT_GIVEN),
        (["b", "a"], 0, [GOOD, point(2, [NAN, 0])], "points[1].positions of joint b", NAN),
        (ARM, 0, [point(1, [0, 0], [0, 0], [0, -INF])], "points[0].accelerations of joint b", -INF),
        (ARM, 0, [point(1, [2 * MAX_MAGNITUDE, 0])], "points[0].positions of joint a", 2 * MAX_MAGNITUDE),
        (ARM, 0, [point(1, [0, 0], (), (), [0, 0])], "points[0].effort", NOT_GIVEN),
        (ARM, 0, [point(1, [0, 0], (), (), None)], "points[0].effort", None),
        (ARM, 0, [point(1, [0, 0], [0, 1e-3])], "points[0].velocities of joint b", 1e-3),
    ],
)  # fmt: skip
def test_what_can_not_be_followed_is_refused_by_field_and_value(names, stamp, points, field, value):
    with pytest.raises(TrajectoryError) as error:
        validate(names, ARM, stamp, points)
    assert error.value.field == field
    assert repr(error.value.value) == repr(value)


def test_other_names_and_values_that_are_hard_to_show_are_refused():
    with pytest.raises(TrajectoryError, match=r"joint_names: .* is no joint .*; give a, b"):
        validate([np.zeros(2), "b"], ARM, 0, [GOOD])
    with pytest.raises(TrajectoryError, match=r"header\.stamp: a int is out of range"):
        validate(ARM, ARM, 10**5000, [GOOD])


def test_a_refusal_is_written_out_with_its_point_joint_value_and_limit():
    with pytest.raises(TrajectoryError) as error:
        validate(ARM, ARM, 0, [GOOD, point(2, [0, 2.5])], None, [1.0, 2.0])
    assert str(error.value) == "points[1].positions of joint b: 2.5 rad is above the limit (2.0)"


@pytest.mark.parametrize(
    ("points", "field", "value", "limit"),
    [
        ([point(1, [0, -1.5])], "points[0].positions of joint b", -1.5, -1),
        ([point(1, [0, 0]), point(9, [2.5, 0])], "points[1].positions of joint a", 2.5, 2),
        (
            [point(1, [0, 0], [0, -4]), point(9, [0, 0], [0, 0])],
            "points[0].velocities of joint b",
            -4,
            3,
        ),
        # The mean speed between the points.
        ([point(1, [0, 0]), point(1.1, [0, 0.5])], "points[1].positions of joint b", 5, 3),
    ],
)
def test_limits_are_held_by_name(points, field, value, limit):
    with pytest.raises(TrajectoryError) as error:
        validate(ARM, ARM, 0, points, [-2, -1], [2, 1], [np.inf, 3])
    assert (error.value.field, error.value.limit) == (field, limit)
    assert error.value.value == pytest.approx(value)


def test_limits_met_exactly_are_accepted():
    points = [point(0.7, [0.7, 0.0]), point(0.8, [0.8, 1.0]), point(1.8, [2.0, -1.0])]
    validate(ARM, ARM, 0, points, [-2, -1], [2, 1], [1.2, 10.0])
    validate(["a"], ["a"], 0, [point(0.7, [0.7]), point(0.8, [0.8])], velocity_max=[1.0])


@pytest.mark.parametrize(
    ("limit", "field"),
    [
        ([1.0], "velocity_max"),
        ([1.0, NAN], "velocity_max of joint b"),
        (["x", 1.0], "velocity_max"),
    ],
)
def test_limits_of_another_shape_are_refused(limit, field):
    with pytest.raises(TrajectoryError) as error:
        validate(ARM, ARM, 0, [GOOD], velocity_max=limit)
    assert error.value.field == field


junk = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.just(10**5000),
    st.floats(),
    st.text(max_size=3),
    st.binary(max_size=3),
    st.complex_numbers(),
    st.lists(st.integers(), max_size=3),
    st.dictionaries(st.text(max_size=1), st.floats(), max_size=2),
)
numbers = st.one_of(st.floats(), st.floats(-3, 3), st.integers(-3, 3), junk)
values = st.one_of(
    st.lists(st.floats(-3, 3), min_size=2, max_size=2),
    st.lists(numbers, max_size=3),
    st.just([]),
    st.just(array("d", [0.0, 0.0])),
    junk,
)
point_times = st.one_of(st.integers(0, 10 * S), st.integers(), junk)
any_point = st.one_of(
    st.tuples(point_times, values, values, values, st.one_of(st.just([]), values)), junk
)


@settings(max_examples=300, deadline=None)
@given(
    st.one_of(st.permutations(ARM), st.lists(st.one_of(st.sampled_from("abc"), junk)), junk),
    st.one_of(st.just(0), st.integers(), junk),
    st.one_of(st.lists(any_point, max_size=4), junk),
)
@pytest.mark.slow
def test_whatever_comes_only_trajectory_errors_are_raised(names, stamp, points):
    try:
        trajectory = validate(names, ARM, stamp, points)
    except TrajectoryError:
        return
    assert np.isfinite(trajectory.positions).all()


coordinates = st.floats(-MAX_MAGNITUDE, MAX_MAGNITUDE)
pairs = st.lists(coordinates, min_size=2, max_size=2)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 2**62), pairs, pairs, pairs), min_size=1, max_size=4),
    st.integers(1, 3),
    st.integers(0, FARTHEST_START),
    st.lists(st.integers(0, 2**63), max_size=5),
)
def test_whatever_is_accepted_gives_a_finite_reference(rows, fields, stamp, samples):
    rows = sorted({row[0]: row for row in rows}.values())
    points = [(row[0], *row[1 : fields + 1], *[[]] * (3 - fields), []) for row in rows]
    if fields > 1:
        points[-1] = (*points[-1][:2], [0.0, 0.0], *points[-1][3:])
    generator = ReferenceGenerator(ARM, start_tolerance=MAX_MAGNITUDE)
    generator.start([0.0, 0.0], 0)
    assert generator.offer(validate(ARM, ARM, stamp, points)).accepted
    for instant in [*sorted(samples), stamp + rows[-1][0] - 1, stamp + rows[-1][0]]:
        generator.sample(instant)
        for reference in (generator.position, generator.velocity, generator.acceleration):
            assert np.isfinite(reference).all()


# --------------------------------------------------------------------------- interpolation


@pytest.mark.parametrize(
    ("rows", "samples"),
    [
        # Straight lines.
        (
            [(1, 2.0), (3, -2.0)],
            {0.25: (0.5, 2, 0), 1: (2, -2, 0), 2.5: (-1, -2, 0), 3: (-2, 0, 0)},
        ),
        # 3 s^2 - 2 s^3 over 2 s; at s = 1/2: 1/2, 1.5 / 2, 0; at s = 1/4: 3/16 - 2/64 = 5/32, (6/4 - 6/16) / 2,
        # (6 - 12/4) / 4.
        (
            [(2, 1.0, 0.0)],
            {0: (0, 0, 1.5), 0.5: (5 / 32, 9 / 16, 3 / 4), 1: (0.5, 0.75, 0.0), 2: (1.0, 0.0, 0.0)},
        ),
        # 10 s^3 - 15 s^4 + 6 s^5 over 2 s; at s = 1/2: 1/2, (15/8) / 2, 0; at s = 1/4: 53/512,
        # (30 / 16 * 9 / 16) / 2, (60 / 4 * 3 / 4 * 1 / 2) / 4.
        (
            [(2, 1.0, 0.0, 0.0)],
            {0: (0, 0, 0), 0.5: (53 / 512, 135 / 256, 45 / 32), 1: (0.5, 15 / 16, 0.0)},
        ),
    ],
    ids=["lines", "cubic", "quintic"],
)
def test_the_fields_of_the_points_choose_the_interpolation(rows, samples):
    generator = following(rows, 0)
    for time, state in samples.items():
        assert at(generator, time) == pytest.approx(state, abs=1e-14)


@pytest.mark.parametrize(
    ("fields", "knots"), [(2, [0.0, 0.4, 0.41, 1.7, 3.0]), (3, [0.0, 0.4, 0.41, 1.7, 3.0, 4.0])]
)
def test_cubics_reproduce_polynomials_of_degree_three_and_quintics_of_five(fields, knots):
    # (t - T)^fields times a polynomial: at rest at T, where the trajectory has to end.
    end = np.polynomial.Polynomial([-knots[-1], 1.0]) ** fields
    motion = end * np.polynomial.Polynomial([0.3, -0.2, 0.1][:fields])
    rates = [motion, motion.deriv(), motion.deriv(2)]
    generator = following(
        [(t, *(rate(t) for rate in rates[:fields])) for t in knots], start=motion(0.0)
    )
    for t in np.arange(0, knots[-1], 0.01):
        assert at(generator, t) == pytest.approx([rate(t) for rate in rates], rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("fields", [1, 2, 3])
def test_the_reference_is_as_smooth_at_the_points_as_their_fields(fields):
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(6, 3))
    rows[-1, 1:] = 0.0
    generator = following(
        [(0.3 * (i + 1), *row[:fields]) for i, row in enumerate(rows)], start=0.1, stamp=0.05
    )
    for i, row in enumerate(rows):
        knot = round((0.05 + 0.3 * (i + 1)) * S)
        for instant in (knot - 1, knot):
            generator.sample(instant)
            state = (generator.position[0], generator.velocity[0], generator.acceleration[0])
            assert_allclose(state[:fields], row[:fields], atol=1e-5)


@pytest.mark.parametrize("fields", [1, 2, 3])
def test_a_new_trajectory_takes_over_smoothly(fields):
    generator = following([(1, 1.0, 0.0, 0.0)], 0)
    before = at(generator, 0.4)
    generator.offer(one([(0.5, -1.0, 0.0, 0.0)[: fields + 1]], stamp=0.4))
    after = at(generator, 0.4)
    # linear: position; cubic: velocity too; quintic: acceleration too
    assert after[:fields] == before[:fields]
    assert before[1] > 1.0
    assert at(generator, 0.4 + 1e-9)[:fields] == pytest.approx(before[:fields], abs=1e-5)
    assert at(generator, 0.9) == (-1.0, 0.0, 0.0)


def test_all_joints_are_joined_alike_and_apart():
    generator = ReferenceGenerator(ARM)
    generator.start([0.0, 10.0], 0)
    generator.offer(validate(ARM, ARM, 0, [point(1, [1, 9]), point(2, [1, 5])]))
    generator.sample(0)
    generator.sample(S // 2)
    assert_array_equal(generator.position, [0.5, 9.5])
    assert_array_equal(generator.velocity, [1.0, -1.0])
    generator.sample(3 * S // 2)
    assert_array_equal(generator.position, [1.0, 7.0])
    assert_array_equal(generator.velocity, [0.0, -4.0])


# --------------------------------------------------------------------------- when


def test_stamp_zero_starts_at_the_first_sample_after_the_offer():
    generator = held(0.0, stamp=5)
    at(generator, 6)
    verdict = generator.offer(one([(1, 1.0)]))
    assert verdict == Verdict(True, "starts at the next sample", 1)
    assert not generator.active
    assert at(generator, 9)[0] == 0.0
    assert generator.active
    assert not generator.finished and not generator.stopping
    assert at(generator, 9.5)[0] == 0.5
    assert at(generator, 10) == (1.0, 0.0, 0.0)
    assert generator.finished and not generator.active


def test_a_future_stamp_waits_and_starts_between_samples():
    generator = held(0.0)
    verdict = generator.offer(one([(1, 1.0)], stamp=2.0005))
    assert verdict.reason == "starts at 2.0005 s"
    assert at(generator, 2.0) == (0.0, 0.0, 0.0)
    assert not generator.active
    assert at(generator, 2.001)[0] == pytest.approx(0.0005, abs=1e-12)
    assert generator.active


@pytest.mark.parametrize(
    "steps",  # a trajectory that is offered and accepted, or a time and the position then
    [
        # Until a future stamp the old one is followed; then half a second from 2 to 0 in 1 s.
        [one([(4, 4.0)]), (0, 0), one([(1, 0.0)], stamp=2), (1.5, 1.5), (2.25, 1.5), (3, 0)],
        # A new future one replaces the pending one,
        [one([(1, 1.0)], stamp=2), one([(1, -1.0)], stamp=3), (2.5, 0), (3.5, -0.5)],
        # and so does one that starts now.
        [one([(1, 1.0)], stamp=2), one([(1, -1.0)]), (0, 0), (2.5, -1)],
        # A future one leaves alone what starts at the next sample.
        [one([(1, 1.0)]), one([(0, 1.0), (1, 3.0)], stamp=2), (0, 0), (0.5, 0.5), (2.5, 2)],
        # Of two that are due the newer is followed; the older one does not come after it.
        [one([(1, 1.0)]), one([(1, -1.0)], stamp=0.5), (1, -0.5), (1.5, -1), (2.5, -1)],
    ],
)
def test_the_newest_trajectory_is_followed_from_its_start_on(steps):
    generator = held(0.0)
    for step in steps:
        if isinstance(step, tuple):
            assert at(generator, step[0])[0] == step[1]
        else:
            assert generator.offer(step).accepted


def test_a_verdict_names_the_trajectory_that_is_replaced():
    generator = following([(1, 1.0)], stamp=2)
    reason = "starts at 3 s; replaces trajectory 1, which had not started"
    assert generator.offer(one([(1, -1.0)], stamp=3)).reason == reason
    assert "replaces trajectory 2" in generator.offer(one([(1, -1.0)])).reason


def test_a_past_stamp_is_refused():
    generator = held(0.0)
    at(generator, 3)
    reason = "header.stamp: 2750000000 ns is 0.25 s in the past: the arm's clock shows 3 s; use stamp 0 for now"
    assert generator.offer(one([(1, 1.0)], stamp=2.75)) == Verdict(False, reason, 0)
    assert generator.offer(one([(1, 1.0)], stamp=3)).accepted
    assert at(generator, 3.5)[0] == 0.5


def test_a_motion_under_way_is_joined_where_that_is_asked_for():
    """From its own points on: the reference is at the same place as if it had come in time."""
    on_time = held(start_tolerance=0.2)
    late = held(start_tolerance=0.2)
    trajectory = one([(1, 0.0, 0.0), (2, 0.5, 1.0), (3, 1.0, 0.0)], 4.0)
    assert on_time.offer(trajectory).accepted
    at(late, 5.4)
    assert "is 1.4 s in the past" in late.offer(trajectory).reason
    late.joins = True
    verdict = late.offer(trajectory)
    assert verdict.accepted and verdict.joined
    assert verdict.reason == "joined 1.4 s after its start: starts at 5.4 s"
    assert late.offer(trajectory).repeat
    for time in (6.0, 6.3, 6.9, 7.0, 8.0):
        np.testing.assert_allclose(at(late, time), at(on_time, time), atol=1e-12)
    assert not late.offer(one([(0.5, 0.0)], 4.0)).accepted
    assert "and so is its end" in late.offer(one([(0.5, 0.0)], 4.0)).reason


def test_an_arm_that_is_not_on_its_way_gets_a_period_of_its_lowest_mode_to_join():
    generator = held(period=0.8)
    generator.joins = True
    times = np.arange(1, 21) / 10.0
    trajectory = one([(t, t) for t in times], 2.5)
    at(generator, 3.0)
    ahead = generator.ahead(trajectory)
    np.testing.assert_allclose(ahead.times[0], 0.8)
    np.testing.assert_allclose(ahead.positions[:, 0], times[times > 1.25])
    short = generator.ahead(one([(0.6, 0.3), (0.7, 0.5)], 2.5))
    np.testing.assert_allclose(short.times, [0.2])
    assert generator.ahead(one([(0.6, 0.3)], 3.5)).stamp_ns == 3_500_000_000


def test_a_stamp_of_another_clock_is_refused_with_both_clocks():
    generator = held(0.0)
    at(generator, 3)
    verdict = generator.offer(one([(1, 1.0)], stamp=1795361236.8))
    assert not verdict.accepted and not generator.pending
    assert verdict.reason.startswith("header.stamp: 1795361236800000000 ns is 1795361233.8 s ahead")
    assert "the arm's clock shows 3 s" in verdict.reason
    assert generator.offer(one([(1, 1.0)], stamp=3603)).accepted


def test_nothing_is_accepted_before_there_is_a_state():
    generator = ReferenceGenerator(["a"])
    assert generator.offer(one([(1, 1.0)])).reason.startswith("no state yet")
    for act in (lambda: generator.sample(0), lambda: generator.stop(0, 1.0)):
        with pytest.raises(TrajectoryError, match="no state yet"):
            act()


def test_a_trajectory_for_other_joints_is_refused():
    verdict = held(0.0).offer(validate(ARM, ARM, 0, [GOOD]))
    assert verdict.reason.startswith("joint_names: ('a', 'b') are not the joints of this arm (a)")


def test_a_repeat_does_not_restart_the_motion():
    rows = [(1, 1.0, 0.5, 0.0), (2, 1.5, 0.0, 0.0)]
    generator = following(rows, 0)
    half = at(generator, 0.5)
    for _ in range(3):
        repeat = Verdict(False, "repeat of trajectory 1", 1, repeat=True)
        assert generator.offer(one(rows)) == repeat
        assert at(generator, 0.5) == half
    at(generator, 5)
    assert generator.offer(one(rows)).repeat  # after its end as well
    assert generator.accepted_id == 1


def test_a_repeat_with_a_stamp_is_a_repeat_and_not_in_the_past():
    generator = following([(1, 1.0)], 3, stamp=1)
    assert generator.offer(one([(1, 1.0)], stamp=1)).repeat


@pytest.mark.parametrize(
    "other",
    [
        one([(1, np.nextafter(1.0, 2), 0.0)]),
        one([(1.001, 1.0, 0.0)]),
        one([(1, 1.0)]),
        one([(1, 1.0, 0.0, 0.0)]),
        one([(0.5, 0.5, 0.0), (1, 1.0, 0.0)]),
        one([(1, 1.0, 0.0)], stamp=7),
    ],
)
def test_what_differs_is_no_repeat(other):
    generator = following([(1, 1.0, 0.0)])
    assert generator.offer(other).accepted


def test_a_superseded_trajectory_is_no_repeat():
    generator = held(0.0)
    first, second = one([(1, 1.0)]), one([(1, 2.0)])
    assert [generator.offer(t).trajectory_id for t in (first, second, first)] == [1, 2, 3]


def test_what_is_refused_changes_nothing():
    generator = following([(1, 1.0)], 0, 0.5)
    assert not generator.offer(one([(0, 3.0)])).accepted
    assert not generator.offer(one([(1, 3.0)], stamp=0.1)).accepted
    assert at(generator, 0.75)[0] == 0.75
    assert generator.offer(one([(1, 1.0)])).repeat


def test_looking_ahead_does_not_disturb_what_starts_at_the_next_sample():
    def followed(look_ahead):
        generator = following([(4, 4.0)], 0, 1)
        generator.offer(one([(4, 0.0, 0.0)]))
        if look_ahead:  # refused, after the reference at 2 s was looked up
            assert not generator.offer(one([(0, 9.0), (1, 9.0)], stamp=2)).accepted
        return at(generator, 1.5), at(generator, 2)

    assert followed(True) == followed(False)


def test_the_hold_after_the_end_has_no_acceleration():
    generator = following([(1, 1.0, 0.0, 5.0)], 0)
    assert at(generator, 1) == (1.0, 0.0, 0.0)


def test_a_first_point_at_zero_must_be_near_the_reference():
    assert held(0.5).offer(one([(0, 0.509), (1, 1.0)])).accepted
    verdict = held(0.5).offer(one([(0, 0.511), (1, 1.0)]))
    assert not verdict.accepted
    assert verdict.reason.startswith("points[0].positions of joint a: 0.01")
    assert "start_tolerance (0.01); give the first point a time_from_start > 0" in verdict.reason
    assert held(0.5, start_tolerance=0.02).offer(one([(0, 0.511), (1, 1.0)])).accepted


def test_a_first_point_at_zero_of_a_future_start_is_judged_by_the_reference_then():
    generator = following([(4, 4.0)], 0)
    assert not generator.offer(one([(0, 0.0), (1, 1.0)], stamp=2)).accepted
    assert generator.offer(one([(0, 2.0), (1, 1.0)], stamp=2)).accepted
    assert at(generator, 2) == (2.0, -1.0, 0.0)
    assert at(generator, 1.999)[0] == 2.0  # back in time, before the start: the state there


def test_a_speed_to_the_first_point_beyond_the_limit_is_refused():
    generator = held(0.0, velocity_max=[2.0])
    verdict = generator.offer(one([(0.25, 1.0), (2, 1.0)]))
    assert verdict.reason.startswith("points[0].positions of joint a: 4.0 rad/s on average")
    assert generator.offer(one([(0.5, 1.0)])).accepted


def test_samples_are_the_same_in_any_order():
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(50, 3))
    rows[-1, 1] = 0.0
    trajectory = one([(0.1 * i, *row) for i, row in enumerate(rows)], stamp=1)
    knots = S + trajectory.times_ns
    stamps = np.sort(np.concatenate((rng.integers(S, 7 * S, 300), knots - 1, knots)))

    def reference(order):
        generator = held(rows[0, 0])
        generator.offer(trajectory)
        generator.sample(S)
        samples = {}
        for i in order:
            generator.sample(int(stamps[i]))
            samples[i] = generator._state.tobytes()
        return [samples[i] for i in range(len(stamps))]

    forward = reference(range(len(stamps)))
    assert reference(reversed(range(len(stamps)))) == forward
    assert reference(rng.permutation(len(stamps))) == forward


def test_a_single_point_at_zero_ends_at_once():
    generator = following([(0, 0.005)])
    assert at(generator, 1) == (0.005, 0.0, 0.0)
    assert generator.finished
    assert at(generator, 0.5) == (0.005, 0.0, 0.0)  # back in time: the state at the start


def test_start_holds_and_forgets():
    generator, trajectory = following([(1, 1.0)], 0, 0.5), one([(1, 1.0)])
    generator.start([0.25], S)
    assert at(generator, 2) == (0.25, 0.0, 0.0)
    assert not generator.active
    assert generator.offer(trajectory).trajectory_id == 2
    generator.reset()
    assert (generator.accepted_id, generator.position[0]) == (0, 0.0)
    assert generator.offer(trajectory).reason.startswith("no state yet")
    generator.start([0.5], 0)
    assert generator.offer(trajectory).trajectory_id == 1


@pytest.mark.parametrize(
    ("position", "field"),
    [
        ([0.0, 0.0], "joint_position"),
        ([NAN], "joint_position of joint a"),
        (["x"], "joint_position"),
    ],
)
def test_a_position_that_can_not_be_held_is_refused(position, field):
    generator = held(0.75)
    with pytest.raises(TrajectoryError) as error:
        generator.start(position, S)
    assert error.value.field == field
    assert at(generator, 1)[0] == 0.75


@pytest.mark.parametrize("tolerance", [-0.1, NAN, INF])
def test_a_start_tolerance_out_of_range_is_refused(tolerance):
    with pytest.raises(TrajectoryError, match=r"start_tolerance: .* out of range"):
        ReferenceGenerator(["a"], start_tolerance=tolerance)


# --------------------------------------------------------------------------- stop


def test_a_stop_slows_the_trajectorys_own_time_down():
    # 2 rad/s, D = 3 rad/s^2: slowing down takes at most 35 v / (16 T), so T is the first of 0.01 * 1.1^k from 35 / 24 s
    # on; over half of it the reference goes on, in the middle with half its speed.
    generator = following([(5, 10.0)], 0)
    before = at(generator, 1)
    generator.stop(S, 3.0)
    time = generator.path.duration_ns / S
    assert 35 / 24 <= time < 1.1 * 35 / 24
    assert at(generator, 1) == before
    assert generator.stopping
    assert not generator.active
    _, speed, acceleration = at(generator, 1 + time / 2)
    assert (speed, acceleration) == pytest.approx((1.0, -35 / 16 * 2 / time), rel=1e-6)
    assert generator.stopping
    assert at(generator, 1 + time) == (pytest.approx(2.0 + time, abs=1e-9), 0.0, 0.0)
    assert not generator.stopping
    assert not generator.finished


MOTION = [
    point(1, [1, 2], [1, -2], [3, 0]),
    point(2, [3, 0], [0, 1], [0, 2]),
    point(3, [2, 1], [0, 0], [0, 0]),
]


def moved(fields, stop_ns=None, period=0.0, **how):
    """A generator on `MOTION`, with positions, velocities and accelerations or less, and stopped at a stamp."""
    generator = ReferenceGenerator(ARM, period=period)
    generator.start([0.0, 1.0], 0)
    rows = [(row[0], *(row[i] if i <= fields else [] for i in (1, 2, 3)), []) for row in MOTION]
    generator.offer(validate(ARM, ARM, 0, rows))
    generator.sample(0)
    if stop_ns is not None:
        generator.stop(stop_ns, **{"deceleration": 1.0} | how)
    return generator


def sampled(generator, stamps):
    """(k, 3, n) states."""
    out = []
    for stamp in stamps:
        generator.sample(int(stamp))
        out.append(generator._state.copy())
    return np.array(out)


@pytest.mark.parametrize("fields", [1, 2, 3])
@pytest.mark.parametrize("stop", [0.01, 0.3, 0.95, 1.4, 2.2, 2.9])
@pytest.mark.parametrize("given", [True, False])
def test_a_stopping_arm_stays_on_its_path_and_is_never_faster_than_the_motion(fields, stop, given):
    stop_ns = round(stop * S)
    generator = moved(fields, stop_ns, given=given)
    path, end = generator.path, stop_ns + generator.path.duration_ns
    stamps = np.linspace(stop_ns, end, 400).astype(int)
    states = sampled(generator, stamps)
    motion = moved(fields)
    # The time of the path at each stamp, by inverting its first joint where it moves, is that of every joint.
    own = sampled(motion, [round(path.elapsed(int(t)) * S) for t in stamps])
    assert_allclose(states[:, 0], own[:, 0], atol=1e-7)
    assert (np.abs(states[:, 1]) <= np.abs(own[:, 1]) + 1e-9).all()
    assert_array_equal(states[0], own[0])
    assert_array_equal(states[-1, 1:], 0.0)
    assert not generator.stopping


@pytest.mark.parametrize("stop", [0.01, 0.3, 0.95, 1.4, 2.2, 2.9])
def test_a_stop_takes_little_more_than_the_motion_itself(stop):
    stop_ns = round(stop * S)
    states = sampled(moved(3), range(0, 3 * S, S // 1000))
    largest = np.abs(states[:, 2]).max(axis=0)
    jerk = np.abs(np.diff(states[:, 2], axis=0)).max(axis=0) * 1000
    generator = moved(3, stop_ns, given=False, deceleration=1e-3)
    end = stop_ns + generator.path.duration_ns
    stopped = sampled(generator, range(stop_ns, end, S // 1000))[:, 2]
    assert (np.abs(stopped).max(axis=0) <= 1.16 * largest).all()
    assert (np.abs(np.diff(stopped, axis=0)).max(axis=0) * 1000 <= 1.35 * jerk).all()


def test_a_slow_motion_is_stopped_faster_than_it_would_stop_itself():
    generator = following([(1000, 100.0, 0.0, 0.0)], 0)
    at(generator, 500)
    generator.stop(500 * S, 5.0, given=False)  # 0.1875 rad/s, a fifth of 5 rad/s^2
    assert generator.path.duration_ns < 0.5 * S


@pytest.mark.parametrize(("length", "least"), [(0.85, 0.36), (10.0, 0.45)])
def test_a_stop_lasts_more_than_a_period_of_the_lowest_mode(length, least):
    generator = ReferenceGenerator(["a"], period=0.3)
    generator.start([0.0], 0)
    generator.offer(one([(length, 1e-6, 0.0, 0.0)]))
    generator.sample(0)
    generator.stop(round(0.5 * length * S), 1e3, given=False)
    assert generator.path.duration_ns == pytest.approx(least * S)


@pytest.mark.parametrize("stop", [0.3, 0.5, 1.5])
def test_a_motion_that_ends_before_the_stop_and_hardly_farther_is_followed_to_its_end(stop):
    rows, period = [(1, 0.5, 0.6, 0.2), (2, 1.0, 0.0, 0.0)], 2.28
    own, stopped = (held(period=period) for _ in range(2))
    for generator in (own, stopped):
        generator.offer(one(rows))
        at(generator, 0.0)
    stopped.stop(round(stop * S), 1e3, given=False)
    path, later = stopped.path, stop + 0.1
    for time in np.arange(stop, 2.2, 0.07):
        assert at(stopped, time) == pytest.approx(at(own, time), abs=1e-12)
        assert stopped.stopping == (time < 2.0) and not (stopped.active or stopped.finished)
        if time > later:
            stopped.stop(round(time * S), 1e3, given=False)
            assert stopped.path is path or time >= 2.0


@pytest.mark.parametrize(
    ("rows", "stop", "why"),
    [
        ([(2, 1.0, 0.0, 0.0)], 0.1, "it ends much later"),
        ([(1.4, 1.0, 0.0, 0.0), (2, 0.0, 0.0, 0.0)], 1.3, "it turns back"),
        ([(1, 0.5), (2, 1.0)], 1.7, "it ends with a jump of the velocity"),
        ([(2, 1.0, 0.0)], 1.7, "it ends with a jump of the acceleration"),
    ],
)
def test_other_motions_are_slowed_down(rows, stop, why):
    generator = held(period=0.6)
    generator.offer(one(rows))
    at(generator, 0.0)
    speed = generator.path.near(round(stop * S), 0.0, generator._near) and generator._near[1, 0]
    generator.stop(round(stop * S), 1e3, given=False)
    assert generator.path.pace(generator.path.start_ns, 0.3) < 0.9, why
    assert abs(at(generator, stop + 0.3)[1]) < abs(speed) or speed < 0.2


def test_near_is_the_stops_own_derivative():
    generator = moved(3, S * 3 // 10, period=0.4)
    for stamp in (S * 3 // 10, S // 2, S * 6 // 10):
        generator.sample(stamp)
        here, h = generator._state.copy(), 1e-4
        later, earlier = generator.near(h).copy(), generator.near(-h).copy()
        assert_allclose(generator.near(0.0), here, atol=1e-12)
        assert_allclose((later - earlier)[:2] / (2 * h), here[1:], atol=1e-5)


def test_states_around_a_stamp_are_those_near_it():
    held_still, moves, stops = (
        held(),
        following([(1, 1.0, 0.0, 0.0), (2, 0.0, 0.0, 0.0)], 0, 0.5),
        moved(3, S),
    )
    for generator, stamps in (
        (held_still, (S,)),
        (moves, (S // 2, S, 3 * S)),
        (stops, (S * 11 // 10,)),
    ):
        for stamp in stamps:
            generator.sample(stamp)
            found = np.empty((5, 3, generator.position.size))
            generator.around(1e-3, found)
            for i, state in enumerate(found):
                assert_allclose(state, generator.near((i - 2) * 1e-3), rtol=1e-12, atol=1e-13)


def test_the_stops_jerk_and_snap_are_continuous():
    generator = moved(3, S * 3 // 10, period=0.4)
    h, begin, end = 1e-3, S * 3 // 10, S * 3 // 10 + generator.path.duration_ns
    for stamp in (begin, end - 1):
        generator.sample(stamp)
        inside = [generator.near(i * h)[2].copy() for i in range(-2, 3)]
        jerk, snap = np.gradient(inside, h, axis=0), np.diff(inside, 2, axis=0) / h**2
        assert np.ptp(jerk, axis=0).max() < 2.0
        assert np.ptp(snap, axis=0).max() < 200.0


def test_a_stop_within_a_stop_does_not_lengthen_it():
    generator = following([(5, 10.0), (6, 10.0)], 0)
    at(generator, 1)
    generator.stop(S, 3.0)
    path = generator.path
    for k in range(1, 20):
        at(generator, 1 + 0.02 * k)
        generator.offer(one([(9, 0.0)], stamp=5))
        generator.stop(S + k * S // 50, 0.1 + k)
        assert generator.path is path
        assert not generator.pending
    assert at(generator, 1 + path.duration_ns / S)[1:] == (0.0, 0.0)


def test_a_stop_where_the_joints_rest_holds_at_once():
    generator = following([(1, 1.0, 0.0, 0.0), (2, 1.0, 0.0, 0.0), (3, 0.0, 0.0, 0.0)], 0, 1.5)
    generator.stop(S * 3 // 2, 1.0)
    assert not generator.stopping
    assert at(generator, 2.5) == (1.0, 0.0, 0.0)


def test_a_start_with_a_velocity_brakes_straight_on_from_it():
    generator = ReferenceGenerator(ARM, period=0.5)
    generator.start([1.0, 2.0], S, [0.4, -0.8], [1.0, 1.6])
    assert generator.stopping
    time = 35 / 16 * 0.5  # the second joint's
    assert generator.path.duration_ns == pytest.approx(time * S, abs=1)
    states = sampled(generator, np.linspace(S, S + time * S, 200))
    assert_array_equal(states[0], [[1.0, 2.0], [0.4, -0.8], [0.0, 0.0]])
    assert_allclose(states[-1], [[1 + 0.2 * time, 2 - 0.4 * time], [0, 0], [0, 0]], atol=1e-9)
    assert (np.abs(states[:, 2]) <= np.array([0.8, 1.6]) + 1e-9).all()
    assert (np.diff(np.abs(states[:, 1]), axis=0) <= 1e-12).all()
    assert not generator.stopping
    generator.start([1.0, 2.0], S, [1e-6, 0.0])
    assert generator.path.duration_ns == S // 4  # half a period of the links
    generator.start([1.0, 2.0], S, [0.0, 0.0])
    assert (generator.path, generator.stopping) == (None, False)


@pytest.mark.parametrize(
    "velocity, time", [([0.5, 0.0], 1.2), ([-0.5, 0.0], 2.0), ([0.5, -0.25], 0.16)]
)
def test_soft_links_do_not_take_the_braking_out_of_the_range_of_the_trajectory(velocity, time):
    """Half a period of 4 s would take joint a 0.5 rad on; 0.3 rad are left to it. Joint b is out of its range."""
    generator = ReferenceGenerator(ARM, period=4.0)
    generator.start([0.0, 0.0], 0)
    end = (S, [0.9, 0.0], [0.0, 0.0], [0.0, 0.0], ())
    assert generator.offer(validate(ARM, ARM, 0, [end])).accepted
    generator.sample(S // 2)
    generator.start([0.6, -0.1], S // 2, velocity, 1000.0)
    assert generator.path.duration_ns == pytest.approx(time * S, rel=1e-9)


@pytest.mark.parametrize(
    ("velocity", "deceleration", "field"),
    [
        ([NAN], 1.0, "joint_velocity of joint a"),
        ([0.0, 1.0], 1.0, "joint_velocity"),
        ([1.0], 0.0, "deceleration of joint a"),
        ([1.0], 1e-6, "braking time of joint a"),
    ],
)
def test_a_velocity_that_can_not_be_braked_is_refused(velocity, deceleration, field):
    generator = held(0.75)
    with pytest.raises(TrajectoryError) as error:
        generator.start([0.0], S, velocity, deceleration)
    assert error.value.field == field
    assert at(generator, 1)[0] == 0.75


@pytest.mark.parametrize("period", [-0.1, NAN, INF])
def test_a_period_out_of_range_is_refused(period):
    with pytest.raises(TrajectoryError, match=r"period: .* out of range"):
        ReferenceGenerator(["a"], period=period)


def test_a_stop_cancels_what_is_followed_and_what_waits():
    generator = following([(1, 1.0)], 0, 0.5)
    generator.offer(one([(1, 7.0)], stamp=5))
    generator.stop(S // 2, 1.5)
    assert at(generator, 9) == (1.0, 0.0, 0.0)  # the path ends before the stop
    verdict = generator.offer(one([(1, 1.0)]))
    assert (verdict.accepted, verdict.trajectory_id) == (True, 3)


def test_a_trajectory_takes_over_from_a_stop():
    generator = following([(5, 10.0)], 0, 1)
    generator.stop(S, 3.0)
    before = at(generator, 1.5)
    generator.offer(one([(1, 5.0, 0.0, 0.0)], stamp=1.5))
    assert at(generator, 1.5) == before
    assert generator.active
    assert at(generator, 2.5) == (5.0, 0.0, 0.0)


def test_a_stop_of_a_hold_holds():
    generator = held(0.5)
    generator.stop(S, 1.0)
    assert at(generator, 1) == at(generator, 2) == (0.5, 0.0, 0.0)
    assert not generator.stopping


@pytest.mark.parametrize(
    ("deceleration", "field"),
    [
        (0.0, "deceleration of joint a"),
        (NAN, "deceleration of joint a"),
        (INF, "deceleration of joint a"),
        ([1.0, 2.0], "deceleration"),
        ("x", "deceleration"),
    ],
)
def test_a_stop_that_can_not_be_made_is_refused_and_changes_nothing(deceleration, field):
    generator = following([(5, 10.0)], 0)
    with pytest.raises(TrajectoryError) as error:
        generator.stop(0, deceleration)
    assert error.value.field == field
    assert at(generator, 1)[0] == 2.0


def test_a_stop_that_takes_too_long_is_refused_unless_the_path_ends_before():
    generator = following([(8000, 16000.0)], 0)
    with pytest.raises(TrajectoryError) as error:
        generator.stop(0, 1e-9)
    assert error.value.field == "braking time"
    generator = following([(5, 10.0)], 0)
    generator.stop(0, 1e-9)
    assert at(generator, 5.1) == (10.0, 0.0, 0.0)
