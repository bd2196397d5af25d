# SPDX-License-Identifier: Apache-2.0
"""Slow manifolds: the paper's, the reference's, and the corrected one beside a slow manifold found numerically."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp
from scipy.linalg import schur

from flexarm_control.component import at_rest
from flexarm_control.composite.design import MANIFOLD, design, design_law
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.models.model import build
from flexarm_dynamics.singular_perturbation import quasi_steady_state, slow_subsystem

SLOW = {"type": "model_following", "kp": [6.25], "kv": [5.0]}
NONE = {"type": "none"}


class Sine:
    """A smooth reference: every joint swings, all derivatives known."""

    def __init__(self, n, rate=1.7):
        self.rate, self.size = rate, 0.4 * (1.0 + np.arange(n))
        self.offset = 0.3 * np.arange(n)

    def at(self, t):
        self.t = t
        self.position, self.velocity, self.acceleration = self.near(0.0)
        return self

    def near(self, offset):
        phase = self.rate * (self.t + offset) + self.offset
        r, a = self.rate, self.size
        return np.array([a * np.sin(phase), a * r * np.cos(phase), -a * r * r * np.sin(phase)])


@pytest.fixture(params=["R", "one_link", "two_link", "long_reach"])
def arm(request, arms):
    return arms[request.param]


def manifold(model, kind, slow=SLOW, **values):
    law = design(model, slow, NONE).slow
    return design_law(MANIFOLD, kind, model, values, law)


def updated(surface, q, qd, reference):
    model = surface.model
    terms = model.terms(q, qd)
    torque = surface.slow.torque(q, qd, reference, terms)
    surface.update(q, qd, reference, terms, torque)
    return terms, torque


# --------------------------------------------------------------------------- orders by hand


def test_order_0_is_the_papers_quasi_steady_state(arm):
    reference = Sine(arm.n_joints).at(0.4)
    q, qd = reference.position + 0.05, reference.velocity - 0.1
    surface = manifold(arm, "corrected", order=0)
    terms, torque = updated(surface, q, qd, reference)
    scale = np.abs(surface.amplitude).max()
    assert_allclose(surface.amplitude, quasi_steady_state(terms, torque), atol=1e-9 * scale)
    assert_array_equal(surface.rate, np.zeros(arm.n_modes))
    assert_allclose(surface.feedforward, np.zeros(arm.n_joints), atol=1e-12)


@pytest.mark.parametrize("error", [0.0, 0.2])
def test_the_rates_are_those_of_the_deflections_along_the_slow_motion(arm, error):
    """Order 1: d/dt of order 0, against a difference over a tenth of the manifold's own step.

    From an error e0 at rest the slow law makes e = e0 (1 + 2.5 t) exp(-2.5 t).
    """
    reference, h = Sine(arm.n_joints), 1e-4
    surface, zeroth = manifold(arm, "corrected", order=1), manifold(arm, "corrected", order=0)

    def state(t):
        r, decay = reference.at(0.4 + t), error * np.exp(-2.5 * t)
        return r.position - (1.0 + 2.5 * t) * decay, r.velocity + 6.25 * t * decay, r

    ends = []
    for t in (-h, h):
        updated(zeroth, *state(t))
        ends.append(zeroth.amplitude.copy())
    updated(surface, *state(0.0))
    expected = (ends[1] - ends[0]) / (2.0 * h)
    assert_allclose(surface.rate, expected, atol=2e-5 * np.abs(expected).max())


def test_at_rest_every_manifold_is_the_static_deflection(arm):
    q = 0.3 + 0.1 * np.arange(arm.n_joints)
    terms = arm.terms(q, np.zeros(arm.n_joints))
    static = -np.linalg.solve(terms.K2, terms.f2)
    scale = max(np.abs(static).max(), 1e-6)
    for kind, values in (("quasi_steady", {}), ("reference", {}), ("corrected", {"order": 4})):
        surface = manifold(arm, kind, **values)
        updated(surface, q, np.zeros(arm.n_joints), at_rest(q))
        assert_allclose(surface.amplitude, static, atol=1e-5 * scale)
        assert_allclose(surface.rate, np.zeros(arm.n_modes), atol=1e-6 * scale)


def test_along_the_reference_is_the_manifold_without_a_tracking_error(arm):
    reference = Sine(arm.n_joints).at(0.9)
    surface = manifold(arm, "corrected", order=2)
    _, torque = updated(surface, reference.position, reference.velocity, reference)
    delta, rate, whole = surface.along(reference)
    assert_allclose(delta, surface.amplitude, atol=1e-8 * np.abs(delta).max())
    assert_allclose(rate, surface.rate, atol=1e-5 * np.abs(rate).max())
    assert_allclose(whole, torque + surface.feedforward, rtol=1e-6)


def test_a_tracking_error_does_not_move_the_manifold_of_the_reference(arm):
    reference = Sine(arm.n_joints).at(0.9)
    surface = manifold(arm, "reference")
    delta, rate, whole = surface.along(reference)
    for off in (0.0, 0.2):
        updated(surface, reference.position + off, reference.velocity - off, reference)
        assert_array_equal(surface.amplitude, delta)
        assert_array_equal(surface.rate, rate)
        # Beyond it the slow law's torque on the reference: inverse dynamics of the quasi-steady arm.
        a, B = slow_subsystem(arm.terms(reference.position, reference.velocity))
        slow = np.linalg.solve(B, reference.acceleration - a)
        assert_allclose(surface.feedforward, whole - slow, atol=1e-6 * np.abs(whole).max())
    assert np.abs(rate).max() > 0.0


# --------------------------------------------------------------------------- invariance


def slow_eigenspace(order, stiffness):
    """Distance of L of the corrected manifold from the invariant subspace of the slow poles, and mu."""
    model = softened(stiffness)
    surface = manifold(model, "corrected", order=order)
    L, U = surface.error_response(np.zeros(1))
    n, m = 1, model.n_modes
    terms = model.terms(np.zeros(1), np.zeros(1))
    _, B = slow_subsystem(terms)
    H, K, C = terms.H, terms.K2, terms.C2
    size = n + m
    # The arm under the slow law and the manifold's feed-forward: u = -B^-1 (kp q + kv qd) + U x.
    u = np.zeros((1, 2 * size))
    gain = -np.linalg.inv(B) @ np.array([[6.25, 5.0]]) + U
    u[0, [0, size]] = gain[0]
    A = np.zeros((2 * size, 2 * size))
    A[:size, size:] = np.eye(size)
    A[size:] = H[:, :1] @ u
    A[size:, n:size] -= H[:, n:] @ K
    A[size:, size + n :] -= H[:, n:] @ C
    _, Z, count = schur(A, output="real", sort=lambda re, im: np.hypot(re, im) < 5.0)
    assert count == 2
    slow = Z[:, :2]
    x = np.r_[slow[0:1], slow[size : size + 1]]
    z = np.r_[slow[n:size], slow[size + n :]]
    exact = z @ np.linalg.inv(x)
    return np.abs(L - exact).max(axis=1), 2.5 / np.sqrt(np.linalg.eigvals(H[n:, n:] @ K).real.min())


def softened(stiffness):
    """Arm one_link with its bending stiffness scaled."""
    return build(scaled(arm_file.load("one_link"), stiffness=stiffness, damping=0.0))


@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_invariant_to_its_order(order):
    """Over EI x 1 ... 256, z on the manifold is off by mu^(order + 1) and more of its own size."""
    errors, mus = [], []
    # Beyond this the central differences' own error is larger than what orders 3 and 4 leave.
    for stiffness in (4.0, 16.0, 64.0) if order < 3 else (1.0, 4.0):
        distance, mu = slow_eigenspace(order, stiffness)
        # In units in which z is of order one: deflections go as mu^2.
        errors.append(max(distance) / mu**2)
        mus.append(mu)
    slope = np.polyfit(np.log(mus), np.log(errors), 1)[0]
    wanted = {0: 0.0, 1: 2.0, 2: 2.0, 3: 4.0, 4: 4.0}[order]
    assert slope > wanted - 0.35


def test_joints_follow_the_reference_on_the_manifold():
    """From the manifold of the reference, under its torque alone, the arm stays on it: nothing vibrates."""
    model = softened(64.0)
    reference = Sine(1)
    surface = manifold(model, "corrected", order=4)

    def derivative(t, s):
        return model.derivative(s, surface.along(reference.at(t))[2])

    r = reference.at(0.0)
    delta, rate, _ = surface.along(r)
    start = np.concatenate([r.position, delta, r.velocity, rate])
    end = solve_ivp(derivative, (0.0, 0.5), start, rtol=1e-9, atol=1e-12).y[:, -1]
    r = reference.at(0.5)
    delta, rate, _ = surface.along(r)
    assert abs(end[0] - r.position[0]) < 2e-5
    assert_allclose(end[1:3], delta, atol=2e-3 * np.abs(delta).max())


# --------------------------------------------------------------------------- by name


@pytest.mark.parametrize(
    ("order", "problem"), [(7, r"is above its upper limit \(6\)"), (2.0, "is not an integer")]
)
def test_orders_out_of_range_are_refused(arm_r, order, problem):
    with pytest.raises(ParameterError, match=rf"manifold\.order: {order} {problem}"):
        manifold(arm_r, "corrected", order=order)


@pytest.mark.parametrize("error", [0.0, 0.2])
def test_a_law_of_another_kind_has_a_corrected_manifold_too(arm, error):
    """Without linear error dynamics the law adds to the reference's acceleration what it adds now."""
    surface = manifold(arm, "corrected", {"type": "computed_torque", "ki": [1.0]}, order=1)
    assert surface.slow.error_gains() is None
    reference, n, h = Sine(arm.n_joints).at(0.2), arm.n_joints, 1e-4
    q, qd = reference.position - error, reference.velocity - 0.5 * error
    terms, torque = updated(surface, q, qd, reference)
    a, B = slow_subsystem(terms)
    extra = a + B @ torque - reference.acceleration

    def deflection(t):
        position, velocity, acceleration = reference.near(t)
        position += t * (0.5 * t * extra - 0.5 * error) - error
        there = arm.terms(position, velocity + t * extra - 0.5 * error)
        return -np.linalg.solve(there.K2, there.M[n:, :n] @ (acceleration + extra) + there.f2)

    assert_allclose(surface.amplitude, deflection(0.0), atol=1e-9 * np.abs(deflection(0.0)).max())
    expected = (deflection(h) - deflection(-h)) / (2.0 * h)
    assert_allclose(surface.rate, expected, atol=2e-5 * np.abs(expected).max())
