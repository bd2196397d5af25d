# SPDX-License-Identifier: Apache-2.0
"""``flexarm identify`` for recordings without torque: options, text and plain data of a fit to the strains alone."""

import functools
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies import workers
from flexarm_studies.commands.options import span
from flexarm_studies.identification.fit_state import FitState, key_of
from flexarm_studies.identification.strain_fit import STARTS, Options
from flexarm_studies.identification.strain_study import Study, study
from flexarm_studies.recordings import mapping as mappings
from flexarm_studies.recordings.motion import CORNER

from . import recording as recordings

#: A variance accounted for below this is not written out [%]: the regression has diverged.
LEAST = -99.0
#: Microstrain per unit of strain.
MICRO = 1e6


def add_arguments(parser):
    """Options of fits to strains alone."""
    add = parser.add_argument_group(
        "without torque: the joints move as recorded, the strains are fitted"
    ).add_argument
    add(
        "--strains",
        action="store_true",
        help="fit the strains alone, also of a recording with torque",
    )
    add(
        "--fit",
        metavar="FROM:TO",
        help="the part that is fitted, as the recording counts the time [s]: 14:60",
    )
    add("--score", metavar="FROM:TO", help="a part that is only predicted, and scored [s]: 60:80")
    add(
        "--score-file",
        metavar="FILE",
        help="another recording of the arm to score, read by the same mapping",
    )
    add(
        "--above",
        type=float,
        default=1.0,
        metavar="HZ",
        help="scores also above this frequency (1)",
    )
    add(
        "--smooth",
        type=float,
        default=CORNER,
        metavar="HZ",
        help=f"corner of the low pass of the joint angles ({CORNER:g})",
    )
    add(
        "--ring-downs",
        action="store_true",
        help="in the end, fit the damping to the decay of ring-downs: strains alone overestimate it",
    )
    add(
        "--pickup",
        type=float,
        metavar="HZ",
        help="score also with what all gauges pick up from the motor currents above this frequency",
    )
    add("--free", nargs="+", action="extend", default=[], metavar="NAME",
        help="find these, too, which are held by default: 'gauges[*].position'")  # fmt: skip
    add(
        "--starts",
        type=int,
        default=STARTS,
        metavar="N",
        help=f"points from which the fit begins ({STARTS})",
    )
    add(
        "--state",
        metavar="FILE",
        help="keep what is found so far; the same command goes on from there",
    )
    workers.add_arguments(parser.add_argument, " for the starts")


def asked(options):
    """Whether an option of fits to strains alone was given."""
    return any(
        (
            options.strains,
            options.fit,
            options.score,
            options.score_file,
            options.free,
            options.state,
            options.ring_downs,
            options.pickup,
        )
    )


def identify(options, arm, measured, progress):
    """Fit and score; return the `StrainFit`, plain data, and the run with its prediction.

    Parameters
    ----------
    options : argparse.Namespace
    arm : Arm
    measured : Recording
    progress : Progress

    Raises
    ------
    FlexarmError
        For options out of range, and as `strain_study.study`.
    """
    wanted = Study(
        span(options.fit, "--fit"), span(options.score, "--score"), options.above, options.pickup
    )
    if options.starts < 1:
        raise FlexarmError(
            "is too small", field="--starts", value=options.starts, limit="1 or more"
        )
    if not 0.0 < options.above < 0.5 / measured.period:
        limit = f"above 0, below {0.5 / measured.period:g} Hz, half of the rate"
        raise FlexarmError("is out of range", field="--above", value=options.above, limit=limit)
    other = None
    if options.score_file:
        other = recordings.read(
            options.score_file, arm, mappings.of_options(options), options.namespace
        )
    fitting = Options(
        tuple(options.hold),
        tuple(options.free),
        options.undetermined,
        options.starts,
        options.smooth,
        ring_downs=options.ring_downs,
    )
    state = None
    if options.state:
        part = measured if wanted.fit is None else measured.between(*wanted.fit)
        state = FitState(options.state, key_of(arm, part, fitting))
    run = functools.partial(workers.results, workers=options.workers, scheduler=options.scheduler)
    found, result, more = study(
        arm, measured, wanted, fitting, other, run=run, state=state, report=progress.step,
        threads=max(options.workers or os.cpu_count() or 1, 1),
    )  # fmt: skip
    result |= {"score_file": options.score_file}
    return found, result | summary(found, measured, options.recording), more


