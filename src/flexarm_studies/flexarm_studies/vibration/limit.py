# SPDX-License-Identifier: Apache-2.0
r"""Finds the least vibration that any time law can leave after a motion, on the simulated arm itself.

A time law of `flexarm_control.shaping.time_law` has the accelerations x at its inner nodes. Its modes are not used
here. The motion y of the tip in a window after the end is linearised by differences, :math:`\partial y/\partial x`;
each column needs a simulated motion. Then

.. math:: \min_{\delta, c, e} \lVert e\rVert \quad\text{with}\quad
    \lvert y_i(t) + (\partial y_i/\partial x)\,\delta - c_i\rvert \le e_i, \quad |\delta_k| \le r, \quad
    |\ddot\sigma| \le a,\; 0 \le \dot\sigma \le v,\; \dot\sigma(T) = 0,\; \sigma(T) = 1

is a linear programme over time t and axes i. The norm is approximated by the largest component along the `directions`.
A step :math:`\delta` is taken if the simulated residual falls; otherwise the radius r is halved. This is successive
linear programming with a trust region (Palacios-Gomez, Lasdon & Engquist 1982). Its result is feasible, but there may
be a smaller residual elsewhere, far from the start.
"""

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import linprog

from flexarm_control.shaping.time_law import ITERATIONS, SLACK

#: Step of the differences, and the first radius, over the largest acceleration [-].
DIFFERENCE, RADIUS = 0.05, 0.3
#: Number of linearisations, and of steps that are tried after each.
ROUNDS, TRIES = 4, 4
#: A linearisation that improves the residual by less than this fraction is the last one [-].
GAIN = 0.05
#: Number of times in the window at which the tip is evaluated.
TIMES = 120
#: Number of angles between the directions of the norm, which is then accurate to 1.5 %.
ANGLES = 9


def least(arm, law, x, window):
    """The residual of a time law, and the least residual that the search finds from there.

    Parameters
    ----------
    arm : PositionArm
    law : time_law.Law
    x : (N - 1,) ndarray
        Accelerations to begin with [1/s^2].
    window : float
        Length of the window of the residual [s].

    Returns
    -------
    first, least : float
        [m]
    x : (N - 1,) ndarray
        The accelerations that leave the least.
    """
    free = null_space(law.ends)
    first, tip = _made(arm, law, x, window)
    least = first
    radius = RADIUS * law.limits[1]
    for _ in range(ROUNDS):
        slope, before = _slope(arm, law, x, free, window, tip), least
        for _ in range(TRIES):
            change = _change(law, x, free, slope, tip, radius)
            now, there = _made(arm, law, x + change, window)
            if now < least:
                x, least, tip = x + change, now, there
            else:
                radius *= 0.5
        if least > (1.0 - GAIN) * before:
            break
    return first, least, x


def _made(arm, law, x, window):
    """Residual [m], and positions of the tip at `TIMES` after the end (TIMES, 3) [m]."""
    swing = arm.follow(law.motion(x), window)
    times = swing.end + np.linspace(0.0, window, TIMES)
    tip = np.array([np.interp(times, swing.time, axis) for axis in swing.tip.T]).T
    return swing.residual(window), tip


def _slope(arm, law, x, free, window, tip):
    """Effect of each free direction (N - 1, f) of the accelerations on the tip, (TIMES, 3, f)."""
    step = DIFFERENCE * law.limits[1]
    columns = [(_made(arm, law, x + step * way, window)[1] - tip) / step for way in free.T]
    return np.stack(columns, axis=2)


def _change(law, x, free, slope, tip, radius):
    """The change of x within a radius that leaves least according to the linearisation."""
    velocity, acceleration = law.limits
    size, now = max(np.ptp(tip, axis=0).max(), 1e-12), law.inner @ x
    # The unknowns are the steps along `free`, the middle and half the width of each axis's swing, and the norm.
    steps, middle, half, norm = np.split(np.eye(free.shape[1] + 7), [-7, -4, -1])
    rows, limits = [directions() @ half - norm], [np.zeros(ANGLES**2)]
    for axis in range(3):
        moved, y = slope[:, axis] / size @ steps - middle[axis], tip[:, axis] / size
        rows += [moved - half[axis], -moved - half[axis]]
        limits += [-y, y]
    speed, bend = law.inner @ free @ steps, free @ steps
    rows += [speed, -speed, bend, -bend]
    limits += [velocity * (1.0 + SLACK) - now, now + SLACK * velocity]
    limits += [np.clip(acceleration - sign * x, 0.0, radius) for sign in (1.0, -1.0)]
    found = linprog(
        norm[0], np.vstack(rows), np.concatenate(limits), bounds=(None, None),
        method="highs", options={"maxiter": ITERATIONS},
    )  # fmt: skip
    return free @ found.x[: free.shape[1]] if found.success else np.zeros_like(x)


def directions():
    """Unit vectors (k, 3) for the norm of a vector without negative components: its largest component along them."""
    turns = np.linspace(0.0, 0.5 * np.pi, ANGLES)
    first, second = (each.ravel() for each in np.meshgrid(turns, turns))
    return np.stack(
        [np.cos(first) * np.cos(second), np.sin(first) * np.cos(second), np.sin(second)], axis=1
    )
