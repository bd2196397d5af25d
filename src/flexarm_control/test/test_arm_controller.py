# SPDX-License-Identifier: Apache-2.0
"""The controller of an arm: its states, what it answers to a bad sample, its limits."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_control import trajectory
from flexarm_control.component import at_rest
from flexarm_control.composite.design import design
from flexarm_control.loop.arm_controller import MAX_REPEATS, PARAMETERS, ArmController
from flexarm_control.loop.authority import Authority
from flexarm_control.loop.samples import ArmSample
from flexarm_control.loop.supervisor import State
from flexarm_dynamics.arm.units import POUND_FORCE_FOOT
from flexarm_dynamics.errors import DesignError, ParameterError
from flexarm_dynamics.models.model import build
from flexarm_dynamics.parameters import check_all
from flexarm_dynamics.singular_perturbation import slow_subsystem

MS = 10**6  # [ns]
FILE_LIMIT = 10.0 * POUND_FORCE_FOOT  # [N m] of arm R
SLOW = {"type": "linear_model_following"}
FAST = {"type": "lqr", "q": [20.0, 20.0, 1000.0, 6e5], "configuration": [np.pi / 2]}


def stamp(k):
    return 10**9 + k * MS


def sample(k=0, position=0.0, session=1, n=1, **fields):
    """Sample k of 1 kHz: arm at rest, straight; fields replace its own."""
    s = ArmSample(n, 2)
    s.stamp_ns, s.session, s.sequence = fields.pop("stamp_ns", stamp(k)), session, k
    s.position[:], s.rate = position, np.zeros(2)
    for name, value in fields.items():
        plain = value is None or name in ("trust", "doubt", "controller_id")
        setattr(s, name, value if plain else np.array(value, float))
    return s


#: Torque at once and at any rate: what the law gives is what is sent. Motions may be shorter than an arm could do.
AT_ONCE = {"return_time": 0.0, "torque_rate_limit": [1e9], "trajectory_torque_margin": 0.0}


def controller(model, law=None, **settings):
    law, settings = law or design(model, SLOW, FAST), {**AT_ONCE, **settings}
    checked = check_all(PARAMETERS, settings, {"joints": model.n_joints, "modes": model.n_modes})
    return ArmController(model, law, checked)


def started(model, law=None, **settings):
    """A controller that has answered sample 0."""
    core = controller(model, law, **settings)
    core.step(sample(0))
    return core


def feed(core, numbers, *position):
    """Answers to the samples of these numbers."""
    return [core.step(sample(k, *position)) for k in numbers]


def motion(end=0.1, duration=0.02, start=0.0, at_ns=0):
    """A trajectory of one joint, 0.02 s long."""
    ns = round(duration * 1e9)
    points = [(0, [start], [0.0], [0.0], ()), (ns, [end], [0.0], [0.0], ())]
    return trajectory.validate(["joint1"], ["joint1"], at_ns, points)


def answer(core):
    """All that an answer is made of."""
    return (
        core.enabled,
        core.state,
        core.saturated,
        core.reason,
        core.trajectory_id,
        core.torque.tolist(),
        core.reference.position.tolist(),
        core.position_error.tolist(),
        core.velocity_error.tolist(),
    )


class Scripted:
    """A law that returns the given torques."""

    def __init__(self, *torques):
        self.torques = list(torques)
        self.needs_rates, self.limit, self.feedforward = True, None, None
        self.free, self.fast_fraction = False, 1.0

    def reset(self):
        pass

    def step(self, q, qd, delta, delta_d, reference, dt):
        value = self.torques.pop(0)
        if isinstance(value, BaseException):
            raise value
        return np.atleast_1d(np.array(value, float))


# --------------------------------------------------------------------------- states


def test_states_go_from_inactive_over_ready_and_tracking_to_holding_and_back(arm_r):
    core, seen = controller(arm_r), []
    assert core.brake("because") is False  # there is nothing to stop
    assert core.state == State.INACTIVE
    for k in range(80):
        assert core.step(sample(k)) is True
        seen.append(core.state)
        if k == 4:
            assert core.offer(motion(at_ns=stamp(10))).trajectory_id == core.trajectory_id == 1
        if k == 40:
            assert_array_equal(core.reference.position, [0.1])
            assert core.offer(motion(end=0.3, start=0.1)).trajectory_id == core.trajectory_id == 2
    R, T, H = State.READY, State.TRACKING, State.HOLDING
    assert seen == [R] * 10 + [T] * 20 + [H] * 11 + [T] * 20 + [H] * 19
    assert_array_equal(core.reference.position, [0.3])


def test_ready_holds_the_joint_where_it_was_found(arm_r):
    core = controller(arm_r)
    core.step(sample(0, position=0.7))
    assert_array_equal(core.reference.position, [0.7])
    assert_array_equal(core.torque, [0.0])
    core.step(sample(1, position=0.69))
    assert_allclose(core.position_error, [0.01], rtol=1e-12)
    assert core.torque[0] > 0.0
    assert core.state == State.READY


def test_the_torque_is_that_of_the_composite_control(arm_r):
    core, law = controller(arm_r), design(arm_r, SLOW, FAST)
    core.step(sample(0))
    s = sample(1, 0.01, velocity=[0.2], amplitude=[0.001, 1e-4], rate=[0.01, 2e-3])
    core.step(s)
    wanted = law.step(s.position, s.velocity, s.amplitude, s.rate, at_rest([0.0]))
    assert_array_equal(core.torque, wanted)
    assert_array_equal(core.position_error, [-0.01])
    assert_array_equal(core.velocity_error, [-0.2])


# --------------------------------------------------------------------------- repeats and restarts


def test_a_repeated_sample_is_answered_from_the_cache_to_the_last_bit(arm_r):
    core, clean = controller(arm_r), controller(arm_r)
    for c in (core, clean):
        c.step(sample(0))
        c.offer(motion())
    for k in range(1, 30):
        assert core.step(sample(k, 1e-4 * k)) is clean.step(sample(k, 1e-4 * k))
        for _ in range(3):
            # what it carries does not matter, unless it can't be used
            assert core.step(sample(k, position=0.5, stamp_ns=stamp(k + 7))) is True
        assert answer(core) == answer(clean)


def test_a_repeat_changes_no_rate_limited_torque(arm_r):
    core = controller(arm_r, Scripted(5.0, 5.0, 5.0), torque_rate_limit=[100.0])
    for k in range(3):
        core.step(sample(k))
        for _ in range(3):
            core.step(sample(k))
        assert_allclose(core.torque, [0.1 * k], rtol=1e-12)


def test_a_new_session_before_any_torque_starts_at_the_measured_position(arm_r):
    core = controller(arm_r)
    core.step(sample(50, rate=None))
    core.offer(motion())
    # earlier stamps and numbers: the simulator was reset
    for k in range(40):
        assert core.step(sample(k, 0.02, session=2)) is True
        assert core.state == State.READY
        assert_array_equal(core.reference.position, [0.02])


def test_a_new_session_of_an_arm_that_rests_where_it_did_goes_on_in_a_ramp(arm_r):
    core = controller(arm_r, Scripted(*[2.0] * 19), return_time=0.1)
    feed(core, range(50, 60))
    assert core.step(sample(0, 0.002, session=2)) is True
    assert (core.state, core.reason) == (State.READY, "")
    assert_array_equal(core.torque, [0.0])
    core.step(sample(50, 0.002, session=2))
    assert_allclose(core.torque, [0.5], rtol=1e-12)


RESTARTS = {
    "has restarted during a motion": (True, {}),
    "has restarted, and joint1 is at 0.5 rad, before at 0": (False, {"position": 0.5}),
    "has restarted while joint1 moves (0.3 rad/s)": (False, {"velocity": [0.3]}),
}


@pytest.mark.parametrize("reason", RESTARTS)
def test_a_new_session_in_motion_or_elsewhere_is_a_latched_fault(arm_r, reason):
    moving, fields = RESTARTS[reason]
    core = started(arm_r)
    if moving:
        core.offer(motion(duration=0.5))
    feed(core, range(1, 10))
    assert core.step(sample(0, session=2, **fields)) is False
    assert core.state == State.FAULT and reason in core.reason
    assert not any(core.step(sample(k, session=2)) for k in range(1, 9))
    assert core.recover()
    assert core.step(sample(9, session=2)) is True


def test_a_sample_that_comes_after_a_later_one_needs_no_answer_and_changes_nothing(arm_r):
    core, clean = controller(arm_r), controller(arm_r)
    for c in (core, clean):
        c.step(sample(4))
        c.offer(motion())
        c.step(sample(5, 0.001))
    for stale in (sample(3), sample(4, np.nan), sample(4, stamp_ns=stamp(6))):
        assert core.step(stale) is None
        assert answer(core) == answer(clean)
    assert core.late == 3
    assert core.step(sample(6, 0.002)) is clean.step(sample(6, 0.002)) is True
    assert answer(core) == answer(clean)


def test_a_source_that_counts_anew_in_its_session_is_followed_after_a_while(arm_r):
    core = controller(arm_r)
    core.step(sample(5000))
    late = [core.step(sample(k, 0.003, stamp_ns=stamp(6000 + k))) for k in range(300)]
    assert late[:199] == [None] * 199 and late[199:] == [True] * 101
    assert_array_equal(core.reference.position, [0.003])


@pytest.mark.parametrize("back", [sample(7, stamp_ns=stamp(5)), sample(8, stamp_ns=stamp(1))])
def test_a_clock_that_goes_back_is_a_fault_and_after_recovery_the_new_time_counts(arm_r, back):
    core = controller(arm_r)
    core.step(sample(5))
    assert core.step(back) is False
    assert core.state == State.FAULT
    assert "the source's clock went back" in core.reason
    again = sample(back.sequence + 1, 0.2, stamp_ns=back.stamp_ns + MS)
    assert core.step(again) is False
    assert core.recover() and core.state == State.INACTIVE
    assert core.step(sample(back.sequence + 2, 0.2, stamp_ns=back.stamp_ns + 2 * MS)) is True
    assert (core.state, core.reason) == (State.READY, "")
    assert_array_equal(core.reference.position, [0.2])


def test_a_stamp_that_jumps_ahead_is_a_fault_a_short_gap_is_bridged(arm_r):
    core = started(arm_r, max_gap=0.1)
    assert core.step(sample(100)) is True
    assert core.missed == 99
    assert core.step(sample(201)) is False
    assert core.state == State.FAULT
    assert core.reason == (
        "header.stamp: 0.101 s after the last state is beyond max_gap, and 100 states are missing (0.1)"
    )


@pytest.mark.parametrize("torque", [True, False])
def test_two_sources_are_a_fault_with_torque_or_without(arm_r, torque):
    core = controller(arm_r)
    fields = {} if torque else {"rate": None}
    for k in range(3):
        core.step(sample(k, session=1, **fields))
        core.step(sample(k, session=2, **fields))
    assert core.state == State.FAULT
    assert "two sources send states (sessions 2 and 1)" in core.reason
    # The one that stays may be either.
    core.recover()
    verdicts = [core.step(sample(k, session=1)) for k in range(3, 250)]
    assert not any(verdicts)
    core.recover()
    assert core.step(sample(250, session=1)) is True


def test_one_late_message_of_a_source_that_ended_before_the_first_torque_is_none(arm_r):
    core = controller(arm_r)
    core.step(sample(0, session=1, rate=None))
    core.step(sample(0, session=2, rate=None))
    assert core.step(sample(1, session=1)) is False
    assert core.state == State.INACTIVE
    assert core.step(sample(1, session=2)) is True


def test_with_synchronised_clocks_an_old_state_or_one_of_the_future_is_a_fault(arm_r):
    for now, when in ((stamp(152), "past"), (stamp(-150), "future")):
        core = controller(arm_r, synchronised_clocks=True)
        assert core.step(sample(0), stamp(99)) is True
        assert core.step(sample(1), now) is False
        assert core.state == State.FAULT
        assert f"header.stamp: 0.151 s in the {when} is beyond max_age (0.1)" in core.reason
        # Without, stamps are no business of this clock.
        core = controller(arm_r)
        assert core.step(sample(0), stamp(10**9)) is True


# --------------------------------------------------------------------------- unusable samples

BAD = {
    "joint_position of joint1: nan": {"position": np.nan},
    "joint_velocity of joint1: inf": {"velocity": [np.inf]},
    "modal_amplitude of link1_y_mode2: nan": {"amplitude": [0.0, np.nan]},
    "modal_rate of link1_y_mode1: -2000000.0": {"rate": [-2e6, 0.0]},
    "modal_amplitude is not known yet": {"amplitude": None},
    "modal_rate is not known yet": {"rate": None},
}


@pytest.mark.parametrize("reason", BAD)
def test_an_unusable_sample_is_a_fault_with_the_reason_and_forgets_the_trajectory(arm_r, reason):
    core = controller(arm_r)
    # Before the first torque it is none.
    assert core.step(sample(0, **BAD[reason])) is False
    assert core.state == State.INACTIVE and reason in core.reason
    assert core.step(sample(1)) is True
    core.offer(motion(end=0.1, duration=0.5))
    feed(core, range(2, 10), 0.05)
    assert core.state == State.TRACKING
    assert abs(core.torque[0]) > 0.01
    for _ in range(2):  # sent again, the answer is the same
        assert core.step(sample(10, **BAD[reason])) is False
        assert core.enabled is False
        assert core.state == State.FAULT
        assert reason in core.reason
        assert_array_equal(core.torque, [0.0])
        assert core.saturated is False
    for k in range(11, 20):  # latched
        assert core.step(sample(k, 0.05)) is False
    assert core.recover() is True
    assert core.recover() is False
    for k in range(20, 60):
        assert core.step(sample(k, 0.06)) is True
        assert core.state == State.READY
        assert core.reason == ""
        assert_array_equal(core.reference.position, [0.06])
        assert_array_equal(core.torque, [0.0])


def test_a_state_that_its_source_distrusts_is_a_fault_with_the_sources_reason(arm_r):
    core = started(arm_r)
    assert not core.step(sample(1, trust=ArmSample.DISTRUSTED, doubt="strain of root: stuck"))
    assert (core.state, core.reason) == (State.FAULT, "strain of root: stuck")


def test_a_state_to_stop_with_ends_the_motion_smoothly_with_the_sources_reason(arm_r):
    core = started(arm_r)
    core.offer(motion(end=0.001, duration=0.2))
    assert core.step(sample(1)) and core.state == State.TRACKING
    assert core.step(sample(2, trust=ArmSample.STOP, doubt="strain of root: lost"))
    assert core.step(sample(3, trust=ArmSample.STOP, doubt="strain of root: lost"))
    assert (core.state, core.reason) == (State.STOPPING, "strain of root: lost")


def test_when_the_states_stop_only_a_new_one_or_a_stopped_clock_makes_it_ready_once_recovered(
    arm_r,
):
    for clock_stopped in (False, True):
        core = started(arm_r)
        core.step(sample(1, 0.002))
        core.distrust("no arm_state_estimate for 0.5 s")
        assert (core.enabled, core.reason) == (False, "no arm_state_estimate for 0.5 s")
        assert core.state == State.FAULT
        assert_array_equal(core.torque, [0.0])
        assert core.step(sample(1, 0.002)) is False
        core.recover()
        assert core.step(sample(1, 0.002, clock_stopped=clock_stopped)) is clock_stopped
        assert core.step(sample(2, 0.002)) is True
        assert core.state == State.READY
        assert_array_equal(core.reference.position, [0.002])


def test_a_state_that_is_repeated_for_ever_is_a_fault_and_no_sign_of_life(arm_r):
    core = started(arm_r)
    core.step(sample(1))
    assert core.alive
    answers = [(core.step(sample(1)), core.alive) for _ in range(MAX_REPEATS)]
    assert answers == [(True, False)] * MAX_REPEATS
    assert core.step(sample(1)) is False
    assert core.state == State.FAULT
    assert core.reason.startswith("state 1 was sent again 11 times: the source repeats it")


def test_a_simulator_whose_clock_stands_still_is_alive_as_long_as_it_likes(arm_r):
    core = started(arm_r)
    core.offer(motion())
    core.step(sample(1))
    before = answer(core)
    for _ in range(10 * MAX_REPEATS):
        assert core.step(sample(1, clock_stopped=True)) is True and core.alive
    assert answer(core) == before
    assert core.step(sample(2)) is True and core.state == State.TRACKING


# --------------------------------------------------------------------------- torque that returns


def test_torque_returns_in_a_ramp_and_less_than_a_tenth_of_it_within_20_ms(arm_r):
    core = controller(arm_r, Scripted(*[10.0] * 200), return_time=0.065, torque_rate_limit=[1e9])
    torques = []
    for k in range(100):
        core.step(sample(k))
        torques.append(core.torque[0])
    limit = core.torque_limit[0]
    assert torques[0] == 0.0 and torques[20] <= 0.1 * limit
    assert (np.diff(torques[:66]) > 0.0).all() and torques[66:] == [10.0] * 34
    assert not core.saturated


def test_an_arm_under_gravity_is_held_from_the_first_sample_on(long_reach):
    sizes = {"joints": 4, "modes": long_reach.n_modes}
    authority = Authority(long_reach, check_all(PARAMETERS, {}, sizes))
    q = np.array([0.0, 1.2, 0.8, -0.8])
    authority.begin(q, True)
    a, B = slow_subsystem(long_reach.terms(q, np.zeros(4)))
    assert_allclose(a + B @ authority.torque, np.zeros(4), atol=1e-9)
    assert np.abs(authority.torque).max() > 50.0


def test_the_first_torque_of_an_arm_at_rest_is_within_the_limit_too(long_reach):
    """Where the weight takes nearly all of the torque."""
    sizes = {"joints": 4, "modes": long_reach.n_modes}
    q = np.array([0.0, 1.2, 0.8, -0.8])
    authority = Authority(long_reach, check_all(PARAMETERS, {}, sizes))
    authority.begin(q, True)
    weight = authority.torque.copy()
    limit = 1.01 * np.maximum(np.abs(weight), 1.0)
    authority.configure(check_all(PARAMETERS, {"torque_limit": limit.tolist()}, sizes))
    authority.begin(q, True)
    assert authority.send(weight + np.sign(weight) * 0.015 * limit, 1e-3, 1e-3)
    heavy = np.abs(weight) > 1.0
    assert heavy.any()
    assert_allclose(np.abs(authority.torque[heavy]), limit[heavy])


def test_the_budget_of_the_torques_change_is_the_files_or_from_limit_and_lowest_frequency(arm_r):
    def rate(model, **settings):
        sizes = {"joints": 1, "modes": 2}
        return Authority(model, check_all(PARAMETERS, settings, sizes)).rate

    omega = arm_r.frequencies(np.zeros(1), locked=True)[0]
    assert_allclose(rate(arm_r), [8.0 * omega * FILE_LIMIT], rtol=1e-12)
    joint = arm_r.arm.joints[0]
    stated = replace(joint, limits=replace(joint.limits, torque_rate=20.0))
    assert_array_equal(rate(build(replace(arm_r.arm, joints=(stated,)))), [20.0])
    assert_array_equal(rate(arm_r, torque_rate_limit=[3.0]), [3.0])
    assert_array_equal(rate(arm_r, torque_rate_limit=[1e9]), [np.inf])


def test_a_gap_beyond_resume_gap_gives_the_motion_up_and_torque_returns_in_a_ramp(arm_r):
    core = started(arm_r, return_time=0.065)
    feed(core, range(1, 100))
    core.offer(motion(duration=1.0))
    feed(core, range(100, 200))
    assert core.step(sample(249)) is True  # 50 ms: none
    assert core.state == State.TRACKING and core.interruptions == 0
    assert core.step(sample(300)) is True
    assert core.reason == (
        "no state for 0.051 s: torque returns in a ramp, the motion was given up: send it again"
    )
    assert (core.interruptions, core.state) == (1, State.READY)
    assert_array_equal(core.torque, [0.0])
    assert not core.reference.active


def test_a_stamp_far_ahead_of_its_number_is_named(arm_r):
    core = started(arm_r)
    feed(core, range(1, 100))
    new = sample(100)
    new.stamp_ns += 300_000_000
    assert core.step(new) is True and core.interruptions == 1
    assert core.reason.startswith(
        "header.stamp: 0.301 s after the last state, and 0 states are missing: the source stood still, or its clock"
    )


def test_where_the_joints_go_on_a_clock_has_jumped_and_the_arm_rests_on_its_path(arm_r):
    core, other = started(arm_r), started(arm_r)
    for each in (core, other):
        feed(each, range(1, 100))
        each.offer(motion(duration=1.0))

    def follow(each, k, jumped_ns=0):
        new = sample(k, each.reference.position[0], velocity=each.reference.velocity.copy())
        new.stamp_ns += jumped_ns
        assert each.step(new) is True

    for k in range(100, 500):
        follow(core, k)
        follow(other, k)
    follow(core, 500, 300_000_000)
    follow(other, 500)
    other.brake("asked for")
    assert (core.state, core.interruptions) == (State.STOPPING, 0)
    assert core.reason.startswith(
        "header.stamp: 0.301 s after the last state, and 0 states are missing: its clock"
    )
    follow(core, 501, 300_000_000)
    follow(other, 501)
    stamp = sample(600).stamp_ns + 300_000_000
    refused = core.offer(replace(motion(duration=1.0), stamp_ns=stamp))
    assert not refused.accepted and "clock jumped" in refused.reason
    for k in range(502, 2500):  # as if it had been asked to stop
        follow(core, k, 300_000_000)
        follow(other, k)
        assert_array_equal(core.reference.position, other.reference.position)
        assert_array_equal(core.torque, other.torque)
    assert core.state == State.HOLDING
    assert core.reference.stamp_ns == sample(2499).stamp_ns + 300_000_000  # the source's time again


def test_a_moving_arm_is_taken_over_as_it_moves_and_brought_to_rest(arm_r):
    core = controller(arm_r, return_time=0.065)
    for k in range(10):  # it is seen for 10 ms first
        assert core.step(sample(k, 0.195 + 5e-4 * k, velocity=[0.5])) is False
    positions, speeds, torques = [], [], []
    for k in range(10, 2000):
        place, speed = (
            (0.2, 0.5) if k == 10 else (positions[-1], speeds[-1])
        )  # it follows the reference
        assert core.step(sample(k, place, velocity=[speed]))
        positions.append(core.reference.position[0])
        speeds.append(core.reference.velocity[0])
        torques.append(core.torque[0])
    assert_allclose((positions[0], speeds[0]), (0.2, 0.5), rtol=1e-9)
    assert core.state == State.HOLDING and speeds[-1] == 0.0
    assert 0.25 < positions[-1] < 0.5
    assert np.abs(torques[:21]).max() <= 0.1 * FILE_LIMIT


@pytest.mark.parametrize("moves, state", [(False, State.READY), (True, State.STOPPING)])
@pytest.mark.parametrize("waited", [200, 4])
def test_an_arm_whose_positions_rest_is_taken_over_at_rest_whatever_its_estimated_velocity(
    arm_r, moves, state, waited
):
    """An estimate that has just converged is off by its noise; a stop from that speed would move the arm."""
    core, begins = controller(arm_r), max(waited, 11)

    def place(k):
        # At last with 0.1 rad/s.
        return 1e-4 * max(k - begins + 15, 0) if moves else 5e-5 * (k % 2)

    for k in range(begins):
        rate = None if k < waited else [0.0, 0.0]
        assert core.step(sample(k, place(k), rate=rate, velocity=[0.1])) is (k == 10 == begins - 1)
    core.step(sample(begins, place(begins), velocity=[0.1]))
    assert core.state == state and core.enabled


@pytest.mark.parametrize("velocity, begins", [(-1.6, 0.0), (1.6, 0.1), (0.08, 0.08)])
def test_a_joint_that_swings_is_taken_over_no_faster_than_it_goes_on(arm_r, velocity, begins):
    """Bent links turn a light joint to and fro; a reference with the speed of a swing would run away."""
    core = controller(arm_r)
    core.step(sample(0, velocity=[velocity]))
    core.step(sample(10, 1e-3, velocity=[velocity]))
    assert core.enabled
    assert_allclose(core.reference.velocity, [begins], atol=1e-12)


@pytest.mark.parametrize("numbers, begins", [((1, 101), 0.3), ((1, 2), 0.9)])
def test_after_a_gap_the_arm_is_no_faster_than_it_was_on_the_mean_but_after_a_jump_of_the_clock(
    arm_r, numbers, begins
):
    """A safe action has acted, of which an estimate knows nothing; over a jump of the clock the time says nothing."""
    core = started(arm_r)
    core.step(sample(numbers[0]))
    core.step(sample(numbers[1], 0.03, velocity=[0.9], stamp_ns=stamp(101)))
    assert core.interruptions == 1
    assert_allclose(core.reference.velocity, [begins], rtol=1e-9)


def test_torque_returns_in_a_ramp_to_a_moving_arm_although_the_law_begins_with_none(arm_r):
    """A law that has just been reset asks for nothing at first, and the next sample kicked."""
    core = controller(arm_r, Scripted(0.0, *[5.0] * 20), return_time=0.065)
    for k in range(31):
        core.step(sample(k, 5e-4 * k, velocity=[0.5]))
        assert abs(core.torque[0]) <= 5.0 * ((k - 10) / 65) ** 2 + 1e-12 or k < 10
    assert core.torque[0] > 0.4


def test_a_law_that_asks_for_more_than_the_limit_returns_as_gently(arm_r):
    core = controller(arm_r, Scripted(*[5.0 * FILE_LIMIT] * 21), return_time=0.065)
    for k in range(21):
        core.step(sample(k))
    assert 0.09 * FILE_LIMIT < core.torque[0] <= 0.1 * FILE_LIMIT


def test_at_a_low_rate_a_period_is_no_gap(arm_r):
    core = started(arm_r)
    for k in range(1, 10):
        assert core.step(sample(k, stamp_ns=stamp(100 * k))) is True
    assert core.interruptions == 1  # the first: no period was known


# --------------------------------------------------------------------------- what the driver applies


def applying(core, numbers, torque=None, controller_id=0):
    """Answers, where the driver reports the torque of the answer before, or another one."""
    found = []
    for k in numbers:
        reported = core.torque.copy() if torque is None else [torque]
        found.append(core.step(sample(k, torque=reported, controller_id=controller_id)))
    return found


def test_a_driver_that_reports_another_torque_for_a_quarter_of_a_second_is_a_fault(arm_r):
    core = started(arm_r, Scripted(*[5.0] * 500))
    assert all(applying(core, range(1, 100)))
    assert all(applying(core, range(100, 349), 0.0))
    assert not any(applying(core, range(352, 360), 0.0))
    assert core.state == State.FAULT
    assert core.reason.startswith("the driver reports 0 N m at joint1, sent were 5: it does not")


def test_a_late_torque_is_the_one_that_was_sent(arm_r):
    random = np.random.default_rng(1)
    core = started(arm_r, Scripted(*random.uniform(-10.0, 10.0, 400)))
    sent = [0.0]
    for k in range(1, 300):
        assert core.step(sample(k, torque=[sent[max(0, len(sent) - 30)]]))
        sent.append(core.torque[0])


def test_the_comparison_can_be_switched_off(arm_r):
    core = started(arm_r, Scripted(*[5.0] * 300), torque_mismatch=0.0)
    assert all(applying(core, range(1, 299), 0.0))


def test_a_driver_that_confirms_no_longer_or_another_controller_is_a_fault(arm_r):
    for later, text in ((0, "applies no torque of this"), (8, "torque of another controller (8)")):
        core = started(arm_r)
        core.controller_id = 7
        assert all(applying(core, range(1, 50), controller_id=0))
        assert all(applying(core, range(50, 100), controller_id=7))
        assert all(applying(core, range(100, 349), controller_id=later))
        assert not any(applying(core, range(352, 355), controller_id=later))
        assert core.state == State.FAULT and text in core.reason


def test_a_driver_that_never_confirms_is_not_asked(arm_r):
    core = started(arm_r)
    core.controller_id = 7
    assert all(applying(core, range(1, 600), controller_id=0))


def test_after_a_time_on_the_safe_action_torque_returns_in_a_ramp_and_the_motion_is_given_up(arm_r):
    core = started(arm_r, Scripted(*[5.0] * 400), return_time=0.065)
    core.controller_id = 7
    core.offer(motion(end=5.0, duration=9.0))
    assert all(applying(core, range(1, 50), controller_id=7))
    assert all(applying(core, range(50, 150), controller_id=0))
    assert core.torque[0] == 5.0
    assert all(applying(core, range(150, 170), controller_id=7))
    assert 0.0 < core.torque[0] < 0.5
    assert core.interruptions == 1 and not core.reference.active
    assert core.reason.startswith("the driver has applied no torque for 0.1 s: torque returns")


def test_a_driver_that_takes_the_torque_late_for_the_first_time_gets_it_in_a_ramp(arm_r):
    core = started(arm_r, Scripted(*[5.0] * 400), return_time=0.065)
    core.controller_id = 7
    core.offer(motion(end=5.0, duration=9.0))
    assert all(applying(core, range(1, 100), controller_id=0))
    assert core.torque[0] == 5.0
    assert all(applying(core, range(100, 120), controller_id=7))
    assert 0.0 < core.torque[0] < 0.5
    assert core.interruptions == 1 and not core.reference.active
    assert core.reason.startswith("the driver has applied no torque for 0.099 s: torque returns")


def test_another_driver_that_confirms_no_controller_may_follow_one_that_does(arm_r):
    core = started(arm_r)
    core.controller_id = 7
    assert all(applying(core, range(1, 50), controller_id=7))
    for k in range(500):
        assert core.step(sample(k, stamp_ns=stamp(60 + k), session=2)) is True


@pytest.mark.parametrize("first", [{}, {"velocity_known": False}])
def test_a_driver_that_came_during_a_fault_may_take_its_time_to_confirm(arm_r, first):
    core = started(arm_r)
    core.controller_id = 7
    assert all(applying(core, range(1, 50), controller_id=7))
    core.fail("no arm_state_estimate for 1 s")
    core.step(sample(0, stamp_ns=stamp(60), session=2, **first))
    core.recover()
    for k in range(1, 500):
        assert core.step(sample(k, stamp_ns=stamp(60 + k), session=2)) is True


def test_while_a_sensor_is_in_doubt_no_motion_is_accepted(arm_r):
    core = started(arm_r)
    core.step(sample(1, trust=ArmSample.STOP, doubt="strain of root: lost"))
    assert core.offer(motion()).reason == "a sensor is in doubt: strain of root: lost"
    core.step(sample(2))
    assert core.offer(motion()).accepted


# --------------------------------------------------------------------------- failing laws


FAILURES = {
    "ZeroDivisionError: by zero": ZeroDivisionError("by zero"),
    "KeyError: 'gain'": KeyError("gain"),
    "DesignError: late": DesignError("late"),
    "ValueError: ": ValueError(),
    "torque of joint1 came out as nan": np.nan,
    "torque of joint1 came out as inf": np.inf,
    "torque of joint1 came out as -inf": -np.inf,
}


@pytest.mark.parametrize("reason", FAILURES)
def test_whatever_a_law_raises_and_a_torque_that_is_no_number_disable_with_the_reason(
    arm_r, reason
):
    core = started(arm_r, Scripted(3.0, FAILURES[reason], 4.0))
    core.offer(motion(end=5.0, duration=9.0))
    assert core.torque[0] == 3.0
    for _ in range(2):
        assert core.step(sample(1, 0.2)) is False
        assert core.state == State.FAULT
        assert core.reason.endswith(reason)
        assert_array_equal(core.torque, [0.0])
    core.recover()
    assert core.step(sample(2, 0.3)) is True
    assert core.state == State.READY
    assert_array_equal(core.reference.position, [0.3])
    assert_array_equal(core.torque, [4.0])


def test_an_interrupt_is_passed_on(arm_r):
    with pytest.raises(KeyboardInterrupt):
        controller(arm_r, Scripted(KeyboardInterrupt())).step(sample(0))


# --------------------------------------------------------------------------- limits


@pytest.mark.parametrize(
    ("setting", "limit"),
    [([0.0], FILE_LIMIT), ([2.0], 2.0), ([1e5], FILE_LIMIT), ([FILE_LIMIT], FILE_LIMIT)],
)
def test_the_lower_of_the_files_and_the_parameters_torque_limit_holds(arm_r, setting, limit):
    core = controller(arm_r, Scripted(1e4, -1e4, 0.5 * limit, limit), torque_limit=setting)
    assert_allclose(core.torque_limit, [limit], rtol=1e-12)
    wanted = [(limit, True), (-limit, True), (0.5 * limit, False), (limit, False)]
    assert_allclose(answers(core, range(4)), wanted, rtol=1e-12)


def answers(core, numbers):
    """Torque of the states of these numbers, and whether it met a limit."""
    return [(core.step(sample(k)) and core.torque[0], core.saturated) for k in numbers]


def test_the_torque_changes_no_faster_than_its_rate_limit_from_the_last_one_sent(arm_r):
    law = Scripted(0.0, 8.0, 8.0, 8.0, 8.0, -8.0, 0.0)
    core = controller(arm_r, law, torque_rate_limit=[2000.0])
    found = answers(
        core, (0, 1, 2, 4, 5, 6, 13)
    )  # after a gap of n periods no farther: an estimate is worst then
    wanted = [(0, False), (2, True), (4, True), (6, True), (8, False), (6, True), (4, True)]
    assert_allclose(found, wanted, atol=1e-12)


def test_the_rate_limit_counts_from_the_torque_that_the_size_limit_let_through(arm_r):
    law = Scripted(0.0, 100.0, -100.0)
    core = controller(arm_r, law, torque_limit=[3.0], torque_rate_limit=[4000.0])
    assert_allclose(answers(core, range(3)), [(0, False), (3, True), (-1, True)], atol=1e-12)


def test_after_a_disable_the_rate_limit_starts_from_no_torque(arm_r):
    law = Scripted(0.0, 8.0, 8.0, 8.0)
    core = started(arm_r, law, torque_rate_limit=[8000.0])
    core.step(sample(1))
    assert_allclose(core.torque, [8.0])
    core.step(sample(2, np.nan))
    core.recover()
    core.step(sample(3))
    assert_array_equal(core.torque, [0.0])
    core.step(sample(4))
    assert_allclose(core.torque, [8.0])


def test_each_joint_has_its_own_limits(two_link):
    joints = [
        replace(joint, limits=replace(joint.limits, torque=most))
        for joint, most in zip(two_link.arm.joints, (5.0, np.inf), strict=True)
    ]
    two = build(replace(two_link.arm, joints=tuple(joints)))

    def still(k):
        return sample(k, n=2, amplitude=np.zeros(two.n_modes), rate=np.zeros(two.n_modes))

    law = Scripted([9.0, 9.0], [9.0, -9.0], [9.0, 1e9])
    core = controller(two, law, torque_rate_limit=[1000.0, 0.0])
    core.step(still(0))  # the first, from rest, in no time: the limited joint stays at 0
    assert_array_equal(core.torque, [0.0, 9.0])
    core.step(still(1))
    assert_allclose(core.torque, [1.0, -9.0])
    core.step(still(2))
    assert_allclose(core.torque, [2.0, 1e9])
    assert core.saturated is True


def test_limits_can_change_between_two_samples(arm_r):
    core = started(arm_r, Scripted(9.0, 9.0))
    assert_array_equal(core.torque, [9.0])
    core.configure(check_all(PARAMETERS, {"torque_limit": [1.0]}, {"joints": 1, "modes": 2}))
    core.step(sample(1))
    assert_array_equal(core.torque, [1.0])


# --------------------------------------------------------------------------- trajectories


def test_a_trajectory_is_refused_before_the_first_state_and_after_a_disable_saying_why(arm_r):
    core = controller(arm_r)
    verdict = core.offer(motion())
    assert (verdict.accepted, verdict.reason) == (False, "no valid state: none yet")
    assert core.reason == verdict.reason
    assert core.trajectory_id == 0
    core.step(sample(0))
    core.step(sample(1, np.nan))
    verdict = core.offer(motion())
    assert not verdict.accepted
    assert "in fault, call ~/recover first: joint_position of joint1: nan" in verdict.reason
    core.recover()
    assert "no valid state: none yet" in core.offer(motion()).reason


def test_a_refused_trajectory_leaves_the_present_one_and_shows_until_the_next_is_accepted(arm_r):
    core = started(arm_r)
    core.offer(motion(duration=0.5))
    core.step(sample(1))
    assert core.offer(motion(start=2.0)).accepted is False
    assert "start_tolerance" in core.reason
    core.step(sample(2))
    assert core.state == State.TRACKING
    assert "start_tolerance" in core.reason
    core.refuse("joint_names: not this arm's")
    assert core.reason == "joint_names: not this arm's"
    assert core.offer(motion(end=0.05, at_ns=stamp(600), start=0.1)).accepted
    assert core.reason == ""


def test_why_the_state_is_bad_comes_before_why_a_trajectory_was_refused(arm_r):
    core = started(arm_r)
    core.refuse("no points")
    core.step(sample(1, np.nan))
    assert "joint_position" in core.reason
    core.recover()
    core.step(sample(2))
    assert core.reason == "no points"


def test_an_identical_trajectory_sent_again_is_no_refusal_and_no_restart(arm_r):
    core = started(arm_r)
    assert core.offer(motion(duration=0.5)).accepted
    core.step(sample(1))
    core.step(sample(40))
    before = core.reference.position.copy()
    verdict = core.offer(motion(duration=0.5))
    assert (verdict.accepted, verdict.repeat, core.reason) == (False, True, "")
    core.step(sample(41))
    assert core.reference.position > before
    assert core.trajectory_id == 1


def test_a_trajectory_stamped_zero_starts_at_the_first_state_after_it(arm_r):
    core = started(arm_r)
    core.offer(motion(duration=0.02))
    core.step(sample(0))  # a repeat is no later state
    core.step(sample(5))
    assert core.state == State.TRACKING
    assert_array_equal(core.reference.position, [0.0])
    core.step(sample(15))
    assert_allclose(core.reference.position, [0.05], rtol=1e-12)


# --------------------------------------------------------------------------- while the observer converges


def converging(arm_r, *samples):
    """A controller that has seen samples without rates."""
    core = controller(arm_r)
    for s in samples:
        assert core.step(s) is False
        assert core.state == State.INACTIVE
        assert core.reason == "modal_rate is not known yet"
    return core


def unknown(k, *args, **more):
    return sample(k, *args, rate=None, **more)


def test_a_trajectory_offered_while_converging_is_kept_and_starts_at_its_stamp(arm_r):
    core = converging(arm_r, unknown(0), unknown(0))
    assert core.offer(motion(at_ns=stamp(10))).accepted
    assert core.trajectory_id == 1
    for k in range(1, 6):
        assert core.step(unknown(k)) is False
    for k in range(6, 11):
        assert core.step(sample(k)) is True
        assert core.reference.position[0] == 0.0
    core.step(sample(15))
    assert core.state == State.TRACKING
    assert core.reference.position[0] != 0.0


def test_one_with_stamp_0_starts_with_the_first_torque(arm_r):
    core = converging(arm_r, unknown(0))
    assert core.offer(motion()).accepted
    for k in range(1, 50):
        core.step(unknown(k))
    assert core.step(sample(50)) is True
    assert core.reference.position[0] == 0.0
    assert core.state == State.TRACKING


@pytest.mark.parametrize(
    ("at_ns", "position", "reason"),
    [(stamp(5), 0.0, "before the observer had converged"), (0, 0.02, "joint1 moved 0.02 rad")],
    ids=["late", "moved"],
)
def test_one_that_can_no_longer_be_followed_is_given_up(arm_r, at_ns, position, reason):
    core = converging(arm_r, unknown(0))
    core.offer(motion(at_ns=at_ns))
    for k in range(1, 20):
        core.step(unknown(k, position))
    for k in range(20, 60):
        assert core.step(sample(k, position)) is True
        assert core.state == State.READY
        assert core.reference.position[0] == position
    assert reason in core.reason


def test_a_new_session_while_converging_forgets_what_was_offered(arm_r):
    core = converging(arm_r, unknown(0))
    core.offer(motion())
    core.step(unknown(0, session=2))
    assert core.step(sample(1, session=2)) is True
    assert core.state == State.READY


# --------------------------------------------------------------------------- stops


def tracking(core, to=40, **motion_):
    """Under way in a long motion."""
    core.step(sample(0))
    assert core.offer(motion(**{"end": 2.0, "duration": 1.0, **motion_})).accepted
    for k in range(1, to):
        core.step(sample(k, core.reference.position.copy(), velocity=core.reference.velocity))
    assert core.state == State.TRACKING
    return to


def test_a_smooth_stop_brakes_the_reference_from_where_it_is_and_then_holds(arm_r):
    core = controller(arm_r, stop_deceleration=[4.0])
    k = tracking(core, 400)
    before = core.reference.velocity[0]
    assert before > 1.0
    assert core.brake("~/stop was called")
    assert core.state == State.STOPPING
    speeds, states = [before], []
    for i in range(k, k + 1500):
        q = core.reference.position + 0.01  # not where the reference is
        assert core.step(sample(i, q, velocity=core.reference.velocity)) is True
        speeds.append(core.reference.velocity[0])
        states.append(core.state)
    own = 10.0 / np.sqrt(3.0) * 2.0  # of a quintic over 2 rad in 1 s [rad/s^2]
    assert np.abs(np.diff(speeds)).max() < 1e-3 * own
    assert speeds[-1] == 0.0
    first = states.index(State.HOLDING)
    assert set(states[:first]) == {State.STOPPING} and set(states[first:]) == {State.HOLDING}
    assert first > 300
    assert core.reason == "~/stop was called"
    # A new trajectory is followed again.
    here = core.reference.position[0]
    assert core.offer(motion(end=here + 0.1, start=here, duration=0.1)).accepted
    core.step(sample(k + 1500, here))
    core.step(sample(k + 1501, here))
    assert (core.state, core.reason) == (State.TRACKING, "")


def test_a_joint_that_stays_behind_is_stopped_then_a_fault(arm_r):
    core = controller(arm_r, tracking_error_limit=0.2)
    k = tracking(core, 300)
    q, states = core.reference.position.copy(), []
    for i in range(k, k + 3000):  # the joint is stuck
        core.step(sample(i, q))
        states.append(core.state)
    order = list(dict.fromkeys(states))
    assert order in (
        [State.TRACKING, State.STOPPING, State.FAULT],
        [State.TRACKING, State.STOPPING, State.HOLDING, State.FAULT],
    )
    assert "tracking error of joint1 is" in core.reason and "limit of 0.2 rad" in core.reason


@pytest.mark.parametrize(
    ("position", "fault", "why"),
    [
        (lambda k: 0.29 if k < 50 else 0.31, 50, "by more than 1.5 times"),
        (lambda k: 0.25, 101, "in spite of the stop"),
        (lambda k: 0.25 if k % 90 < 80 else 0.1, None, ""),
    ],
    ids=["far beyond", "for long", "forgiven"],
)
def test_a_limit_exceeded_by_half_or_for_long_is_a_fault(arm_r, position, fault, why):
    core = started(arm_r, tracking_error_limit=0.2, limit_patience=0.1)
    enabled = [core.step(sample(k, position(k))) for k in range(1, 500)]
    assert enabled.count(True) == pytest.approx(499 if fault is None else fault - 1, abs=1)
    assert core.state == (State.READY if fault is None else State.FAULT)
    assert why in core.reason
    assert core.torque.any() == (fault is None)


BEYOND = {
    "velocity of joint1 is 13 rad/s": ({"position_margin": 0.0}, {"velocity": [13.0]}),
    "deflection of link1_y_mode1 is 0.03": ({"deflection_limit": [0.025, 0.0]}, {"amplitude": [-0.03, 0.0]}),
    "strain of root is 0.0": ({"strain_limit": 1e-4}, {"amplitude": [-0.011, 0.0]}),
    "position of joint1 is 0.06 rad out": ({"tracking_error_limit": 0.0}, {"position": 3.2}),
    "position of joint1 is 0.07": ({"tracking_error_limit": 0.0}, {"position": 3.0, "velocity": [9.0]}),
}  # fmt: skip


@pytest.mark.parametrize("reason", BEYOND)
def test_every_limit_stops_a_motion_and_says_which(limited, reason):
    settings, change = BEYOND[reason]
    core = controller(limited, **settings)
    k = tracking(core, 20)
    core.step(sample(k, **change))
    assert core.state == State.STOPPING, core.reason
    assert reason in core.reason


@pytest.fixture(scope="module")
def limited(one_link):
    """An arm of one link with limits of position and velocity."""
    (joint,) = one_link.arm.joints
    limits = replace(joint.limits, position=(-3.14, 3.14), velocity=10.0)
    return build(replace(one_link.arm, joints=(replace(joint, limits=limits),)))


@pytest.mark.parametrize(("beyond", "state"), [(-0.005, State.TRACKING), (0.005, State.STOPPING)])
def test_the_range_of_a_joint_is_kept_with_its_braking_distance(limited, beyond, state):
    limit, speed, margin = 10.0, 5.0, 0.05
    _, B = slow_subsystem(limited.terms(np.zeros(1), np.zeros(1)))
    distance = speed**2 / (2.0 * B[0, 0] * limit)
    settings = {"tracking_error_limit": 0.0, "position_margin": margin, "torque_limit": [limit]}
    core = controller(limited, **settings)
    k = tracking(core, 20)
    core.step(sample(k, 3.14 + margin - distance + beyond, velocity=[speed]))
    assert core.state == state, core.reason


@pytest.mark.parametrize(
    ("margin", "ahead", "why"),
    [(1.0, 0.0, ""), (1.0, 0.15, "position of joint1 is"), (0.0, 0.0, "position of joint1 is")],
    ids=["judged", "judged, not followed", "not judged"],
)
def test_a_judged_motion_within_the_range_is_not_stopped_for_its_braking_distance(
    limited, margin, ahead, why
):
    """The straight arm's weight leaves little torque to brake it with; hanging, it has enough."""
    (joint,) = limited.arm.joints
    limits = replace(joint.limits, position=(-2.4, -1.2))
    arm = replace(limited.arm, gravity=(0.0, -9.81, 0.0), joints=(replace(joint, limits=limits),))
    hanging = build(arm)
    a, B = slow_subsystem(hanging.terms(np.zeros(1), np.zeros(1)))
    weight = abs(a[0]) / B[0, 0]
    core = controller(
        hanging,
        torque_limit=[1.05 * weight],
        trajectory_torque_margin=margin,
        tracking_error_limit=0.0,
    )
    core.step(sample(0, -2.0))
    verdict = core.offer(motion(start=-2.0, end=-1.2, duration=1.7))
    assert verdict.accepted, verdict.reason
    states = []
    for k in range(1, 1900):
        q = core.reference.position + ahead * (k > 800)
        core.step(sample(k, q, velocity=core.reference.velocity.copy()))
        states.append(core.state)
    assert why in core.reason and (State.STOPPING in states or core.state == State.FAULT) == bool(
        why
    )


