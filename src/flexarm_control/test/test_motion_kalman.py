# SPDX-License-Identifier: Apache-2.0
"""The Kalman filter without torque: consistent with its assumptions, and right on an arm that is moved."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import design_observer
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import StrainMap, gauge_rows
from flexarm_dynamics.errors import MessageError, ModelError, ParameterError
from flexarm_dynamics.models import model
from flexarm_sim.integrators import METHODS

H = 5e-3  # [s]
NOISE = {
    "strain_noise": 4e-7,
    "common_noise": [2e-6],
    "common_memory": [0.3, -0.4],
    "position_noise": 1e-4,
    "jerk_noise": [5.0],
    "bending_force_noise": [0.01],
    "bias_noise": 2e-6,
}


@pytest.fixture(scope="module")
def arm():
    """The two-link arm, which is soft, under a little gravity."""
    flat = arm_file.load("two_link")
    return model.build(replace(flat, gravity=(0.0, -0.5, 0.0)))


def observer(arm, **changed):
    return design_observer("motion_kalman", arm, NOISE | changed)


def sample_of(arm, position, strain):
    sample = ArmSample(arm.n_joints, arm.n_modes, len(arm.arm.gauges))
    sample.position[:], sample.strain[:] = position, strain
    sample.amplitude = StrainMap(arm).amplitudes(np.nan_to_num(strain))
    assert np.isnan(sample.torque).all()
    return sample


def noise_of(draw, count, size):
    """Shared noise with the memory of `NOISE`, rms `size`."""
    a, b = NOISE["common_memory"]
    made = np.zeros(count + 100)
    for k in range(2, made.size):
        made[k] = a * made[k - 1] + b * made[k - 2] + draw.standard_normal()
    return size * made[100:] / np.sqrt((1 - b) / ((1 + b) * ((1 - b) ** 2 - a**2)))


@pytest.fixture(scope="module")
def moved(arm):
    """An arm whose joints follow a motion: angles, strains without noise, amplitudes and rates, 600 samples."""
    n, m, time = arm.n_joints, arm.n_modes, H * np.arange(600)
    wave = lambda t: np.array([0.4 * np.sin(2.0 * t) ** 2 + 0.3, 0.3 * np.sin(3.1 * t) ** 2 - 0.2])  # noqa: E731
    step = 1e-3
    second = lambda t: (wave(t + step) - 2.0 * wave(t) + wave(t - step)) / step**2  # noqa: E731
    advance, state = arm.driven_stepper(METHODS["dop853"]), np.zeros(2 * (n + m))
    state[:n], state[n : n + m] = wave(0.0), arm.static_deflection(wave(0.0))
    delta, rate = np.zeros((2, time.size, m))
    for k, t in enumerate(time):
        if k:
            start, end = second(t - H), second(t)
            advance(state, start, H / 40, 40, None, end - start)
        delta[k], rate[k] = state[n : n + m], state[2 * n + m :]
    gains = np.array([g.gain for g in arm.arm.gauges])
    strain = delta @ (gains[:, None] * gauge_rows(arm, arm.arm.gauges)).T
    return np.array([wave(t) for t in time]), strain, delta, rate


def run(filter_, arm, position, strain):
    """Amplitudes and rates after each sample, and the innovations squared."""
    out, squared = [], []
    for k, (q, e) in enumerate(zip(position, strain, strict=True)):
        filter_.update(sample_of(arm, q, e), H if k else 0.0)
        out.append(np.concatenate([filter_.amplitude, filter_.rate]))
        squared.append(filter_.innovation_squared)
    m = arm.n_modes
    return np.array(out)[:, :m], np.array(out)[:, m:], np.array(squared)


def test_innovations_are_as_large_as_the_noise_that_is_assumed(arm):
    """Samples drawn from the filter's own linear model, at rest without gravity."""
    still = model.build(replace(arm.arm, gravity=(0.0, 0.0, 0.0)))
    made = observer(still, jerk_noise=[0.005], position_noise=1e-6)
    draw = np.random.default_rng(5)
    step = made.motion.design(H, np.zeros(2))
    root = np.linalg.cholesky(step.Q + 1e-24 * np.eye(len(step.Q)))
    x, squared = np.zeros(len(step.Phi)), []
    noise = np.sqrt(np.diag(made.measurement_covariance))
    for k in range(1500):
        x = step.Phi @ x + root @ draw.standard_normal(x.size)
        y = made._C @ x + noise * draw.standard_normal(noise.size)
        made.update(sample_of(still, y[:2], y[2:]), H if k else 0.0)
        squared.append(made.innovation_squared)
    settled = np.array(squared[100:])
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 6 * settled.size) / settled.size
    assert low < settled.mean() < high
    assert made.converged and made.consistent


