# SPDX-License-Identifier: Apache-2.0
"""The benchmark command; see ``python -m benchmarks --help``."""

import argparse
import importlib
import json
import os
import sys
from importlib import metadata
from pathlib import Path

#: What the comparison needs beyond the project itself.
PEERS = ("mujoco", "exudyn", "control")
INSTALL = "pip install -r requirements/bench.txt"

#: Packages whose version is recorded.
VERSIONS = ("numpy", "scipy", "numba", *PEERS)

MISSED, MISSING = 1, 2

#: Markers of the tables in docs/performance.md.
BEGIN, END = "<!-- bench: begin -->", "<!-- bench: end -->"


def parser():
    """The argument parser."""
    top = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Time flexarm beside other codes at the same accuracy, all in the same run.",
        epilog="Exit code 1: a criterion was missed; 2: a package is missing.",
    )
    top.add_argument("--quick", action="store_true", help="few turns and few arm sizes")
    top.add_argument("--out", default="results/bench", help="directory of the results")
    top.add_argument("--json", action="store_true", help="print summary.json in place of tables")
    top.add_argument(
        "--write", metavar="FILE", help="put the tables between the markers of a Markdown file"
    )
    top.add_argument("--no-check", action="store_true", help="measure only: no criteria")
    return top


def missing():
    """Packages that can't be imported and how to install them, as text; empty if none is missing."""
    for names, remedy in ((("flexarm_dynamics",), ". tools/env.sh"), (PEERS, INSTALL)):
        absent = [name for name in names if not _imports(name)]
        if absent:
            return f"missing: {', '.join(absent)}; run `{remedy}`"
    return ""


def _imports(name):
    try:
        importlib.import_module(name)
    except ImportError:
        return False
    return True


def measure(quick, note):
    """Measure everything.

    Parameters
    ----------
    quick : bool
        Few turns and few arm sizes.
    note : callable
        Called with the name of what is being measured.

    Returns
    -------
    dict
        The summary without criteria.
    """
    from . import cases, compare, scaling

    effort = compare.Effort(5, 0.01) if quick else compare.Effort(11, 0.03)
    summary = {
        "quick": quick,
        "python": sys.version.split()[0],
        "versions": {name: metadata.version(name) for name in VERSIONS},
        "cpu_count": os.cpu_count(),
        "cases": {},
        "same_step": {},
    }
    for case in cases.TARGETS:
        note(f"{case}: all codes")
        summary["cases"][case] = compare.all_codes(case, effort)
    for name in compare.BY_HAND:
        note(f"{name}: generated code and hand-written loops")
        summary["same_step"][name] = compare.same_step(name, effort)
    note("cost against links (compiles code for each arm the first time)")
    links = (1, 2, 4, 8) if quick else range(1, 9)
    summary["links"] = scaling.costs([(n, 2) for n in links], effort)
    summary["stiffening"] = scaling.costs([(n, 2) for n in links], effort, foreshortening=True)
    note("cost against modes")
    modes = (1, 2, 4) if quick else range(1, 7)
    summary["modes"] = scaling.costs([(n, m) for n in (1, 2) for m in modes], effort)
    note("throughput against cores")
    summary["throughput"] = scaling.throughput()
    return summary


def main(arguments=None):
    """Run the command; returns the exit code."""
    options = parser().parse_args(arguments)
    what = missing()
    if what:
        print(what, file=sys.stderr)
        return MISSING
    from flexarm_studies.markdown import write_between

    from . import criteria, plots, tables

    summary = measure(options.quick, lambda text: print(f"... {text}", file=sys.stderr, flush=True))
    summary["criteria"] = [] if options.no_check else criteria.check(summary)
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(summary, indent=1)
    (out / "summary.json").write_text(text + "\n", encoding="utf-8")
    plots.draw(summary, out)
    if options.write:
        write_between(options.write, BEGIN, END, tables.markdown(summary))
    print(text if options.json else tables.text(summary))
    print(f"{out}: summary.json, figures", file=sys.stderr)
    return MISSED if any(c["met"] is False for c in summary["criteria"]) else 0


if __name__ == "__main__":
    sys.exit(main())
