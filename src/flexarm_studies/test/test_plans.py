# SPDX-License-Identifier: Apache-2.0
"""Feed-forwards of random arms: regulators along a motion, and plans of motions that end at rest."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.composite.assembly import control
from flexarm_control.feedforward import base, planner
from flexarm_control.feedforward.model import ModelFeedforward, path_of
from flexarm_control.feedforward.planner import Planner
from flexarm_control.feedforward.preview import Preview
from flexarm_control.trajectory import ReferenceGenerator
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import DesignError, ModelError
from flexarm_dynamics.linear import linear_plant, moving_plant, sampled, static_torque
from flexarm_dynamics.models import model
from flexarm_studies.loop import scenario
from flexarm_studies.random_arms import generator


def reference_manifold(known):
    return control(
        known, {"slow.type": "joint_pid", "fast.type": "none", "stability_margin": -1000.0}
    ).manifold


def prepared(number, kind, torque=1.0, share=base.SHARE):
    """The arm's model, its motion's path, and what a feed-forward makes of it with a part of the torque limits.

    Of these, a plan takes the `share`.
    """
    case = generator.arm(number)
    known = model.build(case.read().known)
    n = known.n_joints
    motion = scenario.trajectory_of(case.motion, known, np.zeros(n))
    start = np.zeros((3, n))
    start[0] = motion.positions[0]
    settings = base.Settings(2e-3, start[0], share=share)
    forward = kind(known, reference_manifold(known), settings)
    forward.limit = torque * known.arm.torque_limits
    found = forward.prepare(motion, start)
    reference = ReferenceGenerator(known.joint_names)
    reference.start(start[0], 0)
    verdict = reference.offer(motion)
    forward.take(found, verdict.trajectory_id)
    for k in range(20):
        reference.sample(2_000_000 * k)
        forward.update(reference, 2e-3 if k else 0.0)
    assert np.abs(forward.position - reference.position).max() < np.radians(10.0)
    return known, path_of(motion, start), found


def test_regulators_hold_an_arm_that_its_motion_bends_where_those_of_rest_do_not():
    known, path, found = prepared(10, ModelFeedforward)
    state, resting = np.zeros((3, known.n_joints)), []
    for t in np.linspace(0.0, 1e-9 * path.duration_ns, 60):
        path.evaluate(min(round(t * 1e9), path.duration_ns - 1), state)
        Phi, Gamma = sampled(*moving_plant(known, *state), 2e-3)
        assert np.abs(np.linalg.eigvals(Phi - Gamma @ found.gains.at(t))).max() < 1.0, t
        K = found.at_rest.at(t)
        resting.append(np.abs(np.linalg.eigvals(Phi - Gamma @ K)).max())
        Phi, Gamma = sampled(*linear_plant(known, state[0], coulomb=False), 2e-3)
        assert np.abs(np.linalg.eigvals(Phi - Gamma @ K)).max() < 1.0, t
    assert max(resting) > 1.0


def test_a_motion_that_torque_allows_no_preview_of_is_regulated_all_the_same():
    _, _, found = prepared(10, Preview, torque=0.3)
    assert found.plan is None and found.note.startswith("preview: ")
    assert found.gains is not None


def test_a_plan_has_half_of_the_torque_to_use():
    known, _, found = prepared(10, Preview, torque=0.5)
    share = np.abs(found.plan.torque) / (0.5 * known.arm.torque_limits)
    assert share.max() <= 1.0 and share.max(axis=0).min() > 0.94


@pytest.mark.long
def test_a_plan_that_torque_binds_converges_where_it_is_linearised_often_enough(monkeypatch):
    ours, _ = planners(7, 0.0)
    assert (np.abs(ours.solve().torque) <= ours.limit).all()
    monkeypatch.setattr(planner, "KNOTS", (80, 80))
    with pytest.raises(DesignError, match="still change after"):
        planners(7, 0.0)[0].solve()


def planned(monkeypatch, both=False, simpler=True):
    """What is planned for arm 10 with a mode more, where no plan of it is found; of `both`: nor of the known arm."""
    solve, case = Planner.solve, generator.arm(10)
    known = model.build(case.read().known)
    fuller, n = known.fuller(known.arm.most_modes + 1), known.n_joints

    def refuses(self):
        if both or self.model.n_modes > known.n_modes:
            raise DesignError("there is none", field="preview")
        return solve(self)

    monkeypatch.setattr(Planner, "solve", refuses)
    motion = scenario.trajectory_of(case.motion, known, np.zeros(n))
    start = np.zeros((3, n))
    start[0] = motion.positions[0]
    settings = base.Settings(2e-3, start[0], known if simpler else None)
    forward = Preview(fuller, reference_manifold(known).of(fuller), settings)
    forward.limit = known.arm.torque_limits
    first = forward.prepare_next(motion, start, None)
    return known, fuller, forward.prepare_next(motion, start, replace(first, left=("plan",)))


@pytest.mark.parametrize(("both", "note"), [(False, ""), (True, "preview: there is none")])
def test_where_a_fuller_arm_has_no_plan_that_of_the_known_one_is_followed(both, note, monkeypatch):
    """Where the known one has none, either: its regulated motion."""
    known, fuller, found = planned(monkeypatch, both)
    plan, n = found.plan, known.n_joints
    assert found.note == note
    assert (np.abs(plan.torque) <= known.arm.torque_limits).all()
    further = [n + i for i, name in enumerate(fuller.mode_names) if name not in known.mode_names]
    state = plan.state_at(0.5 * plan.duration)
    assert state.shape == (2 * (n + fuller.n_modes),)
    assert not state[further].any() and np.abs(state[n : n + fuller.n_modes]).max() > 1e-3


def test_without_a_known_arm_there_is_no_other_plan(monkeypatch):
    assert planned(monkeypatch, simpler=False)[2].plan is None


@pytest.mark.parametrize("stabler", [planner.STABLER, planner.STABLE])
def test_a_plan_beyond_all_bounds_is_made_again_in_shorter_steps_if_there_are(stabler, monkeypatch):
    bend, steps = Planner._bend, []

    def diverges_at_first(self):
        steps.append(self.steps)
        x, v = bend(self)
        return (x, v) if self.steps > steps[0] else (np.full_like(x, np.inf), v)

    monkeypatch.setattr(Planner, "_bend", diverges_at_first)
    monkeypatch.setattr(planner, "STABLER", stabler)
    _, _, found = prepared(10, Preview)
    if stabler < planner.STABLE:
        assert found.plan is not None and not found.note
        assert steps[1] >= 1.9 * steps[0]
    else:
        assert found.plan is None and "does not stand this motion" in found.note
        assert len(steps) == 1


def test_a_mode_across_the_joint_is_not_planned_where_slopes_are_finite():
    case = generator.arm(25)
    known = model.build(case.read().known)
    fuller = known.fuller(3, finite_slope=True)
    motion = scenario.trajectory_of(case.motion, known, np.zeros(1))
    start = np.stack([motion.positions[0], np.zeros(1), np.zeros(1)])
    plan = Planner(fuller, path_of(motion, start), start, known.arm.torque_limits).solve()
    assert (np.abs(plan.torque) < 0.8 * known.arm.torque_limits).all()


@pytest.mark.parametrize("share", [base.SHARE, 0.9])
def test_a_plan_that_torque_binds_is_smooth_and_leaves_some_to_the_feedback(share):
    known, _, found = prepared(10, Preview, share=share)
    torque, limits = np.abs(found.plan.torque), known.arm.torque_limits
    assert (torque < (share + 0.01) * limits).all()
    assert (torque.max(axis=0) > (share - 0.01) * limits).any()


@pytest.mark.parametrize(("duration", "most"), [(2.28, 0.1), (2.0, 0.5)])
def test_a_plan_is_not_shifted_for_a_weight_that_takes_most_of_the_torque(duration, most):
    """Of an arm with weight of 0.85 of its limit; what it leaves is hardly enough for the shorter motion."""
    case = generator.arm(0)
    known = model.build(case.read().known)
    positions = scenario.trajectory_of(case.motion, known, np.zeros(1)).positions
    start = np.stack([positions[0], np.zeros(1), np.zeros(1)])
    words = f"quintic:to={positions[-1][0]},duration={duration}"
    motion = scenario.trajectory_of(words, known, start[0])
    weights = [abs(static_torque(known, q)) for q in positions]
    limit = np.max(weights, axis=0) / 0.85
    plan = planner.planned(known, path_of(motion, start), start, limit, 0.0, 0.75)
    times = np.linspace(0.0, plan.duration, 100)
    at = np.zeros((3, 1))
    off = []
    for t in times:
        path_of(motion, start).evaluate(min(round(1e9 * t), round(1e9 * plan.duration) - 1), at)
        off.append(plan.state_at(t)[0] - at[0, 0])
    assert np.degrees(np.abs(off).max()) < most


def test_the_compiled_bending_of_a_plan_is_that_of_the_equations():
    case = generator.arm(10)
    known = model.build(case.read().known)
    motion = scenario.trajectory_of(case.motion, known, np.zeros(2))
    start = np.stack([motion.positions[0], np.zeros(2), np.zeros(2)])
    here = Planner(known, path_of(motion, start), start, known.arm.torque_limits)
    here._along(np.zeros((2, here.basis.shape[2])))
    compiled = here._bend()
    here.stepper = None
    for found, wanted in zip(compiled, here._bend(), strict=True):
        assert_allclose(found, wanted, rtol=0.0, atol=1e-5 * np.abs(wanted).max())


def test_a_mode_that_no_joint_moves_is_not_planned():
    known, _, found = prepared(41, Preview)
    assert found.plan is not None and not found.note
    assert (np.abs(found.plan.torque) <= known.arm.torque_limits).all()


# Modes that no torque reaches ----------------------------------------------------------------------


def planners(number, spread, payload=1.0, stiffness=1.0):
    """The planner for a random arm as its file says, and one for the arm that is really there."""
    case = generator.arm(number)
    known, n = case.read().known, len(case.read().joints)
    motion = scenario.trajectory_of(case.motion, model.build(known), np.zeros(n))
    start = np.stack([motion.positions[0], np.zeros(n), np.zeros(n)])
    arms = (
        model.build(scaled(known, *factors)).fuller(known.most_modes + 1, finite_slope=True)
        for factors in ((1.0, 1.0), (payload, stiffness))
    )
    limits = case.read().torque_limits
    return [Planner(arm, path_of(motion, start), start, limits, spread) for arm in arms]


@cache
def plan_of(number, spread):
    """The plan of a random arm's motion."""
    return planners(number, spread)[0].solve()


