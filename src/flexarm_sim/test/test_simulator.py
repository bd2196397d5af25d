# SPDX-License-Identifier: Apache-2.0
"""The simulated arm sample by sample: time, session, spill-over, another plant, reset."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ArmFileError, ModelError, ParameterError
from flexarm_dynamics.models import levels
from flexarm_dynamics.parameters import check_all
from flexarm_sim.simulator import PARAMETERS, Simulator

FIELDS = ("position", "velocity", "torque", "strain", "amplitude", "rate")


#: The arm, and one with other data.
R = arm_file.load("R")
OTHER = replace(R, name="other")
JOINT, GAUGES = R.joints[0], R.gauges


def simulator(arm="R", plant_arm="", **settings):
    """Arms are given by name, or as they are."""
    checked = check_all(PARAMETERS, settings, {"joints": 1})
    return Simulator(checked | {"arm": arm, "plant_arm": plant_arm})


def samples(sim, count=50):
    """All of `count` samples under a torque that changes."""
    out = []
    for k in range(count):
        out.append([sim.sequence, sim.stamp_ns, *np.concatenate([getattr(sim, f) for f in FIELDS])])
        sim.advance(np.array([3.0 * np.sin(0.2 * k)]) if k % 7 else None)
    return np.array(out)


# --------------------------------------------------------------------------- samples


def test_samples_are_numbered_and_stamped_in_whole_periods():
    for rate, period in ((1000.0, 1_000_000), (3000.0, 333_333), (20000.0, 50_000)):
        sim = simulator(rate=rate)
        for k in range(4):
            assert (sim.sequence, sim.stamp_ns) == (k, Simulator.START_NS + k * period)
            assert sim.time == 1e-9 * (k * period)
            sim.advance(np.zeros(1))


def test_a_sample_holds_the_torque_that_led_to_it():
    sim = simulator()
    assert_array_equal(sim.torque, [0.0])
    for torque in (2.0, -1.0):
        sim.advance(np.array([torque]))
        assert_array_equal(sim.torque, [torque])
    sim.advance(None)
    assert_array_equal(sim.torque, [0.0])


def test_without_torque_the_safe_action_brakes():
    with_torque, without = simulator(), simulator()
    for sim in (with_torque, without):
        for _ in range(200):
            sim.advance(np.array([5.0]))
    for _ in range(300):  # it begins softly
        with_torque.advance(np.zeros(1))
        without.advance(None)
    assert without.velocity[0] < 0.6 * with_torque.velocity[0]


def test_with_the_modes_of_the_file_the_gauges_give_the_true_amplitudes():
    sim = simulator()
    for k in range(100):
        sim.advance(np.array([np.sin(0.3 * k)]))
        assert_allclose(sim.amplitude, sim.plant.delta, atol=1e-15)
        assert_array_equal(sim.rate, sim.plant.delta_d)
        assert_array_equal(sim.position, sim.plant.q)
        assert_array_equal(sim.velocity, sim.plant.qd)


def test_joint_angles_are_quantised_and_velocities_are_not():
    arm = replace(R, joints=(replace(JOINT, encoder_counts=1000),))
    sim = simulator(arm, initial_position=[0.01])
    assert_allclose(sim.position, [2.0 * np.pi / 1000 * 2.0], rtol=1e-12)
    sim.advance(np.array([1.0]))
    assert_array_equal(sim.velocity, sim.plant.qd)


# --------------------------------------------------------------------------- spill-over


def curvature(i, xi):
    """Second derivative of the clamped-free mode i of unit mean square, by its closed form."""
    b = (1.8751040687119611, 4.694091132974175, 7.854757438237613)[i]
    s = (np.cosh(b) + np.cos(b)) / (np.sinh(b) + np.sin(b))
    return b**2 * (np.cosh(b * xi) + np.cos(b * xi) - s * (np.sinh(b * xi) + np.sin(b * xi)))


def test_a_third_mode_spills_over_into_the_two_amplitudes_as_the_gauges_see_it():
    sim = simulator(plant_modes=3)
    # gauges at the root and at mid-span: rows of curvature, times the same -c / L^2
    rows = np.array([[curvature(i, xi) for i in range(3)] for xi in (0.0, 0.5)])
    spill = np.linalg.solve(rows[:, :2], rows[:, 2])
    for delta in ([0.0, 0.0, 1e-3], [0.01, -0.002, 5e-4]):
        sim.plant.reset([0.0], delta)
        sim._measure()
        assert_allclose(sim.amplitude, delta[:2] + spill * delta[2], rtol=1e-9, atol=1e-15)
    assert np.abs(spill).min() > 0.1


def test_spill_over_is_that_of_the_gauge_rows_all_along_a_motion():
    sim = simulator(plant_modes=3)
    rows = sim.sensors.rows
    spill = np.linalg.solve(rows[:, :2], rows[:, 2])
    seen = 0.0
    for k in range(200):
        sim.advance(np.array([5.0 * np.sin(0.3 * k)]))
        delta = sim.plant.delta
        assert_allclose(sim.amplitude, delta[:2] + spill * delta[2], rtol=1e-12, atol=1e-15)
        assert_array_equal(sim.rate, sim.plant.delta_d[:2])
        seen = max(seen, np.abs(sim.amplitude - delta[:2]).max())
    assert seen > 1e-5  # [m]


# --------------------------------------------------------------------------- another plant


def test_the_plant_may_be_another_arm_than_the_controllers():
    heavier = replace(R.payload, mass=2.0 * R.payload.mass)
    sim = simulator(plant_arm=replace(OTHER, payload=heavier))
    assert (sim.arm.name, sim.plant_model.arm.name) == ("R", "other")
    ratio = sim.plant_model.coefficients.rigid / sim.nominal.coefficients.rigid
    assert_allclose(ratio, (1.1586 + 3.1e-3 * 16) / 1.1586, rtol=1e-9)
    same = simulator()
    for s in (sim, same):
        for _ in range(1000):
            s.advance(np.array([2.0]))
    assert_allclose(sim.position / same.position, 1.0 / ratio, rtol=0.02)


def test_gauges_of_the_plant_are_read_in_the_order_of_the_arm():
    swapped, same = simulator(plant_arm=replace(OTHER, gauges=GAUGES[::-1])), simulator()
    for sim in (swapped, same):
        for _ in range(20):
            sim.advance(np.array([2.0]))
    assert_array_equal(swapped.strain, same.strain)
    assert_array_equal(swapped.amplitude, same.amplitude)


def test_a_gauge_that_is_off_in_the_plant_alone_deceives_the_amplitudes():
    off = replace(GAUGES[0], bias=1e-5)
    sim = simulator(plant_arm=replace(OTHER, gauges=(off, *GAUGES[1:])))
    assert_array_equal(sim.strain, [1e-5, 0.0])
    assert np.abs(sim.amplitude).max() > 1e-4  # [m]


@pytest.mark.parametrize(
    ("key", "mine", "its"),
    [("joints", ["joint1"], ["elbow"]), ("gauges", ["root", "middle"], ["elbow", "middle"])],
)
def test_a_plant_with_other_names_is_refused(key, mine, its):
    first, *rest = getattr(R, key)
    with pytest.raises(ModelError) as error:
        simulator(plant_arm=replace(OTHER, **{key: (replace(first, name="elbow"), *rest)}))
    assert error.value.field == "plant_arm other"
    assert (error.value.value, error.value.limit) == (its, mine)


@pytest.mark.parametrize("settings", [{"plant_modes": 1}, {"plant_arm": OTHER.with_modes(1)}])
def test_a_plant_without_the_observed_modes_is_refused(settings):
    with pytest.raises(ModelError, match=r"lacks the modes link1_y_mode2.*raise plant_modes"):
        simulator(**settings)


def test_settings_that_can_not_be_are_refused():
    with pytest.raises(ArmFileError, match="no arm given"):
        simulator("")
    with pytest.raises(ArmFileError, match="neither a file nor a shipped arm"):
        simulator(plant_arm="nowhere")
    with pytest.raises(ParameterError, match=r"rate: .*below"):
        simulator(rate=0.5)
    with pytest.raises(ParameterError, match="initial_position: 2 values where 1"):
        simulator(initial_position=[0.0, 1.0])
    with pytest.raises(ModelError, match="measured frequencies"):
        simulator("P3", plant_modes=3)


# --------------------------------------------------------------------------- determinism


NOISY = replace(R, gauges=tuple(replace(gauge, noise=1e-6) for gauge in GAUGES))


def test_two_simulators_with_the_same_seed_give_the_same_samples_to_the_last_bit():
    first = samples(simulator(NOISY, noise=True, seed=5))
    assert_array_equal(samples(simulator(NOISY, noise=True, seed=5)), first)
    assert not np.array_equal(samples(simulator(NOISY, noise=True, seed=6)), first)


def test_after_a_reset_the_samples_are_the_same_to_the_last_bit():
    sim = simulator(NOISY, noise=True, seed=5, plant_modes=3, initial_position=[0.2])
    first = samples(sim)
    sim.reset()
    assert_array_equal(samples(sim), first)


def test_a_reset_can_put_the_arm_elsewhere_for_once():
    sim = simulator(initial_position=[0.2])
    sim.reset([0.5])
    assert_array_equal(sim.position, [0.5])
    sim.reset()
    assert_array_equal(sim.position, [0.2])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_state_that_is_not_finite_is_a_model_error_and_a_reset_recovers_it():
    sim = simulator()
    before = samples(sim, 3)
    with pytest.raises(ModelError, match="no longer finite"):
        sim.advance(np.array([np.nan]))
    sim.reset()
    assert_array_equal(samples(sim, 3), before)


@pytest.mark.parametrize("level", levels.LEVELS[1:])
def test_the_simulated_arm_alone_is_at_the_level_asked_for(level):
    checked = check_all(PARAMETERS, {"level": level}, {"joints": 2})
    sim = Simulator(checked | {"arm": "two_link", "plant_arm": ""})
    assert levels.level_of(sim.plant_model.arm) == level
    assert levels.level_of(sim.nominal.arm) == "first_order"  # the control model stays the paper's
