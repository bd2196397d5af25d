# SPDX-License-Identifier: Apache-2.0
"""What motions leave at the tip of arms that are not the file's, its gradient, and gains that leave less."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from flexarm_control.robust import design as design_module
from flexarm_control.robust import further
from flexarm_control.robust import search as search_module
from flexarm_control.robust import task as task_module
from flexarm_control.robust.design import design
from flexarm_control.robust.further import FURTHER, Further, leaves, leaving_less
from flexarm_control.robust.loop import APART, ARM, MARGIN, STICKS, sampled_loop
from flexarm_control.robust.recovery import Recovery
from flexarm_control.robust.settings import Settings, sampling_for
from flexarm_control.robust.settling import (
    ANGLE,
    MOTION,
    RUBBING,
    RUBS,
    TOLERANCE,
    WATCHED,
    AfterMotion,
    Residual,
    residuals,
    rings,
    together,
)
from flexarm_control.robust.uncertain import Uncertainty, richer
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.linear import linear_plant
from flexarm_dynamics.models.model import build

UNCERTAIN = Uncertainty()


@pytest.fixture(scope="module")
def r():
    """Arm R, its sampling at 500 Hz, and gains that hold it, without the further search."""
    model = build(arm_file.load("R").known)
    sampling, _ = sampling_for(model, np.zeros((1, 1)), Settings(500.0, 0.002))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(further, "FURTHER", ())
        found = design(model.arm, Settings(500.0, 0.002, effort=0.3))
    return SimpleNamespace(model=model, sampling=sampling, K=found.K, design=found)


@pytest.mark.parametrize("doublings", [0, 1, 3])
def test_the_gradient_is_that_of_differences(doublings):
    rng = np.random.default_rng(doublings)
    N, n, h = 7, 2, 3
    F = rng.standard_normal((N, N))
    F *= 0.95 / np.abs(np.linalg.eigvals(F)).max()
    loop = SimpleNamespace(
        F=F, G=rng.standard_normal((N, n)), N=rng.standard_normal((4, N)), period=0.01
    )
    forces, push = rng.standard_normal((5, h, n)), rng.standard_normal((4, h))
    one = Residual(loop, forces, push, rng.standard_normal((3, h)), 0.3, doublings, 0.7)
    K = 0.1 * rng.standard_normal((n, 4))
    value, slope = one(K)
    for _ in range(5):
        step = 1e-6 * rng.standard_normal(K.shape)
        assert_allclose(one(K + step)[0] - one(K - step)[0], 2.0 * (slope * step).sum(), rtol=1e-5)
    assert value > 0.0


@pytest.mark.parametrize(("period", "longer"), [(0.16, 0), (0.4, 1)])
def test_steps_of_several_samples_leave_what_single_ones_leave(period, longer):
    """A step of the motion is four samples; one after it eight, if a period has at least 16 of these."""
    rng = np.random.default_rng(0)
    N, n, h = 6, 2, 0.16 / 128 if longer == 0 else 0.4 / 128
    F = 0.4 * rng.standard_normal((N, N))
    F *= 0.97 / np.abs(np.linalg.eigvals(F)).max()
    loop = SimpleNamespace(F=F, G=np.zeros((N, n)), N=np.zeros((3, N)), period=h * (2 - longer))
    forces, push, tip = (rng.standard_normal(s) for s in ((3, 2, n), (4, 2), (3, 4)))
    found = Residual(loop, forces, push, tip, period, 2).distance(np.zeros((n, 3)))
    S, X, distance = np.vstack([push, np.zeros((2, 2))]), np.zeros((N, n)), []
    for force in np.repeat(forces, 4, axis=0):
        X = F @ X + S @ force
    for _ in range(30):
        distance.append(np.linalg.norm(tip @ X[:4]))
        X = np.linalg.matrix_power(F, 4 * 2**longer) @ X
    assert_allclose(found[:30], distance, rtol=1e-9)


def test_the_value_is_the_time_until_the_tip_has_settled():
    """A tip that is e - 1 away, squared, for two periods, and then at its place, has J = 2."""
    steps = 50
    loop = SimpleNamespace(F=np.eye(2, k=-1), G=np.zeros((2, 1)), N=np.zeros((1, 2)), period=0.01)
    one = Residual(loop, np.zeros((1, 1, 1)), np.zeros((1, 1)), np.ones((3, 1)), 1.0, 0)
    distance = np.where(np.arange(WATCHED * steps + 1) < 2 * steps, np.sqrt(np.e - 1.0), 0.0)
    X = np.zeros((len(distance) + 1, 1, 2))
    X[1:, 0, 0] = distance / np.sqrt(3.0)
    one._moved = lambda K: ([(loop.F, one._S)], X)
    assert_allclose(one(np.zeros((1, 1)))[0], 2.0, rtol=0.02)
    assert_allclose(one.settling(np.zeros((1, 1))), 2.0, rtol=1e-9)
    X[-1] = 1.0
    assert np.isinf(one.settling(np.zeros((1, 1))))


@pytest.mark.parametrize(("payload", "stiffness", "number"), [(1.3, 1.0, 1), (1.0, 0.9, 2)])
def test_what_is_left_is_that_of_the_linear_arm_in_continuous_time(r, payload, stiffness, number):
    """R as another arm, against an integral of that arm's equations, with filters and delay negligible."""
    model, q = r.model, np.zeros(1)
    infinite = {"joint_corner": np.inf, "modal_corner": 1e5, "torque_corner": np.inf}
    sampling = replace(r.sampling, period=2e-4, delay=0.0, **infinite)
    K = r.K.copy()
    K[:, 2:] = 0.0  # stiffness and damping of the joint alone
    own, other = richer(model.arm.whole), scaled(richer(model.arm.whole), payload, stiffness)
    differs = Uncertainty(payload=(1.0, payload), stiffness=(stiffness, 1.0))
    found = residuals(model, q, sampling, differs)
    same, one = found[0], found[number]
    A, M = [], []
    for arm in (own, other):
        plant = build(arm)
        A.append(linear_plant(plant, q, coulomb=False)[0])
        M.append(plant.terms(q, np.zeros(1)).M.copy())
    half = len(M[0])
    bending = [-mass @ a[half:, :half] for mass, a in zip(M, A, strict=True)]
    gains = K @ sampled_loop(model, build(other), q, sampling).N[:, : 2 * half]
    period = 2.0 * np.pi / model.frequencies(q, locked=True)[0]
    length = MOTION * period
    bent = -np.linalg.solve(bending[0][1:, 1:], M[0][1:, 0])

    def slope(t, x):
        s, force = t / length, np.zeros(half)
        if s < 1.0:
            acceleration = ANGLE * (60.0 * s - 180.0 * s**2 + 120.0 * s**3) / length**2
            snap = ANGLE * (720.0 * s - 360.0) / length**4
            force += (M[0] - M[1]) @ np.concatenate([[acceleration], bent * snap])
            force += (bending[0] - bending[1])[:, 1:] @ bent * acceleration
        force[0] -= (gains @ x)[0]
        return A[1] @ x + np.concatenate([np.zeros(half), np.linalg.solve(M[1], force)])

    times = length + period * one._time
    begin = np.zeros(2 * half)
    moving = solve_ivp(slope, (0.0, length), begin, rtol=1e-8, atol=1e-12).y[:, -1]
    after = solve_ivp(slope, (length, times[-1]), moving, t_eval=times, rtol=1e-8, atol=1e-12)
    tip = np.linalg.norm(one._C[:, : 2 * half] @ after.y, axis=0)
    assert tip[0] > 1.0
    assert_allclose(one.distance(K), tip, atol=0.03 * tip.max())
    assert_allclose(same.distance(K), 0.0, atol=1e-6)