def test_a_torque_at_its_limit_for_long_stops_the_arm(arm_r):
    core = controller(arm_r, Scripted(*[100.0] * 700), saturation_time=0.3, torque_limit=[1.0])
    k = tracking(core, 300)
    for i in range(k, k + 5):
        core.step(sample(i, core.reference.position.copy()))
    assert core.state == State.STOPPING
    assert "time at the torque limit is 0.3" in core.reason
    for i in range(k + 5, k + 250):
        core.step(sample(i, core.reference.position.copy()))
    assert core.state == State.FAULT


def test_what_nothing_holds_to_the_reference_has_no_tracking_error(arm_r):
    core = started(arm_r, design(arm_r, {"type": "none"}, FAST))
    assert core.step(sample(1, 1.0)) is True


def test_the_fast_control_comes_and_goes_in_a_ramp(arm_r):
    core = started(arm_r, Scripted(*[1.0] * 1000))
    core.enable_fast(False)
    fractions = []
    for k in range(1, 300):
        if k == 150:
            core.enable_fast(True)
        core.step(sample(k))
        fractions.append(core.law.fast_fraction)
    assert_allclose(np.abs(np.diff(fractions)).max(), 0.01)
    assert fractions[120] == 0.0 and fractions[-1] == 1.0


def test_the_fast_fraction_scales_the_fast_torque(arm_r):
    law = design(arm_r, SLOW, FAST)
    state = (np.zeros(1), np.zeros(1), np.array([0.01, 0.0]), np.zeros(2), at_rest([0.0]))
    law.step(*state)
    whole, slow = law.fast_torque.copy(), law.slow_torque.copy()
    law.fast_fraction = 0.25
    u = law.step(*state)
    assert_allclose(law.fast_torque, 0.25 * whole, rtol=1e-15)
    assert_allclose(u, slow + 0.25 * whole, rtol=1e-15)


