# SPDX-License-Identifier: Apache-2.0
"""Fast laws: the Riccati equation (20), the paper's gains, what can't be designed."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import solve_continuous_are

from flexarm_control.composite.design import FAST, design_law
from flexarm_dynamics.arm.units import POUND_FORCE
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models.model import Terms
from flexarm_dynamics.singular_perturbation import fast_subsystem, frequencies_and_damping

# Q = diag(1, 1, 50, 30000), r = 1 in ft and lbf ft
PAPER = {
    "q": (POUND_FORCE**2 * np.array([1.0, 1.0, 50.0, 30000.0])).tolist(),
    "r": [1.0],
    "alpha": 5.0,
    "configuration": [np.pi / 2],
}


def lqr(model, **changed):
    return design_law(FAST, "lqr", model, PAPER | changed)


def closed_loop(law):
    return np.linalg.eigvals(law.A2 + law.B2 @ law.K_f)


def uncoupled_model(reached):
    """One joint and two modes of 3 and 7 rad/s; joint and mode are coupled where `reached`."""
    M = np.eye(3)
    M[0, 1:] = M[1:, 0] = 0.2 * np.array(reached)
    terms = Terms(
        M, np.zeros(1), np.zeros(2), np.zeros((1, 2)), np.zeros((2, 2)), np.zeros((1, 2)),
        np.diag([9.0, 49.0]),
    )  # fmt: skip
    return SimpleNamespace(
        n_joints=1, n_modes=2, mode_names=("slender_mode", "stiff_mode"), terms=lambda q, qd: terms
    )


# --------------------------------------------------------------------------- (20)


@pytest.mark.parametrize("alpha", [0.0, 5.0, 20.0])
def test_the_gain_solves_the_riccati_equation_20(arm_r, alpha):
    law = lqr(arm_r, alpha=alpha)
    A2, B2 = fast_subsystem(arm_r.terms(np.array([np.pi / 2]), np.zeros(1)))
    A, V, Q = A2 + alpha * np.eye(4), law.V, np.diag(PAPER["q"])
    terms = [V @ A, A.T @ V, -V @ B2 @ B2.T @ V, Q]
    assert np.linalg.norm(sum(terms)) < 1e-9 * max(map(np.linalg.norm, terms))
    assert np.linalg.eigvalsh(0.5 * (V + V.T)).min() > 0.0
    assert_allclose(law.K_f, -B2.T @ V, rtol=1e-12)


def test_the_gain_is_that_of_an_independent_riccati_solver(arm_p3):
    law = lqr(arm_p3, r=[3.0])
    A2, B2 = fast_subsystem(arm_p3.terms(np.array([np.pi / 2]), np.zeros(1)))
    V = solve_continuous_are(A2 + 5.0 * np.eye(4), B2, np.diag(PAPER["q"]), [[3.0]])
    assert_allclose(law.K_f, -B2.T @ V / 3.0, rtol=1e-8)


def test_p3_has_the_printed_gains_frequencies_and_damping_ratios(arm_p3):
    law = lqr(arm_p3)
    magnitudes = np.abs(law.K_f[0]) / POUND_FORCE
    assert_allclose(magnitudes, [75.505, 6376.58, 17.072, 173.098], rtol=2e-4)
    assert_allclose(magnitudes, [75.50, 6375.64, 17.07, 173.10], rtol=2e-4)  # print
    omega, zeta = frequencies_and_damping(closed_loop(law))
    assert_allclose(omega, [18.592, 94.098], rtol=3e-4)
    assert_allclose(omega, [18.59, 94.10], rtol=3e-4)  # print
    assert_allclose(zeta, [0.7659, 0.7529], rtol=3e-4)
    assert_allclose(zeta, [0.766, 0.753], rtol=3e-4)  # print


def test_r_has_the_gains_frequencies_and_damping_ratios_of_the_errata(arm_r):
    law = lqr(arm_r)
    # u_f = -k z_f with k all negative for tip shapes (+, -)
    wanted = np.array([127.04, 7283.8, 16.998, 183.31])  # [lbf], [lbf s]
    assert_allclose(law.K_f[0] / POUND_FORCE, wanted, rtol=1e-4)
    assert_allclose(law.K_f[0], wanted * POUND_FORCE, rtol=1e-4)
    omega, zeta = frequencies_and_damping(closed_loop(law))
    assert_allclose(omega, [18.578, 90.402], rtol=3e-5)
    assert_allclose(zeta, [0.7755, 0.4052], rtol=1.3e-4)


@pytest.mark.parametrize("alpha", [0.0, 1.0, 5.0, 30.0])
def test_every_closed_pole_lies_left_of_minus_alpha(arm_r, arm_p3, heavy_arm, alpha):
    for model in (arm_r, arm_p3, heavy_arm):
        assert closed_loop(lqr(model, alpha=alpha)).real.max() < -alpha


def test_scaling_q_and_r_together_leaves_the_gain(arm_r):
    scaled = lqr(arm_r, q=(1e3 * np.array(PAPER["q"])).tolist(), r=[1e3])
    assert_allclose(scaled.K_f, lqr(arm_r).K_f, rtol=1e-8)


def test_dearer_torque_lowers_the_gain(arm_r):
    assert np.abs(lqr(arm_r, r=[100.0]).K_f[0, 2:]).max() < np.abs(lqr(arm_r).K_f[0, 2:]).max()


def test_the_design_is_made_at_the_given_configuration(heavy_arm):
    for angle in (0.0, 1.2):
        A2, B2 = fast_subsystem(heavy_arm.terms(np.array([angle]), np.zeros(1)))
        V = solve_continuous_are(A2 + 5.0 * np.eye(4), B2, np.diag(PAPER["q"]), [[1.0]])
        assert_allclose(lqr(heavy_arm, configuration=[angle]).K_f, -B2.T @ V, rtol=1e-8)
    low, high = (lqr(heavy_arm, configuration=[a]).K_f for a in (-np.pi / 2, np.pi / 2))
    assert not np.allclose(low, high, rtol=1e-4)


# --------------------------------------------------------------------------- the torque


def test_u_f_is_exactly_zero_on_the_manifold_and_linear_beside_it(arm_r):
    law = lqr(arm_r)
    assert_array_equal(law.torque(np.zeros(4), np.zeros(1)), [0.0])
    z_f = np.array([1e-3, -2e-4, 0.02, 0.01])
    assert_allclose(law.torque(z_f, np.zeros(1)), [law.K_f[0] @ z_f], rtol=1e-14)
    assert_allclose(
        law.torque(-2.0 * z_f, np.zeros(1)), -2.0 * law.torque(z_f, np.zeros(1)), rtol=1e-14
    )


def test_no_fast_law_gives_no_torque_and_a_zero_gain(arm_r):
    law = design_law(FAST, "none", arm_r, {})
    assert_array_equal(law.torque(np.ones(4), np.zeros(1)), [0.0])
    assert_array_equal(law.K_f, np.zeros((1, 4)))


# --------------------------------------------------------------------------- no design


@pytest.mark.parametrize(
    ("reached", "lost"), [((1.0, 0.0), "stiff_mode"), ((0.0, 1.0), "slender_mode")]
)
def test_a_mode_that_no_torque_reaches_is_named(reached, lost):
    with pytest.raises(DesignError, match=rf"fast\.alpha.*can't reach {lost}") as error:
        lqr(uncoupled_model(reached))
    (kept,) = {"stiff_mode", "slender_mode"} - {lost}
    assert kept not in str(error.value)


def test_the_same_arm_is_designed_once_torque_reaches_both_modes():
    assert closed_loop(lqr(uncoupled_model((1.0, 1.0)))).real.max() < -5.0


def test_nothing_to_minimise_and_no_prescribed_decay_has_no_design(arm_r):
    with pytest.raises(DesignError, match=r"slowest pole.*not left of -alpha.*raise fast\.q"):
        lqr(arm_r, q=[0.0], alpha=0.0)