def left_across(plan, real):
    """Amplitude of the tip over the reach, across the motion, that the joints' planned motion leaves on a real arm."""
    real.motion = np.stack([plan.motion(real.times, k)[:, :1] for k in range(3)], axis=1)
    x, v = real._bend()
    end = real._left(x[-1], v[-1])
    amplitude, rate = end[: real.planned.size], end[real.planned.size :] / real.planned
    return (np.hypot(amplitude, rate) * real.shown)[~real.driven].max()


@pytest.mark.parametrize(
    ("payload", "stiffness"), [(1.0, 1.0), (0.7, 1.0), (1.3, 1.0), (1.0, 0.9), (1.0, 1.1)]
)
@pytest.mark.parametrize("number", [25, 57, 89])
def test_a_plan_leaves_little_in_a_mode_that_no_torque_reaches(number, payload, stiffness):
    plan, (_, real) = plan_of(number, 0.15), planners(number, 0.0, payload, stiffness)
    assert (np.abs(plan.torque) <= real.limit).all()
    assert left_across(plan, real) < 4e-4
    if payload == stiffness == 1.0:
        assert left_across(plan, real) < 3e-5
    if payload > 1.0:
        assert left_across(plan_of(number, 0.0), real) > 2.0 * left_across(plan, real)


def test_a_mode_that_no_torque_reaches_is_left_where_the_torque_does_not_suffice():
    (ours, real), (plain, _) = planners(89, 0.15), planners(89, 0.0)
    for part in ours, plain:
        part.limit, part.share = 0.69 * part.limit, 0.95  # the plain plan takes 0.68
    assert left_across(plain.solve(), real) < 1e-3
    assert left_across(ours.solve(), real) < 1e-3


