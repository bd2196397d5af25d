# SPDX-License-Identifier: Apache-2.0
"""Chooses a motion if none is given: from rest to rest, within the arm's limits of position, speed and torque."""

import numpy as np
from scipy.optimize import minimize

from flexarm_control.trajectory import refuse_torque, specs
from flexarm_dynamics.errors import FlexarmError, TrajectoryError
from flexarm_dynamics.linear import static_torque

#: The motion of the paper; it is taken if the arm can do it.
PAPER = "paper"
#: Largest turn of a joint [rad], which is tried first, and first duration [s]; number of durations, each twice the one
#: before, and of turns, each half the one before.
TURN, DURATION, LONGER, SHORTER = 1.0, 2.0, 4, 5
#: Number of points of a motion that are checked, number of places at which the arm must be able to rest, and fraction
#: of the torque limit that its weight may take there [-].
POINTS, PLACES, HOLDING = 41, 5, 0.9
#: Joints without limits stay within this of zero [rad].
WORKSPACE = np.pi


def default_motion(model, design=None):
    """A motion as text for `specs.from_spec`; the arm begins straight, where the control is designed, or hanging.

    Parameters
    ----------
    model : ArmModel
    design : (n,) array_like, optional
        Configuration for which the control is designed [rad].

    Raises
    ------
    TrajectoryError
        If no motion from these is within the limits.
    """
    if _works(model, PAPER):
        return PAPER
    low, high = np.clip(model.arm.position_limits, -WORKSPACE, WORKSPACE).T
    starts = [np.zeros(model.n_joints)]
    if design is not None and np.size(design) == model.n_joints:
        starts.append(np.asarray(design, float))
    for start in (*starts, _hanging(model, low, high)):
        start = np.clip(start, low, high)
        turn = np.where(high - start >= start - low, 1.0, -1.0)
        room = np.where(turn > 0.0, high - start, start - low)
        for shorter in range(SHORTER):
            end = start + turn * np.minimum(TURN, 0.8 * room) / 2**shorter
            for longer in range(LONGER):
                text = (
                    f"quintic:from={_list(start)},to={_list(end)},duration={DURATION * 2**longer:g}"
                )
                if _works(model, text):
                    return text
    raise TrajectoryError(
        "no motion found within the limits: from straight, from the design's configuration, nor from where it hangs",
        field=model.arm.name,
        hint="give --trajectory",
    )


def _works(model, text):
    """Whether the arm can do a motion, and can rest along it with torque in reserve."""
    try:
        motion = specs.from_spec(f"{text}{',' if ':' in text else ':'}points={POINTS}", model)
        limit = model.arm.torque_limits
        start = np.zeros((3, model.n_joints))
        start[0] = motion.positions[0]
        refuse_torque(model, motion, start, limit)
        every = np.linspace(0, len(motion.positions) - 1, PLACES).astype(int)
        return all(
            (np.abs(static_torque(model, q)) <= HOLDING * limit).all()
            for q in motion.positions[every]
        )
    except (FlexarmError, np.linalg.LinAlgError):
        return False


def _hanging(model, low, high):
    """Configuration in which the rigid arm hangs lowest within its limits, shape (n,) [rad]."""
    straight = np.zeros(model.n_modes)
    found = [
        minimize(
            lambda q: model.potential_energy(q, straight),
            start,
            bounds=list(zip(low, high, strict=True)),
        )
        for start in (np.clip(0.0, low, high), low, high)
    ]
    # The first of equally low ones: a joint that the weight does not turn stays at zero.
    lowest = min(one.fun for one in found)
    best = next(one for one in found if one.fun <= lowest + 1e-6 * max(abs(lowest), 1.0)).x
    return np.clip(best, low + 0.02 * (high - low), high - 0.02 * (high - low))


def _list(q):
    return ";".join(f"{v:.4f}" for v in q)
