# SPDX-License-Identifier: Apache-2.0
"""Gauges that fail, what is left of the strain map then, and the bias of an arm at rest."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers import gauge_health
from flexarm_control.observers.arm_observer import observe
from flexarm_control.observers.gauge_health import (
    GOOD,
    MISSING,
    SATURATED,
    STUCK,
    SUSPECT,
    BiasCalibration,
    GaugeHealth,
)
from flexarm_dynamics.arm.strain_map import StrainMap, gauge_rows
from flexarm_dynamics.errors import NOT_GIVEN, MessageError
from flexarm_dynamics.models import model

MS = 10**6  # [ns]
NOISE, COUNT = 0.5e-6, 2e-3 / 4096  # [strain], of R_lab
NAN, INF = np.nan, np.inf


def health_of(arm, stuck_samples=20):
    return GaugeHealth(arm, StrainMap(arm), stuck_samples)


def swing(k):
    """Amplitudes of sample k of 1 kHz, both modes swinging [m]."""
    return np.array([0.02 * np.sin(0.012 * k + 0.3), 2e-3 * np.sin(0.09 * k)])


class Rows(dict):
    """Gauge rows by model, made once."""

    def __missing__(self, arm):
        self[arm] = gauge_rows(arm, arm.arm.gauges)
        return self[arm]


ROWS = Rows()


def readings(arm, delta, random=None):
    """What the gauges read of amplitudes, rounded as R_lab's."""
    strain = ROWS[arm] @ delta
    if random is not None:
        strain = strain + NOISE * random.standard_normal(strain.size)
    return COUNT * np.round(strain / COUNT)


# --------------------------------------------------------------------------- lost


@pytest.mark.parametrize(
    ("value", "state"),
    [(NAN, MISSING), (INF, MISSING), (1e-3, SATURATED), (-1e-3, SATURATED), (7e5, SATURATED)],
)
@pytest.mark.parametrize("which", range(4))
def test_a_gauge_that_reads_nonsense_is_named_and_left_out(lab, which, value, state):
    health, delta = health_of(lab), swing(40)
    strain = gauge_rows(lab, lab.arm.gauges) @ delta
    strain[which] = value
    health.update(strain)
    assert_array_equal(np.flatnonzero(health.health), [which])
    assert health.health[which] == state
    assert_allclose(health.amplitudes(strain), delta, rtol=1e-9)
    assert health.lost == (which,)
    (warning,) = health.warnings()
    assert warning == (
        f"gauge {lab.arm.gauge_names[which]} is {gauge_health.WORDS[state]}, left out"
    )


def test_readings_just_inside_the_range_are_good(lab):
    health = health_of(lab)
    # the converter's last counts, and the ones before
    for value, bad in ((1e-3 - 2 * COUNT, 0), (1e-3 - COUNT, 1), (-1e-3 + COUNT, 0), (-1e-3, 1)):
        for strain in value * np.eye(4):
            health.reset()
            health.update(strain)
            assert (health.health == SATURATED).sum() == bad


def test_two_of_four_may_fail_and_a_third_is_refused_with_gauges_and_modes_named(lab):
    health, delta = health_of(lab), swing(40)
    strain = gauge_rows(lab, lab.arm.gauges) @ delta
    strain[[0, 2]] = NAN
    health.update(strain)
    assert_allclose(health.amplitudes(strain), delta, rtol=1e-9)
    strain[3] = 1.0
    health.update(strain)
    with pytest.raises(MessageError) as error:
        health.amplitudes(strain)
    assert str(error.value) == (
        "strain of root: nan can't be used: without root (missing), middle (missing), three_quarter (saturated)"
        " the gauges (quarter) can't give link1_y_mode1, link1_y_mode2"
    )


def test_two_gauges_for_two_modes_can_spare_none(arm_r):
    health = health_of(arm_r)
    health.update(np.array([0.0, NAN]))
    with pytest.raises(MessageError, match=r"strain of middle: nan .*gauges \(root\) can't give"):
        health.amplitudes(np.array([0.0, NAN]))
    # what is needed is taken back at once
    health.update(np.array([1e-5, 1e-5]))
    assert_array_equal(
        health.amplitudes(np.array([1e-5, 1e-5])), StrainMap(arm_r).amplitudes([1e-5, 1e-5])
    )


def test_a_gauge_that_can_be_spared_comes_back_after_as_many_good_samples(lab):
    health, rows = health_of(lab, 20), gauge_rows(lab, lab.arm.gauges)
    out = []
    for k in range(40):
        strain = rows @ swing(k)
        if k == 5:
            strain[1] = NAN
        health.update(strain)
        assert_allclose(health.amplitudes(strain), swing(k), rtol=1e-9, atol=1e-15)
        out.append(health.lost)
    assert out == [()] * 5 + [(1,)] * 20 + [()] * 15


