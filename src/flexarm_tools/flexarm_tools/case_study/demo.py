# SPDX-License-Identifier: Apache-2.0
"""``flexarm demo``: makes all runs of the case study, figures, bags, report, and the tables. ROS only for the nodes."""

import functools
import json
import os
import shutil
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.models import model
from flexarm_studies.case_study import figures, heavier
from flexarm_studies.case_study.runs import RUNS, continuous, run_without_ros, summarise
from flexarm_studies.case_study.tables import (
    compared,
    gained,
    heavier_table,
    linear_table,
    nonlinear_table,
)
from flexarm_studies.progress import Progress
from flexarm_studies.workers import processes

#: Round trips of each of the two relays.
RELAYED = 1500
#: The run whose time per sample is compared with that of the relay: it runs alone, the others two at a time.
TIMED = RUNS[-1]
#: Runs of this arm, whose gain is a misprint, are in one process, because nodes take longer for the same samples.
IN_ONE_PROCESS = "P3_h11"


def demo(directory, show, nodes=True, as_json=False):
    """All runs, figures, bags, ``summary.json``, and the tables.

    Parameters
    ----------
    directory : Path
        Results go here.
    show : Progress
        Shows what is going on.
    nodes : bool
        Three processes over DDS; False: the loop without ROS.
    as_json : bool
        Print what ``summary.json`` holds, and no tables.

    Returns
    -------
    dict
        The content of ``summary.json``.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    found, lockstep = {}, None
    if nodes:
        found[TIMED], lockstep = _beside_a_relay(directory, show)
    with processes(min(2, len(os.sched_getaffinity(0)))) as pool:
        running = {
            run: pool.submit(_with_nodes, run, directory)
            if nodes and run.model != IN_ONE_PROCESS
            else pool.submit(_timed, run, directory if nodes else None)
            for run in RUNS
            if run not in found
        }
        heavy = {c: pool.submit(_heavier, c, directory, nodes) for c in heavier.CONTROLS}
        loops = {
            (r.model, r.control): pool.submit(continuous, r) for r in RUNS if r.rates == "true"
        }
        for i, (run, future) in enumerate(running.items()):
            show.step(f"{run.model} {run.control}, {run.rates} rates", i + 1, len(running))
            found[run] = future.result()
        show.step("continuous loop, payload a third heavier, report, figures 2 to 11")
        heavy = {control: future.result() for control, future in heavy.items()}
        gains = [heavier.summarise(c, metrics) for c, (_, metrics) in heavy.items()]
        report = pool.submit(_report, directory, gains) if nodes else None
        records = {run.name: record for run, (record, _) in found.items()}
        drawn = [pool.submit(_figures, directory, records, m) for m in _models()]
        drawn.append(pool.submit(_heavier_figure, directory, {c: r for c, (r, _) in heavy.items()}))
        references = {key: future.result() for key, future in loops.items()}
        made = [path for future in drawn for path in future.result()]
        report = report and report.result()
    summary = {
        "runs": [summarise(run, *found[run]) for run in RUNS],
        "continuous_loop": [
            {"model": m, "control": c, **values} for (m, c), values in references.items()
        ],
        "heavier_payload": gains,
    }
    if nodes:
        summary["lockstep"] = lockstep
    with open(directory / "summary.json", "w", encoding="utf-8") as file:
        json.dump(summary, file, indent=1, allow_nan=False)
    show.done()
    if as_json:
        print(json.dumps(summary, indent=1, allow_nan=False))
    else:
        _print_tables(summary, references, made, directory, report)
    return summary


def _models():
    return dict.fromkeys(r.model for r in RUNS)


def _beside_a_relay(directory, show):
    """The run `TIMED` alone between two bare relays; (record, timing), and the time per sample of both."""
    name = "bare relay of the same messages through three processes"
    show.step(name)
    relays = [_relay(directory)]
    show.step(f"{TIMED.model} {TIMED.control}, {TIMED.rates} rates")
    record, timing = _with_nodes(TIMED, directory, show.fraction)
    show.step(name)
    relays.append(_relay(directory))
    per_sample, relay = timing.seconds_per_sample, float(np.mean(relays))
    return (record, timing), {
        "seconds_per_sample": per_sample,
        "bare_relay_seconds_per_sample": relay,
        "ratio": per_sample / relay,
    }


def _with_nodes(run, directory, progress=lambda fraction: None):
    from .nodes import run_nodes  # needs ROS

    return run_nodes(run, directory / run.name, progress)


def _timed(run, directory=None):
    """The run in one process; its bag goes to a `directory`."""
    started = time.perf_counter()
    record = run_without_ros(run, directory and _bag(directory / run.name))
    wall = time.perf_counter() - started
    return record, SimpleNamespace(
        wall_seconds=wall,
        simulated_seconds=float(record.time[-1] - record.time[0]),
        seconds_per_sample=wall / record.time.size,
    )


def _heavier(control, directory, bag):
    """The run of a control with the heavier payload, with a `bag` or without; as `heavier.run`."""
    return heavier.run(control, _bag(directory / f"R_heavier_{control}") if bag else None)


def _bag(folder):
    """A recorder of the loop in one process, see `scenario.run_loop`."""
    from ..recording.loop_bag import LoopBag  # needs ROS

    shutil.rmtree(folder / "bag", ignore_errors=True)
    return functools.partial(LoopBag, folder / "bag")


def _relay(directory):
    from ..running import relay
    from ..running.lockstep import LockstepRun

    return relay.measure("R", directory / "relay_log", RELAYED, LockstepRun)


#: The report's runs, in the order of its colours.
REPORTED = ("composite", "slow", "designed")
OPENING = (
    "The paper's arm, one flexible link of 4 ft, turns by 90° in 2 s and stops, with a payload a third heavier than the"
    " controller knows; under the paper's slow control alone, under its composite control, and under the control that"
    " flexarm design makes for this arm. Watch the tip after the motion: under the slow control alone it keeps"
    " vibrating; the composite control brings it to rest, but follows the reference less closely; the designed control"
    " brings it to rest and follows closely."
)


def _report(directory, summaries):
    """A page on the runs with the heavier payload, from their bags."""
    from ..report.command import make

    bags = [directory / f"R_heavier_{control}" / "bag" for control in REPORTED]
    names = [heavier.NAMES[control] for control in REPORTED]
    opening = " ".join([OPENING, *compared(summaries)])
    return make(bags, directory / "report.html", names=names, opening=opening)


def _figures(directory, records, name):
    """The figures of one of the paper's arms; the PNG files."""
    arm, gain = name.split("_")
    return figures.draw(
        directory / "figures" / name,
        f"arm {arm}, gain {gain}",
        records[f"{name}_slow"],
        records[f"{name}_composite"],
        model.build(arm_file.load(arm)),
    )


