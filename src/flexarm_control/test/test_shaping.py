# SPDX-License-Identifier: Apache-2.0
"""Shaped trajectories and streams: exact, from and to where they were, within limits, stopped and replaced smoothly."""

import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from flexarm_control.motions import robust_shapers, shapers
from flexarm_control.shaping import limited, time_law, trajectory_shaper
from flexarm_control.shaping import modes as modes_module
from flexarm_control.shaping.modes import Modes
from flexarm_control.shaping.piecewise import PiecewiseMotion
from flexarm_control.shaping.shaped_motion import ShapedMotion
from flexarm_control.shaping.stream import StreamShaper
from flexarm_control.shaping.trajectory_shaper import TrajectoryShaper
from flexarm_control.trajectory import validate
from flexarm_dynamics.errors import DesignError, MessageError, ParameterError, TrajectoryError
from flexarm_dynamics.parameters import check_all

NAMES = ("a", "b")
S = 1_000_000_000
NOW = 1_700_000_000 * S


def made_modes(**settings):
    return Modes(check_all(modes_module.PARAMETERS, settings), 2)


def shaper(limits=None, law="given", **settings):
    settings = {"frequencies": [2.0]} | settings
    checked = check_all(trajectory_shaper.PARAMETERS, limits or {}, {"joints": 2})
    return TrajectoryShaper(made_modes(**settings), NAMES, checked, law)


def trajectory(times, positions, velocities=None, accelerations=None, stamp=0):
    rows = [
        (
            round(t * S),
            list(positions[i]),
            [] if velocities is None else list(velocities[i]),
            [] if accelerations is None else list(accelerations[i]),
            [],
        )
        for i, t in enumerate(times)
    ]
    return validate(NAMES, NAMES, stamp, rows)


def there(fields, span=1.0, far=1.0, stamp=0):
    """From rest at 0 to rest at (far, -far / 2), through a point in the middle."""
    end = np.array([far, -0.5 * far])
    p = [0.0 * end, 0.5 * end, end]
    v = [0.0 * end, 1.5 * end / span, 0.0 * end]
    a = [0.0 * end] * 3
    own = (p, v, a)[:fields]
    return trajectory([0.0, 0.5 * span, span], *own, stamp=stamp)


def joined(shaped):
    return PiecewiseMotion.through(shaped.times_ns / S, shaped.fields)


@pytest.mark.parametrize("fields", [1, 2, 3])
@pytest.mark.parametrize("kind", ["zv", "zvd", "mzv", "ei", "2hump_ei", "zvdd", "robust"])
def test_points_joined_by_the_controller_are_the_exact_convolution(fields, kind):
    given = there(fields)
    own = shaper(type=kind, frequencies=[2.0, 9.0], dampings=[0.02])
    shaped = own.offer(given, NOW)
    motion, train = joined(given_as_shaped(given)), own.modes.constant()
    t = np.linspace(-0.1, 2.5, 2001)
    for order in range(1 if fields == 1 else 2):
        wanted = train.apply(motion).derivative(order, t)
        assert_allclose(joined(shaped).derivative(order, t), wanted, atol=2e-6 * 10**order)
    assert (shaped.fields[0][0] == given.positions[0]).all()
    assert (shaped.fields[0][-1] == given.positions[-1]).all()
    assert shaped.added == pytest.approx(train.duration, abs=1e-6)


def given_as_shaped(data):
    return trajectory_shaper.Shaped(0, True, data.times_ns, data.fields, 0, 0.0, 1.0)


def ringing(motion, begin, end, frequency, after=3.0, dt=1e-4):
    """Energy amplitude that oscillators of a frequency over time, base moved by joint 0, have at the end [rad]."""
    t = np.arange(begin, end + after, dt)
    y = motion(t)[:, 0]
    w = 2.0 * np.pi * (frequency(y) if callable(frequency) else np.full(t.size, frequency))
    x, v = y[0], 0.0
    for k in range(t.size - 1):  # semi-implicit
        v += dt * w[k] ** 2 * (y[k] - x)
        x += dt * v
    return float(np.hypot(x - y[-1], v / w[-1]))


