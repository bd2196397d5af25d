# SPDX-License-Identifier: Apache-2.0
"""``flexarm latency``: its options, and the tables that it writes; `measure` has what is measured."""

import json
import os
from dataclasses import replace
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.markdown import write_between
from flexarm_studies.progress import Progress

from . import processor, redesign
from .measure import CASES, CHAINS, measure, summary, table

BEGIN, END = "<!-- latency: begin -->", "<!-- latency: end -->"
#: A machine that exceeds one of these is too busy for a table: processes per CPU before the start, median of the bare
#: relay [ms], and fraction of the relay's samples answered too late. On a quiet machine of two cores the last two are
#: 0.7 ms and 0.04.
MAX_LOAD, MAX_RELAY_MS, MAX_RELAY_LATE = 0.5, 1.5, 0.1


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Runs loop and relay in real time, in turns, at several rates; three to four minutes."
    )
    parser.epilog = "example: flexarm latency --quick --json results/latency.json"
    parser.add_argument(
        "--quick", action="store_true", help="500 Hz alone, fewer rounds, under a minute"
    )
    parser.add_argument("--rounds", type=int, help="turns of each (default 5; 3 with --quick)")
    parser.add_argument("--arms", default="R,long_reach", help="of R and long_reach")
    parser.add_argument("--rates", default="200,500,1000", help="of arm R [Hz]")
    parser.add_argument(
        "--at-rest", action="store_true", help="no motion; long_reach at 1 kHz, not slowed down"
    )
    parser.add_argument(
        "--relay-spin",
        choices=("executor", "line"),
        default="executor",
        help="relay's nodes served by rclpy's executor (default), or as the loop's nodes are",
    )
    parser.add_argument(
        "--redesign",
        action="store_true",
        help="then, at 500 Hz, the loop while its fast law is designed anew; five minutes more",
    )
    parser.add_argument("--json", metavar="FILE", help="all figures, window by window")
    parser.add_argument(
        "--write",
        metavar="FILE",
        help="put the table between a file's markers, unless the machine was too busy",
    )
    parser.add_argument("--force", action="store_true", help="write, however busy the machine was")


def chosen(options):
    """The cases that the options select."""
    arms, rates = options.arms.split(","), [float(r) for r in options.rates.split(",")]
    rates = [500.0] if options.quick else rates
    known_cases = CASES
    if options.at_rest:
        known_cases = [replace(c, rate=1000.0, pace=1.0) if c.file else c for c in CASES]
    cases = [c for c in known_cases if c.arm in arms and (c.arm != "R" or c.rate in rates)]
    if not cases:
        known = "; ".join(c.name for c in CASES)
        given = f"{options.arms} at {options.rates} Hz"
        raise FlexarmError("is not measured", field="--arms, --rates", value=given, limit=known)
    return cases


def too_busy(load, everything):
    """Why the machine was too busy for a table; empty if it was not.

    Parameters
    ----------
    load : float
        Processes per CPU before the start.
    everything : list of dict
        The measurements, case by case; the relay's rows show the latency of the machine and middleware alone.

    Returns
    -------
    str
    """
    relay = [r for case in everything for r in case["rows"] if r.get("chain") == "relay"]
    median = max((r["latency_ms"]["p50"] for r in relay), default=0.0)
    late = max((r["missed"] for r in relay), default=0.0)
    reasons = {
        f"{load:.1f} processes per CPU before the start (at most {MAX_LOAD:g})": load > MAX_LOAD,
        f"median of the bare relay {median:.1f} ms (at most {MAX_RELAY_MS:g})": median
        > MAX_RELAY_MS,
        f"{100.0 * late:.0f} % of the relay's samples late (at most {100.0 * MAX_RELAY_LATE:g} %)": late
        > MAX_RELAY_LATE,
    }
    return "; ".join(text for text, holds in reasons.items() if holds)


def _table_of(everything, cases, options, title, measured):
    """Measure case by case and print each table; return the table of all, and add its numbers to `everything`."""
    text, progress = "", Progress()
    for i, case in enumerate(cases):
        progress.step(f"{title}: {case.name}", i + 1, len(cases))
        found, rows, made = measured(case, options, progress)
        progress.done()
        more = "\n".join(made.splitlines()[2:]) if text else made
        print(more, flush=True)
        text = f"{text}\n{more}" if text else more
        for row in rows:
            if row.get("chain", "relay") != "relay" and row["enabled"] < 0.99:
                share = f"{100.0 * row['enabled']:.0f} %"
                print(
                    f"{row['case']}, {row['chain']}: torque was enabled in {share} of the samples"
                )
        everything.append({"case": case.name, "title": title, "found": found, "rows": rows})
    return text


def _beside_the_relay(case, options, progress):
    rounds = options.rounds or (3 if options.quick else 5)
    chains = tuple(CHAINS)[:2] if options.quick else tuple(CHAINS)
    # Planning a motion of many joints takes longer than a quick run may.
    moving = not (options.at_rest or (options.quick and case.file))
    found = measure(case, rounds, chains, options.relay_spin, moving, progress.fraction)
    rows = [{**row, "moving": moving} for row in summary(case, found)]
    return found, rows, table(rows)


def _while_designing(case, options, progress):
    found = redesign.measure(case, options.rounds or 10, progress.fraction)
    rows = redesign.summary(case, found)
    return found, rows, redesign.table(rows)


def latency(options):
    """Run the sub-command."""
    tables, everything = [], []
    cases, load = chosen(options), os.getloadavg()[0] / (os.cpu_count() or 1)
    again = [case for case in cases if case.rate == 500.0]
    if options.redesign and not again:
        raise FlexarmError(
            "is measured at 500 Hz", field="--redesign", hint="have it among the --rates"
        )
    tables.append(_table_of(everything, cases, options, "beside a relay", _beside_the_relay))
    tables.append(processor.table([row for case in everything for row in case["rows"]]))
    print(tables[-1], flush=True)
    if options.redesign:
        tables.append(_table_of(everything, again, options, "while designing", _while_designing))
    if options.json:
        Path(options.json).write_text(json.dumps(everything, indent=1) + "\n", encoding="utf-8")
    busy = too_busy(load, everything)
    if busy:
        print(f"The machine was too busy for a table that is to be kept: {busy}.")
    if options.write and busy and not options.force:
        problem = "is not written: the machine was too busy"
        raise FlexarmError(problem, field=options.write, hint="see --force")
    if options.write:
        write_between(options.write, BEGIN, END, "\n\n".join(tables))
