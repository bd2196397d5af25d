# SPDX-License-Identifier: Apache-2.0
"""The safe action `damp`: its torque, its soft start, the strain and the way that these cost."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.models import model
from flexarm_dynamics.singular_perturbation import slow_torque
from flexarm_sim.damping import FRACTION, MAX_TIME, OF_RANGE, WAY, Damping
from flexarm_sim.plant import Plant


def built(name="R", **joint):
    """Model of a shipped arm whose joints `damp`, with changes to each."""
    arm, changes = arm_file.load(name), {"safe_action": "damp", **joint}
    return model.build(replace(arm, joints=tuple(replace(j, **changes) for j in arm.joints)))


def coasting(arm, speed, seconds=1.5):
    """Plant at 1 kHz, and its largest strain from `speed` [rad/s] on under the safe action."""
    plant, rows, strain = Plant(arm, 1e-3), gauge_rows(arm, arm.arm.gauges), 0.0
    plant.qd[:] = speed
    for _ in range(round(1000 * seconds)):
        plant.advance_safely()
        strain = max(strain, np.abs(rows @ plant.delta).max(initial=0.0))
    return plant, strain


SLOW, FAST, LONG = 0.0, np.inf, np.inf  # [rad/s], [s]

# --------------------------------------------------------------------------- the numbers


def test_the_torque_stops_the_joint_on_its_way_between_a_fraction_of_the_limit_and_the_limit():
    arm = built()
    damping, limit = Damping(arm), arm.arm.torque_limits
    inertia = arm.terms(np.zeros(1), np.zeros(1)).M[0, 0]
    assert_allclose(damping.torque(LONG, SLOW), FRACTION * limit)
    assert_allclose(damping.torque(LONG, 1.5), inertia * 1.5**2 / (2.0 * WAY))
    assert_allclose(damping.torque(LONG, FAST), limit)
    assert not damping.coefficient.any()


def test_the_torque_grows_from_nothing_within_half_a_period_of_the_lowest_mode_or_a_quarter_second():
    arm = built()
    damping, half = Damping(arm), np.pi / arm.frequencies(locked=True)[0]
    assert_allclose(damping.time, half)
    assert damping.torque(0.0, FAST) == 0.0
    assert_allclose(damping.torque(0.3 * half, FAST), 0.3 * damping.torque(LONG, FAST))
    assert_allclose(Damping(built("two_link", damp_time=None)).time, MAX_TIME)


def test_the_files_numbers_replace_them_but_for_the_torque_limit():
    damping = Damping(built(damp_torque=1.5, damp_time=0.1))
    assert damping.torque(LONG, SLOW) == damping.torque(LONG, FAST) == 1.5
    assert damping.time[0] == 0.1
    assert_allclose(Damping(built(damp_torque=50.0)).torque(LONG, SLOW), built().arm.torque_limits)
    damping = Damping(built(damp_coefficient=3.0, damp_torque=1.5, damp_time=0.1))
    assert (damping.viscous(0.05), damping.viscous(LONG)) == (1.5, 3.0)
    assert damping.torque(LONG, FAST) == 0.0


def test_gauges_of_a_small_range_bound_the_torque():
    arm = arm_file.load("R")
    gauges = tuple(replace(g, full_scale=50e-6) for g in arm.gauges)
    arm = model.build(replace(arm, gauges=gauges))
    torque = Damping(arm).torque(LONG, FAST)
    # The rigid arm, accelerated by it: K2 delta = -M21 a.
    terms = arm.terms(np.zeros(1), np.zeros(1))
    delta = -np.linalg.solve(terms.K2, terms.M[1:, :1] @ (torque / terms.M[0, 0]))
    strain = np.abs(gauge_rows(arm, gauges) @ delta).max()
    assert strain == pytest.approx(OF_RANGE * 50e-6, rel=1e-6)


def test_what_bears_the_weight_is_added_and_acts_at_once():
    arm = built("rigid", damp_time=0.1)
    damping, still, limit = Damping(arm), np.zeros(arm.n_joints), arm.arm.torque_limits
    weight = np.abs(slow_torque(arm.terms(still, still), still))  # outstretched: the largest
    assert_allclose(damping.torque(LONG, SLOW), np.minimum(weight + FRACTION * limit, limit))
    assert_allclose(damping.torque(0.0, FAST), np.minimum(weight, limit))
    assert Damping(built("rigid", damp_coefficient=3.0, damp_time=0.1)).viscous(0.0).all()


# --------------------------------------------------------------------------- what they do


def test_a_soft_start_does_not_double_the_bending():
    arm = built()
    # While the joint slides: the hub with its link, decelerated by T_d.
    terms, torque = arm.terms(np.zeros(1), np.zeros(1)), Damping(arm).torque(LONG, 1.0)
    delta = np.linalg.solve(terms.K2, terms.M[1:, :1] @ (torque / terms.M[0, 0]))
    static = np.abs(gauge_rows(arm, arm.arm.gauges) @ delta).max()
    assert coasting(built(damp_time=0.0), 1.0)[1] > 1.8 * static
    assert coasting(arm, 1.0)[1] < 1.65 * static


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_the_way_to_rest_is_half_of_the_soft_start_and_v2_over_2a(speed):
    arm = built()
    plant, _ = coasting(arm, speed, 2.0)
    damping, inertia = Damping(arm), arm.terms(np.zeros(1), np.zeros(1)).M[0, 0]
    acceleration = damping.torque(LONG, speed) / inertia
    wanted = 0.5 * speed * damping.time + speed**2 / (2.0 * acceleration)
    assert_allclose(plant.q, wanted, rtol=0.1)
    assert plant.q < 0.5 * speed * damping.time + 1.1 * WAY


def test_while_the_arm_slows_down_the_torque_stays_that_of_its_first_speed():
    plant = coasting(built(), 2.0, 0.35)[0]
    assert 0.1 < plant.qd[0] < 1.0
    before = plant.qd.copy()
    plant.advance_safely()
    damping, inertia = Damping(plant.model), 1.0 / plant.model._terms_at_rest.H[0, 0]
    # Joint rates change with what the joint alone turns, and with the links' pull.
    assert before - plant.qd > 0.5e-3 * damping.torque(LONG, 2.0) / inertia


def test_torque_that_acts_now_and_then_does_not_leave_the_damping_soft():
    plant, speeds = Plant(built(), 1e-3), []
    plant.qd[:] = 1.0
    for k in range(1500):
        if k % 10:
            plant.advance_safely()
        else:
            plant.advance(np.zeros(1))
        speeds.append(abs(plant.qd[0]))
    assert max(speeds[1000:]) < 0.05
    plant.reset()
    plant.qd[:] = 1.0
    plant.advance_safely()
    assert plant.qd[0] > 0.999  # soft again


@pytest.mark.slow
def test_under_gravity_an_arm_without_brakes_sinks_no_faster_than_under_its_whole_torque():
    """long_reach without brakes: the weight takes up to 703 N m of joint 2, which has 600."""
    pose, sunk = np.array([0.0, 1.2, 0.8, -0.8]), []
    for joint in ({}, {"damp_torque": 1e6, "damp_time": 0.0}):
        plant = Plant(built("long_reach", **joint), 2e-3)
        plant.reset(pose)
        for _ in range(250):
            plant.advance_safely()
        sunk.append(np.abs(plant.q - pose).max())
    assert sunk[0] < 1.2 * sunk[1] + 1e-3
