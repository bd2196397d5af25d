# SPDX-License-Identifier: Apache-2.0
"""The plant: motion under torque, energy, safe actions, errors."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ModelError, ShapeError
from flexarm_dynamics.models import model
from flexarm_sim.integrators import friction_warning, integrate, turning_rate
from flexarm_sim.plant import Plant

DEGREE = np.pi / 180.0
ARMS = ("R", "P3", "one_link")


def built(name="R", modes=0, joint=None, **changed):
    """Model of a shipped arm, with changes to its joint or to itself."""
    arm = replace(arm_file.load(name), **changed)
    if joint:
        arm = replace(arm, joints=(replace(arm.joints[0], **joint),))
    return model.build(arm.with_modes(modes) if modes else arm)


def coasting(arm, seconds=1.0, speed=2.0):
    """Joint speeds and energies from `speed` [rad/s] on under the safe action, at 1 kHz."""
    plant = Plant(arm, 1e-3)
    plant.qd[:] = speed
    speeds, energies = [], [arm.energy(plant.state)]
    for _ in range(round(1000 * seconds)):
        plant.advance_safely()
        speeds.append(abs(plant.qd[0]))
        energies.append(arm.energy(plant.state))
    return np.array(speeds), np.array(energies)


# --------------------------------------------------------------------------- motion


@pytest.mark.parametrize("name", ["arm_r", "heavy_arm"])
def test_the_plant_moves_as_the_equations_of_motion_say(request, name):
    arm = request.getfixturevalue(name)
    plant = Plant(arm, 1e-3)
    plant.reset([0.3], [0.02, -0.004])
    start = plant.state.copy()
    torque = np.array([2.0])
    states = [start]
    for _ in range(500):
        plant.advance(torque)
        states.append(plant.state.copy())
    exact = integrate(arm, start, lambda t, s: torque, 1e-3 * np.arange(501), 1e-12, 1e-13)
    assert_allclose(states, exact, atol=1e-9)


@pytest.mark.parametrize("modes", [2, 3, 5])
def test_the_energy_of_the_free_arm_drifts_less_than_1e_5_in_10_s(modes):
    arm = built("R", modes)
    plant = Plant(arm, 1e-3)
    plant.state[:] = 0.0
    plant.qd[:] = 1.0
    plant.delta[:2] = 0.03, -0.01
    plant.delta_d[-1] = 0.5
    start, worst = arm.energy(plant.state), 0.0
    for _ in range(100):
        for _ in range(100):
            plant.advance(np.zeros(1))
        worst = max(worst, abs(arm.energy(plant.state) / start - 1.0))
    assert worst < 1e-5


def test_work_of_the_torque_becomes_energy(arm_r):
    plant = Plant(arm_r, 1e-3)
    torque, work = np.array([2.5]), 0.0
    for _ in range(400):
        before = plant.q[0]
        plant.advance(torque)
        work += torque[0] * (plant.q[0] - before)
    assert_allclose(arm_r.energy(plant.state), work, rtol=1e-10)


def test_an_arm_at_rest_stays_there_to_the_last_bit(arm_r):
    plant = Plant(arm_r, 1e-3)
    plant.reset([0.7])
    for _ in range(10):
        plant.advance(np.zeros(1))
        plant.advance_safely()
    assert_array_equal(plant.state, [0.7, 0.0, 0.0, 0.0, 0.0, 0.0])


# --------------------------------------------------------------------------- safe actions


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("action", ["damp", "brake"])
def test_a_stopping_action_never_adds_energy(name, action):
    _, energies = coasting(built(name, joint={"safe_action": action}))
    assert np.diff(energies).max() <= 1e-12 * energies[0]
    assert energies[-1] < 0.15 * energies[0]


@pytest.mark.parametrize("name", ARMS)
def test_brake_brings_the_joint_from_2_rad_s_below_1_deg_s_within_1_s(name):
    speeds, _ = coasting(built(name, joint={"safe_action": "brake"}), 2.0)
    assert speeds[999:].max() < 1.0 * DEGREE
    assert speeds[300:].max() < 1.0 * DEGREE  # the rigid arm takes 0.2 s at its torque limit
    assert speeds[-1] == 0.0


@pytest.mark.parametrize("name", ARMS)
def test_damp_brings_the_joint_from_2_rad_s_below_1_deg_s_within_1_s_though_the_links_swing_on(
    name,
):
    speeds, _ = coasting(built(name, joint={"safe_action": "damp"}), 2.0)
    assert 0.0 < speeds[999:].max() < 1.0 * DEGREE


def test_damp_stays_within_the_torque_limit():
    arm = built(joint={"safe_action": "damp", "damp_torque": 1e6, "damp_time": 0.0})
    limit, inertia = arm.arm.joints[0].limits.torque, 1.0 / arm._terms_at_rest.H[0, 0]
    speeds, _ = coasting(arm, 0.001)
    assert_allclose(-np.diff([2.0, *speeds]), limit / inertia * 1e-3, rtol=0.01)


def test_a_damp_coefficient_takes_the_swing_out_of_a_flexible_arm():
    arm = built(joint={"safe_action": "damp", "damp_coefficient": 15.7})
    speeds, energies = coasting(arm, 2.0)
    assert speeds[999:].max() < 5.5 * DEGREE
    assert energies[-1] < 0.01 * energies[0]


def test_without_torque_limit_and_gauges_damp_stops_the_rigid_arm_with_10_1_s():
    link = arm_file.load("R").links[0]
    stiff = replace(link, stiffness={"y": 100.0 * link.stiffness["y"]})
    limits = replace(arm_file.load("R").joints[0].limits, torque=np.inf)
    joint = {"safe_action": "damp", "limits": limits, "damp_time": 0.0}
    speeds, _ = coasting(built(links=(stiff,), gauges=(), joint=joint))
    assert speeds[-100:].max() < 1.0 * DEGREE
    assert_allclose(speeds[199], 2.0 * np.exp(-2.0), rtol=0.05)


def test_zero_lets_the_arm_coast_like_no_torque():
    arm = built(joint={"safe_action": "zero"})
    speeds, energies = coasting(arm)
    assert_allclose(speeds, 2.0, rtol=0.2)
    assert_allclose(energies, energies[0], rtol=1e-12)
    safe, free = Plant(arm, 1e-3), Plant(arm, 1e-3)
    for plant in (safe, free):
        plant.reset([0.0], [0.02, 0.01])
    for _ in range(50):
        safe.advance_safely()
        free.advance(np.zeros(1))
    assert_array_equal(safe.state, free.state)


def test_the_files_damping_and_braking_are_used_where_it_states_them():
    J = built().coefficients.rigid
    # as a rigid arm does, for the first few ms
    speeds, _ = coasting(built(joint={"safe_action": "damp", "damp_coefficient": 0.0}), 0.1)
    assert_allclose(speeds, 2.0, rtol=1e-3)
    H11 = built()._terms_at_rest.H[0, 0]
    joint = {"safe_action": "damp", "damp_coefficient": 3.0, "damp_time": 0.0}
    speeds, _ = coasting(built(joint=joint), 0.002)
    assert_allclose(speeds[0], 2.0 * np.exp(-3.0 * H11 * 1e-3), rtol=1e-5)
    weak, _ = coasting(built(joint={"safe_action": "brake", "brake_torque": 0.0}), 0.1)
    strong, _ = coasting(built(joint={"safe_action": "brake", "brake_torque": 50.0}), 0.1)
    assert weak[-1] > 2.0 * np.exp(-1.5) > 0.2 > strong[-1]
    assert J > 1.0


def test_a_brake_far_too_strong_for_the_time_step_stops_the_arm_without_chatter():
    arm = built(joint={"safe_action": "brake", "brake_torque": 1e5})
    speeds, energies = coasting(arm)
    assert np.diff(energies).max() <= 1e-12 * energies[0]
    assert speeds[100:].max() < 1.0 * DEGREE


# --------------------------------------------------------------------------- errors


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("torque", [np.nan, np.inf, 1e200])
def test_a_state_that_is_not_finite_is_an_error_that_names_the_arm(arm_r, torque):
    plant = Plant(arm_r, 1e-3)
    with pytest.raises(ModelError) as error:
        for _ in range(20):
            plant.advance(np.array([torque]))
    assert error.value.field == "state of R" and "reset" in error.value.hint
    plant.reset()
    plant.advance(np.array([1.0]))
    assert np.isfinite(plant.state).all()


def test_an_initial_position_of_the_wrong_shape_is_refused_naming_both(arm_r):
    with pytest.raises(ShapeError) as error:
        Plant(arm_r, 1e-3).reset([0.0, 1.0])
    assert (error.value.value, error.value.limit) == ((2,), (1,))


def test_reset_puts_the_arm_at_rest_at_the_given_position(arm_r):
    plant = Plant(arm_r, 1e-3)
    plant.advance(np.array([5.0]))
    plant.reset([0.4], [0.01, 0.002])
    assert_array_equal(plant.state, [0.4, 0.01, 0.002, 0.0, 0.0, 0.0])
    plant.reset()
    assert_array_equal(plant.state, np.zeros(6))


@pytest.mark.parametrize(("rate", "method"), [(100, "dop853"), (100, "rk4"), (1000, "rk4")])
def test_the_safe_action_is_stable_where_a_joint_alone_is_light(rate, method):
    # The elbow's velocity loop: 40 N m s/rad on 0.23 g m^2, faster than any mode that substeps are chosen for.
    arm = arm_file.load("two_link")
    arm = model.build(replace(arm, joints=tuple(replace(j, damp_time=0.0) for j in arm.joints)))
    plant = Plant(arm, 1.0 / rate, method)
    plant.qd[:] = 0.1
    energies = [arm.energy(plant.state)]
    for _ in range(rate // 2):
        plant.advance_safely()
        energies.append(arm.energy(plant.state))
    assert np.diff(energies).max() < 1e-9 * energies[0]
    assert energies[-1] < 0.9 * energies[0]
    fine = Plant(arm, 1e-4)
    fine.qd[:] = 0.1
    for _ in range(5000):
        fine.advance_safely()
    assert_allclose(plant.q, fine.q, atol=1e-5)


def light_elbow(coulomb):
    """The two-link arm with Coulomb friction [N m] at its elbow of 0.23 g m^2."""
    shoulder, elbow = (arm := arm_file.load("two_link")).joints
    rubbing = replace(elbow, friction=replace(elbow.friction, coulomb=coulomb))
    return model.build(replace(arm, joints=(shoulder, rubbing)))


def test_friction_of_a_light_joint_shortens_the_steps_of_explicit_methods():
    counts = [
        [Plant(light_elbow(coulomb), 1e-3, method).substeps for coulomb in (0.0, 0.01, 10.0)]
        for method in ("dop853", "implicit")
    ]
    assert counts[1] == [1, 1, 1]
    none, some, much = counts[0]
    assert 2 * none <= some <= 3 * none and much == 16 * none


def test_friction_that_no_number_of_substeps_is_enough_for_is_reported():
    assert not friction_warning(light_elbow(0.05), 1e-3)
    text = friction_warning(light_elbow(10.0), 1e-3)
    assert "may hunt" in text and "friction.smoothing" in text
    # The factor that is missing, and with it the rate at which the warning goes.
    missing = float(re.search(r"([\d.]+) times too fast", text)[1])
    assert missing > 1.0
    assert friction_warning(light_elbow(10.0), 1.2e-3 / missing / 1.3) == ""
    assert friction_warning(light_elbow(10.0), 1e-3, "implicit") == ""


def test_breakaway_counts_as_friction_at_rest():
    arm = light_elbow(0.01).arm
    shoulder, elbow = arm.joints
    sticky = replace(elbow, friction=replace(elbow.friction, breakaway=0.03))
    sticky = model.build(replace(arm, joints=(shoulder, sticky)))
    assert_allclose(turning_rate(sticky), turning_rate(light_elbow(0.03)), rtol=0.01)


def test_a_brake_beside_a_damped_light_joint_with_friction_takes_energy():
    arm = light_elbow(0.05).arm
    shoulder, elbow = arm.joints
    joints = replace(shoulder, safe_action="brake"), replace(elbow, safe_action="damp")
    arm = model.build(replace(arm, joints=tuple(replace(j, damp_time=0.0) for j in joints)))
    plant = Plant(arm, 1e-3)
    plant.qd[:] = 0.1
    energies = [arm.energy(plant.state)]
    for _ in range(300):
        plant.advance_safely()
        energies.append(arm.energy(plant.state))
    assert np.diff(energies).max() < 1e-6 * energies[0]
    assert energies[-1] < 0.9 * energies[0]


def test_a_light_joint_with_friction_moves_as_in_short_steps():
    def after(period, substeps=None):
        plant = Plant(light_elbow(0.03), period)
        plant.substeps = substeps or plant.substeps
        plant.qd[1] = 0.005
        for _ in range(round(0.1 / period)):
            plant.advance(np.zeros(2))
        return plant.qd.copy()

    exact = after(5e-5)
    assert_allclose(after(1e-3), exact, atol=1e-12)
    # In the steps that its modes allow the joint hunts, three times as fast as it began.
    assert np.abs(after(1e-3, substeps=1) - exact).max() > 0.01