def summary(found, measured, source):
    """Plain data of a fit: parameters with origin and interval, and what strains do not determine."""
    rows = []
    for q, value, width in zip(found.quantities, found.values, found.half_widths, strict=True):
        kept = bool(np.isnan(width))
        rows.append(
            {
                "name": q.name,
                "unit": q.unit,
                "value": float(value),
                "half_width": None if kept else float(width),
                "kept": ("held" if q.name in found.held else "not determined") if kept else None,
                "determined": q.name not in found.undetermined and not kept,
                "of": "recording" if q.kind in ("delay", "drift") else "arm",
            }
        )
    names = found.arm.gauge_names
    return {
        "arm": found.arm.name,
        "source": str(source),
        "samples": len(found.measured),
        "period_s": measured.period,
        "parameters": rows,
        "alike": [list(group) for group in found.alike],
        "noise": {
            name: {"new": float(s), "memory": float(m)}
            for name, s, m in zip(names, found.noise, found.memory, strict=True)
        },
        "noise_correlation": found.correlation.tolist(),
        "starts": [float(s) for s in found.starts],
        "warnings": list(found.warnings),
    }


def text_of(result, line):
    """Lines for people; ``line(row)`` is of a parameter."""
    yield f"{result['arm']}, strains of a prescribed motion, {result['samples']} samples; 95 % intervals"
    yield ""
    yield from (line(row) for row in result["parameters"])
    for group in result["alike"]:
        yield f"the strains do not tell apart: {', '.join(group)}"
    for part, gauges in result["parts"].items():
        start, end = result[f"{part}_s"]
        yield ""
        yield f"{part} {start:g} to {end:g} s: variance accounted for [%], above the frequency [%], rms [microstrain]"
        what = [key for key in next(iter(gauges.values())) if key != "residual_correlation"]
        yield f"{'':14}" + "".join(f"{name:>22}" for name in gauges)
        for key in what:
            cells = []
            for row in gauges.values():
                score = row[key]
                cells.append(f"{'-':>22}" if score is None else _cell(score))
            yield f"{key:14}" + "".join(cells)
        white = ", ".join(
            f"{name} {row['residual_correlation']['value']:.2f}" for name, row in gauges.items()
        )
        yield f"correlation of the residuals from one sample to the next (0: white): {white}"
    for motor in result["currents"]:
        if not motor["explained"]:
            yield f"current of {motor['joint']}: the model's torque and friction don't explain it"
            continue
        constant, viscous, coulomb = (motor[k] for k in ("torque_constant", "viscous", "coulomb"))
        yield (
            f"current of {motor['joint']}: {_pair(constant)} N m/A, friction {_pair(viscous)} N m s/rad and"
            f" {_pair(coulomb)} N m; {motor['left_of_fitted']:.3f} of it is left where fitted,"
            f" {motor['left_of_scored']:.3f} where scored"
        )
    if (picked := result["pickup"]) is not None:
        use = "" if picked["useful"] else ": no use, so not counted"
        yield (
            f"common to all gauges, from the motor currents above {picked['above_hz']:g} Hz: leaves"
            f" {picked['left']:.3f} of what the model leaves there, in blocks it was not fitted to{use}"
        )
    if result["ring_downs"]:
        yield ""
        yield f"{'ring-down [s]':18}{'gauge':10}{'measured [Hz], damping':>38}{'modelled':>20}"
    for ring in result["ring_downs"]:
        yield (
            f"{ring['from_s']:6.2f} to {ring['to_s']:6.2f}  {ring['gauge']:10}"
            f"{ring['measured_frequency']:8.3f} +- {ring['frequency_width'] or np.nan:.3f}"
            f" {ring['measured_damping']:10.4f}"
            f" +- {ring['damping_width'] or np.nan:.4f}"
            f"{ring['modelled_frequency'] or np.nan:12.3f} {ring['modelled_damping'] or np.nan:7.4f}"
        )


