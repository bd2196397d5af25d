# SPDX-License-Identifier: Apache-2.0
"""Summarises a recording as plain data: times, channels, rests, noise, drift, delays, ring-downs, spectra."""

import numpy as np

from ..identification.recording import JITTER, SIGNALS, kind_of
from . import rest, ring_down, trends

#: SI units of the signals, as they are printed.
UNITS = {
    "position": "rad",
    "velocity": "rad/s",
    "acceleration": "rad/s^2",
    "torque": "N m",
    "current": "A",
    "strain": "-",
    "amplitude": "m, rad",
    "linear_acceleration": "m/s^2",
    "angular_velocity": "rad/s",
}
#: Length of the pieces of a spectrum [s]; max. number of reported peaks, and min. factor above their surroundings [-].
SEGMENT, MAX_PEAKS, OUTSTANDING = 8.0, 4, 4.0
#: A line of the spectrum is compared with the median over this many around it.
AROUND = 41
#: A delay between two channels is given only if their correlation is at least this [-].
ALIKE = 0.5


def summary(recording):
    """All that is found in a `recording`, ready for JSON: numbers in SI, None for unknown values."""
    parts = rest.stretches(recording)
    quiet, rings = quiet_and_rings(recording, parts)
    slowest = min((r.frequency for r in rings), default=None)
    return {
        **_times(recording),
        "channels": [_channel(*channel) for channel in channels(recording)],
        "rest": [_span(recording, part) for part in parts],
        "noise": _noise(recording, quiet),
        "drift": _drift(recording, slowest),
        "delays": _delays(recording),
        "ring_downs": [_ring(recording, ring) for ring in rings],
        "peaks_hz": peaks(recording),
        "notes": list(recording.notes),
    }


def channels(recording):
    """Yield the quantity, the name, and the values (s,) of each channel that was measured."""
    for quantity in SIGNALS:
        values = getattr(recording, quantity)
        kind = kind_of(quantity)
        names = getattr(recording, f"{kind}_names")
        if values is None or not names:
            continue
        for name, column in zip(names, values.T, strict=True):
            if name not in recording.held and np.isfinite(column).any():
                yield quantity, name, column


def quiet_and_rings(recording, parts):
    """The longest rest of a `recording` in which nothing rings (None: there is none), and the ring-downs in the others.

    Parameters
    ----------
    recording : Recording
    parts : list of slice
        Of `rest.stretches`.

    Returns
    -------
    quiet : Noise or None
    rings : list of RingDown
    """
    rings = []
    for part in sorted(parts, key=lambda p: p.stop - p.start, reverse=True):
        found = rest.noise(recording, part)
        # A gauge that rings does not show noise: what all gauges have in common then is the vibration.
        ringing = ring_down.find(recording, [part], np.full(found.rms.size, 1e-15))
        if not ringing:
            rings = ring_down.find(recording, parts, found.rms)
            return found, rings
        rings += ringing
    return None, sorted(rings, key=lambda r: r.part.start)


def _seconds(recording, row):
    return recording.start + recording.period * row


def _span(recording, part):
    return {
        "from_s": _seconds(recording, part.start),
        "to_s": _seconds(recording, part.stop - 1),
    }


def _times(recording):
    stamps = recording.stamps
    stamps = recording.start + recording.time if stamps is None else stamps
    steps = np.diff(stamps)
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > (1.0 + JITTER) * usual)
    return {
        "samples": len(recording.position),
        "period_s": recording.period,
        "rate_hz": 1.0 / recording.period,
        "start_s": recording.start,
        "end_s": _seconds(recording, len(recording.position) - 1),
        "jitter_s": float(np.percentile(np.abs(steps - usual), 99.0)),
        "gaps": [{"at_s": float(stamps[k]), "length_s": float(steps[k])} for k in gaps[:100]],
    }


