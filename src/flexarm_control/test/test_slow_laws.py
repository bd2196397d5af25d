# SPDX-License-Identifier: Apache-2.0
"""Slow laws: (17) by hand, (13)-(14) as perfect model following, none."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

from flexarm_control.composite.design import SLOW, design_law
from flexarm_control.motions import profiles
from flexarm_dynamics.arm.units import POUND_FORCE_FOOT
from flexarm_dynamics.models.model import Terms
from flexarm_dynamics.singular_perturbation import slow_subsystem

# (A2) of arms R and P3: J0 + M L^2 + I0 = 0.109 + 3.1e-3 * 16 + 1 [lbf ft s^2]
M11 = 1.1586 * POUND_FORCE_FOOT  # [kg m^2]


def reference(position=0.0, velocity=0.0, acceleration=0.0):
    """A reference; numbers or one value per joint."""
    values = (position, velocity, acceleration)
    p, v, a = (np.atleast_1d(np.array(x, float)) for x in values)
    return SimpleNamespace(position=p, velocity=v, acceleration=a)


def rigid_terms(M, modes=1):
    """Terms of an arm whose joints do not feel its modes."""
    M = np.array(M, float)
    n = M.shape[0]
    whole = np.eye(n + modes)
    whole[:n, :n] = M
    joint, modal = np.zeros(n), np.zeros(modes)
    zero = np.zeros((n, modes))
    return Terms(whole, joint, modal, zero, np.zeros((modes, modes)), zero, np.eye(modes))


def two_joints(**parameters):
    model = SimpleNamespace(n_joints=2, n_modes=1)
    return design_law(SLOW, "linear_model_following", model, parameters)


def design(name, model, **parameters):
    return design_law(SLOW, name, model, parameters)


def torque_at(law, model, q, qd, ref):
    q, qd = np.atleast_1d(np.array(q, float)), np.atleast_1d(np.array(qd, float))
    return law.torque(q, qd, ref, model.terms(q, qd))


# --------------------------------------------------------------------------- (17)


def test_linear_model_following_is_17_by_hand_for_two_joints():
    law = two_joints(kp=[4.0, 9.0], kv=[2.0, 3.0])
    ref = reference([0.5, -0.25], [0.125, 0.5], [1.0, -2.0])
    torque = law.torque(
        np.array([0.25, 0.0]), np.array([0.0, 0.25]), ref, rigid_terms([[2, 1], [1, 4]])
    )
    # v = acceleration + kv (velocity error) + kp (position error) = (2.25, -3.5)
    assert_allclose(torque, [2 * 2.25 - 3.5, 2.25 - 4 * 3.5], rtol=1e-14)


def test_linear_model_following_on_the_papers_arm_multiplies_by_m11(arm_r):
    law = design("linear_model_following", arm_r)
    torque = torque_at(law, arm_r, 0.2, 0.4, reference(0.5, 1.0, 0.25))
    assert_allclose(torque, [M11 * (0.25 + 5.0 * 0.6 + 6.25 * 0.3)], rtol=1e-14)


def test_each_term_of_17_has_its_own_gain(arm_r):
    law = design("linear_model_following", arm_r, kp=[7.0], kv=[3.0])
    for ref, gain in ((reference(1.0), 7.0), (reference(0, 1.0), 3.0), (reference(0, 0, 1.0), 1.0)):
        assert_allclose(torque_at(law, arm_r, 0.0, 0.0, ref), [M11 * gain], rtol=1e-14)


def test_h11_reproduces_the_slow_poles_of_the_printed_17(arm_p3):
    ref = reference(0.5, 1.0, 0.25)
    right = torque_at(design("linear_model_following", arm_p3), arm_p3, 0, 0, ref)[0]
    law = design("linear_model_following", arm_p3, gain="h11")
    printed = torque_at(law, arm_p3, 0, 0, ref)[0]
    assert_allclose(printed / right, 1.0 / (1.1586 * 1.010133), rtol=1e-6)
    poles = np.roots([1.0, 5.0 * printed / right, 6.25 * printed / right])
    assert_allclose(sorted(poles.imag), [-0.88, 0.88], atol=0.005)
    assert_allclose(poles.real, [-2.14, -2.14], atol=0.005)


def test_under_gravity_17_does_not_depend_on_where_the_arm_was_before(heavy_arm):
    ref = reference(1.0)
    travelled, fresh = (design("linear_model_following", heavy_arm) for _ in range(2))
    torque_at(travelled, heavy_arm, -1.5, 0.0, ref)
    assert_array_equal(
        torque_at(travelled, heavy_arm, 0.3, 0.0, ref), torque_at(fresh, heavy_arm, 0.3, 0.0, ref)
    )


# --------------------------------------------------------------------------- (13)-(14)


def test_13_cancels_gravity_and_friction_on_the_slow_subsystem(heavy_arm):
    law = design("model_following", heavy_arm, kp=[9.0], kv=[4.0])
    for q, qd in ((0.3, -0.7), (-2.0, 3.0), (1.5, 0.01)):
        ref = reference(0.9, -0.4, 2.0)
        a, B = slow_subsystem(heavy_arm.terms(np.array([q]), np.array([qd])))
        acceleration = a + B @ torque_at(law, heavy_arm, q, qd, ref)
        assert_allclose(acceleration, [2.0 + 4.0 * (-0.4 - qd) + 9.0 * (0.9 - q)], rtol=1e-12)
        assert np.abs(a) > 0.1  # there was something to cancel


def test_13_follows_the_reference_model_perfectly_from_any_initial_error(heavy_arm):
    law = design("model_following", heavy_arm)
    profile = profiles.paper_profile()

    def ref(t):
        return reference(profile.position(t), profile.velocity(t), profile.acceleration(t))

    def slow_subsystem_under_control(t, x):
        q, qd = x[:1], x[1:]
        terms = heavy_arm.terms(q, qd)
        a, B = slow_subsystem(terms)
        return np.concatenate([qd, a + B @ law.torque(q, qd, ref(t), terms)])

    e0, ed0 = 0.3, -0.8
    start = [profile.position(0.0)[0] - e0, profile.velocity(0.0)[0] - ed0]
    times = np.linspace(0.0, 2.0, 41)
    result = solve_ivp(
        slow_subsystem_under_control, (0, 2), start, "DOP853", times, rtol=1e-11, atol=1e-12
    )
    error = profile.position(times)[:, 0] - result.y[0]
    # e'' + 5 e' + 6.25 e = 0: a double pole at -2.5
    assert_allclose(error, (e0 + (ed0 + 2.5 * e0) * times) * np.exp(-2.5 * times), atol=1e-10)


def test_13_keeps_a_zero_error_at_zero(heavy_arm):
    law = design("model_following", heavy_arm, kp=[0.0], kv=[0.0])
    terms = heavy_arm.terms(np.array([0.4]), np.array([1.1]))
    torque = law.torque(np.array([0.4]), np.array([1.1]), reference(0.4, 1.1, -3.0), terms)
    a, B = slow_subsystem(terms)
    assert_allclose(a + B @ torque, [-3.0], rtol=1e-12)


def test_13_is_17_where_there_is_nothing_to_compensate(arm_r):
    general, linear = design("model_following", arm_r), design("linear_model_following", arm_r)
    for qd in (0.0, 0.1, 1.5):
        args = (arm_r, 0.2, qd, reference(0.5, 1.0, 0.25))
        assert_allclose(torque_at(general, *args), torque_at(linear, *args), rtol=1e-12)


def test_13_differs_from_17_by_the_weight_under_gravity(heavy_arm):
    general, linear = (design(n, heavy_arm) for n in ("model_following", "linear_model_following"))
    args = (heavy_arm, 0.2, 0.0, reference(0.2))
    assert_allclose(torque_at(linear, *args), 0.0, atol=1e-14)
    assert torque_at(general, *args)[0] > 1.0


# --------------------------------------------------------------------------- none


def test_no_slow_law_gives_no_torque(arm_r):
    law = design("none", arm_r)
    assert_array_equal(torque_at(law, arm_r, 0.5, 1.0, reference(2.0, 1.0, 1.0)), [0.0])


@pytest.mark.parametrize("name", ["linear_model_following", "model_following", "none"])
def test_a_slow_law_leaves_its_inputs_alone(arm_r, name):
    q, qd, ref = np.array([0.2]), np.array([0.4]), reference(0.5, 1.0, 0.25)
    design(name, arm_r).torque(q, qd, ref, arm_r.terms(q, qd))
    assert (q[0], qd[0]) == (0.2, 0.4)
    assert (ref.position[0], ref.velocity[0], ref.acceleration[0]) == (0.5, 1.0, 0.25)
