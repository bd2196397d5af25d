# SPDX-License-Identifier: Apache-2.0
"""``flexarm compare``: tunes all controllers in the same way, runs them, and writes the tables.

One table is for the plant that equals the controllers' model, with everything tuned by simulation on it. The other
table is for the uncertain set, with baselines tuned for this set: `uncertain`.
"""

import argparse
import json
import sys
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError

from .. import workers
from ..commands.options import at_least, chosen
from ..progress import Progress
from ..store import Store, gather
from ..uncertain import controllers as uncertain
from ..uncertain import plants, runs
from . import cases, combinations, report
from .controllers import CONTROLLERS, PREVIEW, Setup, prepared
from .trial import REFUSED, run
from .tuning import tune

#: For `--quick`: the only arm, the number of simulations, and the window after the motion [s].
QUICK, QUICK_BUDGET, QUICK_WINDOW = "R", 2, 0.2
QUICK_PLANTS = (plants.NOMINAL, "payload x1.3")
#: Name of the shipped file among the controllers that run on the uncertain set.
SHIPPED = "shipped"
#: The controllers that run on the uncertain set.
ON_PLANTS = (SHIPPED, "designed", "designed_preview", *uncertain.BASELINES)


@dataclass(frozen=True)
class OnPlants:
    """Marks a job as a controller on uncertain plants."""

    controller: str
    variants: tuple


@dataclass(frozen=True)
class Specification:
    """Settings that all results of a file have in common."""

    comparison_seed: int
    cases: list


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Runs every controller on the same arms, motions, limits and sensors, and writes a table."
    )
    parser.epilog = "example: flexarm compare --arms R --json results/compare.json"
    add = parser.add_argument
    arms = ",".join(s.arm for s in cases.CASES)
    add("--arms", default=arms, help=f"arms, separated by commas ({arms})")
    add(
        "--controllers",
        help=f"controllers, separated by commas; or none (all); on the uncertain set: {','.join(ON_PLANTS)}",
    )
    names = ",".join(plants.VARIANTS)
    add(
        "--plants",
        default=names,
        help=f"uncertain set, separated by commas, of which long_reach has a part; or none ({names})",
    )
    add("--budget", type=int, metavar="N", help="simulations per controller (depends on the arm)")
    add("--seed", type=int, default=0, help="seed of tuning and noise (0)")
    workers.add_arguments(add)
    add(
        "--out",
        metavar="FILE.jsonl",
        help="keep every result; those in it are not computed again, so an interrupted command goes on",
    )
    add(
        "--quick",
        action="store_true",
        help=f"{QUICK} alone, hardly any tuning: to see that it works",
    )
    add(
        "--no-combinations",
        action="store_true",
        help="no combinations of the composite control's parts",
    )
    add("--json", metavar="FILE", help="write rows and gains")
    add("--write", metavar="FILE", help="write the tables between the markers of this file")
    add(
        "--from",
        dest="stored",
        nargs="+",
        metavar="FILE",
        help="take results that --json wrote, from one run or several with different rows; run nothing",
    )


def compare(options):
    """Run the sub-command."""
    if options.stored:
        found = merged([load(path) for path in options.stored])
    else:
        # After every job, so an interrupted run loses nothing.
        found = study(options, Progress(), lambda rows: store(rows, options.json))
    store(found, options.json)
    if options.write:
        report.write(found, options.write)
    print(report.text(found), file=sys.stdout)


def store(found, path):
    """Write rows, if there is a path."""
    if path:
        text = json.dumps(found, indent=1, allow_nan=False)
        Path(path).write_text(text + "\n", encoding="utf-8")


def load(path):
    """Stored rows; a file that --json did not write is refused."""
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
        found["cases"][0]["controllers"]
        return found
    except (ValueError, LookupError, TypeError) as error:
        raise FlexarmError(f"was not written by --json: {error}", field=str(path)) from None


def merged(runs):
    """Merge `runs` into one comparison: rows of the same arm, which must agree in motion, rate, window and so on."""
    by_arm = {}
    for run_ in runs:
        for case in run_["cases"]:
            empty = {"controllers": {}, "combinations": [], "plants": []}
            whole = by_arm.setdefault(case["arm"], case | empty)
            for name in ("motion", "rate_Hz", "window_s", "budget"):
                if whole[name] != case[name] or runs[0]["seed"] != run_["seed"]:
                    raise FlexarmError(f"the runs differ in {name} or seed", field=case["arm"])
            whole["controllers"] |= case["controllers"]
            whole["combinations"] += case["combinations"]
            whole["plants"] += case.get("plants", [])
    order = [s.arm for s in cases.CASES]
    return {
        "seed": runs[0]["seed"],
        "cases": sorted(by_arm.values(), key=lambda s: order.index(s["arm"])),
    }


def wanted_of(options):
    """The requested cases, names of controllers tuned on the model, names of those on uncertain plants, and plants."""
    for name, least in (("budget", 1), ("seed", 0)):
        at_least(f"--{name}", getattr(options, name), least)
    names = [*CONTROLLERS, *ON_PLANTS]
    if options.controllers == "none":
        names = []
    elif options.controllers:
        names = _joined([name.strip() for name in options.controllers.split(",")])
    variants = ()
    if options.plants != "none":
        variants = tuple(chosen("--plants", options.plants, plants.VARIANTS))
    wanted = cases.find([QUICK] if options.quick else options.arms.split(","))
    if options.quick:
        wanted = [replace(s, window=QUICK_WINDOW, depth="star") for s in wanted]
        variants = tuple(v for v in variants if v in QUICK_PLANTS)
    budget = options.budget or (QUICK_BUDGET if options.quick else None)
    if budget:
        wanted = [replace(s, budget=budget) for s in wanted]
    if options.no_combinations:
        wanted = [replace(s, depth="none") for s in wanted]
    tuned = [name for name in names if name in CONTROLLERS]
    return wanted, tuned, [name for name in names if name in ON_PLANTS], variants


