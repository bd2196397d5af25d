# SPDX-License-Identifier: Apache-2.0
"""Trajectories: checks a `trajectory_msgs/JointTrajectory`, and computes the reference from it.

Trajectories mean the same as for the joint_trajectory_controller of ros2_controllers (Jazzy). The
fields of the points select the interpolation:

===================================== ===================================================
positions                             linear: the velocity steps at the points
positions, velocities                 cubic Hermite: position and velocity continuous
positions, velocities, accelerations  quintic Hermite: acceleration continuous too
===================================== ===================================================

The first segment leads from the reference at the start to the first point, at its
`time_from_start`, with the same interpolation. It begins with the reference's own velocity (and
acceleration), so that a new trajectory takes over smoothly. After the last point the reference
holds its position. Near positions may be smoothed, and a last point may move, see `streams`; time may go slower, see
`scaling`.

This package is stricter than the joint_trajectory_controller: it refuses partial joint goals (unless allowed),
velocities without positions, fields that some points lack, a start in the past (unless late ones are joined), and
trajectories that need more torque than the joints have.

Time is the stamp of the samples, in integer nanoseconds; no clock is read.
"""

from .reference import ReferenceGenerator, Verdict
from .request import JointTrajectoryData, validate
from .streams import Streaming
from .torque import refuse_torque
from .values import MAX_MAGNITUDE, MAX_POINTS

__all__ = [
    "MAX_MAGNITUDE",
    "MAX_POINTS",
    "JointTrajectoryData",
    "ReferenceGenerator",
    "Streaming",
    "Verdict",
    "refuse_torque",
    "validate",
]
