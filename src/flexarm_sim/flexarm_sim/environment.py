# SPDX-License-Identifier: Apache-2.0
r"""A vector environment of gymnasium whose arms each learn to reach a joint configuration without swinging there.

The observation of each arm is its full state, q, delta, qd, delta_d, and then the remaining way, g - q for the goal g.
An action is the joints' torques divided by their limits. The reward of a step is

.. math:: -\sum_i|g_i - q_i| - |w|/L,

with the deflection w of the last link's tip and the arm's reach L. An episode is terminated, with the reward `LOST`, if
the arm leaves the range of its model so far that its state is not finite. It is truncated after its duration. The next
step of that arm then begins a new episode, whatever the action (`AutoresetMode.NEXT_STEP`). Start and goal are random.
For another reward, give a `reward` function.

gymnasium is optional: ``pip install gymnasium``, or the wheel's extra ``gym``.
"""

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from . import integrators
from .batch import Arms, models_of

try:
    import gymnasium
except ImportError:
    gymnasium = None

#: Reward of a step after which an arm is out of its model's range.
LOST = -100.0


class ArmVectorEnv(object if gymnasium is None else gymnasium.vector.VectorEnv):
    """Arms that run side by side; see the module.

    Parameters
    ----------
    arms : ArmModel or Arm, or sequence of them
        One for all, or one each, such as `description.scaled` makes with other payloads.
    num_envs : int
    period : float
        Time between two actions [s].
    duration : float
        Duration of an episode [s].
    reach : float
        Start and goal of each joint are uniform within its range, and at most this far from zero [rad].
    reward : callable, optional
        ``reward(states, goals, torque)``, of (b, 2 (n + m)), (b, n) and (b, n): (b,).
    method : str
        One of `integrators.METHODS`; its steps are as long as the stiffest arm allows.
    workers : int, optional
        Number of threads; default: the number of cores.

    Attributes
    ----------
    arms : batch.Arms
    goals : ndarray, shape (num_envs, n)
        [rad]

    Raises
    ------
    FlexarmError
        Without gymnasium, and for an arm without torque limits.
    ShapeError
        For arms with other numbers of joints or modes than the first.
    """

    def __init__(
        self,
        arms,
        num_envs,
        period=0.01,
        duration=5.0,
        reach=1.0,
        reward=None,
        method="dop853",
        workers=None,
    ):
        if gymnasium is None:
            raise FlexarmError("is missing", field="gymnasium", hint="pip install gymnasium")
        models = models_of(arms, num_envs)
        different, first = {id(m): m for m in models}, models[0]
        states = np.zeros((num_envs, 2 * (first.n_joints + first.n_modes)))
        substeps = max(integrators.plant_substeps(m, period, method) for m in different.values())
        self.arms = Arms(models, states, period / substeps, substeps, method, workers)
        self._n, self._modes = first.n_joints, slice(first.n_joints, first.n_joints + first.n_modes)
        bent = {key: _tip_deflection(m) / m.arm.reach for key, m in different.items()}
        self._bent = np.array([bent[id(m)] for m in models])
        self._limit = first.arm.torque_limits
        if not np.isfinite(self._limit).all():
            name = first.joint_names[int(np.argmax(~np.isfinite(self._limit)))]
            raise FlexarmError(
                "is needed: an action is a part of it", field=f"torque limit of {name}"
            )
        low, high = first.arm.position_limits.T
        self._low, self._high = np.maximum(low, -reach), np.minimum(high, reach)
        self.num_envs, self._steps = num_envs, max(1, round(duration / period))
        self._reward = self._to_the_goal if reward is None else reward
        self.goals = np.zeros((num_envs, self._n))
        self._ages, self._over = np.zeros(num_envs, int), np.zeros(num_envs, bool)
        box, batch = gymnasium.spaces.Box, gymnasium.vector.utils.batch_space
        self.single_action_space = box(-1.0, 1.0, (self._n,), np.float64)
        self.single_observation_space = box(
            -np.inf, np.inf, (states.shape[1] + self._n,), np.float64
        )
        self.action_space = batch(self.single_action_space, num_envs)
        self.observation_space = batch(self.single_observation_space, num_envs)
        mode = gymnasium.vector.AutoresetMode.NEXT_STEP
        self.metadata = {"autoreset_mode": mode}

    def reset(self, *, seed=None, options=None):
        """Begin an episode with every arm: as in gymnasium. There are no `options`."""
        super().reset(seed=seed)
        self._begin(np.ones(self.num_envs, bool))
        return self._observation(), {}

    def step(self, actions):
        """One period of all arms, `actions` are (num_envs, n): as in gymnasium."""
        torque = self._limit * np.clip(actions, -1.0, 1.0)
        again = self._over.copy()
        self.arms.advance(torque)
        self._ages += 1
        states = self.arms.states
        lost = ~np.isfinite(states).all(axis=1) & ~again
        states[lost] = 0.0
        self._begin(again)
        rewards = np.where(lost, LOST, self._reward(states, self.goals, torque))
        rewards[again] = 0.0
        truncated = (self._ages >= self._steps) & ~lost & ~again
        self._over = lost | truncated
        return self._observation(), rewards, lost, truncated, {}

    def close_extras(self, **kwargs):
        """End the threads."""
        self.arms.close()

    def _begin(self, which):
        """Put the arms of a mask at rest in random poses, bent by their weight, and give them goals."""
        places = np.flatnonzero(which)
        begin, goals = self.np_random.uniform(self._low, self._high, (2, places.size, self._n))
        self.goals[places], self._ages[places] = goals, 0
        states = self.arms.states
        states[places] = 0.0
        states[places, : self._n] = begin
        for i, q in zip(places, begin, strict=True):
            arm_model = self.arms.models[i]
            if any(arm_model.arm.gravity):
                states[i, self._modes] = arm_model.static_deflection(q)

    def _observation(self):
        states = self.arms.states
        return np.concatenate([states, self.goals - states[:, : self._n]], axis=1)

    def _to_the_goal(self, states, goals, torque):
        way = np.abs(goals - states[:, : self._n]).sum(axis=1)
        bent = np.einsum("bij,bj->bi", self._bent, states[:, self._modes])
        return -way - np.linalg.norm(bent, axis=1)


def _tip_deflection(arm_model):
    """Deflection of the last link's tip by each mode, (2, m)."""
    return (
        np.array([arm_model.tip_deflection(unit) for unit in np.eye(arm_model.n_modes)])
        .reshape(-1, 2)
        .T
    )
