# SPDX-License-Identifier: Apache-2.0
"""Trajectories: what a `trajectory_msgs/JointTrajectory` asks for, and the reference it makes.

Read as the joint_trajectory_controller of ros2_controllers (Jazzy) reads it. The fields that the
points have choose the interpolation (with x the time since the segment's start, T its length):

===================================== ===================================================
positions                             linear: the velocity steps at the points
positions, velocities                 cubic Hermite: position and velocity continuous
positions, velocities, accelerations  quintic Hermite: acceleration continuous too
===================================== ===================================================

The first segment leads from the reference at the start to the first point, at its
`time_from_start`, with the same interpolation: the reference's own velocity (and acceleration)
begin it, so a new trajectory takes over smoothly. After the last point the reference holds it.

Where this is stricter than the joint_trajectory_controller: partial joint goals, velocities
without positions, fields that not every point has, and a start in the past are refused.

Time is the stamp of the samples, in integer nanoseconds; nothing here reads a clock.
"""

from .reference import ReferenceGenerator, Verdict
from .request import JointTrajectoryData, validate
from .values import (
    BRAKING_STEP,
    END_VELOCITY_TOLERANCE,
    MAX_BRAKING,
    MAX_MAGNITUDE,
    MAX_POINTS,
    SPEED_ROUNDING,
)

__all__ = [
    "BRAKING_STEP",
    "END_VELOCITY_TOLERANCE",
    "MAX_BRAKING",
    "MAX_MAGNITUDE",
    "MAX_POINTS",
    "SPEED_ROUNDING",
    "JointTrajectoryData",
    "ReferenceGenerator",
    "Verdict",
    "validate",
]
