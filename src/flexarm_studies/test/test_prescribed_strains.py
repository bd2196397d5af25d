# SPDX-License-Identifier: Apache-2.0
"""Strains of a prescribed motion: the prediction is the plant's, and everything that the fit changes has its effect."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification import recording as recordings
from flexarm_studies.identification.prescribed import MotionPredictor, driven_frequencies, shifted
from flexarm_studies.identification.strain_quantities import (
    Setup,
    changed,
    strain_quantities,
    value_of,
    with_offset,
)

ARM = """
name: geared
gravity: [0.0, -9.81, 0.0]
joints:
- {name: shoulder, axis: [0, 0, 1], hub_inertia: 0.03, rotor_inertia: 1.0e-4, gear_ratio: 50.0,
   transmission: {stiffness: 500.0, damping: 2.0, play: 0.012, load_damping: 0.1, rounding: 0.003, play_damping: 1.5}}
- {name: elbow, axis: [0, 0, 1], hub_inertia: 0.005, motor_mass: 1.5}
links:
- {name: upper, length: 0.45, mass_per_length: 0.34, EI_y: 35.0,
   flexible: {y: {modes: 1, shape: loaded, damping: [0.01]}}}
- {name: fore, length: 0.4, mass_per_length: 0.33, EI_y: 25.0,
   flexible: {y: {modes: 1, shape: loaded, damping: [0.02]}}}
