# SPDX-License-Identifier: Apache-2.0
"""Jacobians and sampled linear systems against what is known in closed form, to machine precision."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from flexarm_dynamics import linear

T = 0.01  # [s]


def oscillator(omega, zeta):
    """A of x'' + 2 zeta omega x' + omega^2 x = 0, and e^(A T) written out."""
    A = np.array([[0.0, 1.0], [-(omega**2), -2.0 * zeta * omega]])
    damped, sigma = omega * np.sqrt(1.0 - zeta**2), zeta * omega
    c, s = np.cos(damped * T), np.sin(damped * T) / damped
    return A, np.exp(-sigma * T) * np.array([[c + sigma * s, s], [-(omega**2) * s, c - sigma * s]])


def test_jacobian_of_a_quadratic_is_exact():
    rng = np.random.default_rng(1)
    G, H, x = rng.standard_normal((3, 4)), rng.standard_normal((3, 4, 4)), rng.standard_normal(4)
    found = linear.jacobian(lambda x: G @ x + 0.5 * H @ x @ x, x, step=0.5)
    assert_allclose(found, G + 0.5 * (H + H.transpose(0, 2, 1)) @ x, rtol=1e-13, atol=1e-13)


def test_jacobian_by_nothing_has_no_columns():
    assert linear.jacobian(lambda x: np.ones(3), np.zeros(0)).shape == (3, 0)


def test_jacobian_takes_a_function_that_returns_its_own_array():
    out = np.zeros(2)

    def function(x):
        out[:] = 3.0 * x
        return out

    assert_allclose(linear.jacobian(function, np.ones(2), step=0.5), 3.0 * np.eye(2), rtol=1e-15)


@pytest.mark.parametrize(("omega", "zeta"), [(3.0, 0.0), (90.0, 0.4)])
def test_oscillator_is_sampled_exactly(omega, zeta):
    A, transition = oscillator(omega, zeta)
    B = np.array([[0.0], [2.0]])
    Phi, Gamma = linear.sampled(A, B, T)
    assert_allclose(Phi, transition, rtol=1e-13, atol=1e-13)
    assert_allclose(Gamma, np.linalg.solve(A, (transition - np.eye(2)) @ B), rtol=1e-11)


def test_double_integrator_is_sampled_exactly_and_stacks_are_too():
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    other, transition = oscillator(20.0, 0.1)
    Phi, Gamma = linear.sampled(np.stack([A, other]), B, T)
    assert_allclose(Phi, [[[1.0, T], [0.0, 1.0]], transition], rtol=1e-13, atol=1e-15)
    assert_allclose(Gamma[0], [[0.5 * T**2], [T]], rtol=1e-14)
    assert_allclose(Gamma[1], linear.sampled(other, B, T)[1], rtol=1e-13)


def test_noise_of_a_double_integrator_is_the_textbooks():
    A, S = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, 7.0])
    Q = linear.sampled_noise(A, S, T)
    assert_allclose(Q, 7.0 * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]]), rtol=1e-13)


@pytest.mark.parametrize("period", [T, 1.0, 30.0])  # e^(90 * 30) overflows
def test_noise_of_a_damped_mode_is_exact_and_ends_stationary(period):
    """From Lyapunov's equation: Q(T) = P - e^{AT} P e^{A^T T} with A P + P A^T = -S."""
    omega, zeta = 90.0, 0.05
    A, S = oscillator(omega, zeta)[0], np.diag([0.0, 1.0])
    P = np.diag([1.0 / omega**2, 1.0]) / (4.0 * zeta * omega)
    Phi = expm(A * period)
    wanted = P - Phi @ P @ Phi.T
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert_allclose(linear.sampled_noise(A, S, period) / scale, wanted / scale, atol=1e-12)


@pytest.mark.parametrize("name", ["R", "one_link", "two_link"])
def test_linear_plant_is_the_arms_equations_at_rest(shipped, name):
    """(2) with M, C, K at rest; gravity's part by q aside, which a stiff arm without gravity lacks."""
    model = shipped(name)
    n, m = model.n_joints, model.n_modes
    q = np.linspace(0.2, 0.5, n)
    A, B = linear.linear_plant(model, q)
    rest = linear.state_at_rest(model, q)
    assert_allclose(model.derivative(rest, linear.static_torque(model, q)), 0.0, atol=1e-8)
    t = model.terms(q, np.zeros(n), rest[n : n + m], np.zeros(m))
    assert_allclose(B, np.vstack([np.zeros((n + m, n)), t.H[:, :n]]), rtol=1e-9, atol=1e-12)
    K, C = np.vstack([t.K1, t.K2]), np.vstack([t.C1, t.C2])
    if not any(model.arm.gravity):
        assert_allclose(A[n + m :, n : n + m], -t.H @ K, rtol=1e-6, atol=1e-6 * np.abs(A).max())
        assert_allclose(A[n + m :, 2 * n + m :], -t.H @ C, rtol=1e-6, atol=1e-8 * np.abs(A).max())


@pytest.mark.parametrize("name", ["R", "two_link", "long_reach"])
def test_the_plant_about_a_motion_is_that_of_small_deviations_from_it(shipped, name):
    """Two nearby states a tenth of a millisecond on, under the torque of the motion, and the transition matrix."""
    model = shipped(name)
    n, half, rng = model.n_joints, model.n_joints + model.n_modes, np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-0.8, 0.8, (3, n))
    A, B = linear.moving_plant(model, q, qd, qdd)
    terms, state, dt = model.terms(q, qd), np.zeros(2 * half), 1e-4
    state[:n], state[half : half + n] = q, qd
    state[n:half] = np.linalg.solve(terms.K2, -terms.f2 - terms.M[n:, :n] @ qdd)
    none, joints = np.zeros(n), slice(half, half + n)
    viscous, move = model.friction_table()[:, 0], 1e-6 * rng.standard_normal(2 * half)

    def accelerated(s, u):
        """Under viscous friction alone."""
        speed = s[joints]
        rubs = model.friction(speed, s[n:half], s[half + n :]) - viscous * speed
        return np.array(model.derivative(s, u + rubs))

    torque = np.linalg.solve(B[joints], qdd - accelerated(state, none)[joints])
    assert_allclose(accelerated(state, torque)[joints], qdd, rtol=1e-8, atol=1e-8)

    def after(start):
        return solve_ivp(
            lambda _, s: accelerated(s, torque), (0.0, dt), start, rtol=1e-12, atol=1e-14
        ).y[:, -1]

    found, wanted = after(state + move) - after(state - move), 2.0 * expm(A * dt) @ move
    for part in (slice(half), slice(half, None)):
        assert np.abs(found - wanted)[part].max() < 1e-3 * np.abs(wanted[part]).max()


def test_coulomb_friction_at_rest_is_left_out_on_request(shipped):
    model = shipped("two_link")
    n, m = model.n_joints, model.n_modes
    with_it, B = linear.linear_plant(model, np.zeros(n))
    without, _ = linear.linear_plant(model, np.zeros(n), coulomb=False)
    _, coulomb, smoothing = model.friction_table().T
    lost = B @ np.diag(coulomb / smoothing)
    assert_allclose(
        (without - with_it)[:, n + m : 2 * n + m], lost, atol=1e-6 * np.abs(with_it).max()
    )
