# SPDX-License-Identifier: Apache-2.0
"""Sampling over any period: against the matrix exponential, entry by entry."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.linear import state_matrix
from flexarm_dynamics.models import model
from flexarm_dynamics.sampling import Sampling, discretise


def linearised(name):
    """A of a shipped arm, and white forces of density one on joints and modes."""
    arm = model.build(arm_file.load(name))
    half, q = arm.n_joints + arm.n_modes, np.full(arm.n_joints, 0.3)
    A = state_matrix(arm, np.append(q, np.zeros(2 * half - q.size)), coulomb=False)
    inverse = np.linalg.inv(arm.terms(q, np.zeros_like(q)).M)
    S = np.zeros_like(A)
    S[half:, half:] = inverse @ inverse.T
    return A, S


def agree(found, exact, rtol):
    """Each entry, beside the size that its row gives it, or both deviations: positions and velocities differ by far."""
    assert found.length == exact.length
    for name in ("Phi", "Gamma"):
        a, b = getattr(found, name), getattr(exact, name)
        left = np.abs(b).max(axis=1)
        assert_allclose(a / left[:, None], b / left[:, None], atol=rtol, rtol=0.0, err_msg=name)
    size = np.sqrt(np.outer(exact.Q.diagonal(), exact.Q.diagonal()))
    assert_allclose(found.Q / size, exact.Q / size, atol=rtol, rtol=0.0, err_msg="Q")


@pytest.mark.parametrize("name", ["R", "two_link", "long_reach", "R_lab"])
def test_any_period_is_as_the_matrix_exponential_has_it(name):
    A, S = linearised(name)
    sampling = Sampling(A, S)
    for length in (1e-6, 2.13e-4, 6e-4, 9.9e-4, 1.41e-3, 3.333e-3, 0.0207):
        agree(sampling.step(length), discretise(A, length, S), 1e-12)


@pytest.mark.parametrize("name", ["R", "long_reach"])
@pytest.mark.parametrize("length", [0.001, 0.002, 0.005, 0.01, 0.033])
def test_common_periods_are_doubled_from_a_short_one_with_the_error_of_rounding(name, length):
    A, S = linearised(name)
    sampling = Sampling(A, S)
    agree(sampling.step(length), discretise(A, length, S), 1e-12)
    assert sampling.step(length) is sampling.step(length)


def test_a_stiff_system_has_a_shorter_grid_and_the_same_error():
    rate = 2.0e5  # [1/s]
    A = np.array([[0.0, 1.0], [-(rate**2), -0.2 * rate]])
    S = np.diag([0.0, 1.0])
    sampling = Sampling(A, S)
    assert sampling.grid < 1e-5
    for length in (1e-7, 1.234e-5, 7.7e-4):
        agree(sampling.step(length), discretise(A, length, S), 1e-11)


def test_no_noise_and_no_period():
    step = Sampling(np.array([[-3.0]])).step(0.0)
    assert step.Q is None and step.Phi == 1.0 and step.Gamma == 0.0


def test_a_system_without_states_has_steps_too():
    """As a rigid arm's modes are."""
    none = np.zeros((0, 0))
    assert Sampling(none).step(0.0023).Phi.shape == (0, 0)
    assert Sampling(none, none).step(0.0023).Q.shape == (0, 0)
