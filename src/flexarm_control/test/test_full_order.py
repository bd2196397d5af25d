# SPDX-License-Identifier: Apache-2.0
"""The sampled full-order closed loop: against the closed form of the continuous one, and against the loop that runs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from flexarm_control.composite import full_order
from flexarm_control.composite.design import design
from flexarm_dynamics import linear
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.singular_perturbation import full_order_matrix

SLOW = {"type": "linear_model_following"}
#: Q = diag(1, 1, 50, 30000), r = 1 in ft and lbf ft, in SI.
PAPER = {"type": "lqr", "q": [19.78667553847073] * 2 + [989.3337769235364, 593600.2661541218]}


@pytest.mark.parametrize("name", ["R", "one_link", "two_link", "long_reach"])
def test_the_linear_plant_is_the_arms_own_motion(arms, name):
    """A small step of torque, simulated with the full equations, against the exact transition."""
    model = arms[name]
    n, m = model.n_joints, model.n_modes
    q = 0.2 + 0.1 * np.arange(n)
    _, Gamma = linear.sampled(*linear.linear_plant(model, q), 1e-3)
    rest = np.concatenate([q, model.static_deflection(q), np.zeros(n + m)])
    hold, push = linear.static_torque(model, q), 1e-4 * np.ones(n)
    end = solve_ivp(
        lambda t, s: model.derivative(s, hold + push), (0, 1e-3), rest, rtol=1e-9, atol=1e-15,
        method="DOP853",
    ).y[:, -1]  # fmt: skip
    expected = Gamma @ push
    assert_allclose(end - rest, expected, atol=1e-5 * np.abs(expected).max())


def test_fast_sampling_gives_the_continuous_poles_of_the_papers_design(arm_r):
    law = design(arm_r, SLOW, PAPER)
    terms = arm_r.terms(np.zeros(1), np.zeros(1))
    A = full_order_matrix(terms, [6.25], [5.0], law.slow.B_inverse(terms), law.fast.K_f)
    expected = np.sort_complex(np.linalg.eigvals(A))
    found = np.sort_complex(full_order.poles(law, np.zeros(1), 1e-5))
    assert_allclose(found, expected, rtol=2e-3)


def test_errata_poles(arm_r):
    """Poles of R, m11, composite: with the paper's manifold, and with the reference's."""
    for manifold, wanted in (
        ("quasi_steady", [-1.773, -3.945 + 4.941j, -3.945 - 4.941j, -34.51, -34.49 + 77.57j, -34.49 - 77.57j]),
        ("reference", [-1.532 + 1.509j, -1.532 - 1.509j, -12.49, -20.78, -35.77 + 79.95j, -35.77 - 79.95j]),
    ):  # fmt: skip
        law = design(arm_r, SLOW, PAPER, {"type": manifold})
        found = np.sort_complex(full_order.poles(law, np.zeros(1), 1e-5))
        assert_allclose(found, np.sort_complex(wanted), rtol=2e-3)


def test_the_corrected_manifold_keeps_the_slow_double_pole(arm_r):
    """The mean of the two slow poles is where they were placed, the better the higher the order."""
    off = []
    for order in (0, 2, 4):
        law = design(arm_r, SLOW, {"type": "lqr"}, {"type": "corrected", "order": order})
        slow = full_order.poles(law, np.zeros(1), 1e-4)[:2]
        off.append(abs(np.prod(slow) - 6.25))
    assert off[2] < off[1] < off[0]
    assert off[1] < 0.5


@pytest.mark.parametrize("delay", [0.0, 1e-3, 2.5e-3])
def test_delays_are_those_of_the_loop_that_runs(arm_r, delay):
    """The slowest decay of a linear loop simulated step by step with a queue of torques."""
    law = design(arm_r, SLOW, PAPER)
    F = full_order.closed_loop(law, np.zeros(1), 1e-3, delay)
    A, B = linear.linear_plant(arm_r, np.zeros(1))
    U, Z = full_order.linear_law(law, np.zeros(1))
    K = U + law.fast.K_f @ Z
    whole = int(delay / 1e-3 + 1e-9)
    part = delay - whole * 1e-3
    state = np.array([0.01, 1e-3, 0.0, 0.0, 0.0, 0.0])
    way = [np.zeros(1)] * (whole + 2)
    start = np.concatenate([state, np.zeros(F.shape[0] - 6)])
    for _ in range(50):
        way.append(K @ state)
        older, newer = way[-2 - whole], way[-1 - whole]
        if part > 1e-9:
            Phi, Gamma = linear.sampled(A, B, part)
            state = Phi @ state + Gamma @ older
        state = expm(A * (1e-3 - part)) @ state + linear.sampled(A, B, 1e-3 - part)[1] @ newer
        start = F @ start
    assert_allclose(start[:6], state, rtol=1e-9, atol=1e-15)


def test_an_unstable_design_is_refused_naming_its_pole(two_link):
    with pytest.raises(DesignError, match="is not left of -stability_margin") as refused:
        design(two_link, SLOW, {"type": "lqr"}, {"type": "corrected"}, {})
    assert refused.value.value.real > refused.value.limit == 0.0


def test_a_margin_that_is_not_kept_is_refused(arm_r):
    design(arm_r, SLOW, {"type": "lqr"}, {"type": "corrected"}, {"stability_margin": 2.0})
    with pytest.raises(DesignError) as refused:
        design(arm_r, SLOW, {"type": "lqr"}, {"type": "corrected"}, {"stability_margin": 3.0})
    assert refused.value.value.real == pytest.approx(-2.4, abs=0.1)
    assert refused.value.limit == -3.0


def test_without_a_slow_law_the_joints_drift_and_nothing_is_asked(arm_r):
    law = design(arm_r, {"type": "none"}, {"type": "lqr"}, {"type": "corrected"}, {})
    assert law.feedforward is None