def test_amplitudes_and_rates_of_a_moved_arm_come_out_without_torque(arm, moved):
    """With a bias, own noise and a shared noise: nearer than the strain map, and rates far nearer than differences."""
    position, strain, delta, rate = moved
    draw = np.random.default_rng(2)
    bias = np.array([8e-6, -5e-6, 6e-6, -7e-6])
    noisy = strain + bias + noise_of(draw, len(strain), 2e-6)[:, None]
    noisy += 4e-7 * draw.standard_normal(strain.shape)
    found, speed, _ = run(observer(arm), arm, position, noisy)
    mapped = np.array([StrainMap(arm).amplitudes(e) for e in noisy])
    late = slice(200, None)
    rms = lambda e: np.sqrt(np.mean(e[late] ** 2, axis=0))  # noqa: E731
    assert (rms(found - delta) < [0.9, 0.3, 0.6, 0.1] * rms(mapped - delta)).all()
    assert (
        rms(speed - rate) < [0.15, 0.6, 0.15, 0.9] * rms(np.gradient(mapped, H, axis=0) - rate)
    ).all()


def test_what_is_predicted_follows_gravity_and_the_joints_motion(arm, moved):
    """Without noise the strain is known before it is measured."""
    position, strain, *_ = moved
    made, errors = observer(arm, strain_noise=1e-9, common_noise=[1e-9], position_noise=1e-7), []
    for k, (q, e) in enumerate(zip(position, strain, strict=True)):
        made.update(sample_of(arm, q, e), H if k else 0.0)
        errors.append(made.strain_innovation.copy())
    changes = np.diff(strain, axis=0)[100:]
    assert (np.std(np.array(errors)[101:], axis=0) < 0.05 * np.std(changes, axis=0)).all()


def test_a_drifting_bias_is_followed_and_published(arm, moved):
    position, strain, *_ = moved
    drift = np.linspace(0.0, 1.0, len(strain))[:, None] * np.array([20e-6, 0.0, 0.0, 0.0])
    made = observer(arm, bias_noise=2e-5, bending_force_noise=[1e-4])
    run(made, arm, position, strain + drift)
    values = [made.parameters_estimated[f"bias of {g} [strain]"] for g in arm.arm.gauge_names]
    assert values[0] == pytest.approx(20e-6, abs=10e-6)
    assert np.abs(values[2:]).max() < 6e-6  # of the other link


def test_the_memory_of_the_shared_noise_makes_predictions_better(arm, moved):
    position, strain, *_ = moved
    noisy = strain + noise_of(np.random.default_rng(4), len(strain), 2e-6)[:, None]
    rms = []
    for memory in (NOISE["common_memory"], [0.0]):
        made, errors = observer(arm, common_memory=memory), []
        for k, (q, e) in enumerate(zip(position, noisy, strict=True)):
            made.update(sample_of(arm, q, e), H if k else 0.0)
            errors.append(made.strain_innovation.copy())
        rms.append(np.sqrt(np.mean(np.array(errors)[100:] ** 2)))
    assert rms[0] < 0.95 * rms[1]


