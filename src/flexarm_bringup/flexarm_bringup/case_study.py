# SPDX-License-Identifier: Apache-2.0
"""The paper's case study: its runs, what is reported of them, and the table beside print.

Nothing here imports ROS but `start_nodes` and `run_nodes`, which run the three executables, and `_relay`;
`run_without_ros` calls the very objects that the nodes call.
"""

import json
import math
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexarm_control import profiles, trajectory
from flexarm_control.composite import design
from flexarm_dynamics import arm_file, model
from flexarm_dynamics.errors import FlexarmError

from . import closed_loop, metrics, parameter_files

DURATION = 8.0  # [s] from the start of the trajectory
FINAL = np.array([math.pi / 2])

#: Section 5 of Siciliano & Book (1986), magnitudes, in the paper's units.
PRINT = {
    "k_f": (75.50, 6375.64, 17.07, 173.10),
    "closed_loop_frequencies_rad_s": (18.59, 94.10),
    "closed_loop_damping": (0.766, 0.753),
    "open_loop_frequencies_rad_s": (14.0, 90.0),
}


@dataclass(frozen=True)
class Run:
    """One run of the case study.

    Attributes
    ----------
    arm, gain : str
        Arm file, and what multiplies the bracket of (17): m11 or h11.
    control : str
        ``slow`` or ``composite``.
    rates : str
        ``true``: the simulator's own; ``observer``: reconstructed from the gauges.
    """

    arm: str
    gain: str
    control: str
    rates: str = "true"

    @property
    def model(self):
        """Name in the summary: arm and gain."""
        return f"{self.arm}_{self.gain}"

    @property
    def name(self):
        """Name of the run's directory."""
        return f"{self.model}_{self.control}" + ("_observer" if self.rates == "observer" else "")

    @property
    def file(self):
        """Controller file of the run."""
        return "paper_composite" if self.control == "composite" else "paper_slow"

    @property
    def controller(self):
        """Parameters of the controller beyond its file."""
        return {"arm": self.arm, "slow.gain": self.gain, "state_timeout": 60.0}

    @property
    def observer(self):
        """Parameters of the observer beyond its file."""
        return {"arm": self.arm} | ({"observer.type": "true_rates"} if self.rates == "true" else {})

    @property
    def simulator(self):
        """Parameters of the simulator."""
        return {"arm": self.arm, "publish_rates": self.rates == "true"}


RUNS = (
    Run("P3", "h11", "slow"),
    Run("P3", "h11", "composite"),
    Run("P3", "m11", "slow"),
    Run("P3", "m11", "composite"),
    Run("R", "m11", "slow"),
    Run("R", "m11", "composite"),
    Run("R", "m11", "composite", "observer"),
)


def law_of(run, arm_model):
    """The run's composite control, from its controller file."""
    values = parameter_files.load(run.file)["controller"] | run.controller
    return design(
        arm_model, parameter_files.under(values, "slow"), parameter_files.under(values, "fast")
    )


def run_without_ros(run):
    """The run in one process, with the objects that the nodes call.

    Returns
    -------
    Record
    """
    values = parameter_files.load(run.file)
    control = values["controller"] | run.controller
    observer = values["observer"] | run.observer
    observer = parameter_files.under(observer, "observer")
    if run.rates == "true":
        observer.pop("bandwidth", None)
    loop = closed_loop.ClosedLoop(
        run.arm,
        parameter_files.under(control, "slow"),
        parameter_files.under(control, "fast"),
        observer,
        {k: v for k, v in run.simulator.items() if k != "arm"},
    )
    return loop.run(paper_trajectory(loop.model.joint_names), DURATION)


def paper_trajectory(joint_names, points=101):
    """The paper's motion as the controller reads it from a topic, starting at the common instant."""
    s = profiles.sample(profiles.paper_profile(), points)
    rows = zip(s.times, s.positions, s.velocities, s.accelerations, strict=True)
    return trajectory.validate(
        joint_names,
        joint_names,
        closed_loop.TRAJECTORY_START_NS,
        [(round(t * 1e9), p, v, a, ()) for t, p, v, a in rows],
    )


def continuous(run):
    """The run's metrics in the continuous loop: full state, no sampling, no sensors."""
    arm_model = model.build(arm_file.load(run.arm))
    times = np.arange(0, round(DURATION * 1000) + 1) * 1e-3
    record = closed_loop.continuous_loop(
        arm_model, law_of(run, arm_model), profiles.paper_profile(), times
    )
    return metrics.case_study_metrics(record, arm_model)


def start_nodes(processes, run):
    """Start the run's simulator, in lockstep and paused, observer and controller."""
    from .recorder import keep_for_recording

    for name, parameters in (
        ("simulator", {"lockstep": True, **run.simulator}),
        ("observer", run.observer),
        ("controller", run.controller),
    ):
        parameters = parameters | keep_for_recording(name)
        processes.start_node(name, parameters, parameter_files.find(run.file))


