# SPDX-License-Identifier: Apache-2.0
"""What is compiled for every sample gives what numpy and scipy give."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline, interp1d

from flexarm_control import kernels
from flexarm_control.manifold import expansion
from flexarm_dynamics.kernels import rigid
from flexarm_dynamics.models.model import Terms

COMPILED = kernels.compiled()
RNG = np.random.default_rng(1)
INF = np.inf


@pytest.mark.parametrize("t", [-0.3, 0.0, 0.4, 1.0, 1.7, 2.5, 3.1])
def test_a_cubic_is_scipys_within_and_beyond_its_ends(t):
    spline = CubicHermiteSpline([0.0, 0.5, 1.0, 2.5], *RNG.normal(size=(2, 4, 3)))
    out = np.empty(3)
    COMPILED.cubic(spline.c, spline.x, t, out)
    np.testing.assert_allclose(out, spline(t), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("t", [-1.0, 0.0, 0.3, 1.0, 1.7, 2.0, 5.0])
def test_between_times_gains_are_linear_and_held_beyond_the_ends(t):
    times, gains, out = np.array([0.0, 1.0, 2.0]), RNG.normal(size=(3, 2, 4)), np.zeros((2, 4))
    COMPILED.between(times, gains, t, out)
    wanted = interp1d(times, gains, axis=0)(np.clip(t, 0.0, 2.0))
    np.testing.assert_allclose(out, wanted, rtol=1e-14, atol=1e-15)
    COMPILED.between(times[:1], gains[:1], t, out)
    np.testing.assert_array_equal(out, gains[0])


@pytest.mark.parametrize("x", [0.0, 0.4, 1.0, 1.9, 2.0, 3.5])
def test_between_rows_values_are_linear_and_the_last_one_is_held(x):
    values, out = RNG.normal(size=(3, 2)), np.zeros(2)
    COMPILED.evenly_between(values, x, out)
    wanted = interp1d(np.arange(3.0), values, axis=0)(min(x, 2.0))
    np.testing.assert_allclose(out, wanted, rtol=1e-14, atol=1e-15)


def test_responses_of_the_bending_are_those_of_scipys_integrator():
    m, n, count, steps, T = 2, 2, 3, 200, 1.3
    by = np.random.default_rng(2).normal(size=(m, 3, n))  # whatever other tests have drawn
    spring, damper = -40.0 * np.eye(m), -0.3 * np.eye(m)
    spring[0, 1] = 7.0
    shift = [lambda t, k=k: np.sin((k + 1.0) * t) for k in range(count)]
    shift_d = [lambda t, k=k: (k + 1.0) * np.cos((k + 1.0) * t) for k in range(count)]
    shift_dd = [lambda t, k=k: -((k + 1.0) ** 2) * np.sin((k + 1.0) * t) for k in range(count)]
    times = np.linspace(0.0, T, 2 * steps + 1)
    basis = np.array([[[f(t) for f in part] for t in times] for part in (shift, shift_d, shift_dd)])
    rows, out = np.array([0, 77, steps]), np.zeros((3, 3, m, n * count))
    every = (
        np.ascontiguousarray(np.broadcast_to(x, (times.size, *x.shape)))
        for x in (spring, damper, by)
    )
    COMPILED.responses(*every, basis, T / steps, rows, out)
    for joint in range(n):
        for k in range(count):

            def rates(t, s, joint=joint, k=k):
                force = by[:, :, joint] @ [shift[k](t), shift_d[k](t), shift_dd[k](t)]
                return np.concatenate([s[m:], spring @ s[:m] + damper @ s[m:] + force])

            wanted = solve_ivp(
                rates,
                (0.0, T),
                np.zeros(2 * m),
                "DOP853",
                dense_output=True,
                rtol=1e-10,
                atol=1e-12,
            )
            for row, step in enumerate(rows):
                t = step * T / steps
                state = wanted.sol(t)
                found = out[row, :, :, joint * count + k].ravel()
                # Steps of 0.04 rad, to the fourth power.
                np.testing.assert_allclose(found, [*state, *rates(t, state)[m:]], atol=5e-6)


def test_polynomials_are_numpys():
    coefficients, out = RNG.normal(size=(5, 3, 2)), np.empty((3, 2))
    COMPILED.horner(coefficients, 0.7, out)
    np.testing.assert_allclose(out, np.polyval(coefficients[::-1], 0.7), rtol=1e-14)


def test_equations_whose_first_pivot_is_zero_are_solved():
    random = np.random.default_rng(1)  # not of any condition: tests run in any order
    A = random.normal(size=(5, 5))
    A[0, 0] = 0.0
    x = random.normal(size=5)
    b = A @ x
    rigid.solve(A, b)
    np.testing.assert_allclose(b, x, rtol=1e-12)


def test_a_torque_is_sent_within_rate_and_size_and_a_limit_that_is_met_is_reported():
    limit, rate, zero = np.array([2.0, INF]), np.array([INF, 10.0]), np.zeros(2)
    for u, sent, met in (
        ([1.0, 0.05], [1.0, 0.05], False),
        ([3.0, 0.0], [2.0, 0.0], True),
        ([0.0, -1.0], [0.0, -0.1], True),
    ):
        torque = np.zeros(2)
        assert COMPILED.sent(np.array(u), zero, 1.0, rate, 0.01, limit, torque) == met
        assert torque.tolist() == sent
    assert not COMPILED.sent(zero, zero, 1.0, rate, 0.0, limit, np.zeros(2))  # at a start


@pytest.mark.parametrize(("index", "value"), [(0, 3.0), (1, -3.0), (0, np.nan)])
def test_what_is_beyond_a_limit_or_no_number_is_seen(index, value):
    error, none = np.zeros(2), np.zeros(0)
    given = np.zeros(2), np.zeros(2), none, np.zeros((0, 4)), np.zeros((0, 0))
    state = np.r_[0.5, 0.5, np.zeros(5)], np.zeros(7), np.zeros(7)
    assert not COMPILED.watched(error, *given, *state)
    error[index] = value
    assert COMPILED.watched(error, *given, *state)


def test_the_error_of_a_simulated_arm_is_that_of_its_joints_and_of_all():
    state, left, own, error = (
        np.array([1.0, 5.0]),
        np.array([0.5, 0.0, 9.0]),
        np.ones(2),
        np.zeros(2),
    )
    assert COMPILED.off(state, left, own, error) == (0.5, 4.0)
    assert error.tolist() == [0.5, 4.0]
    own[1] = np.nan
    assert all(np.isnan(COMPILED.off(state, left, own, error)))


def test_readings_are_low_passed_as_by_the_matrix():
    rows, weights, signal = RNG.normal(size=(5, 4)), RNG.normal(size=(3, 5)), RNG.normal(size=4)
    wanted = weights @ np.vstack([signal, rows[0], rows[2:]])
    COMPILED.low_passed(rows, weights, signal)
    np.testing.assert_allclose(rows[2:], wanted, rtol=1e-13)


@pytest.mark.parametrize(
    ("strain", "well"),
    [([0.1, 0.2], True), ([0.1, 1.0], False), ([np.nan, 0.2], False), ([0.1, 0.3], False)],
)
def test_gauges_are_well_that_move_within_their_range(strain, well):
    low, high, last = np.full(2, -1.0), np.ones(2), np.array([0.0, 0.3])
    same, seen = np.full(2, 7), np.zeros((2, 2, 2))
    assert COMPILED.all_well(np.array(strain), low, high, last, same, seen) == well
    assert last.tolist() == (strain if well else [0.0, 0.3])
    assert same.tolist() == ([0, 0] if well else [7, 7])
    assert seen.tolist() == ([[strain] * 2] * 2 if well else np.zeros((2, 2, 2)).tolist())


def expanded(step, order, M, f2, C2, K2, acceleration, f1, C1, K1):
    """The manifold's expansion, written as in its module's equations: deflection, derivatives, both torques."""
    n, r = f1.size, len(M) // 2
    zero = {
        i - r: -np.linalg.solve(K2[i], M[i][n:, :n] @ acceleration[i] + f2[i])
        for i in range(len(M))
    }
    level, rate, second = dict(zero), np.zeros(f2[0].size), np.zeros(f2[0].size)
    for k in range(1, order + 1):
        if k % 2:
            rate = (level[1] - level[-1]) / (2.0 * step)
            continue
        inner = range(1 - max(level), max(level))
        bend = {i: (level[i + 1] - 2.0 * level[i] + level[i - 1]) / step**2 for i in inner}
        speed = {i: (level[i + 1] - level[i - 1]) / (2.0 * step) for i in inner}
        second = bend[0]
        level = {
            i: zero[i]
            - np.linalg.solve(K2[i + r], M[i + r][n:, n:] @ bend[i] + C2[i + r] @ speed[i])
            for i in inner
        }
    bending = M[r][:n, n:] @ second + C1 @ rate
    torque = M[r][:n, :n] @ acceleration[r] + f1 + bending + K1 @ level[0]
    return level[0], rate, second, torque, bending + K1 @ (level[0] - zero[0])


@pytest.mark.parametrize("order", range(7))
@pytest.mark.parametrize(("n", "m"), [(1, 2), (3, 4), (2, 0)])
def test_a_manifold_is_expanded_as_its_equations_say(order, n, m):
    points = 2 * expansion.reach(order) + 1
    sizes = (n + m, n + m), (n,), (m,), (n, m), (m, m), (n, m), (m, m)
    terms = [Terms(*(RNG.normal(size=size) for size in sizes)) for _ in range(points)]
    terms = [t._replace(K2=t.K2 + 9.0 * np.eye(m)) for t in terms]
    acceleration = RNG.normal(size=(points, n))
    M, _, f2, _, C2, _, K2 = zip(*terms, strict=True)
    here = terms[points // 2]
    wanted = expanded(
        expansion.step(order), order, M, f2, C2, K2, acceleration, here.f1, here.C1, here.K1
    )
    stacked = Terms(*map(np.array, zip(*terms, strict=True)))
    for mine, its in zip(expansion.expand(stacked, acceleration, order), wanted, strict=True):
        np.testing.assert_allclose(mine, its, rtol=1e-8, atol=1e-10 * max(1.0, *np.abs(its), 0.0))
