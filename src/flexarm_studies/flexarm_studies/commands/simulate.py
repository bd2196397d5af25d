# SPDX-License-Identifier: Apache-2.0
"""``flexarm simulate``: computes a table of an arm's motion under given torques, or with prescribed joint angles.

With ``--trajectory`` the arm is in a closed loop, see `run_controller`.
"""

import itertools
import json
import sys

import numpy as np

from flexarm_dynamics.arm.strain_map import reading_rows
from flexarm_dynamics.errors import FlexarmError, ModelError
from flexarm_dynamics.models import levels, model
from flexarm_sim.integrators import METHODS, friction_warning, plant_substeps, substeps

from .. import tables
from ..identification.prescribed import prescribed_torque
from ..identification.recording import read_csv
from ..progress import Progress
from ..recordings import mapping as mappings
from ..recordings.motion import CORNER, motion_of
from . import run_controller
from .options import add_arm_arguments, add_model_arguments, angles, chain_of, level_of, load_arm

#: More rows must be a mistake in --rate or --duration.
MAX_ROWS = 10_000_000
#: With more rows, the progress is shown.
SHOWN = 5000
#: Number of instants at which a prescribed motion's accelerations are evaluated for its level.
SAMPLES = 1000
#: Defaults of options without a controller.
DEFAULTS = {"rate": 100.0, "step": 0.001, "method": "dop853"}


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Simulates an arm from rest: under torques over time, with prescribed joint angles, "
        "or in a closed loop with an observer and a controller, with metrics of the result."
    )
    parser.epilog = (
        "examples:\n"
        "  flexarm simulate two_link --torque torque.csv --duration 4 --out run.csv\n"
        "  flexarm simulate R --controller paper_composite --trajectory paper "
        "--payload-scale 2\n"
        "  flexarm simulate my_arm.yaml --trajectory quintic:to=0.5,duration=2"
    )
    add_arm_arguments(
        parser,
        "columns and rows, or a summary with --out, as JSON; with a controller the metrics",
    )
    parser.add_argument(
        "--torque",
        metavar="FILE.csv",
        help="columns t,tau1,tau2,... [s], [N m]; linear between rows, a repeated time is a step; none: no torque",
    )
    parser.add_argument(
        "--prescribed",
        metavar="FILE",
        help="joint angles in place of torques, from columns t,q1,... [s], [rad], or a recording (bag, CSV); the "
        "torques come out; the links start at rest under gravity",
    )
    mappings.add_option(parser)
    parser.add_argument(
        "--smooth",
        type=float,
        metavar="HZ",
        help=f"corner of the low pass of a recording's joint angles ({CORNER:g})",
    )
    parser.add_argument(
        "--initial",
        metavar="q1,q2,...",
        help="joint angles at the start [rad]; the arm is straight, at rest",
    )
    parser.add_argument(
        "--duration",
        type=float,
        default=None,
        help="simulated time [s] (4, or the prescribed motion; with a controller the motion and the window after it)",
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=None,
        help="rows per second (100, or the recording's); with a controller samples per second (1000)",
    )
    parser.add_argument(
        "--step", type=float, default=None, help="longest step of the integrator [s] (0.001)"
    )
    parser.add_argument(
        "--method",
        choices=list(METHODS),
        default=None,
        help="integrator (dop853); implicit damps stiff modes",
    )
    add_model_arguments(parser)
    parser.add_argument(
        "--out", metavar="FILE.csv", help="file of the table; standard output if not given"
    )
    run_controller.add_arguments(parser)


