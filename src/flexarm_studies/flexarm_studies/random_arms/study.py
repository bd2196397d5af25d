# SPDX-License-Identifier: Apache-2.0
"""Runs many random arms under many controllers; every run is a line of a file, and none is run twice.

A run is identified by the arm's number, the controller and the variant. With the seed these determine its result,
whatever the number of workers. The file's first line contains the seed. Results of changed code need a new file:
nothing detects that a line is older than the code.

The search for gains is sensitive to rounding, so another processor may find other gains for the same arm. Therefore
designs can be kept in a file too, a line each. Runs with the designs of such a file are the same on every processor, up
to the rounding of the runs themselves, and take less time.
"""

from dataclasses import dataclass
from functools import partial

from flexarm_control.robust.default import Default
from flexarm_dynamics.errors import FlexarmError

from ..store import Store, gather
from ..uncertain.controllers import CONTROLLERS, DESIGNED, design_of, with_design
from ..uncertain.runs import key, rows
from . import generator


@dataclass(frozen=True)
class Specification:
    """Settings that all runs of a file have in common."""

    random_arms_seed: int = 0


def design_job(seed, number):
    """Row of an arm's design; also called in other processes.

    Returns
    -------
    list of dict
        One row, with ``sample``, ``number``, ``arm``, and either the fields of `Default` or ``refused``.
    """
    case = generator.arm(number, seed)
    row = {"sample": str(number), "number": number, "arm": case.name}
    try:
        return [row | design_of(case)._asdict()]
    except FlexarmError as error:
        return [row | {"refused": str(error)}]


def job(seed, number, controller, variants, design=None):
    """Rows of one arm and controller in these variants; also called in other processes.

    Parameters
    ----------
    seed, number : int
    controller : str
    variants : sequence of str
    design : dict, optional
        Row of `design_job` for a controller of `DESIGNED`; None: the design is taken from the cache, or made.

    Returns
    -------
    list of dict
        Those of `uncertain.runs.rows`, with the arm's ``number``.
    """
    case = generator.arm(number, seed)
    make = CONTROLLERS[controller] if design is None else partial(_setup, controller, design)
    found = rows(case, number, controller, make, variants, seed=number)
    return [row | {"number": number} for row in found]


def _setup(controller, design, case):
    """`Setup` of a controller from the row of its `design`."""
    if "refused" in design:
        raise FlexarmError(design["refused"])
    return with_design(controller, Default(**{name: design[name] for name in Default._fields}))


def _designs(seed, numbers, path, workers, progress, scheduler):
    """Rows of `design_job` by the arm's number, from the file, or made and added to it."""
    keep = Store(path, Specification(seed))
    for row in keep.results.values():
        if "refused" not in row and not {"number", *Default._fields} <= row.keys():
            keep.close()
            raise FlexarmError(
                "not a file of designs",
                field=str(path),
                hint="use another --designs; results of runs belong to --out",
            )
    jobs = [(seed, number) for number in numbers if str(number) not in keep.results]
    for done, (i, _) in enumerate(gather(keep, design_job, jobs, workers, scheduler), 1):
        if progress is not None:
            progress.step(f"arm {jobs[i][1]}: design", done, len(jobs))
    return {row["number"]: row for row in keep.results.values()}


def run(
    seed,
    numbers,
    controllers,
    variants,
    path=None,
    workers=None,
    progress=None,
    scheduler=None,
    designs=None,
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
    designs : str or Path, optional
        File of designs, JSON lines. The controllers of `DESIGNED` have the designs of this file. Those that it lacks
        are made first, and added to it.

    Returns
    -------
    list of dict
        Rows by arm, controller and variant.

    Raises
    ------
    FlexarmError
        If a file is of another seed, or no file of rows or designs.
    """
    keep, jobs, made = Store(path, Specification(seed)), [], {}
    if designs is not None and any(name in DESIGNED for name in controllers):
        made = _designs(seed, numbers, designs, workers, progress, scheduler)
    # All arms under one controller, then under the next: so the second controller of an arm finds the design of the
    # first.
    for controller in controllers:
        for number in numbers:
            left = [v for v in variants if key(number, controller, v) not in keep.results]
            if left:
                design = made.get(number) if controller in DESIGNED else None
                jobs.append((seed, number, controller, left, design))
    for done, (i, _) in enumerate(gather(keep, job, jobs, workers, scheduler), 1):
        if progress is not None:
            progress.step(f"arm {jobs[i][1]}: {jobs[i][2]}", done, len(jobs))
    return [keep.results[key(n, c, v)] for n in numbers for c in controllers for v in variants]
