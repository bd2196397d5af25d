# SPDX-License-Identifier: Apache-2.0
"""Arms advanced together, and as a vector environment of gymnasium."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import FlexarmError, ShapeError
from flexarm_dynamics.models import model
from flexarm_sim import batch, environment
from flexarm_sim.environment import ArmVectorEnv

MODEL = model.build(arm_file.load("R"))
SIZE = 2 * (1 + MODEL.n_modes)
needs_gymnasium = pytest.mark.skipif(
    environment.gymnasium is None, reason="gymnasium is not installed: pip install gymnasium"
)


@pytest.mark.parametrize("workers", [1, 2])
def test_arms_advanced_one_by_one_interval_end_where_those_do_that_follow_all_at_once(workers):
    states = 1e-3 * np.random.default_rng(2).normal(size=(3, SIZE))
    torque = np.array([[0.5], [-0.2], [0.1]])
    with batch.Arms(MODEL, states, 1e-3, 4, "dop853", workers) as arms:
        for u in torque:
            arms.advance(u)
        whole = batch.simulate(MODEL, states, torque, torque, 1e-3, 4, "dop853")
        assert_array_equal(arms.states, whole[:, -1])
        arms.states[:] = states
        assert_array_equal(arms.follow(torque, torque), whole)
        assert_array_equal(arms.advance(np.zeros((3, 1))), arms.states)


def test_a_torque_of_another_shape_is_refused_with_both():
    with batch.Arms(MODEL, np.zeros((3, SIZE)), 1e-3) as arms, pytest.raises(ShapeError) as error:
        arms.advance(np.zeros((2, 1)))
    assert (error.value.value, error.value.limit) == ((2, 1), (3, 1))


def test_without_gymnasium_the_environment_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(environment, "gymnasium", None)
    with pytest.raises(FlexarmError, match="pip install gymnasium"):
        ArmVectorEnv(MODEL, 2)


@pytest.fixture
def env():
    made = ArmVectorEnv(MODEL, 3, period=0.01, duration=0.03)
    yield made
    made.close()


@needs_gymnasium
def test_an_episode_begins_at_rest_and_ends_after_its_time_and_the_next_step_begins_another(env):
    first, _ = env.reset(seed=4)
    assert first in env.observation_space and env.action_space.shape == (3, 1)
    assert not first[:, 1:SIZE].any()  # at rest, straight
    np.testing.assert_allclose(first[:, SIZE:], env.goals - first[:, :1])
    action = env.action_space.sample()
    for k in range(3):
        seen, rewards, terminated, truncated, _ = env.step(action)
        assert (rewards < 0.0).all() and not terminated.any()
        assert truncated.all() == (k == 2)
    again, rewards, _, truncated, _ = env.step(action)
    assert not again[:, 1:SIZE].any() and not rewards.any() and not truncated.any()
    assert (again[:, 0] != seen[:, 0]).all()
    assert_array_equal(env.reset(seed=4)[0], first)


@needs_gymnasium
def test_steps_are_those_of_the_batch_and_rewards_may_be_ones_own():
    env = ArmVectorEnv(MODEL, 2, period=0.01, reward=lambda states, goals, torque: torque[:, 0])
    env.reset(seed=1)
    before, action = env.arms.states.copy(), np.array([[0.5], [2.0]])
    seen, rewards, *_ = env.step(action)
    torque = MODEL.arm.torque_limits * np.array([[0.5], [1.0]])  # clipped
    assert rewards.tolist() == torque[:, 0].tolist()
    arms = env.arms
    whole = batch.simulate(
        MODEL, before, torque[:, None], torque[:, None], arms.step, arms.substeps, "dop853"
    )
    assert_array_equal(seen[:, :SIZE], whole[:, -1])
    env.close()


@needs_gymnasium
def test_an_arm_that_is_lost_ends_its_episode_and_no_others(env):
    env.reset(seed=0)
    env.arms.states[1, -1] = np.inf
    seen, rewards, terminated, truncated, _ = env.step(np.zeros((3, 1)))
    assert terminated.tolist() == [False, True, False] and not truncated.any()
    assert rewards[1] == environment.LOST and np.isfinite(seen).all()
    _, _, terminated, _, _ = env.step(np.zeros((3, 1)))
    assert not terminated.any()


@needs_gymnasium
def test_each_arm_may_have_a_payload_of_its_own_and_weight_bends_it():
    arm = arm_file.load("long_reach")
    models = [model.build(scaled(arm, scale)) for scale in (1.0, 1.5)]
    env = ArmVectorEnv(models, 2, reach=0.1)
    seen, _ = env.reset(seed=0)
    n, m = models[0].n_joints, models[0].n_modes
    for i, each in enumerate(models):
        np.testing.assert_allclose(
            seen[i, n : n + m], each.static_deflection(seen[i, :n]), rtol=1e-12
        )
    assert np.abs(seen[:, n : n + m]).max() > 1e-3
    env.close()


@needs_gymnasium
def test_an_arm_without_torque_limits_is_refused_by_joint():
    arm = MODEL.arm
    joint = replace(arm.joints[0], limits=replace(arm.joints[0].limits, torque=np.inf))
    with pytest.raises(FlexarmError, match="torque limit of joint1"):
        ArmVectorEnv(model.build(replace(arm, joints=(joint,))), 1)
