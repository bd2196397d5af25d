# SPDX-License-Identifier: Apache-2.0
"""Sums over an arm's readings for `observers.plausibility`: see its modules for the equations."""

import numpy as np

#: Rows of what `jumps` keeps of each reading.
LINE, RESIDUAL, BOUND, FLOOR, NOISE, SCALE, SQUARE, EXCESS = 0, 1, 2, 3, 4, 5, 6, 7
#: Rows of what does not change: rms noise, acceleration by what is not reported, whether it is a rate, that of lost
#: samples' torque, steps of the encoders at positions and at velocities.
OF_NOISE, OF_PUSH, OF_RATE, OF_LOST, OF_COUNT, OF_SPEED_COUNT = 0, 1, 2, 3, 4, 5
#: Rows of what `agreement` keeps of each window and pair.
CHANGED, DRIVEN, MISSED, BETWEEN, START, FIRST = 0, 1, 2, 3, 4, 5


def larger(a, b):
    """The larger of two numbers; NaN if one of them is, as `np.maximum` has it."""
    return a if a >= b or a != a else b


def judge_jumps(
    value, past, times, first, steps, late, change, fixed, gain, growth, deviations, rows
):
    """Compare readings with the line through their past; whether one is beyond its bound.

    Parameters
    ----------
    value : ndarray, shape (N,)
    past, times : ndarray, shape (p, N), (p,)
        The last samples.
    first : int
        The slope is from this one of them to the last.
    steps : tuple of float
        Time since the last sample [s], and how much of the torque of lost samples may still act.
    late : float
        How far the stamps may be off [s].
    change : ndarray, shape (n,)
        Step of the torque [N m].
    fixed : ndarray, shape (6, N)
    gain : ndarray, shape (N, n)
    growth, deviations : float
    rows : ndarray, shape (8, N)
        The first six rows are written.
    """
    dt, unseen = steps
    last = past.shape[0] - 1
    span = times[last] - times[first]
    rho = dt / span
    spread = np.sqrt(1.0 + (1.0 + rho) ** 2 + rho * rho)
    beyond = False
    for i in range(value.size):
        slope = (past[last, i] - past[first, i]) / span
        line = slope * dt + past[last, i]
        residual = abs(value[i] - line)
        scale = 0.5 * (dt + span) if fixed[OF_RATE, i] != 0.0 else 0.5 * dt * (dt + span)
        noise = larger(np.sqrt(rows[SQUARE, i]), fixed[OF_NOISE, i]) * (deviations * spread)
        bound = 0.0
        for j in range(change.size):
            bound += gain[i, j] * change[j]
        if unseen > 0.01:
            bound += unseen * fixed[OF_LOST, i]
        bound += fixed[OF_PUSH, i]
        bound += growth * rows[EXCESS, i]
        floor = abs(slope) * (2.0 * late * (1.0 + rho))
        floor += (1.0 + rho) * fixed[OF_COUNT, i] + (1.0 + rho) / dt * fixed[OF_SPEED_COUNT, i]
        bound = bound * scale + noise + floor
        rows[LINE, i], rows[RESIDUAL, i], rows[BOUND, i] = line, residual, bound
        rows[FLOOR, i], rows[NOISE, i], rows[SCALE, i] = floor, noise, scale
        if residual > bound:
            beyond = True
    return beyond


def learn_jumps(rows, replaced, spread, learns, weight, keep):
    """Follow noise and excess, from the residuals of readings that were believed.

    Parameters
    ----------
    rows : ndarray, shape (8, N)
        The last two rows are followed.
    replaced : ndarray of bool, shape (N,)
        Readings that were not believed.
    spread : float
    learns : bool
        Whether all is taken for noise.
    weight, keep : float
        Of a new square, and of an old excess.
    """
    for i in range(replaced.size):
        residual, noise = rows[RESIDUAL, i], rows[NOISE, i]
        if residual != residual:
            residual = 0.0
        rms = residual / spread
        if not learns:
            rms = min(rms, 0.5 * noise / spread)  # 3 standard deviations
        excess = (residual - (0.5 * noise + rows[FLOOR, i])) / rows[SCALE, i]
        if replaced[i]:
            rms = excess = 0.0
        rows[SQUARE, i] += (rms * rms - rows[SQUARE, i]) * weight
        rows[EXCESS, i] = larger(rows[EXCESS, i] * keep, excess)


def remember(value, stamp, past, times):
    """Move the past on by one sample."""
    last = past.shape[0] - 1
    for k in range(last):
        times[k] = times[k + 1]
        for i in range(value.size):
            past[k, i] = past[k + 1, i]
    times[last] = stamp
    for i in range(value.size):
        past[last, i] = value[i]


def begin_agreement(value, pairs, rate, windows, ages):
    """Begin all windows with this sample."""
    ages[:] = 0.0
    for j in range(pairs.shape[1]):
        rate[j] = value[pairs[1, j]]
        for w in range(windows.shape[1]):
            restart(value, pairs, rate, windows, w, j)


