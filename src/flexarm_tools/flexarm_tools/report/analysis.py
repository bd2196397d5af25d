# SPDX-License-Identifier: Apache-2.0
"""Computes the numbers of a recorded run: tracking, vibration after motions, torque, losses, spectra. No drawing.

Peak error and residual vibration are defined in `flexarm_studies.loop.metrics`.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.linear import jacobian
from flexarm_studies.loop.metrics import (
    MAX_REST,
    MIN_WINDOW,
    joint_error,
    residual_vibration,
    residual_window,
)

from .run import ENABLED, FAULT, HOLDING, READY, STATES, STOPPING, TRACKING
from .timeline import stretches

#: Length of the pieces that a spectrum averages over, and of the shortest piece that is used [s].
SEGMENT, MIN_SEGMENT = 8.0, 1.0
#: Spectra are padded to this multiple of their length, to interpolate between the frequencies they resolve.
PADDED = 4
#: Number of natural frequencies that are shown, from the lowest on.
MAX_FREQUENCIES = 6
#: A measured frequency is reported if its power exceeds that of its neighbourhood by this factor.
OUTSTANDING = 10.0


@dataclass(frozen=True)
class Motion:
    """Samples in which the reference moved, and the rest that followed.

    Attributes
    ----------
    start, end : int
        First sample of the motion, and first one after it.
    rest : int
        First sample after the rest; `end` where there was none.
    """

    start: int
    end: int
    rest: int


def motions(run):
    """The motions of a run: supervisor TRACKING or STOPPING; each rest: HOLDING or READY, for `MAX_REST` at most."""
    moving = (run.state == TRACKING) | (run.state == STOPPING)
    resting = (run.state == HOLDING) | (run.state == READY)
    resting[1:] &= run.timeline.epoch[1:] == run.timeline.epoch[:-1]
    found = []
    for start, end in zip(*stretches(moving), strict=True):
        last = end + int(np.searchsorted(run.time[end:], run.time[end - 1] + MAX_REST, "right"))
        stops = np.flatnonzero(~resting[end:last])
        rest = end + int(stops[0]) if stops.size else int(last)
        if rest > end and run.time[rest - 1] - run.time[end] < MIN_WINDOW:
            rest = end
        found.append(Motion(int(start), int(end), rest))
    return found


def summary(run, moves=None):
    """All numbers of the summary table of a `run`; `moves` are its motions, if they are known.

    Returns
    -------
    dict
        Numbers in SI, lists with one number per joint or link; None for what the bag does not contain.
    """
    moves = motions(run) if moves is None else moves
    found = {
        "arm": run.arm.name if run.arm is not None else None,
        "sessions": run.sessions,
        "samples": int(run.time.size),
        "duration_s": float(run.time[-1] - run.time[0]),
        "rate_hz": 1.0 / run.period if run.period > 0.0 else None,
        "lost": run.timeline.lost,
        "lost_by_recorder": _lost_by_recorder(run),
        "unanswered": run.unanswered,
        "repeated": run.timeline.repeated,
        "clock_jumps": len(run.timeline.jumps),
        "motions": len(moves),
    }
    return found | _supervision(run) | _tracking(run) | _vibration(run, moves) | _torque(run)


def _lost_by_recorder(run):
    """Samples of which the bag contains only the answering torque: the recorder missed them, the controller did not."""
    table, base = run.contents.tables.get("joint_torque"), run.contents.tables[run.base]
    if table is None or not run.timeline.lost:
        return 0
    pair = lambda t: np.asarray(t.session) * 2**32 + np.asarray(t.sequence)  # noqa: E731
    return int(np.setdiff1d(pair(table), pair(base)).size)


def _supervision(run):
    if not run.has("controller/state"):
        return {"faults": None, "first_fault": None, "compute_time_s": None}
    entered = _entered(run, FAULT)
    reasons = run.contents.reasons
    first = None
    if entered.size:
        reason = reasons[run.reason[entered[0]]] or "no reason given"
        first = f"{run.time[entered[0]]:.3f} s: {reason}"
    took = run.column("controller/state", "compute_time")
    took = None if took is None else took[took > 0.0]  # 0: an answer repeated without a new sample
    times = None
    if took is not None and took.size:
        times = np.percentile(took, [50.0, 99.0, 100.0]).tolist()
    return {"faults": int(entered.size), "first_fault": first, "compute_time_s": times}


def _entered(run, state):
    """Samples at which the supervisor entered a state."""
    return stretches(run.state == state)[0]


def followed(run):
    """Samples over which tracking is judged, shape (k,) bool.

    From the first motion's start on, while the supervisor is TRACKING, HOLDING or STOPPING; READY in a run that has
    none of these.
    """
    judged = (run.state >= TRACKING) & (run.state <= STOPPING)
    return judged if judged.any() else run.state == READY


def _tracking(run):
    judged = followed(run)
    if not run.has("controller/state", "reference_position") or not judged.any():
        return {"peak_error_rad": None, "rms_error_rad": None}
    peak, rms = [], []
    for j in range(len(run.joint_names)):
        error = joint_error(run.reference(j), run.position(j))[judged]
        error = error[np.isfinite(error)]
        peak.append(float(error.max()) if error.size else None)
        rms.append(float(np.sqrt(np.mean(error**2))) if error.size else None)
    return {"peak_error_rad": peak, "rms_error_rad": rms}


def _vibration(run, moves):
    found = {"residual_m": None, "residual_windows": 0, "residual_window_s": None}
    found["peak_deflection_m"] = None
    if not run.amplitude_source or run.model is None:
        return found
    rows, names = tip_rows(run.model)
    if len(names):
        peaks = np.zeros(len(names))
        for part in _parts(run):
            bent = run.deflections(part) @ rows.T
            peaks = np.fmax(peaks, np.fmax.reduce(np.abs(bent), axis=0))
        found["peak_deflection_m"] = dict(zip(names, peaks.tolist(), strict=True))
    span, windows = residual_windows(run, moves)
    known = [bending for bending in (tip_bending(run, w) for w in windows) if len(bending)]
    if known:
        squares = sum(len(bending) * residual_vibration(bending) ** 2 for bending in known)
        found["residual_m"] = float(np.sqrt(squares / sum(map(len, known))))
        found["residual_windows"] = len(known)
        found["residual_window_s"] = [round(s, 6) for s in span]
    return found


def residual_windows(run, moves):
    """Where residual vibration is judged after `moves`: see `flexarm_studies.loop.metrics.residual_window`.

    Rests too short to leave out the slow settling count only if none of the motions `moves` has a longer one.

    Returns
    -------
    span : tuple of float
        Start, and end of the longest window, after the motion's end [s].
    windows : list of slice
        Of the samples.
    """
    rests = [
        (move, residual_window(float(run.time[move.rest - 1] - run.time[move.end])))
        for move in moves
        if move.rest > move.end
    ]
    start = max((span[0] for _, span in rests), default=0.0)
    windows, longest = [], start
    for move, (begin, end) in rests:
        if begin == start:
            first = np.searchsorted(run.time, run.time[move.end] + begin - 1e-9)
            windows.append(slice(int(first), move.rest))
            longest = max(longest, end)
    return (start, longest), windows


def tip_bending(run, window):
    """Displacement of the tip by bending over `window`, a rest, shape (known samples, 3) [m].

    By the tip's Jacobian with respect to the amplitudes, at the mean joint angles over the `window`.
    """
    bent = run.deflections(window)
    bent = bent[np.isfinite(bent).all(axis=1)]
    return bent @ tip_jacobian(run.model, np.nanmean(run.positions(window), axis=0)).T


def tip_jacobian(model, q):
    """Derivative of the tip's position with respect to the modal amplitudes, for the straight arm, shape (3, m)."""
    return jacobian(lambda delta: model.tip_position(q, delta), np.zeros(model.n_modes))


