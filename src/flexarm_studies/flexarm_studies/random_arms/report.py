# SPDX-License-Identifier: Apache-2.0
"""Writes the table of random arms for the terminal and for docs/random_arms.md, and why arms were refused or lost."""

import re
from collections import Counter

import numpy as np

from flexarm_dynamics.models import model

from .. import markdown
from ..loop import scenario as scenarios
from ..uncertain import plants
from ..uncertain.controllers import BASELINES
from ..uncertain.limits import ringing
from ..uncertain.trial import JOINT_REST
from . import generator

#: Markers of a seed's table.
BEGIN, END = "<!-- random arms, seed {}: begin -->", "<!-- random arms, seed {}: end -->"
COLUMNS = (
    "plant", "controller", "works", "refused", "lost", "settled", "within 3 periods",
    "periods until settled, median (worst)", "joints at rest", "no later than the best baseline",
    "peak joint error, median (worst)", "residual, median (worst) [1e-3 reach]",
)  # fmt: skip
DECAYS = (
    "designs", "arms", "worst-case decay, median of one link (wanted: 0.3)", "median of all (0.15)", "the least (0.05)",
    "below 0.05",
)  # fmt: skip
MISSES = (
    "Arms that do not settle within three periods on every plant, or do not rest: periods until settled, and the"
    " largest joint error at rest where it is more than wanted."
)
MISSED = "arm", "design", "decay"  # and the plants
LOUD = (
    "Arms whose tip vibrates more than that with noise, rms over the reach. *Exact*: the same arm without noise and"
    " delay. *Held*: vibration of the lowest mode that torque reaches, below which Coulomb friction holds the joints. A"
    " smaller one decays with the links' own damping, as far as the control does not overcome the friction."
)
LOUDER = (
    "arm", "design", "noisy", "noise alone", "exact", "held", "lowest mode that torque reaches [Hz]",
    "that no torque reaches [Hz]",
)  # fmt: skip
BEATEN = (
    "Runs with another payload or stiffness in which the best baseline is better than the design: it settles sooner, or"
    " leaves less."
)
BETTER = (
    "arm", "plant", "design", "settled after [s]", "best baseline after [s]", "residual over the reach",
    "best baseline's",
)  # fmt: skip
#: Minimum decay that is wanted of every design, over the first locked frequency [-].
LEAST = 0.05
#: Settling times closer than this are equal [s].
EQUAL = 0.01
#: Max. locked periods after the motion to count as settled in time [-].
IN_TIME = 3.0
#: Plants with deviations for which a design is made.
UNSURE = ("payload x0.7", "payload x1.3", "stiffness x0.9", "stiffness x1.1")
#: Time [s], and locked periods [-], within which a design should settle on the exact plant.
AT_ONCE, SOON = 0.1, 0.5
#: A smaller residual, as a fraction of the reach, counts as none; max. ratio of a residual with noise to that of noise
#: alone.
STILL, NOISE = 1e-6, 3.0
#: Number of reasons that are listed per controller.
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
    """Shortest settling time of the baselines, by arm and variant [s]; infinite if none settles."""
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
    if best and any((row["number"], row["variant"]) in best for row in group):
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
        _median_periods(group),
        sum(row["at_rest"] for row in works),
        no_later,
        f"{np.median(peaks):.2g}° ({max(peaks):.2g}°)" if peaks else None,
        f"{np.median(residual):.2g} ({max(residual):.2g})" if residual else None,
    )


def _median_periods(group):
    """Locked periods until settled, median and worst of all runs that were not refused, in words."""
    periods = [_periods(row) for row in group if outcome(row) != "refused"]
    if not periods:
        return None
    median, worst = (
        f"{of(periods):.2g}" if np.isfinite(of(periods)) else "never" for of in (np.median, np.max)
    )
    return f"{median} ({worst})"


def _periods(row):
    """Locked periods until the tip of a run settled; infinite: it never did."""
    return row["settling_periods"] if row.get("settled") else np.inf


