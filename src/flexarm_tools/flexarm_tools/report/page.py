# SPDX-License-Identifier: Apache-2.0
"""Writes the report's page: sentences and tables from the numbers, figures and animation."""

import json
import math

from jinja2 import Environment

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.loop import metrics

from . import analysis, animation, figures, template
from .run import STATES

#: Largest page: it must fit into a mail [bytes].
MAX_SIZE = 5_000_000
#: Max. number of rows of the table of events.
MAX_EVENTS = 200
#: More runs than this have no colour of their own.
MAX_RUNS = len(figures.COLOURS)
DEGREES = 180.0 / math.pi

TERMS = (
    (
        "Peak and rms tracking error",
        "Distance of the measured joint angle from its reference, from the first motion's start on, over all samples"
        " in which the supervisor was TRACKING, HOLDING or STOPPING (READY in a run without these).",
    ),
    (
        "Residual vibration",
        "Rms distance of the tip from its mean place, as far as the links' bending moves it, over a window after each"
        f" motion that is shown beside the number: from {metrics.SETTLE:g} s after the motion's end, when the joints"
        f" have settled, to {metrics.MAX_REST:g} s after it, or to the end of the rest. A run in which no rest lasts"
        f" {metrics.SETTLE + metrics.MIN_WINDOW:g} s is judged from the motion's end on: the number then contains the"
        f" slow settling. Rests below {metrics.MIN_WINDOW:g} s don't count. All motions together; from the modal"
        " amplitudes in the bag and the arm file's mode shapes.",
    ),
    (
        "Peak deflection",
        "Distance of a link's tip from the straight line along its base, across the link; all samples.",
    ),
    (
        "Samples lost",
        "Numbers missing in the sequence that the source counts. The recorder missed those of which the bag holds the"
        " answering torque: they reached the controller.",
    ),
    (
        "Compute time",
        "As the controller reports it in controller/state: median, 99th percentile and maximum.",
    ),
    (
        "Figures",
        "Long series are drawn as the smallest and the largest value in each of some hundred bins, so that peaks are"
        " kept. Lines are broken where samples are missing.",
    ),
)


def write(runs, opening=""):
    """The page as text.

    Parameters
    ----------
    runs : list of Run
    opening : str
        Sentences before the numbers: what one sees on the page.

    Raises
    ------
    FlexarmError
        For more than `MAX_RUNS` runs, or a page that can't be made small enough.
    """
    if len(runs) > MAX_RUNS:
        problem, limit = "are too many to distinguish on a page", f"at most {MAX_RUNS}"
        raise FlexarmError(problem, field="runs", value=len(runs), limit=limit)
    moves = [analysis.motions(run) for run in runs]
    label = _align(runs, moves)
    numbers = [analysis.summary(run, m) for run, m in zip(runs, moves, strict=True)]
    spectra = [_spectrum(run, m) for run, m in zip(runs, moves, strict=True)]
    film = animation.data(runs)
    for png in (False, True):
        drawn = figures.draw(runs, moves, spectra, label, png)
        page = _page(runs, numbers, spectra, drawn, film, label, opening)
        if len(page.encode()) <= MAX_SIZE:
            return page
    raise FlexarmError(
        "is too large",
        field="page",
        value=len(page.encode()),
        limit=f"at most {MAX_SIZE} bytes",
        hint="give fewer bags at once",
    )


def _align(runs, moves):
    """Put time zero at the first motion if every run has one. Returns the meaning of time zero, in words."""
    if all(moves):
        for run, m in zip(runs, moves, strict=True):
            run.start_at(m[0].start)
        return "from the start of the first motion"
    return "from the first sample"


def _spectrum(run, moves):
    mask = analysis.rest_mask(run, moves)
    found = analysis.spectrum(run, mask) if mask.any() else None
    if found is None:
        mask[:] = True
        found = analysis.spectrum(run, mask)
    return found


def _page(runs, numbers, spectra, drawn, film, label, opening):
    shown = [
        {
            "label": run.label,
            "colour": figures.colour(i),
            "path": str(run.contents.path),
            "description": f"arm {run.arm.name}" if run.arm is not None else "",
        }
        for i, run in enumerate(runs)
    ]
    filmed = [s for s, run in zip(shown, runs, strict=True) if animation.possible(run)]
    if film is not None:
        film |= {
            "colours": [s["colour"] for s in filmed],
            "states": STATES,
            "stateColours": figures.STATE_COLOURS,
        }
    events = _events(runs)
    environment = Environment(autoescape=True, trim_blocks=True)
    several = len(runs) > 1
    return environment.from_string(template.PAGE).render(
        title=f"{len(runs)} runs side by side" if several else f"Report of {runs[0].label}",
        style=template.STYLE,
        script=template.SCRIPT,
        runs=shown,
        opening=opening,
        short=short(runs, numbers),
        notes=[f"{run.label}: {note}" if several else note for run in runs for note in run.notes],
        rows=rows(runs, numbers),
        film=None if film is None else json.dumps(film, allow_nan=False).replace("<", "\\u003c"),
        film_runs=filmed,
        film_caption=_film_caption(film, label),
        figures=drawn,
        frequencies=_frequencies(runs, spectra),
        events=events[:MAX_EVENTS],
        events_left=max(len(events) - MAX_EVENTS, 0),
        time_label=label,
        terms=TERMS,
    )


