# SPDX-License-Identifier: Apache-2.0
"""Sums over an arm's strains for `observers.plausibility`: see its modules for the equations.

`UNKNOWN`, `FIT` and `BEYOND` are those of `readings`.
"""

import numpy as np

#: What `source_amplitudes` follows of a sample: see there.
DIFFERENCE, LARGE, FAST = 0, 1, 2
#: Rows of what `zero_drift` keeps of each gauge: least bound, what the weight does, zero, low-passed residual, what the
#: motion may do, residual less its zero, its bound, what is taken from the reading.
LEAST, BY_WEIGHT, ZERO, SLOW, MOVING, LEFT, ALLOWED, CORRECTION = 0, 1, 2, 3, 4, 5, 6, 7
#: Rows of what `strain_law` compares: strain, its first and second derivative, p, and the first of those since each
#: moment: all strains, then all first, then all second derivatives.
STRAIN, RATE, ACCELERATION, FORCE, SINCE = 0, 1, 2, 3, 4


def low_passed(rows, weights, signal):
    """Take a sample of several signals; `rows`, (5, N), and `weights`, (3, 5), are those of `low_pass.LowPass`."""
    for i in range(signal.size):
        last, y1, y2, y3 = rows[0, i], rows[2, i], rows[3, i], rows[4, i]
        rows[0, i], rows[1, i] = signal[i], last
        for k in range(3):
            value = weights[k, 0] * signal[i] + weights[k, 1] * last
            rows[2 + k, i] = value + weights[k, 2] * y1 + weights[k, 3] * y2 + weights[k, 4] * y3


def source_amplitudes(value, g, project, rows, middle, half, weights, low, zero, state, ways):
    """Take the readings of a sample for `amplitudes.SourceAmplitudes`.

    Parameters
    ----------
    value : ndarray, shape (N,)
    g : int
        Number of gauges.
    project : ndarray, shape (g, g)
    rows : ndarray, shape (g, m)
    middle, half : ndarray, shape (g,)
        Of the gauges' ranges.
    weights, low : ndarray, shape (3, 5), (5, 2 g)
        Of the `low_pass.LowPass`.
    zero : ndarray, shape (2 g,)
        Followed while it is learnt.
    state : ndarray, shape (3,)
        `DIFFERENCE` of amplitudes and strains, largest over the gauges; how `LARGE` and how `FAST` the strains were
        recently.
    ways : tuple of int, float, float and bool
        Samples before this one, corner of the low pass [rad/s], fraction of `LARGE` and `FAST` that is kept per sample,
        and whether the zero is learnt.

    Returns
    -------
    int
        `UNKNOWN` amplitudes; `FIT`; `BEYOND`: a reading is no number, or at an end of its range.
    """
    m = rows.shape[1]
    n = (value.size - g - 2 * m) // 2
    strain, amplitude = value[n : n + g], value[n + g : n + g + m]
    if amplitude[0] != amplitude[0]:
        return UNKNOWN  # noqa: F821
    count, corner, keep, learns = ways
    now = np.empty(2 * g)
    if not mapped(strain, amplitude, project, rows, middle, half, now):
        return BEYOND  # noqa: F821
    if count == 0:
        for k in range(5):
            low[k] = now
    else:
        low_passed(low, weights, now)
    if learns:
        for i in range(2 * g):
            zero[i] += (low[4, i] - zero[i]) / (count + 1)
    state[:] = apart(low, zero, corner, state[LARGE], state[FAST], keep)
    return FIT  # noqa: F821


def mapped(strain, amplitude, project, rows, middle, half, out):
    """Fill `out`, (2 g,), with the strains' part that modes can cause, and the amplitudes' strains minus this part.

    Returns whether all of it is finite, and no gauge is at an end of its range.

    Parameters
    ----------
    strain, middle, half : ndarray, shape (g,)
        Readings, and their ranges.
    amplitude : ndarray, shape (m,)
    project : ndarray, shape (g, g)
    rows : ndarray, shape (g, m)
    out : ndarray, shape (2 g,)
    """
    g, good = strain.size, True
    for i in range(g):
        own, its = 0.0, 0.0
        for j in range(g):
            own += project[i, j] * strain[j]
        for j in range(amplitude.size):
            its += rows[i, j] * amplitude[j]
        out[i], out[g + i] = own, its - own
        good &= np.isfinite(own) and np.isfinite(its) and abs(strain[i] - middle[i]) < half[i]
    return good