def test_a_plan_that_is_not_found_with_such_modes_is_made_without_them(monkeypatch):
    solve, tries = Planner._solved, []

    def fails_at_first(self):
        tries.append(self.spread)
        plan = solve(self)
        if self.spread:
            raise DesignError("none", field="preview")
        return plan

    monkeypatch.setattr(Planner, "_solved", fails_at_first)
    ours, _ = planners(89, 0.15)
    plan = ours.solve()
    assert tries == [0.15, 0.0]
    assert_allclose(plan.torque, plan_of(89, 0.0).torque)


def test_where_too_little_torque_leaves_no_plan_more_of_it_is_used(monkeypatch):
    tries = []

    def fails_below(self):
        tries.append((self.share, self.spread))
        if self.share < base.SHARE:
            raise DesignError("none", field="preview")
        return "plan"

    monkeypatch.setattr(Planner, "_solved", fails_below)
    ours, _ = planners(89, 0.15)
    ours.share = 0.75
    assert ours.solve() == "plan"
    assert tries == [(0.75, 0.15), (base.SHARE, 0.15)]


def test_arms_with_other_frequencies_carry_the_same_payload():
    case = generator.arm(89)
    known = model.build(case.read().known)
    motion = scenario.trajectory_of(case.motion, known, np.zeros(1))
    start = np.stack([motion.positions[0], np.zeros(1), np.zeros(1)])
    heavier = known.fuller(3, finite_slope=True).with_payload(1.3)
    ours = Planner(heavier, path_of(motion, start), start, case.read().torque_limits, 0.15)
    ours.solve()
    ratios = [other.planned / ours.planned for other in ours._others]
    assert_allclose(np.mean(ratios, axis=1), [0.85, 0.925, 1.075, 1.15], rtol=0.01)


