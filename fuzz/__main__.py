# SPDX-License-Identifier: Apache-2.0
"""The fuzzing command; see ``python -m fuzz --help``.

The unit tests use hypothesis, but this command does not. With all checks, hypothesis gives the torque reader 300 inputs
per second, even if it draws only a seed for each; the loop below gives 1600. A million inputs must end within hours,
and each must be reproducible from its number alone.
"""

import argparse
import re
import sys
import time
import traceback

from . import reader as frame
from .reader import Violation
from .tally import Tally


def readers():
    """Every reader's class by name."""
    from . import control, driver, files, messages, trajectories

    kinds = (
        messages.States,
        messages.Torques,
        messages.Gate,
        trajectories.Points,
        trajectories.Reference,
        trajectories.YamlFiles,
        trajectories.CsvFiles,
        trajectories.Written,
        files.Arms,
        files.Models,
        files.Archives,
        files.Parameters,
        files.ParameterFiles,
        files.Csv,
        files.Messages,
        files.Driver,
        control.Observers,
        control.Controllers,
        control.Designs,
        driver.Lines,
    )
    return {kind.name: kind for kind in kinds}


def parser():
    """The argument parser."""
    top = argparse.ArgumentParser(
        prog="python -m fuzz",
        description="Give every reader of messages and files malformed input; none may do more than refuse it.",
        epilog="Exit code 1: a property does not hold; the last lines say how to repeat it.",
    )
    top.add_argument("--inputs", type=int, default=1_000_000, help="of all readers together")
    top.add_argument("--seed", type=int, default=1)
    top.add_argument("--only", metavar="READER", help="this one alone, with all the inputs")
    top.add_argument(
        "--at", type=int, metavar="N", help="with --only: run N alone, with its traceback"
    )
    top.add_argument(
        "--dds", type=int, default=0, metavar="N", help="then N messages to running nodes"
    )
    top.add_argument("--list", action="store_true", help="list the readers")
    return top


NUMBER = re.compile(r"[-+]?\d[\d.e+-]*")
#: A reader that has failed this often gets no more inputs.
ENOUGH = 100


def fuzz(kind, inputs, seed):
    """Give one reader a number of inputs; return the `Tally`.

    Parameters
    ----------
    kind : type
        A `Reader`.
    inputs : int
    seed : int
    """
    reader, tally = kind(), Tally(kind.name)
    started = time.perf_counter()
    for number in range(-(-inputs // kind.batch)):
        tally.inputs += kind.batch
        try:
            tally.refused += reader.run(frame.generator(seed, kind.name, number))
        except Exception as error:
            tally.failures += 1
            tally.first.setdefault(_kind(error), _failure(reader, error, seed, number))
            if tally.failures >= ENOUGH:
                break
            reader.renew()
    tally.seconds = time.perf_counter() - started
    return tally


def _kind(error):
    """The kind of a failure, without numbers and names: it groups failures that have the same cause."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    return type(error).__name__, where.filename, where.lineno, NUMBER.sub("#", str(error))[:24]


def _failure(reader, error, seed, number):
    kind = "" if isinstance(error, Violation) else f"{type(error).__name__}: "
    frames = traceback.extract_tb(error.__traceback__)
    where = " < ".join(f"{f.filename.rsplit('/', 1)[-1]}:{f.lineno}" for f in frames[:-5:-1])
    return (
        f"{reader.name}, input {number} of seed {seed}: {kind}{str(error)[:400]}\n"
        f"  at {where}\n"
        f"  given: {frame.show(getattr(reader, 'given', None))}\n"
        f"  again: python -m fuzz --only '{reader.name}' --seed {seed} --at {number}"
    )


def inputs_of(kinds, inputs):
    """Number of inputs that each reader gets."""
    whole = sum(kind.weight for kind in kinds)
    return {kind: max(kind.batch, round(inputs * kind.weight / whole)) for kind in kinds}


def main(arguments=None):
    """Run the command; returns the exit code."""
    options = parser().parse_args(arguments)
    every = readers()
    if options.list:
        print("\n".join(every))
        return 0
    if options.only and options.only not in every:
        print(f"no reader {options.only!r}: there are {', '.join(every)}", file=sys.stderr)
        return 2
    kinds = [every[options.only]] if options.only else list(every.values())
    if options.at is not None:
        if not options.only:
            print("--at goes with --only: which reader's?", file=sys.stderr)
            return 2
        return again(kinds[0], options.seed, options.at)
    tallies = []
    print(
        f"{'reader':20}{'inputs':>9}{'refused':>9}{'accepted':>9}{'failures':>9}{'s':>8}",
        flush=True,
    )
    for kind, count in inputs_of(kinds, options.inputs).items():
        tallies.append(fuzz(kind, count, options.seed))
        print(line(tallies[-1]), flush=True)
    if options.dds:
        from . import nodes

        tallies += nodes.fuzz(options.dds, options.seed, lambda t: print(line(t), flush=True))
    for text in (text for tally in tallies for text in tally.first.values()):
        print(f"\n{text}")
    return 1 if any(t.failures for t in tallies) else 0


def line(tally):
    """A row of the table."""
    return (
        f"{tally.name:20}{tally.inputs:9}{tally.refused:9}{tally.accepted:9}{tally.failures:9}"
        f"{tally.seconds:8.1f}"
    )


def again(kind, seed, number):
    """Run one input again, and let its error propagate."""
    reader = kind()
    try:
        refused = reader.run(frame.generator(seed, kind.name, number))
    finally:
        print(f"given: {frame.show(getattr(reader, 'given', None))}")
    print(f"{refused} of {kind.batch} refused")
    return 0


if __name__ == "__main__":
    from flexarm_ros.start import leave_after

    leave_after(lambda: sys.exit(main()))
