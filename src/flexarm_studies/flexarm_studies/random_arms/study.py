# SPDX-License-Identifier: Apache-2.0
"""Many random arms under many controllers: every run a line of a file, and none is run twice.

A run is known by the arm's number, the controller and the variant; with the seed these decide its result, whatever the
number of workers. The file's first line holds the seed. Results of changed code need a new file: nothing notices that a
line is older than the code.
"""

import os
import time
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError

from ..analysis.monte_carlo import Store
from ..commands.options import at_least
from ..workers import processes
from . import generator, trial
from .controllers import CONTROLLERS


@dataclass(frozen=True)
class Specification:
    """What all runs of a file have in common."""

    random_arms_seed: int = 0


def key(number, controller, variant):
    """Of a run, in the file."""
    return f"{number}/{controller}/{variant}"


def job(seed, number, controller, variants):
    """Set a controller up for one arm and run these variants; also called in other processes.

    Returns
    -------
    list of dict
        Rows, each with ``sample`` (its `key`), ``number``, ``arm``, ``controller``, ``variant``, ``seconds`` of
        computing, and what `trial.run` returns.
    """
    case = generator.arm(number, seed)
    begin, refused, setup = time.monotonic(), None, None
    try:
        setup = CONTROLLERS[controller](case)
    except FlexarmError as error:
        refused = str(error)
    rows = []
    for variant in variants:
        if refused is None:
            found = trial.run(case, setup, trial.VARIANTS[variant], seed=number)
        else:
            found = {"refused": refused}
        now = time.monotonic()
        rows.append(
            {
                "sample": key(number, controller, variant),
                "number": number,
                "arm": case.name,
                "controller": controller,
                "variant": variant,
                "seconds": round(now - begin, 3),
                **found,
            }
        )
        begin = now
    return rows


def run(seed, count, controllers, variants, path=None, workers=None, progress=None):
    """Run arms 0 to count - 1 under all `controllers` in all `variants`.

    Parameters
    ----------
    seed, count : int
    controllers, variants : sequence of str
    path : str or Path, optional
        File of rows, JSON lines; runs that are in it are not run again.
    workers : int, optional
        Number of processes; one per core if not given. 1: everything in this process.
    progress : Progress, optional

    Returns
    -------
    list of dict
        Rows by arm, controller and variant.
    """
    for name, value, least in (("seed", seed, 0), ("count", count, 1), ("workers", workers, 1)):
        at_least(f"--{name}", value, least)
    keep = None if path is None else Store(Path(path), Specification(seed))
    found = {} if keep is None else dict(keep.results)
    jobs = []
    for number in range(count):
        for controller in controllers:
            left = [v for v in variants if key(number, controller, v) not in found]
            if left:
                jobs.append((seed, number, controller, left))
    try:
        for i, rows in enumerate(_results(jobs, workers), 1):
            for row in rows:
                found[row["sample"]] = row
                if keep is not None:
                    keep.append(row)
            if progress is not None:
                progress.step(f"{rows[0]['arm']}: {rows[0]['controller']}", i, len(jobs))
    finally:
        if keep is not None:
            keep.close()
    return [found[key(n, c, v)] for n in range(count) for c in controllers for v in variants]


def _results(jobs, workers):
    """Rows of each job as they come."""
    workers = min(workers or os.cpu_count() or 1, len(jobs))
    if workers <= 1:
        yield from (job(*each) for each in jobs)
        return
    with processes(workers) as executor:
        for future in as_completed([executor.submit(job, *each) for each in jobs]):
            yield future.result()
