# SPDX-License-Identifier: Apache-2.0
"""Integrators: the tableau's order, substeps, the error-controlled solution, what can't be integrated."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models import model
from flexarm_dynamics.models.fixed_step import lost
from flexarm_sim.integrators import MAX_SUBSTEPS, METHODS, PHASE_PER_STEP, integrate, substeps

METHOD = METHODS["dop853"]
TABLEAU, WEIGHTS = METHOD.A, METHOD.weights
START = np.array([0.3, 0.02, -0.004, 1.5, 0.1, 0.3])  # bent and turning
TORQUE = np.array([3.0])


def stepped(arm, step, count):
    """The compiled integrator's state after `count` steps from START."""
    state = START.copy()
    arm.stepper(METHOD)(state, TORQUE, step, count, arm.friction_table())
    return state


def test_the_tableau_is_explicit_and_consistent():
    assert_array_equal(np.triu(TABLEAU), np.zeros_like(TABLEAU))
    assert_allclose(WEIGHTS.sum(), 1.0, rtol=1e-14)
    c = TABLEAU.sum(axis=1)
    for power in range(1, 8):  # quadrature conditions of order eight
        assert_allclose(WEIGHTS @ c**power, 1.0 / (power + 1), rtol=1e-12)


def test_the_compiled_integrator_converges_with_order_eight(arm_r):
    exact = integrate(arm_r, START, lambda t, s: TORQUE, [0.0, 0.64], 1e-13, 1e-15)[-1]
    steps = np.array([0.016, 0.008])  # [s], 1.4 and 0.7 of the second mode's phase
    errors = [
        np.linalg.norm((stepped(arm_r, h, round(0.64 / h)) - exact) / np.abs(START)) for h in steps
    ]
    assert errors[1] > 1e-10  # above rounding, or the order means nothing
    assert 7.5 < np.log2(errors[0] / errors[1]) < 9.5


@pytest.mark.parametrize("name", ["arm_r", "heavy_arm"])
def test_one_compiled_step_is_the_runge_kutta_step_of_the_models_equations(request, name):
    arm, h = request.getfixturevalue(name), 1e-3
    stages = []
    for row in TABLEAU:
        stage = START + h * sum((a * k for a, k in zip(row, stages, strict=False)), np.zeros(6))
        stages.append(arm.derivative(stage, TORQUE))
    assert_allclose(stepped(arm, h, 1), START + h * WEIGHTS @ np.array(stages), rtol=1e-12)


def test_a_substep_stays_below_a_radian_of_the_highest_mode(arm_r):
    for count in (2, 3, 5, 8):
        arm = model.build(arm_r.arm.with_modes(count))
        highest = arm.frequencies()[-1]
        for period in (1e-3, 1e-2):
            n = substeps(arm, period)
            assert highest * period / n <= PHASE_PER_STEP["dop853"]
            assert n == 1 or highest * period / (n - 1) > PHASE_PER_STEP["dop853"]
            assert substeps(arm, period, "rk4") >= n
            assert substeps(arm, period, "implicit") == 1


@pytest.mark.parametrize("method", ["dop853", "rk4"])
def test_a_mode_at_the_longest_substep_loses_less_than_a_millionth_of_its_energy_a_period(method):
    assert 1e-7 < lost(method, PHASE_PER_STEP[method]) < 1e-6  # shorter ones would be of no use


def test_what_a_method_loses_is_what_an_oscillator_loses():
    phase, state = 1.6, np.array([1.0, 0.0])
    omega = np.array([[0.0, 1.0], [-(phase**2), 0.0]])
    stages = []
    for row in TABLEAU:
        stages.append(omega @ (state + sum(a * k for a, k in zip(row, stages, strict=False))))
    state = state + sum(b * k for b, k in zip(WEIGHTS, stages, strict=True))
    energy = state[0] ** 2 + (state[1] / phase) ** 2  # of 1 before the step
    assert_allclose(lost("dop853", phase), 1.0 - energy ** (2.0 * np.pi / phase), rtol=1e-6)


def test_a_damped_mode_takes_fewer_substeps_and_the_arm_moves_the_same():
    """The twist of `long_reach`, 1829 rad/s: one substep of a millisecond, beside eight."""
    arm = arm_file.load("long_reach")
    chain, undamped = model.build(arm), model.build(scaled(arm, damping=0.0))
    assert chain.frequencies()[-1] > 1.5e3
    assert (substeps(chain, 1e-3), substeps(undamped, 1e-3)) == (1, 2)
    n, m, advance = chain.n_joints, chain.n_modes, chain.stepper(METHOD)
    ends = []
    for count in (1, 8):
        state = np.zeros(2 * (n + m))
        state[:n] = 0.0, 1.2, 0.8, -0.8
        for k in range(300):  # a torque that jumps
            advance(
                state, np.array([50.0, 100.0, 60.0, 20.0]) * (k % 100 < 20), 1e-3 / count, count
            )
        ends.append(chain.tip_position(state[:n], state[n : n + m]))
    assert np.abs(ends[0] - ends[1]).max() < 1e-6  # [m]


def test_a_rigid_or_slow_arm_takes_one_substep(arm_r):
    assert substeps(arm_r, 1e-3) == 1
    assert substeps(SimpleNamespace(n_modes=0, transmission_rates=lambda: (0.0, 0.0)), 1.0) == 1


def test_a_mode_too_fast_to_simulate_is_refused_saying_what_to_change():
    arm = model.build(arm_file.load("R").with_modes(5))
    with pytest.raises(ModelError, match=rf"at most {MAX_SUBSTEPS}.*integrator implicit"):
        substeps(arm, 20.0)


def test_the_error_controlled_solution_keeps_the_energy(arm_r):
    times = np.linspace(0.0, 2.0, 5)
    states = integrate(arm_r, START, lambda t, s: np.zeros(1), times)
    energies = [arm_r.energy(s) for s in states]
    assert_array_equal(states[0], START)
    assert_allclose(energies, energies[0], rtol=1e-9)


def test_the_error_controlled_solution_takes_a_torque_of_time_and_state(arm_r):
    stiff = replace(arm_r.arm.links[0], stiffness={"y": 1e3 * arm_r.arm.links[0].stiffness["y"]})
    rigid = model.build(replace(arm_r.arm, links=(stiff,)))
    J = rigid.coefficients.rigid
    # J q'' = -J q + J: a rigid joint on a spring, from rest
    times = np.linspace(0.0, 1.0, 6)
    torque = lambda t, s: J * (1.0 - s[:1])  # noqa: E731
    q = integrate(rigid, np.zeros(6), torque, times, 1e-7, 1e-9)[:, 0]
    assert_allclose(q, 1.0 - np.cos(times), atol=2e-4)


def test_no_time_to_integrate_over_gives_the_initial_state(arm_r):
    for times in ([0.5], [0.5, 0.5]):
        states = integrate(arm_r, START, lambda t, s: TORQUE, np.array(times))
        assert_array_equal(states, [START] * len(times))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_integration_that_fails_says_where(arm_r):
    with pytest.raises(ModelError, match=r"R: integration stopped at 0\.0 s"):
        integrate(arm_r, START, lambda t, s: np.full(1, np.nan), np.array([0.0, 1.0]))