def _pair(row):
    return f"{row['value']:.4g} +- {row['half_width']:.2g}"


def _cell(score):
    values = [np.nan if score[k] is None else score[k] for k in ("vaf", "vaf_above", "rms")]
    percent = [
        f"{v:.{d}f}" if not v < LEAST else f"< {LEAST:g}"
        for v, d in zip(values, (2, 1), strict=False)
    ]
    return f"{percent[0]:>8}{percent[1]:>7}{MICRO * values[2]:7.2f}"


def heading(result):
    """Lines of the comment at the head of the written arm file."""
    start, end = result["fit_s"]
    source = Path(result["source"]).name
    yield f"Identified from the strains of {source}, {start:g} to {end:g} s, the joints moved as measured."
    for name, row in (result["parts"].get("score") or result["parts"]["fit"]).items():
        score = row["model"]
        yield (
            f"  {name}: {score['vaf']:.2f} % of the variance explained"
            f"{'' if 'score' not in result['parts'] else ' of a part that was not fitted'},"
            f" {score['vaf_above']:.1f} % above the frequency"
        )
    yield "What belongs to the recording:"
    for row in result["parameters"]:
        if row["of"] == "recording" and row["half_width"] is not None:
            yield f"  {row['name']} {row['value']:.4g} +- {row['half_width']:.2g} {row['unit']}"
    for group in result["alike"]:
        yield f"Strains do not tell apart: {', '.join(group)}"
    yield "Every number has its origin beside it: identified, with its 95 % interval, or as given."
    yield ""


def origins(result):
    """Name of a quantity to the text beside its number."""
    notes = {}
    for row in result["parameters"]:
        if row["half_width"] is not None:
            sure = row["determined"] and row["half_width"] <= abs(row["value"])
            weak = "" if sure else ", weakly"
            notes[row["name"]] = f"identified{weak}: +- {row['half_width']:.2g}"
    return notes


def for_file(found):
    """A fit as `rewritten` takes it, without what belongs to the recording alone."""
    keep = [j for j, q in enumerate(found.quantities) if q.kind not in ("delay", "drift")]
    return replace(
        found,
        quantities=[found.quantities[j] for j in keep],
        values=found.values[keep],
        half_widths=found.half_widths[keep],
    )


def draw(found, run, predicted, result, path):
    """Draw measured, predicted and residual strains of the part that was not fitted, or of all; return the path.

    `run` is the recording of the prediction; `found`, `predicted` (s, g) and `result` are those of `identify`.
    """
    from flexarm_studies.commands.options import check_file
    from flexarm_studies.plotting import plt, save

    path, names = check_file(path), found.arm.gauge_names
    figure, axes = plt.subplots(
        len(names), 2, figsize=(12.0, 2.0 * len(names) + 0.8), squeeze=False, sharex=True, layout="constrained"
    )  # fmt: skip
    shown = "score" if result["score_s"] and other_part(result) else "fit"
    time, (start, end) = run.start + run.time, result[f"{shown}_s"]
    shows = (time >= start) & (time <= end)
    for c, (name, (left, right)) in enumerate(zip(names, axes, strict=True)):
        left.plot(time[shows], MICRO * run.strain[shows, c], lw=1.4, color="0.6", label="measured")
        left.plot(time[shows], MICRO * predicted[shows, c], lw=0.7, label="predicted")
        right.plot(time[shows], MICRO * (run.strain - predicted)[shows, c], lw=0.5, color="tab:red")
        left.set_ylabel(f"{name} [microstrain]")
        right.set_ylabel("residual [microstrain]")
    axes[0, 0].legend(fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]" + ("" if shown == "fit" else ", not fitted"))
    figure.suptitle(
        f"{found.arm.name}: strains measured and predicted from the motion of the joints"
    )
    return str(save(figure, path, dpi=120))


def other_part(result):
    """Whether a part of the same recording was scored; there is a prediction to draw for it."""
    return "score" in result["parts"] and not result.get("score_file")


def arm_text(path):
    """Text of an arm file by its name or path."""
    return arm_file.find(path).read_text(encoding="utf-8")
