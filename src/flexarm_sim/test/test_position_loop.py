# SPDX-License-Identifier: Apache-2.0
"""Drives with a joint loop: the law by hand, commands by what they have, delay, interpolation, limits, stability."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import DesignError, MessageError, ParameterError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import check_all
from flexarm_dynamics.singular_perturbation import slow_torque
from flexarm_sim.plant import Plant
from flexarm_sim.position_loop import PARAMETERS, PositionLoop, spectral_radius
from flexarm_sim.simulator import PARAMETERS as SIMULATOR
from flexarm_sim.simulator import Simulator

TWO = model.build(arm_file.load("two_link"))
STILL = np.zeros(2)


def loop(arm=TWO, period=1e-3, **settings):
    return PositionLoop(arm, period, check_all(PARAMETERS, settings, {"joints": arm.n_joints}))


def test_gains_make_the_rigid_arm_a_second_order_system():
    drives = loop(bandwidth=15.0, damping=0.7)
    inertia = np.diag(TWO.terms(STILL, STILL).M[:2, :2])
    assert_allclose(drives.kp, 225.0 * inertia, rtol=1e-12)
    assert_allclose(drives.kd, 21.0 * inertia, rtol=1e-12)
    assert_allclose(loop(kp=[3.0, 4.0]).kp, [3.0, 4.0])


def test_the_law_by_hand():
    own = {"kp": [20.0], "kd": [0.1], "ki": [2.0]}
    drives = loop(**own, command_delay=0.0, gravity=False, interpolation="hold")
    drives.begin([0.1, 0.2])
    drives.command(0.0, [0.11, 0.19], [0.3, -0.4], [0.05, 0.06])
    q, qd = np.array([0.09, 0.2]), np.array([0.1, 0.0])
    first = [20.0 * 0.02 + 0.1 * 0.2 + 0.05, 20.0 * -0.01 + 0.1 * -0.4 + 0.06]
    assert_allclose(drives.torque(0.0, q, qd), first, rtol=1e-12)
    grown = np.array([2.0 * 0.02 * 1e-3, 2.0 * -0.01 * 1e-3])
    assert_allclose(drives.torque(1e-3, q, qd), first + grown, rtol=1e-12)


def test_the_weight_of_the_rigid_arm_is_borne():
    arm = model.build(arm_file.load("long_reach"))
    q = np.linspace(0.6, 0.9, arm.n_joints)
    drives = loop(arm, bandwidth=1.0)
    drives.begin(q)
    still = np.zeros(arm.n_joints)
    assert_allclose(drives.torque(0.0, q, still), slow_torque(arm.terms(q, still), still))


def test_a_command_acts_after_its_delay_and_is_reached_within_a_period_of_the_commands():
    drives = loop(kp=[5.0], kd=[0.1], command_rate=250.0, command_delay=0.005)
    drives.begin(STILL)
    drives.command(0.0, [0.4, -0.4])
    seen = []
    for k in range(12):
        drives.torque(1e-3 * k, STILL, STILL)
        seen.append((drives.reference[0], drives.reference_velocity[0]))
    assert_allclose([r for r, _ in seen], [0.0] * 5 + [0.1, 0.2, 0.3, 0.4] + [0.4] * 3, atol=1e-12)
    assert_allclose([v for _, v in seen], [0.0] * 5 + [100.0] * 4 + [0.0] * 3, atol=1e-9)


def test_a_held_command_is_a_step():
    drives = loop(interpolation="hold", command_delay=0.0)
    drives.command(0.0, [0.4, 0.0])
    drives.torque(0.0, STILL, STILL)
    assert_allclose(drives.reference, [0.4, 0.0])
    assert_allclose(drives.reference_velocity, STILL)


def test_velocities_alone_move_the_reference_and_efforts_alone_are_passed_on():
    drives = loop(kp=[5.0], kd=[0.1], command_delay=0.0)
    drives.command(0.0, velocity=[1.0, -2.0])
    for k in range(10):
        drives.torque(1e-3 * k, STILL, STILL)
    assert_allclose(drives.reference, [0.01, -0.02], rtol=1e-9)
    drives.command(0.01, effort=[0.3, 100.0])
    assert_allclose(drives.torque(0.01, STILL, STILL), [0.3, TWO.arm.torque_limits[1]])


def test_torque_stays_within_its_limit_and_the_integral_part_stands_still_there():
    own = {"kp": [20.0], "kd": [0.1], "ki": [1.0], "command_delay": 0.0, "interpolation": "hold"}
    drives = loop(**own)
    drives.command(0.0, [100.0, 0.0])
    for k in range(100):
        torque = drives.torque(1e-3 * k, STILL, STILL)
    assert torque[0] == TWO.arm.torque_limits[0] and drives.saturated.tolist() == [True, False]
    drives.begin(STILL)
    drives.command(1.0, [0.0, 0.0])
    assert_allclose(drives.torque(1.0, STILL, STILL), STILL, atol=1e-12)


def test_what_is_unstable_when_sampled_is_refused_before_anything_moves():
    assert loop(bandwidth=20.0).period == 1e-3
    with pytest.raises(DesignError, match=r"largest eigenvalue at 10 Hz.*lower bandwidth"):
        loop(period=0.1, bandwidth=300.0)


def test_drives_in_steps_and_continuous_ones_move_the_arm_alike():
    """The velocity loop within a sample, by the stepper and by many short steps of constant torque."""
    arm = model.build(arm_file.load("R"))
    ends = []
    for continuous in (True, False):
        plant, drives = Plant(arm, 2e-3), loop(arm, 2e-3, bandwidth=20.0, command_delay=0.0)
        drives.limit = np.array([np.inf])
        drives.begin([0.0])
        drives.command(0.0, [0.02])
        for k in range(50):
            if not continuous:  # as where the torque is at its limit
                drives._bounded = partial(bounded, drives)
                drives._steps = 64
            drives.drive(plant, 2e-3 * k)
        ends.append(plant.state.copy())
    assert_allclose(*ends, rtol=5e-3, atol=1e-6)


def bounded(drives, wanted):
    """As `PositionLoop._bounded` of a limit that is never met, with the flag that it is."""
    drives.saturated = np.ones_like(drives.saturated)
    return wanted


def test_an_integral_part_alone_is_unstable():
    """A double integrator under k_i/s alone: its closed loop has poles in the right half-plane."""
    arm = model.build(arm_file.load("rigid"))
    none = np.zeros(arm.n_joints)
    assert spectral_radius(arm, 1e-3, none, none, none + 1.0) > 1.0


@pytest.mark.parametrize(
    "command", [{}, {"position": [1.0]}, {"velocity": [np.nan, 0.0]}, {"effort": [1.0, 2.0, 3.0]}]
)
def test_a_bad_command_changes_nothing(command):
    drives = loop(command_delay=0.0)
    drives.begin([0.1, 0.2])
    with pytest.raises(MessageError):
        drives.command(0.0, **command)
    drives.torque(0.0, STILL, STILL)
    assert_allclose(drives.reference, [0.1, 0.2])


def test_settings_are_checked():
    with pytest.raises(ParameterError, match="interpolation"):
        loop(interpolation="cubic")


def test_a_stiff_joint_loop_reaches_its_command_and_leaves_the_links_ringing():
    """What flexarm is compared with: the joints arrive, the tip does not rest."""
    settings = {"arm": "R", "plant_modes": 3, "rate": 500.0}
    simulator = Simulator(check_all(SIMULATOR, settings, {"joints": 1}))
    drives = PositionLoop(simulator.nominal, 2e-3, check_all(PARAMETERS, {}, {"joints": 1}))
    drives.begin(simulator.position)
    tips = []
    for k in range(1500):
        if k % 4 == 0:
            drives.command(simulator.time, [0.3 * min(simulator.time / 0.6, 1.0)])
        simulator.advance_with(drives.drive)
        tips.append(simulator.plant_model.tip_position(simulator.plant.q, simulator.plant.delta))
    assert_allclose(simulator.plant.q, 0.3, atol=0.02)
    assert np.ptp(tips[-250:], axis=0).max() > 1e-3
