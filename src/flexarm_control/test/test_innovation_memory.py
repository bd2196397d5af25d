# SPDX-License-Identifier: Apache-2.0
"""What past innovations tell: the regression on all of them, sample by sample."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.observers.innovation_memory import PRIOR, InnovationMemory

NOISE = np.array([2e-6, 1e-6])
A = np.array([[0.6, 0.3], [-0.2, 0.4]])


def coloured(count):
    """Innovations that follow from the last one by A, shape (count, 2)."""
    made = np.zeros((count, 2))
    for k, new in enumerate(np.random.default_rng(1).standard_normal((count, 2))):
        made[k] = A @ made[k - 1] + new
    return made * NOISE


def test_the_coefficients_are_those_of_the_regression_on_all_samples():
    values, made = coloured(300), InnovationMemory(NOISE, 2)
    for v in values:
        made.take(v)
    scaled = np.vstack([np.zeros((2, 2)), values / NOISE])
    past = np.hstack([scaled[1:-1], scaled[:-2]])
    whole = np.linalg.solve(past.T @ past + np.eye(4) / PRIOR, past.T @ scaled[2:])
    assert_allclose(made.coefficients, whole, rtol=1e-8, atol=1e-10)
    assert_allclose(made.predict(), NOISE * (np.r_[scaled[-1], scaled[-2]] @ whole), rtol=1e-8)


def test_coloured_innovations_are_predicted_and_white_ones_are_not():
    values, made, errors = coloured(2000), InnovationMemory(NOISE, 3), []
    for v in values:
        errors.append(v - made.predict())
        made.take(v)
    late = np.array(errors)[1000:]
    assert late.std(axis=0) == pytest.approx(NOISE, rel=0.05)
    assert (late.std(axis=0) < 0.92 * values.std(axis=0)).all()


def test_what_was_learnt_can_be_kept():
    values, made = coloured(200), InnovationMemory(NOISE, 2)
    for v in values[:100]:
        made.take(v)
    made.learning, kept = False, made.coefficients.copy()
    for v in values[100:]:
        made.take(v)
    assert_allclose(made.coefficients, kept, rtol=0)
    scaled = values[:-3:-1].ravel() / np.tile(NOISE, 2)
    assert_allclose(made.predict(), NOISE * (scaled @ kept))


def test_a_gauge_that_is_left_out_and_a_gap_teach_nothing():
    made = InnovationMemory(NOISE, 2)
    for v in coloured(100):
        made.take(v)
    kept = made.coefficients.copy()
    made.take(np.array([np.nan, 1e-6]))
    assert_allclose(made.coefficients, kept, rtol=0)
    assert np.isfinite(made.predict()).all()
    made.forget_past()
    assert not made.predict().any()


def test_order_zero_predicts_nothing():
    made = InnovationMemory(NOISE, 0)
    made.take(NOISE)
    assert_allclose(made.predict(), 0.0)
