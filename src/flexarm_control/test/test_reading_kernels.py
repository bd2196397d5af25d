# SPDX-License-Identifier: Apache-2.0
"""What is compiled for the checks of the readings gives what numpy gives, on random samples."""

import sys

import numpy as np
import pytest

from flexarm_control import kernels
from flexarm_control.kernels import readings, strains
from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import observe
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model as models

COMPILED = kernels.compiled()
N, M, G = 2, 3, 4
INF = np.inf


@pytest.fixture(params=range(20))
def random(request):
    return np.random.default_rng(request.param)


def sometimes(random, values, other, chance=0.3):
    """`values`, some of them replaced."""
    return np.where(random.random(np.shape(values)) < chance, other, values)


def test_readings_are_gathered_in_their_order(random):
    groups = [random.normal(size=k) for k in (N, G, M, N, M)]
    value, raw = np.zeros(2 * N + G + 2 * M), np.zeros(2 * N + G)
    COMPILED.gather(*groups, value, raw)
    np.testing.assert_array_equal(value, np.concatenate(groups))
    np.testing.assert_array_equal(raw, np.concatenate([groups[0], groups[1], groups[3]]))


def test_a_torque_steps_from_the_last_one_and_the_step_fades(random):
    torque = sometimes(random, random.normal(size=N), random.choice([np.nan, 0.0, INF]))
    torques, strength = np.vstack([random.normal(size=(2, N)) ** 2, np.zeros((2, N))]), np.ones(N)
    torques[readings.LAST] = sometimes(random, torques[readings.LAST], np.nan)
    value, rows = random.normal(size=5), np.zeros((9, 5))
    COMPILED.arrive(value, torque, strength, rows, torques)
    np.testing.assert_array_equal(rows[readings.CAME], value)
    if np.isfinite(torque).all() and torque.any():
        step = np.abs(torque - torques[readings.LAST])
        step = np.maximum(np.where(np.isnan(step), strength, step), 0.7 * torques[readings.CHANGE])
        np.testing.assert_array_equal(torques[readings.NEW], torque)
        np.testing.assert_array_equal(torques[readings.NEW_CHANGE], step)
    else:
        assert np.isnan(torques[readings.NEW]).all()
        np.testing.assert_array_equal(torques[readings.NEW_CHANGE], strength)


def test_readings_that_were_replaced_are_counted_and_teach_no_noise(random):
    size = 6
    rows, replaced = random.normal(size=(9, size)) ** 2, random.random(size) < 0.4
    rows[readings.RESIDUAL] = sometimes(random, rows[readings.RESIDUAL], np.nan)
    counts, often = random.integers(0, 3, (2, size)), random.random(size)
    before, was, counted, seen = rows.copy(), replaced.copy(), counts.copy(), often.copy()
    COMPILED.learn_jumps(rows, replaced, counts, often, 1.7, False, 0.1, 0.9, 0.8)
    residual = np.nan_to_num(before[readings.RESIDUAL])
    noise = before[readings.NOISE]
    square = np.where(was, 0.0, np.minimum(residual, 0.5 * noise) / 1.7) ** 2
    excess = (residual - 0.5 * noise - before[readings.FLOOR]) / before[readings.SCALE]
    excess = np.maximum(0.9 * before[readings.EXCESS], np.where(was, 0.0, excess))
    old = before[readings.SQUARE]
    np.testing.assert_allclose(rows[readings.SQUARE], old + 0.1 * (square - old), rtol=1e-13)
    np.testing.assert_allclose(rows[readings.EXCESS], excess, rtol=1e-13)
    np.testing.assert_array_equal(counts[readings.RUN], (counted[readings.RUN] + 1) * was)
    np.testing.assert_array_equal(
        counts[readings.GRACE], np.maximum(counted[readings.GRACE] - 1, 0)
    )
    np.testing.assert_allclose(often, 0.8 * seen + was, rtol=1e-15)
    assert not replaced.any()


