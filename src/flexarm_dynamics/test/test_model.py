# SPDX-License-Identifier: Apache-2.0
"""Terms of the equations of motion, structural damping, frequencies of any model."""

import numpy as np
import pytest
from scipy.linalg import eigh

from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models.model import Terms, damping_matrix


def matrices(m=3):
    rng = np.random.default_rng(1)
    A, B = rng.standard_normal((2, m, m))
    return A @ A.T + np.eye(m), B @ B.T + np.eye(m)


def test_partition_is_the_inverse_of_the_mass_matrix():
    M, _ = matrices(5)
    t = Terms(M, *(np.zeros(k) for k in (2, 3)), *(np.zeros((2, 3)), np.zeros((3, 3))) * 2)
    H11, H12, H21, H22 = t.partition()
    assert (H11.shape, H12.shape, H21.shape, H22.shape) == ((2, 2), (2, 3), (3, 2), (3, 3))
    np.testing.assert_allclose(M @ np.block([[H11, H12], [H21, H22]]), np.eye(5), atol=1e-12)


def test_damping_matrix_gives_each_mode_its_ratio():
    M, K = matrices()
    ratios = (0.01, 0.2, 0.05)
    D = damping_matrix(M, K, ratios)
    squares, psi = eigh(K, M)
    modal = psi.T @ D @ psi
    np.testing.assert_allclose(
        modal, np.diag(2.0 * np.array(ratios) * np.sqrt(squares)), atol=1e-12
    )
    np.testing.assert_allclose(D, D.T, atol=1e-13)


def test_damping_ratios_repeat_their_last_and_none_is_none():
    M, K = matrices()
    np.testing.assert_array_equal(
        damping_matrix(M, K, (0.1,)), damping_matrix(M, K, (0.1, 0.1, 0.1))
    )
    np.testing.assert_array_equal(damping_matrix(M, K, ()), np.zeros((3, 3)))
    # More ratios than modes: the first ones count.
    np.testing.assert_array_equal(
        damping_matrix(M, K, (0.1, 0.2, 0.3, 0.9)), damping_matrix(M, K, (0.1, 0.2, 0.3))
    )


def test_stiffness_that_is_not_definite_is_refused():
    M, K = matrices()
    with pytest.raises(ModelError) as error:
        damping_matrix(M, K - 100.0 * np.eye(3), (0.1,))
    assert error.value.field == "modal stiffness" and error.value.value < 0.0


@pytest.mark.parametrize("name", ["R", "P3", "one_link"])
def test_frequencies_are_those_of_the_whole_system(name, shipped):
    """Free: eigenvalues of (K, M) with the joint in; locked: the modes alone."""
    arm_model = shipped(name)
    t = arm_model.terms(np.zeros(1), np.zeros(1))
    K = np.zeros((3, 3))
    K[1:, 1:] = t.K2
    squares = eigh(K, t.M, eigvals_only=True)
    assert abs(squares[0]) < 1e-9 * squares[-1]
    np.testing.assert_allclose(arm_model.frequencies(), np.sqrt(squares[1:]), rtol=1e-9)
    locked = np.sqrt(eigh(t.K2, t.M[1:, 1:], eigvals_only=True))
    np.testing.assert_allclose(arm_model.frequencies(locked=True), locked, rtol=1e-11)
    assert np.all(arm_model.frequencies() > locked)
