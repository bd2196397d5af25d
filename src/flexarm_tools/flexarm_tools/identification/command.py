# SPDX-License-Identifier: Apache-2.0
"""``flexarm identify``: recorded motion and arm file in; parameters with intervals, an arm file and a plot out."""

import json
import sys
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification.arm_text import rewritten
from flexarm_studies.identification.derived import derived
from flexarm_studies.identification.fit import identify as fit
from flexarm_studies.progress import Progress
from flexarm_studies.recordings import mapping as mappings

from . import page, strains
from . import recording as recordings

UNDETERMINED = 0.5
#: What the command writes.
FILES = ("out", "plot", "report")


def add_arguments(parser):
    """Arguments of ``identify``."""
    parser.description = (
        "Fits the arm file's model to a bag or CSV file: stiffness, damping, inertias, "
        "payload, friction, gauges, each with its 95 % interval; writes an arm file with "
        "them. Of a recording without torque the joints are moved as recorded and the strains fitted: "
        "transmissions with play, stiffness, damping, masses, gauges."
    )
    parser.epilog = (
        "example: flexarm identify results/sweep my_arm.yaml --out identified.yaml --plot fit.png"
    )
    add = parser.add_argument
    add("recording", metavar="BAG|CSV", nargs="?", help="a bag's directory, or a CSV file")
    add("arm", metavar="ARM", help="arm file that the fit starts from: a shipped name or a path")
    mappings.add_option(parser)
    add("--live", type=float, metavar="SECONDS", help="record a running arm's topics for so long")
    add("--namespace", default="", help="of the arm's topics")
    add("--out", metavar="FILE", help="write the arm file with the values found")
    add("--plot", metavar="FILE", help="draw measured, fitted and residual motion")
    add(
        "--report",
        metavar="FILE",
        help="write a page of HTML: overlays with zoom, residuals, parameters, correlations, what to measure next",
    )
    add(
        "--hold",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="keep the file's value of these: payload.mass 'gauges[*].gain'",
    )
    add(
        "--undetermined",
        type=float,
        default=UNDETERMINED,
        metavar="SHARE",
        help=f"half-interval, of the value, beyond which the file's value is kept ({UNDETERMINED:g})",
    )
    add("--json", action="store_true", help="print JSON")
    strains.add_arguments(parser)


def identify(options):
    """Run ``identify``; return the result as plain data."""
    if (options.live is None) == (options.recording is None):
        raise FlexarmError("give either a bag or CSV file, or --live SECONDS")
    if not options.undetermined > 0.0:
        raise FlexarmError(
            "is out of range", field="--undetermined", value=options.undetermined, limit="above 0"
        )
    out = None
    if options.out:
        out = Path(options.out)
        if out.exists() and out.samefile(arm_file.find(options.arm)):
            raise FlexarmError(
                "is the arm file itself", field="--out", value=str(out), hint="give another name"
            )
        out.parent.mkdir(parents=True, exist_ok=True)
    arm = arm_file.load(options.arm)
    progress = Progress()
    progress.step("measure" if options.live is not None else f"read {options.recording}")
    if options.live is not None:
        from .live import record

        measured = record(arm, options.live, options.namespace)
    else:
        measured = recordings.read(
            options.recording, arm, mappings.of_options(options), options.namespace
        )
    if strains.asked(options) or not np.isfinite(measured.torque).any():
        return without_torque(options, arm, measured, progress, out)
    progress.step(f"fit {arm.name} to {len(measured.position)} samples")
    found = fit(arm, measured, options.hold, options.undetermined)
    progress.done()
    result = summary(found, measured, options.recording or "a running arm")
    if out:
        text = arm_file.find(options.arm).read_text(encoding="utf-8")
        out.write_text(rewritten(text, found, heading(result)), encoding="utf-8")
        result["out"] = str(out)
    if options.plot:
        result["plot"] = draw(found, measured, options.plot)
    if options.report:
        result["report"] = page.write(found, measured, found.predicted, result, options.report)
    if options.json:
        print(json.dumps(result, allow_nan=False))
    else:
        print("\n".join(text_of(result)))
        for warning in result["warnings"]:
            print(f"flexarm identify: {warning}", file=sys.stderr)
    return result


