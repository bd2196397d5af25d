# SPDX-License-Identifier: Apache-2.0
"""``flexarm resonance``: finds the modes that ring in a recording, with intervals, and the shaper that removes them."""

import json
import sys
from dataclasses import replace
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.commands.options import chosen, numbers
from flexarm_studies.identification.recording import SIGNALS
from flexarm_studies.recordings import mapping as mappings
from flexarm_studies.recordings import streams
from flexarm_studies.resonance import study as studies
from flexarm_studies.resonance.answer import answers
from flexarm_studies.resonance.effect import read as read_trajectory
from flexarm_studies.resonance.measured import rings, save
from flexarm_studies.resonance.motion import STEP, SWEEP, Bounds, design, measure
from flexarm_studies.resonance.retiming import of_move
from flexarm_studies.resonance.time_law import Move

from ..identification import recording as recordings
from ..recording import robot
from ..recording.bag import KINDS

STATE = KINDS["arm_state"]
DEFAULT = studies.Wishes()
#: Bounds that are options, and what they are.
BOUNDS = {
    "travel": "the motion stays this near to where the arm stands [rad]",
    "velocity": "its speed [rad/s]",
    "acceleration": "its acceleration [rad/s^2]",
    "stop_travel": "a measured joint this far from there stops it [rad]",
    "stop_velocity": "and one as fast as this [rad/s]",
}


def add_arguments(parser):
    """Arguments of ``resonance``."""
    parser.description = (
        "Finds the modes that ring after a motion or a blow, with frequency and damping and an interval of each, and "
        "recommends the shaper that leaves as little as is wanted at the least delay. No arm file is needed."
    )
    parser.epilog = (
        "example: flexarm resonance --simulate one_link --kind sweep\n"
        "example: flexarm resonance --allow-motion --topic arm_controller/joint_trajectory --imu imu --out tip.csv\n"
        "example: flexarm resonance run.csv --mapping my_mapping.yaml --figure results/resonance.png\n"
        "example: flexarm resonance results/bag --residual 0.02 --trajectory motion.csv"
    )
    add = parser.add_argument
    add(
        "recordings",
        metavar="FILE",
        nargs="*",
        help="a bag's directory, or a CSV file; several of one arm, in several configurations; none: the arm is moved",
    )
    mappings.add_option(parser)
    add("--namespace", default="", help="of the topics in a bag")
    add(
        "--channels",
        metavar="A,B",
        help=f"quantities that ring ({', '.join(SIGNALS)}); not given: strains and IMU, or speeds",
    )
    add(
        "--window",
        action="append",
        default=[],
        metavar="FROM:TO",
        help="a stretch of free ringing [s]",
    )
    add(
        "--band",
        default=f"{DEFAULT.low:g}:{DEFAULT.high:g}",
        metavar="LOW:HIGH",
        help=f"frequencies that are looked for [Hz] (default {DEFAULT.low:g}:{DEFAULT.high:g})",
    )
    add(
        "--residual",
        type=float,
        default=DEFAULT.residual,
        help=f"fraction of the vibration that may be left (default {DEFAULT.residual:g})",
    )
    add(
        "--margin",
        type=float,
        default=DEFAULT.margin,
        help=f"fraction by which frequencies may be off beyond what was measured (default {DEFAULT.margin:g})",
    )
    add("--trajectory", metavar="T", help="say what the motion in this file excites, .csv or .yaml")
    move = DEFAULT.move
    add(
        "--move",
        metavar="D:V:A",
        help="say what the motion of one joint over this distance within these limits excites [rad, rad/s, rad/s^2]; "
        "also that of the least exciting time law, there by default "
        f"{move.distance:g}:{move.velocity:g}:{move.acceleration:g}",
    )
    add(
        "--figure",
        metavar="F",
        help="draw decay and fit, spectra, modes, and what each shaper leaves",
    )
    add("--json", action="store_true", help="print JSON, in SI")
    _add_motion(
        parser.add_argument_group("measuring by a small motion, in place of FILE").add_argument
    )


def _add_motion(add):
    add("--allow-motion", action="store_true", help="stand clear: the arm will move")
    add(
        "--simulate",
        metavar="ARM",
        help="move the simulated arm of this arm file, behind a position loop",
    )
    add("--at", metavar="q1,q2,...", help="where the simulated arm stands [rad] (default 0)")
    add(
        "--kind",
        choices=(STEP, SWEEP),
        default=STEP,
        help="there and back, or a sweep (default step)",
    )
    add("--joints", metavar="A,B", help="which joints move, one after the other (default: all)")
    for name, what in BOUNDS.items():
        default = getattr(Bounds, name)
        add(
            f"--{name.replace('_', '-')}",
            type=float,
            default=default,
            help=f"{what} (default {default:g})",
        )
    add("--rest", type=float, default=4.0, help="free ringing after each motion [s] (default 4)")
    add(
        "--sweep",
        default="1:15",
        metavar="LOW:HIGH",
        help="frequencies of a sweep [Hz] (default 1:15)",
    )
    add("--sweep-duration", type=float, default=10.0, help="of a sweep [s] (default 10)")
    add(
        "--topic", default="joint_trajectory", help="of the trajectories (default joint_trajectory)"
    )
    add(
        "--joint-states",
        default="joint_states",
        help="topic of the joint states (default joint_states)",
    )
    add(
        "--imu",
        action="append",
        default=[],
        metavar="TOPIC",
        help="topic of an IMU, as often as there are",
    )
    add("--arm-state", default="", metavar="TOPIC", help="topic of an ArmState, for its strains")
    add("--out", metavar="F", help="keep what was measured in a CSV file")


