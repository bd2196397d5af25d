# SPDX-License-Identifier: Apache-2.0
"""Excitation of an arm: the torque's shape, its limits, and what stops it."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_control.loop.samples import ArmSample
from flexarm_control.motions import excitation_run
from flexarm_control.motions.excitation_run import ExcitationRun, Stage
from flexarm_control.motions.excitation_torque import ExcitationTorque
from flexarm_dynamics.errors import DesignError, ParameterError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import check_all
from flexarm_dynamics.singular_perturbation import slow_subsystem


def run_of(arm_model, **settings):
    return ExcitationRun(arm_model, check_all(excitation_run.PARAMETERS, settings))


def sample(k, position=0.0, strain=0.0, velocity=0.0, session=1, period_ns=10_000_000):
    made = ArmSample(1, 0, 2)
    made.stamp_ns, made.session, made.sequence = k * period_ns, session, k
    made.position[:], made.velocity[:], made.strain[:] = position, velocity, strain
    return made


def test_a_pulse_leaves_the_rigid_arm_at_rest(one_link):
    settings = {"kind": "pulse", "amplitude": 2.0, "duration": 0.4, "rest": 1.0}
    push = ExcitationTorque(one_link, settings)
    torque = np.array([push.torque(x)[0] for x in (np.arange(1400) + 0.5) * 1e-3])
    assert np.sum(torque) == pytest.approx(0.0, abs=1e-9)
    assert np.abs(torque).max() == 2.0 and not torque[400:].any()
    assert push.duration == 1.4


def test_a_ring_down_pushes_at_the_first_frequency_and_lets_go(one_link):
    push = ExcitationTorque(one_link, {"kind": "ring_down", "amplitude": 1.0})
    first = one_link.frequencies()[0] / (2.0 * np.pi)
    assert push.shaking == pytest.approx(3.0 / first)
    assert push.torque(0.25 / first)[0] == pytest.approx(1.0)
    assert push.torque(push.shaking + 0.01)[0] == 0.0


def test_a_sweep_crosses_every_frequency_in_its_range(one_link):
    push = ExcitationTorque(one_link, {"kind": "sweep", "amplitude": 1.0, "duration": 4.0})
    t = np.arange(0.0, 4.0, 1e-3)
    torque = np.array([push.torque(x)[0] for x in t])
    rising = t[1:][(torque[:-1] < 0.0) & (torque[1:] >= 0.0)]
    frequency, modes = 1.0 / np.diff(rising), one_link.frequencies() / (2.0 * np.pi)
    # A period that ends where it began: the mean of the instantaneous frequency over it.
    rate = (1.3 * modes[-1] - 0.25 * modes[0]) / 4.0
    middle = 0.5 * (rising[1:] + rising[:-1])
    np.testing.assert_allclose(frequency, 0.25 * modes[0] + rate * middle, rtol=0.03)
    assert push.low < modes[0] and frequency[-1] > modes[-1]
    assert np.abs(torque).max() <= 1.0 and abs(torque[-1]) < 0.01


def test_joints_take_their_turns_and_weight_is_held(two_link):
    heavy = model.build(replace(two_link.arm, gravity=(0.0, -1.0, 0.0)))
    q, settings = (
        np.array([0.3, 0.4]),
        {"kind": "pulse", "amplitude": 1.0, "duration": 0.2, "rest": 0.3},
    )
    push = ExcitationTorque(heavy, settings, q)
    a, B = slow_subsystem(heavy.terms(q, np.zeros(2)))
    np.testing.assert_allclose(a + B @ push.hold, 0.0, atol=1e-12)
    assert np.abs(push.hold).min() > 0.05
    np.testing.assert_allclose(push.torque(0.05) - push.hold, [1.0, 0.0])
    np.testing.assert_allclose(push.torque(0.55) - push.hold, [0.0, 1.0])
    np.testing.assert_allclose(push.torque(2.0), push.hold)


@pytest.mark.parametrize(
    ("settings", "field", "limit"),
    [
        ({"amplitude": 14.0}, "amplitude", "above 0, at most 13.5"),
        ({"joint": "elbow"}, "joint", "joint1"),
        ({"frequency_low": 5.0, "frequency_high": 5.0}, "frequency_high", "above frequency_low, 5"),
    ],
)  # fmt: skip
def test_what_can_not_be_done_is_refused_before_the_arm_moves(one_link, settings, field, limit):
    with pytest.raises(DesignError) as error:
        run_of(one_link, **settings)
    assert (error.value.field, error.value.limit) == (field, limit)
    with pytest.raises(ParameterError):
        run_of(one_link, amplitude=-1.0)


def shaking(one_link, **settings):
    """A run that has waited for rest, and the number of its next sample."""
    run = run_of(
        one_link, **{"kind": "pulse", "amplitude": 1.0, "duration": 0.5, "rest": 0.5} | settings
    )
    for k in range(21):
        assert run.step(sample(k)) == (k == 20)
    assert run.stage is Stage.SHAKING and run.torque[0] == 1.0
    return run, 21


def test_it_waits_for_rest_shakes_and_ends_disabled(one_link):
    run, k = shaking(one_link)
    torques = []
    while run.step(sample(k)):
        torques.append(run.torque[0])
        k += 1
    assert run.stage is Stage.DONE and run.reason == "" and run.torque[0] == 0.0
    assert len(torques) == 99 and torques[24] == -1.0 and torques[60] == 0.0
    assert not run.step(sample(k + 1))


def test_an_arm_in_motion_is_not_shaken(one_link):
    run = run_of(one_link, amplitude=1.0)
    for k in range(30):
        assert not run.step(sample(k, position=0.001 * k))
    assert run.stage is Stage.STOPPED and "joint1 moved by 0.006 rad before" in run.reason


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        ({"position": 1.1}, "joint1 came to 1.1 rad, from 0 rad: beyond travel 1 rad"),
        ({"position": np.nan}, "position of joint1 is not finite"),
        ({"strain": -4.1e-3}, "strain of root came to 0.0041, beyond its limit 0.004"),
        ({"session": 2}, "the source of arm_state was restarted"),
        ({"period_ns": 0}, "the clock of arm_state went back"),
    ],
)
def test_a_limit_ends_it_for_good(one_link, broken, reason):
    run, k = shaking(one_link)
    assert not run.step(sample(k, **broken))
    assert run.stage is Stage.STOPPED and reason in run.reason
    assert run.torque[0] == 0.0
    assert not run.step(sample(k + 1))


def test_the_arm_files_limits_hold_within_the_travel(one_link):
    run = run_of(one_link, amplitude=1.0, travel=1.0)
    for k in range(21):
        run.step(sample(k, position=3.1))
    assert run.stage is Stage.SHAKING
    assert not run.step(sample(21, position=3.15))
    assert "the limits -3.14 to 3.14" in run.reason


def test_a_second_source_ends_it(one_link):
    run = run_of(one_link, kind="pulse", amplitude=1.0, duration=0.5, rest=0.5)
    run._order.take(sample(0, session=7))
    run._order.take(sample(0, session=1))
    run.step(sample(1, session=7))
    assert run.stage is Stage.STOPPED and "two sources" in run.reason


def test_a_repeated_state_has_the_same_answer(one_link):
    run, k = shaking(one_link)
    first = (run.step(sample(k, velocity=0.1)), run.torque.copy())
    again = (run.step(sample(k, velocity=0.2)), run.torque.copy())
    assert first[0] and again[0]
    np.testing.assert_array_equal(first[1], again[1])


def test_the_spring_pulls_back_and_damps_within_the_torque_limit(one_link):
    run, k = shaking(one_link, hold_frequency=0.2, rest=5.0)
    omega, inertia = 2.0 * np.pi * 0.2, one_link.terms(np.zeros(1), np.zeros(1)).M[0, 0]
    run.step(sample(k + 60, position=0.1, velocity=0.3))
    expected = -inertia * (omega**2 * 0.1 + 1.4 * omega * 0.3)
    # B^-1 of (10) is the inertia of the rigid arm.
    assert run.torque[0] == pytest.approx(expected, rel=1e-9)
    run.step(sample(k + 61, position=0.1, velocity=90.0))
    assert run.torque[0] == -13.5


def test_without_measured_speed_it_is_the_filtered_difference(one_link):
    run, k = shaking(one_link, hold_frequency=0.2, rest=9.0)
    for i in range(200):
        made = sample(k + 60 + i, position=1e-3 * i)
        made.velocity_known, made.velocity[:] = False, np.nan
        run.step(made)
    assert run._speed[0] == pytest.approx(0.1, rel=1e-3)
