# SPDX-License-Identifier: Apache-2.0
"""The controllers that random arms are tried with, by name; each makes its `Setup` from a `RandomArm`.

``default`` and ``preview`` are what docs/tutorial/own_arm.md tells a user to type, with one set of gains for every arm.
``designed`` and ``designed_preview`` are what ``flexarm design`` makes of the arm file, for 500 Hz and 2 ms of delay,
at start, middle and end of the motion, as the baselines are tuned.
The baselines are tuned for each arm.
"""

from functools import lru_cache, partial

from flexarm_control.robust.design import Settings, design
from flexarm_dynamics.arm import arm_file

from ..comparison.controllers import Setup
from ..loop import scenario as scenarios
from .baselines import full_state_lqr, shaped_pid, task_of
from .trial import DELAY, SLOW_RATE


def _tutorial(feedforward, case):
    settings = ("slow.type=model_following", f"feedforward={feedforward}")
    return Setup(scenarios.parameters("composite", settings))


@lru_cache(maxsize=2)
def _design(text, places):
    settings = Settings(rate=SLOW_RATE, delay=DELAY, configurations=places)
    found = design(arm_file.parse(text), settings)
    found.check()
    return found.parameters()


def _designed(feedforward, case):
    start, middle, end = (tuple(q.tolist()) for q in task_of(case).places)
    return Setup(_design(case.text, (middle, start, end)) | {"feedforward": feedforward})


CONTROLLERS = {
    "default": partial(_tutorial, "model"),
    "preview": partial(_tutorial, "preview"),
    "designed": partial(_designed, "model"),
    "designed_preview": partial(_designed, "preview"),
    "pid_zvd": partial(shaped_pid, kind="zvd"),
    "pid_ei": partial(shaped_pid, kind="ei"),
    "lqr": full_state_lqr,
}
#: With what the others are compared.
BASELINES = ("pid_zvd", "pid_ei", "lqr")
