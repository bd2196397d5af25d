# SPDX-License-Identifier: Apache-2.0
"""Runs many random arms under many controllers; every run is a line of a file, and none is run twice.

A run is identified by the arm's number, the controller and the variant. With the seed these determine its result,
whatever the number of workers. The file's first line contains the seed. Results of changed code need a new file:
nothing detects that a line is older than the code.
"""

from dataclasses import dataclass

from ..store import Store, gather
from ..uncertain.controllers import CONTROLLERS
from ..uncertain.runs import key, rows
from . import generator


@dataclass(frozen=True)
class Specification:
    """Settings that all runs of a file have in common."""

    random_arms_seed: int = 0


def job(seed, number, controller, variants):
    """Rows of one arm and controller in these variants; also called in other processes.

    Returns
    -------
    list of dict
        Those of `uncertain.runs.rows`, with the arm's ``number``.
    """
    case = generator.arm(number, seed)
    found = rows(case, number, controller, CONTROLLERS[controller], variants, seed=number)
    return [row | {"number": number} for row in found]


def run(
    seed, numbers, controllers, variants, path=None, workers=None, progress=None, scheduler=None
):
    """Run the arms with these `numbers` under all `controllers` in all `variants`.

    Parameters
    ----------
    seed : int
        0 or more.
    numbers : sequence of int
    controllers, variants : sequence of str
    path : str or Path, optional
        File of rows, JSON lines; runs that are in it are not run again.
    workers, scheduler
        As for `workers.results`.
    progress : Progress, optional

    Returns
    -------
    list of dict
        Rows by arm, controller and variant.
    """
    keep, jobs = Store(path, Specification(seed)), []
    # All arms under one controller, then under the next: so the second controller of an arm finds the design of the
    # first.
    for controller in controllers:
        for number in numbers:
            left = [v for v in variants if key(number, controller, v) not in keep.results]
            if left:
                jobs.append((seed, number, controller, left))
    for done, (i, _) in enumerate(gather(keep, job, jobs, workers, scheduler), 1):
        if progress is not None:
            progress.step(f"arm {jobs[i][1]}: {jobs[i][2]}", done, len(jobs))
    return [keep.results[key(n, c, v)] for n in numbers for c in controllers for v in variants]