def apart(rows, zero, corner, large, fast, keep):
    """Largest difference of `mapped`'s second half from its zero, and how large and fast its first half was recently.

    Parameters
    ----------
    rows : ndarray, shape (5, 2 g)
        Of the `low_pass.LowPass` of what `mapped` gives.
    zero : ndarray, shape (2 g,)
    corner : float
        Of the low pass [rad/s].
    large, fast, keep : float
        Values before this sample, and the fraction of them that is kept.
    """
    g, difference = zero.size // 2, 0.0
    large, fast = keep * large, keep * fast
    for i in range(g):
        difference = max(difference, abs(rows[4, g + i] - zero[g + i]))
        large = max(large, abs(rows[4, i] - zero[i]))
        fast = max(fast, abs(corner * (rows[3, i] - rows[4, i])))
    return difference, large, fast


def pick_up(strain, position, middle, half, moments, now):
    """Put strains, positions and `moments` times the strains into `now`; whether none is at an end of its range.

    Parameters
    ----------
    strain, middle, half : ndarray, shape (g,)
        Readings, and their ranges.
    position : ndarray, shape (n,)
    moments : int
    now : ndarray, shape (g + n + m + moments g,)
        The m forces in it stay. If a reading is at an end of its range, nothing is written.
    """
    g, n = strain.size, position.size
    for i in range(g):
        if abs(strain[i] - middle[i]) >= half[i]:
            return False
    first = now.size - moments * g
    for i in range(g):
        now[i] = strain[i]
        for k in range(moments):
            now[first + k * g + i] = strain[i]
    for i in range(n):
        now[g + i] = position[i]
    return True


def not_explained(low, corner, drive, load, turn, bend, moved, residual):
    """Fill the accelerations, and the part of the strains that the motion does not explain.

    Parameters
    ----------
    low : ndarray, shape (5, g + n + m or more)
        Of the `low_pass.LowPass` of strains, positions and forces.
    corner : float
        Its [rad/s].
    drive, load, turn, bend : ndarray, shape (g, n), (g, g), (g, g), (g, m)
        `zero_drift.law_matrices`.
    moved : ndarray, shape (g + n,)
        Filled with the second derivatives of strains and positions.
    residual : ndarray, shape (2, g)
        Filled with r, and with p.
    """
    (g, n), m = drive.shape, bend.shape[1]
    for i in range(g + n):
        moved[i] = corner * corner * (low[2, i] - 2.0 * low[3, i] + low[4, i])
    for i in range(g):
        p, inertia = 0.0, 0.0
        for j in range(n):
            p += drive[i, j] * moved[g + j]
        for j in range(m):
            p += bend[i, j] * low[4, g + n + j]
        for j in range(g):
            rate = corner * (low[3, j] - low[4, j])
            inertia += load[i, j] * moved[j] + turn[i, j] * rate
        residual[0, i], residual[1, i] = low[4, i] + inertia + p, p


def follow_drift(residual, moved, position, start, drive, load, doubted, rows, ways):
    """Take a residual for `zero_drift.ZeroDrift`.

    Parameters
    ----------
    residual : ndarray, shape (g,)
    moved : ndarray, shape (g + n,)
        Second derivatives of strains and positions.
    position, start : ndarray, shape (n,)
        Now and at the start [rad].
    drive, load : ndarray, shape (g, n), (g, g)
        What another payload changes.
    doubted : ndarray of bool, shape (g,)
    rows : ndarray, shape (8, g)
    ways : tuple of int, float, float, bool and float
        Residuals that the zero is the mean of, weights of a residual in its low pass and in the correction, whether the
        zero is learnt, and the fraction of `LEAST` below which a correction is set to zero.

    Returns
    -------
    bool
        Whether the zero was learnt from this residual.
    bool
        Whether a gauge is beyond its bound.
    """
    count, weight, quick, learns, nothing = ways
    g, n, turned, wrong = residual.size, position.size, 0.0, False
    moving = np.empty(g)
    for i in range(g):
        by_joints, by_strains = 0.0, 0.0
        for j in range(n):
            by_joints += drive[i, j] * abs(moved[g + j])
        for j in range(g):
            by_strains += load[i, j] * abs(moved[j])
        moving[i] = by_joints + by_strains
        learns &= moving[i] < rows[LEAST, i]
    for j in range(n):
        turned += abs(position[j] - start[j])
    for i in range(g):
        if learns:
            rows[ZERO, i] += (residual[i] - rows[ZERO, i]) / (count + 1)
        rows[SLOW, i] += weight * (residual[i] - rows[SLOW, i])
        rows[MOVING, i] += weight * (moving[i] - rows[MOVING, i])
        rows[LEFT, i] = rows[SLOW, i] - rows[ZERO, i]
        rows[ALLOWED, i] = rows[LEAST, i] + rows[MOVING, i] + min(turned, 2.0) * rows[BY_WEIGHT, i]
        wrong |= abs(rows[LEFT, i]) > rows[ALLOWED, i]
        wanted = residual[i] - rows[ZERO, i] if doubted[i] else 0.0
        rows[CORRECTION, i] += quick * (wanted - rows[CORRECTION, i])
        if abs(rows[CORRECTION, i]) < nothing * rows[LEAST, i]:
            rows[CORRECTION, i] = 0.0
    return learns, wrong


