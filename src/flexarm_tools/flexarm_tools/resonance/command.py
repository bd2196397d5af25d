# SPDX-License-Identifier: Apache-2.0
"""``flexarm resonance``: the modes that ring in a recording, with intervals, and the shaper that takes them out."""

import json
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.commands.options import numbers
from flexarm_studies.identification.recording import SIGNALS
from flexarm_studies.recordings import mapping as mappings
from flexarm_studies.resonance import study as studies
from flexarm_studies.resonance.time_law import Move

from ..identification import recording as recordings
from ..recording import robot
from ..recording.bag import KINDS

STATE = KINDS["arm_state"]
DEFAULT = studies.Wishes()


def add_arguments(parser):
    """Arguments of ``resonance``."""
    parser.description = (
        "Finds the modes that ring after a motion or a blow, with frequency and damping and an interval of each, and "
        "recommends the shaper that leaves as little as is wanted at the least delay. No arm file is needed."
    )
    parser.epilog = (
        "example: flexarm resonance run.csv --mapping my_mapping.yaml --figure results/resonance.png\n"
        "example: flexarm resonance results/bag --residual 0.02 --trajectory motion.csv"
    )
    add = parser.add_argument
    add(
        "recordings",
        metavar="FILE",
        nargs="+",
        help="a bag's directory, or a CSV file; several of one arm, in several configurations",
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
        default=f"{move.distance:g}:{move.velocity:g}:{move.acceleration:g}",
        metavar="D:V:A",
        help="motion of the least exciting time law: distance and limits [rad, rad/s, rad/s^2] (default "
        f"{move.distance:g}:{move.velocity:g}:{move.acceleration:g})",
    )
    add(
        "--figure",
        metavar="F",
        help="draw decay and fit, spectra, modes, and what each shaper leaves",
    )
    add("--json", action="store_true", help="print JSON, in SI")


def resonance(options):
    """Run ``resonance``; what was found as plain data.

    Raises
    ------
    FlexarmError
        For what can't be read, where nothing rings, and for options that are no numbers or out of range.
    """
    wishes = wishes_of(options)
    mapping = mappings.of_options(options)
    measured = [
        read(path, mapping, options.namespace, wishes.quantities) for path in options.recordings
    ]
    made = studies.study(measured, wishes)
    motion = studies.of_trajectory(made, options.trajectory) if options.trajectory else None
    found = {"recordings": [str(path) for path in options.recordings]} | studies.plain(made)
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


def read(path, mapping=None, namespace="", quantities=()):
    """A `Recording` of a CSV file, or of a bag: of its `arm_state` where there is one, else of joint states and IMUs.

    Parameters
    ----------
    path : str or Path
    mapping : Mapping, optional
        What the columns of a CSV file are.
    namespace : str
        Of the topics in a bag.
    quantities : sequence of str
        That are wanted: those of an IMU are in no `arm_state`.

    Raises
    ------
    FlexarmError
        For what can't be read.
    """
    if Path(path).exists() and recordings.is_bag(path) and mapping is None:
        there = robot.kinds(path)
        of_imu = {"linear_acceleration", "angular_velocity"} & set(quantities)
        if STATE not in there or (of_imu and robot.IMU in there):
            return robot.read(path, namespace)
    return recordings.read(path, None, mapping, namespace)


def wishes_of(options):
    """The `Wishes` that the options say.

    Raises
    ------
    FlexarmError
        For options that are no numbers or out of range.
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
        move=Move(*_listed("--move", options.move, 3)),
    )


def _listed(option, text, count):
    values = numbers(option, text, ":")
    if len(values) != count:
        raise FlexarmError(
            "numbers are wanted, separated by ':'", field=option, value=text, limit=count
        )
    return values
