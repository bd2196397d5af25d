# SPDX-License-Identifier: Apache-2.0
"""Brakes: sticking, slipping, stopping, energy."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.models import model
from flexarm_sim.brakes import pivot
from flexarm_sim.plant import Plant


def braked(name, torques=None, **changed):
    """Model of a shipped arm with brakes of given torques [N m]; None: no brake on that joint."""
    arm = arm_file.load(name)
    torques = [j.brake_torque for j in arm.joints] if torques is None else torques
    joints = [
        replace(j, safe_action="zero" if t is None else "brake", brake_torque=t)
        for j, t in zip(arm.joints, torques, strict=True)
    ]
    return model.build(replace(arm, joints=tuple(joints), **changed))


def run(plant, count):
    """Positions, rates and energies of `count` periods under the safe action."""
    rows, energies = [], [plant.model.energy(plant.state)]
    for _ in range(count):
        plant.advance_safely()
        rows.append(np.stack([plant.q, plant.qd]))
        energies.append(plant.model.energy(plant.state))
    q, qd = np.stack(rows, axis=1)
    return q, qd, np.array(energies)


# --------------------------------------------------------------------------- one joint, in closed form


@pytest.mark.parametrize("rate", [1000.0, 37.0])
@pytest.mark.parametrize("integrator", ["dop853", "rk4", "implicit"])
def test_a_rigid_arm_stops_when_and_where_a_constant_brake_torque_stops_it(rate, integrator):
    arm = arm_file.load("rigid")
    one = replace(arm, joints=arm.joints[:1], links=arm.links[:1], gravity=(0.0, 0.0, 0.0))
    one = replace(one, joints=(replace(one.joints[0], brake_torque=0.3),))
    plant = Plant(model.build(one), 1.0 / rate, integrator)
    inertia = plant.model.mass_matrix(np.zeros(1))[0, 0]
    plant.qd[:] = -2.0
    stops = 2.0 * inertia / 0.3
    q, qd, _ = run(plant, 2 + int(2.0 * stops * rate))
    t = np.arange(1, q.size + 1) / rate
    moving = t < stops
    assert moving.sum() > 5 and (~moving).sum() > 5
    assert_allclose(qd[moving, 0], -2.0 + 0.3 / inertia * t[moving], atol=1e-12)
    assert_allclose(q[~moving, 0], -(2.0**2) * inertia / (2.0 * 0.3), atol=1e-9)
    assert_array_equal(qd[~moving], 0.0)
    assert np.ptp(q[~moving]) == 0.0


def test_a_brake_lets_go_above_its_torque_and_gives_that_torque():
    for torque, holds in ((1.01, True), (0.99, False)):
        arm = arm_file.load("rigid")
        one = replace(arm, joints=arm.joints[:1], links=arm.links[:1])
        built = model.build(one)
        weight = built.forces(np.zeros(1), np.zeros(1))[0]
        joint = replace(one.joints[0], brake_torque=torque * weight)
        plant = Plant(model.build(replace(one, joints=(joint,))), 1e-3)
        q, qd, energies = run(plant, 100)
        if holds:
            assert_array_equal(q, 0.0)
            continue
        inertia = built.mass_matrix(np.zeros(1))[0, 0]
        assert_allclose(qd[0, 0], -0.01 * weight / inertia * 1e-3, rtol=1e-6)
        # what the brake takes is its torque times the way
        assert_allclose(energies[-1] - energies[0], -torque * weight * -q[-1, 0], rtol=1e-9)


@pytest.mark.parametrize("name", ["R", "P3", "one_link"])
def test_a_locked_flexible_joint_leaves_the_beam_its_clamped_motion(name):
    arm = braked(name, [1e3])
    plant = Plant(arm, 1e-3)
    plant.reset([0.3])
    plant.delta[0] = 0.01
    q, qd, energies = run(plant, 500)
    assert_array_equal(q, 0.3)
    assert_array_equal(qd, 0.0)
    # the modes swing as the clamped ones do
    terms = arm.terms(plant.q, plant.qd)
    a, b = terms.M[1:, 1:], arm.stiffness_matrix()
    damped = terms.C2
    m = arm.n_modes
    zero = np.zeros((m, m))
    A = np.block([[zero, np.eye(m)], [-np.linalg.solve(a, b), -np.linalg.solve(a, damped)]])
    w, v = np.linalg.eig(A)
    start = np.concatenate([[0.01], np.zeros(2 * m - 1)])
    exact = ((v * np.exp(0.5 * w)) @ np.linalg.solve(v, start)).real
    assert_allclose(plant.delta, exact[:m], atol=2e-5 if name == "P3" else 2e-6)
    assert np.diff(energies).max() <= 1e-12


# --------------------------------------------------------------------------- several joints


@pytest.mark.parametrize("integrator", ["dop853", "implicit"])
def test_brakes_hold_a_heavy_arm_from_rest_for_ever(integrator):
    arm = braked("long_reach")
    plant = Plant(arm, 2e-3, integrator)
    plant.reset([0.1, 0.2, 0.3, -0.2])
    start = plant.state.copy()
    run(plant, 200)
    assert_array_equal(plant.q, start[:4])
    assert_allclose(plant.delta, start[4:14], atol=1e-9)


@pytest.mark.parametrize("name", ["rigid", "long_reach"])
def test_under_brakes_energy_never_rises_and_all_come_to_rest(name):
    arm = braked(name)
    plant = Plant(arm, 2e-3)
    plant.reset(0.2 * np.arange(1, 1 + arm.n_joints))
    plant.qd[:] = np.array([0.7, -0.4, 0.9, -2.0])[: arm.n_joints]
    _, qd, energies = run(plant, 300)
    assert np.diff(energies).max() <= 1e-9 * np.abs(energies).max()
    assert energies[-1] < energies[0] - 0.01
    assert_array_equal(qd[-1], 0.0)


def test_each_joint_sticks_on_its_own():
    arm = braked("rigid", [30.0, 0.2])  # the elbow's load takes more than that
    plant = Plant(arm, 1e-3)
    q, _, _ = run(plant, 200)
    assert_array_equal(q[:, 0], 0.0)
    assert q[-1, 1] < -0.01
    # and a joint without a brake swings while the other is held
    plant = Plant(braked("rigid", [30.0, None]), 1e-3)
    q, _, energies = run(plant, 500)
    assert_array_equal(q[:, 0], 0.0)
    assert q[-1, 1] < -0.5
    assert_allclose(energies, energies[0], atol=1e-8)


def test_a_joint_that_is_shaken_by_the_other_slips_and_sticks_again():
    arm = braked("rigid", [30.0, 1.2])  # just above the elbow's load at rest
    plant = Plant(arm, 1e-3)
    plant.qd[0] = 3.0
    q, qd, energies = run(plant, 300)
    assert np.abs(q[-1, 1]) > 1e-3
    assert_array_equal(qd[-1], 0.0)
    assert np.diff(energies).max() <= 1e-12 * np.abs(energies).max()


def test_joint_friction_helps_a_brake_to_stop_and_not_to_hold():
    arm = arm_file.load("rigid")
    stops = []
    for viscous in (0.0, 2.0):
        joint = replace(arm.joints[0], brake_torque=0.3, friction=Friction(viscous, 0.0, 0.01))
        one = replace(arm, joints=(joint,), links=arm.links[:1], gravity=(0.0, 0.0, 0.0))
        plant = Plant(model.build(one), 1e-3)
        plant.qd[:] = 1.0
        stops.append(run(plant, 1000)[0][-1, 0])
    assert 0.0 < stops[1] < 0.5 * stops[0]


def test_a_joint_that_is_damped_hard_shakes_a_weak_brake_loose():
    """Stretched out, nothing but the first joint's stopping moves the second."""
    arm = replace(arm_file.load("rigid"), gravity=(0.0, 0.0, 0.0))
    first, *rest = arm.joints
    joints = (replace(first, safe_action="damp", damp_coefficient=50.0), *rest)
    for torque, slips in ((1e-3, True), (1e3, False)):
        weak = replace(joints[1], safe_action="brake", brake_torque=torque)
        plant = Plant(model.build(replace(arm, joints=(joints[0], weak, *joints[2:]))), 1e-3)
        plant.qd[0] = 1.0
        _, qd, energy = run(plant, 5)
        assert (qd[-1, 1] != 0.0) == slips
        assert np.diff(energy).max() <= 0.0


def test_shares_of_brakes_are_the_least_constraint():
    random = np.random.default_rng(5)
    for _ in range(200):
        n = random.integers(1, 7)
        root = random.normal(size=(n, n))
        H, torque = root @ root.T + 1e-3 * np.eye(n), 10.0 ** random.uniform(-1, 2, n)
        a = random.normal(size=n) * 10.0 ** random.uniform(0, 3)
        share, slips = pivot(a, H * torque)
        acceleration = a + H @ (torque * share)
        assert np.abs(share).max() <= 1.0 + 1e-9
        sticks = slips == 0
        scale = np.abs(a).max()
        assert_allclose(acceleration[sticks], 0.0, atol=1e-7 * scale)
        assert_array_equal(share[~sticks], -slips[~sticks])
        assert (acceleration * slips)[~sticks].min(initial=0.0) >= -1e-9 * scale
