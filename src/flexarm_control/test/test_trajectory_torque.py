# SPDX-License-Identifier: Apache-2.0
"""A trajectory that needs more torque than the joints have is refused, and changes nothing."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_control import trajectory
from flexarm_control.composite.design import design
from flexarm_control.composite.designer import Designer
from flexarm_control.loop.arm_controller import PARAMETERS, ArmController
from flexarm_control.loop.samples import ArmSample
from flexarm_control.motions import profiles
from flexarm_control.trajectory import refuse_torque, validate
from flexarm_control.trajectory.torque import required_torque
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import TrajectoryError
from flexarm_dynamics.models.model import build
from flexarm_dynamics.parameters import check_all
from flexarm_dynamics.singular_perturbation import slow_torque


@pytest.fixture(scope="module")
def hanging():
    """Arm one_link in a vertical plane: 0 is horizontal, -pi/2 hangs."""
    return build(replace(arm_file.load("one_link"), gravity=(0.0, -9.81, 0.0)))


def quintic(duration, *goal, stamp=0):
    names = tuple(f"joint{i + 1}" for i in range(len(goal)))
    still = [0.0] * len(goal)
    return validate(names, names, stamp, [(round(1e9 * duration), list(goal), still, still, ())])


def rest(*position):
    return np.array([position, np.zeros(len(position)), np.zeros(len(position))])


def peak(model, duration, *goal):
    """Largest torque of each joint of a quintic from zero, on a fine grid."""
    profile = profiles.quintic(np.zeros(len(goal)), np.array(goal), duration)
    t = np.linspace(0.0, duration, 2001)
    states = zip(profile.position(t), profile.velocity(t), profile.acceleration(t), strict=True)
    return np.abs([slow_torque(model.terms(q, qd), qdd) for q, qd, qdd in states]).max(0)


def test_the_torque_is_that_of_the_slow_subsystem(two_link):
    rng = np.random.default_rng(1)
    motion = rng.uniform(-1.0, 1.0, (5, 3, 2))
    wanted = [slow_torque(two_link.terms(q, qd), qdd) for q, qd, qdd in motion]
    assert_array_equal(required_torque(two_link, motion), wanted)


@pytest.mark.parametrize("duration", [0.7, 2.0])
def test_a_motion_is_judged_by_its_peak(two_link, duration):
    needed = peak(two_link, duration, 0.8, 0.8)
    motion = quintic(duration, 0.8, 0.8)
    refuse_torque(two_link, motion, rest(0.0, 0.0), needed)
    for joint in range(2):
        limit = needed.copy()
        limit[joint] *= 0.98
        with pytest.raises(TrajectoryError) as refused:
            refuse_torque(two_link, motion, rest(0.0, 0.0), limit)
        error = refused.value
        assert error.field.startswith(f"points[0]: torque of joint joint{joint + 1} at ")
        assert abs(error.value) == pytest.approx(needed[joint], rel=5e-3)
        assert error.limit == pytest.approx(limit[joint], rel=1e-5)


def test_the_error_names_joint_time_torque_limit_and_how_much_slower(two_link):
    needed = peak(two_link, 0.7, 0.8, 0.8)
    with pytest.raises(TrajectoryError) as refused:
        refuse_torque(two_link, quintic(0.7, 0.8, 0.8), rest(0.0, 0.0), needed / [4.0, 1.0])
    text = str(refused.value)
    assert "N m are needed there, more than the torque limit" in text
    slower = float(text.split("give it ")[1].split(" times")[0])
    assert slower == pytest.approx(2.0, rel=0.1)  # torques of a motion fall with its time squared
    place = float(refused.value.field.split(" at ")[1].removesuffix(" s"))
    assert 0.0 < place < 0.7


def test_weight_counts_and_a_place_where_it_can_not_be_held_is_named(hanging):
    hold = abs(slow_torque(hanging.terms(np.zeros(1), np.zeros(1)), np.zeros(1))[0])
    slowly = quintic(20.0, 0.0)
    start = rest(-1.5)
    refuse_torque(hanging, slowly, start, np.array([1.02 * hold]))
    with pytest.raises(TrajectoryError, match=r"can't be held there: choose other positions"):
        refuse_torque(hanging, slowly, start, np.array([0.9 * hold]))


def test_of_positions_alone_what_is_smooth_is_judged(hanging):
    names = ("joint1",)
    hold = abs(slow_torque(hanging.terms(np.zeros(1), np.zeros(1)), np.zeros(1))[0])
    jump = validate(names, names, 0, [(1_000_000, [-1.0], (), (), ())])
    refuse_torque(hanging, jump, rest(-1.5), np.array([0.9 * hold]))
    up = validate(names, names, 0, [(5_000_000_000, [0.0], (), (), ())])
    with pytest.raises(TrajectoryError, match="can't be held there"):
        refuse_torque(hanging, up, rest(-1.5), np.array([0.9 * hold]))


def test_steps_of_the_acceleration_between_cubics_are_judged_on_both_sides(two_link):
    names, zero = ("joint1", "joint2"), [0.0, 0.0]
    points = [(500_000_000, [0.4, 0.0], zero, (), ()), (2_500_000_000, [0.5, 0.0], zero, (), ())]
    motion = validate(names, names, 0, points)
    # 6 D / T^2 at the ends of the first polynomial.
    ends = [(rest(0.0, 0.0), 9.6), (rest(0.4, 0.0), -9.6)]
    needed = []
    for state, acceleration in ends:
        state[2, 0] = acceleration
        needed.append(np.abs(required_torque(two_link, state[None])[0]))
    needed = np.max(needed, axis=0)
    refuse_torque(two_link, motion, rest(0.0, 0.0), 1.05 * needed)
    with pytest.raises(TrajectoryError, match=r"points\[0\]: torque of joint joint1"):
        refuse_torque(two_link, motion, rest(0.0, 0.0), 0.95 * needed)


def test_a_joint_without_limit_is_not_judged(two_link):
    refuse_torque(two_link, quintic(0.01, 1.0, 1.0), rest(0.0, 0.0), np.full(2, np.inf))
    limit = np.array([np.inf, 1e-3])
    with pytest.raises(TrajectoryError, match="joint2"):
        refuse_torque(two_link, quintic(0.01, 1.0, 1.0), rest(0.0, 0.0), limit)


def test_the_cost_of_many_points_is_bounded_and_a_single_spike_is_found(arm_r):
    count = 9000
    stamps = np.arange(1, count + 1) * 1_000_000
    zero = [0.0]
    points = [(int(t), zero, zero, zero, ()) for t in stamps]
    spike = 4567
    points[spike] = (int(stamps[spike]), zero, zero, [50.0], ())
    motion = validate(("joint1",), ("joint1",), 0, points)
    counted = []
    model = replace_terms(arm_r, counted)
    limit = arm_r.arm.torque_limits
    with pytest.raises(TrajectoryError, match=rf"points\[{spike}\]|points\[{spike + 1}\]"):
        refuse_torque(model, motion, rest(0.0), limit)
    assert len(counted) < 2100


def replace_terms(model, counted):
    """A model that counts how often it is asked for its terms."""

    class Counting:
        n_joints, joint_names = model.n_joints, model.joint_names

        def terms(self, *args):
            counted.append(1)
            return model.terms(*args)

    return Counting()


# The controller --------------------------------------------------------------------------------


def started(model, **settings):
    """A controller that has answered a sample."""
    law = design(model, {"type": "linear_model_following"}, {"type": "none"})
    sizes = {"joints": model.n_joints, "modes": model.n_modes}
    core = ArmController(model, law, check_all(PARAMETERS, settings, sizes))
    step(core, 0)
    return core


def step(core, k):
    sample = ArmSample(1, 2)
    sample.stamp_ns, sample.session, sample.sequence = 10**9 + k * 10**6, 1, k
    sample.position[:], sample.rate = core.reference.position, np.zeros(2)
    return core.step(sample)


def test_a_refusal_leaves_the_motion_and_the_state(arm_r):
    def moved(*offers):
        core = started(arm_r)
        assert core.offer(quintic(1.0, 0.2)).accepted
        found = []
        for k in range(1, 60):
            if k == 20:
                for motion in offers:
                    verdict = core.offer(motion)
                    assert not verdict.accepted and verdict.trajectory_id == 0
                    assert core.reason == verdict.reason
                    assert "more than the torque limit (13.5582)" in verdict.reason
            step(core, k)
            found.append([*core.reference.position, *core.torque, core.state, core.trajectory_id])
        return found

    later = quintic(0.5, 2.0, stamp=10**9 + 40 * 10**6)
    assert_array_equal(moved(quintic(0.5, 2.0), later), moved())


def test_the_margin_scales_the_limit_and_zero_turns_the_check_off(arm_r):
    motion = quintic(1.0, 1.57)  # 5 % more than arm R has
    assert not started(arm_r).offer(motion).accepted
    assert started(arm_r, trajectory_torque_margin=1.1).offer(motion).accepted
    assert started(arm_r, trajectory_torque_margin=0.0).offer(motion).accepted
    assert not started(arm_r, torque_limit=[1.0]).offer(quintic(1.0, 0.2)).accepted


def test_where_a_trajectory_starts_can_be_asked_for_from_another_thread(arm_r):
    core = started(arm_r)
    assert core.offer(quintic(1.0, 0.2)).accepted
    for k in range(1, 500):
        step(core, k)
    now = core.reference.start_of(0)
    assert_allclose(
        now, [getattr(core.reference, k) for k in ("position", "velocity", "acceleration")]
    )
    later = core.reference.start_of(10**9 + 800 * 10**6)
    for k in range(500, 801):
        step(core, k)
    assert_allclose(later[0], core.reference.position, rtol=1e-12)
    assert trajectory.ReferenceGenerator(["joint1"]).start_of(0) is None


def test_the_designer_judges_as_the_function_does(arm_r):
    designer = Designer(arm_r, pytest.fail, process=False)
    limit = arm_r.arm.torque_limits
    assert designer.judge(quintic(2.0, 1.57), rest(0.0), limit) is None
    with pytest.raises(TrajectoryError, match=r"give it 1\.02 times the time"):
        designer.judge(quintic(1.0, 1.57), rest(0.0), limit)
    designer.close()


def test_an_idle_design_process_judges_and_the_error_comes_back_whole(arm_r, monkeypatch):
    designer = Designer(arm_r, pytest.fail)
    try:
        limit = arm_r.arm.torque_limits
        assert not designer._process.idle
        designer.warm_up()
        assert designer._process.idle
        monkeypatch.setattr("flexarm_control.composite.designer.refuse_torque", pytest.fail)
        with pytest.raises(
            TrajectoryError, match=r"joint1 at 0\.\d+ s: .* \(13\.5582\); give it 1\.02"
        ):
            designer.judge(quintic(1.0, 1.57), rest(0.0), limit)
    finally:
        designer.close()
