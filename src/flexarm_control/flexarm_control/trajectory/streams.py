# SPDX-License-Identifier: Apache-2.0
r"""Streams of points: trajectories whose end moves, and near positions that are smoothed.

A stream, as of MoveIt Servo or of teleoperation, sends its next point before the last one is reached. Such a point may
have a velocity. If no other point comes, the motion goes on for the time C (`cmd_timeout`) and comes to rest in B:

.. math::
    \dot q &= v + a t (1 - t/C)^2, && 0 \le t \le C, \\
    \dot q &= v\,(1 - 10x^3 + 15x^4 - 6x^5) + a' B x (1 - x)^3, && x = (t - C)/B,

where v and a are the velocity and acceleration of the last point. a' is 0 after the first part; if C is 0, there is no
first part, and a' is a. Velocity and acceleration have no step, and the jerk has none at the end.

Points with positions alone are joined by straight lines, whose velocity steps at each point. If points are nearer to
each other than `smoothing_time`, the straight lines L are smoothed by a triangle of width W,

.. math:: q(t) = \frac{F(t + W/2) - 2F(t) + F(t - W/2)}{(W/2)^2}, \qquad F'' = L .

Its velocity and acceleration are the same differences of F' and of L. The motion reaches the end, at rest, W/2 later. A
single point is reached at rest, after W if its own time is shorter. A stream of single points is thus filtered with
third order. W is `smoothing_time`, and at least half a period of the lowest bending mode.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from flexarm_dynamics.parameters import parameter

from .values import BRAKING_STEP, SECOND

REFUSE, IGNORE, ADD = "refuse", "ignore", "add"
PARAMETERS = (
    parameter("allow_nonzero_velocity_at_trajectory_end", False).described(
        "Whether the last point of a trajectory may have a velocity, as in a stream. The motion then goes on for"
        " cmd_timeout, and comes to rest smoothly if nothing else has arrived by then."
    ),
    parameter("cmd_timeout", 0.1, "s", 0.0, 3600.0).described(
        "How long a motion goes on after a last point with a velocity. 0.0: it comes to rest from that point on."
    ),
    parameter("smoothing_time", 0.1, "s", 0.0, 10.0).described(
        "Points with positions alone that are nearer to each other than this are smoothed over this time, and at least"
        " half a period of the lowest bending mode. 0.0: straight lines, whose velocity steps at each point."
    ),
    parameter("effort_in_points", REFUSE, choices=(REFUSE, IGNORE, ADD)).described(
        "Treatment of effort in points: refuse; ignore; add: it is added to the torque, which already contains"
        " everything that the arm's model gives."
    ),
)
#: Ratio of the largest slope of the brake's velocity to its mean one [-].
BRAKE_SLOPE = 15.0 / 8.0
#: Minimum duration of the brake, in periods of the lowest bending mode.
BRAKE_PERIODS = 1.2
#: Minimum window of smoothing, in the same periods.
SMOOTH_PERIODS = 0.5


@dataclass(frozen=True)
class Streaming:
    """How points of streams are taken; by default like any other points, and effort is refused.

    Attributes
    ----------
    moving_end : bool
        Whether the last point may have a velocity.
    timeout : float
        C [s]
    deceleration : float or ndarray, shape (n,)
        Largest deceleration in the brake [rad/s^2].
    period : float
        Period of the lowest bending mode [s].
    smoothing : float
        Points that are nearer to each other than this are smoothed [s]; 0: none.
    effort : str
        One of `REFUSE`, `IGNORE` and `ADD`.
    """

    moving_end: bool = False
    timeout: float = 0.0
    deceleration: object = 2.0
    period: float = 0.0
    smoothing: float = 0.0
    effort: str = REFUSE

    @property
    def window(self):
        """W [s]; for a faster motion the slow manifold would not be valid."""
        return max(self.smoothing, SMOOTH_PERIODS * self.period)

    def coast(self, velocity):
        """The `Coast` after a last point with a velocity (n,) [rad/s]."""
        brake = float((BRAKE_SLOPE * np.abs(velocity) / self.deceleration).max())
        brake = max(brake, BRAKE_PERIODS * self.period, BRAKING_STEP)
        return Coast(round(self.timeout * SECOND), round(brake * SECOND))


#: Treats points like a joint_trajectory_controller by default, except for effort.
PLAIN = Streaming()


@dataclass(frozen=True)
class Coast:
    """The end of a motion whose last point moves: durations for which it goes on, and then brakes [ns]."""

    going_on_ns: int
    brake_ns: int

    @property
    def times_ns(self):
        """Durations of its polynomials: one or two."""
        return [time for time in (self.going_on_ns, self.brake_ns) if time > 0]

    def coefficients(self, position, velocity, acceleration):
        """Coefficients of its polynomials, each (7, n), from the state at the last point; and the rest position (n,).

        The position is sum_i c_i t^i.
        """
        out, q, a = [], position, acceleration
        if self.going_on_ns > 0:
            time = self.going_on_ns / SECOND
            shape = np.outer([0.0, 0.0, 0.5, -2.0 / 3.0, 0.25, 0.0, 0.0], a)
            out.append(_scaled(q, velocity, shape * time**2, time))
            q, a = q + time * velocity + time**2 / 12.0 * a, 0.0 * a
        time = self.brake_ns / SECOND
        shape = np.outer([0.0, 0.0, 0.0, 0.0, -2.5, 3.0, -1.0], time * velocity)
        shape += np.outer([0.0, 0.0, 0.5, -1.0, 0.75, -0.2, 0.0], time**2 * a)
        out.append(_scaled(q, velocity, shape, time))
        return out, q + 0.5 * time * velocity + 0.05 * time**2 * a


def _scaled(position, velocity, shape, time):
    """Coefficients in t of position + velocity t + sum_i shape_i x^i, x = t / time."""
    out = shape / time ** np.arange(7.0)[:, None]
    out[0], out[1] = position, velocity
    return out


def are_near(times_ns, window):
    """Whether some of the points, and a start before the first, are nearer to each other than a window [s]."""
    between = np.diff(times_ns, prepend=0)
    return bool(((between < window * SECOND) & (between > 0)).any())


def smoothed(times_ns, positions, window):
    """Smooth positions at near points; see the module.

    Parameters
    ----------
    times_ns : ndarray of int, shape (k,)
        Times of the points from the start [ns].
    positions : ndarray, shape (k, n)
        [rad]
    window : float
        W [s]

    Returns
    -------
    times_ns : ndarray of int, shape (l,)
        Times of the result: the last one is later, and those within W of the start are left out.
    fields : list of 3 ndarrays, shape (l, n)
        Positions, velocities and accelerations; at rest at the end.
    """
    half_ns = round(0.5 * window * SECOND)
    if len(times_ns) == 1:
        times = np.maximum(times_ns, 2 * half_ns)
        return times, [positions, np.zeros_like(positions), np.zeros_like(positions)]
    times = np.append(times_ns[times_ns >= 2 * half_ns], times_ns[-1] + half_ns)
    t, half = times / SECOND, half_ns / SECOND
    line = _line(times_ns / SECOND, positions, 2.0 * window)
    fields = []
    for order in (2, 1, 0):
        f = line.antiderivative(order) if order else line
        fields.append((f(t + half) - 2.0 * f(t) + f(t - half)) / half**2)
    fields[0][-1], fields[1][-1], fields[2][-1] = positions[-1], 0.0, 0.0
    return times, fields


def _line(times, positions, beyond):
    """Straight lines between points; the first line goes on before the first point, and the end is held after it."""
    slope = (positions[1] - positions[0]) / (times[1] - times[0])
    times = np.concatenate([[times[0] - beyond], times, [times[-1] + beyond]])
    positions = np.vstack([positions[0] - beyond * slope, positions, positions[-1]])
    return make_interp_spline(times, positions, k=1)