payload: {mass: 0.1}
gauges:
- {name: a, link: upper, position: 0.05, direction: y, surface_distance: 0.003, gain: 0.9, bias: 1.0e-5}
- {name: b, link: fore, position: 0.05, direction: y, surface_distance: 0.003}
"""
RATE = 100.0


def moved(seconds=4.0, names=("shoulder", "elbow")):
    """A recording of two moves with a rest between, strains unknown."""
    time = np.arange(0.0, seconds, 1.0 / RATE)
    step = lambda at, long: np.clip((time - at) / long, 0.0, 1.0)  # noqa: E731
    quintic = lambda s: s**3 * (10.0 - 15.0 * s + 6.0 * s**2)  # noqa: E731
    there, back = quintic(step(0.5, 0.8)), quintic(step(2.2, 0.7))
    position = np.column_stack([0.8 + 1.2 * there - 0.9 * back, -0.5 + 0.6 * there])
    strain = np.zeros((time.size, 2))
    return recordings.uniform(time, {"position": position, "strain": strain}, joint_names=names)


@pytest.fixture(scope="module")
def arm():
    return arm_file.parse(ARM)


def test_the_strains_are_those_of_the_simulated_motion(arm, flexarm, tmp_path):
    """`simulate --prescribed` integrates the same motion by another method, with another spline, in shorter steps.

    Both at first order, as the fit is.
    """
    measured = moved()
    columns = np.column_stack([measured.time, measured.position])
    header = "t,shoulder_position,elbow_position"
    np.savetxt(tmp_path / "run.csv", columns, delimiter=",", header=header, comments="")
    (tmp_path / "arm.yaml").write_text(ARM)
    code, _, err = flexarm(
        "simulate", tmp_path / "arm.yaml", "--prescribed", tmp_path / "run.csv", "--out", tmp_path / "out.csv",
        "--level", "first_order",
    )  # fmt: skip
    assert code == 0, err
    made = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    predictor = MotionPredictor(arm, measured)
    delta, rate, built = predictor.states(arm)
    found = predictor.strains(arm, delta, rate, built)
    simulated = np.column_stack([made["a_strain"], made["b_strain"]])
    assert np.ptp(simulated, axis=0).min() > 5e-5
    np.testing.assert_allclose(found[: len(simulated)], simulated, atol=2e-7)


def test_shorter_steps_change_no_tenth_of_a_microstrain(arm):
    predictor = MotionPredictor(arm, moved())
    coarse = predictor.strains(arm, *predictor.states(arm))
    predictor.substeps *= 4
    fine = predictor.strains(arm, *predictor.states(arm))
    assert np.abs(coarse - fine).max() < 1e-7


def test_sharp_flanks_take_shorter_steps(arm):
    sharp = replace(arm.joints[0], transmission=replace(arm.joints[0].transmission, rounding=0.0))
    arm = replace(arm, joints=(sharp, arm.joints[1]))
    predictor = MotionPredictor(arm, moved())
    coarse = predictor.strains(arm, *predictor.states(arm))
    predictor.substeps *= 8
    error = coarse - predictor.strains(arm, *predictor.states(arm))
    assert np.sqrt(np.mean(error**2)) < 1e-7


def test_a_fit_may_try_a_play_of_nearly_nothing(arm):
    tiny = replace(arm.joints[0].transmission, play=1e-9, rounding=0.0)
    arm = replace(arm, joints=(replace(arm.joints[0], transmission=tiny), arm.joints[1]))
    predictor = MotionPredictor(arm, moved())
    assert 20 < predictor.substeps < 200
    assert np.isfinite(predictor.strains(arm, *predictor.states(arm))).all()


def test_delay_drift_bias_and_offset_do_what_they_say(arm):
    measured = moved()
    predictor = MotionPredictor(arm, measured)
    delta, rate, built = predictor.states(arm)
    rows = np.array([[0.9], [1.0]]) * gauge_rows(built, arm.gauges)
    np.testing.assert_allclose(
        predictor.strains(arm, delta, rate, built), delta @ rows.T + [1e-5, 0.0], atol=1e-18
    )
    late = predictor.strains(arm, delta, rate, built, delay=np.array([0.02, 0.0]))
    np.testing.assert_allclose(late[2:, 0], (delta @ rows.T + [1e-5, 0.0])[:-2, 0], atol=1e-15)
    drifted = predictor.strains(arm, delta, rate, built, drift=np.array([1e-6, 0.0]))
    change = drifted[:, 0] - (delta @ rows.T)[:, 0] - 1e-5
    assert change[-1] - change[0] == pytest.approx(1e-6 * measured.time[-1])
    assert abs(change.mean()) < 1e-12
    # An angle that is off by 0.1 rad is the arm whose joint is mounted so.
    offset = np.array([0.1, -0.05])
    turned = with_offset(arm, offset)
    other = MotionPredictor(turned, measured)
    np.testing.assert_allclose(
        predictor.strains(arm, *predictor.states(arm, offset)),
        other.strains(turned, *other.states(turned)),
        atol=1e-12,
    )


def test_between_samples_a_shifted_series_is_a_cubic():
    time = 0.01 * np.arange(200)
    wave, slope = np.sin(20.0 * time), 20.0 * np.cos(20.0 * time)
    late = shifted(wave, slope, 0.0037, 0.01)
    np.testing.assert_allclose(late[1:], np.sin(20.0 * (time - 0.0037))[1:], atol=1e-5)
    early = shifted(wave, slope, -0.0037, 0.01)
    np.testing.assert_allclose(early[:-1], np.sin(20.0 * (time + 0.0037))[:-1], atol=1e-5)


def test_the_driven_frequencies_ring_in_a_motion_that_stops(arm):
    """With play closed, after a jerk: the spectrum of the strain peaks at the lowest of them."""
    closed, measured = arm.without_play, moved(8.0)
    closed = changed(
        Setup.of(closed),
        [q for q in strain_quantities(closed, measured) if q.name.endswith("transmission.damping")],
        [0.02],
    ).arm
    closed = replace(
        closed,
        joints=(
            replace(
                closed.joints[0],
                transmission=replace(closed.joints[0].transmission, load_damping=0.0),
            ),
            closed.joints[1],
        ),
    )
    predictor = MotionPredictor(closed, measured)
    delta, _, built = predictor.states(closed)
    lowest = driven_frequencies(built, measured.position[-1])[0] / (2.0 * np.pi)
    tail = delta[int(4.0 * RATE) :, 0]
    power = np.abs(np.fft.rfft((tail - tail.mean()) * np.hanning(tail.size), 8192))
    found = np.fft.rfftfreq(8192, 1.0 / RATE)[np.argmax(power)]
    assert found == pytest.approx(lowest, rel=0.02)


def test_each_quantity_is_read_back_and_changes_a_strain(arm):
    measured = moved()
    setup = Setup.of(arm)
    found = strain_quantities(arm, measured)
    assert len({q.name for q in found}) == len(found)
    predictor = MotionPredictor(arm, measured)
    read = lambda s: predictor.strains(  # noqa: E731
        s.arm, *predictor.states(s.arm, s.offset), s.delay, s.drift / measured.time[-1]
    )
    base = read(setup)
    for q in found:
        value = value_of(setup, q) + 0.1 * q.scale
        other = changed(setup, [q], [value])
        assert value_of(other, q) == pytest.approx(value), q.name
        assert np.abs(read(other) - base).max() > 1e-10, q.name


def test_a_model_without_prescribed_motion_is_refused():
    with pytest.raises(FlexarmError, match="write `model: chain`"):
        MotionPredictor(arm_file.load("R"), moved())