def test_a_strain_limit_without_gauges_is_refused(rigid):
    with pytest.raises(ParameterError, match="rigid has no gauges") as refused:
        controller(rigid, Scripted(0.0), strain_limit=1e-3)
    assert (refused.value.field, refused.value.value) == ("strain_limit", 1e-3)


@pytest.mark.parametrize("slow", ["linear_model_following", "adaptive_model_following"])
def test_a_warm_up_leaves_nothing_behind(arm_r, slow):
    def made():
        return controller(arm_r, design(arm_r, {"type": slow}, FAST))

    core, clean = made(), made()
    core.warm_up()
    assert answer(core) == answer(clean)
    for c in (core, clean):
        c.step(sample(0))
        c.offer(motion())
    for k in range(1, 40):
        for c in (core, clean):
            c.step(sample(k, 1e-4 * k, velocity=[0.1], amplitude=[1e-3, 1e-4]))
        assert answer(core) == answer(clean)


def test_a_repeat_with_another_stamp_begins_nothing(arm_r):
    # Found by fuzzing: the stamp of 2**62 ns made the next time step negative, and the torque 1e12 N m.
    core = started(arm_r, Scripted(*[5.0] * 9), torque_rate_limit=[100.0])
    core.fail("for the test")
    core.recover()
    assert core.step(sample(0, stamp_ns=2**62)) is False
    assert "came again with another stamp" in core.reason
    for k in range(1, 4):
        assert core.step(sample(k)) is True
        assert abs(core.torque[0]) <= 0.1 * k