# Words and tables ------------------------------------------------------------------------------


def digits(value, count=3):
    """A number for reading; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    text = f"{value:#.{count}g}"
    if "e" in text and 1e-3 <= abs(value) < 1e6:
        text = f"{value:.0f}"
    return text.rstrip(".")


def _several(count, noun):
    return f"no {noun}s" if not count else f"one {noun}" if count == 1 else f"{count} {noun}s"


def short(runs, numbers):
    """The summary in sentences: one paragraph for each run, then the differences between them."""
    lines = []
    for run, m in zip(runs, numbers, strict=True):
        parts = [f"{digits(m['duration_s'])} s at {digits(m['rate_hz'], 4)} Hz"]
        parts.append(f"{_several(m['lost'], 'sample')} lost")
        if m["motions"] or run.has("controller/state"):
            parts.append(_several(m["motions"], "motion"))
        text = f"{run.label}: {', '.join(parts)}."
        if m["peak_error_rad"] and None not in m["peak_error_rad"]:
            worst = max(range(len(m["peak_error_rad"])), key=lambda j: m["peak_error_rad"][j])
            error = DEGREES * m["peak_error_rad"][worst]
            text += f" Largest tracking error: {digits(error)}° ({run.joint_names[worst]})."
        if m["residual_m"] is not None:
            text += f" The tip vibrated by {digits(1e3 * m['residual_m'])} mm rms, {_window(m)}."
        text += _torque_words(run, m)
        if m["faults"]:
            count = _several(m["faults"], "fault").capitalize()
            text += f" {count}, the first at {m['first_fault']}."
        elif m["faults"] == 0:
            text += " No faults."
        lines.append(text)
    return lines + _differences(runs, numbers)


def _window(m):
    """Time window in which residual vibration was judged, in words."""
    start, end = m["residual_window_s"]
    return f"{start:.3g} to {end:.3g} s after {'the motion' if m['residual_windows'] == 1 else 'each motion'}"


def _torque_words(run, m):
    peaks = zip(m["peak_torque_Nm"], m["torque_limit_Nm"], strict=True)
    fractions = [
        (peak / limit, j) for j, (peak, limit) in enumerate(peaks) if peak is not None and limit
    ]
    if not fractions:
        return ""
    fraction, j = max(fractions)
    text = f" Torque up to {digits(100.0 * fraction)} % of the limit ({run.joint_names[j]})"
    if m["saturation_share"]:
        text += f"; at the limit in {digits(100.0 * m['saturation_share'])} % of the samples"
    return f"{text}."


def _differences(runs, numbers):
    """How the best run compares with the worst."""
    lines = []
    for name, value, window in (
        ("Residual vibration", lambda m: m["residual_m"], _window),
        ("Peak tracking error", lambda m: _worst(m["peak_error_rad"]), None),
    ):
        known = [(value(m), i) for i, m in enumerate(numbers) if value(m)]
        if len(known) < 2:
            continue
        if window is not None:
            windows = sorted({window(numbers[i]) for _, i in known})
            differ = "over windows that differ (see the table)"
            name += f", {windows[0] if len(windows) == 1 else differ}"
        (low, best), (high, worst) = min(known), max(known)
        if high / low >= 1.05:
            text = (
                f"{runs[best].label} has {digits(high / low)} times less than {runs[worst].label}"
            )
        else:
            text = "the same within 5 % in all runs"
        lines.append(f"{name}: {text}.")
    return lines


def _worst(values):
    return max((v for v in values or () if v is not None), default=None)


def _cell(text, small="", bad=False):
    return {"text": text, "small": small, "bad": bad}


def rows(runs, numbers):
    """Rows of the summary table, a cell for each run."""
    out = []

    def group(name):
        out.append({"group": name})

    def row(name, cell):
        cells = [cell(run, m) for run, m in zip(runs, numbers, strict=True)]
        if any(c["text"] != "–" for c in cells):
            out.append({"name": name, "cells": cells})

    group("Record")
    row("arm", lambda r, m: _cell(m["arm"] or "unknown"))
    row(
        "duration [s]",
        lambda r, m: _cell(digits(m["duration_s"], 4), f"in {_several(m['sessions'], 'session')}"),
    )
    row("rate [Hz]", lambda r, m: _cell(digits(m["rate_hz"], 4)))
    row("samples", lambda r, m: _cell(str(m["samples"]), _repeats(m)))
    row("samples lost", _lost)
    row("samples without a torque", _unanswered)
    row("motions", lambda r, m: _cell(str(m["motions"]) if r.has("controller/state") else "–"))
    row("faults", _faults)
    group("Tracking and vibration")
    for key, name in (
        ("peak_error_rad", "peak tracking error, motion and rest [deg]"),
        ("rms_error_rad", "rms tracking error, motion and rest [deg]"),
    ):
        row(name, lambda r, m, key=key: _per_joint(r, m[key], DEGREES))
    row("residual vibration of the tip, rms [mm]", _residual)
    row("peak deflection of a link's tip [mm]", _deflection)
    group("Torque and time")
    row("peak torque [N m]", _peak_torque)
    row("samples with the torque at a limit [%]", _saturation)
    row("compute time, median / 99 % / maximum [ms]", _compute)
    return [
        r
        for k, r in enumerate(out)
        if "group" not in r or (k + 1 < len(out) and "group" not in out[k + 1])
    ]


def _repeats(m):
    words = []
    if m["repeated"]:
        words.append(f"{m['repeated']} sent again")
    if m["clock_jumps"]:
        words.append(f"{_several(m['clock_jumps'], 'jump')} of the clock")
    return ", ".join(words)


def _lost(run, m):
    if not m["lost"]:
        return _cell("0")
    fraction = f"({digits(100.0 * m['lost'] / (m['lost'] + m['samples']))} %"
    by_recorder = m["lost_by_recorder"]
    missed = f", {by_recorder} missed by the recorder alone" if by_recorder else ""
    return _cell(str(m["lost"]), f"{fraction}{missed})", bad=m["lost"] > by_recorder)


def _unanswered(run, m):
    if m["unanswered"] is None:
        return _cell("–")
    fraction = f"({digits(100.0 * m['unanswered'] / m['samples'])} %)" if m["unanswered"] else ""
    return _cell(str(m["unanswered"]), fraction, bad=m["unanswered"] > 0.01 * m["samples"])


def _faults(run, m):
    if m["faults"] is None:
        return _cell("–")
    return _cell(str(m["faults"]), m["first_fault"] or "", bad=m["faults"] > 0)


def _per_joint(run, values, scale):
    if not values:
        return _cell("–")
    if len(values) == 1:
        return _cell(digits(None if values[0] is None else scale * values[0]))
    texts = [digits(None if v is None else scale * v) for v in values]
    return _cell(", ".join(texts), f"({', '.join(run.joint_names)})")


def _residual(run, m):
    if m["residual_m"] is None:
        return _cell("–")
    motions = f", {m['residual_windows']} motions" if m["residual_windows"] > 1 else ""
    return _cell(digits(1e3 * m["residual_m"]), f"({_window(m)}{motions})")


def _deflection(run, m):
    if not m["peak_deflection_m"]:
        return _cell("–")
    values = m["peak_deflection_m"]
    names = f"({', '.join(values)})" if len(values) > 1 else ""
    return _cell(", ".join(digits(1e3 * v) for v in values.values()), names)


def _peak_torque(run, m):
    cell = _per_joint(run, m["peak_torque_Nm"], 1.0)
    if any(m["torque_limit_Nm"]):
        limits = ", ".join(digits(v) for v in m["torque_limit_Nm"])
        cell["small"] = f"of {limits}"
    return cell


def _saturation(run, m):
    fraction = m["saturation_share"]
    return _cell("–" if fraction is None else digits(100.0 * fraction), bad=bool(fraction))


def _compute(run, m):
    if m["compute_time_s"] is None:
        return _cell("–")
    period = "" if m["rate_hz"] is None else f"period {digits(1e3 / m['rate_hz'])}"
    return _cell(" / ".join(digits(1e3 * v) for v in m["compute_time_s"]), period)


def _frequencies(runs, spectra):
    out = []
    for run, s in zip(runs, spectra, strict=True):
        if s is None:
            continue
        known = analysis.predicted(run, s.configuration)
        top = analysis.highest(run, known)
        cells = [_hertz(analysis.peaks(s, top)) or "none stands out"]
        for case in ("joints locked", "joints free"):
            shown = [f for f in known.get(case, ()) if f < top][: analysis.MAX_FREQUENCIES]
            cells.append(_hertz(shown) or "–")
        out.append([run.label, *cells])
    return out


def _hertz(frequencies):
    return ", ".join(digits(f, 4) for f in frequencies)


def _events(runs):
    found = []
    for run in runs:
        seen = [(a, state, why) for a, _, state, why in analysis.episodes(run) if state >= 0]
        seen += [(t, STATES.index(s), why) for t, s, why in analysis.refusals(run) if s in STATES]
        for t, state, why in dict.fromkeys(seen):
            found.append((run.label, t, STATES[state], why))
    found.sort(key=lambda e: (e[1], e[0]))
    return [(label, f"{t:.3f}", state, why) for label, t, state, why in found]


def _film_caption(film, label):
    if film is None:
        return ""
    return (
        f"From {film['start']:.2f} s to {film['end']:.2f} s {label}. Coloured: the arm, its deflection exaggerated by"
        " the factor shown; grey: the same joint angles without bending; dashed: the reference. Drag to turn, double"
        " click to turn back, space to play, click into a figure to go to that time."
    )
