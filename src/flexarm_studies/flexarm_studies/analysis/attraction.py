# SPDX-License-Identifier: Apache-2.0
"""Finds how far off rest the nonlinear loop still brings the arm back, with its torque limits, sensors and observer.

The loop starts with a joint away from its goal, or with the arm bent. Bisection finds the largest offset from which the
arm comes back. The result is a few rays into the domain of attraction, not the whole domain.
"""

from dataclasses import replace

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.singular_perturbation import fast_subsystem

from ..loop import scenario as scenarios

#: Largest joint error [rad], and largest deflection as a fraction of the arm's length [-], that are tried.
MAX_TURN, MAX_BEND = 3.0, 0.3
#: An arm has come back within this fraction of its largest excursion [-], or within this of its rest [rad], [m].
BACK, FLOOR = 0.1, 1e-4
#: Length of the last part of the run, over which this is judged [s].
LATE = 0.25
#: Length of the run, in time constants of the slowest pole [-], and its limits [s].
DECAYS, MIN_TIME, MAX_TIME = 8.0, 1.0, 8.0


def directions(case):
    """Yield each ray: name, joint offset (n,) [rad] or deflection (m,) [m, rad], largest scale, and its unit."""
    model, n, m = case.model, case.model.n_joints, case.model.n_modes
    for i, name in enumerate(model.joint_names):
        offset = np.zeros(n)
        offset[i] = 1.0
        yield name, offset, np.zeros(m), MAX_TURN, "rad"
    shape = lowest_shape(case)
    if shape is not None:
        reach = case.arm.reach
        yield "lowest fast mode", np.zeros(n), shape, MAX_BEND * reach, "m"


def lowest_shape(case):
    """Deflections of the boundary layer's lowest mode, 1 m at the tip; None where it does not move the tip."""
    model, q = case.model, case.q
    m = model.n_modes
    if not m:
        return None
    A2, _ = fast_subsystem(model.terms(q, np.zeros(model.n_joints)))
    values, vectors = np.linalg.eig(A2[m:, :m])
    shape = np.real(vectors[:, np.argmin(np.abs(values))])
    small = 1e-3
    moved = model.tip_position(q, small * shape) - model.tip_position(q, np.zeros(m))
    size = np.linalg.norm(moved) / (small * np.linalg.norm(shape))
    return None if size < 1e-6 else shape * small / np.linalg.norm(moved)


def comes_back(case, joint, bend, watched):
    """Whether the loop brings the arm back from an offset to the motion's end, while it is `watched` [s].

    The offset is `joint` (n,) [rad], and `bend` (m,) about the static deflection [m, rad].
    """
    q = case.q
    values = case.scenario.controller | {"start_tolerance": 10.0}
    hold = {"times": [0.0, 0.01], "positions": [q.tolist()] * 2}
    scenario = replace(case.scenario, controller=values, trajectory=hold)
    try:
        loop = scenarios.loop_of(scenario)
        motion = scenarios.trajectory_of(hold, loop.model, q)
        simulator = loop.simulator
        simulator.reset(q + joint)
        modes = [simulator.plant_model.mode_names.index(name) for name in loop.model.mode_names]
        simulator.plant.delta[modes] += bend
        simulator._measure()
        record = loop.follow(motion, watched)
    except FlexarmError:
        return False
    if loop.lost:
        return False
    rest = loop.model.static_deflection(q)
    late = record.time > record.time[-1] - LATE
    off = np.abs(record.plant_position - q).max(1)
    bent = np.abs(record.plant_amplitude[:, modes] - rest).max(1, initial=0.0)
    # Each is judged by its own peak: a small bending may turn the joint far on the way back.
    return all(bool(v[late].max() < max(BACK * v.max(), FLOOR)) for v in (off, bent))


def study(case, steps=5, progress=None):
    """Largest scale along each ray from which the arm comes back, by this number of `steps` of bisection.

    Returns ``reason``; ``rays``: ``direction``, ``scale`` (of joint error, or tip deflection), ``unit``, and
    ``searched``, the largest scale tried. If the arm came back even from there, the scale is equal to it.
    """
    if case.without_poles:
        return {"reason": case.without_poles, "rays": []}
    decay = case.decay()
    if decay <= 0.0:
        return {"reason": "the linear loop is not stable", "rays": []}
    watched = float(np.clip(DECAYS / decay, MIN_TIME, MAX_TIME))
    rays, every = [], list(directions(case))
    for i, (name, joint, bend, largest, unit) in enumerate(every):
        good, bad = 0.0, largest
        if comes_back(case, largest * joint, largest * bend, watched):
            good = largest
        else:
            for _ in range(steps):
                middle = 0.5 * (good + bad)
                back = comes_back(case, middle * joint, middle * bend, watched)
                good, bad = (middle, bad) if back else (good, middle)
        rays.append({"direction": name, "scale": good, "unit": unit, "searched": largest})
        if progress is not None:
            progress.fraction((i + 1) / len(every))
    return {"reason": "", "watched_s": watched, "rays": rays}
