# SPDX-License-Identifier: Apache-2.0
"""``flexarm vibration``: measures how much arms behind a position loop swing after motions, shaped and not."""

from dataclasses import dataclass
from pathlib import Path

from .. import workers
from ..markdown import table, write_between
from ..progress import Progress
from ..store import Store, gather
from . import cases, figure, pushes, report, study


@dataclass(frozen=True)
class Specification:
    """What all results of a file have in common."""

    seed: int
    methods: tuple = study.METHODS


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Measures how arms behind a position loop (125 Hz, 8 ms) ring, moves them by planners' motions and by shaped "
        "ones, and compares what the tip swings afterwards: random arms, an elastic base, one link with payloads."
    )
    parser.epilog = "example: flexarm vibration --count 4 --out results/vibration.jsonl"
    add = parser.add_argument
    add("--count", type=int, default=20, help="random arms (20)")
    add("--seed", type=int, default=0, help="of the arms and motions (0)")
    workers.add_arguments(add)
    add(
        "--out",
        metavar="FILE.jsonl",
        help="write every result; those that are in it are not computed again",
    )
    add(
        "--methods",
        nargs="+",
        choices=list(report.WANTED),
        metavar="METHOD",
        help="only these, beside the motion as it is: "
        + ", ".join(f"'{name}'" for name in report.WANTED).replace("%", "%%"),
    )
    add("--fresh", action="store_true", help="remove that file first: after a change of the code")
    add("--write", metavar="FILE.md", help="write the tables between the markers of this file")
    add("--pushes", action="store_true", help="push one link, with damping by strain and without")
    add(
        "--more-time",
        action="store_true",
        help="what retimed leaves in more than a period, of the motions that it misses; --out has the results",
    )
    add(
        "--more-places",
        action="store_true",
        help="what retimed leaves of the motions that it misses by modes at more places; --out has the results",
    )
    add(
        "--trials",
        action="store_true",
        help="what retimed leaves of the motions that it misses, corrected in trials; --out has the results",
    )
    add(
        "--limit",
        action="store_true",
        help="the least that any time law is found to leave of the motions that retimed misses; --out has the results",
    )
    add(
        "--bent",
        action="store_true",
        help="paths that bend, shaped by the modes of both ends",
    )
    add("--figure", metavar="FILE", help="draw one arm's tip before and after, .svg or .png")


def vibration(options):
    """Run the sub-command."""
    if options.figure:
        print(figure.draw(options.figure, options.seed))
        return
    if options.pushes:
        decays = [pushes.decay(payload, options.seed) for payload in pushes.PAYLOADS]
        if options.write:
            pushes.write(decays, options.write)
        print(pushes.text(decays))
        return
    if options.bent:
        made = cases.all_of(options.count, options.seed).values()
        rows = [row for make in made for row in study.run_bent(make())]
        lines = table(report.COLUMNS, report.summary(rows))
        _show(lines, options.write, report.BENT)
        return
    if options.out and options.fresh:
        Path(options.out).unlink(missing_ok=True)
    methods = (study.METHODS[0], *options.methods) if options.methods else study.METHODS
    rows = run(
        options.seed, options.count, options.out, options.workers, options.scheduler, methods
    )
    missed = {
        _more_time: options.more_time,
        _more_places: options.more_places,
        _in_trials: options.trials,
        _limits: options.limit,
    }
    made = next((each for each, wanted in missed.items() if wanted), None)
    if made is not None:
        lines, where = made(rows, options.count, options.seed)
        _show(lines, options.write, where)
        return
    if options.write:
        report.write(rows, options.write)
    print(report.text(rows))


def _show(lines, path, where):
    """Print lines, and write them between the markers `where` of a file, if there is one."""
    if path:
        write_between(path, *where, "\n".join(lines))
    print("\n".join(lines))


def _more_time(rows, count, seed):
    """The table of what `retimed` leaves in `report.TIMES`, for motions above its wanted residual, and its markers."""
    known, missed = _missed(rows, count, seed, ("retimed",))
    found = [
        (row, study.in_more_time(known[row["arm"]], row["motion"], report.TIMES)) for row in missed
    ]
    return report.time_table(found), report.TIME


def _more_places(rows, count, seed):
    """The table of what `retimed` leaves with modes at `report.PLACES`, for motions that it misses, and its markers."""
    known, missed = _missed(rows, count, seed, report.LISTED)
    found = [
        (row, study.at_more_places(known[row["arm"]], row["motion"], report.PLACES, off))
        for row, off in ((row, study.OFFS[row["method"]]) for row in missed)
    ]
    return report.places_table(found), report.PLACED


def _limits(rows, count, seed):
    """The table of the least that a time law leaves, for the motions that `retimed` misses, and its markers."""
    known, missed = _missed(rows, count, seed, ("retimed",))
    found = [(row, study.at_least(known[row["arm"]], row["motion"])) for row in missed]
    return report.limit_table(found), report.LIMIT


def _in_trials(rows, count, seed):
    """The table of what `retimed` leaves after corrections, for motions above its wanted residual, and its markers."""
    known, missed = _missed(rows, count, seed, report.LISTED)
    found = [
        (row, study.in_trials(known[row["arm"]], row["motion"], report.CORRECTIONS, off))
        for row, off in ((row, study.OFFS[row["method"]]) for row in missed)
    ]
    return report.trials_table(found), report.TRIALS


def _missed(rows, count, seed, methods):
    """Cases by name, and the rows of motions that some methods miss, that is, that exceed the wanted residual."""
    known = {case.name: case for case in (make() for make in cases.all_of(count, seed).values())}
    return known, [row for row, _ in report.missed(rows, methods)]


def run(seed, count, path=None, processes=None, scheduler=None, methods=study.METHODS):
    """Results of all cases.

    Parameters
    ----------
    seed, count : int
        Seed and number of the random arms.
    path : str, optional
        File of the results, see `Store`.
    processes, scheduler
        As of `workers.results`.
    methods : sequence of str
        As of `study.run`.

    Returns
    -------
    list of dict
        Rows as of `study.run`.
    """
    keep, progress = Store(path, Specification(seed, methods)), Progress()
    progress.step("arms behind a position loop")
    names = list(cases.all_of(count, seed))
    missing = [name for name in names if name not in keep.results]
    calls = [(name, count, seed, methods) for name in missing]
    for done, _ in enumerate(gather(keep, _rows_of, calls, processes, scheduler), 1):
        progress.fraction(done / len(missing))
    progress.done()
    return [row for name in names for row in keep.results[name]["rows"]]


def _rows_of(name, count, seed, methods):
    """In a worker: the result of one case."""
    return [{"sample": name, "rows": study.run(cases.all_of(count, seed)[name](), methods)}]
