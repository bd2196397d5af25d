"""Encoder and gauges: quantisation, noise, what a gauge reads."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics import model
from flexarm_sim.sensors import Sensors


def sensors(arm, noise=False, seed=0, counts=0, sigma=0.0, **gauge):
    joint = replace(arm.arm.joints[0], encoder_counts=counts)
    gauges = tuple(replace(g, noise=sigma, **gauge) for g in arm.arm.gauges)
    return Sensors(model.build(replace(arm.arm, joints=(joint,), gauges=gauges)), noise, seed)


def strains(s, delta=(0.0, 0.0), count=1):
    return np.array([s.strain(np.array(delta), np.zeros(2)) for _ in range(count)])


# --------------------------------------------------------------------------- encoder


def test_an_encoder_rounds_to_its_counts(arm_r):
    s, step = sensors(arm_r, counts=4096), 2.0 * np.pi / 4096
    angles = np.random.default_rng(3).uniform(-10.0, 10.0, 500)
    read = np.array([s.position(np.array([q]), np.zeros(1))[0] for q in angles])
    assert_allclose(read / step, np.round(read / step), atol=1e-9)
    assert np.abs(read - angles).max() <= 0.5 * step * (1.0 + 1e-12)
    assert np.abs(read - angles).max() > 0.49 * step
    assert len(set(read)) > 400


def test_without_counts_the_angle_is_read_to_the_last_bit(arm_r):
    q = np.array([1.0 / 3.0])
    assert_array_equal(sensors(arm_r).position(q, np.zeros(1)), q)


# --------------------------------------------------------------------------- gauges


def test_a_gauge_reads_minus_distance_times_curvature(arm_r):
    length, distance = 1.2192, 0.00238125  # [m]
    # clamped-free modes of unit mean square: curvature 2 beta^2 at the root
    beta = np.array([1.8751040687119611, 4.694091132974175])
    delta = np.array([0.02, -0.005])
    root = -distance / length**2 * (2.0 * beta**2) @ delta
    assert_allclose(strains(sensors(arm_r), delta)[0, 0], root, rtol=1e-10)


def test_gain_and_bias_are_the_gauges_own(arm_r):
    delta = [0.02, -0.005]
    plain = strains(sensors(arm_r), delta)
    assert_allclose(strains(sensors(arm_r, gain=1.5, bias=2e-5), delta), 1.5 * plain + 2e-5)


def test_gauge_noise_has_the_stated_rms_no_bias_and_no_memory(arm_r):
    values = strains(sensors(arm_r, True, 1, sigma=2e-6), count=20_000)
    assert_allclose(values.std(axis=0), 2e-6, rtol=0.02)
    assert np.abs(values.mean(axis=0)).max() < 4.0 * 2e-6 / np.sqrt(20_000)
    correlation = np.corrcoef(np.vstack([values.T, np.roll(values, 1, axis=0).T]))
    assert np.abs(correlation - np.eye(4)).max() < 0.04


def test_gauge_noise_is_the_same_for_the_same_seed_and_after_a_reset(arm_r):
    first = sensors(arm_r, True, 7, sigma=1e-6)
    values = strains(first, count=50)
    assert_array_equal(strains(sensors(arm_r, True, 7, sigma=1e-6), count=50), values)
    assert not np.array_equal(strains(first, count=50), values)
    first.reset()
    assert_array_equal(strains(first, count=50), values)
    assert not np.array_equal(strains(sensors(arm_r, True, 8, sigma=1e-6), count=50), values)


@pytest.mark.parametrize(("noise", "sigma"), [(False, 1e-6), (True, 0.0)])
def test_there_is_no_noise_unless_it_is_asked_for_and_stated(arm_r, noise, sigma):
    s = sensors(arm_r, noise, sigma=sigma)
    assert_array_equal(strains(s, count=3), np.zeros((3, 2)))


def test_a_quiet_gauge_beside_a_noisy_one_stays_quiet(arm_r):
    gauges = (arm_r.arm.gauges[0], replace(arm_r.arm.gauges[1], noise=1e-6))
    s = Sensors(model.build(replace(arm_r.arm, gauges=gauges)), True)
    values = strains(s, count=100)
    assert_array_equal(values[:, 0], np.zeros(100))
    assert values[:, 1].std() > 5e-7


def test_an_arm_without_gauges_reads_none(arm_r):
    s = Sensors(model.build(replace(arm_r.arm, gauges=())), True)
    assert s.strain(np.zeros(2), np.zeros(0)).size == 0
