# SPDX-License-Identifier: Apache-2.0
"""Loops under torque limits, and the slower design that follows where one does not come back from them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.kernels import compiled, steps
from flexarm_control.low_pass import POLES
from flexarm_control.robust import design as design_module
from flexarm_control.robust import recovery as recovery_module
from flexarm_control.robust import settling
from flexarm_control.robust import task as task_module
from flexarm_control.robust.design import SLOWER, design
from flexarm_control.robust.loop import sampled_loop
from flexarm_control.robust.recovery import LATER, Recovery, recovery
from flexarm_control.robust.settings import Settings, sampling_for
from flexarm_control.robust.settling import residuals
from flexarm_control.robust.uncertain import Uncertainty, richer
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.linear import static_torque
from flexarm_dynamics.models.model import build

UNCERTAIN = Uncertainty()
QUICK = Settings(500.0, 0.002, effort=0.1)


@pytest.fixture(scope="module")
def r():
    """Arm R with a design; its torque limit is large."""
    found = design(arm_file.load("R"), replace(QUICK, effort=0.3))
    return SimpleNamespace(model=build(found.arm.known), design=found)


def of(r, **limits):
    """Its `recovery`, with other limits of the joint."""
    joints = tuple(replace(j, limits=replace(j.limits, **limits)) for j in r.model.arm.joints)
    model, found = build(replace(r.model.arm, joints=joints)), r.design
    return recovery(model, found.configurations, found.sampling, UNCERTAIN, found.sets)


# --------------------------------------------------------------------------- the kernel


def following(A, sent, effect, integral, held, pushes, motion, limit):
    """The same steps, in products of matrices."""
    X = [np.zeros(len(A))]
    for push, u in zip(pushes, motion, strict=True):
        x, y = X[-1], held + sent @ X[-1]
        part = 1.0
        for i in np.flatnonzero(np.abs(u + y) > limit):
            part = min(part, max((np.sign(u + y)[i] * limit[i] - u[i]) / y[i], 0.0))
        beyond = (np.abs(u + y) > limit).any()
        v = np.clip(u + part * y, -limit, limit) if beyond else u + y
        after = A @ x + push + effect @ (v - u - y)
        for i, at in enumerate(integral):
            if beyond and (after[at] - x[at]) * (u + y)[i] < 0.0:
                after[at] = x[at]
        X.append(after)
    return np.array(X)


@pytest.mark.parametrize("kernel", [steps, compiled()])
@pytest.mark.parametrize("limit", [np.inf, 3.0, 0.5])
def test_steps_under_limits_are_those_of_feedback_that_is_scaled_together(kernel, limit):
    draw = np.random.default_rng(2)
    N, n, count = 6, 2, 30
    A = draw.standard_normal((N, N))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    sent, effect = 0.3 * draw.standard_normal((n, N)), 0.1 * draw.standard_normal((N, n))
    pushes, motion = draw.standard_normal((count, N)), 0.3 * draw.standard_normal((count, n))
    given = (
        A,
        sent,
        effect,
        np.array([4, 2]),
        np.array([0.2, -0.1]),
        pushes,
        motion,
        np.full(n, limit),
    )
    X = np.zeros((count + 1, N))
    kernel.limited_steps(*given, X)
    assert_allclose(X, following(*given), rtol=1e-9, atol=1e-12)


def test_states_that_grow_without_end_are_no_numbers():
    X, none = np.zeros((100, 1)), np.zeros((1, 1))
    law = np.array([[3.0]]), none, none, np.zeros(1, int), np.zeros(1)
    compiled().limited_steps(*law, np.ones((99, 1)), np.zeros((99, 1)), np.ones(1), X)
    assert np.isfinite(X[:20]).all() and np.isnan(X[-1, 0])


# --------------------------------------------------------------------------- loops


@pytest.mark.parametrize("corner", [np.inf, 60.0])
@pytest.mark.parametrize("delay", [0.0, 0.0005, 0.002, 0.0035])
def test_a_loop_says_what_is_sent_and_what_a_change_of_it_does(r, corner, delay):
    """The same change of the torque, made by u where no filter is in the way, and by the torques that are under way."""
    sampling = replace(r.design.sampling, delay=delay, torque_corner=corner)
    loop = sampled_loop(r.model, r.model, np.zeros(1), sampling)
    draw = np.random.default_rng(0)
    x, u = draw.standard_normal(len(loop.F)), np.array([0.7])
    if delay:  # the newest torque under way
        assert_allclose(
            (loop.F @ x + loop.G @ u)[-1:], loop.sent @ x + loop.through @ u, rtol=1e-12
        )
    bare = sampled_loop(r.model, r.model, np.zeros(1), replace(sampling, torque_corner=np.inf))
    assert_allclose(bare.effect, bare.G, rtol=1e-12)
    assert not bare.sent.any()
    if np.isfinite(corner):
        # The filter's own states lie before the torques that are under way: a change of what leaves it is not in them.
        end = len(x) - int(np.ceil(delay / sampling.period))
        assert len(x) == len(bare.F) + POLES
        assert not loop.effect[end - POLES : end].any()
        assert_allclose(
            np.delete(loop.effect, np.s_[end - POLES : end], axis=0), bare.G, rtol=1e-12
        )


# --------------------------------------------------------------------------- recovery


def test_without_limits_it_is_what_the_motion_leaves(r, monkeypatch):
    """Of the heavier payload, without friction, by sample; the motion as long as that of `settling`."""
    monkeypatch.setattr(settling, "STEPS", np.inf)
    one = residuals(r.model, np.zeros(1), r.design.sampling, UNCERTAIN)[1]
    period = 2.0 * np.pi / r.model.frequencies(np.zeros(1), locked=True)[0]
    motion = settling.Motion(build(richer(r.model.arm.whole)), np.zeros(1), period, 0.002)
    found = of(r, torque=np.abs(motion.torque).max() / UNCERTAIN.torque_share, velocity=np.inf)
    assert 0.0 < found.unlimited == pytest.approx(one.settling(r.design.K), abs=1e-9)


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_two_joints_move_together_with_the_gains_of_their_configuration(monkeypatch, weight):
    """Of a planar arm with two links, upright or lying, and a set of gains for each of two configurations."""
    monkeypatch.setattr(settling, "STEPS", np.inf)
    text = arm_file.find("two_link").read_text()
    arm = arm_file.parse(
        text.replace("gravity: [0.0, 0.0, 0.0]", f"gravity: [0.0, {-weight}, 0.0]")
    )
    model, at = build(arm), np.array([[0.2, 0.4], [0.7, -0.5]])
    sampling, _ = sampling_for(model, at, QUICK)
    sets = 0.01 * np.random.default_rng(0).random((2, 2, 6 + 2 * model.n_modes))
    seen = []

    class Limited(recovery_module._Limited):
        def settling(self, *given):
            seen.append((*given, self.states(*given)))
            return super().settling(*given)

    monkeypatch.setattr(recovery_module, "_Limited", Limited)
    found = recovery(model, at, sampling, UNCERTAIN, sets)
    assert len(seen) == (8 if weight else 4) and found is not None
    for k, (forces, torque, held, limit, X) in enumerate(seen):
        here = k // (len(seen) // 2)
        one = residuals(model, at[here], sampling, UNCERTAIN)[1]
        way = (at[1] - at[0]) / np.linalg.norm(at[1] - at[0]) * (-1.0) ** (k // 2)
        free = one._moved(sets[here])[1].transpose(0, 2, 1) @ way
        part = forces[0, 0] / (one._forces[0].T @ way)[0]
        assert np.isinf(limit[0]) or np.abs(torque / limit).max() <= UNCERTAIN.torque_share + 1e-9
        assert_allclose(held, static_torque(build(richer(arm.whole)), at[here]), atol=1e-12)
        if np.isinf(limit[0]):
            rows = 400
            assert_allclose(
                X[:rows], part * free[:rows], rtol=1e-6, atol=1e-9 * np.abs(X[:rows]).max()
            )


def test_limits_count_where_the_torque_reaches_them(r, monkeypatch):
    """A third of the torque is enough for the motion; 1.3 times all of it is not."""
    monkeypatch.setattr(Uncertainty, "torque_share", 0.3)
    third = of(r, velocity=np.inf)
    assert third.limited == third.unlimited and third.later == 0.0
    monkeypatch.setattr(Uncertainty, "torque_share", 1.3)
    more = of(r, velocity=np.inf)
    assert more.later == more.limited - more.unlimited > 0.1


@pytest.mark.parametrize(
    ("payload", "share"),
    [((0.7, 1.3), 0.75), ((0.9, 1.1), 0.886), ((0.5, 1.0), 0.95), ((1.0, 5.0), 0.5)],
)
def test_a_motion_leaves_the_torque_that_a_heavier_payload_needs(payload, share):
    assert Uncertainty(payload=payload).torque_share == share


def test_a_motion_is_not_faster_than_a_joint_may_turn():
    period, way = 0.5, np.array([1.0, -0.5])
    speed = recovery_module.PEAK * settling.ANGLE * 0.5 / (settling.MOTION * period)
    part = recovery_module._part(
        np.ones((3, 2)), np.full(2, 50.0), way, np.array([np.inf, 3.0 * speed]), period
    )
    assert part == pytest.approx(3.0)
    assert (
        recovery_module._part(
            np.ones((3, 2)), np.array([2.0, 5.0]), way, np.full(2, np.inf), period
        )
        == 2.0
    )


def test_it_is_not_looked_at_without_torque_limits_or_room_beside_the_weight(r):
    assert of(r, torque=np.inf) is None
    assert Recovery.of([]) is None


def test_it_moves_once_in_each_direction_between_configurations():
    at = np.array([[0.0, 0.0], [0.5, 0.5], [1.0, 1.0], [1.0, 0.0]])
    ways = recovery_module._ways(at, False)
    wanted = [[0.5, 0.5], [1.0, 0.0], [0.5, -0.5], [0.0, -1.0]]
    assert_allclose(ways, [np.array(way) / np.linalg.norm(way) for way in wanted], atol=1e-12)
    assert_allclose(recovery_module._ways(at, True)[4:], -np.array(ways))
    assert_allclose(recovery_module._ways(np.zeros((1, 4)), False), [[0.5] * 4])


@pytest.mark.parametrize(
    ("pairs", "later"),
    [
        ([(1.0, 1.0), (3.0, 0.5)], 2.5),
        ([(7.0, 1.0), (6.0, 6.0)], 6.0),
        ([(np.inf, 1.0)], np.inf),
        ([(np.inf, np.inf), (2.0, 1.0)], 1.0),
    ],
)
def test_what_the_limits_cost_is_that_of_one_motion(pairs, later):
    found = Recovery.of(pairs)
    assert found == Recovery(*np.max(pairs, axis=0), later)
    assert found.comes_back == (later <= LATER)


# --------------------------------------------------------------------------- slower designs


def by_speed(monkeypatch, found):
    """`recovery` of designs of each speed; the speeds that are asked come into the list."""
    asked = []

    class Task(task_module.Task):
        def __init__(self, arm, settings, *rest, **named):
            asked.append(settings.speed)
            super().__init__(arm, settings, *rest, **named)

    monkeypatch.setattr(design_module, "Task", Task)
    monkeypatch.setattr(task_module, "recovery", lambda *_: found(asked[-1]))
    return asked


def test_a_design_that_does_not_come_back_is_made_slower_until_one_does(monkeypatch):
    asked = by_speed(
        monkeypatch,
        lambda speed: Recovery.of([(9.0 if speed > 0.4 else 8.5, 1.0 if speed > 0.4 else 8.0)]),
    )
    reported, searched = [], []
    monkeypatch.setattr(design_module, "leaving_less", lambda *task: searched.append(task[3]))
    found = design(
        arm_file.load("R"), replace(QUICK, speed=0.8), progress=lambda f, d: reported.append(f)
    )
    assert list(dict.fromkeys(asked)) == [0.8, 0.8 * SLOWER[0], 0.8 * SLOWER[1]]
    assert searched == [None, 0.8, 0.8]  # the speed that was asked
    assert found.settings.speed == 0.8 * SLOWER[1] == 0.4
    assert found.recovery == Recovery(8.5, 8.0, 0.5) and found.slowed
    assert reported[-1] == 1.0 and max(reported[:-1]) >= 0.8


@pytest.mark.long
def test_where_none_comes_back_it_is_the_one_that_is_soonest(monkeypatch):
    late = {1.0: np.inf, SLOWER[0]: 6.0, SLOWER[1]: 5.0, SLOWER[2]: 7.0}
    asked = by_speed(monkeypatch, lambda speed: Recovery.of([(late[speed], 1.0)]))
    found = design(arm_file.load("R"), QUICK)
    assert list(dict.fromkeys(asked)) == [1.0, *SLOWER]
    assert found.settings.speed == SLOWER[1] and found.slowed and not found.comes_back


def test_one_that_comes_back_is_the_first_and_only_one(r, monkeypatch):
    asked = by_speed(monkeypatch, lambda speed: Recovery(3.0, 1.5, 1.5))
    found = design(arm_file.load("R"), QUICK)
    assert found.settings.speed == 1.0 and not found.slowed
    assert set(asked) == {1.0}
    assert r.design.settings.speed == 1.0 and r.design.comes_back
