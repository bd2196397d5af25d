# SPDX-License-Identifier: Apache-2.0
"""Encoder and gauges: quantisation, noise, what a gauge reads."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.models import model
from flexarm_sim.sensors import Sensors


def sensors(arm, noise=False, seed=0, counts=0, sigma=0.0, period=0.0, **gauge):
    joint = replace(arm.arm.joints[0], encoder_counts=counts)
    gauges = tuple(replace(g, noise=sigma, **gauge) for g in arm.arm.gauges)
    changed = model.build(replace(arm.arm, joints=(joint,), gauges=gauges))
    return Sensors(changed, noise, seed, period)


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
    assert_array_equal(strains(sensors(arm_r, noise, sigma=sigma), count=3), np.zeros((3, 2)))


def test_a_quiet_gauge_beside_a_noisy_one_stays_quiet(arm_r):
    gauges = (arm_r.arm.gauges[0], replace(arm_r.arm.gauges[1], noise=1e-6))
    s = Sensors(model.build(replace(arm_r.arm, gauges=gauges)), True)
    values = strains(s, count=100)
    assert_array_equal(values[:, 0], np.zeros(100))
    assert values[:, 1].std() > 5e-7


def test_an_arm_without_gauges_reads_none(arm_r):
    s = Sensors(model.build(replace(arm_r.arm, gauges=())), True)
    assert s.strain(np.zeros(2), np.zeros(0)).size == 0


# --------------------------------------------------------------------------- bridge and drift


def test_a_bridge_rounds_to_its_counts_with_noise_or_without(arm_r):
    """12 bits over 2000 microstrain: 0.48828125 microstrain each."""
    count = 0.48828125e-6
    for noise in (False, True):
        s = sensors(arm_r, noise, sigma=1e-6, bits=12, full_scale=1e-3)
        plain = sensors(arm_r, noise, sigma=1e-6)
        for k in range(200):
            delta = np.array([2e-5 * k, -1e-6 * k])
            read, exact = strains(s, delta)[0], strains(plain, delta)[0]
            assert_allclose(read / count, np.round(read / count), atol=1e-9)
            assert np.abs(read - exact).max() <= 0.5 * count * (1.0 + 1e-9)
    assert np.abs(read - exact).max() > 0.0


def test_a_gauge_ends_at_the_ends_of_its_range(arm_r):
    s = sensors(arm_r, full_scale=2e-4)
    bent = np.array([0.1, 0.0])
    exact = strains(sensors(arm_r, full_scale=0.1), bent)[0]
    assert exact[0] < -2e-4 and abs(exact[0]) > 5e-4
    assert_array_equal(strains(s, bent)[0], np.clip(exact, -2e-4, 2e-4))
    assert strains(s, -bent)[0, 0] == 2e-4
    # a converter has one count less on the plus side
    s = sensors(arm_r, full_scale=2e-4, bits=4)
    assert_allclose([strains(s, d)[0, 0] for d in (bent, -bent)], [-2e-4, 2e-4 - 4e-4 / 16])


def test_a_range_that_is_not_stated_is_a_thousand_microstrain(arm_r):
    assert strains(sensors(arm_r), [-1.0, 0.0])[0, 0] == 1e-3


def test_the_bias_walks_by_drift_times_the_root_of_time(arm_r):
    """From 300 walks of 100 samples: the variance grows in proportion, steps are independent."""
    walking = [sensors(arm_r, True, k, period=1e-2, drift=2e-6) for k in range(300)]
    walks = np.array([strains(s, count=101) for s in walking])
    assert_array_equal(walks[:, 0], 0.0)
    for k, rms in ((1, 2e-7), (25, 1e-6), (100, 2e-6)):
        assert_allclose(walks[:, k].std(), rms, rtol=0.12)
    steps = np.diff(walks, axis=1)
    assert abs(np.corrcoef(steps[:, :-1].ravel(), steps[:, 1:].ravel())[0, 1]) < 0.02


def test_drift_starts_again_with_a_reset_and_leaves_the_noise_as_it_was(arm_r):
    def drifting(noise=True, **more):
        return sensors(arm_r, noise, 4, period=1e-3, **{"drift": 1e-6, **more})

    s = drifting()
    walk = strains(s, count=20)
    s.reset()
    assert_array_equal(strains(s, count=20), walk)
    assert_array_equal(strains(drifting(noise=False), count=3), np.zeros((3, 2)))
    still, walking = (strains(drifting(sigma=1e-6, drift=d), count=20) for d in (0.0, 1e-6))
    assert_allclose(walking - still, walk, atol=1e-20)
