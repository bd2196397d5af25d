# SPDX-License-Identifier: Apache-2.0
"""Gains that change with the configuration: their weights, and the laws and designs that have them."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.composite.assembly import control
from flexarm_control.robust.decay import SlowestScheduled, Wanted, eigenvalues
from flexarm_control.robust.design import design
from flexarm_control.robust.held import held_loops
from flexarm_control.robust.loop import Sampling
from flexarm_control.robust.search import RELAXED, Search
from flexarm_control.robust.settings import Settings
from flexarm_control.robust.task import units
from flexarm_control.robust.uncertain import Uncertainty
from flexarm_control.schedule import Schedule, matters
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.models.model import build

AT = np.array([[0.2, 0.1], [-0.5, 1.0], [0.4, -0.9]])


@pytest.fixture(scope="module")
def two_link():
    return build(arm_file.load("two_link"))


def test_where_a_set_is_made_it_is_alone_and_between_two_they_share(two_link):
    schedule = Schedule(two_link, AT)
    for k, q in enumerate(AT):
        assert_allclose(schedule.weights(q), np.eye(3)[k], atol=1e-9)
    found = schedule.weights(np.array([3.0, 0.55])).copy()
    assert_allclose(found[0], found[1], rtol=1e-9)
    assert_allclose(found.sum(), 1.0, rtol=1e-12)
    assert found[2] < 0.15


def test_the_first_joint_of_a_planar_arm_does_not_matter(two_link):
    assert matters(two_link).tolist() == [False, True]
    schedule = Schedule(two_link, AT)
    here = schedule.weights(np.array([0.0, 0.4])).copy()
    assert_allclose(schedule.weights(np.array([1.0, 0.4 + 2.0 * np.pi])), here, rtol=1e-9)


def test_wrong_numbers_of_configurations_and_sets_are_refused(two_link):
    with pytest.raises(ParameterError, match="no whole number"):
        Schedule(two_link, [0.1, 0.2, 0.3], "slow.schedule")
    with pytest.raises(ParameterError, match="2 sets of gains where 3"):
        Schedule(two_link, AT).sets(np.ones(4), 2, "slow.stiffness")


def laws_of(model, **more):
    n, m = model.n_joints, model.n_modes
    draw = np.random.default_rng(3)
    values = {
        "feedforward": "none",
        "stability_margin": -1e6,
        "slow.type": "joint_pid",
        "slow.stiffness": draw.uniform(1.0, 2.0, 3 * n).tolist(),
        "slow.damping": draw.uniform(0.1, 0.2, 3 * n).tolist(),
        "slow.integral": [0.5] * n,
        "slow.schedule": AT.ravel().tolist(),
        "fast.type": "fixed_gain",
        "fast.gain": draw.standard_normal(3 * n * 2 * m).tolist(),
        "fast.schedule": AT.ravel().tolist(),
        "manifold.type": "reference",
    }
    return control(model, values | more), values


def test_the_laws_have_the_gains_of_the_place_also_in_another_process(two_link):
    law, values = laws_of(two_link)
    q, zero, n = AT[1] + [0.3, 0.2], np.zeros(2), 2
    z = np.random.default_rng(5).standard_normal(2 * two_link.n_modes)
    weights = Schedule(two_link, AT).weights(q)
    K = weights @ np.array(values["slow.stiffness"]).reshape(3, n)
    K_f = np.tensordot(weights, np.array(values["fast.gain"]).reshape(3, n, -1), 1)
    motion = SimpleNamespace(position=q + 0.01, velocity=zero)
    for slow in (law.slow, _sent(law.slow)):
        assert_allclose(slow.feedback(q, zero, motion), 0.01 * K, rtol=1e-9)
    for fast in (law.fast, _sent(law.fast)):
        assert_allclose(fast.torque(z, q), K_f @ z, rtol=1e-9)


def _sent(law):
    """The law without its model, through pickle and back."""
    model, law.model = law.model, None
    try:
        return pickle.loads(pickle.dumps(law))
    finally:
        law.model = model


@pytest.fixture(scope="module")
def scheduled(two_link):
    sampling = Sampling(2e-3, 2e-3, 400.0, 400.0)
    loops, weights = held_loops(two_link, AT, sampling, Uncertainty(), 3)
    wanted, scale = Wanted(2.75, 400.0, 1e-3), units(two_link, AT, 2.75)
    few = list(range(0, len(loops), 9))
    one = SlowestScheduled([loops[k] for k in few], wanted, scale, [weights[k] for k in few])
    return one, [weights[k] for k in few]


def test_loops_between_the_configurations_have_the_mean_of_the_sets(scheduled):
    slowest, weights = scheduled
    assert any("between configurations 1 and 3" in loop.name for loop in slowest.loops)
    x = np.random.default_rng(2).uniform(0.0, 0.3, slowest.size)
    sets = slowest.gains(x)
    assert_allclose(slowest.scaled(sets), x, rtol=1e-12)
    for K, w in zip(slowest.of_loops(slowest.loops, x), weights, strict=True):
        assert_allclose(K, np.tensordot(w, sets, 1), rtol=1e-12)


def test_the_gradient_by_all_sets_is_that_of_differences(scheduled):
    slowest, _ = scheduled
    draw = np.random.default_rng(2)
    x, way = draw.uniform(0.05, 0.3, slowest.size), draw.standard_normal(slowest.size)
    function, step = slowest.smooth(slowest.loops, 1e-3), 1e-6
    slope = function(x)[1]
    ahead, back = (function(x + sign * step * way)[0] for sign in (1.0, -1.0))
    assert_allclose(slope @ way, (ahead - back) / (2.0 * step), rtol=1e-4)
    assert len(slope.reshape(3, -1)[np.abs(slope.reshape(3, -1)).max(axis=1) > 0.0]) > 1


def test_the_slope_of_each_loop_s_pole_is_that_of_all_sets(scheduled):
    slowest, weights = scheduled
    x = np.random.default_rng(2).uniform(0.05, 0.3, slowest.size)
    k, step = len(weights) - 1, 1e-6
    assert 0.0 < weights[k].max() < 1.0
    found = slowest.each(x)[k]
    difference = [
        (slowest.each(x + step * e)[k].v - slowest.each(x - step * e)[k].v) / (2.0 * step)
        for e in np.eye(x.size)
    ]
    assert_allclose(found.slope, np.linalg.norm(difference), rtol=1e-4)


def test_loops_that_limit_the_others_are_asked_less_once(scheduled):
    slowest, _ = scheduled
    search = Search(slowest, None, 0.6)
    each = [-0.10, -0.11] + [-0.3] * (len(slowest.loops) - 2)
    search._each = lambda x: each
    found, near = search.relaxed(None)
    assert near == {0, 1}
    for k, (before, after) in enumerate(zip(slowest.loops, found, strict=True)):
        assert after.fraction == (RELAXED if k in near else 1.0) * before.fraction
    assert search.relaxed(None, near)[0] is None


@pytest.mark.long
def test_a_design_of_two_links_holds_at_every_place_that_it_names():
    settings = Settings(
        rate=500.0, delay=0.002, effort=0.1, configurations=((0.0, 0.4), (0.0, 0.9))
    )
    found = design(arm_file.load("two_link"), settings)
    assert found.scheduled and found.sets.shape[0] == 2 and found.holds
    pairs = list(found.loops())
    assert len(pairs) == len(found.slowest)
    assert any("between" in loop.name for loop, _ in pairs)
    for loop, K in pairs:
        assert np.abs(eigenvalues(loop, K)[1]).max() < 1.0
    values = found.parameters()
    assert len(values["slow.stiffness"]) == 4 and values["fast.schedule"] == [0.0, 0.4, 0.0, 0.9]


def test_a_rigid_arm_has_sets_without_gains_for_modes():
    rigid = build(arm_file.load("rigid"))
    assert Schedule(rigid, ()).sets([1.0], 0, "gain").shape == (1, 0)
