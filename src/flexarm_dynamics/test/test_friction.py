# SPDX-License-Identifier: Apache-2.0
"""Joint friction with breakaway, Stribeck's part, and a part of the transmitted torque."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Arm, Friction, Joint, Link, Transmission
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.linear import state_matrix
from flexarm_dynamics.models.chain import Chain
from flexarm_dynamics.models.fixed_step import METHODS
from flexarm_dynamics.models.one_link import OneLink

FRICTION = Friction(0.3, 0.5, 0.02, 0.8, 0.1)
GEAR = Transmission(850.0, 1.0)
INERTIA = 0.02 + 0.5 * 0.6**3 / 3.0


def single(friction, gear=None):
    """One rigid link without weight."""
    rotor = 1e-4 if gear else 0.0
    joint = Joint(
        "joint1", hub_inertia=0.02, rotor_inertia=rotor, gear_ratio=50.0, friction=friction,
        transmission=gear,
    )  # fmt: skip
    return Chain(Arm("single", (joint,), (Link("link1", 0.6, 0.5),)))


def level(rate, load=0.0):
    """The law, written out again."""
    return 0.5 + 0.3 * np.exp(-((rate / 0.1) ** 2)) + load


@pytest.mark.parametrize("rate", [-2.0, -0.07, 0.0, 0.01, 0.3])
def test_friction_falls_from_breakaway_to_coulombs_level(rate):
    chain = single(FRICTION)
    expected = 0.3 * rate + level(rate) * np.tanh(rate / 0.02)
    assert chain.friction(np.array([rate]))[0] == pytest.approx(expected, abs=1e-15)
    found = chain.derivative(np.array([0.0, rate]), np.array([2.0]))[1]
    assert found == pytest.approx((2.0 - expected) / INERTIA, rel=1e-12)
    assert chain.terms(np.zeros(1), np.array([rate])).f1[0] == pytest.approx(expected, abs=1e-15)
    torque = chain.inverse_dynamics(np.zeros(1), np.array([rate]), np.ones(1))
    assert torque[0] == pytest.approx(INERTIA + expected, rel=1e-12)


@pytest.mark.parametrize("rate", [-0.4, 0.2])
def test_a_part_of_the_transmitted_torque_is_friction(rate):
    chain = single(replace(FRICTION, load=0.25), GEAR)
    state = np.array([0.0, 0.004, rate, 0.5])
    transmitted = 850.0 * 0.004 + 1.0 * 0.5
    expected = 0.3 * rate + level(rate, 0.25 * transmitted) * np.tanh(rate / 0.02)
    found = chain.friction(state[2:3], state[1:2], state[3:])
    assert found[0] == pytest.approx(expected, rel=1e-12)
    motor = chain.derivative(state, np.array([2.0]))[2]
    assert motor == pytest.approx((2.0 + transmitted - expected) / 0.25, rel=1e-12)
    t = chain.terms(np.zeros(1), state[2:3], state[1:2], state[3:])
    # In the form (2) the transmission's torque is in the row of its deflection.
    assert t.f1[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("method, straight, tolerance", [
    ("rk4", True, 1e-8), ("rk4", False, 1e-8), ("dop853", True, 1e-9), ("implicit", False, 1e-4),
])  # fmt: skip
def test_every_integrator_has_the_same_friction(method, straight, tolerance):
    """A push that ends: motor and link slip, stop and hold; against scipy on equations written out here."""
    chain = single(replace(FRICTION, load=0.25), GEAR)

    def rate(t, y):
        _, x, qd, xd = y
        tau = 850.0 * x + xd
        f = 0.3 * qd + level(qd, 0.25 * abs(tau)) * np.tanh(qd / 0.02)
        qdd = (3.0 - 6.0 * t + tau - f) / 0.25
        return [qd, xd, qdd, -tau / INERTIA - qdd]

    T, count = 0.5, 10_000
    state = np.zeros(4)
    advance = chain.stepper(METHODS[method], **({} if straight else {"straight_line": False}))
    advance(state, np.array([3.0]), T / count, count, None, np.array([-3.0]))
    exact = solve_ivp(rate, (0, T), np.zeros(4), "DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    assert_allclose(state, exact, rtol=tolerance, atol=tolerance * np.abs(exact).max())
    assert abs(state[0]) > 0.1


def test_a_joint_slips_only_beyond_its_breakaway():
    chain = single(replace(FRICTION, smoothing=1e-3))
    moved = []
    for torque in (0.75, 0.85):
        state = np.zeros(2)
        chain.stepper(METHODS["implicit"])(state, np.array([torque]), 1e-3, 1000)
        moved.append(state[0])
    assert abs(moved[0]) < 5e-3 and moved[1] > 0.5


def test_a_linear_model_of_the_moving_arm_has_viscous_friction_alone():
    chain = single(replace(FRICTION, load=0.25), GEAR)
    bare = single(Friction(0.3), GEAR)
    state = np.array([0.0, 0.004, 0.0, 0.0])
    A = state_matrix(chain, state, np.zeros(1), coulomb=False)
    assert_allclose(A, state_matrix(bare, state, np.zeros(1)), atol=1e-6 * np.abs(A).max())
    steep = state_matrix(chain, state, np.zeros(1))
    assert steep[2, 2] == pytest.approx(-(0.3 + (0.8 + 0.25 * 3.4) / 0.02) / 0.25, rel=1e-6)


def test_driven_joints_have_no_friction():
    chain = single(FRICTION)
    state = np.array([0.0, 0.05])
    chain.driven_stepper(METHODS["rk4"])(state, np.zeros(1), 1e-3, 100)
    assert_allclose(state, [0.005, 0.05], atol=1e-15)


def test_the_closed_form_of_one_link_refuses_what_it_has_not():
    arm = arm_file.load("one_link")
    joint = replace(arm.joints[0], friction=FRICTION)
    with pytest.raises(ModelError, match=r"friction\.breakaway of joint1: is not in this model"):
        OneLink(replace(arm, model="one_link", joints=(joint,)))
    joint = replace(arm.joints[0], rotor_inertia=1e-4, transmission=GEAR)
    with pytest.raises(ModelError, match="transmission of joint1: is not in this model"):
        OneLink(replace(arm, model="one_link", joints=(joint,)))