def noise_of_law(gauge, encoder, square, drive, load, turn, groups):
    """Mean of |z|^2 + |p|^2 in `strain_law` due to noise, summed over each gauge's link, shape (g,).

    Parameters
    ----------
    gauge, encoder : ndarray, shape (g,), (n,)
        Variances of low-passed strains and positions.
    square : float
        Square of the corner.
    drive, load, turn : ndarray, shape (g, n), (g, g), (g, g)
    groups : ndarray of bool, shape (g, g)
    """
    g, n = drive.shape
    noise, out = np.empty(g), np.zeros(g)
    for i in range(g):
        of_gauges, of_encoders = 0.0, 0.0
        for j in range(g):
            of_gauges += (square * load[i, j] ** 2 + turn[i, j] ** 2) * gauge[j]
        for j in range(n):
            of_encoders += drive[i, j] * drive[i, j] * encoder[j]
        noise[i] = gauge[i] + square * (of_gauges + square * of_encoders)
    for i in range(g):
        for j in range(g):
            if groups[j, i]:
                out[i] += noise[j]
    return out


def high_passed(low, corner, force, slow, fast, weight, first):
    """Fill `fast` with the readings and those since each moment, without their slow part.

    Parameters
    ----------
    low : ndarray, shape (5, N)
        Of the `low_pass.LowPass`; the strains since each moment come last.
    corner : float
        Its [rad/s].
    force : ndarray, shape (g,)
        p.
    slow, fast : ndarray, shape (4 + 3 k, g)
        Strains, first and second derivatives, forces, then strains since each of k moments, and their derivatives.
    weight : float
        Of the readings in `slow`.
    first : bool
        Whether there were none before.
    """
    rows, g = slow.shape
    moments = (rows - SINCE) // 3
    young = low.shape[1] - moments * g
    for i in range(g):
        for k in range(rows):
            kind, at = k, i
            if k >= SINCE:
                kind, at = (k - SINCE) // moments, young + ((k - SINCE) % moments) * g + i
            if kind == FORCE:
                raw = force[i]
            elif kind == STRAIN:
                raw = low[4, at]
            elif kind == RATE:
                raw = corner * (low[3, at] - low[4, at])
            else:
                raw = corner * corner * (low[2, at] - 2.0 * low[3, at] + low[4, at])
            if first:
                slow[k, i] = raw if k < SINCE else 0.0
            slow[k, i] += weight * (raw - slow[k, i])
            fast[k, i] = raw - slow[k, i]


def follow_misfit(fast, project, load, turn, groups, sums, keep, run, noise, limits):
    """Follow the misfit of strains and motion, and count for how long it is large; see `strain_law`.

    Parameters
    ----------
    fast : ndarray, shape (4 or more, g)
        As of `high_passed`.
    project, load, turn : ndarray, shape (g, g)
    groups : ndarray of bool, shape (g, g)
        Gauges of one link.
    sums : ndarray, shape (2, g)
        Means of |z + p|^2 and |z|^2 + |p|^2.
    keep : float
        Weight of the old ones.
    run : ndarray of int, shape (g,)
    noise : ndarray, shape (g,)
        `noise_of_law`.
    limits : tuple of float, float and int
        How far the sum must be above the noise, the misfit that counts, and how often in a row.

    Returns
    -------
    bool
        Whether the misfit of a gauge has been large for that long.
    """
    clear, large, least = limits
    g, long = run.size, False
    for i in range(g):
        z, p = 0.0, fast[FORCE, i]
        for j in range(g):
            z += project[i, j] * fast[STRAIN, j] + turn[i, j] * fast[RATE, j]
            z += load[i, j] * fast[ACCELERATION, j]
        sums[0, i] = keep * sums[0, i] + (1.0 - keep) * (z + p) ** 2
        sums[1, i] = keep * sums[1, i] + (1.0 - keep) * (z * z + p * p)
    for i in range(g):
        misfit, total = 0.0, 0.0
        for j in range(g):
            if groups[j, i]:
                misfit += sums[0, j]
                total += sums[1, j]
        doubtful = total > clear * clear * noise[i] and misfit > large * total
        run[i] = run[i] + 1 if doubtful else 0
        long |= run[i] >= least
    return long
