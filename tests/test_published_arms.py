# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/published_arms.md, computed: what others measured on such an arm beside what `flexlink` has."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.robust.design import design
from flexarm_control.robust.settings import Settings
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.linear import linear_plant, sampled
from flexarm_dynamics.models.model import build
from flexarm_studies.loop.scenario import Scenario, run_loop

TEXT = (Path(__file__).resolve().parents[1] / "docs" / "published_arms.md").read_text("utf-8")
ARM = arm_file.load("flexlink").with_modes(3)

# The drive as published: what turns volts into torque.
TORQUE_CONSTANT = 7.68e-3  # [N m/A] and [V s/rad]
RESISTANCE = 2.6  # [ohm]
BEARINGS = 0.015  # [N m s/rad]
LOSSES = (0.69 * 0.90, 1.0)  # [-] efficiencies: as in the file, and none
MODULE = 2.0e-4  # [kg m^2] of the hub inertia
# Of the measured loop and of the lumped model.
GAIN, PERIOD = 1.65, 0.002  # [V/rad], [s]
LINK_INERTIA, LINK_STIFFNESS = 0.065 * 0.419**2 / 3.0, 1.30  # [kg m^2], [N m/rad]


def rows(name):
    """Cells of a marked table, numbers where they are numbers."""
    part = TEXT.split(f"<!-- {name}: begin -->")[1].split(f"<!-- {name}: end -->")[0]
    lines = [line for line in part.strip().splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def numbers(name, first=1):
    return np.array([[float(cell) for cell in row[first:]] for row in rows(name)])


def drive(efficiency):
    """Torque per volt [N m/V], and the arm's model with the motor's back-EMF among its friction."""
    joint = ARM.joints[0]
    per_volt = efficiency * TORQUE_CONSTANT * joint.gear_ratio / RESISTANCE
    viscous = BEARINGS + per_volt * joint.gear_ratio * TORQUE_CONSTANT
    friction = replace(joint.friction, viscous=viscous)
    return per_volt, build(replace(ARM, joints=(replace(joint, friction=friction),)))


def response(frequency, efficiency):
    """From the added voltage to the joint angle in the sampled loop [rad/V]."""
    per_volt, model = drive(efficiency)
    A, B = linear_plant(model, np.zeros(1), True)
    F, G = sampled(A, per_volt * B, PERIOD)
    F[:, 0] -= GAIN * G[:, 0]
    z = np.exp(2j * np.pi * np.asarray(frequency) * PERIOD)
    return np.array([np.linalg.solve(x * np.eye(len(F)) - F, G)[0, 0] for x in z])


def square_wave(time, efficiency):
    """Of the joint [rad], to ±1 V with a period of 10 s."""
    k = np.arange(1, 600, 2)
    G = response(0.1 * k, efficiency)
    waves = G * np.exp(0.2j * np.pi * np.outer(time, k))
    return (4.0 / np.pi / k * waves.imag).sum(1)


def clamped(arm):
    """Frequencies with the joint held [Hz]."""
    return build(arm).normal_modes(np.zeros(1), locked=True)[0] / (2.0 * np.pi)


def compared(table, found, scale=None):
    """Assert the columns 'model' and 'deviation' of a table whose first column was published."""
    published, model, deviation = table.T
    whole = published if scale is None else scale
    assert_allclose(model, found, rtol=6e-3)
    assert_allclose(deviation, 100.0 * (found - published) / whole, atol=0.7)


def test_the_file_has_the_published_drive():
    per_volt, model = drive(LOSSES[0])
    joint = ARM.joints[0]
    assert joint.limits.torque == pytest.approx(10.0 * per_volt, rel=5e-3)
    assert joint.friction.viscous == pytest.approx(model.arm.joints[0].friction.viscous, rel=1e-3)


def test_frequencies_with_the_root_held():
    compared(numbers("frequencies"), clamped(ARM))
    assert abs(numbers("frequencies")[:, 2]).max() < 3.0
    whole = clamped(replace(ARM, links=(replace(ARM.links[0], length=0.419),)))
    table, mode = numbers("others", 2), [0, 0, 0, 1]
    compared(table[:, :3], clamped(ARM)[mode])
    compared(table[:, [0, 3, 4]], whole[mode])


def test_servo_and_lumped_model():
    table = numbers("servo")
    for columns, efficiency in (([0, 1, 2], LOSSES[0]), ([0, 3, 4], LOSSES[1])):
        per_volt, model = drive(efficiency)
        joint = model.arm.joints[0]
        J = joint.hub_inertia - MODULE + joint.gear_ratio**2 * joint.rotor_inertia
        c, k, Jl = joint.friction.viscous, LINK_STIFFNESS, LINK_INERTIA
        A = np.zeros((4, 4))  # of theta, alpha and their rates, as the laboratory manual has it
        A[0, 2] = A[1, 3] = 1.0
        A[2, 1:3], A[3, 1:3] = (k / J, -c / J), (-k / J - k / Jl, c / J)
        poles = np.linalg.eigvals(A)
        pair = poles[poles.imag.argmax()]
        found = [per_volt / c, per_volt / c, pair.imag, pair.real, poles.real.min()]
        compared(table[:, columns], np.array(found))


@pytest.mark.parametrize(
    ("columns", "efficiency"), [([1, 2, 3], LOSSES[0]), ([1, 4, 5], LOSSES[1])]
)
def test_responses(columns, efficiency):
    gains, steps = numbers("gains", 0), numbers("steps", 0)
    compared(gains[:, columns], abs(response(gains[:, 0], efficiency)))
    compared(steps[:, columns], square_wave(steps[:, 0], efficiency), scale=2.0 / GAIN)
    if efficiency == 1.0:
        assert abs(gains[gains[:, 0] < 10.0, 5]).max() <= 8.0 and abs(steps[:, 5]).max() <= 3.0


@pytest.mark.long
def test_the_designed_control_holds_it_on_a_plant_with_more_modes():
    found = design(arm_file.load("flexlink"), Settings(rate=500.0, delay=0.002))
    motion = {"trajectory": "quintic:to=0.785,duration=0.8", "rate": 500.0, "delay": 0.002}
    _, metrics, loop = run_loop(Scenario("flexlink", found.parameters(), plant_modes=3, **motion))
    assert not loop.lost and metrics["settling_time_s"] < 0.2
    assert metrics["peak_joint_error_rad"][0] < 4e-3
