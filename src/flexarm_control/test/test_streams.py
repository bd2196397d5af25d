# SPDX-License-Identifier: Apache-2.0
"""Streams of points: ends that move, near positions, effort, continuous joints, and another speed."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.trajectory import ReferenceGenerator, Streaming, refuse_torque, validate
from flexarm_control.trajectory.streams import ADD, IGNORE
from flexarm_dynamics.errors import TrajectoryError

S, MS = 10**9, 10**6  # [ns]
STREAM = Streaming(moving_end=True, timeout=0.1, deceleration=2.0, smoothing=0.1)


def one(rows, streaming=STREAM, stamp=0.0, **limits):
    """A trajectory of one joint, from (time, position, velocity, acceleration, effort) rows; None: not given."""
    points = [
        (
            round(row[0] * S),
            *([() if v is None else [v] for v in (*row[1:], *[None] * (5 - len(row)))]),
        )
        for row in rows
    ]
    return validate(["a"], ["a"], round(stamp * S), points, streaming=streaming, **limits)


def held(position=0.0, **options):
    generator = ReferenceGenerator(["a"], **options)
    generator.start([position], 0)
    return generator


def sampled(generator, times):
    """States (k, 3) at times [s]."""
    out = []
    for time in times:
        generator.sample(round(time * S))
        out.append([generator.position[0], generator.velocity[0], generator.acceleration[0]])
    return np.array(out)


def is_smooth(states, step):
    """Whether velocity and acceleration are the derivatives of position and velocity, without steps."""
    for lower, upper in ((0, 1), (1, 2)):
        mean = 0.5 * (states[1:, upper] + states[:-1, upper])
        assert_allclose(np.diff(states[:, lower]) / step, mean, atol=0.02)


def follow(messages, until, step=0.001):
    """States of a generator to which messages are offered at their times, {time [s]: trajectory}."""
    generator, waiting, out = held(), sorted(messages.items()), []
    for time in np.arange(0.0, until, step):
        while waiting and waiting[0][0] <= time + 1e-9:
            verdict = generator.offer(waiting.pop(0)[1])
            assert verdict.accepted, verdict.reason
        out.append(sampled(generator, [time])[0])
    return np.array(out), generator


# --------------------------------------------------------------------------- ends that move


def test_a_last_point_with_a_velocity_goes_on_for_the_timeout_and_comes_to_rest():
    states, generator = follow({0.0: one([(1.0, 0.5, 1.0, 0.0)])}, 2.4)
    # On for 0.1 s, then to rest in 15/16 s: half of that distance.
    assert_allclose(states[1100, :2], [0.6, 1.0], atol=1e-9)
    assert_allclose(states[-1], [0.6 + 0.5 * 15 / 16, 0.0, 0.0], atol=1e-9)
    assert np.abs(states[1000:, 2]).max() <= 2.0 + 1e-6
    is_smooth(states, 0.001)
    assert generator.finished


@pytest.mark.parametrize("timeout", [0.0, 0.2])
def test_the_acceleration_of_the_last_point_goes_without_a_step(timeout):
    streaming = Streaming(moving_end=True, timeout=timeout, deceleration=2.0)
    states, _ = follow({0.0: one([(1.0, 0.5, 1.0, 1.5)], streaming)}, 3.0)
    is_smooth(states[5:], 0.001)
    assert_allclose(states[999:1002, 2], 1.5, atol=0.05)
    assert_allclose(states[-1, 1:], 0.0, atol=1e-9)


def test_an_end_that_moves_is_refused_unless_it_is_allowed():
    with pytest.raises(TrajectoryError, match="allow_nonzero_velocity_at_trajectory_end"):
        one([(1.0, 0.5, 1.0)], Streaming())
    one([(1.0, 0.5, 0.0)], Streaming())


def test_the_arm_has_to_come_to_rest_within_its_limits():
    with pytest.raises(TrajectoryError, match="would come to rest after it, above the limit"):
        one([(1.0, 0.5, 1.0)], position_low=[-1.0], position_high=[0.9])
    one([(1.0, 0.5, 0.5)], position_low=[-1.0], position_high=[0.9])


def test_a_stream_of_points_with_velocities_is_a_smooth_motion():
    """A sine with a gentle start, at 50 Hz, each point sent 20 ms ahead."""

    def wanted(t):
        rise = min(t, 1.0)
        amplitude, rate = rise**2 * (3 - 2 * rise), 6 * rise * (1 - rise) * (t < 1)
        return amplitude * np.sin(2 * t), rate * np.sin(2 * t) + amplitude * 2 * np.cos(2 * t)

    messages = {t: one([(0.02, *wanted(t + 0.02))]) for t in np.arange(150) * 0.02}
    states, _ = follow(messages, 5.2)
    times = np.arange(0.0, 2.9, 0.001)
    assert_allclose(states[: times.size, 0], [wanted(t)[0] for t in times], atol=1e-4)
    assert np.abs(np.diff(states[:, 1])).max() < 0.02  # no step of the velocity
    assert_allclose(states[-1, 1:], 0.0, atol=1e-9)


def test_what_coasting_takes_is_judged(arm_r):
    still = Streaming(moving_end=True, timeout=0.0, deceleration=1e3)
    names = arm_r.joint_names
    start = np.array([[0.0], [1.0], [0.0]])
    for streaming, fits in ((STREAM, True), (still, False)):
        motion = validate(names, names, 0, [(S, [1.0], [1.0], (), ())], streaming=streaming)
        try:
            refuse_torque(arm_r, motion, start, np.array([3.5]))
            assert fits
        except TrajectoryError as error:
            assert not fits
            assert "points[0]: torque of joint" in str(error)


# --------------------------------------------------------------------------- near positions


def test_positions_alone_at_50_hz_have_no_steps_of_velocity_and_end_at_rest():
    messages = {t: one([(0.02, 0.5 * (t + 0.02))]) for t in np.arange(100) * 0.02}
    states, _ = follow(messages, 2.5)
    is_smooth(states, 0.001)
    assert_allclose(states[1000:1900, 1], 0.5, atol=0.01)  # after the start as even as it was sent
    assert np.abs(states[:, 0] - 0.5 * np.arange(2.5, step=0.001).clip(max=2.0)).max() < 0.04
    assert_allclose(states[-1], [1.0, 0.0, 0.0], atol=1e-9)


def test_near_points_of_one_trajectory_are_smoothed_and_far_ones_joined_by_lines():
    times = np.arange(1, 101) * 0.02
    rows = [(t, np.sin(t)) for t in times]
    motion = one(rows)
    states, _ = follow({0.0: motion}, 2.3)
    is_smooth(states, 0.001)
    assert_allclose(states[200:1900, 0], np.sin(np.arange(0.2, 1.9, 0.001)), atol=1e-3)
    assert_allclose(states[-1], [np.sin(2.0), 0.0, 0.0], atol=1e-9)
    assert motion.times_ns[-1] == 2 * S + 50 * MS
    assert one([(0.5, 1.0), (0.7, 2.0)]).velocities is None
    assert one(rows, Streaming()).velocities is None


def test_a_first_point_at_time_0_has_to_be_where_the_arm_is():
    rows = [(t, 0.5 + t) for t in np.arange(50) * 0.02]
    assert "beyond start_tolerance" in held().offer(one(rows)).reason
    assert held(0.5).offer(one(rows)).accepted
    assert "beyond start_tolerance" in held().offer(one(rows[:1])).reason


# --------------------------------------------------------------------------- effort


def test_effort_is_linear_between_the_points_held_at_the_end_and_gone_after_a_stop():
    adds = Streaming(effort=ADD)
    generator = held()
    generator.offer(one([(1.0, 0.1, 0.0, 0.0, 2.0), (2.0, 0.1, 0.0, 0.0, 4.0)], adds))
    for time, effort in ((0.0, 0.0), (0.5, 1.0), (1.5, 3.0), (5.0, 4.0)):
        sampled(generator, [time])
        assert_allclose(generator.effort, effort)
    generator.stop(5 * S, 1.0)
    sampled(generator, [5.0])
    assert_allclose(generator.effort, 4.0)
    sampled(generator, [5.05])
    assert_allclose(generator.effort, 2.0)
    sampled(generator, [5.2])
    assert_allclose(generator.effort, 0.0)
    assert generator.position[0] == 0.1


def test_a_trajectory_without_effort_goes_on_from_that_of_the_one_before():
    generator = held()
    generator.offer(one([(1.0, 0.1, 0.0, 0.0, 2.0)], Streaming(effort=ADD)))
    sampled(generator, [0.0, 1.0])
    generator.offer(one([(1.0, 0.2, 0.0)]))
    sampled(generator, [1.0])
    assert_allclose(generator.effort, 2.0)
    sampled(generator, [1.5])
    assert_allclose(generator.effort, 1.0)
    sampled(generator, [2.5])
    assert_allclose(generator.effort, 0.0)


def test_effort_is_refused_or_ignored_as_it_is_asked_for():
    with pytest.raises(TrajectoryError, match="effort_in_points"):
        one([(1.0, 0.1, 0.0, 0.0, 2.0)])
    assert one([(1.0, 0.1, 0.0, 0.0, 2.0)], Streaming(effort=IGNORE)).effort is None


def test_effort_counts_for_the_torque_that_is_judged(arm_r):
    names = arm_r.joint_names
    for effort, fits in ((1.0, True), (3.0, False)):
        points = [(2 * S, [0.1], [0.0], [0.0], [effort])]
        motion = validate(names, names, 0, points, streaming=Streaming(effort=ADD))
        try:
            refuse_torque(arm_r, motion, np.zeros((3, 1)), np.array([2.0]))
            assert fits
        except TrajectoryError:
            assert not fits


# --------------------------------------------------------------------------- continuous joints


@pytest.mark.parametrize(
    ("here", "wanted", "reached"), [(0.1, 6.2, 6.2 - 2 * np.pi), (20.0, 0.5, 0.5 + 6 * np.pi)]
)
def test_a_continuous_joint_takes_the_short_way(here, wanted, reached):
    generator = held(here, continuous=[True])
    motion = one([(2.0, wanted, 0.0)])
    assert generator.offer(motion).accepted
    assert generator.offer(motion).repeat
    states = sampled(generator, np.linspace(0.0, 2.1, 100))
    assert_allclose(states[-1, 0], reached)
    assert np.abs(states[:, 0] - here).max() <= np.pi
    other = held(here)
    other.offer(one([(2.0, wanted, 0.0)]))
    assert_allclose(sampled(other, [0.0, 2.1])[-1, 0], wanted)


# --------------------------------------------------------------------------- speed scaling


def test_half_the_speed_takes_twice_the_time_with_a_quarter_of_the_acceleration():
    generator, slow = held(), held()
    slow.scale(0.5)
    for each in (generator, slow):
        each.offer(one([(1.0, 1.0, 0.0, 0.0)]))
        each.sample(0)
    whole, half = (
        sampled(g, f * np.linspace(0.0, 1.0, 50)) for g, f in ((generator, 1.0), (slow, 2.0))
    )
    assert_allclose(half, whole * [1.0, 0.5, 0.25], atol=1e-7)
    assert slow.finished
    assert slow.speed_scaling == 0.5


def test_the_factor_changes_smoothly_and_zero_rests_on_the_way():
    generator = held()
    generator.offer(one([(2.0, 1.0, 0.0, 0.0)]))
    changes, out = {0.8: 0.0, 3.0: 1.0, 3.1: 0.4}, []
    for k in range(6500):
        if k / 1000 in changes:
            generator.scale(changes[k / 1000])
        out.append(sampled(generator, [k / 1000])[0])
    states = np.array(out)
    is_smooth(states, 0.001)
    assert np.abs(states[2500:2900, 1:]).max() == 0.0
    assert 0.2 < states[2700, 0] < 0.9
    assert_allclose(states[-1], [1.0, 0.0, 0.0], atol=1e-9)


def test_a_stop_and_a_new_trajectory_go_on_from_a_scaled_one():
    generator, out = held(), []
    generator.offer(one([(2.0, 1.0, 0.0, 0.0)]))
    for k in range(6000):
        if k == 500:
            generator.scale(0.5)
        if k == 1500:
            generator.offer(one([(2.0, 2.0, 0.0, 0.0)]))
        if k == 2500:
            generator.stop(2500 * MS, 1.0)
        out.append(sampled(generator, [k / 1000])[0])
    states = np.array(out)
    is_smooth(states, 0.001)
    assert_allclose(states[-1, 1:], 0.0)
    assert not generator.stopping
    with pytest.raises(TrajectoryError, match="speed_scaling"):
        generator.scale(1.5)


def test_looking_at_any_stamp_changes_nothing():
    generator, other = held(), held()
    for each in (generator, other):
        each.scale(0.7)
        each.offer(one([(2.0, 1.0, 0.0, 0.0)]))
        each.sample(0)
    for time in (0.3, 0.9, 5.0):
        seen = generator.look_at(round(time * S))
        assert (sampled(generator, [0.4]) == sampled(other, [0.4])).all()
        again = held()
        again.scale(0.7)
        again.offer(one([(2.0, 1.0, 0.0, 0.0)]))
        assert_allclose(sampled(again, [0.0, time])[-1], seen[:, 0])
