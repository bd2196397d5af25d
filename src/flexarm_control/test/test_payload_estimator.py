# SPDX-License-Identifier: Apache-2.0
"""The estimate of the payload on samples of a known arm: what it finds, and when it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_control.payload.estimator import INTERVAL, PayloadEstimator
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models.model import build

HEAVY = 1.6


def weighed_arm():
    """Arm two_link under gravity, with gauges of an ordinary range and a payload that matters."""
    arm = arm_file.load("two_link")
    gauges = tuple(replace(gauge, full_scale=2e-3) for gauge in arm.gauges)
    return replace(arm, gravity=(0.0, -4.0, 0.0), gauges=gauges)


def sample(model, t):
    """Positions, amplitudes and torques of a slow motion, bent as its forces at each instant bend it."""
    q = np.array([0.4, 0.3]) + 0.3 * np.sin(t) * np.array([1.0, -1.0])
    qd = 0.3 * np.cos(t) * np.array([1.0, -1.0])
    qdd = -0.3 * np.sin(t) * np.array([1.0, -1.0])
    terms, n = model.terms(q, qd), 2
    delta = -np.linalg.solve(terms.K2, terms.f2 + terms.M[n:, :n] @ qdd)
    return q, delta, terms.f1 + terms.M[:n, :n] @ qdd + terms.K1 @ delta


def learnt(mode, moving, wrong=lambda delta: delta, payload=HEAVY, seconds=2.5):
    """An estimator that has seen `seconds` of an arm with another payload, `wrong` amplitudes in their place."""
    model = build(weighed_arm())
    plant = model.with_payload(payload)
    estimator = PayloadEstimator(model, mode, 3.0)
    dt = INTERVAL
    for k in range(round(seconds / dt)):
        q, delta, u = sample(plant, k * dt if moving else 0.0)
        if not moving:
            terms = plant.terms(q, np.zeros(2))
            delta = -np.linalg.solve(terms.K2, terms.f2)
            u = terms.f1 + terms.K1 @ delta
        estimator.note(q, wrong(delta), u, dt if k else 0.0)
        estimator.update(not moving)
    return estimator


@pytest.mark.parametrize("payload", [0.7, 1.3, 2.0])
def test_at_rest_gauges_and_torques_weigh_the_payload(payload):
    found = learnt("rest", moving=False, payload=payload)
    assert found.reason == ""
    assert found.value == pytest.approx(payload, abs=1e-6)
    assert found.low < payload < found.high
    assert found.strain[0] == pytest.approx(payload, abs=1e-6)
    assert found.torque[0] == pytest.approx(payload, abs=1e-6)


def test_in_motion_too():
    found = learnt("online", moving=True, seconds=6.0)
    assert found.reason == ""
    assert found.value == pytest.approx(HEAVY, abs=0.05)


def test_what_estimates_at_rest_learns_nothing_in_motion():
    found = learnt("rest", moving=True)
    assert np.isnan(found.value)
    assert found.reason


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (lambda delta: -delta, "strains give"),
        (lambda delta: 0.0 * delta, "strains give"),
        (lambda delta: delta * [1.0, 1.0, -1.0, -1.0], ""),
        (lambda delta: 2.0 * delta, "strains give"),
    ],
    ids=["wrong sign", "dead", "wrong sign on one link", "twice the gain"],
)
def test_gauges_that_contradict_the_torques_give_no_estimate(wrong, why):
    found = learnt("rest", moving=False, wrong=wrong)
    assert why in found.reason
    assert found.reason


def test_a_doubt_discards_what_was_learnt():
    found = learnt("rest", moving=False)
    found.discard("a sensor is in doubt: strain of root")
    assert np.isnan(found.value)
    assert found.reason == "a sensor is in doubt: strain of root"


def test_a_payload_beyond_the_limit_is_not_believed():
    found = learnt("rest", moving=False, payload=4.0)
    assert found.value == pytest.approx(4.0, abs=1e-3)
    assert "payload_limit 3" in found.reason


def test_friction_widens_the_interval_of_the_torques():
    smooth = PayloadEstimator(build(weighed_arm()), "rest", 3.0)
    arm = weighed_arm()
    joints = tuple(
        replace(j, friction=replace(j.friction, coulomb=0.2, smoothing=0.01)) for j in arm.joints
    )
    rough = PayloadEstimator(build(replace(arm, joints=joints)), "rest", 3.0)
    for estimator in (smooth, rough):
        plant = estimator._one.with_payload(HEAVY)
        q = np.array([0.4, 0.3])
        terms = plant.terms(q, np.zeros(2))
        delta = -np.linalg.solve(terms.K2, terms.f2)
        for k in range(250):
            estimator.note(q, delta, terms.f1 + terms.K1 @ delta, INTERVAL if k else 0.0)
            estimator.update(True)
    assert rough.torque[1] > 3.0 * smooth.torque[1]


def test_an_arm_without_payload_or_bending_is_refused():
    arm = weighed_arm()
    empty = replace(arm, payload=replace(arm.payload, mass=0.0, inertia=((0.0,) * 3,) * 3))
    with pytest.raises(DesignError, match=r"payload\.mass"):
        PayloadEstimator(build(empty), "rest", 3.0)
    with pytest.raises(DesignError, match="does not bend"):
        PayloadEstimator(build(arm_file.load("rigid")), "rest", 3.0)