def resonance(options):
    """Run ``resonance``; return what was found as plain data.

    Raises
    ------
    FlexarmError
        If the recording can't be read, if nothing rings, and for options that are not numbers or out of range.
    """
    wishes = wishes_of(options)
    if options.recordings:
        mapping = mappings.of_options(options)
        given = [
            read(path, mapping, options.namespace, wishes.quantities) for path in options.recordings
        ]
        made = studies.study(given, wishes)
    else:
        made = by_motion(options, wishes)
    motion = _motion(made, options, wishes)
    found = {"recordings": [str(path) for path in options.recordings]} | studies.plain(made, motion)
    if motion is not None:
        found["trajectory"] = motion
    if options.figure:
        from flexarm_studies.resonance.figure import draw

        found["figure"] = draw(made, options.figure)
    if options.json:
        print(json.dumps(found, allow_nan=False))
        return found
    print("\n".join(studies.text(made, motion)))
    if "figure" in found:
        print(f"figure: {found['figure']}")
    return found


def _motion(made, options, wishes):
    """What the motion of ``--trajectory`` or ``--move`` excites; None if there is no motion."""
    if options.trajectory:
        return studies.of_trajectory(made, read_trajectory(options.trajectory))
    return studies.of_trajectory(made, of_move(wishes.move)) if options.move else None


def by_motion(options, wishes):
    """The `Study` of an arm that is moved, a running one or a simulated one.

    Parameters
    ----------
    options : Namespace
    wishes : Wishes

    Raises
    ------
    FlexarmError
        Without ``--allow-motion`` or ``--simulate``, for motions beyond their bounds, and if the measurement was
        stopped.
    """
    bounds = Bounds(**{name: getattr(options, name) for name in BOUNDS})
    if options.simulate:
        from flexarm_studies.resonance.simulated import SimulatedArm

        return _moved(SimulatedArm(options.simulate, _place(options)), options, wishes, bounds)
    if not options.allow_motion:
        hint = "give a FILE to look at; or stand clear, and give --allow-motion"
        raise FlexarmError("this moves the arm", hint=hint)
    from flexarm_ros.session import Session

    from .live import RunningArm

    with Session("resonance", namespace=options.namespace) as session:
        topics = options.topic, options.joint_states, options.imu, options.arm_state
        return _moved(RunningArm(session, *topics), options, wishes, bounds)


def _place(options):
    return None if options.at is None else numbers("--at", options.at)


def _moved(arm, options, wishes, bounds):
    names = list(arm.joint_names)
    moving = chosen("--joints", options.joints, names) if options.joints else names
    joints, band = [names.index(name) for name in moving], _listed("--sweep", options.sweep, 2)
    motion = design(
        options.kind, joints, len(names), bounds, options.rest, tuple(band), options.sweep_duration
    )
    print(
        f"moves {', '.join(moving)} for {motion.duration:.1f} s, within {bounds.travel:g} rad, "
        f"{bounds.velocity:g} rad/s, {bounds.acceleration:g} rad/s^2; stops if a joint is "
        f"{bounds.stop_travel:g} rad away or faster than {bounds.stop_velocity:g} rad/s", file=sys.stderr,
    )  # fmt: skip
    measure(arm, motion, bounds)
    recording = streams.join(arm.streams())
    if options.out:
        save(recording, options.out)
    found, windows = rings(recording, motion, arm.begin, wishes)
    made = studies.of_windows(found, windows, wishes)
    if options.kind != STEP:
        return made
    return replace(made, answers=tuple(answers(found, windows, made.families, motion, arm.begin)))


def read(path, mapping=None, namespace="", quantities=()):
    """Read a `Recording` from a CSV file or a bag: from `arm_state` if there, otherwise from joint states and IMUs.

    Parameters
    ----------
    path : str or Path
    mapping : Mapping, optional
        What the columns of a CSV file are.
    namespace : str
        Of the topics in a bag.
    quantities : sequence of str
        The wanted quantities; an `arm_state` has none of an IMU.

    Raises
    ------
    FlexarmError
        If it can't be read.
    """
    if Path(path).exists() and recordings.is_bag(path) and mapping is None:
        there = robot.kinds(path)
        of_imu = {"linear_acceleration", "angular_velocity"} & set(quantities)
        if STATE not in there or (of_imu and robot.IMU in there):
            return robot.read(path, namespace)
    return recordings.read(path, None, mapping, namespace)


def wishes_of(options):
    """The `Wishes` that the options express.

    Raises
    ------
    FlexarmError
        For options that are not numbers or out of range.
    """
    low, high = _listed("--band", options.band, 2)
    if not 0.0 <= low < high:
        raise FlexarmError(
            "is no band", field="--band", value=options.band, limit="0 <= low < high"
        )
    for name in ("residual", "margin"):
        value = getattr(options, name)
        if not (0.0 < value < 1.0 or (name == "margin" and value == 0.0)):
            raise FlexarmError("is out of range", field=f"--{name}", value=value, limit="0 to 1")
    quantities = tuple(options.channels.split(",")) if options.channels else ()
    for name in quantities:
        if name not in SIGNALS:
            limit = ", ".join(SIGNALS)
            raise FlexarmError("is unknown", field="--channels", value=name, limit=limit)
    return studies.Wishes(
        residual=options.residual,
        margin=options.margin,
        low=low,
        high=high,
        windows=tuple(tuple(_listed("--window", w, 2)) for w in options.window),
        quantities=quantities,
        move=Move(*_listed("--move", options.move, 3)) if options.move else DEFAULT.move,
    )


def _listed(option, text, count):
    values = numbers(option, text, ":")
    if len(values) != count:
        raise FlexarmError(
            "numbers are wanted, separated by ':'", field=option, value=text, limit=count
        )
    return values
