# SPDX-License-Identifier: Apache-2.0
"""``flexarm attack``: runs a driver that lies, on every arm, under every observer."""

import json
import os
from concurrent.futures import as_completed
from functools import cache
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError

from ..commands.options import at_least
from ..progress import Progress
from ..workers import processes
from . import report
from .cases import ARMS, arm_of, chosen, observers
from .lies import LIES, random_lies


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Simulates arms whose driver lies, users that stop and strangers that interfere, and judges"
        " what the arm does until it rests."
    )
    parser.epilog = (
        "example: flexarm attack --arms R --observers kalman --lies encoder,~/stop\n"
        "exit code 1: a criterion does not hold"
    )
    add = parser.add_argument
    add("--arms", help=f"separated by commas ({','.join(ARMS)})")
    add("--observers", help=f"separated by commas ({','.join(observers())})")
    add("--lies", help="those whose names have one of these texts, separated by commas (all)")
    add("--list", action="store_true", help="list the lies, and do nothing else")
    add(
        "--cover",
        action="store_true",
        help="a tenth of the runs: every lie under every observer and on every arm once or more, moments in turn",
    )
    add("--random", type=int, default=0, metavar="N", help="so many random lies beside them (0)")
    add("--healthy", type=int, metavar="SAMPLES", help="no lies: count alarms in healthy samples")
    add(
        "--recoil",
        action="store_true",
        help="no lies: how fast bent links turn joints that were held, which no control prevents",
    )
    add("--seed", type=int, default=0, help="of random lies and healthy runs (0)")
    add("--workers", type=int, metavar="N", help="processes (one per core)")
    add(
        "--json",
        metavar="FILE",
        help="write every run; with --healthy one a line, and go on where the file ends",
    )
    add(
        "--from",
        dest="stored",
        nargs="+",
        metavar="FILE",
        help="take runs that --json wrote, of one study or several; run nothing",
    )
    add("--write", metavar="FILE", help="write the table between the markers of this file")
    add("--note", metavar="FILE", help="write the table, worst on top, and the worst runs to FILE")


def attack(options):
    """Run the sub-command; return the exit code."""
    at_least("--random", options.random, 0)
    at_least("--workers", options.workers, 1)
    at_least("--healthy", options.healthy, 1)
    wanted = _lies(options)
    if options.list:
        print("\n".join(f"{lie.kind:13}{lie.name}" for lie in wanted.values()))
        return 0
    if options.stored:
        return _report(options, [row for file in options.stored for row in _stored(file)])
    cases = chosen(_split(options.arms), _split(options.observers))
    if options.recoil:
        from . import recoil

        return recoil.report(cases, options.write)
    if options.healthy:
        from .healthy import healthy

        return healthy(options, cases)
    todo = cover(cases, wanted) if options.cover else jobs(cases, wanted)
    # After every few runs, so an interrupted study loses nothing.
    rows = study(todo, options.workers, lambda rows: _store(options, rows))
    return _report(options, rows)


def _stored(file):
    """Rows that `--json` wrote."""
    try:
        rows = json.loads(Path(file).read_text(encoding="utf-8"))
        report.summary(rows)
        return rows
    except (ValueError, LookupError, TypeError) as error:
        raise FlexarmError(f"was not written by --json: {error}", field=file) from None


def _store(options, rows):
    """Write the requested files, for all runs or for those done so far."""
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    if options.note:
        report.note(options.note, rows)


def _report(options, rows):
    """Write and print what the runs show; return the exit code."""
    entries = report.summary(rows)
    _store(options, rows)
    if options.write:
        report.write(options.write, entries)
    print("\n".join([*report.table(entries), "", *report.worst_runs(rows)]))
    return int(any(row["failed"] for row in rows))


def _split(text):
    return None if text is None else [word.strip() for word in text.split(",")]


