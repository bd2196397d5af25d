# SPDX-License-Identifier: Apache-2.0
r"""Makes motions like MoveIt and others: with trapezoidal speed, and also with a limit of jerk.

On a straight path in the joints from rest to rest, the time-optimal motion within limits of speed and acceleration
(TOTG, TOPP-RA) has a trapezoid of speed. With a limit of jerk (Ruckig) it is the same convolved with a box whose width
is acceleration over jerk, as long as the limits are reached. Both are exact here.
"""

import numpy as np
from scipy.interpolate import PPoly

from flexarm_control.shaping.piecewise import PiecewiseMotion

#: Fraction of a trapezoid's duration in which it accelerates, and in which it brakes [-].
RAMP = 1.0 / 3.0


def trapezoid(start, end, duration):
    """Return the motion with a trapezoid of speed, as points with velocities; cubic polynomials represent it exactly.

    Parameters
    ----------
    start, end : (n,) array_like
        [rad]
    duration : float
        [s]
    """
    start, end = np.asarray(start, float), np.asarray(end, float)
    ramp = RAMP * duration
    speed = (end - start) / (duration - ramp)
    times = np.array([0.0, ramp, duration - ramp, duration])
    done = 0.5 * ramp * speed
    positions = np.stack([start, start + done, end - done, end])
    return PiecewiseMotion.through(
        times, [positions, np.stack([0 * speed, speed, speed, 0 * speed])]
    )


def resampled(motion, period):
    """Return a motion as points with all fields at equal times, as MoveIt's TOTG gives it.

    Parameters
    ----------
    motion : PiecewiseMotion
    period : float
        MoveIt's default is 0.1 s [s].
    """
    times = np.append(np.arange(0.0, motion.duration - 1e-9, period), motion.duration)
    states = list(motion.states(times))
    states[2][-1] = 0.0
    return PiecewiseMotion.through(times, states)


def jerk_limited(motion, width):
    """Return a motion convolved with a box.

    Parameters
    ----------
    motion : PiecewiseMotion
        Its polynomials are cubic at most.
    width : float
        Acceleration over jerk, by which the motion gets longer [s].
    """
    still = np.zeros((1, *motion.coefficients.shape[1:]))
    before, after = still.copy(), still.copy()
    before[0, 0], after[0, 0] = motion.start, motion.end
    coefficients = np.concatenate([before, motion.coefficients, after])
    knots = np.concatenate(
        [[motion.knots[0] - 2.0 * width], motion.knots, [motion.knots[-1] + 2.0 * width]]
    )
    whole = PPoly(coefficients.transpose(1, 0, 2)[::-1], knots)
    total = whole.antiderivative()
    times = np.unique(np.concatenate([motion.knots, motion.knots + width]).round(12))
    p = (total(times) - total(times - width)) / width
    v = (whole(times) - whole(times - width)) / width
    a = (whole(times, 1) - whole(times - width, 1)) / width
    for values in (v, a):
        values[[0, -1]] = 0.0
    p[-1] = motion.end
    return PiecewiseMotion.through(times, [p, v, a])  # of degree 4: all fields are needed
