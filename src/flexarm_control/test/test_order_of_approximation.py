# SPDX-License-Identifier: Apache-2.0
r"""(16): :math:`x = \bar x + O(\mu)`, :math:`z = \bar z + z_f + O(\mu)`, and what a better manifold makes of it.

The arm, stiffened step by step, under continuous control and on a smooth reference, beside what the slow subsystem
(10), the manifold and the boundary layer (11) say of it. The slow law places the poles of the tracking error, so that
:math:`\bar x` is known in closed form; the fast one's poles go as 1/mu, as the theory has them.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from flexarm_control.composite.design import design
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.models.model import build
from flexarm_dynamics.singular_perturbation import fast_subsystem

KP, KV = 6.25, 5.0
TIMES = np.linspace(0.0, 0.5, 41)
#: Tracking error at the start [rad], [rad/s].
ERROR = np.array([0.05, -0.1])


def reference(t):
    """Smooth to any order: 0.5 (1 - cos 2t) rad."""

    def near(offset):
        s = 2.0 * (t + offset)
        return np.array([[0.5 - 0.5 * np.cos(s)], [np.sin(s)], [2.0 * np.cos(s)]])

    position, velocity, acceleration = near(0.0)
    return SimpleNamespace(
        position=position, velocity=velocity, acceleration=acceleration, near=near
    )


def slow(t):
    """Joint position and velocity of the slow subsystem under its law: a double pole."""
    p = -KV / 2.0
    a, b = ERROR[0], ERROR[1] - p * ERROR[0]
    e, ed = (a + b * t) * np.exp(p * t), (b + p * (a + b * t)) * np.exp(p * t)
    r = reference(t)
    return np.array([r.position[0] - e, r.velocity[0] - ed])


def deviations(order, stiffness, straight=False):
    """Largest deviations of x from that of (10), and of z from the manifold and the boundary layer; and mu.

    x is the joint's position and velocity, z = (delta/mu^2, delta_d/mu), of order one both.
    """
    model = build(scaled(arm_file.load("one_link"), stiffness=stiffness, damping=0.0))
    control = design(
        model,
        {"type": "model_following", "kp": [KP], "kv": [KV]},
        {"type": "pole_placement", "damping": [0.3, 0.1]},
        {"type": "corrected", "order": order},
    )
    manifold, m = control.manifold, model.n_modes
    split = [1, 1 + m, 2 + m]

    def torque(t, state):
        q, delta, qd, delta_d = np.split(state, split)
        return control.step(q, qd, delta, delta_d, reference(t))

    start = np.insert(np.zeros(2 * m), [0, m], slow(0.0))
    torque(0.0, start)
    layer = -np.concatenate([manifold.amplitude, manifold.rate])  # z_f of the straight arm
    if not straight:
        start[1 : 1 + m], start[2 + m :] = manifold.amplitude, manifold.rate
        layer[:] = 0.0
    found = solve_ivp(
        lambda t, state: model.derivative(state, torque(t, state)),
        TIMES[[0, -1]], start, "DOP853", TIMES, rtol=1e-8, atol=1e-11,
    )  # fmt: skip
    terms = model.terms(np.zeros(1), np.zeros(1))
    A2, B2 = fast_subsystem(terms)
    gains = np.array([control.fast.torque(unit, np.zeros(1)).copy() for unit in np.eye(2 * m)]).T
    propagate = expm((A2 + B2 @ gains) * TIMES[1])  # (11) under (15)
    mu = 1.0 / np.sqrt(np.linalg.eigvalsh(terms.K2).min())
    unit = np.repeat([mu**2, mu], m)
    joints, bending = [], []
    for t, state in zip(TIMES, found.y.T, strict=True):
        q, delta, qd, delta_d = np.split(state, split)
        torque(t, state)
        joints.append(np.abs(np.concatenate([q, qd]) - slow(t)).max())
        z_bar = np.concatenate([manifold.amplitude, manifold.rate])
        z = np.concatenate([delta, delta_d])
        bending.append(np.abs((z - z_bar - layer) / unit).max())
        layer = propagate @ layer
    return max(joints), max(bending), mu


def powers(order, stiffnesses, straight=False):
    """Powers of mu with which both deviations go."""
    joints, bending, mu = np.array([deviations(order, k, straight) for k in stiffnesses]).T
    return [np.polyfit(np.log(mu), np.log(e), 1)[0] for e in (joints, bending)]


def test_from_the_straight_arm_both_deviations_are_of_the_first_order():
    assert powers(1, (16.0, 64.0), straight=True) == pytest.approx([1.0, 1.0], abs=0.15)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_on_a_manifold_of_order_k_both_are_of_order_k_plus_1(order):
    """Over EI x 1 ... 256 the powers are 1.03, 2.46, 3.09 for the joints, 1.02, 1.98, 3.09 for the bending."""
    joints, bending = powers(order, (4.0, 16.0))
    assert bending == pytest.approx(order + 1.0, abs=0.15)
    assert joints > order + 1.0 - 0.15