def _joined(words):
    """Names of controllers from a list with commas: "joint PID, ZV shaper" contains a comma itself."""
    names, rest = [], list(words)
    while rest:
        for count in (2, 1):
            name = ", ".join(rest[:count])
            if name in CONTROLLERS or name in ON_PLANTS:
                names.append(name)
                del rest[:count]
                break
        else:
            known = "; ".join((*CONTROLLERS, *ON_PLANTS))
            raise FlexarmError("is unknown", field="--controllers", value=rest[0], limit=known)
    return names


def jobs_of(wanted, names, on_plants=(), variants=()):
    """All jobs, the longest first: (case, controller's name, combination or `OnPlants`)."""
    of_set = [
        (s, OnPlants(name, plants.names_for(cases.arm_of(s.arm), judged)))
        for s in reversed(wanted)
        for judged in [tuple(v for v in variants if v in s.plants)]
        for name in on_plants
        if judged
    ]
    tuned = [
        (s, name)
        for s in reversed(wanted)
        for name in names
        if name != PREVIEW or combinations.shipped(s)[-1] != "preview"
    ]
    parts = [(s, c) for s in reversed(wanted) for c in combinations.of(s)]
    return of_set + tuned + parts


def evaluate(case, name, seed):
    """Tune the controller `name` and run it without and with noise; also called in other processes.

    Returns ``row`` and ``noisy`` as `trial.run` returns them, ``gains`` by name, ``simulations``, and the ``first`` and
    ``best`` cost.
    """
    candidate = CONTROLLERS[name]
    free = candidate.free(case)

    def result(values, **noise):
        try:
            return run(case, prepared(case, name, values), **noise)
        except FlexarmError as error:
            return {"refused": str(error), "cost": REFUSED}

    screen = candidate.screen and partial(candidate.screen, case)
    values, history = [], []
    if free:
        values, _, history = tune(
            lambda values: result(values)["cost"], free, case.budget, seed, screen
        )
    row = result(values)
    return {
        "row": row,
        "noisy": result(values, noisy=True, seed=seed),
        "gains": {f.name: v for f, v in zip(free, values, strict=True)},
        "simulations": len(history),
        "first": history[0] if history else row["cost"],
        "best": min(history, default=row["cost"]),
    }


def on_plants(case, what, seed=0):
    """Rows of a controller on uncertain plants, as `runs.rows`; it is tuned once for all of them."""
    shipped = partial(Setup, case.values() | {"rate": case.rate})
    make = uncertain.CONTROLLERS.get(what.controller, lambda task: shipped())
    found = runs.rows(cases.task_of(case), case.arm, what.controller, make, what.variants, seed)
    return [
        {k: v for k, v in row.items() if k not in ("sample", "arm", "seconds")} for row in found
    ]


def label(job):
    """Label of a job, in a file of results and for people."""
    case, what = job
    if isinstance(what, OnPlants):
        return f"{case.arm}: {what.controller} on {len(what.variants)} plants"
    return f"{case.arm}: {what if isinstance(what, str) else ' + '.join(what)}"


def _do(job, seed):
    case, what = job
    if isinstance(what, OnPlants):
        found = on_plants(case, what, seed)
    elif isinstance(what, str):
        found = evaluate(case, what, seed)
    else:
        found = {"row": run(case, combinations.setup(case, what))}
    return [{"sample": label(job), "found": found}]


def study(options, progress, each=lambda found: None):
    """Tune and run all controllers; `each` is called with the results so far after every job.

    Returns the content of docs/comparison.json: ``seed``, and a list of cases, each with ``arm``, ``motion``,
    ``rate_Hz``, ``window_s``, ``budget``, the controllers by name, the list ``combinations``, and the rows ``plants``.
    """
    wanted, names, on, variants = wanted_of(options)
    jobs = jobs_of(wanted, names, on, variants)
    kinds = [asdict(case) | {"variants": list(variants)} for case in wanted]
    keep = Store(options.out, Specification(options.seed, kinds))

    def gathered():
        return {"seed": options.seed, "cases": [_of_arm(s, jobs, keep.results) for s in wanted]}

    calls = [(job, options.seed) for job in jobs if label(job) not in keep.results]
    done = len(jobs) - len(calls)
    for i, _ in gather(keep, _do, calls, options.workers, options.scheduler):
        done += 1
        progress.step(label(calls[i][0]), done, len(jobs))
        each(gathered())
    progress.done()
    return gathered()


def _of_arm(case, jobs, results):
    """Rows of the finished jobs of a case, in the jobs' order."""
    mine = [
        (what, results[label((s, what))]["found"])
        for s, what in jobs
        if s == case and label((s, what)) in results
    ]
    return {
        "arm": case.arm,
        "motion": case.motion,
        "rate_Hz": case.rate,
        "window_s": case.window,
        "budget": case.budget,
        "controllers": {what: found for what, found in mine if isinstance(what, str)},
        "combinations": [
            dict(zip(combinations.PARTS, what, strict=True)) | found
            for what, found in mine
            if isinstance(what, tuple)
        ],
        "plants": [row for what, found in mine if isinstance(what, OnPlants) for row in found],
    }


def main(argv=None):
    """Run it without the other commands; for tests."""
    parser = argparse.ArgumentParser(prog="flexarm compare")
    add_arguments(parser)
    compare(parser.parse_args(argv))