def missed(rows):
    """Cells of the table of the designs in `rows` that did not settle in time everywhere, per arm and controller.

    For each variant: the locked periods until settled, followed by the largest joint error at rest if that is more than
    wanted.
    """
    designed = {row["controller"] for row in rows if "decay" in row}
    groups = {}
    for row in rows:
        if row["controller"] in designed:
            groups.setdefault((row["arm"], row["controller"]), []).append(row)
    for (arm, controller), group in groups.items():
        if any(_periods(row) > IN_TIME or not row.get("at_rest") for row in group):
            yield arm, controller, group[0].get("decay"), *map(_in_words, group)


def loud(rows, seed):
    """Cells of the table of the designs in `rows` that vibrate more with noise than wanted, and what limits them.

    Returns
    -------
    iterator of tuple
        Cells of the columns `LOUDER`.
    """
    exact = {
        (row["number"], row["controller"]): row.get("residual_tip")
        for row in rows
        if row["variant"] == "exact"
    }
    for row in rows:
        if "decay" not in row or not row.get("noise_tip") or _quiet(row):
            continue
        case = generator.arm(row["number"], seed)
        plant = model.build(plants.plant_of(case.read(), plants.VARIANTS[row["variant"]]))
        path = scenarios.trajectory_of(case.motion, plant, np.zeros(plant.n_joints))
        modes = ringing(plant, np.array(path.positions[-1]))
        free = next((mode.frequency for mode in modes if not mode.reached), None)
        lowest = next((mode for mode in modes if mode.reached), None)
        own = exact.get((row["number"], row["controller"]))
        held, hertz = (lowest.held, lowest.frequency) if lowest else (None, None)
        sizes = row["residual_tip"], row["noise_tip"], own, held
        words = (None if size is None else f"{size:.1e}" for size in sizes)
        yield row["arm"], row["controller"], *words, hertz, free


def beaten(rows):
    """Cells of the columns `BETTER`, for each run of a design in `rows` that the best baseline beats."""
    best, smallest = best_baseline(rows), _smallest_residual(rows)
    designed = {row["controller"] for row in rows if "decay" in row}
    for row in rows:
        place = row["number"], row["variant"]
        if row["controller"] not in designed or row["variant"] not in UNSURE or place not in best:
            continue
        if not _no_worse(row, best, smallest):
            never = "never" if outcome(row) == "works" else outcome(row)
            after = f"{row['settling_s']:.3g}" if row.get("settled") else never
            sooner = f"{best[place]:.3g}" if np.isfinite(best[place]) else "never"
            residuals = row.get("residual_tip"), smallest.get(place)
            words = (None if size is None else f"{size:.1e}" for size in residuals)
            yield row["arm"], row["variant"], row["controller"], after, sooner, *words


def _no_worse(row, best, smallest):
    """Whether a run settles no later and leaves no more than `best_baseline` and its `_smallest_residual`."""
    place = row["number"], row["variant"]
    if not row.get("settled"):
        return outcome(row) == "works" and not np.isfinite(best[place])
    sooner = row["settling_s"] <= best[place] + EQUAL
    return sooner and row["residual_tip"] <= max(smallest.get(place, np.inf), STILL)


def _quiet(row):
    """Whether a run with noise vibrates at most `NOISE` times as much as with noise alone, or not at all."""
    found, alone = row.get("residual_tip"), row.get("noise_tip")
    return None not in (found, alone) and found <= max(NOISE * alone, STILL)


def _in_words(row):
    if outcome(row) != "works":
        return outcome(row)
    settled = f"{_periods(row):.2g}" if row["settled"] else "never"
    return settled if row["at_rest"] else f"{settled} ({row['rest_joint_deg']:.2g}°)"


