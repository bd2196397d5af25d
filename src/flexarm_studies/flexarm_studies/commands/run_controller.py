# SPDX-License-Identifier: Apache-2.0
"""``flexarm simulate --controller``: plant, observer and controller in one process, with metrics."""

import json
import math
import sys
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError

from .. import tables
from ..loop import scenario as scenarios
from .options import angles

#: Options of the closed loop, and the field of `Scenario` that each one fills.
FIELDS = {
    "trajectory": "trajectory",
    "payload_scale": "payload_scale",
    "stiffness_scale": "stiffness_scale",
    "damping_scale": "damping_scale",
    "plant_arm": "plant_arm",
    "plant_modes": "plant_modes",
    "noise": "noise",
    "seed": "seed",
    "delay": "delay",
    "window": "window",
    "settle_within": "tolerance",
    "repeat": "repeat",
    "duration": "duration",
    "rate": "rate",
}
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
        "--controller", metavar="FILE", help="parameter file of the nodes: a shipped name or a path"
    )
    add(
        "--trajectory",
        metavar="FILE|SPEC",
        help="a file (.csv, .yaml), or a motion in a line: paper, quintic:to=0.8;0.8,duration=4",
    )
    add(
        "--set",
        nargs="+",
        action="extend",
        metavar="NAME=VALUE",
        help="parameters beyond the file's: slow.kp=9 fast.type=none",
    )
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
    add("--settle-within", type=float, help="tolerance of the tip for settling [mm] (1)")


def check_arguments(options):
    """Refuse options that do not fit the mode, with or without a controller.

    Raises
    ------
    FlexarmError
    """
    if options.controller is None:
        wrong = [
            k
            for k in (*FIELDS, "set", "bag")
            if k not in SHARED and getattr(options, k) is not None
        ]
        why = "is possible only with --controller"
    else:
        wrong = [k for k in OPEN_LOOP if getattr(options, k)]
        why = "is not possible with --controller"
        if options.trajectory is None:
            hint = "give a file, or a motion such as paper"
            raise FlexarmError("is missing", field="--trajectory", hint=hint)
    if wrong:
        raise FlexarmError(why, field=f"--{wrong[0].replace('_', '-')}")


def scenario_of(options):
    """The `Scenario` that the options describe."""
    parameters = scenarios.parameters(options.controller, options.set or ())
    if options.initial is not None:
        parameters["initial_position"] = angles(
            options.initial, arm_file.load(options.arm), "--initial"
        ).tolist()
    if options.method is not None:
        parameters["integrator"] = options.method
    given = {k: getattr(options, k) for k in FIELDS if getattr(options, k) is not None}
    if "settle_within" in given:
        given["settle_within"] *= 1e-3
    fields = {FIELDS[k]: v for k, v in given.items()}
    return scenarios.Scenario(options.arm, parameters, **fields)


def run_controller(options, recorder=None):
    """Run the sub-command, recorded as in `scenario.run_loop`; exit code 1 if the loop lost the arm."""
    scenario = scenario_of(options)
    record, metrics, loop = scenarios.run_loop(scenario, recorder)
    plant = loop.simulator.plant_model
    for warning in warnings(scenario, loop):
        print(f"flexarm simulate: {warning}", file=sys.stderr)
    if options.out:
        rows = table(record, loop.model, plant)
        tables.write(column_names(loop.model, plant), rows, options.out)
    if options.json:
        result = {"scenario": scenario.as_dict(), "metrics": metrics}
        if options.out:
            result |= {"out": str(Path(options.out)), "rows": len(record.time)}
        print(json.dumps(result, allow_nan=False))
    else:
        print("\n".join(report(scenario, loop.model, metrics)))
    if options.bag:
        print(f"bag {options.bag}; look at it with: flexarm report {options.bag}", file=sys.stderr)
    if metrics["lost"]:
        print(f"flexarm simulate: the arm was lost: {metrics['reason']}", file=sys.stderr)
        sys.exit(1)


def warnings(scenario, loop):
    """Warnings about a run, which is carried out nevertheless."""
    law, gauges = loop.controller.law, loop.simulator.plant_model.arm.gauges
    yield from law.warnings()
    if loop.unprepared:
        yield f"no preview of the trajectory: {loop.unprepared}"
    if scenario.noise and not any(g.noise or g.drift for g in gauges):
        yield f"--noise: the arm file of {loop.model.arm.name} states none"


# What is printed -------------------------------------------------------------------------------


def report(scenario, arm_model, metrics):
    """Lines with the metrics, for people."""
    values, m = scenario.controller, metrics
    parts = [f"{k} {scenarios.type_of(k, values)}" for k in scenarios.COMPONENTS]
    lines = [
        f"{arm_model.arm.name}: {', '.join(parts)}, feed-forward {values.get('feedforward', 'model')}",
        f"{scenario.trajectory}",
        f"{m['motion_s']:g} s of motion, {m['simulated_s']:g} s in all; controller {m['state']}",
        "",
        f"{'joint':16}{'peak error':>12}{'rms error':>12}{'peak torque':>13}{'rms torque':>12}",
        f"{'':16}{'[deg]':>12}{'[deg]':>12}{'[N m]':>13}{'[N m]':>12}",
    ]
    columns = ("peak_joint_error_rad", "rms_joint_error_rad", "peak_torque_Nm", "rms_torque_Nm")
    for i, name in enumerate(arm_model.joint_names):
        peak, rms, torque, effort = (m[c][i] for c in columns)
        lines.append(
            f"{name:16}{math.degrees(peak):12.4g}{math.degrees(rms):12.4g}{torque:13.4g}{effort:12.4g}"
        )
    lines += ["", *(f"{text:44}{value}" for text, value in _of_the_tip(scenario, m))]
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


def column_names(arm_model, plant_model):
    """Columns of the table: time, per joint, per mode, the tip."""
    n = arm_model.n_joints
    prefixes = ("q_ref", "qd_ref", "q", "q_measured", "qd_estimate", "tau_slow", "tau_fast", "tau")
    names = ["t", *(f"{p}{i + 1}" for p in prefixes for i in range(n))]
    names += list(plant_model.mode_names)
    for what in ("estimate", "rate_estimate", "quasi_steady"):
        names += [f"{name}_{what}" for name in arm_model.mode_names]
    names += [f"tip_{axis}" for axis in "xyz"] + [f"tip_ref_{axis}" for axis in "xyz"]
    return [*names, "saturated"]


def table(record, arm_model, plant_model):
    """Rows of the table; joint angles and amplitudes without suffix are the simulated arm's own."""
    r = record
    straight = np.zeros(arm_model.n_modes)
    tip = [
        plant_model.tip_position(q, d)
        for q, d in zip(r.plant_position, r.plant_amplitude, strict=True)
    ]
    wanted = [arm_model.tip_position(q, straight) for q in r.reference]
    return np.column_stack(
        [
            r.time,
            r.reference,
            r.reference_velocity,
            r.plant_position,
            r.position,
            r.velocity,
            r.slow_torque,
            r.fast_torque,
            r.torque,
            r.plant_amplitude,
            r.amplitude,
            r.rate,
            r.quasi_steady,
            tip,
            wanted,
            r.saturated,
        ]
    )