def test_the_arms_are_those_with_another_payload_or_softer_links_and_they_stick_with_friction(r):
    model, q = r.model, np.zeros(1)
    moved = residuals(model, q, r.sampling, UNCERTAIN)
    assert len(moved) == 3
    joints = tuple(replace(j, friction=replace(j.friction, coulomb=0.1)) for j in model.arm.joints)
    rubbing = build(replace(model.arm, joints=joints))
    found = residuals(rubbing, q, r.sampling, UNCERTAIN)
    assert len(found) == 3 * (1 + len(RUBBING))
    assert [one._share for one in found] == 3 * [1.0, RUBS, RUBS]
    # Nothing but the damper differs from the arm without friction.
    assert_allclose(found[0](r.K)[0], moved[0](r.K)[0], rtol=1e-9)
    assert abs(found[1](r.K)[0] / RUBS - moved[0](r.K)[0]) > 1e-3
    assert_allclose(np.linalg.norm(moved[0]._C[:, 0]), 1.0 / TOLERANCE, rtol=1e-3)


def test_the_whole_is_about_the_worst_of_all_and_its_gradient_that_of_differences():
    rng = np.random.default_rng(1)
    scale = np.array([[2.0, 0.0, 3.0]])
    centres = rng.standard_normal((3, 1, 3))
    slowest = SimpleNamespace(
        scale=scale,
        free=scale > 0.0,
        gains=lambda x: np.stack([np.insert(one, 1, 0.0)[None] * scale for one in x.reshape(2, 2)]),
    )
    found = [
        (k, lambda K, c=c: (float(((K - c) ** 2).sum()), 2.0 * (K - c)))
        for k, c in zip((0, 1, 1), centres, strict=True)
    ]
    whole, x = AfterMotion(slowest, found), rng.standard_normal(4)
    value, slope = whole(x)
    each = [one(slowest.gains(x)[k])[0] for k, one in found]
    assert max(each) <= value < 1.15 * max(each)
    for step in 1e-6 * np.eye(4):
        assert_allclose(
            whole(x + step)[0] - whole(x - step)[0], 2.0 * slope @ step, rtol=1e-6, atol=1e-12
        )


