# SPDX-License-Identifier: Apache-2.0
"""``flexarm simulate --trajectory``: runs plant, observer and controller in one process, with metrics."""

import json
import math
import sys
from pathlib import Path

import numpy as np

from flexarm_control.robust import default
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError

from .. import tables
from ..loop import judged
from ..loop import scenario as scenarios
from ..loop.metrics import tip_path
from .options import add_settings, angles

#: Options of the closed loop: fields of `Scenario`.
FIELDS = (
    "trajectory", "payload_scale", "stiffness_scale", "damping_scale", "plant_arm", "plant_modes", "noise", "seed",
    "delay", "window", "tolerance", "repeat", "duration", "rate",
)  # fmt: skip
#: Options of `flexarm simulate` that belong to the arm without a controller, or to both.
OPEN_LOOP = ("torque", "prescribed", "step", "modes", "foreshortening", "finite_slope")
SHARED = ("duration", "rate")


def add_arguments(parser):
    """Arguments of the closed loop."""
    group = parser.add_argument_group(
        "with a controller",
        "observer and controller, the objects that the nodes call, move the arm",
    )
    add = group.add_argument
    add(
        "--controller",
        metavar="FILE",
        help="parameter file of the nodes: a shipped name or a path; not given: a design for the arm",
    )
    add(
        "--trajectory",
        metavar="FILE|SPEC",
        help="a file (.csv, .yaml), or a motion in a line: paper, quintic:to=0.8;0.8,duration=4",
    )
    add_settings(add)
    add(
        "--payload-scale",
        type=float,
        help="the payload's mass and inertia times this, unknown to the controller (1)",
    )
    add(
        "--stiffness-scale",
        type=float,
        help="the links' stiffness times this, unknown to the controller (1)",
    )
    add(
        "--damping-scale",
        type=float,
        help="the links' damping times this, unknown to the controller (1)",
    )
    add("--plant-arm", metavar="ARM", help="arm file of the simulated arm, if it is another")
    add("--plant-modes", type=int, metavar="N", help="modes per direction of the simulated arm")
    add("--noise", action="store_true", default=None, help="gauges have the arm file's noise")
    add("--seed", type=int, help="of the noise (0)")
    add("--delay", type=float, help="from a measurement until its torque acts [s] (0)")
    add("--repeat", type=int, metavar="N", help="do the motion N times, and back in between (1)")
    add("--window", type=float, help="time after the motion over which rest is judged [s] (3)")
    add(
        "--bag",
        metavar="FOLDER",
        help="record the run as the nodes' topics: a rosbag2 bag for `flexarm report`, PlotJuggler, Foxglove",
    )
    add(
        "--settle-within",
        dest="tolerance",
        type=float,
        help="tolerance of the tip for settling [mm] (1)",
    )


def is_closed(options):
    """Whether the options ask for a closed loop."""
    return options.controller is not None or options.trajectory is not None


def check_arguments(options):
    """Refuse options that do not fit the mode, with or without a controller."""
    if not is_closed(options):
        others = [k for k in (*FIELDS, "set", "bag") if k not in SHARED]
        wrong = [k for k in others if getattr(options, k) is not None]
        why = "is possible only with --trajectory"
    else:
        wrong = [k for k in OPEN_LOOP if getattr(options, k)]
        why = f"is not possible with {'--trajectory' if options.controller is None else '--controller'}"
        if options.trajectory is None:
            hint = "give a file, or a motion such as paper"
            raise FlexarmError("is missing", field="--trajectory", hint=hint)
    if wrong:
        name = "settle-within" if wrong[0] == "tolerance" else wrong[0].replace("_", "-")
        raise FlexarmError(why, field=f"--{name}")


def scenario_of(options):
    """The `Scenario` that the options describe."""
    parameters = scenarios.parameters(options.controller, options.set or (), options.arm)
    if options.initial is not None:
        parameters["initial_position"] = angles(
            options.initial, arm_file.load(options.arm), "--initial"
        ).tolist()
    if options.method is not None:
        parameters["integrator"] = options.method
    if options.level is not None:
        parameters["level"] = options.level
    given = {k: getattr(options, k) for k in FIELDS if getattr(options, k) is not None}
    if "tolerance" in given:
        given["tolerance"] *= 1e-3  # [mm]
    return scenarios.Scenario(options.arm, parameters, **given)


def run_controller(options, recorder=None):
    """Run the sub-command, recorded as in `scenario.run_loop`; exit code 1 if the loop lost the arm."""
    scenario = scenario_of(options)
    task = scenarios.design_task(scenario)
    if task is not None and not default.is_cached(arm_file.load(options.arm), *task):
        print(
            "flexarm simulate: designing a controller for this arm; it is kept for the next time",
            file=sys.stderr,
        )
    record, metrics, loop = scenarios.run_loop(scenario, recorder)
    plant = loop.simulator.plant_model
    bears = judged.bears_of(loop, loop.controller.reference.position.copy(), scenario.delay)
    for warning in warnings(scenario, loop):
        print(f"flexarm simulate: {warning}", file=sys.stderr)
    if options.out:
        tables.write(*table(record, loop.model, plant), options.out)
    if options.json:
        result = {"scenario": scenario.as_dict(), "metrics": metrics, "bears": bears.as_dict()}
        if options.out:
            result |= {"out": str(Path(options.out)), "rows": len(record.time)}
        print(json.dumps(result, allow_nan=False))
    else:
        print("\n".join(report(scenario, loop, metrics, bears)))
    if options.bag:
        print(f"bag {options.bag}; look at it with: flexarm report {options.bag}", file=sys.stderr)
    if metrics["lost"]:
        print(f"flexarm simulate: the arm was lost: {metrics['reason']}", file=sys.stderr)
        sys.exit(1)