def _lies(options):
    """The requested lies, by name."""
    known = LIES | random_lies(options.random, options.seed)
    words = _split(options.lies)
    wanted = {k: v for k, v in known.items() if words is None or any(w in k for w in words)}
    if not wanted:
        limit = ", ".join(known)
        raise FlexarmError("names no lie", field="--lies", value=options.lies, limit=limit)
    return wanted


def jobs(cases, wanted):
    """(case, lie, moment, pick) of every run; runs of the same case are adjacent."""
    found = {}
    for case in cases:
        for lie in wanted.values():
            own = _case_of(lie, case)
            if lie.suits(own, arm_of(own.arm, own.noise)):
                found.setdefault(own, []).extend((own, lie, moment) for moment in lie.moments)
    # Several cases may have the same run of a lie: with modal rates, the observer is always `true_rates`.
    return [job for own in found.values() for job in dict.fromkeys(own)]


def cover(cases, wanted):
    """A part of the `jobs`: each lie once under each observer, with arms, measured velocity and moments in turn.

    If ``cases`` has at least as many observers as arms, each lie of ``wanted`` also occurs on each arm.
    """
    arms = tuple(dict.fromkeys(case.arm for case in cases))
    names = tuple(dict.fromkeys(case.observer for case in cases))
    chosen = []
    for i, lie in enumerate(wanted.values()):
        own = jobs(cases, {lie.name: lie})
        for j, name in enumerate(names):
            # What the job should have: this observer, this arm, with or without velocity, this moment.
            turn = (
                arms[(i + j) % len(arms)],
                bool((i // 3 + j) % 2),
                lie.moments[(i + j) % len(lie.moments)],
            )
            wish = (name, *turn)
            chosen.append(max(own, key=lambda job: _alike(job, wish), default=None))
    found = {}
    for job in dict.fromkeys(filter(None, chosen)):
        found.setdefault(job[0], []).append(job)
    return [job for own in found.values() for job in own]


def _alike(job, wish):
    """Which parts of a wish a job fulfils: observer, arm, velocity and moment, in this order."""
    case, _, moment = job
    return tuple(
        a == b for a, b in zip((case.observer, case.arm, case.velocity, moment), wish, strict=True)
    )


def _case_of(lie, case):
    from .run import case_of

    return case_of(lie, case)


def study(todo, workers=None, store=lambda rows: None):
    """Run jobs in processes, `workers` or one per core; return the rows in the order of `todo`, that of `jobs`.

    A case whose motion fails without a lie is reported, and has no rows: there is nothing to compare with. The rows so
    far are passed to `store` each time some are added.
    """
    progress = Progress()
    parts = _parts(todo)
    rows = {}
    total = len(todo)
    progress.step(f"{total} runs of {len({lie.name for _, lie, _ in todo})} lies")
    with processes(workers or os.cpu_count() or 1) as executor:
        running = {executor.submit(run_all, part): part for part in parts}
        for future in as_completed(running):
            found = future.result()
            rows |= dict(zip(running[future], found, strict=True))
            progress.step(str(running[future][0][0]), len(rows), total)
            store([row for job in todo if (row := rows.get(job))])
    progress.done()
    return [row for job in todo if (row := rows[job])]


#: Number of runs that go to a process at once: each process runs a case's motion without a lie only once.
AT_ONCE = 6


def _parts(todo):
    """Runs of one case, in small lists."""
    parts = []
    for job in todo:
        if not parts or parts[-1][0][0] != job[0] or len(parts[-1]) == AT_ONCE:
            parts.append([])
        parts[-1].append(job)
    return parts


@cache
def _honest(case):
    from .run import Honest

    return Honest(case)


def run_all(part):
    """Rows of the runs of one case, in a process of its own; each is None if the motion without a lie fails."""
    from .run import attack as run

    case = part[0][0]
    try:
        honest, problem = _honest(case), _honest(case).problem
    except FlexarmError as error:
        problem = str(error)
    if problem:
        print(f"not attacked: {case}: the honest motion: {problem}", flush=True)
        return [None] * len(part)
    return [run(honest, lie, moment) for _, lie, moment in part]
