# SPDX-License-Identifier: Apache-2.0
"""Sums over an arm's readings for `observers.plausibility`: see its modules for the equations."""

import numpy as np

#: Rows of what `jumps` keeps of each reading; the last one is the reading as it came.
LINE, RESIDUAL, BOUND, FLOOR, NOISE, SCALE, SQUARE, EXCESS, CAME = 0, 1, 2, 3, 4, 5, 6, 7, 8
#: Rows of its counts: samples in a row that were replaced, and coming samples in which it is not replaced.
RUN, GRACE = 0, 1
#: Rows of the torque: the last sample's and its change, those of the sample that is judged.
LAST, CHANGE, NEW, NEW_CHANGE = 0, 1, 2, 3
#: Rows of what does not change: rms noise, acceleration by what is not reported, whether it is a rate, that of lost
#: samples' torque, steps of the encoders at positions and at velocities.
OF_NOISE, OF_PUSH, OF_RATE, OF_LOST, OF_COUNT, OF_SPEED_COUNT = 0, 1, 2, 3, 4, 5
#: Rows of what `agreement` keeps of each window and pair.
CHANGED, DRIVEN, MISSED, BETWEEN, START, FIRST = 0, 1, 2, 3, 4, 5
#: What a comparison finds: nothing to compare, that it fits, that it does not.
UNKNOWN, FIT, BEYOND = 0, 1, 2


def larger(a, b):
    """The larger of two numbers; NaN if one of them is, as `np.maximum` has it."""
    return a if a >= b or a != a else b


def below(limit, position, velocity, amplitude, rate):
    """Whether all readings are below a `limit` in size; not NaN."""
    good = True
    for i in range(position.size):
        good &= abs(position[i]) < limit
    for i in range(velocity.size):
        good &= abs(velocity[i]) < limit
    for i in range(amplitude.size):
        good &= abs(amplitude[i]) < limit
    for i in range(rate.size):
        good &= abs(rate[i]) < limit
    return good


def is_beyond(values, limit):
    """Whether one of the `values` is at a `limit` in size, or beyond it; not NaN."""
    beyond = False
    for i in range(values.size):
        beyond |= abs(values[i]) >= limit
    return beyond


def join(position, amplitude, velocity, rate, out):
    """Put a state into `out`, (2 n + 2 m,); whether it is finite: nothing is written otherwise."""
    n, m, good = position.size, amplitude.size, True
    for i in range(n):
        good &= np.isfinite(position[i]) and np.isfinite(velocity[i])
    for i in range(m):
        good &= np.isfinite(amplitude[i]) and np.isfinite(rate[i])
    if good:
        for i in range(n):
            out[i], out[n + m + i] = position[i], velocity[i]
        for i in range(m):
            out[n + i], out[2 * n + m + i] = amplitude[i], rate[i]
    return good


def filtered_derivative(amplitude, dt, bandwidth, last, rate):
    """Filter the derivative of the amplitudes, all (m,), into `rate`; see `observers.filtered_derivative`."""
    left = np.exp(-bandwidth * dt)
    for i in range(amplitude.size):
        difference = (amplitude[i] - last[i]) / dt
        rate[i] = (rate[i] - difference) * left + difference
        last[i] = amplitude[i]


def keep(position, velocity, torque, strain, out):
    """Put readings into one row `out`, (3 n + g,)."""
    n = position.size
    for i in range(n):
        out[i], out[n + i], out[2 * n + i] = position[i], velocity[i], torque[i]
    for i in range(strain.size):
        out[3 * n + i] = strain[i]


def gather(position, strain, amplitude, velocity, rate, value, raw):
    """Put the readings into one vector, `value`, and those that may stand still, (q, strain, qd), into `raw`."""
    n, g, m = position.size, strain.size, amplitude.size
    for i in range(n):
        raw[i] = value[i] = position[i]
        raw[n + g + i] = value[n + g + m + i] = velocity[i]
    for i in range(g):
        raw[n + i] = value[n + i] = strain[i]
    for i in range(m):
        value[n + g + i], value[2 * n + g + m + i] = amplitude[i], rate[i]


def arrive(value, torque, strength, rows, torques):
    """Note readings as they came, `value` (N,), in `rows`, and the torque in the last two rows of `torques`, (4, n).

    Zeros and NaN mean that the torque is unknown; its change is `strength`, (n,), then [N m]. A change is at least 0.7
    times that of the sample before, because a change acts for several samples.
    """
    for i in range(value.size):
        rows[CAME, i] = value[i]
    acts, known = False, True
    for i in range(torque.size):
        acts |= torque[i] != 0.0
        known &= np.isfinite(torque[i])
    known &= acts
    for i in range(torque.size):
        torques[NEW, i], torques[NEW_CHANGE, i] = np.nan, strength[i]
        if known:
            step = abs(torque[i] - torques[LAST, i])
            torques[NEW, i] = torque[i]
            if step == step:
                torques[NEW_CHANGE, i] = step
            torques[NEW_CHANGE, i] = larger(torques[NEW_CHANGE, i], 0.7 * torques[CHANGE, i])


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
        Index of the sample from which the slope to the last one is taken.
    steps : tuple of float
        Time since the last sample [s], and how much of the torque of lost samples may still act.
    late : float
        How far the stamps may be off [s].
    change : ndarray, shape (n,)
        Step of the torque [N m].
    fixed : ndarray, shape (6, N)
    gain : ndarray, shape (N, n)
    growth, deviations : float
    rows : ndarray, shape (9, N)
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


