# SPDX-License-Identifier: Apache-2.0
"""Lists combinations of the composite control's own parts: slow law, fast law, slow manifold and feed-forward.

`full`: every slow law with every fast law and every manifold, and with every fast law and every feed-forward.
`pairs`: every slow law with every fast law, and every manifold with every feed-forward.
`star`: one part at a time, the rest as shipped.
Combinations that can't differ are left out. Without a fast law the manifold has no effect, except for the corrected
one, which has a torque of its own. With a single joint, scheduled gains and resolved acceleration change nothing.
"""

from itertools import product

import numpy as np

from ..loop.scenario import type_of
from . import cases
from .controllers import Setup

SLOW = (
    "linear_model_following",
    "model_following",
    "computed_torque",
    "resolved_acceleration",
    "sliding_mode",
    "adaptive_model_following",
)
FAST = ("none", "lqr", "scheduled_lqr", "pole_placement", "output_feedback")
MANIFOLD = ("quasi_steady", "reference", "corrected")
FEEDFORWARD = ("none", "model", "preview")
PARTS = ("slow", "fast", "manifold", "feedforward")
#: Damping ratio that pole placement gives the lowest mode; the stiffer modes stay as they are [-].
DAMPING = 0.4


def shipped(case):
    """The parts of the shipped controller, in the order of `PARTS`."""
    values = case.values()
    return *(type_of(part, values) for part in PARTS[:3]), values.get("feedforward", "model")


def of(case):
    """Combinations to try, each a tuple in the order of `PARTS`."""
    joints = cases.model_of(case.arm).n_joints
    slow = [s for s in SLOW if joints > 1 or s != "resolved_acceleration"]
    fast = [f for f in FAST if joints > 1 or f != "scheduled_lqr"]
    s0, f0, m0, w0 = shipped(case)
    if case.depth == "full":
        every = [(s, f, m, w0) for s, f, m in product(slow, fast, MANIFOLD)]
        every += [(s, f, m0, w) for s, f, w in product(slow, fast, FEEDFORWARD)]
    elif case.depth == "pairs":
        every = [(s, f, m0, w0) for s, f in product(slow, fast)]
        every += [(s0, f0, m, w) for m, w in product(MANIFOLD, FEEDFORWARD)]
    elif case.depth == "star":
        every = [(s, f0, m0, w0) for s in slow] + [(s0, f, m0, w0) for f in fast]
        every += [(s0, f0, m, w0) for m in MANIFOLD] + [(s0, f0, m0, w) for w in FEEDFORWARD]
    else:
        every = ()
    return list(dict.fromkeys(c for c in every if not (c[1] == "none" and c[2] == "reference")))


def setup(case, combination):
    """The shipped controller with other parts; they take over its gains if they have the same ones."""
    values = case.values()
    arm = cases.model_of(case.arm)
    kp = np.array(values.get("slow.kp", [6.25]))
    kv = np.array(values.get("slow.kv", [5.0]))
    slow, fast = combination[:2]
    values |= {f"{p}.type": c for p, c in zip(PARTS[:3], combination[:3], strict=True)}
    values["feedforward"] = combination[3]
    if slow == "sliding_mode":  # decay on the surface as fast as the double pole's
        values["slow.lambda"] = np.sqrt(kp).tolist()
    if slow == "resolved_acceleration":
        values |= {"slow.tip_kp": float(kp[0]), "slow.tip_kv": float(kv[0])}
    if fast == "pole_placement":
        values["fast.damping"] = [DAMPING] + [0.0] * (arm.n_modes - 1)
    if fast == "output_feedback":
        values["fast.period"] = 1.0 / case.rate
    return Setup(values)
