# SPDX-License-Identifier: Apache-2.0
"""Limits, and values as messages show and check them; shared by this package."""

import numpy as np

from flexarm_dynamics.errors import TrajectoryError
from flexarm_dynamics.shown import show

MAX_POINTS = 10**6
# Beyond this a double resolves less than 1e-7 of the unit: no joint's value, but a wrong one.
MAX_MAGNITUDE = 1e9  # [rad], [rad/s], [rad/s^2]
# The joint_trajectory_controller's own bound: one step of single precision at 1.
END_VELOCITY_TOLERANCE = float(np.finfo(np.float32).eps)  # [rad/s]
BRAKING_STEP = 0.01  # [s]
MAX_BRAKING = 3600.0  # [s] of a stop: a longer one is a wrong deceleration
# Speeds derived from differences carry rounding; a limit met exactly must not be refused.
SPEED_ROUNDING = 1e-6  # [-]

UNITS = {"positions": "rad", "velocities": "rad/s", "accelerations": "rad/s^2"}
SECOND = 1_000_000_000  # [ns]
NOT_NUMBERS = (TypeError, ValueError, OverflowError)  # what conversions to numbers raise

__all__ = ["joint_limit", "per_joint", "seconds", "show"]


def joint_limit(name, values, joint_names):
    """Return limits as an (n,) float array without nan."""
    values = per_joint(name, values, joint_names)
    if np.isnan(values).any():
        joint = joint_names[int(np.argmax(np.isnan(values)))]
        raise TrajectoryError(f"{name} of joint {joint} is nan: give inf where there is no limit")
    return values


def per_joint(name, values, joint_names):
    """Return one float per joint, (n,)."""
    try:
        values = np.array(values, dtype=float)
    except NOT_NUMBERS:
        raise TrajectoryError(f"{name} is {show(values)}: give one number per joint") from None
    if values.shape != (len(joint_names),):
        raise TrajectoryError(
            f"{name} has shape {values.shape}, the joints have ({len(joint_names)},): give one "
            "number per joint"
        )
    return values


def seconds(time_ns):
    """Write nanoseconds as seconds, exactly, without trailing zeros."""
    time_ns = int(time_ns)
    whole, part = divmod(abs(time_ns), SECOND)
    decimals = f".{part:09d}".rstrip("0") if part else ""
    return f"{'-' if time_ns < 0 else ''}{whole}{decimals} s"
