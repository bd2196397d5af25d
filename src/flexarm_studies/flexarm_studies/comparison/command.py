# SPDX-License-Identifier: Apache-2.0
"""``flexarm compare``: tunes everyone alike, runs everyone, and writes the table."""

import argparse
import json
import os
import sys
from concurrent.futures import as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError

from ..progress import Progress
from ..workers import processes
from . import combinations, report, subjects
from .contenders import CONTENDERS, PREVIEW, prepared
from .trial import run
from .tuning import tune

#: Of `--quick`: one arm, so many simulations each, watched so long [s].
QUICK, QUICK_BUDGET, QUICK_WINDOW = "R", 2, 0.2


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Runs every controller on the same arms, motions, limits and sensors, and writes a table."
    )
    parser.epilog = "example: flexarm compare --arms R --json results/compare.json"
    add = parser.add_argument
    arms = ",".join(s.arm for s in subjects.SUBJECTS)
    add("--arms", default=arms, help=f"which, separated by commas ({arms})")
    add("--contenders", help="which, separated by commas; none (all)")
    add("--budget", type=int, metavar="N", help="simulations per contender (by arm)")
    add("--seed", type=int, default=0, help="of the tuning and of the noise (0)")
    add("--workers", type=int, metavar="N", help="processes (one per core)")
    add("--quick", action="store_true", help=f"{QUICK} alone, next to no tuning: that it works")
    add("--no-combinations", action="store_true", help="the rivals alone")
    add("--json", metavar="FILE", help="write rows and gains")
    add("--write", metavar="FILE", help="write the tables between the markers of this file")
    add(
        "--from",
        dest="stored",
        nargs="+",
        metavar="FILE",
        help="take what --json wrote, of one run or of several for different rows; nothing is run",
    )


def compare(options):
    """Run the sub-command."""
    if options.stored:
        found = merged([load(path) for path in options.stored])
    else:
        # After every job: what an interrupted run has done is not lost.
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
    """Stored rows.

    Raises
    ------
    FlexarmError
        For a file that is none of ours.
    """
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
        found["subjects"][0]["contenders"]
        return found
    except (ValueError, LookupError, TypeError) as error:
        raise FlexarmError(f"{path}: not what --json wrote: {error}") from None


def merged(runs):
    """One comparison from several: rows of an arm that is in more than one of them are put together.

    Raises
    ------
    FlexarmError
        When they differ in more than which rows they have.
    """
    by_arm = {}
    for run_ in runs:
        for subject in run_["subjects"]:
            whole = by_arm.setdefault(
                subject["arm"], subject | {"contenders": {}, "combinations": []}
            )
            for name in ("motion", "rate_Hz", "window_s", "budget"):
                if whole[name] != subject[name] or runs[0]["seed"] != run_["seed"]:
                    raise FlexarmError(f"{subject['arm']}: the runs differ in {name} or seed")
            whole["contenders"] |= subject["contenders"]
            whole["combinations"] += subject["combinations"]
    order = [s.arm for s in subjects.SUBJECTS]
    return {
        "seed": runs[0]["seed"],
        "subjects": sorted(by_arm.values(), key=lambda s: order.index(s["arm"])),
    }


def chosen(options):
    """Subjects and contenders that were asked for."""
    if options.budget is not None and options.budget < 1:
        raise FlexarmError(f"--budget {options.budget}: 1 or more is wanted")
    if options.workers is not None and options.workers < 1:
        raise FlexarmError(f"--workers {options.workers}: 1 or more is wanted")
    if options.seed < 0:
        raise FlexarmError(f"--seed {options.seed}: 0 or more is wanted")
    names = list(CONTENDERS)
    if options.contenders == "none":
        names = []
    elif options.contenders:
        names = [name.strip() for name in options.contenders.split(",")]
        # "joint PID, ZV shaper" has a comma of its own.
        names = _joined(names)
    wanted = subjects.find([QUICK] if options.quick else options.arms.split(","))
    if options.quick:
        wanted = [replace(s, window=QUICK_WINDOW, depth="star") for s in wanted]
    budget = options.budget or (QUICK_BUDGET if options.quick else None)
    if budget:
        wanted = [replace(s, budget=budget) for s in wanted]
    if options.no_combinations:
        wanted = [replace(s, depth="none") for s in wanted]
    return wanted, names


def _joined(words):
    names, rest = [], list(words)
    while rest:
        for count in (2, 1):
            name = ", ".join(rest[:count])
            if name in CONTENDERS:
                names.append(name)
                del rest[:count]
                break
        else:
            raise FlexarmError(f"--contenders {rest[0]}: there are {'; '.join(CONTENDERS)}")
    return names


def jobs_of(wanted, names):
    """What there is to do, the longest first: (subject, contender's name or combination)."""
    tuned = [
        (s, name)
        for s in reversed(wanted)
        for name in names
        if name != PREVIEW or combinations.shipped(s)[-1] != "preview"
    ]
    parts = [(s, c) for s in reversed(wanted) for c in combinations.of(s)]
    return tuned + parts


def contend(subject, name, seed):
    """Tune a contender and run it, without noise and with; for other processes, too.

    Returns
    -------
    dict
        ``row`` and ``noisy`` as `trial.run` has them, ``gains`` by name, ``simulations``, ``first`` and ``best`` cost.
    """
    contender = CONTENDERS[name]
    free = contender.free(subject)

    def result(values, **noise):
        try:
            return run(subject, prepared(subject, name, values), **noise)
        except FlexarmError as error:
            return {"refused": str(error), "cost": 1e4}

    screen = contender.screen and partial(contender.screen, subject)
    values, history = [], []
    if free:
        values, _, history = tune(
            lambda values: result(values)["cost"], free, subject.budget, seed, screen
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
    subject, what = job
    if isinstance(what, str):
        return contend(subject, what, seed)
    return {"row": run(subject, combinations.setup(subject, what))}


def study(options, progress, each=lambda found: None):
    """Tune and run everyone.

    Parameters
    ----------
    options : namespace
    progress : Progress
    each : callable, optional
        Of what there is, called after every job.

    Returns
    -------
    dict
        Ready for JSON: ``seed``, and ``subjects``, a list of ``arm``, ``motion``, ``rate_Hz``, ``budget``,
        ``contenders`` by name and ``combinations``, a list.
    """
    wanted, names = chosen(options)
    jobs = jobs_of(wanted, names)
    results = {}
    workers = min(options.workers or os.cpu_count() or 1, len(jobs))
    for i, found in _results(jobs, options.seed, workers):
        results[i] = found
        subject, what = jobs[i]
        label = what if isinstance(what, str) else " + ".join(what)
        progress.step(f"{subject.arm}: {label}", len(results), len(jobs))
        each(_gathered(options.seed, wanted, jobs, results))
    progress.done()
    return _gathered(options.seed, wanted, jobs, results)


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


def _gathered(seed, wanted, jobs, results):
    """Rows by arm, of the jobs that are done; in the jobs' order, whichever came first."""
    return {"seed": seed, "subjects": [_of_arm(s, jobs, results) for s in wanted]}


def _of_arm(subject, jobs, results):
    mine = [(w, results[i]) for i, (s, w) in enumerate(jobs) if s == subject and i in results]
    return {
        "arm": subject.arm,
        "motion": subject.motion,
        "rate_Hz": subject.rate,
        "window_s": subject.window,
        "budget": subject.budget,
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