def test_gauges_of_another_link_give_theirs_and_the_unobserved_modes_are_named(two_link):
    health = health_of(two_link)
    strain = np.array([1e-5, 1e-5, NAN, 1e-5])
    health.update(strain)
    with pytest.raises(MessageError) as error:
        health.amplitudes(strain)
    assert "link2_y_mode1, link2_y_mode2" in str(error.value)
    assert "link1_y" not in str(error.value)


# --------------------------------------------------------------------------- stuck


def run(health, arm, count, change=lambda k, strain: None, delta=swing, seed=1):
    """Feed `count` samples, without noise if the seed is None; the health of each, and the last readings."""
    random, out = None if seed is None else np.random.default_rng(seed), []
    for k in range(count):
        strain = readings(arm, delta(k), random)
        change(k, strain)
        health.update(strain)
        out.append(health.health.copy())
    return np.array(out), strain


@pytest.mark.parametrize("which", range(4))
def test_a_gauge_that_stands_still_while_the_others_move_is_stuck(lab, which):
    health = health_of(lab, 50)

    def stick(k, strain):
        if k >= 100:
            strain[which] = 37 * COUNT

    states, strain = run(health, lab, 500, stick)
    others = np.delete(states, which, axis=1)
    # it fits ill before it is found out
    assert (
        not others.any() and not states[:100].any() and set(states[:149, which]) <= {GOOD, SUSPECT}
    )
    assert states[-1, which] == STUCK
    assert_allclose(health.amplitudes(strain), swing(499), atol=5e-4)
    assert health.lost == (which,)


@pytest.mark.parametrize(
    ("count", "speed", "seed"),
    [(200, 0.0, None), (400, 0.0, 1), (3000, 1e-6, None)],
    ids=["quiet rest", "noisy rest", "within counts"],
)
def test_rest_and_slow_motion_are_not_taken_for_stuck_gauges(lab, count, speed, seed):
    """In slow motion the outer gauge keeps its count for long while the root goes through several."""
    states, _ = run(
        health_of(lab), lab, count, delta=lambda k: np.array([speed * k, 0.0]), seed=seed
    )
    assert not states.any()


@pytest.mark.parametrize(
    ("which", "value"), [([2], 1e-3), ([2], 0.4e-3), ([2], NAN), ([2], INF), ([0, 2], 1e-3)]
)
def test_gauges_that_jump_do_not_make_the_others_stuck(lab, which, value):
    """At rest, quiet: a wire breaks, or something in mid-range does; the ends of two ranges witness no motion."""
    health = health_of(lab)
    for k in range(200):
        strain = np.full(4, 5 * COUNT)
        if k > 100:
            strain[which] = value if k % 2 else -value
        health.update(strain)
        assert not np.delete(health.health, which).any()
    assert (health.health[which] == SATURATED).all() == (value == 1e-3)


def test_of_two_gauges_the_one_that_stands_still_is_stuck_and_refused(arm_r):
    health = health_of(arm_r, 50)
    rows = gauge_rows(arm_r, arm_r.arm.gauges)
    for k in range(300):
        strain = rows @ swing(k)
        strain[0] = 1e-5
        health.update(strain)
    assert_array_equal(health.health, [STUCK, GOOD])
    with pytest.raises(MessageError, match=r"strain of root: 1e-05 .* without root \(stuck\)"):
        health.amplitudes(strain)
    health.update(rows @ swing(300))  # it moves: good, and needed
    assert_allclose(health.amplitudes(rows @ swing(300)), swing(300), rtol=1e-9)


def test_the_min_travel_is_the_ratio_of_the_rows(lab):
    rows = np.array([[2.0, 6.0], [1.0, -2.0], [0.0, 3.0]])
    gauges = (*lab.arm.gauges[:2], replace(lab.arm.gauges[2], direction="z"))
    assert_array_equal(
        gauge_health.min_travel(rows, gauges), [[0.0, 2.0, 0.0], [1.0 / 3.0, 0.0, 0.0], [0.0] * 3]
    )


# --------------------------------------------------------------------------- suspect


def test_noise_as_stated_makes_no_gauge_suspect_and_its_residual_is_one(lab):
    health = health_of(lab, 200)
    states, _ = run(health, lab, 3000)
    assert not states.any()
    assert_allclose(np.sqrt(health._square), 1.0, atol=0.25)