def tip_rows(model):
    """Rows (r, m) that map the amplitudes to the deflection of each link's tip across the link, and their names."""
    rows, names, modes = [], [], model.arm.modes
    for link in model.arm.links:
        for direction in sorted(set(link.flexible) - {"twist"}):
            shapes = np.atleast_1d(model.mode_shapes(link.name, direction)(1.0))
            row = np.zeros(model.n_modes)
            for j, mode in enumerate(modes):
                if (mode.link, mode.direction) == (link.name, direction):
                    row[j] = shapes[mode.number - 1]
            rows.append(row)
            names.append(f"{link.name} {direction}")
    return np.array(rows).reshape(len(rows), model.n_modes), names


def _parts(run):
    """Slices that cover all samples, so a table of all samples need not be in memory."""
    size = 200_000
    return [slice(a, a + size) for a in range(0, run.time.size, size)]


def torque_column(run, j):
    """A joint's sent torque, or the applied one if the bag lacks that [N m]; NaN while torque was not enabled."""
    mode = run.column("joint_torque", "mode")
    sent = run.column("joint_torque", "torque", j)
    if sent is not None and mode is not None:
        return np.where(mode == ENABLED, sent, np.nan)
    sent = run.column("controller/state", "torque", j)
    return sent if sent is not None else run.column(run.base, "joint_torque", j)


def _torque(run):
    limits = [None] * len(run.joint_names)
    if run.arm is not None:
        limits = [j.limits.torque if np.isfinite(j.limits.torque) else None for j in run.arm.joints]
    peaks = []
    for j in range(len(run.joint_names)):
        torque = torque_column(run, j)
        known = torque is not None and np.isfinite(torque).any()
        peaks.append(float(np.nanmax(np.abs(torque))) if known else None)
    saturated, fraction = run.column("controller/state", "saturated"), None
    if saturated is not None:
        active = (run.state >= READY) & (run.state <= STOPPING)
        fraction = float(np.mean(saturated[active] > 0.0)) if active.any() else None
    return {"peak_torque_Nm": peaks, "torque_limit_Nm": limits, "saturation_share": fraction}


