# SPDX-License-Identifier: Apache-2.0
"""The feed-forward that simulates the nominal arm: no step of its torque, whatever the reference's jerk does."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_control import trajectory
from flexarm_control.composite.design import design
from flexarm_control.fading import Fading
from flexarm_control.feedforward import model as model_feedforward
from flexarm_control.feedforward.model import PLAN, gains_along, path_of, regulator
from flexarm_control.loop.supervisor import longest_period
from flexarm_control.trajectory import ReferenceGenerator
from flexarm_control.trajectory.path import SlowedPath
from flexarm_control.trajectory.scaling import ScaledPath, TimeLaw
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import linear_plant, moving_plant, sampled
from flexarm_dynamics.models.model import build

MS = 1_000_000
SLOW, FAST, CORRECTED = {"type": "linear_model_following"}, {"type": "lqr"}, {"type": "corrected"}


def faded(time, rate):
    """phi of the module, from 0 on."""
    x = rate * np.maximum(time, 0.0)
    return np.where(time < 0.0, 0.0, (1.0 + x + 0.5 * x * x) * np.exp(-x))


def test_a_mode_that_no_torque_reaches_is_left_out_of_the_regulator():
    arm = arm_file.load("one_link")
    link = arm.links[0]
    bends = {**link.flexible, "z": replace(link.flexible["y"], modes=1)}
    link = replace(link, flexible=bends, stiffness={**link.stiffness, "z": 50.0})
    arm = replace(arm, links=(link,), gravity=(0.0, 0.0, 0.0), gauges=(), observed_modes=())
    both, q = build(arm), np.zeros(1)
    A, B = linear_plant(both, q, coulomb=False)
    closed = np.linalg.eigvals(A - B @ regulator(both, q, 1e-3))
    decay = 0.3 * both.frequencies(locked=True)[0]
    alone = closed[closed.real > -decay]
    assert len(alone) == 2 and np.abs(np.abs(alone[0]) / both.frequencies(q) - 1.0).min() < 1e-3


def test_the_regulator_holds_where_samples_are_too_far_apart_for_that_of_continuous_time():
    model, q = build(arm_file.load("R")), np.zeros(1)
    plant = linear_plant(model, q, coulomb=False)
    gains = {}
    for period in (1e-3, 3e-2):
        Phi, Gamma = sampled(*plant, period)
        gains[period] = regulator(model, q, period)
        assert np.abs(np.linalg.eigvals(Phi - Gamma @ gains[period])).max() < 1.0
    Phi, Gamma = sampled(*plant, 3e-2)
    assert np.abs(np.linalg.eigvals(Phi - Gamma @ gains[1e-3])).max() > 1.0


def test_regulators_hold_everywhere_along_a_motion_there_and_back():
    """Gains are linear in time: between one before the arm turns and one after it, they are of other configurations."""
    model, period = build(arm_file.load("long_reach")), 2e-3
    start, there, back = (
        np.array([0.0, 1.2, 0.8, -0.8]),
        np.array([0.184, 0.959, 1.149, -0.541]),
        np.array([0.009, 1.099, 1.024, -0.716]),
    )
    names, still = model.joint_names, np.zeros(4)
    points = [(2724, there), (3124, there), (5024, back)]
    data = trajectory.validate(names, names, 0, [(t * MS, q, still, still, []) for t, q in points])
    path = path_of(data, np.stack([start, still, still]))
    gains, state = gains_along(model, path, period), np.zeros((3, 4))
    for t in np.linspace(0.0, 5.02, 50):
        path.evaluate(round(t * 1e9), state)
        for plant in (linear_plant(model, state[0], coulomb=False), moving_plant(model, *state)):
            Phi, Gamma = sampled(*plant, period)
            assert np.abs(np.linalg.eigvals(Phi - Gamma @ gains.at(t))).max() < 1.0, t


def test_a_stop_on_the_way_ends_with_the_regulator_of_the_arm_at_rest(two_link):
    names, still, start = two_link.joint_names, np.zeros(2), np.array([0.0, 0.3])
    motion = joint_pid_motion(two_link)
    points = [(800 * MS, np.array([1.2, 1.0]), still, still, [])]
    data = trajectory.validate(names, names, 0, points)
    prepared = motion.prepare(data, np.stack([start, still, still]))
    path, t = path_of(data, np.stack([start, still, still])), 0.2
    path.begin(0, np.stack([start, still, still]))
    stop = SlowedPath(path, round(t * 1e9), 400 * MS)
    moving, resting = prepared.gains.at(t), prepared.at_rest.at(t)
    assert np.abs(moving - resting).max() > 1e-3 * np.abs(moving).max()
    assert_array_equal(prepared.at(t, path, round(t * 1e9)), moving)
    assert_array_equal(prepared.at(t, stop, round(t * 1e9)), moving)
    assert_array_equal(prepared.at(t, stop, 700 * MS), resting)
    half = next(k for k in range(200, 600) if stop.speed(k * MS) < np.sqrt(0.5)) * MS
    share = stop.pace(half) ** 2
    assert_allclose(prepared.at(t, stop, half), share * moving + (1.0 - share) * resting)
    # At half the speed the acceleration is a quarter.
    slow = ScaledPath(path, TimeLaw(0, 0.0, 0.5))
    assert slow.pace(100 * MS) == 0.5
    assert_allclose(prepared.at(t, slow, 100 * MS), 0.25 * moving + 0.75 * resting)


@pytest.mark.parametrize(("factor", "more"), [(0.5, 1.1), (0.0, 1.2)])
def test_where_the_speed_is_scaled_on_the_way_the_plan_goes_on_beside_the_slower_motion(
    two_link, factor, more
):
    """Dropped at once, the plan leaves the simulated arm 1.4 and 1.7 times as far from the reference."""
    whole, _ = planned_motion(two_link, 3.0)
    scaled, late = planned_motion(two_link, 3.0, factor)
    assert scaled < more * whole
    assert late < 1e-4


def test_what_has_faded_of_a_plan_does_not_come_back(two_link):
    names, still, start = two_link.joint_names, np.zeros(2), np.array([0.0, 0.3])
    generator = ReferenceGenerator(names)
    generator.start(start, 0)
    generator.sample(0)
    data = trajectory.validate(names, names, 0, [(3000 * MS, start + 0.9, still, still, [])])
    generator.offer(data)
    generator.sample(0)
    assert generator.path.kept == 1.0

    def scale(stamp, factor):
        generator.sample(stamp)
        generator.scale(factor, 2.0, given=False)
        return generator.path.kept

    assert scale(500 * MS, 0.5) == 1.0
    assert_allclose(scale(2000 * MS, 1.0), 0.5, atol=1e-3)
    assert generator.path.pace(3000 * MS) > 0.7 > generator.path.kept
    assert_allclose(scale(3000 * MS, 0.2), 0.5, atol=1e-3)
    generator.sample(3100 * MS)
    stop = SlowedPath(generator.path, 3100 * MS, 400 * MS)
    assert_allclose(stop.kept, 0.5, atol=1e-3)
    # A trajectory that begins slower has no plan.
    generator.start(start, 9000 * MS)
    generator.sample(9001 * MS)
    generator.offer(replace(data, stamp_ns=0, positions=data.positions - 0.1))
    generator.sample(9002 * MS)
    assert generator.path.scaled and generator.path.kept == 0.0


def planned_motion(model, duration, factor=None):
    """Largest and last distance of the simulated arm from a reference that changes its speed on the way [rad]."""
    names, still, start = model.joint_names, np.zeros(2), np.array([0.0, 0.3])
    motion = joint_pid_motion(model, "preview")
    motion.limit = model.arm.torque_limits
    generator = ReferenceGenerator(names, period=longest_period(model))
    generator.start(start, 0)
    generator.sample(0)
    end = round(1e9 * duration)
    data = trajectory.validate(names, names, 0, [(end, start + 0.9, still, still, [])])
    prepared = motion.prepare(data, np.stack([start, still, still]))
    motion.take(prepared, generator.offer(data).trajectory_id)
    away = []
    for stamp in range(MS, round(2.5 * end), MS):
        generator.sample(stamp)
        if stamp == round(0.3 * end) and factor is not None:
            generator.scale(factor, 2.0, given=False)
        motion.update(generator, 1e-3 if away else 0.0)
        away.append(np.abs(motion.position - generator.position).max())
    assert prepared.plan is not None
    return max(away), away[-1]


def joint_pid_motion(model, kind="model"):
    laws = {"type": "joint_pid", "stiffness": [0.01], "damping": [0.01]}, {"type": "none"}
    settings = {"feedforward": kind, "stability_margin": -1000.0}
    return design(model, *laws, {"type": "reference"}, settings).feedforward


def test_after_a_motion_that_ends_with_an_acceleration_the_regulator_is_that_of_rest(two_link):
    names, none, start = two_link.joint_names, np.zeros(2), np.zeros((3, 2))
    points = [(800 * MS, np.array([1.2, 1.0]), none, [], [])]  # a cubic
    data = trajectory.validate(names, names, 0, points)
    prepared = joint_pid_motion(two_link).prepare(data, start)
    for t in (0.0, 0.8, 2.0):
        assert_allclose(prepared.gains.at(t), prepared.at_rest.at(t), rtol=1e-6, atol=1e-9)
    moving, resting = prepared.gains.at(0.7), prepared.at_rest.at(0.7)
    assert np.abs(moving - resting).max() > 1e-3 * np.abs(moving).max()


def test_where_no_regulator_holds_the_moving_arm_that_of_rest_remains(two_link, monkeypatch):
    def none(*_):
        raise DesignError("swings", field="feedforward")

    monkeypatch.setattr(model_feedforward, "moving_plant", none)
    names, still = two_link.joint_names, np.zeros(2)
    data = trajectory.validate(names, names, 0, [(800 * MS, np.ones(2), still, still, [])])
    prepared = joint_pid_motion(two_link).prepare(data, np.zeros((3, 2)))
    assert prepared.gains is prepared.at_rest and prepared.note == "feedforward: swings"


def test_a_preparation_comes_in_parts_each_of_use_without_the_next(two_link):
    names, still, start = two_link.joint_names, np.zeros(2), np.zeros((3, 2))
    data = trajectory.validate(names, names, 0, [(3000 * MS, np.ones(2), still, still, [])])
    motion = joint_pid_motion(two_link, "preview")
    first = motion.prepare_next(data, start, None)
    assert first.gains is first.at_rest and first.gains is not None and first.plan is None
    second = motion.prepare_next(data, start, first)
    assert second.gains is not second.at_rest and second.plan is None and second.left == (PLAN,)
    third = motion.prepare_next(data, start, second)
    assert third.plan is not None and not third.left and not third.note
    whole = motion.prepare(data, start)
    assert_array_equal(whole.gains.gains, third.gains.gains)
    assert_array_equal(whole.plan.torque, third.plan.torque)


def test_a_slow_motion_takes_no_more_designs_than_one_of_an_arm_at_rest(two_link):
    names, still, counts = two_link.joint_names, np.zeros(2), {}
    for seconds in (1, 60):
        points = [(1000 * seconds * MS, np.ones(2), still, still, [])]
        path = path_of(trajectory.validate(names, names, 0, points), np.zeros((3, 2)))
        counts[seconds] = [len(gains_along(two_link, path, 2e-3, m).times) for m in (True, False)]
    assert counts[60][0] <= counts[60][1] + 2 and counts[1][0] > 2 * counts[1][1]


def test_a_motion_that_the_first_sample_is_in_begins_at_rest(arm_r):
    names = arm_r.joint_names
    motion = design(arm_r, SLOW, FAST, CORRECTED, {"feedforward": "model"}).feedforward
    reference = ReferenceGenerator(names, period=0.5)
    reference.start(np.zeros(1), 0)
    data = trajectory.validate(names, names, 0, [(400 * MS, [1.0], [0.0], [0.0], [])])
    assert reference.offer(data).accepted
    reference.sample(0)
    motion.update(reference, 0.0)
    # The manifold's own amplitude is -3 mm there: of the snap with which the motion begins.
    assert_allclose(motion.amplitude, 0.0, atol=1e-12)
    assert_allclose(motion.torque, 0.0, atol=1e-9)


def test_a_motion_says_where_it_was_put_elsewhere(arm_r):
    """At first, and when its simulated arm is lost; looked ahead or not."""
    motion = design(arm_r, SLOW, FAST, CORRECTED, {"feedforward": "model"}).feedforward
    reference, placed = ReferenceGenerator(arm_r.joint_names, period=0.5), []
    reference.start(np.zeros(1), 0)
    reference.offer(
        trajectory.validate(
            arm_r.joint_names, arm_r.joint_names, 0, [(MS * 900, [1.0], [0.0], [0.0], [])]
        )
    )
    for k in range(12):
        reference.sample(k * MS)
        if k == 6:
            motion.state[0] += 2.0
        motion.update(reference, 1e-3 if k else 0.0)
        placed.append(motion.placed)
        if k % 2 and k != 5:
            motion.look_ahead(reference, 1e-3)
    assert placed == [k in (0, 6) for k in range(12)]


@pytest.mark.parametrize("change", ["friction", "weight"])
def test_the_simulated_arm_comes_to_rest_on_the_reference(two_link, change):
    """Neither Coulomb friction nor what the manifold leaves out of the weight holds it beside."""
    rough, arm = Friction(viscous=0.0, coulomb=0.3, smoothing=0.01), two_link.arm
    if change == "friction":
        arm = replace(arm, joints=tuple(replace(joint, friction=rough) for joint in arm.joints))
    else:
        arm = replace(arm, gravity=(0.0, -0.98, 0.0))
    model, names, none = build(arm), two_link.joint_names, np.zeros(2)
    motion = joint_pid_motion(model)
    reference, start, end = ReferenceGenerator(names), np.array([0.0, 0.3]), np.array([0.5, 0.5])
    reference.start(start, 0)
    data = trajectory.validate(names, names, 0, [(2000 * MS, end, none, none, [])])
    verdict = reference.offer(data)
    assert verdict.accepted
    motion.take(motion.prepare(data, np.stack([start, none, none])), verdict.trajectory_id)
    for k in range(8000):
        reference.sample(k * MS)
        motion.update(reference, 1e-3 if k else 0.0)
    assert_allclose(motion.position, end, rtol=0.0, atol=2e-5)
    assert_allclose(motion.amplitude, model.static_deflection(end), atol=1e-5)


def test_jumps_add_up_and_fade_whatever_the_samples():
    fading, rng, now = Fading(2, 20.0), np.random.default_rng(0), 0.0
    jumps = {0.0: [1.0, -2.0], 0.1: [0.5, 3.0]}
    for then in sorted([*rng.uniform(0.0, 0.4, 30), *jumps]):
        fading.advance(then - now)
        now = then
        if then in jumps:
            fading.jump(np.array(jumps[then]))
        wanted = sum(faded(then - t, 20.0) * np.array(j) for t, j in jumps.items() if t <= then)
        assert_allclose(fading.left, wanted, rtol=1e-9)
    again = pickle.loads(pickle.dumps(fading))
    again.advance(0.1)
    fading.advance(0.1)
    assert_allclose(again.left, fading.left, rtol=0.0, atol=0.0)
    fading.advance(10.0)
    assert not fading.left.any()


def torques(model, fields, stop=None, until=2.6):
    """Feed-forward torque (k, 1) of a motion of 1 rad in 2 s, sampled at 1 kHz from before its start; the motion."""
    names = model.joint_names
    motion = design(model, SLOW, FAST, CORRECTED, {"feedforward": "model"}).feedforward
    reference = ReferenceGenerator(names, period=0.5)
    reference.start(np.zeros(1), 0)
    point = (2000 * MS, *([1.0], [0.0], [0.0])[:fields], *([[]] * (4 - fields)))
    data, out = trajectory.validate(names, names, 0, [point]), []
    for k in range(-5, round(1000 * until)):
        if k == 0:
            assert reference.offer(data).accepted
        if stop is not None and k == round(1000 * stop):
            reference.stop((k + 4) * MS, 10.0, given=False)
        reference.sample((k + 5) * MS)
        motion.update(reference, 1e-3 if out else 0.0)
        out.append(motion.torque.copy())
    return np.array(out), motion


@pytest.mark.parametrize("fields", [1, 2, 3])
def test_a_motion_begins_and_ends_without_a_step_of_torque(arm_r, fields):
    """Linear points jump in velocity, cubic ones in acceleration, quintic ones in jerk."""
    u, motion = torques(arm_r, fields)
    steps = np.abs(np.diff(u, axis=0)).max(axis=1)
    assert steps.max() < {1: 1.6, 2: 0.32, 3: 0.045}[fields]  # without fading: 45, 7.3 and 1.75
    assert_allclose(motion.position, 1.0, atol=5e-3)


@pytest.mark.parametrize("stop", [0.0, 0.002, 0.3, 1.0, 1.6, 1.99])
def test_a_stop_takes_no_step_of_torque(arm_r, stop):
    u, motion = torques(arm_r, 3, stop, 4.0)
    assert np.abs(np.diff(u, axis=0)).max() < 0.05
    assert np.abs(motion.velocity).max() < 1e-4
    assert np.abs(u[-1]).max() < 1e-3
