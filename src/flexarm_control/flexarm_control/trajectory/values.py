# SPDX-License-Identifier: Apache-2.0
"""Limits of trajectories, and checks of their values; shared by this package."""

import numpy as np

from flexarm_dynamics.errors import TrajectoryError

MAX_POINTS = 10**6
# Beyond this a double resolves less than 1e-7 of the unit: the value must be wrong.
MAX_MAGNITUDE = 1e9  # [rad], [rad/s], [rad/s^2]
# The joint_trajectory_controller's own bound: one step of single precision at 1.
END_VELOCITY_TOLERANCE = float(np.finfo(np.float32).eps)  # [rad/s]
BRAKING_STEP = 0.01  # [s]
MAX_BRAKING = 3600.0  # [s] of a stop: a longer one is a wrong deceleration
# Speeds derived from differences carry rounding; a limit met exactly must not be refused.
SPEED_ROUNDING = 1e-6  # [-]
# Motions that are planned for the limit meet it to their own accuracy between the points.
TORQUE_ROUNDING = 1e-3  # [-]

UNITS = {"positions": "rad", "velocities": "rad/s", "accelerations": "rad/s^2", "effort": "N m"}
SECOND = 1_000_000_000  # [ns]
NOT_NUMBERS = (TypeError, ValueError, OverflowError)  # what conversions to numbers raise


def joint_limit(name, values, joint_names):
    """Return limits as an (n,) float array without nan."""
    values = per_joint(name, values, joint_names)
    hint = "give inf where there is no limit"
    refuse_joint(name, np.isnan(values), values, joint_names, "is no limit", hint=hint)
    return values


def per_joint(name, values, joint_names):
    """Return one float per joint, (n,)."""
    try:
        array = np.array(values, dtype=float)
    except NOT_NUMBERS:
        raise TrajectoryError("is no list of numbers", field=name, value=values) from None
    if array.shape != (len(joint_names),):
        raise TrajectoryError(
            f"has shape {array.shape}, the joints have ({len(joint_names)},)",
            field=name,
            hint="give one number per joint",
        )
    return array


def refuse_joint(name, bad, values, joint_names, problem, limit=None, hint="", first=0):
    """Refuse the first bad one of the values (n,), or (k, n) of points from `first` on; `limit` may be (n,)."""
    found = np.argwhere(bad)
    if found.size:
        *point, joint = found[0]
        limit = float(limit[joint]) if isinstance(limit, np.ndarray) else limit
        where = f"points[{first + point[0]}].{name}" if point else name
        raise TrajectoryError(
            problem,
            field=f"{where} of joint {joint_names[joint]}",
            value=float(values[tuple(found[0])]),
            limit=limit,
            hint=hint,
        )


def seconds(time_ns):
    """Write nanoseconds as seconds, exactly, without trailing zeros."""
    time_ns = int(time_ns)
    whole, part = divmod(abs(time_ns), SECOND)
    decimals = f".{part:09d}".rstrip("0") if part else ""
    return f"{'-' if time_ns < 0 else ''}{whole}{decimals} s"