def test_a_mode_whose_frequency_changes_along_the_motion_does_not_ring():
    far = 2.0
    spread = {
        "frequencies": [2.0, 4.0],
        "configurations": [0.0, 0.0, far, -0.5 * far],
        "type": "zvd",
    }
    given = there(3, span=2.4, far=far)
    varies = shaper(**spread)
    frequency = lambda y: varies.modes.at(np.column_stack([y, -0.5 * y]))[:, 0]  # noqa: E731

    def left(own):
        shaped = own.offer(given, NOW)
        return ringing(joined(shaped).position, 0.0, shaped.times_ns[-1] / S, frequency)

    unshaped, fixed = left(shaper(type="none")), left(shaper(type="zvd", frequencies=[3.0]))
    own = left(varies)
    assert own < 0.1 * unshaped
    assert own < 0.3 * fixed


@pytest.mark.parametrize("varies", [False, True])
def test_the_speed_is_the_derivative_of_the_position_and_the_acceleration_that_of_the_speed(varies):
    more = {"configurations": [0.0, 0.0, 1.0, -0.5]} if varies else {}
    modes = made_modes(type="ei", frequencies=[2.0, 5.0, 2.6, 7.0][: 4 if varies else 2], **more)
    motion = joined(given_as_shaped(there(3)))
    shaped = ShapedMotion(motion, modes)
    t, h = np.linspace(0.01, shaped.end, 300), 1e-5
    p, v, a = (shaped.states(t + d) for d in (-h, 0.0, h))
    assert_allclose((a[0] - p[0]) / (2 * h), v[1], atol=1e-5)
    assert_allclose((a[1] - p[1]) / (2 * h), v[2], atol=2e-2)


@settings(deadline=None)
@example([0.8359375, 0.15625], 0.5, "zv")  # comes near its limit slowly
@given(
    st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=6),
    st.floats(0.5, 20.0),
    st.sampled_from(["zv", "ei", "zvdd"]),
)
def test_speed_and_acceleration_never_grow_and_limits_hold(ways, frequency, kind):
    positions = np.column_stack([np.cumsum([0.0, *ways]), np.zeros(len(ways) + 1)])
    times = 0.3 * np.arange(len(positions))
    velocities = np.zeros_like(positions)
    velocities[1:-1] = (positions[2:] - positions[:-2]) / 0.6
    data = trajectory(times, positions, velocities)
    free = shaper(type=kind, frequencies=[frequency]).offer(data, NOW)
    t = np.linspace(0.0, free.times_ns[-1] / S, 1500)
    given, found = joined(given_as_shaped(data)), joined(free)
    for order in (1, 2):
        peak = np.abs(given.derivative(order, np.linspace(0, times[-1], 4001))).max()
        assert np.abs(found.derivative(order, t)).max() <= peak * (1.0 + 1e-2) + 1e-6
    limits = {"velocity": [0.5], "acceleration": [2.0]}
    bound = shaper(limits, type=kind, frequencies=[frequency]).offer(data, NOW)
    t = np.linspace(0.0, bound.times_ns[-1] / S, 3000)
    assert np.abs(joined(bound).velocity(t)).max() <= 0.5 * (1.0 + 1e-2)
    assert np.abs(joined(bound).acceleration(t)).max() <= 2.0 * (1.0 + 5e-2)
    assert (bound.fields[0][-1] == positions[-1]).all()


def test_what_replaces_a_motion_goes_on_from_it_and_the_whole_is_shaped():
    own, when = shaper(type="zvd"), 0.45
    first = own.offer(there(3), NOW)
    at = own.state(NOW + int(when * S))
    second = own.offer(
        trajectory([0.8], [[0.2, 0.3]], [[0.0, 0.0]], [[0.0, 0.0]]), NOW + int(when * S)
    )
    assert not second.fresh
    assert second.start_ns == NOW + int(when * S)
    early = second.times_ns[0] / S
    assert 0.01 < early < 0.3
    # A controller goes on from where it is: that state and the points that follow.
    times = np.concatenate([[0.0], second.times_ns / S])
    whole = PiecewiseMotion.through(
        times, [np.vstack([a, f]) for a, f in zip(at, second.fields, strict=True)]
    )

    def commanded(t):
        return np.where((t < when)[:, None], joined(first).position(t), whole.position(t - when))

    end = when + times[-1]
    assert_allclose(commanded(np.array([end + 1.0]))[0], [0.2, 0.3], atol=1e-9)
    assert ringing(commanded, 0.0, end, 2.0) < 2e-3
    assert own.state(NOW + int((end + 0.1) * S))[0] == pytest.approx([0.2, 0.3])