def _channel(quantity, name, values):
    known = values[np.isfinite(values)]
    return {
        "quantity": quantity,
        "of": name,
        "unit": UNITS[quantity],
        "low": float(known.min()),
        "high": float(known.max()),
        "step": rest.step_of(known),
        "missing": int(values.size - known.size),
    }


def _known(values):
    """Numbers for JSON: None where there is none."""
    return [float(v) if np.isfinite(v) else None for v in values]


def _noise(recording, found):
    if found is None:
        return None
    return {
        **_span(recording, found.part),
        "gauges": list(recording.gauge_names),
        "rms": _known(found.rms),
        "correlation": [_known(row) for row in found.correlation],
        "rms_corrected": _known(found.corrected),
        "shared_rms": _known(found.shared),
        "own_rms": _known(found.own),
        "shared_memory": _known(found.memory),
    }


def _drift(recording, slowest):
    """Drift and delay of each gauge."""
    keys = ("drift", "drift_half_width", "delay_s", "delay_half_width_s")
    rows = trends.drift_and_delay(recording, slowest).T
    named = zip(recording.gauge_names, rows, strict=True)
    return [{"gauge": name} | dict(zip(keys, _known(row), strict=True)) for name, row in named]


def _delays(recording):
    """Delays: speeds after the angles' rates, accelerations after the speeds' rates, gauges after the first gauge."""
    found, period = [], recording.period
    pairs = (("velocity", "position"), ("acceleration", "velocity"))
    for later, earlier in pairs:
        a, b = getattr(recording, later), getattr(recording, earlier)
        for j, name in enumerate(recording.joint_names):
            if a is not None and b is not None:
                rate = rest.derivative(b[:, j], period)
                _late(found, f"{later} of {name}", f"rate of its {earlier}", a[:, j], rate, period)
    strain = [(n, v) for q, n, v in channels(recording) if q == "strain"]
    for name, values in strain[1:]:
        first, reference = strain[0]
        # Slow signals correlate at any small delay.
        fast = [v - rest.low_passed(v[:, None], period, 1.0)[:, 0] for v in (values, reference)]
        _late(found, name, first, *fast, period)
    return found


def _late(found, what, against, a, b, period):
    if not (np.isfinite(a).all() and np.isfinite(b).all() and a.std() > 0.0 and b.std() > 0.0):
        return
    if period * len(a) <= 2 * trends.LONGEST:
        return
    delay, alike = trends.lag(a, b, period)
    if abs(alike) > ALIKE:
        found.append({"of": what, "after": against, "delay_s": delay, "correlation": alike})


def _ring(recording, ring):
    return _span(recording, ring.part) | {
        "gauge": recording.gauge_names[ring.gauge],
        "frequency_hz": ring.frequency,
        "frequency_half_width_hz": ring.frequency_width,
        "damping": ring.damping,
        "damping_half_width": ring.damping_width,
        "amplitude": ring.amplitude,
        "explained": ring.explained,
    }


def spectrum(values, period):
    """Frequencies [Hz] and power density of a series (s,), one value per `period` [s] (Welch)."""
    from scipy.signal import welch

    length = min(len(values), int(SEGMENT / period))
    return welch(values, 1.0 / period, nperseg=length, detrend="linear")


def peaks(recording):
    """Frequencies at which each gauge has a peak of its spectrum, the strongest first [Hz]: name to list."""
    from scipy.ndimage import median_filter
    from scipy.signal import find_peaks

    found = {}
    for quantity, name, values in channels(recording):
        if quantity != "strain" or not np.isfinite(values).all():
            continue
        frequency, power = spectrum(values, recording.period)
        level = np.log(np.maximum(power, 1e-300))
        above = level - median_filter(level, AROUND, mode="nearest")
        at, _ = find_peaks(level)
        at = at[(above[at] > np.log(OUTSTANDING)) & (frequency[at] > 0.5)]
        at = at[np.argsort(above[at])[::-1]][:MAX_PEAKS]
        found[name] = [float(f) for f in frequency[at]]
    return found
