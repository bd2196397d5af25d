# SPDX-License-Identifier: Apache-2.0
"""What `composite.law` computes of every sample once slow law, motion and gains are known: see there."""

import numpy as np


def about_motion(q, qd, position, velocity, torque, nominal, response, amplitude, rate, slow, bar):
    """Slow torque about a feed-forward's motion, and the deflections that go with it.

    Parameters
    ----------
    q, qd : ndarray, shape (n,)
        Of the joints [rad], [rad/s].
    position, velocity, torque, nominal : ndarray, shape (n,)
        Of the motion, and what the slow law gives on it [rad], [rad/s], [N m].
    response : ndarray, shape (2m + n, 2n)
        Of deflections, rates and torque to the tracking error.
    amplitude, rate : ndarray, shape (m,)
        The motion's deflections and their rates.
    slow : ndarray, shape (n,)
        The slow law's torque [N m]; what else belongs to it is added.
    bar : ndarray, shape (2m,)
        Filled with z_bar.
    """
    n, m, size = q.size, amplitude.size, bar.size
    for i in range(size):
        value = 0.0
        for j in range(n):
            value += response[i, j] * (q[j] - position[j])
            value += response[i, n + j] * (qd[j] - velocity[j])
        bar[i] = (amplitude[i] if i < m else rate[i - m]) + value
    for i in range(n):
        value = 0.0
        for j in range(n):
            value += response[size + i, j] * (q[j] - position[j])
            value += response[size + i, n + j] * (qd[j] - velocity[j])
        slow[i] += torque[i] - nominal[i] + value


def wanted_acceleration(q, qd, position, velocity, acceleration, Lambda0, Lambda1, out):
    """Fill `out` with v of (13) and (14): the desired acceleration of the slow subsystem; all (n,)."""
    for i in range(q.size):
        pull = Lambda0[i] * (q[i] - position[i]) + Lambda1[i] * (qd[i] - velocity[i])
        out[i] = acceleration[i] + pull


def deviation(delta, delta_d, delta_bar, rate_bar, quasi_steady, z_f):
    """Fill z_f = z - z_bar, (2m,), and `quasi_steady` with the deflections of z_bar, all (m,)."""
    m = quasi_steady.size
    for i in range(m):
        quasi_steady[i] = delta_bar[i]
        z_f[i] = delta[i] - delta_bar[i]
        z_f[m + i] = delta_d[i] - rate_bar[i]


def together(motion, limit, slow, fast, torque, wanted):
    """Scale the feedback of all joints until no torque is beyond its limit; return whether one was.

    Parameters
    ----------
    motion, limit : ndarray, shape (n,)
        The motion's torque, which is not scaled, and the torque limits [N m].
    slow, fast, torque : ndarray, shape (n,)
        Slow and fast torque, and their sum; all are overwritten.
    wanted : ndarray, shape (n,)
        If a torque was beyond its limit, filled with the signs of all torques times infinity.
    """
    part, beyond = 1.0, False
    for i in range(torque.size):
        if abs(torque[i]) > limit[i]:
            beyond = True
            bound = limit[i] if torque[i] > 0.0 else -limit[i]
            part = min(part, max((bound - motion[i]) / (torque[i] - motion[i]), 0.0))
    if beyond:
        for i in range(torque.size):
            wanted[i] = np.copysign(np.inf, torque[i])
            slow[i] = motion[i] + part * (slow[i] - motion[i])
            fast[i] *= part
            torque[i] = slow[i] + fast[i]
    return beyond


def cubic(coefficients, knots, t, out):
    """Fill `out`, (n,), with a piecewise cubic at t; its first and last pieces go on beyond its ends.

    Parameters
    ----------
    coefficients : ndarray, shape (4, k, n)
        By the time since a piece's knot, those of the cubes first, as in scipy.
    knots : ndarray, shape (k + 1,)
    t : float
    out : ndarray, shape (n,)
    """
    low, high = 0, knots.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if t < knots[middle]:
            high = middle
        else:
            low = middle
    s = t - knots[low]
    for i in range(out.size):
        c = coefficients[:, low, i]
        out[i] = ((c[0] * s + c[1]) * s + c[2]) * s + c[3]


def between(times, values, t, out):
    """Fill `out`, (p, n), with `values`, (k, p, n), of `times`, (k,): linear between them, held beyond either end."""
    low, high = 0, times.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if t < times[middle]:
            high = middle
        else:
            low = middle
    f = 0.0
    if high > low:
        f = min(max((t - times[low]) / (times[high] - times[low]), 0.0), 1.0)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = (1.0 - f) * values[low, i, j] + f * values[high, i, j]


def evenly_between(values, x, out):
    """Fill `out`, (n,), with `values`, (k, n), at a place x among the rows; linear between, the last one held."""
    i = min(int(x), values.shape[0] - 2)
    f = min(x - i, 1.0)
    for j in range(out.size):
        out[j] = (1.0 - f) * values[i, j] + f * values[i + 1, j]