def test_a_reading_stands_still_that_is_the_same_and_not_at_an_end_of_its_range(random):
    size, now = 8, random.normal(size=8)
    last = np.stack([sometimes(random, random.normal(size=size), now), np.zeros(size)])
    now = sometimes(random, now, np.nan, 0.1)
    middle, half = np.zeros(size), sometimes(random, np.full(size, 0.5), INF)
    still, smallest = random.integers(0, 5, size), sometimes(random, np.full(size, 0.1), INF)
    changes, same = random.random(size), np.zeros(size, bool)
    change = np.abs(now - last[0])
    stands = (change == 0.0) & ~(np.abs(now - middle) >= half)
    wanted = np.where(stands, still + 1, 0), np.where(stands, changes, change)
    least = np.where(stands, smallest, np.fmin(smallest, change))
    assert COMPILED.changed(now, last, middle, half, same) == stands.any()
    COMPILED.follow_changes(last[1], same, still, smallest, changes)
    np.testing.assert_array_equal(same, stands)
    np.testing.assert_array_equal(last, [now, change])
    np.testing.assert_array_equal(still, wanted[0])
    np.testing.assert_array_equal(changes, wanted[1])
    np.testing.assert_array_equal(smallest, least)


def test_joints_should_move_by_what_the_torque_leaves_of_weight_friction_and_bending(random):
    torque = random.choice([0.0, 1.0]) * random.normal(size=N)
    amplitude = sometimes(random, random.normal(size=M), np.nan, 0.1)
    inertia, bent, rows = random.normal(size=(N, N)), random.normal(size=(N, M)), np.zeros((3, N))
    rows[:] = 0.1 * random.normal(size=(3, N))
    rows[2], friction, travel = np.abs(rows[2]), np.full(N, 0.1), np.full(N, 1e-6)
    still, moved = random.integers(0, 9, N), 1e-6 * random.normal(size=(2, N))
    weight, pushed, noise = rows
    of_links = pushed + bent @ amplitude if np.isfinite(amplitude).all() else np.zeros(N)
    unsure = friction + 0.4 * (np.abs(weight) + np.abs(of_links)) + noise
    wanted = inertia @ (torque - weight + of_links)
    left = np.maximum(np.abs(wanted) - np.abs(inertia) @ unsure, 0.0) * torque.any()
    speed = np.where(still <= 1, 0.0, moved[0]) + 1e-3 * np.sign(wanted) * left
    angle = np.where(still <= 1, 0.0, moved[1]) + 1e-3 * speed
    found = np.zeros(N, bool)
    some = COMPILED.follow_joints(
        1e-3, torque, amplitude, inertia, rows, bent, (friction, 0.4), travel, still, 6, moved, found
    )  # fmt: skip
    np.testing.assert_allclose(moved, [speed, angle], rtol=1e-12, atol=1e-18)
    np.testing.assert_array_equal(found, (still >= 6) & (np.abs(moved[1]) > travel))
    assert some == found.any()


def test_gauges_and_velocities_are_found_that_stop_at_once_or_longer_than_their_noise_allows(
    random,
):
    size, end = 2 * N + G, N + G
    now = sometimes(random, random.normal(size=size), 0.0)
    still = random.integers(random.choice([0, 6]), 15, size)
    smallest, tiny = 0.1 * random.random(size), np.full(size, 1e-3)
    changes, found = random.random((8, size)), np.zeros(size, bool)
    gauges = np.stack([random.random(G), sometimes(random, random.random(G), INF), np.full(G, 9.0)])
    quiet, mean, at = still >= 6, changes.mean(axis=0), int(random.integers(8))
    order = (at - 1 - still - np.arange(2)[:, None]) % 8
    slow = changes[order, np.arange(size)].max(axis=0) <= 6.0 * smallest
    abrupt = quiet & (mean > 6.0 * smallest) & (mean > tiny) & ~(slow & (still < 12))
    silent = (gauges[0] >= 0.5 * gauges[1]) & (still[N:end] >= gauges[2])
    wanted = np.concatenate([[False] * N, abrupt[N:end] | silent, abrupt[end:] & (now[end:] != 0)])
    frame = COMPILED.stopped(now, still, smallest, changes, at, tiny, gauges, (6, 6.0), found)
    assert frame == (quiet[:end].all() and abrupt[:end].any())
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("bad", [np.nan, INF, -2.0, None])
@pytest.mark.parametrize("group", range(4))
def test_a_sample_is_refused_if_one_reading_is_no_number_or_too_large(random, group, bad):
    groups = [random.uniform(-1.0, 1.0, k) for k in (N, N, M, M)]
    if bad is not None:
        groups[group][random.integers(groups[group].size)] = bad
    assert COMPILED.below(1.5, *groups) == (bad is None)
    assert COMPILED.is_beyond(groups[group], 1.5) == (bad is not None and bad == bad)


