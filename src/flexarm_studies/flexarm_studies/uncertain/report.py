# SPDX-License-Identifier: Apache-2.0
"""Reports runs on uncertain plants: nominal, median and worst of each controller, and who wins, also in words.

A run that is lost or refused, or does not settle, is worse than all others. The median is a value of one run: with an
even number of plants, the worse of the two in the middle. Nominal is the plant that equals the model; median and worst
do not include it.
"""

from collections import Counter

from .. import markdown
from .controllers import BASELINES, WORDS
from .plants import NOMINAL

#: Compared measures: key of a row, words, factor, and the difference that still counts as equal: a fraction, and a
#: number.
MEASURES = (
    ("peak_joint_error_deg", "peak joint error [deg]", 1.0, 0.01, 0.0),
    ("settling_s", "settling time [s]", 1.0, 0.01, 0.01),
    ("residual_tip", "tip residual [1e-3 reach]", 1e3, 0.01, 1e-3),
)
OVER = (NOMINAL, "median", "worst")
#: Words for a run without a number, from better to worse.
NOT_SETTLED, LOST, REFUSED = "not settled", "lost", "refused"
ORDER = (NOT_SETTLED, LOST, REFUSED)
#: Number of reasons that are listed per controller.
REASONS = 2


def cell(row, name, factor):
    """A measure of a run as (rank, number, word): smaller is better; the number is None if there is a word."""
    word = next((w for w in (REFUSED, LOST) if w in row), None)
    if word is None and row[name] is None:
        word = NOT_SETTLED
    if word is not None:
        return (1 + ORDER.index(word), None, word)
    return (0, factor * row[name], "")


def rows_of(rows):
    """Rows of the table: (words, {controller: cell}, winners), for each measure and each of `OVER`."""
    controllers = list(dict.fromkeys(row["controller"] for row in rows))
    for name, words, factor, fraction, number in MEASURES:
        for over in OVER:
            cells = {c: _over(rows, c, over, name, factor) for c in controllers}
            yield f"{words}, {over}", cells, winners(cells, fraction, number)


def _over(rows, controller, over, name, factor):
    """Cell of a controller, nominal or over the plants; None if there is no such run."""
    own = [r for r in rows if r["controller"] == controller]
    own = [r for r in own if (r["variant"] == NOMINAL) == (over == NOMINAL)]
    found = sorted((cell(r, name, factor) for r in own), key=_rank)
    if not found:
        return None
    return found[-1] if over == "worst" else found[len(found) // 2]


def _rank(found):
    return found[0], found[1] or 0.0


def winners(cells, fraction, number):
    """Controllers with the best cell, or equally good within `fraction` and `number`; none if no cell has a number."""
    values = {c: found[1] for c, found in cells.items() if found and found[1] is not None}
    if not values:
        return []
    best = min(values.values())
    return [c for c, value in values.items() if value <= best * (1.0 + fraction) + number]


def table(rows):
    """Lines of the table, Markdown: a column per controller."""
    found = list(rows_of(rows))
    if not found:
        return []
    controllers = list(found[0][1])
    lines = [(words, *map(_text, cells.values()), ", ".join(won)) for words, cells, won in found]
    for word in (LOST, REFUSED):
        count = Counter(r["controller"] for r in rows if word in r)
        runs = Counter(r["controller"] for r in rows)
        lines.append((word, *(f"{count[c]} of {runs[c]}" for c in controllers), ""))
    return markdown.table(("", *controllers, "best"), lines)


def _text(found):
    if found is None:
        return None
    return found[2] or f"{found[1]:.3g}"


def verdicts(rows):
    """Sentences: in which rows a baseline wins, and against what; in which it does not; lost or refused runs."""
    found = list(rows_of(rows))
    if not any(c in BASELINES for _, cells, _ in found for c in cells):
        return [*_worst_plants(rows), *_reasons(rows)]
    beaten, kept = [], []
    for words, cells, won in found:
        own = {c: x for c, x in cells.items() if c not in BASELINES and x}
        if own and won and not set(won) & set(own):
            best = min(own, key=lambda c: _rank(own[c]))
            beaten.append(
                f"{words}: {', '.join(won)} ({_text(cells[won[0]])}) before {best} ({_text(own[best])})"
            )
        elif set(won) & set(own):
            kept.append(f"{words} ({', '.join(c for c in won if c in own)})")
    lines = [f"A baseline wins {len(beaten)} of {len(found)} rows{':' if beaten else '.'}"]
    lines += [f"  - {line}" for line in beaten]
    if kept:
        lines.append(f"No baseline is better in {len(kept)}: {'; '.join(kept)}.")
    return [*lines, *_worst_plants(rows), *_reasons(rows)]


def _worst_plants(rows):
    """The plant on which each controller takes longest to settle."""
    for controller in dict.fromkeys(r["controller"] for r in rows):
        own = [r for r in rows if r["controller"] == controller and r["variant"] != NOMINAL]
        if own:
            last = max(own, key=lambda r: _rank(cell(r, "settling_s", 1.0)))
            text = _text(cell(last, "settling_s", 1.0))
            seconds = " s" if text[0].isdigit() else ""
            yield f"{controller} settles last on {last['variant']}: {text}{seconds}."


def _reasons(rows):
    """Why runs were lost or refused."""
    for word in (LOST, REFUSED):
        count = Counter((r["controller"], r[word]) for r in rows if word in r)
        seen = Counter()
        for (controller, why), runs in count.most_common():
            seen[controller] += 1
            if seen[controller] <= REASONS:
                yield f"{controller} {word} in {runs} runs: {why}"


def bullets(lines):
    """Sentences as a Markdown list; an indented one is already an item."""
    return "\n".join(line if line.startswith("  -") else f"- {line}" for line in lines)


def legend(rows):
    """One line with the meaning of the controllers' names."""
    names = dict.fromkeys(row["controller"] for row in rows)
    return "; ".join(f"{name}: {WORDS[name]}" for name in names if name in WORDS)