def test_an_arm_that_is_what_its_file_says_leaves_nothing(r):
    none = Uncertainty(payload=(1.0, 1.0), stiffness=(1.0, 1.0))
    slowest = SimpleNamespace(gains=lambda x: r.K[None], scale=np.ones(r.K.shape), free=r.K != 0.0)
    found = [(0, one) for one in residuals(r.model, np.zeros(1), r.sampling, none)]
    value, slope = AfterMotion(slowest, found)(np.zeros(1))
    assert value == 0.0 and not slope.any()


def lasting(found):
    """J of a design, and its settling time in locked periods."""
    task = task_module.Task(found.arm, found.settings, found.uncertainty)
    loops, weights = task.held(found.sampling, len(found.sets))
    search = task.search_of(loops, weights, found.sampling)
    rest = [(0, one) for one in residuals(task.nominal, task.at[0], found.sampling, UNCERTAIN)]
    after, x = AfterMotion(search.slowest, rest), search.slowest.scaled(found.sets)
    return after(x)[0], after.settling(x), -search.value(x)


def test_what_gains_leave_is_known_without_a_search(r):
    task = task_module.Task(r.model.arm, r.design.settings, UNCERTAIN)
    gains = SimpleNamespace(K=r.design.sets, sampling=r.design.sampling)
    assert leaves(task, gains) == pytest.approx(lasting(r.design)[0], rel=1e-12)
    assert together([]) == 0.0 and np.isinf(together([1.0, np.inf]))


def test_a_design_whose_motions_leave_much_goes_on_for_gains_that_leave_less(r, monkeypatch):
    before, settled, reached = lasting(r.design)
    monkeypatch.setattr(further, "FURTHER", (Further(0.9 * before, 0.54 * before, 800, 0.5),))
    fractions = []
    other = design(r.model.arm, r.design.settings, progress=lambda part, _: fractions.append(part))
    first = design_module.FIRST
    assert any(first * design_module.NEARBY < part < first for part in fractions)
    after, sooner, _ = lasting(other)
    assert after < 0.8 * before and sooner < settled
    assert other.holds and other.reached > 0.79 * min(reached, r.design.reached)


def test_a_slow_design_may_leave_more(r, monkeypatch):
    settings = replace(r.design.settings, speed=0.5)
    slow = design(r.model.arm, settings)
    monkeypatch.setattr(further, "FURTHER", (Further(0.6 * lasting(slow)[0], 0.0, 800, 0.5),))
    assert_allclose(design(r.model.arm, settings).K, slow.K, rtol=0.0)


@pytest.fixture(scope="module")
def rough(r):
    """The same with Coulomb friction: the task, its search and the gains found without."""
    joints = tuple(
        replace(j, friction=replace(j.friction, coulomb=0.1)) for j in r.model.arm.joints
    )
    task = task_module.Task(replace(r.model.arm, joints=joints), r.design.settings, UNCERTAIN)
    loops, weights = task.held(r.design.sampling, 1)
    search = task.search_of(loops, weights, r.design.sampling)
    x = search.slowest.scaled(r.design.sets)
    return SimpleNamespace(
        task=task, loops=loops, search=search, x=x, found=task.sets(search, x, 0)
    )


