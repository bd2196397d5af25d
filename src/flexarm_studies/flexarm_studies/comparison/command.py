# SPDX-License-Identifier: Apache-2.0
"""``flexarm compare``: tunes all controllers alike, runs them, and writes the table."""

import argparse
import json
import os
import sys
from concurrent.futures import as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError

from ..commands.options import at_least
from ..progress import Progress
from ..workers import processes
from . import cases, combinations, report
from .controllers import CONTROLLERS, PREVIEW, prepared
from .trial import REFUSED, run
from .tuning import tune

#: For `--quick`: the one arm, the number of simulations, and the window after the motion [s].
QUICK, QUICK_BUDGET, QUICK_WINDOW = "R", 2, 0.2


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Runs every controller on the same arms, motions, limits and sensors, and writes a table."
    )
    parser.epilog = "example: flexarm compare --arms R --json results/compare.json"
    add = parser.add_argument
    arms = ",".join(s.arm for s in cases.CASES)
    add("--arms", default=arms, help=f"arms, separated by commas ({arms})")
    add("--controllers", "--contenders", help="controllers, separated by commas; or none (all)")
    add("--budget", type=int, metavar="N", help="simulations per controller (depends on the arm)")
    add("--seed", type=int, default=0, help="seed of tuning and noise (0)")
    add("--workers", type=int, metavar="N", help="processes (one per core)")
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
        # After every job, so that an interrupted run loses nothing.
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
        found["subjects"][0]["contenders"]
        return found
    except (ValueError, LookupError, TypeError) as error:
        raise FlexarmError(f"was not written by --json: {error}", field=str(path)) from None


def merged(runs):
    """Merge `runs` into one comparison: rows of the same arm, which must agree in motion, rate, window and so on."""
    by_arm = {}
    for run_ in runs:
        for case in run_["subjects"]:
            whole = by_arm.setdefault(case["arm"], case | {"contenders": {}, "combinations": []})
            for name in ("motion", "rate_Hz", "window_s", "budget"):
                if whole[name] != case[name] or runs[0]["seed"] != run_["seed"]:
                    raise FlexarmError(f"the runs differ in {name} or seed", field=case["arm"])
            whole["contenders"] |= case["contenders"]
            whole["combinations"] += case["combinations"]
    order = [s.arm for s in cases.CASES]
    return {
        "seed": runs[0]["seed"],
        "subjects": sorted(by_arm.values(), key=lambda s: order.index(s["arm"])),
    }


def chosen(options):
    """The requested cases, and names of controllers."""
    for name, least in (("budget", 1), ("workers", 1), ("seed", 0)):
        at_least(f"--{name}", getattr(options, name), least)
    names = list(CONTROLLERS)
    if options.controllers == "none":
        names = []
    elif options.controllers:
        names = _joined([name.strip() for name in options.controllers.split(",")])
    wanted = cases.find([QUICK] if options.quick else options.arms.split(","))
    if options.quick:
        wanted = [replace(s, window=QUICK_WINDOW, depth="star") for s in wanted]
    budget = options.budget or (QUICK_BUDGET if options.quick else None)
    if budget:
        wanted = [replace(s, budget=budget) for s in wanted]
    if options.no_combinations:
        wanted = [replace(s, depth="none") for s in wanted]
    return wanted, names


def _joined(words):
    """Names of controllers from what stands between commas: "joint PID, ZV shaper" has a comma of its own."""
    names, rest = [], list(words)
    while rest:
        for count in (2, 1):
            name = ", ".join(rest[:count])
            if name in CONTROLLERS:
                names.append(name)
                del rest[:count]
                break
        else:
            known = "; ".join(CONTROLLERS)
            raise FlexarmError("is unknown", field="--controllers", value=rest[0], limit=known)
    return names


def jobs_of(wanted, names):
    """All jobs, the longest first: (case, controller's name or combination)."""
    tuned = [
        (s, name)
        for s in reversed(wanted)
        for name in names
        if name != PREVIEW or combinations.shipped(s)[-1] != "preview"
    ]
    parts = [(s, c) for s in reversed(wanted) for c in combinations.of(s)]
    return tuned + parts


def evaluate(case, name, seed):
    """Tune the controller `name` and run it without and with noise; also called in other processes.

    Returns ``row`` and ``noisy`` as `trial.run` has them, ``gains`` by name, ``simulations``, and the ``first`` and
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


def _do(job, seed):
    case, what = job
    if isinstance(what, str):
        return evaluate(case, what, seed)
    return {"row": run(case, combinations.setup(case, what))}


def study(options, progress, each=lambda found: None):
    """Tune and run all controllers; `each` is called with the results so far after every job.

    Returns what docs/comparison.json holds: ``seed``, and a list of cases, each with ``arm``, ``motion``, ``rate_Hz``,
    ``window_s``, ``budget``, the controllers by name, and the list ``combinations``.
    """
    wanted, names = chosen(options)
    jobs = jobs_of(wanted, names)
    results = {}
    workers = min(options.workers or os.cpu_count() or 1, len(jobs))

    def gathered():
        return {"seed": options.seed, "subjects": [_of_arm(s, jobs, results) for s in wanted]}

    for i, found in _results(jobs, options.seed, workers):
        results[i] = found
        case, what = jobs[i]
        label = what if isinstance(what, str) else " + ".join(what)
        progress.step(f"{case.arm}: {label}", len(results), len(jobs))
        each(gathered())
    progress.done()
    return gathered()


def _results(jobs, seed, workers):
    """(number, result) of every job as they come."""
    if workers == 1:
        for i, job in enumerate(jobs):
            yield i, _do(job, seed)
        return
    with processes(workers) as executor:
        waiting = {executor.submit(_do, job, seed): i for i, job in enumerate(jobs)}
        for future in as_completed(waiting):
            yield waiting[future], future.result()


def _of_arm(case, jobs, results):
    """Rows of the finished jobs of a case, in the jobs' order."""
    mine = [(w, results[i]) for i, (s, w) in enumerate(jobs) if s == case and i in results]
    return {
        "arm": case.arm,
        "motion": case.motion,
        "rate_Hz": case.rate,
        "window_s": case.window,
        "budget": case.budget,
        "contenders": {what: found for what, found in mine if isinstance(what, str)},
        "combinations": [
            dict(zip(combinations.PARTS, what, strict=True)) | found
            for what, found in mine
            if not isinstance(what, str)
        ],
    }


def main(argv=None):
    """Run it without the other commands; for tests."""
    parser = argparse.ArgumentParser(prog="flexarm compare")
    add_arguments(parser)
    compare(parser.parse_args(argv))
