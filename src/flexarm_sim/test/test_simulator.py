# SPDX-License-Identifier: Apache-2.0
"""The simulated arm sample by sample: time, session, spill-over, another plant, reset."""

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm.arm_file import find
from flexarm_dynamics.errors import ArmFileError, ModelError, ParameterError
from flexarm_dynamics.parameters import check_all
from flexarm_sim.simulator import PARAMETERS, Simulator

FIELDS = ("position", "velocity", "torque", "strain", "amplitude", "rate")


def simulator(arm="R", **settings):
    return Simulator(check_all(PARAMETERS, {"arm": str(arm), **settings}, {"joints": 1}))


def samples(sim, count=50):
    """All of `count` samples under a torque that changes."""
    out = []
    for k in range(count):
        out.append([sim.sequence, sim.stamp_ns, *np.concatenate([getattr(sim, f) for f in FIELDS])])
        sim.advance(np.array([3.0 * np.sin(0.2 * k)]) if k % 7 else None)
    return np.array(out)


def changed_arm(tmp_path, name="R", change=None, stem="other"):
    """A copy of a shipped arm file, its YAML changed."""
    data = yaml.safe_load(find(name).read_text())
    data["name"] = stem
    if change:
        change(data)
    path = tmp_path / f"{stem}.yaml"
    path.write_text(yaml.safe_dump(data))
    return str(path)


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
    for _ in range(100):
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


def test_joint_angles_are_quantised_and_velocities_are_not(tmp_path):
    def change(data):
        data["joints"][0]["encoder_counts"] = 1000

    sim = simulator(changed_arm(tmp_path, change=change), initial_position=[0.01])
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


def test_with_fewer_modes_than_observed_there_is_no_plant():
    with pytest.raises(ModelError, match=r"link1_y_mode2.*raise plant_modes"):
        simulator(plant_modes=1)


# --------------------------------------------------------------------------- another plant


def test_the_plant_may_be_another_arm_than_the_controllers(tmp_path):
    def heavier(data):
        data["payload"]["mass"] *= 2.0

    sim = simulator(plant_arm=changed_arm(tmp_path, change=heavier))
    assert (sim.arm.name, sim.plant_model.arm.name) == ("R", "other")
    ratio = sim.plant_model.coefficients.rigid / sim.nominal.coefficients.rigid
    assert_allclose(ratio, (1.1586 + 3.1e-3 * 16) / 1.1586, rtol=1e-9)
    same = simulator()
    for s in (sim, same):
        for _ in range(1000):
            s.advance(np.array([2.0]))
    assert_allclose(sim.position / same.position, 1.0 / ratio, rtol=0.02)


def test_gauges_of_the_plant_are_read_in_the_order_of_the_arm(tmp_path):
    def change(data):
        data["gauges"].reverse()

    swapped, same = simulator(plant_arm=changed_arm(tmp_path, change=change)), simulator()
    for sim in (swapped, same):
        for _ in range(20):
            sim.advance(np.array([2.0]))
    assert_array_equal(swapped.strain, same.strain)
    assert_array_equal(swapped.amplitude, same.amplitude)


def test_a_gauge_that_is_off_in_the_plant_alone_deceives_the_amplitudes(tmp_path):
    def change(data):
        data["gauges"][0]["bias"] = 1e-5

    sim = simulator(plant_arm=changed_arm(tmp_path, change=change))
    assert_array_equal(sim.strain, [1e-5, 0.0])
    assert np.abs(sim.amplitude).max() > 1e-4  # [m]


@pytest.mark.parametrize(
    ("key", "mine", "its"),
    [("joints", ["joint1"], ["elbow"]), ("gauges", ["root", "middle"], ["elbow", "middle"])],
)
def test_a_plant_with_other_names_is_refused(tmp_path, key, mine, its):
    def change(data):
        data[key][0]["name"] = "elbow"

    with pytest.raises(ModelError) as error:
        simulator(plant_arm=changed_arm(tmp_path, change=change))
    assert error.value.field == "plant_arm other"
    assert (error.value.value, error.value.limit) == (its, mine)


def test_a_plant_without_the_observed_modes_is_refused(tmp_path):
    def change(data):
        data["links"][0]["flexible"]["y"]["modes"] = 1

    with pytest.raises(ModelError, match="lacks the modes link1_y_mode2"):
        simulator(plant_arm=changed_arm(tmp_path, change=change))


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


def noisy(tmp_path):
    def change(data):
        for gauge in data["gauges"]:
            gauge["noise"] = 1e-6

    return changed_arm(tmp_path, change=change)


def test_two_simulators_with_the_same_seed_give_the_same_samples_to_the_last_bit(tmp_path):
    arm = noisy(tmp_path)
    first = samples(simulator(arm, noise=True, seed=5))
    assert_array_equal(samples(simulator(arm, noise=True, seed=5)), first)
    assert not np.array_equal(samples(simulator(arm, noise=True, seed=6)), first)


def test_after_a_reset_the_samples_are_the_same_to_the_last_bit(tmp_path):
    sim = simulator(noisy(tmp_path), noise=True, seed=5, plant_modes=3, initial_position=[0.2])
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