@pytest.mark.parametrize("which", range(4))
def test_the_gauge_whose_bias_is_wrong_is_suspect_by_name_and_still_used(lab, which):
    health = health_of(lab, 50)

    def shift(k, strain):
        strain[which] += 60e-6

    states, strain = run(health, lab, 300, shift)
    assert_array_equal(states[-1], np.where(np.arange(4) == which, SUSPECT, GOOD))
    assert_array_equal(health.amplitudes(strain), StrainMap(lab).amplitudes(strain))
    assert health.lost == ()
    assert f"gauge {lab.arm.gauge_names[which]} does not fit the others" in health.warnings()[0]


def test_without_redundancy_no_gauge_is_suspect(arm_r):
    health = health_of(arm_r)
    for k in range(300):
        health.update(np.array([1e-4 * np.sin(k), -1e-4 * np.cos(0.3 * k)]))
    assert not health.health.any()


# --------------------------------------------------------------------------- bias


def push(calibration, arm, count, seed=2, **fields):
    """Samples of an arm at rest; fields (values or functions of k) replace what it would give."""
    random = np.random.default_rng(seed)
    n, g = arm.n_joints, len(arm.arm.gauges)
    for k in range(count):
        s = ArmSample(n, arm.n_modes, g)
        s.torque[:] = 0.0
        s.strain[:] = readings(arm, np.zeros(arm.n_modes), random)
        for name, value in fields.items():
            getattr(s, name)[:] = value(k) if callable(value) else value
        calibration.push(s)


def calibration_of(arm, samples=100):
    return BiasCalibration(arm, StrainMap(arm), samples)


def test_the_bias_is_the_mean_reading_of_an_arm_at_rest(lab):
    c, wanted = calibration_of(lab, 400), np.array([20e-6, -35e-6, 0.0, 3e-6])
    random = np.random.default_rng(5)
    push(c, lab, 400, strain=0.0)
    for row in c._strain:
        row[:] = wanted + NOISE * random.standard_normal(4)
    assert_allclose(c.bias(), c._strain.mean(axis=0), rtol=1e-12)
    assert_allclose(c.bias(), wanted, atol=4.0 * NOISE / np.sqrt(400))


def test_the_strain_of_the_arms_own_weight_is_no_bias(heavy_arm):
    """By hand: the moment of beam and payload at the clamp, c M / EI, is what the gauge reads beyond its bias."""
    c, q = calibration_of(heavy_arm, 10), np.array([0.4])
    delta = heavy_arm.static_deflection(q)
    rows = gauge_rows(heavy_arm, heavy_arm.arm.gauges)
    link, payload = heavy_arm.arm.links[0], heavy_arm.arm.payload.mass
    moment = -9.81 * np.cos(0.4) * link.length * (0.5 * link.mass + payload)
    root = -0.00238125 * moment / link.stiffness["y"]
    assert_allclose((rows @ delta)[0], root, rtol=0.1)  # two modes' curvature at the clamp
    assert abs(root) > 100e-6
    push(c, heavy_arm, 10, strain=rows @ delta + np.array([12e-6, -7e-6]), position=0.4)
    assert_allclose(c.bias(), [12e-6, -7e-6], rtol=1e-9)


def test_gains_stay_in_the_expected_strain(heavy_arm):
    gauges = tuple(replace(g, gain=2.0) for g in heavy_arm.arm.gauges)
    arm = model.build(replace(heavy_arm.arm, gauges=gauges))
    delta = arm.static_deflection(np.zeros(1))
    c = calibration_of(arm, 10)
    push(c, arm, 10, strain=2.0 * gauge_rows(arm, gauges) @ delta + 5e-6)
    assert_allclose(c.bias(), [5e-6, 5e-6], rtol=1e-9)


def test_too_few_samples_are_counted(lab):
    c = calibration_of(lab, 100)
    push(c, lab, 57)
    with pytest.raises(MessageError, match="not enough samples yet") as refused:
        c.bias()
    assert (refused.value.value, refused.value.limit) == (57, 100)
    push(c, lab, 43)
    c.bias()
    c.reset()
    with pytest.raises(MessageError, match=r"0 are not enough samples yet"):
        c.bias()


MOVING = [
    ("velocity of joint1", 0.02, 0.01, {"velocity": 0.02}),
    ("velocity of joint1", NAN, 0.01, {"velocity": NAN}),
    ("change of position of joint1", 0.006, 0.00507, {"position": lambda k: 0.003 * np.sin(0.1 * k)}),
    ("change of torque of joint1", 1.1, 0.678, {"torque": lambda k: 1.1 * (k > 40)}),
    ("rms strain of root", 6.97, 2.08, {"strain": lambda k: [1e-5 * np.sin(0.2 * k), 0.0, 0.0, 0.0]}),
    ("strain of middle", NOT_GIVEN, None, {"strain": lambda k: [0.0, 0.0, NAN if k == 50 else 0.0, 0.0]}),
    ("strain of quarter", -1000.0, None, {"strain": [0.0, -1e-3, 0.0, 0.0]}),
]  # fmt: skip


