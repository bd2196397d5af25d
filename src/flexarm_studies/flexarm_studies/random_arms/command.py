# SPDX-License-Identifier: Apache-2.0
"""``flexarm arms``: runs random arms under several controllers, on plants that are not their models."""

from pathlib import Path

from .. import workers
from ..commands.options import at_least, chosen, whole_numbers
from ..progress import Progress
from ..uncertain.controllers import CONTROLLERS
from ..uncertain.plants import VARIANTS
from . import generator, report, study

#: Controllers and plants of the table, unless others are requested.
USUAL = ("default", "preview", "designed", "designed_preview", "pid_zvd", "pid_ei", "lqr")
PLANTS = (
    "exact",
    "payload x0.7",
    "payload x1.3",
    "stiffness x0.9",
    "stiffness x1.1",
    "damping x0.3",
    "damping x3",
    "noisy",
)


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Draws arms at random, runs controllers on plants that are not their models, and writes a table: "
        "how many arms work, are refused, are lost, settle, and when."
    )
    parser.epilog = (
        "examples:\n"
        "  flexarm arms --count 8 --controllers default,pid_zvd --variants 'exact,payload x1.3'\n"
        "  flexarm arms --count 16 --files results/arms\n"
        "  flexarm arms --arms 0-4,8 --controllers designed_preview --out results/arms.jsonl\n"
        "  flexarm arms --arms 0-4,8 --controllers designed_preview --designs docs/random_arms_designs.jsonl"
    )
    add = parser.add_argument
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--count", type=int, default=100, help="arms (100)")
    which.add_argument("--arms", metavar="NUMBERS", help="these arms of the seed alone: 0-4,8")
    add("--seed", type=int, default=0, help="of the arms and of the noise (0)")
    workers.add_arguments(add)
    usual, names = ",".join(USUAL), ", ".join(CONTROLLERS)
    add(
        "--controllers",
        default=usual,
        help=f"controllers, separated by commas ({usual}) of {names}",
    )
    usual, names = ",".join(PLANTS), ", ".join(VARIANTS)
    add("--variants", default=usual, help=f"plants, separated by commas ({usual}) of {names}")
    add(
        "--out",
        metavar="FILE.jsonl",
        help="write every run; runs that are in it are not run again, so an interrupted command goes on",
    )
    add(
        "--designs",
        metavar="FILE.jsonl",
        help="designed controllers have the gains of this file; those that it lacks are searched for and added to it",
    )
    add("--fresh", action="store_true", help="remove these files first: after a change of the code")
    add(
        "--write", metavar="FILE.md", help="write the table between the seed's markers of this file"
    )
    add(
        "--files",
        metavar="FOLDER",
        help="only write the arm files, with their motions; run nothing",
    )


def arms(options):
    """Run the sub-command."""
    at_least("--seed", options.seed, 0)
    at_least("--count", options.count, 1)
    numbers = whole_numbers("--arms", options.arms) if options.arms else range(options.count)
    if options.files:
        _write_files(options.seed, numbers, Path(options.files))
        return
    controllers = chosen("--controllers", options.controllers, CONTROLLERS)
    variants = chosen("--variants", options.variants, VARIANTS)
    for path in (options.out, options.designs):
        if path and options.fresh:
            Path(path).unlink(missing_ok=True)
    progress = Progress()
    rows = study.run(
        options.seed,
        numbers,
        controllers,
        variants,
        options.out,
        options.workers,
        progress,
        options.scheduler,
        options.designs,
    )
    progress.done()
    if options.write:
        report.write(rows, options.seed, options.write)
    print(report.text(rows, options.seed))


def _write_files(seed, numbers, folder):
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        arm = generator.arm(number, seed)
        path = folder / f"{arm.name}.yaml"
        path.write_text(f"# --trajectory {arm.motion}\n{arm.text}", encoding="utf-8")
        print(path)