def test_a_stop_in_the_middle_ends_on_the_way_without_ringing_and_no_harder_than_allowed():
    limit = 8.0
    own, when = shaper({"acceleration": [limit]}, type="zvd"), 0.6
    first = own.offer(there(3), NOW)
    assert first.stretch == pytest.approx(1.0)
    stop = own.stop(NOW + int(when * S))
    at = joined(first).derivative
    state = [at(k, np.array([when]))[0] for k in range(3)]
    whole = PiecewiseMotion.through(
        np.concatenate([[0.0], stop.times_ns / S]),
        [np.vstack([a, f]) for a, f in zip(state, stop.fields, strict=True)],
    )

    def commanded(t):
        return np.where((t < when)[:, None], joined(first).position(t), whole.position(t - when))

    end = when + stop.times_ns[-1] / S
    last = whole.end
    assert 0.1 < last[0] < 0.99
    assert last[1] == pytest.approx(-0.5 * last[0])  # on its way, which is straight
    assert ringing(commanded, 0.0, end, 2.0) < 2e-3
    t = np.linspace(0.0, stop.times_ns[-1] / S, 2000)
    assert np.abs(whole.acceleration(t)).max() < 1.05 * limit
    assert own.stop(NOW + int((end + 0.1) * S)) is None


@pytest.mark.parametrize("when", [0.1, 0.5, 0.9, 1.4])
@pytest.mark.parametrize("settings", [{}, {"type": "retimed"}])
def test_a_stop_keeps_limits_that_only_the_shaped_motion_keeps(when, settings):
    own = shaper({"acceleration": [4.2]}, **settings)
    assert np.abs(joined_given(there(3)).acceleration(np.linspace(0.0, 1.0, 500))).max() > 6.0
    first = own.offer(there(3), NOW)
    assert first.stretch == 1.0
    stop = own.stop(NOW + round(when * S))
    _, whole, end = commanded(own, first, when, stop)
    t = np.linspace(0.0, end - when - 1e-9, 2000)
    assert np.abs(whole.acceleration(t)).max() < 4.2 * (1.0 + 1e-2)
    assert end < first.times_ns[-1] / S + 1e-6
    assert when > 0.5 or whole.end[0] < 0.95


def test_a_stop_of_lines_slows_down_as_well():
    own = shaper(type="zv")
    own.offer(there(1), NOW)
    stop = own.stop(NOW + int(0.3 * S))
    assert len(stop.fields) == 1
    steps = np.diff(stop.fields[0], axis=0) / np.diff(stop.times_ns)[:, None] * S
    assert np.abs(np.diff(steps, axis=0)).max() < 0.4  # of 1 rad/s


