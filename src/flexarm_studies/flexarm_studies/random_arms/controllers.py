# SPDX-License-Identifier: Apache-2.0
"""The controllers that random arms are tried with, by name; each makes its `Setup` from a `RandomArm`.

``default`` and ``preview`` are what docs/tutorial/own_arm.md tells a user to type, with one set of gains for every arm.
The baselines are tuned for each arm.
"""

from functools import partial

from ..loop import scenario as scenarios
from .baselines import full_state_lqr, shaped_pid
from .trial import Setup


def _tutorial(feedforward, case):
    settings = ("slow.type=model_following", f"feedforward={feedforward}")
    return Setup(scenarios.parameters("composite", settings))


CONTROLLERS = {
    "default": partial(_tutorial, "model"),
    "preview": partial(_tutorial, "preview"),
    "pid_zvd": partial(shaped_pid, kind="zvd"),
    "pid_ei": partial(shaped_pid, kind="ei"),
    "lqr": full_state_lqr,
}
#: With what the others are compared.
BASELINES = ("pid_zvd", "pid_ei", "lqr")