def test_joints_that_stick_are_looked_at_without_delay_too(rough):
    more = rough.task.at_once()
    loops, _ = more.held(rough.found.sampling, 1)
    stuck = [loop for loop in loops if loop.kind == STICKS]
    late = [loop for loop in rough.loops if loop.kind == STICKS]
    assert len(stuck) == 2 * len(late) and len(loops) == len(rough.loops) + len(late)
    sooner = [loop for loop in stuck if "no delay" in loop.name]
    assert [loop.fraction for loop in sooner] == [0.5 * loop.fraction for loop in late]
    assert all(
        len(a.F) < len(b.F) for a, b in zip(sooner, late, strict=True)
    )  # no torque under way
    assert not rough.task.hunts(rough.found)
    wild = rough.found._replace(K=20.0 * rough.found.K)
    assert rough.task.hunts(wild) and not more.hunts(wild)  # those loops are held already


def test_gains_with_which_joints_hunt_are_searched_for_again(rough, monkeypatch):
    asked = []

    def hunts(task, found):
        asked.append(task.uncertainty.at_once)
        return not task.uncertainty.at_once

    monkeypatch.setattr(task_module.Task, "hunts", hunts)
    monkeypatch.setattr(further, "FURTHER", ())
    made = design(rough.task.arm, replace(rough.task.settings, effort=0.1))
    assert made.uncertainty.at_once and asked[0] is False
    assert any("sticking" in row.name and "no delay" in row.name for row in made.slowest)


@pytest.fixture(scope="module")
def rough_pair():
    """A task for two links whose joints rub, and soft gains of the joints alone."""
    arm = arm_file.load("two_link")
    joints = tuple(replace(j, friction=replace(j.friction, coulomb=0.02)) for j in arm.joints)
    settings = Settings(500.0, 0.002, effort=0.05, configurations=((0.0, 0.7),))
    task = task_module.Task(replace(arm, joints=joints), settings, UNCERTAIN)
    loops, weights = task.held(task.sampling, 1)
    search = task.search_of(loops, weights, task.sampling)
    found = task.alone(None, None)
    return SimpleNamespace(task=task, search=search, found=found)


def test_a_vibration_that_grows_fast_while_some_joints_stick_is_found(rough_pair, monkeypatch):
    task = rough_pair.task
    more = task.apart()
    loops, _ = more.held(rough_pair.found.sampling, 1)
    apart = [loop for loop in loops if loop.kind == APART]
    assert len(apart) == 4  # each joint, with the delay and without

    def growth(K):
        """Of the fastest of all loops in which some joints stick, over omega_1."""
        closed = [loop.F - loop.G @ (K @ loop.N) for loop in apart]
        most = max(np.abs(np.linalg.eigvals(one)).max() for one in closed)
        return np.log(most) / apart[0].period / task.omega_1

    wild = rough_pair.found._replace(K=5.0 * rough_pair.found.K)
    fast = growth(wild.K[0])
    assert fast > 0.0
    monkeypatch.setattr(task_module, "GROWS_FAST", 0.99 * fast)
    assert task.hunts_apart(wild) and not more.hunts_apart(wild)  # those loops are held already
    monkeypatch.setattr(task_module, "GROWS_FAST", 1.01 * fast)
    assert not task.hunts_apart(wild)


def test_such_gains_are_searched_for_again_with_these_loops(rough_pair, monkeypatch):
    asked, task = [], rough_pair.task

    def hunts_apart(task, found):
        asked.append(task.uncertainty.apart)
        return True

    monkeypatch.setattr(task_module.Task, "hunts_apart", hunts_apart)
    monkeypatch.setattr(further, "FURTHER", ())
    made = design(task.arm, task.settings)
    assert asked == [False]
    assert made.uncertainty.apart and made.uncertainty.at_once and made.uncertainty.edges
    assert made.decay > 0.0 and any(row.kind == APART for row in made.slowest)
    # If the arm does not come back from its torque limits with the new gains, the old ones stay.
    old = task_module.recovery

    def lost(model, at, sampling, uncertainty, K):
        found = old(model, at, sampling, uncertainty, K)
        return replace(found, later=np.inf) if uncertainty.apart else found

    monkeypatch.setattr(task_module, "recovery", lost)
    kept = design(task.arm, task.settings)
    assert kept.hunts and not kept.uncertainty.apart