@pytest.mark.parametrize("bad", [np.nan, INF, None])
@pytest.mark.parametrize("group", range(4))
def test_a_state_is_joined_whole_or_not_at_all(random, group, bad):
    groups, out = [random.normal(size=k) for k in (N, M, N, M)], np.zeros(2 * (N + M))
    if bad is not None:
        groups[group][-1] = bad
    assert COMPILED.join(*groups, out) == (bad is None)
    np.testing.assert_array_equal(out, np.concatenate(groups) if bad is None else 0.0)


def test_a_derivative_is_filtered_as_its_equation_has_it(random):
    last, now, rate = random.normal(size=(3, M))
    slope = (now - last) / 1e-3
    wanted = slope + (rate - slope) * np.exp(-0.5)
    COMPILED.filtered_derivative(now, 1e-3, 500.0, last, rate)
    np.testing.assert_allclose(rate, wanted, rtol=1e-12)
    np.testing.assert_array_equal(last, now)


def test_a_row_of_readings_is_kept(random):
    groups, out = [random.normal(size=k) for k in (N, N, N, G)], np.zeros(3 * N + G)
    COMPILED.keep(*groups, out)
    np.testing.assert_array_equal(out, np.concatenate(groups))


def test_rates_are_compared_if_one_is_given():
    value = np.array([1.0, np.nan, np.nan])
    assert COMPILED.is_given(value, np.array([1, 0]))
    assert not COMPILED.is_given(value, np.array([1, 2]))


def test_what_the_motion_does_not_explain_is_the_laws_residual(random):
    size = G + N + M
    low, corner = random.normal(size=(5, size)), 40.0
    drive, load, turn, bend = (random.normal(size=(G, k)) for k in (N, G, G, M))
    moved, residual = np.zeros(G + N), np.zeros((2, G))
    COMPILED.not_explained(low, corner, drive, load, turn, bend, moved, residual)
    first = corner * (low[3] - low[4])
    second = corner**2 * (low[2] - 2.0 * low[3] + low[4])
    p = drive @ second[G : G + N] + bend @ low[4, G + N :]
    np.testing.assert_allclose(moved, second[: G + N], rtol=1e-12)
    np.testing.assert_allclose(residual[1], p, rtol=1e-10)
    wanted = low[4, :G] + load @ second[:G] + turn @ first[:G] + p
    np.testing.assert_allclose(residual[0], wanted, rtol=1e-10)