def _heavier_figure(directory, records):
    """The figure of the heavier payload; the PNG file."""
    arm = arm_file.load("R")
    plant = model.build(scaled(arm, heavier.PAYLOAD))
    folder = directory / "figures" / "R_heavier"
    return [figures.draw_heavier(folder, records, model.build(arm), plant)]


def _print_tables(summary, references, figures, directory, report):
    print("\n".join(["", *linear_table(summary["runs"]), ""]))
    print("\n".join([*nonlinear_table(summary["runs"], references), ""]))
    print("\n".join([*heavier_table(summary["heavier_payload"]), ""]))
    if "lockstep" in summary:
        l = summary["lockstep"]  # noqa: E741
        print(
            f"Lockstep: {1e3 * l['seconds_per_sample']:.2f} ms a sample; a bare relay of the same messages:"
            f" {1e3 * l['bare_relay_seconds_per_sample']:.2f} ms; ratio {l['ratio']:.2f}\n"
        )
    if report is not None:
        print(f"Look at  {report} in a browser: the three controls side by side, with an animation")
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
    print("\n".join(["", *gained(summary["heavier_payload"])]))
    print(
        "  It is config/controllers/R_designed.yaml. For your arm: ./flexarm design my_arm.yaml (docs/design.md)"
    )


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "The case study of Siciliano & Book (1986): seven runs, five with three nodes; then arm R with a heavier"
        " payload under the paper's controls and a designed one. About two minutes."
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
