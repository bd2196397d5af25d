# SPDX-License-Identifier: Apache-2.0
"""Writes the table of residual vibration for the terminal and for docs/vibration.md."""

import numpy as np

from ..markdown import table, write_between
from .study import METHODS

BEGIN, END = "<!-- vibration: begin -->", "<!-- vibration: end -->"
TIME = "<!-- more time: begin -->", "<!-- more time: end -->"
#: Periods by which a motion may get longer: one as in the other tables, and more [-].
TIMES = (1.0, 1.5, 2.0, 3.0)
BENT = "<!-- bent: begin -->", "<!-- bent: end -->"
#: Numbers of places along a motion at which its modes are measured.
PLACES = (3, 5, 9)
PLACED = "<!-- more places: begin -->", "<!-- more places: end -->"
LIMIT = "<!-- limit: begin -->", "<!-- limit: end -->"
TRIALS = "<!-- trials: begin -->", "<!-- trials: end -->"
#: Number of corrections of a motion that is repeated.
CORRECTIONS = 5
#: Wanted residual of a method, over that of the trapezoid [-].
WANTED = {
    "robust": 0.1,
    "zvd": 0.1,
    "robust -15 %": 0.2,
    "robust +15 %": 0.2,
    "robust, both ends": 0.1,
    "robust, both ends -15 %": 0.2,
    "robust, both ends +15 %": 0.2,
    "retimed": 0.1,
    "retimed -15 %": 0.2,
    "retimed +15 %": 0.2,
}
UNSHAPED = METHODS[0]
#: Methods of which each motion that exceeds the wanted residual is listed; for the others, such motions are counted.
LISTED = ("retimed", "retimed -15 %", "retimed +15 %")
COLUMNS = (
    "method",
    "median",
    "90 %",
    "largest",
    "wanted",
    "within it",
    "worse than unshaped",
    "added, periods",
)


def ratios(rows):
    """Residual over that of the trapezoid, by method: dict of lists of (row, ratio)."""
    unshaped = {(r["arm"], r["motion"]): r["residual"] for r in rows if r["method"] == UNSHAPED}
    found = {method: [] for method in METHODS[1:]}
    for row in rows:
        if row["method"] in found:
            found[row["method"]].append(
                (row, row["residual"] / unshaped[row["arm"], row["motion"]])
            )
    return found


def summary(rows):
    """A row of `COLUMNS` for each method."""
    out = []
    for method, pairs in ratios(rows).items():
        if not pairs:
            continue
        found = np.array([ratio for _, ratio in pairs])
        wanted = WANTED.get(method)
        within = None if wanted is None else f"{int((found <= wanted).sum())} of {found.size}"
        added = float(np.median([row["added"] for row, _ in pairs]))
        worse = f"{int((found > 1.0).sum())} of {found.size}"
        spread = (float(f(found)) for f in (np.median, lambda x: np.quantile(x, 0.9), np.max))
        out.append((method, *spread, wanted, within, worse, added))
    return out


def groups(rows):
    """Rows by kind of arm, a dict."""
    named = {"random arms": [], "elastic base": [], "one link, payload 0 to 3 times": []}
    for row in rows:
        kind = "elastic base" if row["arm"] == "elastic base" else "random arms"
        kind = "one link, payload 0 to 3 times" if row["arm"].startswith("one link") else kind
        named[kind].append(row)
    return {name: found for name, found in named.items() if found}


def missed(rows, methods=LISTED):
    """(row, ratio) of each motion that exceeds the wanted residual, of some methods."""
    found = ratios(rows)
    return [pair for m in methods for pair in found[m] if pair[1] > WANTED[m]]


def missed_lines(rows):
    """Lines about each motion that exceeds the wanted residual, of the methods `LISTED`."""
    lines = []
    for row, ratio in missed(rows):
        modes = ", ".join(f"{f:.2f}" for f in row["frequencies"])
        where = f"{row['arm']}, motion {row['motion']}"
        lines.append(f"- {row['method']}: {ratio:.2f} of unshaped; {where}; measured {modes} Hz")
    return lines


def time_table(found):
    """Lines of the table of what `retimed` leaves in more time, from pairs of a row and its ratios for `TIMES`."""
    columns = ("motion", *(f"{times:g} period{'s' * (times != 1.0)}" for times in TIMES))
    named = ((f"{row['arm']}, motion {row['motion']}", *left) for row, left in found)
    return table(columns, named)


def places_table(found):
    """Lines of the table of what `retimed` leaves with modes at more places, from rows and ratios for `PLACES`."""
    columns = ("motion", "method", "wanted", *(f"{count} places" for count in PLACES))
    named = (
        (f"{row['arm']}, motion {row['motion']}", row["method"], WANTED[row["method"]], *left)
        for row, left in found
    )
    return table(columns, named)


def limit_table(found):
    """Lines of the table of the least that a time law leaves, from a row and `study.at_least` of its motion each."""
    columns = ("motion", "unshaped, mm", "retimed, mm", "retimed", "least, mm", "least")
    named = (
        (
            f"{row['arm']}, motion {row['motion']}",
            1e3 * unshaped,
            1e3 * left,
            left / unshaped,
            1e3 * least,
            least / unshaped,
        )
        for row, (unshaped, left, least) in found
    )
    return table(columns, named)


def trials_table(found):
    """Lines of the table of what `retimed` leaves after corrections, from pairs of a row and its residuals."""
    columns = ("motion", "method", "wanted", *(f"{n} corrections" for n in range(CORRECTIONS + 1)))
    named = (
        (f"{row['arm']}, motion {row['motion']}", row["method"], WANTED[row["method"]], *least)
        for row, least in found
    )
    return table(columns, named)


def text(rows):
    """The tables, Markdown."""
    lines = []
    for name, found in groups(rows).items():
        arms = {row["arm"] for row in found}
        silent = {(r["arm"], r["motion"]) for r in found if not r["method"]}
        lines += [f"**{name}** ({len(arms)}), three motions each", ""]
        lines += [*table(COLUMNS, summary(found)), ""]
        if silent:
            lines += [f"No mode was found in the ringing of {len(silent)} motions.", ""]
    lines += ["Not within what is wanted, of retimed:", "", *(missed_lines(rows) or ["- none"])]
    return "\n".join(lines)


def write(rows, path):
    """Put the tables between the markers of a Markdown file."""
    write_between(path, BEGIN, END, text(rows))