def test_past_innovations_make_predictions_better_and_leave_the_state_as_it_is(arm, moved):
    """The filter takes the shared noise for white; its memory finds out."""
    position, strain, *_ = moved
    noisy = strain + noise_of(np.random.default_rng(4), len(strain), 2e-6)[:, None]
    plain, learnt = (observer(arm, common_memory=[0.0], innovation_order=k) for k in (0, 4))
    errors = []
    for k, (q, e) in enumerate(zip(position, noisy, strict=True)):
        for made in (plain, learnt):
            made.update(sample_of(arm, q, e), H if k else 0.0)
        errors.append((learnt.strain_innovation.copy(), learnt.strain_error.copy()))
    alone, whole = np.sqrt(np.mean(np.array(errors)[200:] ** 2, axis=(0, 2)))
    assert whole < 0.95 * alone
    assert_allclose(learnt.state, plain.state, rtol=0)
    assert_allclose(plain.strain_error, plain.strain_innovation)
    learnt.update(sample_of(arm, position[-1], noisy[-1]), 3.0 * H)  # a gap: nothing follows
    assert_allclose(learnt.strain_error, learnt.strain_innovation)


@pytest.mark.parametrize("how", ["reads nothing", "is lost"])
def test_a_gauge_that_is_left_out_has_no_part_in_the_estimate(arm, moved, how):
    position, strain, delta, _ = moved
    made, spoilt = observer(arm), strain.copy()
    run(made, arm, position[:20], strain[:20])
    spoilt[:, 1] = 1.0 if how == "is lost" else np.nan
    if how == "is lost":
        made.leave_out((1,))
    errors = []
    for q, e, d in zip(position[20:], spoilt[20:], delta[20:], strict=True):
        made.update(sample_of(arm, q, e), H)
        errors.append(made.amplitude - d)
    assert np.abs(errors).max() < 0.05 * np.abs(delta).max()
    assert np.isnan(made.strain_innovation[1])
    assert np.isfinite(made.strain_innovation[[0, 2, 3]]).all()
    made.update(
        sample_of(arm, position[-1], strain[-1]), H
    )  # it reads again, but stays lost if it was
    assert np.isnan(made.strain_innovation[1]) == (how == "is lost")


def test_a_calibration_at_rest_moves_the_bias_and_not_the_links(arm):
    q = np.array([0.3, -0.2])
    rows = gauge_rows(arm, arm.arm.gauges)
    sag = arm.static_deflection(q)
    strain = rows @ sag + 5e-6
    made = observer(arm)
    for k in range(20):
        made.update(sample_of(arm, q, strain), H if k else 0.0)
    made.rest_at(sag)
    assert_allclose(made.amplitude, sag)
    values = [made.parameters_estimated[f"bias of {g} [strain]"] for g in arm.arm.gauge_names]
    assert_allclose(values, 5e-6, atol=2e-6)


def test_a_new_design_goes_on_from_the_old_estimate(arm, moved):
    position, strain, *_ = moved
    old, new = observer(arm), observer(arm, jerk_noise=[8.0])
    run(old, arm, position[:50], strain[:50])
    new.resume(old)
    assert_allclose(new.state, old.state)
    assert_allclose(new.amplitude, old.amplitude)
    other = design_observer("kalman", arm, {})
    new.resume(other)  # of another kind: it starts afresh
    new.update(sample_of(arm, position[0], strain[0]), 0.0)
    assert not new.converged


def test_what_it_can_not_work_with_is_refused(arm):
    with pytest.raises(
        ModelError, match=r"gauges: of .* are none, and observer.type motion_kalman"
    ):
        design_observer("motion_kalman", model.build(arm_file.load("rigid")), {})
    with pytest.raises(ParameterError, match=r"common_memory: \[1\.1\] is a noise that grows"):
        observer(arm, common_memory=[1.1])
    made, sample = observer(arm), sample_of(arm, np.zeros(2), np.zeros(4))
    sample.strain = None
    with pytest.raises(
        MessageError, match=r"strain: is not given, and observer.type motion_kalman"
    ):
        made.update(sample, 0.0)
