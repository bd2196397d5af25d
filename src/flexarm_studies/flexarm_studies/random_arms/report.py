# SPDX-License-Identifier: Apache-2.0
"""The table of random arms, for the terminal and for docs/random_arms.md, and why arms were refused or lost."""

import re
from collections import Counter

import numpy as np

from .. import markdown
from ..uncertain.controllers import BASELINES

BEGIN, END = "<!-- random arms: begin -->", "<!-- random arms: end -->"
COLUMNS = (
    "plant", "controller", "works", "refused", "lost", "settled", "within 3 periods", "joints at rest",
    "no later than the best baseline", "peak joint error, median (worst)", "residual, median [1e-3 reach]",
)  # fmt: skip
#: Settling times closer than this are equal [s].
EQUAL = 0.01
#: Settled in time: locked periods after the motion [-].
IN_TIME = 3.0
#: So many reasons are listed per controller.
REASONS = 6


def outcome(row):
    """``refused``, ``lost`` or ``works``."""
    return next((name for name in ("refused", "lost") if name in row), "works")


def rows_of(rows):
    """Cells of the table, a row per variant and controller in the order of `rows`."""
    best = best_baseline(rows)
    groups = {}
    for row in rows:
        groups.setdefault((row["variant"], row["controller"]), []).append(row)
    order = list(dict.fromkeys(row["variant"] for row in rows))
    for (variant, controller), group in sorted(groups.items(), key=lambda g: order.index(g[0][0])):
        yield (variant, controller, *_cells(group, best if controller not in BASELINES else None))


def best_baseline(rows):
    """Shortest settling time of the baselines, by arm and variant [s]; infinite where none settles."""
    best = {}
    for row in rows:
        if row["controller"] in BASELINES:
            found = np.inf if row.get("settling_s") is None else row["settling_s"]
            place = row["number"], row["variant"]
            best[place] = min(best.get(place, np.inf), found)
    return best


def _cells(group, best):
    count = Counter(map(outcome, group))
    works = [row for row in group if outcome(row) == "works"]
    settled = [row for row in works if row["settled"]]
    in_time = sum(row["settling_periods"] <= IN_TIME for row in settled)
    no_later = None
    if best:
        compared = [row for row in settled if (row["number"], row["variant"]) in best]
        no_later = sum(
            row["settling_s"] <= best[row["number"], row["variant"]] + EQUAL for row in compared
        )
    peaks = [row["peak_joint_error_deg"] for row in works]
    residual = [1e3 * row["residual_tip"] for row in works if row["residual_tip"] is not None]
    return (
        count["works"],
        count["refused"],
        count["lost"],
        len(settled),
        in_time,
        sum(row["at_rest"] for row in works),
        no_later,
        f"{np.median(peaks):.2g}° ({max(peaks):.2g}°)" if peaks else None,
        f"{np.median(residual):.2g}" if residual else None,
    )


def reasons(rows):
    """Lines: why arms were refused or lost, by controller, the commonest first; numbers and names left out."""
    lines = []
    for controller in dict.fromkeys(row["controller"] for row in rows):
        own = [row for row in rows if row["controller"] == controller and outcome(row) != "works"]
        found = Counter((outcome(row), _gist(row[outcome(row)])) for row in own)
        for (what, why), count in found.most_common(REASONS):
            lines.append(f"- {controller}, {what} in {count} runs: {why}")
    return lines


def _gist(reason):
    """A reason without what differs from arm to arm."""
    short = re.sub(r"\[[^\]]*\]", "…", reason.split(";")[0])
    short = re.sub(r"(joint|link)\d+(_[yz]_mode\d+)?", r"\1", short)
    return re.sub(r"\(?-?\d[\d.]*(e[-+]?\d+)?([-+]\d[\d.]*(e[-+]?\d+)?j\))?", "…", short)


def text(rows, seed):
    """Table and reasons, Markdown."""
    count = len({row["number"] for row in rows})
    head = f"{count} arms, seed {seed}."
    return "\n".join([head, "", *markdown.table(COLUMNS, rows_of(rows)), "", *reasons(rows)])


def write(rows, seed, file):
    """Put the table between the markers of a Markdown `file`."""
    markdown.write_between(file, BEGIN, END, f"\n{text(rows, seed)}\n")