@pytest.mark.parametrize("at_end", [True, False])
def test_a_softer_arm_that_does_not_rest_at_either_end_is_left_out(at_end, monkeypatch):
    (ours, _), soft, make = planners(89, 0.15), [], planner.made

    def made(arm, payload):
        other = make(arm, payload)
        if not soft:
            soft.append(other)
            rest, q_end = other.static_deflection, ours.reference[-1, 0]

            def folds(q):
                if np.allclose(q, q_end if at_end else ours.start[0]):
                    raise ModelError("folds under its own weight")
                return rest(q)

            other.static_deflection = folds
        return other

    monkeypatch.setattr(planner, "made", made)
    others = list(ours._alike())
    assert len(others) == 3 and all(other.model is not soft[0] for other in others)
    soft.clear()
    assert np.isfinite(ours.solve().torque).all()


def test_arms_that_do_not_rest_if_they_are_softer_are_left_out(monkeypatch):
    def folds(arm, scale):
        raise ModelError("folds under its own weight")

    monkeypatch.setattr(planner, "made", folds)
    ours, real = planners(89, 0.15)
    assert left_across(ours.solve(), real) < 2e-4 and ours._others == []


def test_a_mode_that_the_motion_does_not_excite_is_not_looked_at():
    ours, _ = planners(1, 0.15)  # no gravity, no sag
    ours.solve()
    assert not ours.moved.all() and ours._others is None


def test_an_arm_whose_modes_are_all_reached_is_planned_once():
    known, path, _ = prepared(10, Preview)
    start = np.zeros((3, 2))
    path.evaluate(0, start)
    start[1:] = 0.0
    ours = Planner(known, path, start, known.arm.torque_limits, 0.15)
    plan = ours.solve()
    assert ours._others is None
    plain = Planner(known, path, start, known.arm.torque_limits)
    assert (plan.torque == plain.solve().torque).all()