def warnings(scenario, loop):
    """Warnings about a run, which is carried out nevertheless."""
    law, gauges = loop.controller.law, loop.simulator.plant_model.arm.gauges
    yield from law.warnings()
    if loop.designed is not None and scenario.delay > loop.designed.bears_delay:
        yield (
            f"the delay of {1e3 * scenario.delay:.3g} ms is longer than the"
            f" {1e3 * loop.designed.bears_delay:.3g} ms that the design bears: design for it, --set"
            f" design.delay={scenario.delay:g}"
        )
    if loop.simulator.range.warning:
        yield loop.simulator.range.warning
    if loop.simulator.friction_warning:
        yield loop.simulator.friction_warning
    if loop.unprepared:
        yield f"no preview of the trajectory: {loop.unprepared}"
    if scenario.noise and not any(g.noise or g.drift for g in gauges):
        yield f"--noise: the arm file of {loop.model.arm.name} states none"


# What is printed -------------------------------------------------------------------------------


def report(scenario, loop, metrics, bears):
    """Lines with the metrics, and what the loop `bears` at rest where the reference ends, for people."""
    arm_model, m, values = loop.model, metrics, scenario.controller
    if loop.designed is not None:
        values = loop.designed.parameters | values
    parts = [f"{k} {scenarios.type_of(k, values)}" for k in scenarios.COMPONENTS]
    lines = [
        f"{arm_model.arm.name}: {', '.join(parts)}, feed-forward {values.get('feedforward', 'model')}",
        f"{scenario.trajectory}",
        f"{m['motion_s']:g} s of motion, {m['simulated_s']:g} s in all; controller {m['state']}",
        "",
        f"{'joint':16}{'peak error':>12}{'rms error':>12}{'peak torque':>13}{'rms torque':>12}",
        f"{'':16}{'[deg]':>12}{'[deg]':>12}{'[N m]':>13}{'[N m]':>12}",
    ]
    errors = np.degrees([m["peak_joint_error_rad"], m["rms_joint_error_rad"]])
    for name, *row in zip(
        arm_model.joint_names, *errors, m["peak_torque_Nm"], m["rms_torque_Nm"], strict=True
    ):
        lines.append("{:16}{:12.4g}{:12.4g}{:13.4g}{:12.4g}".format(name, *row))
    lines += ["", *(f"{text:44}{value}" for text, value in _of_the_tip(scenario, m))]
    lines.append(f"{'the loop bears, at rest where it ended':44}{judged.words(bears)}")
    lines += [f"warning: {cycle.text}" for cycle in bears.limit_cycles]
    for i, each in enumerate(m.get("passes", ())):
        peak = max(each["peak_joint_error_rad"])
        lines.append(
            f"{f'time {i + 1}: peak joint [deg], tip [mm]':44}{math.degrees(peak):.4g},"
            f" {each['peak_tip_error_mm']:.4g}"
        )
    return lines


def _of_the_tip(scenario, m):
    """Labels and texts of the metrics that do not belong to a joint."""
    digits = lambda value: "-" if value is None else f"{value:.4g}"  # noqa: E731
    yield "tip from the rigid arm's, peak and rms [mm]", _pair(m, "tip_error_mm")
    if "static_sag_mm" in m:
        yield "static sag at the end [mm]", digits(m["static_sag_mm"])
        yield "tip from the bent arm's, peak and rms [mm]", _pair(m, "tip_error_about_sag_mm")
    start, end = m["residual_window_s"] or (0.0, 0.0)
    window = f" {start:.3g} to {end:.3g} s after it" if end else ""
    yield f"tip vibration{window}, rms [mm]", digits(m["residual_tip_rms_mm"])
    yield "tip's greatest error in the last 0.5 s [mm]", digits(m["final_tip_error_mm"])
    label = f"settled within {1e3 * scenario.tolerance:g} mm after [s]"
    settled = m["settling_time_s"]
    yield label, "never" if settled is None else digits(settled)
    yield "samples with the torque at a limit [%]", digits(100.0 * m["saturation_share"])
    if m.get("case_study"):
        for key, value in m["case_study"].items():
            if not isinstance(value, dict):
                yield f"case study: {key}", digits(value)


def _pair(m, name):
    return f"{m[f'peak_{name}']:.4g}, {m[f'rms_{name}']:.4g}"


# The table -------------------------------------------------------------------------------------


def table(record, arm_model, plant_model):
    """Columns and rows of the table of a `record`.

    `arm_model` is the arm as the controller knows it, `plant_model` the simulated one; joint angles and amplitudes
    without suffix are the latter's own.
    """
    r = record
    per_joint = {
        "q_ref": r.reference, "qd_ref": r.reference_velocity, "q": r.plant_position,
        "q_measured": r.position, "qd_estimate": r.velocity,
        "tau_slow": r.slow_torque, "tau_fast": r.fast_torque, "tau": r.torque,
    }  # fmt: skip
    per_mode = {"estimate": r.amplitude, "rate_estimate": r.rate, "quasi_steady": r.quasi_steady}
    straight = np.zeros((r.time.size, arm_model.n_modes))
    tips = {
        "tip": tip_path(plant_model, r.plant_position, r.plant_amplitude),
        "tip_ref": tip_path(arm_model, r.reference, straight),
    }
    names = ["t", *(f"{what}{i + 1}" for what in per_joint for i in range(arm_model.n_joints))]
    names += plant_model.mode_names
    names += [f"{mode}_{what}" for what in per_mode for mode in arm_model.mode_names]
    names += [f"{what}_{axis}" for what in tips for axis in "xyz"] + ["saturated"]
    columns = [r.time, *per_joint.values(), r.plant_amplitude, *per_mode.values()]
    return names, np.column_stack([*columns, *tips.values(), r.saturated])