def learn_jumps(rows, replaced, counts, often, spread, learns, weight, keep, fade):
    """Follow noise and excess, from the residuals of readings that were believed, and count those that were not.

    Parameters
    ----------
    rows : ndarray, shape (9, N)
        Square and excess are followed.
    replaced : ndarray of bool, shape (N,)
        Readings that were not believed; false afterwards.
    counts : ndarray of int, shape (2, N)
    often : ndarray, shape (N,)
        Readings that were replaced of late.
    spread : float
    learns : bool
        Whether the whole residual counts as noise.
    weight, keep, fade : float
        Weight of a new square, and factors per sample on the old excess and on `often`.
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
        counts[GRACE, i] = max(counts[GRACE, i] - 1, 0)
        counts[RUN, i] = counts[RUN, i] + 1 if replaced[i] else 0
        often[i] = often[i] * fade + (1.0 if replaced[i] else 0.0)
        replaced[i] = False


def remember(value, stamp, past, times, torques):
    """Move the past on by one sample."""
    for i in range(torques.shape[1]):
        torques[LAST, i], torques[CHANGE, i] = torques[NEW, i], torques[NEW_CHANGE, i]
    last = past.shape[0] - 1
    for k in range(last):
        times[k] = times[k + 1]
        for i in range(value.size):
            past[k, i] = past[k + 1, i]
    times[last] = stamp
    for i in range(value.size):
        past[last, i] = value[i]


def is_given(value, indices):
    """Whether one of the readings with these `indices` is a number."""
    given = False
    for i in indices:
        given |= np.isfinite(value[i])
    return given


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
    """Compare the rates with their values over all windows.

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
        Ratio by which a rate may be wrong, factor on what the trapezoidal rule can miss, delay of a filtered rate [s],
        and samples of a window from which on that ratio counts: before, only an opposite sign is found.
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
        Change of the value, and the change that the rate gives; filled when a pair is beyond its bound.

    Returns
    -------
    int
        `UNKNOWN` rates, all of them; `FIT`; `BEYOND`: one pair at least is beyond its bound.
    """
    if not is_given(value, pairs[1]):
        return UNKNOWN
    scale, missed, delay, least = factors
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
            ratio = scale if ages[0, w] >= least else 1.0
            bound = ratio * larger(abs(windows[CHANGED, w, j]), abs(windows[DRIVEN, w, j]))
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
    return BEYOND if any_wrong else FIT


def renew(value, pairs, lengths, rate, windows, ages):
    """Restart windows that are full, and all windows of a pair whose sums are NaN, as its rate was unknown."""
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


def changed(readings, last, middle, half, same):
    """Fill `last` with these readings and their changes since the last ones, and `same` with those that stand still.

    Parameters
    ----------
    readings : ndarray, shape (N,)
    last : ndarray, shape (2, N)
        The last readings, and their changes; overwritten.
    middle, half : ndarray, shape (N,)
        Of the readings' ranges: what is at an end of it does not stand still.
    same : ndarray of bool, shape (N,)

    Returns
    -------
    bool
        Whether one stands still.
    """
    some = False
    for i in range(readings.size):
        change = abs(readings[i] - last[0, i])
        last[0, i], last[1, i] = readings[i], change
        same[i] = change == 0.0 and not abs(readings[i] - middle[i]) >= half[i]
        some |= same[i]
    return some


def follow_changes(change, same, still, smallest, changes):
    """Count for how long readings stand still; note how far the others moved.

    Parameters
    ----------
    change : ndarray, shape (N,)
    same, still : ndarray of bool and int, shape (N,)
    smallest : ndarray, shape (N,)
        Smallest change so far, NaN aside.
    changes : ndarray, shape (N,)
        Filled with the changes; that of a reading that stands still stays.
    """
    for i in range(change.size):
        if same[i]:
            still[i] += 1
            continue
        still[i] = 0
        changes[i] = change[i]
        if change[i] < smallest[i]:
            smallest[i] = change[i]


def follow_joints(
    dt, torque, amplitude, inertia, rows, bent, friction, travel, still, least, moved, found
):
    """Follow how far the torque should have moved joints that stand still; see `standstill`.

    Parameters
    ----------
    dt : float
        Since the last sample [s].
    torque : ndarray, shape (n,)
        Finite.
    amplitude : ndarray, shape (m,)
        Of the modes; NaN: unknown.
    inertia : ndarray, shape (n, n)
        Inverse of the joints' mass matrix.
    rows : ndarray, shape (3, n)
        Torque of the weight, that of the links at zero amplitudes, and that due to noise of the amplitudes [N m].
    bent : ndarray, shape (n, m)
        Torque of the bent links per amplitude.
    friction : tuple of ndarray and float
        (n,) of each joint [N m], and the fraction of weight and bending that is unsure.
    travel : ndarray, shape (n,)
        [rad]
    still : ndarray of int, shape (n,)
    least : int
        Samples for which a joint must stand still.
    moved : ndarray, shape (2, n)
        Speed and angle that the torque has made since; followed.
    found : ndarray of bool, shape (n,)
        Filled with the joints that should have moved.

    Returns
    -------
    bool
        Whether there is one.
    """
    n, acts, known, some = torque.size, False, True, False
    for j in range(amplitude.size):
        known &= np.isfinite(amplitude[j])
    net, unsure = np.empty(n), np.empty(n)
    for i in range(n):
        acts |= torque[i] != 0.0
        of_links = 0.0
        if known:
            for j in range(amplitude.size):
                of_links += bent[i, j] * amplitude[j]
            of_links += rows[1, i]
        net[i] = torque[i] - rows[0, i] + of_links
        unsure[i] = friction[0][i] + friction[1] * (abs(rows[0, i]) + abs(of_links)) + rows[2, i]
    for i in range(n):
        wanted, doubt = 0.0, 0.0
        for j in range(n):
            wanted += inertia[i, j] * net[j]
            doubt += abs(inertia[i, j]) * unsure[j]
        left = max(abs(wanted) - doubt, 0.0) if acts else 0.0  # else: no torque, or brakes
        if still[i] <= 1:
            moved[0, i] = moved[1, i] = 0.0
        moved[0, i] += dt * (left if wanted > 0.0 else -left)
        moved[1, i] += dt * moved[0, i]
        found[i] = still[i] >= least and abs(moved[1, i]) > travel[i]
        some |= found[i]
    return some


def stopped(readings, still, smallest, changes, at, tiny, gauges, limits, found):
    """Find gauges and joint velocities that stand still, and whether all positions and gauges do; see `standstill`.

    Parameters
    ----------
    readings : ndarray, shape (N,)
        Joint positions, strains, joint velocities.
    still, smallest, tiny : ndarray, shape (N,)
    changes : ndarray, shape (k, N)
        Changes before each reading began to stand still; a ring buffer.
    at : int
        Where the ring's next change goes.
    gauges : ndarray, shape (3, g)
        Noise that was seen, noise that is stated, and how many equal readings the latter rules out.
    limits : tuple of int and float
        Equal samples that count if one of the last two changes before them is large, otherwise twice as many are
        needed; ratio of a large change to the smallest one.
    found : ndarray of bool, shape (N,)
        Filled with the gauges and velocities that stand still.

    Returns
    -------
    bool
        Whether all positions and gauges stand still, and at least one of them stopped abruptly.
    """
    g, (least, times) = gauges.shape[1], limits
    n = (readings.size - g) // 2
    end, all_quiet, at_once = n + g, True, False
    for i in range(readings.size):
        quiet = still[i] >= least
        mean = 0.0
        for k in range(changes.shape[0]):
            mean += changes[k, i]
        mean /= changes.shape[0]
        bound = times * smallest[i]
        last = (at - 1 - still[i]) % changes.shape[0]  # -1 is the last row
        abrupt = quiet and mean > bound and mean > tiny[i]
        if abrupt and still[i] < 2 * least:
            abrupt = max(changes[last, i], changes[last - 1, i]) > bound
        if i < end:
            all_quiet &= quiet
            at_once |= abrupt
        # A joint that a brake has stopped is still at once; its velocity is zero then, and the links swing.
        found[i] = abrupt and i >= n and not (i >= end and readings[i] == 0.0)
        if n <= i < end:
            j = i - n
            found[i] |= gauges[0, j] >= 0.5 * gauges[1, j] and still[i] >= gauges[2, j]
    return end > n and all_quiet and at_once


def all_well(strain, low, high, last, same, seen):
    """Whether all readings are in range and differ from the last ones; if so, `last`, `same` and `seen` are updated.

    Parameters
    ----------
    strain, low, high : ndarray, shape (g,)
        Readings, and the ends of their ranges.
    last : ndarray, shape (g,)
    same : ndarray of int, shape (g,)
        For how many samples each has been the same.
    seen : ndarray, shape (2, g, g)
        Least and largest reading of every gauge since each of them moved.
    """
    for i in range(strain.size):
        if not low[i] < strain[i] < high[i] or strain[i] == last[i]:
            return False
    for i in range(strain.size):
        last[i], same[i] = strain[i], 0
        for j in range(strain.size):
            seen[0, i, j] = seen[1, i, j] = strain[j]
    return True


def restart(value, pairs, rate, windows, w, j):
    """Begin window w of pair j with this sample."""
    windows[START, w, j], windows[FIRST, w, j] = value[pairs[0, j]], rate[j]
    windows[DRIVEN, w, j] = windows[MISSED, w, j] = windows[BETWEEN, w, j] = 0.0