# Spectra ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Spectrum:
    """How strongly the links' tips vibrate at each frequency; without a model, the modes.

    Attributes
    ----------
    frequency : ndarray, shape (f,)
        [Hz]
    density : ndarray, shape (f, signals)
        Amplitude spectral density [m / sqrt(Hz)], or [m, rad / sqrt(Hz)] of modes.
    names : list of str
    configuration : ndarray, shape (n,)
        Mean joint angles over the samples used [rad].
    seconds : float
        Duration of these samples.
    """

    frequency: np.ndarray
    density: np.ndarray
    names: list
    configuration: np.ndarray
    seconds: float


def spectrum(run, mask):
    """Welch's estimate over the stretches without gaps in the samples of `mask` (k,); None if none is long enough."""
    from scipy.signal import welch

    if not run.amplitude_source or not run.period > 0.0:
        return None
    rate = 1.0 / run.period
    mask = mask & run.bent_known
    pieces = [(a, b) for a, b in _gapless(run, mask) if (b - a) * run.period >= MIN_SEGMENT]
    if not pieces:
        return None
    if run.model is not None:
        rows, names = tip_rows(run.model)
    else:
        rows, names = np.eye(len(run.mode_names)), list(run.mode_names)
    if not names:
        return None
    length = int(min(max(b - a for a, b in pieces), round(SEGMENT * rate)))
    power, weight, q = 0.0, 0, 0.0
    for a, b in pieces:
        if b - a < length / 2 or b - a < 8:
            continue
        signal = run.deflections(slice(a, b)) @ rows.T
        # A shorter piece is padded to the same frequencies; the average is over its own length.
        f, p = welch(
            signal, rate, nperseg=min(length, b - a), nfft=PADDED * length, detrend="linear", axis=0
        )
        power, weight = power + p * (b - a), weight + b - a
        q = q + np.nanmean(run.positions(slice(a, b)), axis=0) * (b - a)
    if not weight:
        return None
    return Spectrum(f[1:], np.sqrt(power[1:] / weight), names, q / weight, weight * run.period)


def _gapless(run, mask):
    """Stretches of samples in `mask` of which none is missing."""
    starts, ends = stretches(mask)
    cuts = np.flatnonzero(~run.timeline.joined) + 1
    for a, b in zip(starts, ends, strict=True):
        edges = [a, *cuts[(cuts > a) & (cuts < b)], b]
        yield from ((int(x), int(y)) for x, y in itertools.pairwise(edges))


def rest_mask(run, moves):
    """The samples of all rests after motions, shape (k,) bool."""
    mask = np.zeros(run.time.size, bool)
    for move in moves:
        mask[move.end : move.rest] = True
    return mask


def predicted(run, q):
    """Natural frequencies by the model at joint angles q: joints locked, and joints free, each ascending [Hz]."""
    if run.model is None or not run.model.n_modes:
        return {}
    both = {"joints locked": True, "joints free": False}
    return {name: run.model.frequencies(q, locked) / (2.0 * np.pi) for name, locked in both.items()}


def highest(run, cases):
    """Highest frequency to show: well above the lowest ones of `predicted` [Hz]."""
    nyquist = 0.5 / run.period
    known = [f for values in cases.values() for f in values[:MAX_FREQUENCIES]]
    return float(min(nyquist, 2.0 * max(known)) if known else min(nyquist, 100.0))


def peaks(spectrum_, top=np.inf):
    """Up to four frequencies below `top` that stand out in the sum of all signals, the strongest first [Hz]."""
    from scipy.signal import find_peaks

    power = (spectrum_.density[spectrum_.frequency <= top] ** 2).sum(axis=1)
    if power.size < 3 or not power.max() > 0.0:
        return []
    at = find_peaks(
        np.log10(power + 1e-300), prominence=np.log10(OUTSTANDING), distance=4 * PADDED
    )[0]
    order = np.argsort(power[at])[::-1][:4]
    return [float(spectrum_.frequency[i]) for i in at[order]]


# The supervisor --------------------------------------------------------------------------------


def episodes(run):
    """Stretches in one state of the supervisor: (start [s], end [s], state, reason); state -1 where unknown."""
    if not run.has("controller/state"):
        return []
    change = np.flatnonzero(np.diff(run.state) != 0) + 1
    starts = np.concatenate([[0], change])
    ends = np.concatenate([change, [run.time.size - 1]])
    reasons = run.contents.reasons
    out = []
    for a, b in zip(starts, ends, strict=True):
        why = reasons[run.reason[a]] if run.reason[a] >= 0 else ""
        out.append((float(run.time[a]), float(run.time[b]), int(run.state[a]), why))
    return out


def refusals(run):
    """Times at which a reason for a refusal was given: (time [s], state, reason)."""
    if not run.has("controller/state"):
        return []
    reasons = run.contents.reasons
    change = np.flatnonzero(np.diff(run.reason) != 0) + 1
    rows = [int(i) for i in np.concatenate([[0], change]) if run.reason[i] >= 0]
    names = (*STATES, "?")  # -1: unknown
    return [
        (float(run.time[i]), names[run.state[i]], reasons[run.reason[i]])
        for i in rows
        if reasons[run.reason[i]]
    ]