@pytest.mark.parametrize("learns", [True, False])
def test_a_drift_is_low_passed_and_bounded_by_what_a_payload_may_do(random, learns):
    residual, moved = random.normal(size=G), random.normal(size=G + N)
    position, start = random.normal(size=(2, N))
    drive, load = 0.1 * random.random((G, N)), 0.1 * random.random((G, G))
    doubted, rows = random.random(G) < 0.5, random.random((8, G))
    rows[strains.LEAST] = 0.5
    before = rows.copy()
    moving = drive @ np.abs(moved[G:]) + load @ np.abs(moved[:G])
    learnt = learns and bool((moving < 0.5).all())
    zero = before[strains.ZERO]
    zero = zero + learnt * (residual - zero) / 3
    slow = before[strains.SLOW] + 0.1 * (residual - before[strains.SLOW])
    moves = before[strains.MOVING] + 0.1 * (moving - before[strains.MOVING])
    turned = min(np.abs(position - start).sum(), 2.0)
    bound = 0.5 + moves + turned * before[strains.BY_WEIGHT]
    taken = before[strains.CORRECTION]
    taken = taken + 0.2 * (np.where(doubted, residual - zero, 0.0) - taken)
    found = COMPILED.follow_drift(
        residual, moved, position, start, drive, load, doubted, rows, (2, 0.1, 0.2, learns, 1e-3)
    )
    assert found == (learnt, bool((np.abs(slow - zero) > bound).any()))
    wanted = (zero, slow, moves, slow - zero, bound, np.where(np.abs(taken) < 5e-4, 0.0, taken))
    np.testing.assert_allclose(rows[strains.ZERO :], wanted, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("first", [True, False])
def test_strains_are_high_passed_and_their_misfit_is_counted(random, first):
    moments, corner, k, keep = 2, 40.0, 0.2, 0.9
    low, force = random.normal(size=(5, G + N + M + moments * G)), random.normal(size=G)
    slow, fast = random.normal(size=(4 + 3 * moments, G)), np.zeros((4 + 3 * moments, G))
    read = low[4], corner * (low[3] - low[4]), corner**2 * (low[2] - 2.0 * low[3] + low[4])
    young = [x[-moments * G :].reshape(moments, G) for x in read]
    raw = np.vstack([*(x[:G] for x in read), force, *young])
    was = np.vstack([raw[:4], np.zeros((3 * moments, G))]) if first else slow.copy()
    COMPILED.high_passed(low, corner, force, slow, fast, k, first)
    np.testing.assert_allclose(slow, was + k * (raw - was), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(fast, raw - slow, rtol=1e-12)

    project, load, turn = random.normal(size=(3, G, G))
    groups = np.equal.outer(*[np.arange(G) // 2] * 2)
    sums, run, noise = random.random((2, G)), random.integers(0, 4, G), random.random(G)
    strain, rate, acceleration, p = fast[:4]
    z = project @ strain + turn @ rate + load @ acceleration
    means = keep * sums + (1.0 - keep) * np.stack([(z + p) ** 2, z * z + p * p])
    misfit, total = means @ groups
    doubtful = (total > 4.0 * noise) & (misfit > 0.9 * total)
    counted = np.where(doubtful, run + 1, 0)
    limits = (2.0, 0.9, 3)
    long = COMPILED.follow_misfit(fast, project, load, turn, groups, sums, keep, run, noise, limits)
    np.testing.assert_allclose(sums, means, rtol=1e-10)
    np.testing.assert_array_equal(run, counted)
    assert long == (counted >= 3).any()


def test_the_noise_of_the_law_is_summed_over_a_link(random):
    gauge, encoder = random.random(G), random.random(N)
    drive, load, turn = (random.normal(size=(G, k)) for k in (N, G, G))
    groups = np.equal.outer(*[np.arange(G) // 2] * 2)
    noise = gauge + 16.0 * (load**2 @ gauge + drive**2 @ encoder) + 4.0 * turn**2 @ gauge
    found = COMPILED.noise_of_law(gauge, encoder, 4.0, drive, load, turn, groups)
    np.testing.assert_allclose(found, noise @ groups, rtol=1e-12)


def test_strains_at_an_end_of_their_range_are_not_picked_up():
    strain, position, now = np.array([0.1, -0.2]), np.array([1.0]), np.full(7, 9.0)
    half = np.ones(2)
    assert COMPILED.pick_up(strain, position, np.zeros(2), half, 1, now)
    assert now.tolist() == [0.1, -0.2, 1.0, 9.0, 9.0, 0.1, -0.2]
    half[1] = 0.2
    assert not COMPILED.pick_up(2.0 * strain, position, np.zeros(2), half, 1, now)
    assert now[0] == 0.1


@pytest.mark.parametrize("name", ["R", "long_reach"])
def test_a_warm_up_loads_what_the_samples_of_a_moving_arm_call(name, monkeypatch):
    """Nothing is compiled, or read from a file, on the control path."""
    monkeypatch.delitem(sys.modules, COMPILED.__name__)  # of which other tests have loaded parts
    own = kernels.compiled.__wrapped__()
    monkeypatch.setattr(kernels, "compiled", lambda: own)
    model = models.build(arm_file.load(name))
    observe(model, "filtered_derivative", {}).warm_up()
    loaded, observer = signatures(own), observe(model, "filtered_derivative", {})
    n, g = model.n_joints, len(model.arm.gauges)
    sample, draw = ArmSample(n, model.n_modes, g), np.random.default_rng(0)
    for k in range(1500):
        sample.stamp_ns, sample.sequence = 1_000_000 * (k + 1), k
        sample.position[:], sample.velocity[:] = 0.3 * np.sin(3e-3 * k), 0.9 * np.cos(3e-3 * k)
        sample.torque[:], sample.rate = np.sin(0.1 * k), None
        sample.strain = 1e-5 * draw.normal(size=g) * (k % 400 > 40)  # stands still now and then
        sample.amplitude = None if k % 300 < 100 else np.zeros(model.n_modes)
        sample.trust, sample.doubt, sample.velocity_known = ArmSample.TRUSTED, "", k % 500 > 50
        observer.step(sample, later=True)
        observer.look_ahead()
    assert signatures(own) == loaded


def signatures(module):
    """Number of argument types that each compiled function has been loaded for."""
    found = {k: getattr(v, "signatures", None) for k, v in vars(module).items()}
    return {name: len(types) for name, types in found.items() if types is not None}
