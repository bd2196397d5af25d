# SPDX-License-Identifier: Apache-2.0
"""Makes the table of ``flexarm attack``: for each lie the worst case over arms, observers and moments."""

from pathlib import Path

from .. import markdown
from .lies import LASTING
from .run import CRITERIA

MARKERS = "<!-- attack table: begin -->", "<!-- attack table: end -->"
#: Written in place of a time if the event did not happen before the run's end.
NEVER = "never"
COLUMNS = (
    "lie", "speed", "strain", "excursion [rad]", "step", "outlier [%]", "returning [%]", "safe after [s]",
    "named after [s]", "runs", "held", "what fails, in how many runs",
)  # fmt: skip


def summary(rows):
    """A dict per lie: the worst of its `rows`, number of runs, how many passed, and how often each criterion failed."""
    found = []
    for name in dict.fromkeys(row["lie"] for row in rows):
        own = [row for row in rows if row["lie"] == name]
        failed = [what for row in own for what in row["failed"]]
        worst = {k: _worst(own, k) for k in ("speed", "strain", "excursion", "step")}
        worst |= {k: _worst(own, k) for k in ("outlier", "returning", "safe", "named")}
        if own[0]["kind"] == LASTING and any(row["safe"] is None for row in own):
            worst["safe"] = NEVER
        if any(row["named"] is None and "named" in row["failed"] for row in own):
            worst["named"] = NEVER
        counts = {what: failed.count(what) for what in dict.fromkeys(failed)}
        held = sum(not row["failed"] for row in own)
        found.append(
            {"lie": name, "kind": own[0]["kind"], **worst, "runs": len(own), "held": held, "failed": counts}
        )  # fmt: skip
    return found


def _worst(rows, key):
    return max((row[key] for row in rows if row[key] is not None), default=None)


def badness(entry):
    """By how much a summary's worst measure exceeds its criterion; lies that pass come last."""
    if not entry["failed"]:
        return 0.0
    ratios = [
        entry[k] / CRITERIA[k] for k in ("speed", "strain", "excursion") if entry[k] is not None
    ]
    return max([1.0, *ratios])


def table(entries):
    """Lines of the Markdown table."""
    rows = []
    for e in entries:
        percent = (None if e[k] is None else 100.0 * e[k] for k in ("outlier", "returning"))
        failed = "; ".join(f"{what} {count}" for what, count in e["failed"].items())
        numbers = (e[k] for k in ("speed", "strain", "excursion", "step"))
        rows.append(
            (e["lie"], *numbers, *percent, e["safe"], e["named"], e["runs"], e["held"], failed)
        )
    return markdown.table(COLUMNS, rows)


def worst_runs(rows, count=15):
    """Lines about the runs with the worst failures."""
    bad = sorted((r for r in rows if r["failed"]), key=_ratio, reverse=True)
    return [
        f"{r['arm']}, {r['observer']}, {'with' if r['velocity'] else 'without'} velocity: {r['lie']} at"
        f" {r['moment']:g}: {', '.join(r['failed'])}; speed {r['speed']:.3g}, strain {r['strain']:.3g},"
        f" excursion {r['excursion']:.3g} rad, torque {r['torque']:.3g}; {r['state']}: {r['text'] or '-'}"
        for r in bad[:count]
    ]


def _ratio(row):
    return max(row[k] / CRITERIA[k] for k in ("speed", "strain", "excursion"))


def write(file, entries):
    """Put the table between the markers of a document."""
    markdown.write_between(file, *MARKERS, "\n".join(table(entries)))


def note(file, rows):
    """Write the table, with the worst lies on top, and the worst runs to a separate file."""
    entries = sorted(summary(rows), key=badness, reverse=True)
    text = "\n".join([*table(entries), "", *worst_runs(rows), ""])
    Path(file).write_text(text, encoding="utf-8")