def test_bad_beginnings_are_refused_and_change_nothing():
    own = shaper()
    late = trajectory([0.5, 1.0], [[0, 0], [1, 1]], [[0, 0], [0, 0]])
    with pytest.raises(TrajectoryError, match=r"points\[0\].time_from_start: 0.5 s is after"):
        own.offer(late, NOW)
    assert own.offer(late, NOW, measured=[0.3, 0.4]).fields[0][0] == pytest.approx([0.3, 0.4])
    own = shaper()
    with pytest.raises(TrajectoryError, match=r"positions of joint b: -0\.0 rad is not where"):
        own.offer(there(2), NOW, measured=[0.0, 0.4])
    with pytest.raises(TrajectoryError, match="s ago is when it ended"):
        own.offer(there(2, stamp=NOW - 9 * S), NOW)
    assert own.state(NOW) is None
    with pytest.raises(TrajectoryError, match="velocities: are not given"):
        shaper({"acceleration": [1.0]}).offer(there(1), NOW)
    own.offer(there(2), NOW)
    before = own.state(NOW + S)
    with pytest.raises(TrajectoryError, match="is not where"):
        own.offer(there(2, far=3.0), NOW + S // 2)
    assert (own.state(NOW + S) == before).all()


def test_a_trajectory_that_starts_later_waits():
    own = shaper()
    shaped = own.offer(there(2, stamp=NOW + 2 * S), NOW)
    assert shaped.fresh
    assert shaped.start_ns == NOW + 2 * S
    assert own.state(NOW + S)[0] == pytest.approx([0.0, 0.0])
    assert own.moving(NOW + S)
    assert not own.moving(shaped.end_ns + 1)


def test_points_of_other_fields_while_moving_stay_close_to_the_motion():
    own = shaper(type="zv")
    own.offer(there(3), NOW)
    second = own.offer(trajectory([1.0], [[0.0, 0.0]]), NOW + S // 2)
    assert len(second.fields) == 1
    times = NOW + S // 2 + second.times_ns
    wanted = np.array([own.state(int(t))[0] for t in times])
    assert_allclose(second.fields[0], wanted, atol=1e-6)
    assert np.diff(second.times_ns).max() <= 0.04 * S


def test_parameters_that_do_not_fit_together_are_named():
    with pytest.raises(ParameterError, match=r"shaper.configurations: 3 values are no rows of 2"):
        made_modes(frequencies=[1.0], configurations=[0.0, 0.0, 0.0])
    with pytest.raises(ParameterError, match=r"shaper.frequencies: 3 values for 2 config"):
        made_modes(frequencies=[1.0, 2.0, 3.0], configurations=[0.0] * 2 + [1.0] * 2)
    with pytest.raises(ParameterError, match=r"shaper.frequencies: 0 are not given"):
        made_modes()
    with pytest.raises(ParameterError, match=r"shaper.dampings: 2 values \(3, as freq"):
        made_modes(frequencies=[1.0, 2.0, 3.0], dampings=[0.1, 0.1])
    with pytest.raises(ParameterError, match="row 1 is that of row 0"):
        made_modes(frequencies=[1.0, 2.0], configurations=[0.5] * 4)
    assert not made_modes(type="none").stages


def test_frequencies_between_configurations_are_between_the_measured_ones():
    modes = made_modes(frequencies=[2.0, 8.0, 3.0, 9.0], configurations=[0.0, 0.0, 1.0, 1.0])
    found = modes.at([[0.0, 0.0], [1.0, 1.0], [0.5, 0.5], [9.0, 9.0]])
    assert_allclose(found[:3], [[2.0, 8.0], [3.0, 9.0], [2.5, 8.5]], atol=1e-12)
    assert ((found >= [2.0, 8.0]) & (found <= [3.0, 9.0])).all()


@pytest.mark.parametrize("others", [[19.0], [8.0], [6.0], [4.5]])
def test_the_robust_shaper_takes_out_two_modes_within_a_period_of_the_lower_one(others):
    frequencies = [3.0, *others]
    found = robust_shapers.robust(frequencies, [0.01] * len(frequencies), 0.15, 1.0)
    assert found.duration <= 1.0 / (3.0 * np.sqrt(1 - 1e-4)) + 1e-9
    assert (found.amplitudes > 0.0).all()
    w = 2.0 * np.pi * np.array(frequencies)
    assert found.residual(w, 0.01).max() < 0.04
    off = w[:, None] * np.linspace(0.85, 1.15, 101)
    assert found.residual(off, 0.01).max() < 0.12
    one = shapers.zvd(w[0], 0.01)
    assert one.residual(off, 0.01).max() > found.residual(off, 0.01).max()


def test_without_a_type_a_motion_gets_longer_by_a_period_whatever_the_number_of_modes():
    own = shaper(frequencies=[2.0, 7.0, 11.0])
    assert own.modes.kind == "robust"
    assert own.offer(there(3), NOW).added == pytest.approx(0.5, abs=1e-6)


def test_a_stream_is_shaped_as_a_trajectory_is():
    modes = made_modes(type="ei", frequencies=[2.0, 7.0], dampings=[0.05])
    motion = joined(given_as_shaped(there(3)))
    stream, dt = StreamShaper(modes, NAMES), 2e-3
    t = np.arange(0.0, 2.0, dt)
    found = np.array([stream.step(motion.position(x), dt) for x in t])
    wanted = modes.constant().apply(motion).position(t)
    assert_allclose(found, wanted, atol=5e-5)
    assert stream.settled()
    assert stream.step(motion.end, dt) == pytest.approx(motion.end)


def test_a_stream_over_changing_frequencies_ends_where_it_should_and_hardly_rings():
    modes = made_modes(type="zvd", frequencies=[2.0, 4.0], configurations=[0.0, 0.0, 1.0, -0.5])
    motion, dt = joined(given_as_shaped(there(3, span=2.4))), 2e-3
    stream = StreamShaper(modes, NAMES)
    t = np.arange(0.0, 4.0, dt)
    found = np.array([stream.step(motion.position(x), dt) for x in t])
    assert_allclose(found[-1], motion.end, atol=1e-12)

    def frequency(y):
        return modes.at(np.column_stack([y, -0.5 * y]))[:, 0]

    def output(x):
        return np.column_stack([np.interp(x, t, column) for column in found.T])

    rings = ringing(motion.position, 0.0, 3.2, frequency)
    assert ringing(output, 0.0, 3.2, frequency) < 0.15 * rings


@pytest.mark.parametrize(
    ("values", "problem"),
    [([1.0], "data: 1 values"), ([1.0, np.nan], "joint b: nan is not finite"), ([], "0 values")],
)
def test_malformed_inputs_of_a_stream_are_refused(values, problem):
    with pytest.raises(MessageError, match=problem):
        StreamShaper(made_modes(frequencies=[1.0]), NAMES).check(values)


# New time laws for straight motions: what they leave of modes that change on the way, stopped and replaced, too.

FAR = 2.0
ALONG = {
    "type": "retimed",
    "frequencies": [3.0, 2.0],
    "configurations": [0.0, 0.0, FAR, -0.5 * FAR],
}


def trapezoid(far=FAR, span=1.2):
    """From rest to rest with a third of the time each for the ramps, from 0 to (far, -far / 2)."""
    end, ramp = np.array([far, -0.5 * far]), span / 3.0
    speed = end / (span - ramp)
    done = 0.5 * ramp * speed
    times = [0.0, ramp, span - ramp, span]
    return trajectory(
        times, [0.0 * end, done, end - done, end], [0.0 * end, speed, speed, 0.0 * end]
    )


def frequency(y):
    """Of the mode at positions of joint 0 (k,): even on the way, constant beyond [Hz]."""
    return np.interp(y, [0.0, FAR], [3.0, 2.0])


def off(factor):
    return lambda y: factor * frequency(y)


def test_a_mode_that_changes_along_a_short_motion_is_left_alone_also_15_per_cent_off():
    left = {}
    for kind, own in (("none", {"type": "none"}), ("retimed", ALONG)):
        shaped = shaper(**own).offer(trapezoid(), NOW)
        end = shaped.times_ns[-1] / S
        left[kind] = [ringing(joined(shaped).position, 0.0, end, off(f)) for f in (1.0, 0.85, 1.15)]
    assert shaped.added == pytest.approx(
        0.5, rel=0.02
    )  # a period of the lowest frequency on the way
    assert left["retimed"][0] < 0.03 * left["none"][0]
    assert max(left["retimed"][1:]) < 0.06 * max(left["none"])


@pytest.mark.parametrize("limit", [None, 0.8])
def test_start_end_line_speed_and_acceleration_stay(limit):
    given = trapezoid()
    own = joined_given(given)
    speed, bend = FAR / 0.8, FAR / 0.8 / 0.4
    limits = {} if limit is None else {"velocity": [limit * speed], "acceleration": [limit * bend]}
    shaped = shaper(limits, **ALONG).offer(given, NOW)
    made = joined(shaped)
    t = np.linspace(0.0, shaped.times_ns[-1] / S, 3001)
    p, v, a = made.states(t)
    assert_allclose(p[:, 1], -0.5 * p[:, 0], atol=1e-9)
    assert_allclose(made.end, own.end)
    assert v[:, 0].min() > -1e-3
    assert v[:, 0].max() <= (limit or 1.0) * speed * (1.0 + 1e-6)
    assert np.abs(a[:, 0]).max() <= (limit or 1.0) * bend * (1.0 + 1e-4)


def test_a_new_time_law_accelerates_no_more_than_the_robust_shaper_of_the_same_modes():
    given, own = joined_given(trapezoid()), shaper(**ALONG)
    shaped = ShapedMotion(given, own.modes)
    t = np.linspace(0.0, shaped.end, 4001)
    allowed = np.abs(shaped.states(t)[2]).max()
    made = time_law.retimed(given, own.modes)
    found = np.abs(made.acceleration(np.linspace(0.0, made.duration, 4001))).max()
    assert allowed < 0.9 * np.abs(given.acceleration(t)).max()
    assert found <= allowed * (1.0 + 1e-6)


def test_what_one_mode_hands_to_another_is_the_response_of_both_one_after_the_other():
    """z' = p z + s'' of one mode drives C' = q C + s' z of the other."""
    two = {**ALONG, "frequencies": [3.0, 4.0], "configurations": []}
    motion, modes = joined_given(trapezoid()), shaper(**two).modes
    line = time_law.Line(motion, modes, time_law.along(motion))
    progress, steps, bend = line.history(motion.knots[-1])
    handed = line.coupled(progress, steps, bend[:, None])
    p, q = 2j * np.pi * modes.frequencies[0]
    t = np.linspace(0.0, 1.2, 24001)
    middle, step = 0.5 * (t[1:] + t[:-1]), t[1]
    speed, bend = (line.progress(order, middle) for order in (1, 2))
    each = step * np.exp(-p * middle) * bend
    z = np.exp(p * middle) * (np.cumsum(each) - 0.5 * each)
    wanted = step * np.sum(speed * z * np.exp(q * (1.2 - middle)))
    assert len(handed) == 2
    assert abs(handed[1][1, 0] - wanted) < 0.01 * np.abs(z).max() < 0.1 * abs(wanted)


def test_a_time_law_that_would_leave_more_than_the_given_motion_is_not_used(monkeypatch):
    own = shaper(**ALONG)
    monkeypatch.setattr(time_law.Law, "worst", lambda *_: 1.1)
    assert time_law.retimed(joined_given(trapezoid()), own.modes) is None


def joined_given(data):
    return PiecewiseMotion.through(data.times_ns / S, data.fields)


def test_what_is_not_straight_from_rest_to_rest_gets_the_robust_shaper_for_the_modes_of_all_rows():
    own = shaper(**ALONG)
    bent = trajectory(
        [0.0, 0.6, 1.2],
        [[0.0, 0.0], [1.0, 0.3], [2.0, -1.0]],
        [[0.0, 0.0], [2.0, -1.0], [0.0, 0.0]],
    )
    train = own.modes.constant()
    other = shaper(type="robust", frequencies=[3.0, 2.0]).modes.constant()
    assert_allclose(train.times, other.times)
    t = np.linspace(0.0, 2.0, 400)
    wanted = train.apply(joined_given(bent)).position(t)
    assert_allclose(joined(own.offer(bent, NOW)).position(t), wanted, atol=2e-6)
    assert time_law.retimed(joined_given(there(1)), own.modes) is None  # without speeds


def commanded(own, first, when, second):
    """Positions over time of a trajectory that another one takes the place of at `when` [s], and their end [s]."""
    at = joined(first).derivative
    state = [at(k, np.array([when]))[0] for k in range(len(second.fields))]
    fields = [np.vstack([a, f]) for a, f in zip(state, second.fields, strict=True)]
    whole = PiecewiseMotion.through(np.append(0.0, second.times_ns / S), fields)

    def position(t):
        return np.where((t < when)[:, None], joined(first).position(t), whole.position(t - when))

    return position, whole, when + second.times_ns[-1] / S


@pytest.mark.parametrize("when", [0.1, 0.4, 0.7, 1.3])
def test_a_stop_ends_on_the_line_without_ringing(when):
    own = shaper(**ALONG)
    unshaped = shaper(type="none").offer(trapezoid(), NOW)
    swing = ringing(joined(unshaped).position, 0.0, 1.2, frequency)
    first = own.offer(trapezoid(), NOW)
    stop = own.stop(NOW + round(when * S))
    position, whole, end = commanded(own, first, when, stop)
    assert 0.0 < whole.end[0] <= FAR + 1e-9
    assert whole.end[0] < 0.9 * FAR or when > 0.6
    assert whole.end[1] == pytest.approx(-0.5 * whole.end[0])
    assert end < 1.2 + 0.5 + 0.05
    assert ringing(position, 0.0, end, frequency) < 0.05 * swing
    assert (
        np.abs(whole.acceleration(np.linspace(0.0, end - when, 500))[:, 0]).max() < 1.3 * FAR / 0.32
    )


def test_a_trajectory_that_replaces_one_goes_on_from_it_without_ringing():
    own, when = shaper(**ALONG), 0.6
    first = own.offer(trapezoid(), NOW)
    second = own.offer(trajectory([1.0], [[0.4, 0.3]], [[0.0, 0.0]]), NOW + round(when * S))
    position, whole, end = commanded(own, first, when, second)
    assert not second.fresh
    assert_allclose(whole.end, [0.4, 0.3])
    # Of a frequency that is the same everywhere, the shaper of the change is exact.
    unshaped = shaper(type="none").offer(trapezoid(), NOW)
    swing = ringing(joined(unshaped).position, 0.0, 1.2, frequency)
    assert ringing(position, 0.0, end, frequency) < 0.1 * swing
    steps = np.diff(position(np.linspace(0.0, end, 4000)), axis=0)
    assert np.abs(steps).max() < 1.5 * FAR / 0.8 * end / 4000


# The quickest time laws within limits.

LIMITS = {"velocity": [1.0, 0.4], "acceleration": [4.0, 3.0], "jerk": [30.0, 20.0]}


@pytest.mark.parametrize("law", ["jerk_limited", "time_optimal"])
def test_a_quickest_time_law_keeps_the_line_and_the_limits_and_meets_one_of_them(law):
    own = shaper(LIMITS, law, type="none")
    first = own.offer(trajectory([5.0], [[1.0, -0.5]]), NOW, measured=np.zeros(2))
    motion = joined(first)
    t = np.linspace(0.0, first.times_ns[-1] / S, 4001)
    p, v, a = motion.states(t)
    assert_allclose(p[:, 1], -0.5 * p[:, 0], atol=1e-6)
    assert_allclose(motion.end, [1.0, -0.5])
    parts = [np.abs(x).max(axis=0) / LIMITS[k] for k, x in (("velocity", v), ("acceleration", a))]
    assert max(part.max() for part in parts) <= 1.0 + 1e-5
    assert parts[0][1] == pytest.approx(1.0, abs=1e-3)  # the slower joint goes as fast as it may
    if law == "jerk_limited":
        jerk = np.abs(np.diff(a, axis=0)).max(axis=0) / np.diff(t)[0]
        assert (jerk <= np.array(LIMITS["jerk"]) * (1.0 + 1e-5)).all()


def test_a_time_optimal_motion_passes_all_points_and_a_jerk_limited_one_refuses_a_corner():
    corner = trajectory([1.0, 2.0], [[0.5, 0.0], [0.5, 0.5]])
    made = joined(shaper(LIMITS, "time_optimal", type="none").offer(corner, NOW, np.zeros(2)))
    p, v, a = made.states(np.linspace(0.0, made.duration, 4001))
    for point in corner.positions:
        assert np.abs(p - point).max(axis=1).min() < 1e-3
    assert (np.abs(v).max(axis=0) <= np.array(LIMITS["velocity"]) * (1.0 + 1e-6)).all()
    assert (np.abs(a).max(axis=0) <= np.array(LIMITS["acceleration"]) * (1.0 + 1e-3)).all()
    with pytest.raises(
        TrajectoryError, match=r"points\[0\].positions of joint .* beside the straight line"
    ):
        shaper(LIMITS, "jerk_limited", type="none").offer(corner, NOW, np.zeros(2))


def test_a_curved_path_of_many_points_takes_one_time_and_the_motion_does_not_grow_with_them():
    v, a = np.array([1.0, 0.8]), np.array([4.0, 3.0])
    made = []
    for count in (20, 600):
        x = np.linspace(0.0, 1.0, count)
        made.append(limited.time_optimal(np.column_stack([np.sin(2.0 * x), x**2]), v, a))
        t = np.linspace(0.0, made[-1].duration, 4001)
        tops = [np.abs(made[-1].derivative(k, t)).max(axis=0) / m for k, m in ((1, v), (2, a))]
        assert max(top.max() for top in tops) <= 1.0 + 1e-6
        assert (tops[0] > 0.99).all()
        assert made[-1].knots.size < 1500
    assert made[0].duration == pytest.approx(made[1].duration, rel=1e-3)


def test_points_microseconds_apart_are_joined_within_the_limits():
    limits = {"velocity": [1.0, 0.8], "acceleration": [4.0, 3.0]}
    own = shaper(limits, "time_optimal", type="robust", frequencies=[2.0, 7.0])
    shaped = own.offer(trajectory([0.0, 1.0, 2.0], [[0.0, 0.0], [0.9, 0.3], [-0.5, -0.2]]), NOW)
    motion = joined(shaped)
    pieces = np.diff(motion.knots)
    assert pieces.min() < 1e-5
    places = (motion.knots[:-1, None] + pieces[:, None] * [0.001, 0.5, 0.999]).ravel()
    assert (np.abs(motion.acceleration(places)) < 1.01 * np.array([4.0, 3.0])).all()


@pytest.mark.parametrize(
    ("points", "duration"),
    [
        # A point half-way along the path, but for rounding, is as one of the grid; so is one as close to another point.
        ([[0.0, 0.0], [0.6, 0.7], [1.2, 0.0]], 2.5),
        ([[0.0, 0.0], [0.8, 0.3], [1.6, 0.0]], 2.5),
        ([[0.0, 0.0], [0.25, 0.3], [0.25 + 1e-9, 0.3], [1.0, 0.0]], 1.6),
    ],
)
def test_points_that_nearly_meet_make_no_endless_motion(points, duration):
    motion = limited.time_optimal(points, [1.0, 1.0], [4.0, 4.0])
    assert motion.duration < duration
    assert_allclose(motion.end, points[-1], rtol=0.0, atol=1e-15)
    away = np.abs(motion.position(np.linspace(0.0, motion.duration, 4000)) - points[1]).max(axis=1)
    assert away.min() < 1e-3


def test_a_jerk_limited_motion_is_replaced_on_the_way_and_a_time_optimal_one_is_not():
    there_and = trajectory([1.0], [[1.0, -0.5]])
    back = trajectory([1.0], [[0.0, 0.0]])
    own = shaper(LIMITS, "jerk_limited", type="zvd")
    own.offer(there_and, NOW, np.zeros(2))
    at = own.state(NOW + S // 2)
    replaced = own.offer(back, NOW + S // 2)
    assert not replaced.fresh
    assert_allclose(replaced.fields[0][0], at[0], atol=0.1)
    assert_allclose(replaced.fields[0][-1], [0.0, 0.0])
    own = shaper(LIMITS, "time_optimal", type="zvd")
    own.offer(there_and, NOW, np.zeros(2))
    with pytest.raises(TrajectoryError, match="begins at rest"):
        own.offer(back, NOW + S // 2)


def test_a_quickest_time_law_needs_its_limits_and_its_library(monkeypatch):
    with pytest.raises(
        ParameterError, match=r"limits.jerk: .*needs limits.velocity, .*limits.jerk"
    ):
        shaper({**LIMITS, "jerk": [1.0, 0.0]}, "jerk_limited")
    monkeypatch.setitem(sys.modules, "toppra", None)
    with pytest.raises(DesignError, match="pip install toppra"):
        shaper(LIMITS, "time_optimal")
