# SPDX-License-Identifier: Apache-2.0
"""The soak command; see ``python -m soak --help``."""

import argparse
import sys
import tempfile
import time

from flexarm_dynamics.errors import FlexarmError

#: A process's memory may grow by this much, because the allocator's own use varies that much [MiB].
FLAT = 8.0
#: Timeout of each wait, on a busy machine [s].
PATIENCE = 180.0
#: Time between two lines of progress [s].
REPORT = 10.0


def parser():
    """The argument parser."""
    top = argparse.ArgumentParser(
        prog="python -m soak",
        description="Random motions, parameters and faults for the nodes in lockstep; invariants at every sample.",
        epilog="Exit code 1: an invariant does not hold, a process died, or the loop did not go on.",
    )
    top.add_argument("--minutes", type=float, default=30.0, help="of wall time")
    top.add_argument("--rounds", type=int, help="so many rounds, however long they take")
    top.add_argument("--seed", type=int, default=1)
    top.add_argument("--arm", default="R")
    top.add_argument("--without-faults", action="store_true", help="motions and parameters alone")
    top.add_argument(
        "--walk", type=int, metavar="STEPS",
        help="instead: so many random transitions, services, parameter sets and motions, in this process",
    )  # fmt: skip
    return top


def soak(options, say):
    """Run the rounds; return the `Soak`, and why it ended early (empty if it did not)."""
    from . import run

    with tempfile.TemporaryDirectory(prefix="soak-") as folder, run.harness.Bench(folder) as bench:
        bench.patience = max(bench.patience, PATIENCE)
        life = run.Soak(bench, options.seed, options.arm, not options.without_faults)
        begun = reported = time.monotonic()
        end, trouble = begun + 60.0 * options.minutes, ""
        try:
            while time.monotonic() < end and life.rounds != options.rounds:
                life.trouble()
                life.prove()
                if time.monotonic() - reported >= REPORT:
                    reported = time.monotonic()
                    life.look()
                    say(progress(life, reported - begun))
        except (AssertionError, FlexarmError) as error:
            trouble = str(error)
        life.drain()
        return life, trouble


def progress(life, wall):
    """A line of progress after `wall` seconds."""
    memory = ", ".join(f"{name} {mib:.0f} MiB" for name, mib in life.memory[-1].items())
    counts = life.invariants.counts
    return (
        f"{wall:6.0f} s: {life.rounds} rounds, {life.seconds:.0f} s simulated, {counts['torques']} torques,"
        f" {counts['enabled']} enabled, {life.recoveries} recoveries, {sum(life.invariants.broken.values())}"
        f" broken; {memory}; {life.shared[-1]} files in shared memory"
    )


def report(life, trouble):
    """The final table as lines, and whether all is well."""
    judge, good = life.invariants, not trouble
    grown, files = life.growth()
    lines = [f"{'rounds':36}{life.rounds}", f"{'healthy motions':36}{life.motions}"]
    lines += [f"{'simulated [s]':36}{life.seconds:.1f}", f"{'recoveries':36}{life.recoveries}"]
    lines += [f"{'parameters refused':36}{life.refusals}"]
    lines += [f"{name:36}{count}" for name, count in sorted(judge.counts.items())]
    for name, mib in grown.items():
        lines.append(f"{f'memory of {name} after warm-up [MiB]':36}{mib:+.1f}")
        good &= mib < FLAT
    if grown:
        lines.append(f"{'files in shared memory':36}{files:+d}")
        good &= files <= 0
    for name, count in judge.broken.items():
        lines.append(f"BROKEN {name}: {count} times; first {judge.first[name]}")
    good &= not judge.broken
    if trouble:
        lines.append(f"ENDED EARLY in round {life.rounds + 1}: {trouble}")
    return lines, good


def main(arguments=None):
    """Run the command; returns the exit code."""
    options = parser().parse_args(arguments)
    if options.walk:
        from .walk import walk

        lines, good = walk(
            options.seed, options.walk, lambda text: print(text, flush=True), options.arm
        )
        print("\n".join(lines))
        return 0 if good else 1
    life, trouble = soak(options, lambda text: print(text, flush=True))
    lines, good = report(life, trouble)
    print("\n".join(lines))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
