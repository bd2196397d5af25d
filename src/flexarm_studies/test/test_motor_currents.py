# SPDX-License-Identifier: Apache-2.0
"""Motor currents: the torque is that of the equations of motion, and constant and friction are found from currents."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_studies.identification import recording as recordings
from flexarm_studies.identification.currents import motor_fits, torques
from flexarm_studies.identification.strain_quantities import Setup

ARM = """
name: geared
gravity: [0.0, -9.81, 0.0]
joints:
- {name: shoulder, axis: [0, 0, 1], hub_inertia: 0.05, rotor_inertia: 1.0e-4, gear_ratio: 50.0,
   transmission: {stiffness: 600.0, damping: 3.0, play: 0.01, rounding: 0.003, play_damping: 1.0},
   friction: {viscous: 5.0, coulomb: 5.0, smoothing: 0.03}}
links:
- {name: beam, length: 0.5, mass_per_length: 0.4, EI_y: 40.0,
   flexible: {y: {modes: 1, shape: loaded, damping: [0.02]}}}
payload: {mass: 1.5}
"""
CONSTANT, VISCOUS, COULOMB, INERTIA, BIAS = 12.0, 1.5, 2.0, 0.4, 0.05
RATE = 100.0


def moved(seconds=12.0):
    time = np.arange(0.0, seconds, 1.0 / RATE)
    position = np.full(time.size, 0.3)
    for at, size in ((0.8, 1.3), (3.0, -0.9), (5.5, 1.5), (8.0, -1.7), (10.0, 0.8)):
        s = np.clip((time - at) / 0.7, 0.0, 1.0)
        position = position + size * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    signals = {"position": position[:, None], "strain": np.zeros((time.size, 0))}
    return recordings.uniform(time, signals, joint_names=("shoulder",))


@pytest.fixture(scope="module")
def arm():
    return arm_file.parse(ARM)


@pytest.fixture(scope="module")
def driven(arm):
    return torques(arm, moved(), 20.0)


def test_at_rest_the_torque_holds_the_weight(driven):
    torque, predictor = driven
    # Beam of 0.2 kg with its centre at a quarter of a metre, payload at its half.
    weight = 9.81 * (0.2 * 0.25 + 1.5 * 0.5) * np.cos(0.3)
    assert torque[0, 0] == pytest.approx(weight, rel=0.02)
    assert np.abs(predictor.acceleration).max() > 5.0


def test_the_work_of_the_torque_is_the_change_of_energy_and_what_is_damped(driven):
    torque, predictor = driven
    work = np.cumsum(torque[:, 0] * predictor.velocity[:, 0]) / RATE
    height = 0.5 * 1.5 + 0.2 * 0.25
    lifted = 9.81 * height * (np.sin(predictor.position[-1, 0]) - np.sin(predictor.position[0, 0]))
    assert work[-1] > lifted and work[-1] == pytest.approx(lifted, abs=2.0)


def test_constant_and_friction_are_found_within_their_intervals(arm, driven):
    torque, predictor = driven
    speed = predictor.velocity[:, 0]
    effort = torque[:, 0] + INERTIA * predictor.acceleration[:, 0] + VISCOUS * speed
    effort += COULOMB * np.tanh(speed / 0.03)
    noise = np.random.default_rng(2).normal(0.0, 0.02, speed.size)
    current = effort / CONSTANT + BIAS + noise
    run = replace(moved(), current=current[:, None])
    found = SimpleNamespace(setup=Setup.of(arm))
    (made,) = motor_fits(found, run, slice(0, 800), slice(800, 1200), 20.0)
    truth = {
        "constant": CONSTANT,
        "viscous": VISCOUS,
        "coulomb": COULOMB,
        "inertia": INERTIA,
    }
    for name, true in truth.items():
        value, width = getattr(made, name)
        assert abs(value - true) < 2.0 * width < 0.3 * true, name
    assert made.explained and made.left_of_scored == pytest.approx(
        (noise[800:] ** 2).mean() / current[800:].var(), rel=0.1
    )


def test_a_current_that_has_nothing_to_do_with_the_torque_is_not_explained(arm):
    run = moved()
    current = np.random.default_rng(1).normal(size=(len(run.position), 1))
    found = SimpleNamespace(setup=Setup.of(arm))
    (made,) = motor_fits(
        found, replace(run, current=current), slice(0, 800), slice(800, 1200), 20.0
    )
    assert not made.explained and made.left_of_scored > 0.9
    assert not motor_fits(found, run, slice(0, 800), slice(800, 1200), 20.0)