def run_nodes(run, directory, progress=lambda fraction: None):
    """The run with simulator, observer and controller as three processes over DDS, recorded.

    Parameters
    ----------
    run : Run
    directory : Path
        For the bag and the nodes' logs.
    progress : callable
        Called with the fraction done.

    Returns
    -------
    record : Record
    timing : Timing

    Raises
    ------
    FlexarmError
        Where a node fails, or the arm is lost.
    """
    from . import lockstep, recorder
    from .processes import Processes, own_domain

    with own_domain() as domain, Processes(domain, directory / "log") as processes:
        start_nodes(processes, run)
        with lockstep.LockstepRun(processes) as line:
            joints = arm_file.load(run.arm).joint_names
            start = closed_loop.TRAJECTORY_START_NS
            message = lockstep.trajectory_message(joints, profiles.paper_profile(), 101, start)
            samples, timing = line.run(message, DURATION, progress)
        codes = processes.stop()
        if any(codes.values()):
            raise FlexarmError(f"{run.name}: exit codes {codes}; logs in {directory / 'log'}")
    bag = directory / "bag"
    shutil.rmtree(bag, ignore_errors=True)
    recorder.write_bag(bag, samples, run.arm)
    return recorder.to_record(recorder.decode(samples), start), timing


def summarise(run, record, timing):
    """The run's entry in ``summary.json``; every value is computed from this run."""
    arm_model = model.build(arm_file.load(run.arm))
    return {
        "model": run.model,
        "control": run.control,
        "rates": run.rates,
        **metrics.linear_metrics(arm_model, law_of(run, arm_model), FINAL),
        **metrics.case_study_metrics(record, arm_model, until=DURATION),
        "wall_seconds": timing.wall_seconds,
        "simulated_seconds": timing.simulated_seconds,
    }


def linear_table(summaries):
    """Lines of the table of gains, frequencies and damping: print | P3 | R."""
    composite = {s["model"]: s for s in summaries if s["control"] == "composite"}
    p3, r = composite["P3_m11"], composite["R_m11"]
    lines = [
        "Fast subsystem at the end of the motion: open loop, and closed by the optimal fast control",
        f"{'':34}{'print':>12}{'P3':>12}{'R':>12}",
    ]
    labels = {
        "open_loop_frequencies_rad_s": ("open loop, mode {} [rad/s]", "~{:.0f}"),
        "closed_loop_frequencies_rad_s": ("closed loop, mode {} [rad/s]", "{:.2f}"),
        "closed_loop_damping": ("damping ratio, mode {} [-]", "{:.3f}"),
    }
    for key, (label, digits) in labels.items():
        for i, printed in enumerate(PRINT[key]):
            lines.append(
                f"{label.format(i + 1):34}{digits.format(printed):>12}"
                f"{p3[key][i]:12.4f}{r[key][i]:12.4f}"
            )
    for i, printed in enumerate(PRINT["k_f"]):
        name = f"k_f, {('mode 1', 'mode 2', 'rate 1', 'rate 2')[i]} " + (
            "[lbf]" if i < 2 else "[lbf s]"
        )
        lines.append(f"{name:34}{printed:12.2f}{abs(p3['k_f'][i]):12.3f}{abs(r['k_f'][i]):12.3f}")
    lines.append("(k_f: magnitudes; for R all of u_f = -k z_f are negative with tip shapes (+, -))")
    return lines


def nonlinear_table(summaries, references):
    """Lines of the table of the nonlinear runs: nodes beside the continuous loop."""
    lines = [
        "Nonlinear arm, 90 deg in 2 s: three nodes at 1 kHz (n) beside the continuous loop (c)",
        f"{'':26}{'peak joint':>15}{'max error':>17}{'tip residual':>19}{'peak tip':>17}{'peak torque':>15}",
        f"{'':26}{'error [deg]':>15}{'t > 3 s [deg]':>17}{'rms 3-8 s [ft]':>19}{'[ft]':>17}{'[lbf ft]':>15}",
        f"{'':26}"
        + f"{'n':>8}{'c':>7}{'n':>9}{'c':>8}{'n':>10}{'c':>9}{'n':>9}{'c':>8}{'n':>8}{'c':>7}",
    ]
    for s in summaries:
        key = (s["model"], s["control"])
        c = references[key]
        who = f"{s['model']} {s['control']}" + (", observer" if s["rates"] == "observer" else "")
        lines.append(
            f"{who:26}"
            f"{s['peak_joint_error_deg']:8.4f}{c['peak_joint_error_deg']:7.3f}"
            f"{s['max_joint_error_after_3s_deg']:9.4f}{c['max_joint_error_after_3s_deg']:8.4f}"
            f"{s['residual_tip_rms_ft']:10.2e}{c['residual_tip_rms_ft']:9.2e}"
            f"{s['peak_tip_deflection_ft']:9.4f}{c['peak_tip_deflection_ft']:8.4f}"
            f"{s['peak_torque_lbf_ft']['total']:8.3f}{c['peak_torque_lbf_ft']['total']:7.3f}"
        )
    return lines


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
            run_nodes(run, directory / run.name, show.fraction) if nodes else _timed(run)
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


def _timed(run):
    from types import SimpleNamespace

    started = time.perf_counter()
    record = run_without_ros(run)
    wall = time.perf_counter() - started
    return record, SimpleNamespace(
        wall_seconds=wall,
        simulated_seconds=float(record.time[-1] - record.time[0]),
        seconds_per_sample=wall / record.time.size,
    )


def _relay(directory):
    from . import relay
    from .lockstep import LockstepRun

    return relay.measure("R", directory / "relay_log", recorder=LockstepRun)


def _report(directory):
    """A page of the story's two runs, from their bags."""
    from .report.command import make

    bags = [directory / f"R_m11_{control}" / "bag" for control in ("composite", "slow")]
    return make(bags, directory / "report.html")


def _figures(directory, records):
    from . import figures

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
