# SPDX-License-Identifier: Apache-2.0
"""Simulated seconds per second of arms side by side: ``python -m benchmarks.environments [ARM …]``."""

import sys
import time

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import levels
from flexarm_sim.environment import ArmVectorEnv
from flexarm_studies import markdown

ARMS = ("R", "two_link", "long_reach")
#: Number of arms, time between two actions [s], number of timed actions, number of turns (the median is taken).
COUNT, PERIOD, STEPS, TURNS = 64, 0.01, 10, 5


def row(name):
    """A line of the table: simulated seconds per second of processor time, by actions and in whole runs."""
    env = ArmVectorEnv(arm_file.load(name), COUNT, period=PERIOD, duration=1e6)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape)
    torque = np.zeros((COUNT, STEPS, action.shape[1]))
    level = levels.level_of(env.arms.models[0].arm)

    def actions():
        for _ in range(STEPS):
            env.step(action)

    rates = [f"{_rate(work):.0f}" for work in (actions, lambda: env.arms.follow(torque, torque))]
    env.close()
    return (name, level, *rates)


def _rate(work):
    work()  # the first call loads code
    times = []
    for _ in range(TURNS):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return COUNT * STEPS * PERIOD / float(np.median(times))


if __name__ == "__main__":
    head = ("arm", "level", f"{COUNT} arms, by actions", f"{COUNT} arms, whole runs")
    print("\n".join(markdown.table(head, [row(name) for name in sys.argv[1:] or ARMS])))