def simulate(options, recorder=None, reader=read_csv):
    """Run the sub-command.

    `recorder` writes the bag of ``--bag``, see `scenario.run_loop`. ``reader(path, arm, mapping)`` reads recordings;
    the default reads only CSV files.
    """
    run_controller.check_arguments(options)
    if run_controller.is_closed(options):
        run_controller.run_controller(options, recorder)
        return
    arm = load_arm(options)
    if options.torque and options.prescribed:
        raise FlexarmError("exclude each other", field="--torque and --prescribed")
    drive = motion = None
    if options.torque:
        drive = tables.Steps(*tables.read(options.torque, "tau", arm.joint_names))
    if options.prescribed:
        if arm.model != "chain":
            problem = f"of {arm.name} supports no --prescribed"
            raise ModelError(problem, field="model", value=arm.model, limit="chain")
        if options.initial:
            problem = "is not possible: a prescribed motion starts where its table does"
            raise FlexarmError(problem, field="--initial")
        motion = _motion(options, arm, reader)
    arm = levels.simulated(arm, level_of(options), _known_of(drive, motion, len(arm.joints)))
    arm_model = model.build(arm)
    kinematics = chain_of(arm_model)
    for name, value in DEFAULTS.items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    times = _times(options, motion)
    columns, strains = column_names(kinematics), _strains(kinematics)
    q = angles(options.initial, arm, "--initial")
    rows = np.empty((times.size, len(columns)))
    if motion is None:
        run = _free(arm_model, drive, q, times, options)
    else:
        run = _prescribed(arm_model, motion, times, options)
    rubs = "" if motion is not None else friction_warning(arm_model, options.step, options.method)
    if rubs:
        print(f"flexarm simulate: {rubs}", file=sys.stderr)
    progress = Progress() if times.size > SHOWN else None
    if progress:
        progress.step(f"{arm.name}, {times[-1] - times[0]:g} s")
    n, m, inside = arm_model.n_joints, arm_model.n_modes, levels.Range(arm_model)
    for k, (state, torque) in enumerate(run):
        if not np.isfinite(state).all() or np.abs(state).max() > 1e9:
            raise ModelError(
                f"stopped at t = {times[k]:g} s: the state is beyond the validity of this model",
                field=arm.name,
                hint=f"take a shorter --step; {inside.warning or 'or more of the arm is wrong'}",
            )
        if inside.check(state[:n], state[n + m : 2 * n + m], state[n : n + m]):
            print(f"flexarm simulate: t = {times[k]:g} s: {inside.warning}", file=sys.stderr)
        rows[k] = row(kinematics, times[k], state, torque, strains)
        if progress and k % (times.size // 50) == 0:
            progress.fraction(k / times.size)
    if progress:
        progress.done()
    _report(options, arm_model, columns, rows, inside, rubs)
    return columns, rows


def _motion(options, arm, reader):
    """The prescribed motion: of a table with the columns t,q1,..., or of a recording."""
    path = options.prescribed
    if options.mapping is None and tables.has_columns(path, "t", "q1"):
        if options.smooth is not None:
            problem, hint = "is of recordings", "a table of t,q1,... is taken as it is"
            raise FlexarmError(problem, field="--smooth", value=options.smooth, hint=hint)
        return tables.Motion(*tables.read(path, "q", arm.joint_names), path)
    recording = reader(path, arm, mappings.of_options(options))
    if options.rate is None:
        options.rate = 1.0 / recording.period
    return motion_of(recording, CORNER if options.smooth is None else options.smooth)


def _strains(chain):
    """Function from modal amplitudes (m,) to the gauges' readings (g,), without noise."""
    gauges = chain.arm.gauges
    rows = reading_rows(chain, gauges)
    bias = np.array([g.bias for g in gauges])
    return lambda delta: rows @ delta + bias


def _times(options, motion):
    for name in ("rate", "step"):
        if not 0.0 < (value := getattr(options, name)) < np.inf:
            limit = "finite, above 0"
            raise FlexarmError("is out of range", field=f"--{name}", value=value, limit=limit)
    start, end = (0.0, np.inf) if motion is None else (motion.start, motion.end)
    duration = options.duration
    if duration is None:
        duration = min(4.0, end - start) if motion is None else end - start
    if not 0.0 <= duration < np.inf:
        limit = "finite, at least 0"
        raise FlexarmError("is out of range", field="--duration", value=duration, limit=limit)
    if duration > (end - start) * (1.0 + 1e-9) + 1e-9:
        problem, limit = (
            f"s is longer than the motion in {options.prescribed}",
            f"{end - start:g} s",
        )
        raise FlexarmError(problem, field="--duration", value=duration, limit=limit)
    if (rows := duration * options.rate) > MAX_ROWS:
        problem, limit = f"s at --rate {options.rate:g} makes {rows:.0f} rows", f"{MAX_ROWS} rows"
        raise FlexarmError(problem, field="--duration", value=duration, limit=limit)
    # Rows are one period apart: the end has a row only if the duration is a whole number of periods.
    count = int(duration * options.rate + 1e-9) + 1
    return np.minimum(start + np.arange(count) / options.rate, end)


def _free(arm_model, drive, q, times, options):
    """Yield state and torque at each time, under torque."""
    n, m = arm_model.n_joints, arm_model.n_modes
    advance = arm_model.stepper(METHODS[options.method])
    state = np.zeros(2 * (n + m))
    state[:n] = q
    if drive is None:
        drive = tables.Steps(np.zeros(1), np.zeros((1, n)))
    longest = options.step / plant_substeps(arm_model, options.step, options.method)
    yield state, drive.right_of(times[0])
    for begin, end in itertools.pairwise(times):
        inner = drive.times[(drive.times > begin + 1e-12) & (drive.times < end - 1e-12)]
        cuts = np.unique(np.concatenate([[begin], inner, [end]]))
        for a, b in itertools.pairwise(cuts):
            count = max(1, int(np.ceil((b - a) / longest - 1e-9)))
            torque = drive.right_of(a)
            advance(state, torque, (b - a) / count, count, None, drive.left_of(b) - torque)
        yield state, drive.right_of(end)


def _prescribed(chain, motion, times, options):
    """Yield state and torque at each time, with prescribed joint angles."""
    n, m = chain.n_joints, chain.n_modes
    if options.method == "implicit":
        raise FlexarmError(
            "can't prescribe a motion", field="--method", value="implicit", limit="dop853, rk4"
        )
    advance = chain.driven_stepper(METHODS[options.method])
    state = np.zeros(2 * (n + m))
    state[n : n + m] = chain.static_deflection(motion(times[0])[0])
    longest = options.step / substeps(chain, options.step, options.method)
    for k, t in enumerate(times):
        if k:
            count = max(1, int(np.ceil((t - times[k - 1]) / options.step - 1e-9)))
            grid = np.linspace(times[k - 1], t, count + 1)
            for a, b in itertools.pairwise(grid):
                start, end = motion(a)[2], motion(b)[2]
                inner = max(1, int(np.ceil((b - a) / longest - 1e-9)))
                advance(state, start, (b - a) / inner, inner, None, end - start)
        # The joints are at the positions of the table, without rounding errors.
        state[:n], state[n + m : 2 * n + m], acceleration = motion(t)
        yield state, prescribed_torque(chain, state, acceleration)


def column_names(chain):
    """Columns of the table."""
    names = ["t", *(f"{what}{i + 1}" for what in ("q", "qd", "tau") for i in range(chain.n_joints))]
    names += [*chain.mode_names, "tip_x", "tip_y", "tip_z"]
    for i in range(len(chain.arm.links)):
        names += [f"link{i + 1}_tip_{axis}" for axis in "xyz"]
        if chain.planar_axis is not None:
            names.append(f"link{i + 1}_base_angle")
        names += [f"link{i + 1}_defl_{axis}" for axis in "yz"]
    return names + [f"{name}_strain" for name in chain.arm.gauge_names]


def row(chain, t, state, torque, strains):
    """One row of the table; `strains` is the function of `_strains`."""
    n, m = chain.n_joints, chain.n_modes
    q, delta, qd, _ = np.split(state, [n, n + m, 2 * n + m])
    ends = chain.link_ends(q, delta)
    values = [[t], q, qd, torque, delta, ends[-1]]
    base = chain.base_angles(q, delta) if chain.planar_axis is not None else None
    for i, link in enumerate(chain.arm.links):
        values.append(ends[i])
        if base is not None:
            values.append(base[i : i + 1])
        values.append(chain.tip_deflection(delta, link.name))
    values.append(strains(delta))
    return np.concatenate(values)


def _known_of(drive, motion, joints):
    """The `levels.Drive` of a table of torques, or of a prescribed motion."""
    if motion is None:
        return levels.Drive(np.zeros(joints) if drive is None else drive.largest)
    times = np.linspace(motion.start, motion.end, SAMPLES)
    _, speeds, accelerations = (
        np.abs(each).max(axis=0) for each in zip(*map(motion, times), strict=True)
    )
    return levels.Drive(acceleration=accelerations, velocity=speeds)


def _report(options, arm_model, columns, rows, inside, rubs):
    arm = arm_model.arm
    if options.out or not options.json:
        tables.write(columns, rows, options.out)
    if options.json:
        result = {"arm": arm.name, "model": arm.model, "level": inside.level, "columns": columns}
        result |= {
            "left_out_mm": 1e3 * inside.error,
            "warnings": [text for text in (inside.warning, rubs) if text],
        }
        if options.out:
            result |= {"out": options.out, "rows": len(rows)}
            result["last"] = dict(zip(columns, rows[-1].tolist(), strict=True))
        else:
            result["rows"] = rows.tolist()
        print(json.dumps(result))
        return
    if options.out:
        print(
            f"{options.out}: {arm.name}, {len(rows)} rows of {len(columns)} columns, t = {rows[0, 0]:g} to"
            f" {rows[-1, 0]:g} s",
            file=sys.stderr,
        )