def reached(rows):
    """Cells of the table of requirements on designs: the line, what is wanted, and what each design reached.

    Returns
    -------
    list of str, list of tuple
        The designs' names, and the rows.
    """
    names = list(dict.fromkeys(row["controller"] for row in rows if "decay" in row))
    best, smallest = best_baseline(rows), _smallest_residual(rows)
    own = [[row for row in rows if row["controller"] == name] for name in names]

    def line(words, wanted, right, which=lambda row: True):
        groups = [[row for row in group if which(row)] for group in own]
        return words, wanted, *(_share(list(map(right, group))) for group in groups)

    def exact(row):
        return row["variant"] == "exact"

    def unsure(row):
        return row["variant"] in UNSURE

    def compared(row):
        return unsure(row) and (row["number"], row["variant"]) in best

    table = [
        line("neither refused nor lost", "all", lambda row: outcome(row) == "works"),
        line(
            f"exact: settled within {AT_ONCE} s",
            "95 % (`preview`)",
            lambda row: row.get("settled") and row["settling_s"] <= AT_ONCE,
            exact,
        ),
        line(
            "exact: settled within half a period",
            "95 %",
            lambda row: _periods(row) <= SOON,
            exact,
        ),
        line(
            "payload and stiffness differ: settled within three periods",
            "95 %",
            lambda row: _periods(row) <= IN_TIME,
            unsure,
        ),
        line(
            f"the same: joints rest within {JOINT_REST}°",
            "all",
            lambda row: row.get("at_rest"),
            unsure,
        ),
        line(
            "the same: settled no later, and no more residual, than the best baseline",
            "95 %",
            lambda row: _no_worse(row, best, smallest),
            compared,
        ),
        line(
            f"noisy: residual at most {NOISE:g} times what noise alone makes",
            "all",
            _quiet,
            lambda row: "noise_tip" in row or (row["variant"] == "noisy"),
        ),
    ]
    return names, [row for row in table if any(cell is not None for cell in row[2:])]


def _smallest_residual(rows):
    """Residual of the baselines that settle the soonest, by arm and variant, as a fraction of the reach [-]."""
    best, found = best_baseline(rows), {}
    for row in rows:
        place = row["number"], row["variant"]
        if row["controller"] in BASELINES and row.get("settling_s") == best[place]:
            found[place] = row["residual_tip"]
    return found


def _share(right):
    """Count of true values among all, in words; None for an empty list."""
    if not right:
        return None
    count = sum(map(bool, right))
    return f"{count} of {len(right)} ({100.0 * count / len(right):.3g} %)"


def reasons(rows):
    """Lines: why arms were refused or lost, by controller, the most common first; without numbers and names."""
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


def decays(rows):
    """Cells of the table of designs, a row per controller that is a design: the worst-case decay of its arms."""
    found = {}
    for row in rows:
        if "decay" in row:
            found.setdefault(row["controller"], {})[row["number"]] = row
    for controller, arms in found.items():
        every = [row["decay"] for row in arms.values()]
        one = [row["decay"] for row in arms.values() if re.match(r"[a-z]+1(?!\d)", row["arm"])]
        median = [float(np.median(some)) if some else None for some in (one, every)]
        slow = sum(decay < LEAST for decay in every)
        yield controller, len(every), *median, min(every), slow


def text(rows, seed):
    """Tables and reasons, Markdown."""
    count = len({row["number"] for row in rows})
    lines = [f"{count} arms, seed {seed}.", "", *markdown.table(COLUMNS, rows_of(rows))]
    designs = list(decays(rows))
    if designs:
        names, table = reached(rows)
        lines += ["", *markdown.table(("of the runs", "wanted", *names), table)]
        lines += ["", *markdown.table(DECAYS, designs)]
        variants = dict.fromkeys(row["variant"] for row in rows)
        lines += ["", MISSES, "", *markdown.table((*MISSED, *variants), missed(rows))]
        if found := list(beaten(rows)):
            lines += ["", BEATEN, "", *markdown.table(BETTER, found)]
        if found := list(loud(rows, seed)):
            lines += ["", LOUD, "", *markdown.table(LOUDER, found)]
    return "\n".join([*lines, "", *reasons(rows)])


def write(rows, seed, file):
    """Put the table between the markers of a Markdown `file`."""
    begin, end = (marker.format(seed) for marker in (BEGIN, END))
    markdown.write_between(file, begin, end, f"\n{text(rows, seed)}\n")
