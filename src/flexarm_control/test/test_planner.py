# SPDX-License-Identifier: Apache-2.0
"""The planner's least squares: equations that hold, and a penalty on torque beyond its limit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import null_space

from flexarm_control.feedforward.planner import PENALTY, _least, _penalised


@given(st.integers(0, 10_000), st.integers(0, 3), st.integers(1, 12))
def test_the_solution_is_stationary_among_those_that_hold_the_equations(seed, held, count):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    H, right = root @ root.T + 0.1 * np.eye(6), rng.normal(size=6)
    A, b = rng.normal(size=(held, 6)), rng.normal(size=held)
    rows, values = rng.normal(size=(count, 6)), rng.uniform(-0.5, 1.0, count)
    free = _least(H, right, A, b)
    x = _penalised(H, right, A, b, rows, values, free)
    assert_allclose(A @ x, b, atol=1e-8)
    slope = H @ x - right + PENALTY * rows.T @ np.maximum(rows @ x - values, 0.0)
    along = null_space(A) if held else np.eye(6)
    size = 1.0 + np.abs(H).max() * np.abs(x).max()
    assert_allclose(along.T @ slope, 0.0, atol=1e-7 * size)
    if (rows @ free <= values).all():
        assert_allclose(x, free)


def test_a_bound_that_the_free_solution_keeps_changes_nothing():
    H, none = np.eye(2), np.zeros((0, 2))
    free = _least(H, np.array([1.0, 2.0]), none, np.zeros(0))
    assert free == pytest.approx([1.0, 2.0])
    x = _penalised(
        H, np.array([1.0, 2.0]), none, np.zeros(0), np.eye(2), np.array([3.0, 3.0]), free
    )
    assert (x == free).all()


def test_a_single_penalty_has_its_closed_form():
    # min (x - 2)^2 / 2 + w max(0, x - 1)^2 / 2
    H, none = np.eye(1), np.zeros((0, 1))
    x = _penalised(H, np.array([2.0]), none, np.zeros(0), np.eye(1), np.ones(1), np.array([2.0]))
    assert x == pytest.approx([(2.0 + PENALTY) / (1.0 + PENALTY)])