def test_what_such_a_search_finds_is_taken_if_no_loop_gets_too_slow_and_the_arm_is_not_later(
    rough_pair, monkeypatch
):
    task, found = rough_pair.task, rough_pair.found
    made, less = task.design(found), found._replace(K=1.01 * found.K)
    monkeypatch.setattr(task_module.Task, "from_nearby", lambda self, say, found: found)
    monkeypatch.setattr(design_module, "leaving_less", lambda *_: less)

    def steadied():
        return design_module._steadied(task, found, made, 1.0, lambda fraction, decay: None)

    monkeypatch.setattr(design_module, "later", lambda now, before: False)
    assert_allclose(steadied().K, less.K[0])
    assert not steadied().hunts
    monkeypatch.setattr(design_module, "later", lambda now, before: True)
    assert steadied().uncertainty.apart
    assert_allclose(steadied().K, made.K)
    (row, *rows) = found.rows
    slow = found._replace(rows=(row._replace(value=-0.01), *rows))
    assert 0.0 < slow.decay < min(found.decay, further.LEAST)
    monkeypatch.setattr(task_module.Task, "from_nearby", lambda self, say, found: slow)
    kept = steadied()
    assert kept.hunts and not kept.uncertainty.apart  # it is marked
    assert_allclose(kept.K, made.K)


def test_a_rigid_arm_whose_joints_stick_is_searched_for_too():
    arm = arm_file.load("rigid")
    joints = tuple(replace(j, friction=replace(j.friction, coulomb=0.5)) for j in arm.joints)
    settings = Settings(500.0, 0.002, effort=0.05, configurations=((0.2, 0.4),))
    task = task_module.Task(replace(arm, joints=joints), settings, UNCERTAIN)
    found = task.alone(None, None)
    assert found.decay > 0.0 and not task.nominal.n_modes
    made = design_module._steadied(task, found, task.design(found), 1.0, lambda *_: None)
    assert made.uncertainty.apart and made.decay > 0.0


def test_gains_ring_longer_if_the_slowest_mode_that_rings_loses_a_tenth_of_its_decay(
    rough, monkeypatch
):
    task, found = rough.task, rough.found
    each = residuals(task.nominal, task.at[0], found.sampling, UNCERTAIN)
    numbered = [(0, one) for one in each]
    slowest = rings(numbered, found.K)
    assert slowest == min(one.ringing(found.K[0]) for one in each if one.rubs)
    weak = found._replace(K=0.5 * found.K)
    assert rings(numbered, weak.K) < 0.9 * slowest
    monkeypatch.setattr(further, "LEAST", 2.0 * slowest / task.speed)
    assert further.rings_longer(task, found, task, weak)
    assert not further.rings_longer(task, found, task, found)
    monkeypatch.setattr(further, "LEAST", 0.0)
    assert not further.rings_longer(task, found, task, weak)


def test_loops_are_there_for_an_arm_for_a_margin_or_stick(rough):
    margins = ("no delay", "gain x", "delay ", "modes alone")
    for loop in rough.loops:
        margin = any(words in loop.name for words in margins)
        kind = STICKS if "sticking" in loop.name else MARGIN if margin else ARM
        assert loop.kind == kind, loop.name
    assert {loop.kind for loop in rough.loops} == {ARM, MARGIN, STICKS}


def test_loops_for_a_margin_are_eased_and_an_arm_that_moves_keeps_a_least_decay():
    loops = [SimpleNamespace(kind=kind) for kind in (ARM, ARM, MARGIN, STICKS)]

    def parts(*decays):
        return list(further._parts(loops, decays, 0.5))

    assert parts(0.2, 0.5, 0.3, 0.4) == [1.0, 1.0, 0.5, 1.0]
    # With 0.02 kept of all: 0.05 of what moves, or all that it has.
    assert_allclose(parts(0.2, 0.03, 0.3, 0.02), [2.5, 1.5, 0.5, 1.0])