@pytest.mark.parametrize(("field", "value", "limit", "samples"), MOVING)
def test_an_arm_that_is_not_at_rest_is_not_calibrated(lab, field, value, limit, samples):
    c = calibration_of(lab)
    push(c, lab, 100, **samples)
    with pytest.raises(MessageError) as error:
        c.bias()
    assert (error.value.field, error.value.limit) == (field, limit)
    assert repr(error.value.value) == repr(value)
    push(c, lab, 100)  # only the last samples count
    c.bias()


def test_an_unknown_torque_and_an_encoders_flicker_are_rest(lab):
    c, step = calibration_of(lab), 2.0 * np.pi / 4096
    flicker = {"position": lambda k: step * (k % 2), "velocity": lambda k: 0.77 * (-1) ** k}
    push(c, lab, 100, torque=NAN, **flicker)
    c.bias()


def test_a_calibration_is_described_in_microstrain_and_as_lines_of_the_arm_file():
    text = gauge_health.calibration_text(("a", "b"), np.zeros(2), np.array([1.5e-5, -2e-7]), 200)
    assert text == (
        "bias [microstrain]: a +15.00 (was +0.00), b -0.20 (was +0.00); mean of 200 samples"
    )
    lines = gauge_health.calibration_yaml(("a", "b"), np.array([1.5e-5, -2e-7]))
    assert lines == "bias: 1.5000e-05  # gauge a\nbias: -2.0000e-07  # gauge b"


# --------------------------------------------------------------------------- in the observer


def observed(arm, **options):
    return observe(arm, "filtered_derivative", options)


def sample(arm, k, strain, amplitude=None):
    s = ArmSample(1, 2, len(arm.arm.gauges))
    s.stamp_ns, s.session, s.sequence = 10**9 + k * MS, 1, k
    s.torque[:] = 0.0
    s.strain[:] = strain
    s.amplitude = amplitude
    return s


def test_after_a_calibration_strains_are_mapped_here_and_the_rate_does_not_jump(lab):
    core, bias = observed(lab, calibration_samples=50), np.array([20e-6, -35e-6, 5e-6, 3e-6])
    wrong = StrainMap(lab).amplitudes(bias)
    assert np.abs(wrong).max() > 1e-4  # [m]
    for k in range(60):
        core.step(sample(lab, k, bias, wrong.copy()))
    assert_allclose(core.observer.amplitude, wrong)
    old, new = core.calibrate()
    assert_array_equal(old, np.zeros(4))
    assert_allclose(new, bias, rtol=1e-12)
    for k in range(60, 70):
        core.step(sample(lab, k, bias, wrong.copy()))  # the source goes on sending its own
        assert_allclose(core.observer.amplitude, 0.0, atol=1e-15)
        assert_allclose(core.observer.rate, 0.0, atol=1e-12)
    # and the maps without a gauge have the new bias too
    strain = bias.copy()
    strain[1] = NAN
    core.step(sample(lab, 70, strain))
    assert_allclose(core.observer.amplitude, 0.0, atol=1e-15)


def test_a_refused_calibration_changes_nothing_and_repeated_samples_do_not_count(lab):
    core = observed(lab, calibration_samples=50)
    for k in [0] * 100 + list(range(1, 49)):
        core.step(sample(lab, k, np.full(4, 1e-5)))
    with pytest.raises(MessageError, match=r"49 are not enough samples yet \(50\)"):
        core.calibrate()
    assert not core.calibrated
    assert_array_equal(core.strain_map.bias, np.zeros(4))


def test_given_amplitudes_are_used_whatever_the_gauges_are(lab):
    core = observed(lab)
    core.step(sample(lab, 0, np.full(4, NAN), np.array([0.01, 0.002])))
    assert_array_equal(core.observer.amplitude, [0.01, 0.002])
    assert_array_equal(core.gauges.health, [MISSING] * 4)


def test_a_sample_refused_for_its_gauges_leaves_the_estimate_as_it_was(arm_r):
    core, clean = observed(arm_r), observed(arm_r)
    for k in range(20):
        strain = np.array([1e-5, 2e-5]) * np.sin(0.1 * k)
        if k == 10:
            with pytest.raises(MessageError, match="strain of middle: nan"):
                core.step(sample(arm_r, k, np.array([strain[0], NAN])))
            continue
        core.step(sample(arm_r, k, strain))
        clean.step(sample(arm_r, k, strain))
        assert_array_equal(core.observer.rate, clean.observer.rate)
    assert core.gauges.lost == ()
