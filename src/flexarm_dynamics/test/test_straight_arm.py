# SPDX-License-Identifier: Apache-2.0
"""Terms of the straight arm as they are recorded and replayed, beside the recursions that they are recorded from."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Transmission, scaled
from flexarm_dynamics.kernels import straight_arm, symbols
from flexarm_dynamics.kernels.duals import Dual
from flexarm_dynamics.models import model
from flexarm_dynamics.models.chain import Chain
from flexarm_dynamics.singular_perturbation import slow_torque


def geared(arm):
    """With a transmission at the first joint, and rotors behind gears."""
    first, *others = arm.joints
    gear = Transmission(900.0, damping=0.4, play=1e-3)
    first = replace(first, rotor_inertia=1e-4, gear_ratio=50.0, transmission=gear)
    return replace(arm, joints=(first, *others))


ARMS = {
    "spatial": lambda: arm_file.load("long_reach"),
    "planar": lambda: arm_file.load("two_link"),
    "geared": lambda: geared(arm_file.load("two_link")),
    "rigid": lambda: arm_file.load("rigid"),
}


@pytest.mark.parametrize("name", ARMS)
def test_recorded_terms_are_those_of_the_recursions(name):
    chain = Chain(ARMS[name]())
    n, draw = chain.n_joints, np.random.default_rng(3)
    for _ in range(3):
        q, qd = draw.uniform(-2.0, 2.0, (2, n))
        t = chain.terms(q, qd)
        K, C = chain.linearisation(q, qd)  # by complex steps
        forces = chain.forces(q, qd)
        forces[:n] += chain.friction(qd)
        for found, wanted in (
            (t.M, chain.mass_matrix(q)),
            (np.concatenate([t.f1, t.f2]), forces),
            (np.vstack([t.K1, t.K2]), K),
            (np.vstack([t.C1, t.C2]), C),
        ):
            size = np.abs(wanted).max(initial=1e-300)
            assert np.abs(found - wanted).max(initial=0.0) < 1e-13 * size


@pytest.mark.parametrize("name", ARMS)
def test_the_slow_torque_is_that_of_all_terms(name):
    chain = Chain(ARMS[name]())
    draw = np.random.default_rng(4)
    for _ in range(5):
        q, qd, acceleration = draw.uniform(-2.0, 2.0, (3, chain.n_joints))
        wanted = slow_torque(chain.terms(q, qd), acceleration)
        found = chain.slow_torque(q, qd, acceleration)
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())


def test_the_slow_torque_takes_fewer_operations():
    chain = Chain(arm_file.load("long_reach"))
    terms, slow = (tape._record.places for tape in (chain._tape, chain._slow_tape))
    assert len(slow) < 0.7 * len(terms)
    assert slow.dtype == np.uint16  # places of 2 bytes: half as much to read


def test_arms_of_one_structure_share_a_record_and_have_their_own_numbers():
    one = Chain(arm_file.load("two_link"))
    other = Chain(scaled(one.arm, payload=1.7, stiffness=0.6))
    q, qd = np.array([0.4, -0.9]), np.array([0.3, 0.5])
    assert one._tape._record is other._tape._record
    assert np.abs(one.terms(q, qd).M - other.terms(q, qd).M).max() > 0.1
    for chain in (one, other):
        np.testing.assert_allclose(chain.terms(q, qd).M, chain.mass_matrix(q), rtol=1e-12)
    bare = Chain(scaled(one.arm, payload=0.0))
    assert bare._tape._record is not one._tape._record  # zeros are structure
    np.testing.assert_allclose(bare.terms(q, qd).M, bare.mass_matrix(q), rtol=1e-12)


def test_each_call_has_arrays_of_its_own():
    chain = Chain(arm_file.load("two_link"))
    first = chain.terms(np.zeros(2), np.zeros(2))
    M = first.M.copy()
    chain.terms(np.ones(2), np.ones(2))
    np.testing.assert_array_equal(first.M, M)


def test_duals_differentiate():
    x, y = Dual(0.7, {0: 1.0}), Dual(-0.4, {1: 1.0})
    z = 2.0 * np.sin(x * y) - np.cos(y) * x + 3.0 - (1.0 - x)
    assert z.value == pytest.approx(2 * np.sin(-0.28) - np.cos(0.4) * 0.7 + 2.0 + 0.7, rel=1e-15)
    assert z.slopes[0] == pytest.approx(2 * np.cos(0.28) * -0.4 - np.cos(0.4) + 1.0, rel=1e-15)
    assert z.slopes[1] == pytest.approx(2 * np.cos(0.28) * 0.7 + np.sin(-0.4) * 0.7, rel=1e-15)


def test_products_that_one_sum_needs_are_one_operation_with_it():
    graph = symbols.Graph()
    (q,), (v,) = graph.inputs("q", 1), graph.inputs("v", 1)
    c = graph.symbol("c[0]")
    known = c * c
    outputs = [q * v - c * np.cos(q), v - q * (known - 1.0), -(q * v) + known, 4.0]
    record = straight_arm._assembled(graph, outputs, 1, 1)
    assert len(record.places) < 8  # ten nodes but inputs and cosine
    assert record.counts[0] == 2  # c c and c c - 1
    v_ = np.zeros(record.size)
    v_[2] = 5.0
    for place, number in record.numbers:
        v_[place] = number
    run, out = straight_arm.kernel(), np.zeros(4)
    k = record.counts[0]
    run.run(v_, record.counts[2], record.places[:k], record.signs[:k])
    friction = np.array([[0.0, 0.0, 1.0]])
    parts = record.counts, record.places, record.signs, record.functions, record.outputs, friction
    run.evaluate(v_, record.inputs, *parts, np.array([0.3]), np.array([0.8]), out)
    wanted = [0.24 - 5 * np.cos(0.3), 0.8 - 0.3 * 24, -0.24 + 25, 4.0]
    np.testing.assert_allclose(out, wanted, rtol=1e-15)


@pytest.mark.parametrize("name", [*ARMS, "R", "one_link", "swung"])
def test_terms_at_several_states_are_those_of_each(name):
    swung = replace(arm_file.load("one_link"), gravity=(0.3, -9.81, 0.0))
    own = {"swung": lambda: swung, **ARMS}
    arm = model.build(own[name]() if name in own else arm_file.load(name))
    motions = np.random.default_rng(5).uniform(-2.0, 2.0, (3, 3, arm.n_joints))
    found = arm.terms_along(motions)
    for i, (q, qd, _) in enumerate(motions):
        for mine, its in zip(found, arm.terms(q, qd), strict=True):
            assert mine[i].shape == its.shape
            np.testing.assert_allclose(mine[i], its, rtol=1e-12, atol=1e-13)
