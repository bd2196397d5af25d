# SPDX-License-Identifier: Apache-2.0
"""Observers of the modal rates: what they assume, how exact they are, how they start."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import OBSERVERS, design_observer
from flexarm_dynamics import registry
from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.singular_perturbation import fast_subsystem


def sample(amplitude, rate=None, torque=0.0, position=0.0, velocity=0.0):
    return SimpleNamespace(
        amplitude=np.array(amplitude, float),
        rate=None if rate is None else np.array(rate, float),
        torque=np.array([torque]),
        position=np.array([position]),
        velocity=np.array([velocity]),
        strain=1e-3 * np.array(amplitude, float),
    )


def irregular_steps(count, seed=1):
    """Time steps as the stamps of a jittering driver give them: whole nanoseconds, 0.3 to 2.5 ms."""
    steps = 1e-9 * np.random.default_rng(seed).integers(300_000, 2_500_000, count)
    steps[1::7] = 1.000e-3  # several that differ by a few microseconds
    steps[2::7] = 1.004e-3
    return steps


# --------------------------------------------------------------------------- filtered derivative


def filtered(arm, bandwidth=1000.0):
    return design_observer("filtered_derivative", arm, {"bandwidth": bandwidth})


def test_filtered_derivative_moves_along_the_filters_own_exponential_whatever_the_steps(arm_r):
    observer, slope, t = filtered(arm_r, 400.0), np.array([0.3, -2.0]), 0.0
    observer.update(sample([0.1, 0.1]), 0.0)
    for h in irregular_steps(60):
        t += h
        observer.update(sample(0.1 + slope * t), h)
        # omega_c s / (s + omega_c) on a ramp from rest: exact once it has settled
        assert_allclose(observer.rate, slope * -np.expm1(-400.0 * t), rtol=1e-11)
    assert observer.converged
    assert_allclose(observer.rate, slope, rtol=1e-11)
    assert_allclose(observer.amplitude, 0.1 + slope * t, rtol=1e-15)


def response(observer, w, h):
    """Rate by amplitude at the frequency w, from both modes at once: the real and the imaginary part of e^(jwt)."""
    t = h * np.arange(2000)
    for k, z in enumerate(np.exp(1j * w * t)):
        observer.update(sample([z.real, z.imag]), h if k else 0.0)
    return (observer.rate[0] + 1j * observer.rate[1]) / np.exp(1j * w * t[-1])


def test_filtered_derivative_has_the_documented_frequency_response(arm_r):
    corner, h = 500.0, 2e-4
    for w in (14.0, 90.0, 500.0):
        found = response(filtered(arm_r, corner), w, h)
        z, a = np.exp(1j * w * h), np.exp(-corner * h)
        assert_allclose(found, (z - 1.0) / h * (1.0 - a) / (z - a), rtol=1e-10)
        # a straight line between samples is all that sets it apart from the continuous filter
        continuous = 1j * w * corner / (1j * w + corner)
        assert_allclose(found, continuous, rtol=(w * h) ** 2 / 6.0 + w * corner * h**2 / 12.0)


def test_filtered_derivative_delays_a_slow_rate_by_one_time_constant(arm_r):
    corner, h, w = 1000.0, 5e-4, 2.0
    delay = -np.angle(response(filtered(arm_r, corner), w, h) / 1j) / w
    # as documented; what is left is of the order of (omega_c h)^4 / 720
    assert_allclose(delay, 1.0 / corner + corner * h**2 / 12.0, rtol=2e-4)


def test_filtered_derivative_converges_after_five_time_constants(arm_r):
    observer = filtered(arm_r, 1000.0)
    for k in range(8):
        observer.update(sample([0.0, 0.0]), 1e-3 if k else 0.0)
        assert observer.converged == (k >= 5)


# --------------------------------------------------------------------------- Luenberger


class Truth:
    """The boundary layer (11) at one joint state, under torques that are constant over each step."""

    def __init__(self, model, q=0.0, qd=0.0, start=(0.01, -0.002, 0.3, -0.5)):
        self.q, self.qd, self.z, self.torque = q, qd, np.array(start), 0.0
        self.A2, self.B2 = fast_subsystem(model.terms(np.array([q]), np.zeros(1)))
        # friction and gravity at the joint's state: -H21 f1 - H22 f2
        t = model.terms(np.array([q]), np.array([qd]))
        _, _, H21, H22 = t.partition()
        self.bias = np.concatenate([np.zeros(2), -H21 @ t.f1 - H22 @ t.f2])

    def advance(self, torque, h):
        A = np.zeros((5, 5))
        A[:4, :4], A[:4, 4] = self.A2, self.B2[:, 0] * torque + self.bias
        self.z, self.torque = (expm(A * h) @ np.append(self.z, 1.0))[:4], torque

    @property
    def rate(self):
        return self.z[2:]

    def sample(self):
        return sample(self.z[:2], None, self.torque, self.q, self.qd)


def luenberger(model, pole=300.0):
    return design_observer("luenberger", model, {"pole": pole})


def follow(observer, truth, steps, seed=2):
    """Run both; the errors of the rates and the times since the first sample."""
    torques = np.random.default_rng(seed).normal(0.0, 3.0, steps.size)
    observer.update(truth.sample(), 0.0)
    errors, converged = [observer.rate - truth.rate], [observer.converged]
    for torque, h in zip(torques, steps, strict=True):
        truth.advance(torque, h)
        observer.update(truth.sample(), h)
        errors.append(observer.rate - truth.rate)
        converged.append(observer.converged)
    return np.array(errors), np.concatenate([[0.0], np.cumsum(steps)]), converged


def test_luenberger_error_decays_as_its_pole_says_whatever_the_steps(arm_r, arm_p3, heavy_arm):
    steps = irregular_steps(40)
    cases = [(arm, pole, 0.0, 0.0, steps) for arm, pole in ((arm_r, 100.0), (arm_p3, 300.0))]
    cases += [(arm_r, 300.0, 0.0, 0.0, np.full(30, h)) for h in (1e-3, 1 / 3000, 5e-5)]
    # gravity and friction
    cases += [(heavy_arm, 300.0, *state, steps) for state in ((0.7, 0.5), (-1.2, -2.0))]
    for arm, pole, q, qd, steps in cases:
        observer, truth = luenberger(arm, pole), Truth(arm, q, qd)
        errors, t, _ = follow(observer, truth, steps)
        assert_allclose(errors, np.exp(-pole * t)[:, None] * errors[0], atol=1e-8)
        assert np.abs(errors[0]).max() > 0.3
        assert (np.abs(truth.bias).max() > 1.0) == (arm is heavy_arm)


def test_luenberger_is_exact_on_the_linear_model_once_converged(arm_r):
    observer, truth = luenberger(arm_r), Truth(arm_r)
    errors, t, converged = follow(observer, truth, irregular_steps(120))
    first = converged.index(True)
    assert t[first - 1] < 5.0 / 300.0 <= t[first]
    assert np.abs(errors[first]).max() <= np.exp(-5.0) * np.abs(errors[0]).max()
    assert_allclose(errors[-1], 0.0, atol=1e-10)
    assert_allclose(observer.innovation, 0.0, atol=1e-13)
    assert_array_equal(observer.amplitude, truth.z[:2])


def test_luenberger_sees_gravity_at_the_present_angle_not_at_a_rounded_one(heavy_arm):
    truth = Truth(heavy_arm, 0.74)
    # the stiffness that gravity adds is taken to 0.1 rad; its weight on the modes is not
    truth.A2, truth.B2 = fast_subsystem(heavy_arm.terms(np.array([0.7]), np.zeros(1)))
    errors, _, _ = follow(luenberger(heavy_arm), truth, irregular_steps(120))
    assert_allclose(errors[-1], 0.0, atol=1e-9)


def test_luenberger_does_not_remember_where_it_was_designed_first(heavy_arm):
    runs = []
    for first in (0.66, 0.74):
        observer = luenberger(heavy_arm)
        for position in (first, 0.7, 0.7, 0.7):
            observer.update(sample([0.01, 0.001], torque=1.0, position=position), 1e-3)
        observer.reset()
        for k in range(5):
            observer.update(sample([0.01 * k, 0.001], torque=1.0, position=0.71), 1e-3)
        runs.append(observer.rate.copy())
    assert_array_equal(*runs)


def test_luenberger_innovation_is_the_amplitude_that_was_not_predicted(arm_r):
    observer = luenberger(arm_r)
    observer.update(sample([0.0, 0.0]), 0.0)
    observer.update(sample([1e-4, -2e-4]), 1e-3)
    assert_allclose(observer.innovation, [1e-4, -2e-4], rtol=1e-14)


def test_luenberger_refuses_an_unknown_torque_but_for_the_first_sample(arm_r):
    observer = luenberger(arm_r)
    observer.update(sample([0.0, 0.0], torque=np.nan), 0.0)
    with pytest.raises(MessageError, match=r"joint_torque: is unknown.*filtered_derivative"):
        observer.update(sample([0.0, 0.0], torque=np.nan), 1e-3)


# --------------------------------------------------------------------------- true rates


def test_true_rates_passes_on_what_the_source_says(arm_r):
    observer = design_observer("true_rates", arm_r, {})
    observer.update(sample([0.1, 0.2], [3.0, 4.0]), 0.0)
    assert_array_equal(observer.amplitude, [0.1, 0.2])
    assert_array_equal(observer.rate, [3.0, 4.0])
    assert observer.converged


def test_true_rates_without_rates_says_what_to_do(arm_r):
    with pytest.raises(MessageError, match=r"modal_rate: is empty.*publish_rates"):
        design_observer("true_rates", arm_r, {}).update(sample([0.1, 0.2]), 0.0)


# --------------------------------------------------------------------------- all of them


@pytest.mark.parametrize("name", registry.names(OBSERVERS))
def test_after_a_reset_an_observer_is_as_new(arm_r, name):
    def run(observer):
        estimates = []
        for k in range(60):
            amplitude = [1e-3 * np.sin(0.3 * k), 1e-3 * np.sin(0.3 * k)]
            observer.update(sample(amplitude, [0.1, k], 0.5, 0.01 * k, 5.0), 2e-3 if k else 0.0)
            estimate = [*observer.amplitude, *observer.rate, *observer.covariance_diagonal]
            parameters = observer.parameters_estimated.values()
            estimates.append([*estimate, *parameters, observer.converged])
        return np.array(estimates)

    observer = design_observer(name, arm_r, {})
    assert not observer.converged
    first = run(observer)
    assert observer.converged
    observer.reset()
    assert not observer.converged
    assert_array_equal(run(observer), first)


@pytest.mark.parametrize("name", ["true_rates", "filtered_derivative", "luenberger"])
def test_an_observer_keeps_no_hold_on_the_callers_arrays(arm_r, name):
    observer, s = design_observer(name, arm_r, {}), sample([0.1, 0.2], [3.0, 4.0])
    observer.update(s, 0.0)
    s.amplitude[:], s.rate[:] = 9.0, 9.0
    assert_array_equal(observer.amplitude, [0.1, 0.2])
    assert np.all(observer.rate != 9.0)


def test_luenberger_predicts_across_a_gap_in_which_the_fastest_mode_can_turn(arm_r):
    observer = design_observer("luenberger", arm_r, {"pole": 300.0})
    gap = 3.0 / arm_r.frequencies()[-1]  # nearly half a period: no gain could correct the rates
    A2, _ = fast_subsystem(arm_r.terms(np.zeros(1), np.zeros(1)))
    sample, z, t = ArmSample(1, 2), np.array([1e-3, -1e-4, 0.0, 0.0]), 0.0
    sample.torque[:] = 0.0
    for dt in [0.0] + [1e-3] * 50 + [gap] + [1e-3] * 5:
        z = expm(A2 * dt) @ z
        sample.amplitude = z[:2].copy()
        observer.update(sample, dt)
        t += dt
        if t > 0.045:
            assert observer.converged
            assert_allclose(observer.rate, z[2:], atol=2e-5 * np.abs(z[2:]).max())


def test_a_new_observer_goes_on_from_the_old_ones_estimate(arm_r):
    old, new = (
        design_observer("filtered_derivative", arm_r, {"bandwidth": b}) for b in (1000.0, 500.0)
    )
    sample = ArmSample(1, 2)
    for k in range(50):
        sample.amplitude = np.array([1e-3 * k, 0.0])
        old.update(sample, 1e-3 if k else 0.0)
    new.resume(old)
    assert new.converged
    sample.amplitude = np.array([50e-3, 0.0])
    new.update(sample, 1e-3)
    assert_allclose(new.rate, [1.0, 0.0], rtol=1e-6)
