# SPDX-License-Identifier: Apache-2.0
"""The composite control's own parts beside each other: slow law, fast law, slow manifold and feed-forward.

`full` is every slow law with every fast law and every manifold, and with every fast law and every feed-forward; `pairs`
every slow law with every fast law, and every manifold with every feed-forward; `star` one part at a time: the rest as
shipped. Left out is what can't differ: without fast law nothing holds on to a
manifold, and to the corrected one alone belongs a torque; scheduled gains and resolved acceleration of a single joint.
"""

from itertools import product

import numpy as np

from . import subjects
from .contenders import Setup

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
#: Of the lowest mode, where poles are placed: the stiffer ones are left as they are.
DAMPING = 0.4


def shipped(subject):
    """The parts of the shipped controller, in the order of `PARTS`."""
    values = subject.values()
    named = [values.get(f"{p}.type") for p in PARTS[:3]]
    defaults = ("linear_model_following", "lqr", "corrected")
    return (
        *(n or d for n, d in zip(named, defaults, strict=True)),
        values.get("feedforward", "model"),
    )


def of(subject):
    """Combinations to try, each a tuple in the order of `PARTS`."""
    joints = subjects.model_of(subject.arm).n_joints
    slow = [s for s in SLOW if joints > 1 or s != "resolved_acceleration"]
    fast = [f for f in FAST if joints > 1 or f != "scheduled_lqr"]
    s0, f0, m0, w0 = shipped(subject)
    if subject.depth == "full":
        every = [(s, f, m, w0) for s, f, m in product(slow, fast, MANIFOLD)]
        every += [(s, f, m0, w) for s, f, w in product(slow, fast, FEEDFORWARD)]
    elif subject.depth == "pairs":
        every = [(s, f, m0, w0) for s, f in product(slow, fast)]
        every += [(s0, f0, m, w) for m, w in product(MANIFOLD, FEEDFORWARD)]
    elif subject.depth == "star":
        every = [(s, f0, m0, w0) for s in slow] + [(s0, f, m0, w0) for f in fast]
        every += [(s0, f0, m, w0) for m in MANIFOLD] + [(s0, f0, m0, w) for w in FEEDFORWARD]
    else:
        every = ()
    return list(dict.fromkeys(c for c in every if not (c[1] == "none" and c[2] == "reference")))


def setup(subject, combination):
    """The shipped controller with other parts; their gains those of the shipped one where they have the same."""
    values = subject.values()
    arm = subjects.model_of(subject.arm)
    kp = np.array(values.get("slow.kp", [6.25]))
    kv = np.array(values.get("slow.kv", [5.0]))
    slow, fast = combination[:2]
    values |= {f"{p}.type": c for p, c in zip(PARTS[:3], combination[:3], strict=True)}
    values["feedforward"] = combination[3]
    if slow == "sliding_mode":  # one of its two rates on the surface, as a double pole's
        values["slow.lambda"] = np.sqrt(kp).tolist()
    if slow == "resolved_acceleration":
        values |= {"slow.tip_kp": float(kp[0]), "slow.tip_kv": float(kv[0])}
    if fast == "pole_placement":
        values["fast.damping"] = [DAMPING] + [0.0] * (arm.n_modes - 1)
    if fast == "output_feedback":
        values["fast.period"] = 1.0 / subject.rate
    return Setup(values)
