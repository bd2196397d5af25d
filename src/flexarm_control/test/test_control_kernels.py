# SPDX-License-Identifier: Apache-2.0
"""What is compiled for every sample gives what numpy and scipy give."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from flexarm_control import kernels
from flexarm_dynamics.kernels import rigid

COMPILED = kernels.compiled()
RNG = np.random.default_rng(1)
INF = np.inf


@pytest.mark.parametrize("t", [-0.3, 0.0, 0.4, 1.0, 1.7, 2.5, 3.1])
def test_a_cubic_is_scipys_within_and_beyond_its_ends(t):
    spline = CubicHermiteSpline([0.0, 0.5, 1.0, 2.5], *RNG.normal(size=(2, 4, 3)))
    out = np.empty(3)
    COMPILED.cubic(spline.c, spline.x, t, out)
    np.testing.assert_allclose(out, spline(t), rtol=1e-13, atol=1e-13)


def test_polynomials_are_numpys():
    coefficients, out = RNG.normal(size=(5, 3, 2)), np.empty((3, 2))
    COMPILED.horner(coefficients, 0.7, out)
    np.testing.assert_allclose(out, np.polyval(coefficients[::-1], 0.7), rtol=1e-14)


def test_equations_whose_first_pivot_is_zero_are_solved():
    A = RNG.normal(size=(5, 5))
    A[0, 0] = 0.0
    x = RNG.normal(size=5)
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
    assert COMPILED.all_well(np.array(strain), low, high, last) == well
    assert last.tolist() == (strain if well else [0.0, 0.3])
