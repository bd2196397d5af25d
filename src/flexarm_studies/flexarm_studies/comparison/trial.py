# SPDX-License-Identifier: Apache-2.0
"""Makes one run of a controller on a case, and computes the compared numbers."""

from dataclasses import replace

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from ..loop import scenario as scenarios
from ..loop.metrics import tracking_metrics
from . import cases

#: Weights of the cost: each of these costs 1. The errors are fractions of the arm's length [-], [-], [s].
TRACKING, RESIDUAL, SETTLING = 1e-2, 1e-3, 1.0
#: Cost of a run that loses the arm (higher if this happens earlier), and of a refused design.
LOST, REFUSED = 1e3, 1e4
#: The arm counts as lost at this joint error [rad].
MAX_ERROR = 0.7


def run(case, setup, noisy=False, seed=0):
    """Run a controller, the `setup`, on a case, if `noisy` with noise of the sensors.

    Returns the row of `row_of`; for a refused design ``refused``, the reason, and ``cost``; for a lost arm ``lost``,
    the reason, and ``cost``.
    """
    try:
        return _run(case, setup, noisy, seed)
    except FlexarmError as error:
        return {"refused": str(error), "cost": REFUSED}


def _run(case, setup, noisy, seed):
    arm = cases.arm_of(case.arm, noisy)
    scenario = scenarios.Scenario(
        arm, setup.controller, noise=noisy, seed=seed, rate=case.rate, window=case.window
    )
    loop = scenarios.loop_of(scenario)
    loop.MAX_ERROR = MAX_ERROR
    controller = loop.controller
    if setup.law is not None:
        controller.law = setup.law(loop.model)
    wanted = scenarios.trajectory_of(case.motion, loop.model, loop.simulator.position)
    motion = wanted if setup.motion is None else setup.motion(loop.model)
    loop.simulator.reset(motion.positions[0])
    if controller.plans:
        _reuse_plan(case, setup.controller["feedforward"], controller)
    end = 1e-9 * int(wanted.times_ns[-1])
    record = loop.follow(motion, end + case.window)
    if loop.lost:
        done = float(record.time[-1]) / (end + case.window)
        return {"lost": loop.lost, "cost": LOST * (2.0 - done)}
    if setup.motion is not None:  # judged by the case's motion, not by the shaped one
        profile = cases.profile_of(case)
        time = np.clip(record.time, 0.0, profile.duration)
        record = replace(record, reference=profile.position(time).reshape(len(time), -1))
    with np.errstate(over="ignore", invalid="ignore"):
        plant = loop.simulator.plant_model
        # The vibration right after the motion counts, too: the cost, which has a term for settling, was chosen for
        # this.
        found = tracking_metrics(record, loop.model, plant, end, case.window, settle=0.0)
    return row_of(found, case, arm.reach)


def row_of(found, case, length):
    """The numbers that are compared, from those `found` by `tracking_metrics`; `length` is that of the arm [m].

    Returns ``peak_joint_error_rad``, ``peak_tip_mm``, ``rms_tip_mm`` (about the sag if there is gravity),
    ``residual_mm`` (from the motion's end on, over the case's window), ``settling_s`` (None: not within the window),
    ``peak_torque_Nm`` (per joint), ``saturation_share`` and ``cost``.
    """
    about = "about_sag_mm" if "static_sag_mm" in found else "mm"
    row = {
        "peak_joint_error_rad": max(found["peak_joint_error_rad"]),
        "peak_tip_mm": found[f"peak_tip_error_{about}"],
        "rms_tip_mm": found[f"rms_tip_error_{about}"],
        "residual_mm": found["residual_tip_rms_mm"],
        "settling_s": found["settling_time_s"],
        "peak_torque_Nm": found["peak_torque_Nm"],
        "saturation_share": found["saturation_share"],
    }
    settling = case.window if row["settling_s"] is None else row["settling_s"]
    row["cost"] = (
        1e-3 * row["rms_tip_mm"] / length / TRACKING
        + 1e-3 * row["residual_mm"] / length / RESIDUAL
        + settling / SETTLING
    )
    return row


#: Plans that feed-forwards prepared, by case, kind and start.
_PREPARED = {}


def _reuse_plan(case, kind, controller):
    """Prepare a motion only once: its plan depends on arm, motion and rate, not on the tuned gains."""

    def prepare(trajectory):
        start, law = controller.reference.resting, controller.law
        if start is None:
            return None
        key = (case, kind, start.tobytes())
        if key not in _PREPARED:
            law.limit = controller.torque_limit
            _PREPARED[key] = law.feedforward.prepare(trajectory, start)
        return replace(_PREPARED[key], trajectory_id=0)

    controller.prepare = prepare
