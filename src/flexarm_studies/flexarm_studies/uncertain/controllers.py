# SPDX-License-Identifier: Apache-2.0
"""Makes the controllers for the uncertain set, by name; each makes its `Setup` from a `RandomArm` or `ArmTask`.

``shipped`` is the controller file that flexarm has for a shipped arm. ``default`` and ``preview`` are the commands of
docs/tutorial/own_arm.md, with one set of gains for every arm. ``designed_preview`` is the result of ``flexarm design``
for the arm file, for 500 Hz and 2 ms of delay, at start, middle and end of the motion, like the baselines. ``designed``
has ``feedforward: model``. The baselines are tuned for each arm.
"""

from functools import partial

from flexarm_control.robust.default import default
from flexarm_control.robust.settings import Settings
from flexarm_control.robust.uncertain import Uncertainty

from ..comparison.controllers import Setup
from ..loop import scenario as scenarios
from .baselines import RATE, full_state_lqr, shaped_pid, strain_pid, task_of
from .plants import DELAY


def _tutorial(feedforward, case):
    settings = ("slow.type=model_following", f"feedforward={feedforward}")
    return Setup(scenarios.parameters("composite", settings))


def design_of(case):
    """The `Default` of the arm's design, which is taken from the cache of designs if it is there.

    Raises
    ------
    DesignError
        If no stable gains are found.
    """
    start, middle, end = (tuple(q.tolist()) for q in task_of(case).places)
    settings = Settings(rate=RATE, delay=DELAY, configurations=(middle, start, end))
    return default(case.read(), settings, Uncertainty())


def with_design(controller, design):
    """`Setup` of a controller of `DESIGNED` with a `Default`."""
    parameters = design.parameters | {"feedforward": DESIGNED[controller], "rate": RATE}
    return Setup(parameters, found={"decay": design.reached})


def _designed(controller, case):
    return with_design(controller, design_of(case))


#: Controllers with the gains of `flexarm design`, and their feed-forward.
DESIGNED = {"designed": "model", "designed_preview": "preview"}
CONTROLLERS = {
    "default": partial(_tutorial, "model"),
    "preview": partial(_tutorial, "preview"),
    **{name: partial(_designed, name) for name in DESIGNED},
    "pid": partial(shaped_pid, kind=None),
    "pid_zv": partial(shaped_pid, kind="zv"),
    "pid_zvd": partial(shaped_pid, kind="zvd"),
    "pid_ei": partial(shaped_pid, kind="ei"),
    "pid_strain": strain_pid,
    "lqr": full_state_lqr,
}
#: Controllers with which the others are compared.
BASELINES = ("pid", "pid_zv", "pid_zvd", "pid_ei", "pid_strain", "lqr")
#: Meaning of the names, for tables.
WORDS = {
    "shipped": "the controller file that is shipped for the arm",
    "default": "the nodes' composite control with `model_following`",
    "preview": "the same with `feedforward: preview`",
    "designed": "`flexarm design --feedforward model`",
    "designed_preview": "`flexarm design`",
    "pid": "joint PID",
    "pid_zv": "joint PID, ZV shaper",
    "pid_zvd": "joint PID, ZVD shaper",
    "pid_ei": "joint PID, EI shaper",
    "pid_strain": "joint PID with strain feedback",
    "lqr": "full-state LQR with a Kalman filter (LQG)",
}