def test_the_further_search_keeps_four_fifths_of_the_slowest_decay_and_half_of_the_margins(
    rough, monkeypatch
):
    left = residuals(rough.task.nominal, np.zeros(1), rough.found.sampling, UNCERTAIN)
    after = AfterMotion(rough.search.slowest, [(0, one) for one in left])
    monkeypatch.setattr(further, "FURTHER", (Further(0.9 * after(rough.x)[0], 0.0, 800, 0.5),))
    asked = []
    taken = search_module.Search.sooner
    monkeypatch.setattr(
        search_module.Search,
        "sooner",
        lambda self, *args: asked.append(self.slowest.loops) or taken(self, *args),
    )
    other = leaving_less(rough.task, rough.found, lambda fraction, decay: None)
    assert other is not None
    assert after(rough.search.slowest.scaled(other.K))[0] < 0.85 * after(rough.x)[0]
    before = rough.search.decays(rough.x)
    now = rough.search.decays(rough.search.slowest.scaled(other.K))
    for loop, one, new in zip(rough.loops, asked[0], now, strict=True):
        eased = 0.5 if loop.kind == MARGIN else 1.0
        assert one.fraction == eased * loop.fraction
        assert new > 0.78 * eased * min(before), loop.name


@pytest.mark.parametrize(
    ("leaves", "speed", "asked", "chosen"),
    [
        (3.6, 1.0, None, 0),
        (3.4, 1.0, None, 1),
        (2.1, 1.0, None, 1),
        (1.9, 1.0, None, None),
        (3.4, 0.5, None, None),
        (3.4, 0.5, 1.0, 1),  # torque limits have lowered its speed
    ],
)
def test_margins_are_eased_only_where_motions_leave_very_much(
    rough, monkeypatch, leaves, speed, asked, chosen
):
    searched = []

    def sooner(self, x, after, keep, budget, enough, progress):
        searched.append((self.slowest.loops, budget, enough))
        return x

    monkeypatch.setattr(search_module.Search, "sooner", sooner)
    monkeypatch.setattr(AfterMotion, "__call__", lambda self, x: (leaves, 0.0 * x))
    monkeypatch.setattr(rough.task, "speed", speed)
    assert leaving_less(rough.task, rough.found, lambda fraction, decay: None, asked) is None
    if chosen is None:
        assert not searched
        return
    ((loops, budget, enough),) = searched
    eased = [new.fraction / old.fraction for new, old in zip(loops, rough.loops, strict=True)]
    wanted = FURTHER[chosen]
    assert eased == [wanted.eased if loop.kind == MARGIN else 1.0 for loop in rough.loops]
    assert budget == rough.task.settings.effort * wanted.evaluations
    assert enough == wanted.enough < wanted.much
    assert FURTHER[0].eased < FURTHER[1].eased == 1.0


@pytest.mark.parametrize(
    ("before", "now", "taken"),
    [
        ((1.6, 1.0), (1.5, 0.7), True),
        ((1.5, 1.0), (1.6, 0.7), False),
        ((2.2, 1.2), (2.1, 0.7), True),  # sooner all the same
        ((1.5, 1.0), (np.inf, 0.7), False),
        ((np.inf, 1.0), (np.inf, 0.7), True),
        ((5.0, 4.0), (4.9, 2.5), False),  # it came back before
        (None, (5.0, 0.7), True),
        ((5.0, 1.0), None, True),
    ],
)
def test_gains_that_leave_less_are_not_taken_if_torque_limits_make_the_arm_later_with_them(
    monkeypatch, before, now, taken
):
    """Periods until settled with and without limits, of the gains before and of those of the further search."""
    arm, times, found = arm_file.load("R"), iter([before, now]), []

    def recovery(*_):
        pair = next(times)
        return None if pair is None else Recovery.of([pair])

    monkeypatch.setattr(task_module, "recovery", recovery)

    def leaving(task, sets, progress, asked):
        found.append(1.01 * sets.K)
        return sets._replace(K=found[0])

    monkeypatch.setattr(design_module, "leaving_less", leaving)
    quick = Settings(500.0, 0.002, effort=0.02)
    made = design_module.design_at(arm, quick, UNCERTAIN)
    assert np.array_equal(made.sets, found[0]) == taken


