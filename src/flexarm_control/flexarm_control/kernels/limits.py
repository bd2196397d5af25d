# SPDX-License-Identifier: Apache-2.0
"""What `loop.authority`, `loop.supervisor` and `loop.applied` compute of every sample: see there."""

import numpy as np


def sent(u, weight, part, rate, dt, limit, torque):
    """Put the part of a torque that may be sent into `torque`; return whether a limit was met.

    Parameters
    ----------
    u, weight : ndarray, shape (n,)
        The law's torque, and the torque that holds the arm's weight [N m].
    part : float
        Fraction of u - weight that is applied, 0 to 1.
    rate, limit : ndarray, shape (n,)
        Limits of the torque's change per second and of its size; infinite where there is none [N m/s], [N m].
    dt : float
        Time over which the rate limit applies [s].
    torque : ndarray, shape (n,)
        The last torque that was sent; overwritten with the new one [N m].
    """
    met = False
    for i in range(u.size):
        wanted = u[i]
        if part < 1.0:  # a law may ask for more than the limit, or against the weight
            wanted = weight[i] + part * min(max(u[i] - weight[i], -limit[i]), limit[i])
        value = wanted
        if rate[i] < np.inf:
            step = rate[i] * dt
            value = min(max(value, torque[i] - step), torque[i] + step)
        value = min(max(value, -limit[i]), limit[i])
        met |= value != wanted
        torque[i] = value
    return met


def watched(error, q, qd, amplitude, ranges, rows, inverse, value, ratio):
    """Fill the values that the supervisor watches, and their ratios to the limits; whether a ratio is above 1, or NaN.

    Parameters
    ----------
    error, q, qd : ndarray, shape (n,)
        Tracking error, positions and velocities of the joints.
    amplitude : ndarray, shape (m,)
    ranges : ndarray, shape (n or 0, 4)
        Least and largest position, deceleration, and the most that a predicted excess of the range may count.
    rows : ndarray, shape (g, m)
        Of the strain map.
    inverse : ndarray, shape (3 n + m + g + 1,)
        One over each limit.
    value, ratio : ndarray, shape (3 n + m + g + 1,)
        The last value is given, the others are filled.
    """
    n, m = q.size, amplitude.size
    for i in range(n):
        value[i], value[n + i] = abs(error[i]), abs(qd[i])
    for i in range(ranges.shape[0]):
        low, high, able, most = ranges[i, 0], ranges[i, 1], ranges[i, 2], ranges[i, 3]
        reach = q[i] + qd[i] * abs(qd[i]) / (2.0 * able)
        # A predicted excess is a reason to stop, but not yet a fault.
        will_be = min(max(low - reach, reach - high), most)
        value[2 * n + i] = max(0.0, max(low - q[i], max(q[i] - high, will_be)))
    for i in range(m):
        value[3 * n + i] = abs(amplitude[i])
    for k in range(rows.shape[0]):
        strain = 0.0
        for i in range(m):
            strain += rows[k, i] * amplitude[i]
        value[3 * n + m + k] = abs(strain)
    beyond = False
    for i in range(value.size):
        ratio[i] = value[i] * inverse[i]
        if not ratio[i] <= 1.0:
            beyond = True
    return beyond


def alike(a, b, tolerance):
    """Whether two arrays differ nowhere by more than a tolerance; False if one has NaN."""
    near = True
    for i in range(a.size):
        near &= abs(a[i] - b[i]) <= tolerance[i]
    return near
