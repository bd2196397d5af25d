# SPDX-License-Identifier: Apache-2.0
"""``flexarm recording show``: shows what a bag or a CSV file contains, before anything is fitted to it."""

import json

from flexarm_dynamics.arm import arm_file
from flexarm_studies.recordings import mapping as mappings
from flexarm_studies.recordings.summary import summary

from ..identification import recording as recordings


def add_arguments(parser):
    """Arguments of ``recording``."""
    parser.description = (
        "Looks at a recording: times and gaps, channels, where the joints rest, the gauges' noise there and its "
        "correlation, their drift and delay, delays between channels, ring-downs with frequency and damping, peaks "
        "of the spectra."
    )
    parser.epilog = (
        "example: flexarm recording show run.csv --mapping my_mapping.yaml --figure results/run.png"
    )
    add = parser.add_argument
    add("action", choices=("show",), help="show: print what is in it")
    add("recording", metavar="FILE", help="a bag's directory, or a CSV file")
    mappings.add_option(parser)
    add(
        "--arm",
        help="arm file whose joints and gauges are wanted; all of the recording if not given",
    )
    add("--namespace", default="", help="of the topics in a bag")
    add("--figure", metavar="F", help="draw channels, spectra, noise and ring-downs")
    add("--json", action="store_true", help="print JSON, in SI")


def recording(options):
    """Run ``recording``; return the summary as plain data."""
    arm = arm_file.load(options.arm) if options.arm else None
    mapping = mappings.of_options(options)
    measured = recordings.read(options.recording, arm, mapping, options.namespace)
    found = {"recording": str(options.recording)} | summary(measured)
    if options.figure:
        from flexarm_studies.recordings.figure import draw

        found["figure"] = draw(measured, found, options.figure)
    if options.json:
        print(json.dumps(found, allow_nan=False))
    else:
        print("\n".join(text_of(found)))
    return found


def text_of(found):
    """Lines for people, of a summary `found`."""
    yield (
        f"{found['recording']}: {found['samples']} samples at {found['rate_hz']:.6g} Hz, "
        f"{found['start_s']:g} to {found['end_s']:g} s, jitter {1e3 * found['jitter_s']:.2g} ms"
    )
    gaps = found["gaps"]
    yield f"gaps: {len(gaps)}" + "".join(
        f"\n  {g['length_s']:.4g} s at {g['at_s']:.4g} s" for g in gaps[:5]
    )
    yield from (f"note: {note}" for note in found["notes"])
    yield from ("", "channel                        least        greatest     step         missing")
    for c in found["channels"]:
        name = f"{c['quantity']} of {c['of']} [{c['unit']}]"
        yield f"{name:30} {c['low']:<12.5g} {c['high']:<12.5g} {c['step']:<12.3g} {c['missing']}"
    rests = ", ".join(f"{r['from_s']:.1f} to {r['to_s']:.1f}" for r in found["rest"])
    yield from ("", f"joints rest [s]: {rests or 'nowhere'}")
    yield from _noise(found["noise"])
    yield from _drift(found["drift"])
    yield from _ring_downs(found["ring_downs"])
    yield from _delays(found["delays"])
    yield from _peaks(found["peaks_hz"])
    if "figure" in found:
        yield f"figure: {found['figure']}"


def _noise(noise):
    if noise is None:
        yield "noise: no rest without vibration"
        return
    yield f"\nnoise from {noise['from_s']:.1f} to {noise['to_s']:.1f} s [microstrain], and correlation"
    rows = zip(
        noise["gauges"], noise["rms"], noise["rms_corrected"], noise["correlation"], strict=True
    )
    for name, rms, corrected, row in rows:
        if rms is None:
            yield f"  {name:16} misses values"
            continue
        numbers = "  ".join("  -  " if v is None else f"{v:5.2f}" for v in row)
        alone = "" if corrected is None else f"({1e6 * corrected:.2f} by itself)"
        yield f"  {name:16} {1e6 * rms:6.2f} {alone:18} {numbers}"
    if len(noise["gauges"]) > 1 and None not in noise["shared_rms"]:
        for what, factor in (("shared_rms", 1e6), ("own_rms", 1e6), ("shared_memory", 1.0)):
            unit = "" if factor == 1.0 else " [microstrain]"
            values = " ".join(f"{factor * v:.2f}" for v in noise[what])
            yield f"  {what.replace('_', ' ')}{unit}: {values}"


def _drift(rows):
    known = [row for row in rows if row["drift"] is not None]
    if known:
        yield "\ndrift over the recording [microstrain], delay after the motion [ms]"
    for row in known:
        yield (
            f"  {row['gauge']:16} {1e6 * row['drift']:6.1f} +- {1e6 * row['drift_half_width']:<6.1f}"
            f" {1e3 * row['delay_s']:6.1f} +- {1e3 * row['delay_half_width_s']:.1f}"
        )


def _ring_downs(rings):
    yield f"\nring-downs: {len(rings)}"
    for r in rings:
        yield (
            f"  {r['from_s']:6.2f} to {r['to_s']:6.2f} s, {r['gauge']}: "
            f"{r['frequency_hz']:.3f} +- {r['frequency_half_width_hz']:.3f} Hz, damping "
            f"{r['damping']:.4f} +- {r['damping_half_width']:.4f}, {1e6 * r['amplitude']:.3g} microstrain"
        )


def _delays(delays):
    if delays:
        yield "\ndelays between channels"
    for d in delays:
        late = f"{1e3 * d['delay_s']:.1f} ms after {d['after']}"
        yield f"  {d['of']:28} {late} (correlation {d['correlation']:.2f})"


def _peaks(peaks):
    if peaks:
        yield "\npeaks of the spectra [Hz]"
    for name, found in peaks.items():
        yield f"  {name:16} {', '.join(f'{f:.1f}' for f in found) or 'none'}"