def agree(
    value,
    pairs,
    dt,
    late,
    change,
    gain,
    factors,
    noise,
    lengths,
    rate,
    windows,
    ages,
    run,
    evidence,
):
    """Compare the rates with their values over all windows; whether a pair is beyond its bound.

    Parameters
    ----------
    value : ndarray, shape (N,)
    pairs : ndarray of int, shape (2, k)
        Value and rate of each pair.
    dt : float
        Since the last sample [s].
    late : float
        Jitter of the stamps [s].
    change : ndarray, shape (n,)
        Step of the torque [N m].
    gain : ndarray, shape (k, n)
    factors : tuple of float
        Ratio by which a rate may be wrong, what multiplies that which the rule can miss, delay of a filtered rate [s].
    noise : ndarray, shape (2, k)
        Of the difference, and of the rates.
    lengths : tuple of int
        Of the windows.
    rate : ndarray, shape (k,)
        The last rates; overwritten.
    windows : ndarray, shape (6, w, k)
    ages : ndarray, shape (2, w)
        Samples and time of each window.
    run : ndarray of int, shape (k,)
        Samples in a row that each pair has been beyond its bound.
    evidence : ndarray, shape (2, w, k)
        Change of the value and what the rate gives, when a pair is beyond its bound.
    """
    scale, missed, delay = factors
    any_wrong = False
    for w in range(len(lengths)):
        ages[1, w] += dt
    for j in range(pairs.shape[1]):
        at, now = value[pairs[0, j]], value[pairs[1, j]]
        driven, miss, between = 0.5 * dt * (now + rate[j]), abs(now - rate[j]) * (0.5 * dt), 0.0
        for i in range(change.size):
            between += gain[j, i] * change[i]
        between *= 0.25 * dt * dt
        rate[j] = now
        wrong = False
        for w in range(len(lengths)):
            windows[DRIVEN, w, j] += driven
            windows[MISSED, w, j] += miss
            windows[BETWEEN, w, j] += between
            windows[CHANGED, w, j] = at - windows[START, w, j]
            bound = scale * larger(abs(windows[CHANGED, w, j]), abs(windows[DRIVEN, w, j]))
            bound += missed * windows[MISSED, w, j] + windows[BETWEEN, w, j]
            bound += delay * abs(now - windows[FIRST, w, j]) + noise[0, j]
            bound += 2.0 * late * abs(now) + noise[1, j] * np.sqrt(ages[1, w] * dt)
            if abs(windows[CHANGED, w, j] - windows[DRIVEN, w, j]) > bound:
                wrong = True
        run[j] = run[j] + 1 if wrong else 0
        any_wrong |= wrong
    if any_wrong:
        for w in range(len(lengths)):
            for j in range(pairs.shape[1]):
                evidence[0, w, j] = windows[CHANGED, w, j]
                evidence[1, w, j] = windows[DRIVEN, w, j]
    renew(value, pairs, lengths, rate, windows, ages)
    return any_wrong


def renew(value, pairs, lengths, rate, windows, ages):
    """Begin windows anew that are full, and those of a rate that comes again: they began with NaN."""
    for j in range(pairs.shape[1]):
        if windows[DRIVEN, 0, j] != windows[DRIVEN, 0, j]:
            for w in range(len(lengths)):
                restart(value, pairs, rate, windows, w, j)
    for w in range(len(lengths)):
        ages[0, w] += 1.0
        if ages[0, w] >= lengths[w]:
            ages[0, w] = ages[1, w] = 0.0
            for j in range(pairs.shape[1]):
                restart(value, pairs, rate, windows, w, j)


def low_passed(rows, weights, signal):
    """Take a sample of several signals; `rows`, (5, N), and `weights`, (3, 5), are those of `low_pass.LowPass`."""
    for i in range(signal.size):
        last, y1, y2, y3 = rows[0, i], rows[2, i], rows[3, i], rows[4, i]
        rows[0, i], rows[1, i] = signal[i], last
        for k in range(3):
            value = weights[k, 0] * signal[i] + weights[k, 1] * last
            rows[2 + k, i] = value + weights[k, 2] * y1 + weights[k, 3] * y2 + weights[k, 4] * y3


def mapped(strain, amplitude, project, rows, middle, half, out):
    """Fill `out`, (2 g,), with the strains' part that amplitudes explain, and by how much the amplitudes' differ.

    Whether all of it is finite, and no gauge at an end of its range.

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
    """Largest difference of `mapped`'s second half to its zero, and how large and fast the first half is of late.

    Parameters
    ----------
    rows : ndarray, shape (5, 2 g)
        Of the `low_pass.LowPass` of what `mapped` gives.
    zero : ndarray, shape (2 g,)
    corner : float
        Of the low pass [rad/s].
    large, fast, keep : float
        Before this sample, and what is left of that.
    """
    g, difference = zero.size // 2, 0.0
    large, fast = keep * large, keep * fast
    for i in range(g):
        difference = max(difference, abs(rows[4, g + i] - zero[g + i]))
        large = max(large, abs(rows[4, i] - zero[i]))
        fast = max(fast, abs(corner * (rows[3, i] - rows[4, i])))
    return difference, large, fast


def changed(readings, last, change):
    """Fill `change` with how far readings are from the last ones, which they replace; whether one is the same."""
    same = False
    for i in range(readings.size):
        change[i] = abs(readings[i] - last[i])
        last[i] = readings[i]
        same |= change[i] == 0.0
    return same


def less(smallest, change):
    """Take what is smaller of the changes, NaN aside."""
    for i in range(change.size):
        if change[i] < smallest[i]:
            smallest[i] = change[i]


def all_well(strain, low, high, last):
    """Whether all readings are within their ranges, and none is that before it; `last` is then replaced by them."""
    for i in range(strain.size):
        if not low[i] < strain[i] < high[i] or strain[i] == last[i]:
            return False
    for i in range(strain.size):
        last[i] = strain[i]
    return True


def restart(value, pairs, rate, windows, w, j):
    """Begin window w of pair j with this sample."""
    windows[START, w, j], windows[FIRST, w, j] = value[pairs[0, j]], rate[j]
    windows[DRIVEN, w, j] = windows[MISSED, w, j] = windows[BETWEEN, w, j] = 0.0