def without_torque(options, arm, measured, progress, out):
    """Fit the strains alone; return the result as plain data."""
    found, result, (run, predicted) = strains.identify(options, arm, measured, progress)
    progress.done()
    if out:
        text = strains.arm_text(options.arm)
        head, notes = strains.heading(result), strains.origins(result)
        out.write_text(rewritten(text, strains.for_file(found), head, notes), encoding="utf-8")
        result["out"] = str(out)
    if options.plot:
        result["plot"] = strains.draw(found, run, predicted, result, options.plot)
    if options.report:
        result["report"] = page.write(found, run, predicted, result, options.report)
    if options.json:
        print(json.dumps(result, allow_nan=False))
    else:
        print("\n".join(strains.text_of(result, _line)))
        for key in FILES:
            if key in result:
                print(f"{key}: {result[key]}")
        for warning in result["warnings"]:
            print(f"flexarm identify: {warning}", file=sys.stderr)
    return result


def summary(found, measured, source):
    """Plain data of a fit."""
    names = (*found.arm.joint_names, *found.arm.gauge_names)
    rows = []
    for q, value, width in zip(found.quantities, found.values, found.half_widths, strict=True):
        kept = bool(np.isnan(width))
        why = "held" if q.name in found.held else "not determined"
        rows.append(
            {
                "name": q.name,
                "unit": q.unit,
                "value": float(value),
                "half_width": None if kept else float(width),
                "kept": why if kept else None,
            }
        )
    others = [
        {
            "name": d.name,
            "unit": d.unit,
            "value": d.value,
            "half_width": d.half_width if np.isfinite(d.half_width) else None,
        }
        for d in derived(found.arm, found.initial[: len(found.arm.joints)], found)
    ]
    return {
        "arm": found.arm.name,
        "source": str(source),
        "samples": len(measured.position),
        "period_s": measured.period,
        "parameters": rows,
        "derived": others,
        "residual_rms": {
            name: {"value": float(v), "unit": "rad" if c < len(found.arm.joints) else "strain"}
            for c, (name, v) in enumerate(zip(names, found.noise, strict=True))
        },
        "warnings": list(found.warnings),
    }


def heading(result):
    """Lines of the comment at the head of the written arm file."""
    yield f"Identified from {result['source']}: {result['samples']} samples of {result['period_s']:.6g} s."
    yield "Value +- half of the 95 % interval (docs/identification.md):"
    for row in result["parameters"]:
        yield "  " + _line(row)
    yield ""


def _line(row, width=36):
    if row["half_width"] is None:
        note = row.get("kept")
        return f"{row['name']:{width}} {row['value']:.6g} {row['unit']}" + (
            f"  ({note}: the file's)" if note else ""
        )
    share = abs(row["half_width"] / row["value"]) if row["value"] else np.inf
    percent = f"  ({100.0 * share:.2g} %)" if share < 10.0 else ""
    return f"{row['name']:{width}} {row['value']:.6g} +- {row['half_width']:.2g} {row['unit']}{percent}"


def text_of(result):
    """Lines for people."""
    seconds = result["samples"] * result["period_s"]
    yield f"{result['arm']}, {seconds:.4g} s of motion, {result['samples']} samples; 95 % intervals"
    yield ""
    yield from (_line(row) for row in result["parameters"])
    yield ""
    yield from (_line(row) for row in result["derived"])
    yield ""
    for name, row in result["residual_rms"].items():
        yield f"{'residual of ' + name:36} {row['value']:.3g} {row['unit']} rms"
    for key in FILES:
        if key in result:
            yield f"{key}: {result[key]}"


def draw(found, measured, path):
    """Draw measured, fitted and residual signals; return the path."""
    from flexarm_studies.commands.options import check_file
    from flexarm_studies.plotting import plt, save

    path = check_file(path)
    n = len(found.arm.joints)
    names = (*found.arm.joint_names, *found.arm.gauge_names)
    factors = [np.degrees(1.0)] * n + [1e6] * (len(names) - n)
    units = ["deg"] * n + ["microstrain"] * (len(names) - n)
    figure, axes = plt.subplots(
        len(names), 2, figsize=(11.0, 2.0 * len(names) + 0.8), squeeze=False, sharex=True,
        layout="constrained",
    )  # fmt: skip
    for c, (name, factor, unit) in enumerate(zip(names, factors, units, strict=True)):
        left, right = axes[c]
        left.plot(
            measured.time, factor * found.measured[:, c], lw=1.6, color="0.6", label="measured"
        )
        left.plot(measured.time, factor * found.predicted[:, c], lw=0.8, label="fitted")
        residual = factor * (found.measured[:, c] - found.predicted[:, c])
        right.plot(measured.time, residual, lw=0.5, color="tab:red")
        left.set_ylabel(f"{name} [{unit}]")
        right.set_ylabel(f"residual [{unit}]")
    axes[0, 0].legend(fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    figure.suptitle(f"{found.arm.name}: measured and fitted")
    return str(save(figure, path, dpi=120))
