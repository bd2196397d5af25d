# SPDX-License-Identifier: Apache-2.0
"""The torque ends in the middle of a move: what the safe action makes of the arm."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_studies.loop import scenario

#: Of a driver: the last torque acts for so long yet [s].
TORQUE_TIMEOUT = 0.05
#: Parameters beyond the shipped ones, and the move; without a plan of the motion, which takes seconds.
PAPER = {"feedforward": "none", "manifold.type": "quasi_steady"}
MOVES = {
    "R": (PAPER, "quintic:to=1.57,duration=2"),
    "two_link": ({"feedforward": "none"}, "quintic:to=1.047;1.047,duration=2"),
    "long_reach": (
        {"feedforward": "none"},
        "quintic:from=0;1.2;0.8;-0.8,to=1.0472;0.1528;1.8472;0.2472,duration=2",
    ),
}


def broken_off(name, time, **joint):
    """Speeds (N, n) [rad/s], energies (N,) [J] and turns (n,) [rad] under the safe action, the controller killed."""
    arm = arm_file.load(name)
    arm = replace(arm, joints=tuple(replace(j, **joint) for j in arm.joints))
    values, motion = MOVES[name]
    if name != "R":
        values = scenario.parameters(name) | values
    run = scenario.Scenario(arm, controller=values, trajectory=motion, duration=time)
    loop = scenario.run_loop(run)[2]
    assert not loop.lost
    plant, torque = loop.simulator.plant, loop.controller.torque.copy()
    for _ in range(round(TORQUE_TIMEOUT / plant.period)):
        plant.advance(torque)
    begin, speeds, energies = plant.q.copy(), [], [plant.model.energy(plant.state)]
    for _ in range(round(1.2 / plant.period)):
        plant.advance_safely()
        speeds.append(plant.qd.copy())
        energies.append(plant.model.energy(plant.state))
    return np.array(speeds), np.array(energies), plant.q - begin, plant.period


@pytest.mark.parametrize("time", [0.3, 1.0, 1.7])
def test_a_brake_stops_the_joint_within_a_second_and_energy_only_falls(time):
    speed, energy, turned, period = broken_off("R", time, safe_action="brake")
    assert np.diff(energy).max() < 1e-9 * energy[0]
    assert np.all(speed[round(1.0 / period) :] == 0.0)
    assert np.rad2deg(np.abs(turned)).max() < 10.0


@pytest.mark.parametrize("name", ["R", "two_link"])
@pytest.mark.parametrize("time", [0.3, 1.0, 1.7])
def test_damping_stops_every_joint_within_a_second_and_energy_only_falls(name, time):
    speed, energy, turned, period = broken_off(name, time)
    assert np.diff(energy).max() < 1e-9 * energy[0]
    assert np.rad2deg(np.abs(speed[round(1.0 / period) :])).max() < 1.0
    assert np.rad2deg(np.abs(turned)).max() < 10.0


@pytest.mark.slow
def test_under_gravity_the_brakes_stop_every_joint_within_a_second_and_the_arm_does_not_drop():
    speed, energy, turned, period = broken_off("long_reach", 1.5)
    # The energy of gravity depends on where the arm stops; the sum falls all the same.
    assert np.diff(energy).max() < 1e-6 * np.ptp(energy)
    assert np.rad2deg(np.abs(speed[round(1.0 / period) :])).max() < 1.0
    assert np.rad2deg(np.abs(turned)).max() < 8.0