def test_gains_that_would_be_slower_than_asked_are_not_taken(r, monkeypatch):
    task = task_module.Task(r.design.arm, r.design.settings, UNCERTAIN)
    loops, weights = task.held(r.design.sampling, 1)
    search = task.search_of(loops, weights, r.design.sampling)
    x = search.slowest.scaled(r.design.sets)
    reached = -search.value(x)

    size = x @ x

    def pulls(y):
        """Gains that are all zero would be best."""
        return 5.0 * float(y @ y) / size, 10.0 * y / size

    found = search.sooner(x, pulls, 0.8 * reached, 60, 0.0)
    assert pulls(found)[0] < 0.85 * pulls(x)[0] and -search.value(found) > 0.79 * reached
    # Without a penalty they are found, and not taken; nor are gains that bring little.
    monkeypatch.setattr(search_module, "STEEP", 0.0)
    assert search.sooner(x, pulls, 0.8 * reached, 60, 0.0) is x
    assert (
        search.sooner(x, lambda y: (1.0 + 0.01 * pulls(y)[0], 0.01 * pulls(y)[1]), 1e-3, 60, 0.0)
        is x
    )


def test_only_poles_near_the_lowest_frequency_ring_and_the_slowest_counts():
    h, omega = 0.01, 2.0 * np.pi / 0.5
    poles = [-0.05 + 1.0j, -0.2 + 3.0j, -0.01 + 7.0j, -0.02 + 0.4j, -0.03, -0.04]  # over omega
    F = np.zeros((10, 10))
    for k, s in enumerate(poles):
        z = np.exp(s * omega * h)
        at = 2 * k if k < 5 else 9
        if np.imag(s):
            F[at : at + 2, at : at + 2] = [[z.real, z.imag], [-z.imag, z.real]]
        else:
            F[at, at] = z.real
    loop = SimpleNamespace(F=F, G=np.zeros((10, 1)), N=np.zeros((2, 10)), period=h)
    one = Residual(loop, np.zeros((3, 2, 1)), np.zeros((4, 2)), np.zeros((3, 2)), 0.5, 0)
    assert_allclose(one.ringing(np.zeros((1, 2))), 0.05, rtol=1e-9)
    loop.F = np.diag(np.diag(F)[8:])
    loop.G, loop.N = np.zeros((2, 1)), np.zeros((2, 2))
    assert one.ringing(np.zeros((1, 2))) == np.inf


def test_only_arms_whose_joints_rub_are_looked_at_for_what_rings(rough, r):
    left = residuals(rough.task.nominal, np.zeros(1), rough.found.sampling, UNCERTAIN)
    assert [one.rubs for one in left] == 3 * [False, True, True]
    after = AfterMotion(rough.search.slowest, [(0, one) for one in left])
    K = rough.search.slowest.gains(rough.x)[0]
    rubbing = [one.ringing(K) for one in left if one.rubs]
    assert after.ringing(rough.x) == min(rubbing) < np.inf
    smooth = residuals(r.model, np.zeros(1), r.sampling, UNCERTAIN)
    after = AfterMotion(rough.search.slowest, [(0, one) for one in smooth])
    assert after.ringing(rough.x) == np.inf


@pytest.mark.parametrize(
    ("before", "now", "taken"),
    [
        (0.028, 0.018, False),  # random arm 7
        (0.028, 0.026, True),  # hardly less
        (0.2, 0.031, True),  # it does not ring for long
        (0.2, 0.029, False),
        (np.inf, np.inf, True),  # no friction
    ],
)
def test_gains_that_let_a_mode_of_rubbing_joints_ring_longer_are_not_taken(
    rough, monkeypatch, before, now, taken
):
    x = rough.search.slowest.scaled(rough.found.K)
    monkeypatch.setattr(further, "FURTHER", (Further(1e-3, 0.0, 800, 0.5),))
    monkeypatch.setattr(search_module.Search, "sooner", lambda self, x, *_: 1.01 * x)
    monkeypatch.setattr(
        AfterMotion, "ringing", lambda self, y: before if np.array_equal(x, y) else now
    )
    other = leaving_less(rough.task, rough.found, lambda fraction, decay: None)
    assert (other is not None) == taken


def test_ringing_is_judged_by_the_decay_that_is_lost_and_at_a_lower_speed_less_is_asked():
    longer = further._rings_longer
    assert longer(0.02, 0.03, 1.0) and not longer(0.02, 0.03, 0.5)
    assert not longer(-0.01, -0.01, 1.0) and longer(-0.0111, -0.01, 1.0)
    assert longer(0.02, np.inf, 1.0) and not longer(0.04, np.inf, 1.0)  # no mode rang before
    assert not longer(np.inf, np.inf, 1.0)
