# SPDX-License-Identifier: Apache-2.0
"""Motor housings: an inertia about all three axes that hangs on the link before the joint."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_dynamics.arm.description import Arm, Flexibility, Joint, Link, Payload
from flexarm_dynamics.models.chain import Chain
from flexarm_dynamics.models.fixed_step import METHODS

HOUSING = ((0.03, 0.002, -0.004), (0.002, 0.05, 0.001), (-0.004, 0.001, 0.02))
NONE = ((0.0,) * 3,) * 3


def spatial(housing=HOUSING):
    """Two flexible links about askew axes; the second joint's motor has a housing."""
    joints = (
        Joint("joint1", (0.6, 0.8, 0.0), (0.1, 0.0, 0.05), (0.2, -0.4, 0.3), hub_inertia=0.05),
        Joint(
            "joint2", (0.0, -0.6, 0.8), (0.03, 0.02, 0.0), (0.5, 0.3, -0.6), hub_inertia=0.04,
            motor_mass=0.5, housing_inertia=housing, rotor_inertia=1e-4, gear_ratio=20.0,
        ),
    )  # fmt: skip
    stiffness = {"y": 5.0, "z": 7.0, "twist": 3.0}
    flexible = {d: Flexibility(1, "clamped_free") for d in stiffness}
    links = tuple(Link(f"link{i}", 0.6, 0.5, stiffness, flexible, 2e-3) for i in (1, 2))
    return Arm("spatial", joints, links, Payload(0.2), gravity=(1.0, -2.0, -9.0))


def moving(chain):
    """A state, and its parts."""
    rng = np.random.default_rng(4)
    n, m = chain.n_joints, chain.n_modes
    state = np.concatenate(
        [rng.uniform(-1, 1, n), rng.uniform(-0.03, 0.03, m), rng.uniform(-1, 1, n + m)]
    )
    return state, *np.split(state, [n, n + m, 2 * n + m])


def test_it_has_the_energy_and_the_momentum_of_a_body_on_the_link_before():
    chain, bare = Chain(spatial()), Chain(spatial(NONE))
    _, q, delta, qd, delta_d = moving(chain)
    turning = chain.velocity("link1", 0.6, q, qd, delta, delta_d)[3:]
    # The tip's frame: what turns link 2's frame, but its joint's turn.
    unturned = chain.frames(np.array([q[0], 0.0]), delta)[0][1]
    tensor = unturned @ np.array(HOUSING) @ unturned.T
    more = chain.kinetic_energy(q, qd, delta, delta_d) - bare.kinetic_energy(q, qd, delta, delta_d)
    assert more == pytest.approx(0.5 * turning @ tensor @ turning, rel=1e-10)
    (linear, angular), (bare_linear, bare_angular) = (
        c.momentum(q, qd, delta, delta_d) for c in (chain, bare)
    )
    assert_allclose(linear, bare_linear, atol=1e-14)
    assert_allclose(angular - bare_angular, tensor @ turning, atol=1e-12)


def test_accelerations_are_those_of_the_mass_matrix_and_power_balances():
    chain = Chain(spatial())
    state, q, delta, qd, delta_d = moving(chain)
    torque, n = np.array([1.0, -0.5]), 2
    rate = chain.derivative(state, torque)
    force = -chain.forces(q, qd, delta, delta_d)
    force[:n] += torque
    expected = np.linalg.solve(chain.mass_matrix(q, delta), force)
    assert_allclose(rate[n + chain.n_modes :], expected, rtol=1e-9)
    step = 1e-6
    power = (chain.energy(state + step * rate) - chain.energy(state - step * rate)) / (2.0 * step)
    assert power == pytest.approx(torque @ qd, rel=1e-6)
    stepped = [state.copy(), state.copy()]
    for s, straight in zip(stepped, (True, False), strict=True):
        chain.stepper(METHODS["rk4"], straight_line=straight)(s, torque, 1e-4, 20)
    assert_allclose(stepped[0], stepped[1], rtol=1e-9, atol=1e-12)


def test_the_first_joint_s_housing_stands_on_the_base():
    arm = spatial(NONE)
    joints = (replace(arm.joints[0], housing_inertia=HOUSING), arm.joints[1])
    chain, bare = Chain(replace(arm, joints=joints)), Chain(arm)
    _, q, delta, _, _ = moving(chain)
    assert not chain.kernel.JOINT_PARTS
    assert np.array_equal(chain.mass_matrix(q, delta), bare.mass_matrix(q, delta))