def faded(c, rate, dt):
    """Advance (c0 + c1 t + c2 t^2) e^(-rate t), coefficients c (3, n), by a time; their largest magnitude then."""
    decay, largest = np.exp(-rate * dt), 0.0
    for i in range(c.shape[1]):
        c0, c1, c2 = c[0, i], c[1, i], c[2, i]
        c[0, i] = decay * (c0 + dt * (c1 + dt * c2))
        c[1, i] = decay * (c1 + 2.0 * dt * c2)
        c[2, i] = decay * c2
        for k in range(3):
            size = abs(c[k, i])
            if size > largest or size != size:  # NaN stays
                largest = size
    return largest


def off(state, left, own, error):
    """Fill `error`, (N,), with the wanted state, its fading jump included, minus the simulated arm's state.

    Parameters
    ----------
    state, own : ndarray, shape (N,)
        Wanted, and the simulated arm's.
    left : ndarray, shape (N + n,)
        Of the jumps of state and torque.
    error : ndarray, shape (N,)

    Returns
    -------
    float
        Largest magnitude of the first n errors, those of the joints; NaN if any error is NaN.
    float
        Largest magnitude of all errors; NaN likewise.
    """
    n, joints, largest = left.size - state.size, 0.0, 0.0
    for i in range(state.size):
        error[i] = state[i] + left[i] - own[i]
        size = abs(error[i])
        if size != size:
            return np.nan, np.nan
        largest = max(largest, size)
        if i < n:
            joints = max(joints, size)
    return joints, largest


def regulated(torque, left, gain, error, limit, friction, wanted, own, out, driven):
    """Fill `out`, (n,), with the torque for a simulated arm, and `driven`, (n,), with this torque minus friction.

    The torque is the sum of the reference's torque, its fading jump, the regulator's torque, and the Coulomb friction
    at the arm's own speeds minus that at the wanted speeds. The sum is clipped to the limit; see `off`.

    Parameters
    ----------
    torque : ndarray, shape (n,)
        Of the reference.
    left : ndarray, shape (N + n,)
        Of the jumps of state and torque.
    gain : ndarray, shape (n, N)
        The regulator's.
    error : ndarray, shape (N,)
        As `off` fills it.
    limit : ndarray, shape (n,)
    friction : ndarray, shape (n, 3)
        As of `ArmModel.friction_table`.
    wanted, own : ndarray, shape (N,)
        States; as of `off`.
    out, driven : ndarray, shape (n,)
    """
    first, half = error.size, error.size // 2
    for i in range(out.size):
        value, rubs = 0.0, 0.0
        for j in range(first):
            value += gain[i, j] * error[j]
        value += torque[i] + left[first + i]
        if friction[i, 1] > 0.0:
            rubs = friction[i, 1] * np.tanh(own[half + i] / friction[i, 2])
            value += rubs - friction[i, 1] * np.tanh(wanted[half + i] / friction[i, 2])
        out[i] = min(max(value, -limit[i]), limit[i])
        driven[i] = out[i] - rubs


def horner(coefficients, x, out):
    """Fill `out`, (p, n), with polynomials at x; their coefficients, (k, p, n), the constant ones first."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            value = coefficients[-1, i, j]
            for k in range(coefficients.shape[0] - 2, -1, -1):
                value = value * x + coefficients[k, i, j]
            out[i, j] = value


def horners(coefficients, x, step, out):
    """Fill `out`, (k, p, n), with polynomials as of `horner` at k places, `step` apart; the middle one is x."""
    for i in range(out.shape[0]):
        horner(coefficients, x + (i - out.shape[0] // 2) * step, out[i])


def weights_between(q, at, joints, weights):
    """Fill `weights`, (k,), of sets of gains that are made for configurations `at`, (k, n), in q (n,) [rad].

    `joints`: numbers of those that matter. Inverse squares of the distances, their sum 1.
    """
    total = 0.0
    for k in range(weights.size):
        square = 1e-12
        for j in joints:
            half = np.sin(0.5 * (q[j] - at[k, j]))
            square += 4.0 * half * half
        weights[k] = 1.0 / square
        total += weights[k]
    for k in range(weights.size):
        weights[k] /= total


def state_before(late, newest, intervals, states, out):
    """Fill `out` (k,) with the state some time ago: half of it positions, the other half their rates.

    Between samples it is the cubic with the positions and rates of both. Before the first one, the rates are constant.

    Parameters
    ----------
    late : float
        How long ago [s].
    newest : int
        Row of the newest sample in the ring of rows.
    intervals : ndarray, shape (s,)
        Time since the previous sample [s]; infinite: the first one.
    states : ndarray, shape (s, k)
        State at each sample.
    out : ndarray, shape (k,)
        Filled.
    """
    size, half, i, between = intervals.size, out.size // 2, newest, False
    for _ in range(size - 1):
        if late < intervals[i]:
            between = late > 0.0 and np.isfinite(intervals[i])
            break
        late -= intervals[i]
        i = (i - 1) % size
    for k in range(half):
        position, rate = states[i, k], states[i, half + k]
        if between:
            h = intervals[i]
            s, before = 1.0 - late / h, states[i - 1, k]
            slope, change = states[i - 1, half + k], (position - before) / h
            a, b = 3.0 * change - 2.0 * slope - rate, slope + rate - 2.0 * change
            out[k] = before + h * s * (slope + s * (a + s * b))
            out[half + k] = slope + s * (2.0 * a + 3.0 * s * b)
        else:
            out[k] = position - late * rate if late > 0.0 else position
            out[half + k] = rate
