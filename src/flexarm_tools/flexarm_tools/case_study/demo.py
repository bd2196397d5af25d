# SPDX-License-Identifier: Apache-2.0
"""``flexarm demo``: all runs of the case study, figures, bags, report, and the tables. ROS only for the nodes."""

import json
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_studies.case_study import figures
from flexarm_studies.case_study.runs import RUNS, continuous, run_without_ros, summarise
from flexarm_studies.case_study.tables import linear_table, nonlinear_table
from flexarm_studies.progress import Progress


def demo(directory, show, nodes=True, as_json=False):
    """All runs, figures, bags, ``summary.json``, and the tables.

    Parameters
    ----------
    directory : Path
        Results go here.
    show : Progress
        Where to say what is going on.
    nodes : bool
        Three processes over DDS; False: the loop without ROS.
    as_json : bool
        Print what ``summary.json`` holds, and no tables.

    Returns
    -------
    dict
        What ``summary.json`` holds.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    relay_times, summaries, records = [], [], {}
    per_sample = []
    if nodes:
        show.step("bare relay of the same messages through three processes")
        relay_times.append(_relay(directory))
    for i, run in enumerate(RUNS):
        show.step(f"{run.model} {run.control}, {run.rates} rates", i + 1, len(RUNS))
        record, timing = (
            _with_nodes(run, directory / run.name, show.fraction) if nodes else _timed(run)
        )
        records[run.name] = record
        summaries.append(summarise(run, record, timing))
        per_sample.append(timing.seconds_per_sample)
        if nodes and i in (len(RUNS) // 2, len(RUNS) - 1):
            show.step("bare relay of the same messages through three processes")
            relay_times.append(_relay(directory))
    show.step("continuous loop, for comparison")
    references = {(r.model, r.control): continuous(r) for r in RUNS if r.rates == "true"}
    show.step("figures 2 to 11")
    figures = _figures(directory, records)
    summary = {
        "runs": summaries,
        "continuous_loop": [
            {"model": m, "control": c, **values} for (m, c), values in references.items()
        ],
    }
    if nodes:
        summary["lockstep"] = {
            "seconds_per_sample": float(np.median(per_sample)),
            "bare_relay_seconds_per_sample": float(np.median(relay_times)),
            "ratio": float(np.median(per_sample) / np.median(relay_times)),
        }
    with open(directory / "summary.json", "w", encoding="utf-8") as file:
        json.dump(summary, file, indent=1, allow_nan=False)
    report = None
    if nodes:
        show.step("report of the composite and the slow control")
        report = _report(directory)
    show.done()
    if as_json:
        print(json.dumps(summary, indent=1, allow_nan=False))
    else:
        _print_tables(summary, references, figures, directory, report)
    return summary


def _with_nodes(run, directory, progress):
    from .nodes import run_nodes  # needs ROS

    return run_nodes(run, directory, progress)


def _timed(run):
    started = time.perf_counter()
    record = run_without_ros(run)
    wall = time.perf_counter() - started
    return record, SimpleNamespace(
        wall_seconds=wall,
        simulated_seconds=float(record.time[-1] - record.time[0]),
        seconds_per_sample=wall / record.time.size,
    )


def _relay(directory):
    from ..running import relay
    from ..running.lockstep import LockstepRun

    return relay.measure("R", directory / "relay_log", recorder=LockstepRun)


#: The report's runs: the control, and what it is called on the page.
REPORTED = {"composite": "composite control", "slow": "slow control alone"}
OPENING = (
    "The paper's arm, one flexible link of 4 ft, turns by 90° in 2 s and stops; once under the slow control alone, once"
    " under the composite control. Watch the tip after the motion: under the slow control alone it keeps vibrating, the"
    " composite control brings it to rest. During the motion the composite control follows the reference less closely:"
    " docs/control.md says why, and which controller has both."
)


def _report(directory):
    """A page on two of the runs, from their bags."""
    from ..report.command import make

    bags = [directory / f"R_m11_{control}" / "bag" for control in REPORTED]
    return make(bags, directory / "report.html", names=list(REPORTED.values()), opening=OPENING)


def _figures(directory, records):
    made = []
    for name in dict.fromkeys(r.model for r in RUNS):
        arm = name.split("_")[0]
        made += figures.draw(
            directory / "figures" / name,
            "arm {}, gain {}".format(*name.split("_")),
            records[f"{name}_slow"],
            records[f"{name}_composite"],
            model.build(arm_file.load(arm)),
        )
    return made


def _print_tables(summary, references, figures, directory, report):
    print("\n".join(["", *linear_table(summary["runs"]), ""]))
    print("\n".join([*nonlinear_table(summary["runs"], references), ""]))
    if "lockstep" in summary:
        l = summary["lockstep"]  # noqa: E741
        print(
            f"Lockstep: {1e3 * l['seconds_per_sample']:.2f} ms a sample; a bare relay of the same messages:"
            f" {1e3 * l['bare_relay_seconds_per_sample']:.2f} ms; ratio {l['ratio']:.2f}\n"
        )
    if report is not None:
        print(f"Look at  {report} in a browser: composite beside slow control, with an animation")
    print(f"Look at  {figures[-1]}")
    print(f"         {len(figures)} figures, PNG and SVG, in {directory / 'figures'}")
    if (directory / "R_m11_composite" / "bag").is_dir():
        print(f"Bags     {directory}/<run>/bag (MCAP): open in PlotJuggler or Foxglove")
    print(f"Numbers  {directory / 'summary.json'}")
    print("Next     ./flexarm view two_link: an arm in the browser, to handle")
    bag = directory.parent / "mine"
    print(f"         ./flexarm simulate R --controller composite --trajectory paper --bag {bag}")
    if report is not None:
        print(
            f"         ./flexarm report {bag} {directory / 'R_m11_composite'}: yours beside the paper's"
        )
    print("         docs/guide.md, 'Run the nodes yourself'; docs/index.md for the rest")


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "The case study of Siciliano & Book (1986): three nodes, seven runs, about a minute."
    )
    parser.epilog = "example: flexarm demo --out results/case_study"
    add = parser.add_argument
    add("--out", default="results/case_study", help="directory of the results")
    add(
        "--without-ros",
        action="store_true",
        help="the same objects in one process, no DDS, no bags",
    )
    add("--json", action="store_true", help="print summary.json, not the tables")


def run_demo(options):
    """Run the sub-command."""
    demo(options.out, Progress(), nodes=not options.without_ros, as_json=options.json)
