# SPDX-License-Identifier: Apache-2.0
"""The least-exciting motion: its optimum, its limits, and what the full model, integrated, says of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from flexarm_control.motions import excitation, profiles
from flexarm_control.motions.least_exciting import _Problem, least_exciting, least_squares
from flexarm_dynamics.errors import FlexarmError, TrajectoryError
from flexarm_dynamics.models import model
from flexarm_sim.integrators import METHODS

QUARTER = np.pi / 2


@pytest.fixture(scope="module")
def motion(arm_r):
    """The paper's move in 2 s, with a limit below the quintic's peak torque."""
    return least_exciting(arm_r, [0.0], [QUARTER], 2.0, torque_limit=[3.5])


def test_it_goes_from_rest_to_rest_without_jerk_and_never_back(motion):
    profile = motion.profile
    t = np.linspace(0.0, 2.0, 1001)
    np.testing.assert_allclose(profile.position([0.0, 2.0])[:, 0], [0.0, QUARTER], atol=1e-12)
    assert profile.velocity(t).min() > -1e-6
    for at in (0.0, 2.0):
        np.testing.assert_allclose(profile.velocity(at), 0.0, atol=1e-10)
        np.testing.assert_allclose(profile.acceleration(at), 0.0, atol=1e-9)
    # The acceleration leaves zero as s^2: no jerk.
    assert abs(profile.acceleration(1e-4)[0]) < 1e-3


def test_the_torque_stays_within_its_limit_and_uses_it(motion):
    assert motion.quintic.peak_torque[0] > 3.55
    assert 3.49 < motion.excitation.peak_torque[0] <= 3.5 * (1.0 + 1e-5)


@pytest.mark.slow
def test_it_excites_less_than_the_families_of_the_same_duration(arm_r, motion):
    others = [profiles.quintic(0.0, QUARTER, 2.0), profiles.paper_profile(2.0)]
    others += [profiles.smooth(0.0, QUARTER, 2.0, k) for k in (3, 4)]
    for other in others:
        excited = excitation.along(arm_r, other, points=301)
        assert motion.excitation.residual < 0.01 * excited.residual
        assert motion.excitation.transient < excited.transient


def test_the_full_model_is_left_as_quiet_as_the_linear_theory_says(arm_r, motion):
    """Nonlinear equations of motion under the slow torque alone, against the linear energy."""

    def energy_left(profile):
        states = zip(*profile.states(np.linspace(0.0, 2.0, 401)), strict=True)
        torque = np.array([excitation.reduced(arm_r, *state)[0] for state in states])
        rows = np.zeros((401, 6))
        arm_r.stepper(METHODS["dop853"]).trajectory(rows, torque[:-1], torque[1:], 0.005)
        state = rows[-1]
        terms = arm_r.terms(state[:1], np.zeros(1))
        inertia = np.linalg.inv(terms.partition()[3])
        return 0.5 * state[1:3] @ terms.K2 @ state[1:3] + 0.5 * state[4:] @ inertia @ state[4:]

    quintics = profiles.quintic(0.0, QUARTER, 2.0)
    left = energy_left(quintics)
    assert left == pytest.approx(motion.quintic.residual, rel=0.1)
    assert energy_left(motion.profile) < 1e-4 * left


def test_no_feasible_neighbour_is_better(arm_r):
    """Convexity: along any way that keeps the limits the objective of the last programme does not fall."""
    base = profiles.quintic([0.0], [QUARTER], 2.0)
    problem = _Problem(arm_r, base, np.array([3.5]), np.array([np.inf]))
    x, _ = problem.solve()
    r, A = problem.linearised(x, 2.0)
    E, f = problem._objective(r[:, 1:], A[:, 1:])
    torque, slopes = problem.torque_rows(r, A)
    inside = problem._programme(x, 0.95)  # keeps the limits with something to spare
    rng, tried, best = np.random.default_rng(3), 0, np.linalg.norm(E @ x - f)
    for part in np.geomspace(1e-3, 0.3, 20):
        for size in (0.0, 1e-3, 1e-2):
            near = x + part * (inside - x + size * rng.standard_normal(x.size))
            rate = problem.basis.constants[1] + problem.basis.matrices[1] @ near
            if np.abs(torque + slopes @ near).max() > 1.0 or rate.min() < 0.0:
                continue
            tried += 1
            assert np.linalg.norm(E @ near - f) >= best * (1.0 - 1e-7)
    assert tried >= 20


def test_constrained_least_squares_agree_with_another_method():
    rng = np.random.default_rng(5)
    for _ in range(5):
        E, f = rng.standard_normal((12, 5)), 3.0 * rng.standard_normal(12)
        G, h = rng.standard_normal((9, 5)), rng.uniform(-1.0, 0.2, 9)
        x = least_squares(E, f, G, h)
        assert (G @ x - h).min() > -1e-9
        other = minimize(
            lambda x, E=E, f=f: np.sum((E @ x - f) ** 2),
            np.zeros(5),
            jac=lambda x, E=E, f=f: 2.0 * E.T @ (E @ x - f),
            constraints={"type": "ineq", "fun": lambda x, G=G, h=h: G @ x - h},
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        )
        np.testing.assert_allclose(x, other.x, atol=1e-5)
    with pytest.raises(TrajectoryError, match="limits contradict each other"):
        least_squares(np.eye(2), np.zeros(2), np.array([[1.0, 0.0], [-1.0, 0.0]]), np.ones(2))


def test_the_least_torque_it_names_is_near_the_double_integrators_and_does(arm_r):
    """Bang-bang, 4 I angle / T^2, is the least of all motions; jerk-free ones want some more."""
    with pytest.raises(TrajectoryError, match=r"duration: 2\.0 s is too short") as error:
        least_exciting(arm_r, [0.0], [QUARTER], 2.0, torque_limit=[2.0])
    words = str(error.value).split()
    factor = float(words[words.index("needs") + 1])
    inertia = arm_r.terms(np.zeros(1), np.zeros(1)).M[0, 0]
    assert 1.0 < 2.0 * factor / (4.0 * inertia * QUARTER / 4.0) < 1.15
    duration = float(error.value.hint.split()[1])
    # Without gravity the least torque falls as 1 / T^2.
    assert duration == pytest.approx(2.0 * np.sqrt(factor), rel=0.015)
    found = least_exciting(arm_r, [0.0], [QUARTER], 1.01 * duration, torque_limit=[2.0])
    assert found.excitation.peak_torque[0] <= 2.0 * (1.0 + 1e-5)


def test_two_joints_move_together_within_both_torques_and_both_speeds(two_link):
    found = least_exciting(two_link, [0.0, 0.2], [0.8, 0.6], 3.0, [0.45, 1.0], [0.45, 1.0])
    t = np.linspace(0.0, 3.0, 301)
    way = (found.profile.position(t) - [0.0, 0.2]) / [0.8, 0.4]
    np.testing.assert_allclose(way[:, 0], way[:, 1], atol=1e-12)
    assert (found.excitation.peak_torque <= np.array([0.45, 1.0]) * (1 + 1e-5)).all()
    assert found.profile.velocity(t)[:, 0].max() <= 0.45 * (1.0 + 1e-3)
    assert found.excitation.residual < 0.01 * found.quintic.residual


def test_a_rigid_arm_gets_the_smoothest_motion_and_gravity_that_cant_be_held_is_named(rigid):
    found = least_exciting(rigid, [0.0, 0.2], [0.5, 0.5], 2.0)
    assert found.excitation.residual == 0.0 and found.rounds <= 3
    message = r"holding the arm on the way takes 1\.\d+ times the torque limits"
    with pytest.raises(TrajectoryError, match=message):
        least_exciting(rigid, [0.0, 0.2], [0.5, 0.5], 2.0, torque_limit=[6.0, 10.0])


@pytest.mark.parametrize(
    ("change", "field", "limit"),
    [
        ({"end": [0.0]}, "end", None),
        ({"duration": 0.0}, "duration", "above 0, at most 1e+09"),
        ({"torque_limit": [0.0]}, "torque_limit[0]", "above 0"),
        ({"velocity_limit": [1.0, 1.0]}, "velocity_limit", (1,)),
        ({"start": [0.0, 0.0], "end": [1.0, 1.0]}, "start", (1,)),
    ],
)
def test_what_makes_no_motion_is_refused(arm_r, change, field, limit):
    wanted = {"start": [0.0], "end": [1.0], "duration": 1.0} | change
    with pytest.raises(FlexarmError) as error:
        least_exciting(arm_r, **wanted)
    assert (error.value.field, error.value.limit) == (field, limit)


def test_a_speed_limit_that_is_too_low_alone_is_named(arm_r):
    with pytest.raises(TrajectoryError, match=r"speed limits alone need 2 s; take [\d.]+ s"):
        least_exciting(arm_r, [0.0], [1.0], 1.0, velocity_limit=[0.5])


def test_an_arm_without_torque_limits_needs_none(arm_r):
    joint = replace(arm_r.arm.joints[0], limits=replace(arm_r.arm.joints[0].limits, torque=np.inf))
    free = model.build(replace(arm_r.arm, joints=(joint,)))
    found = least_exciting(free, [0.0], [QUARTER], 2.0)
    assert found.excitation.residual < 1e-4 * found.quintic.residual
