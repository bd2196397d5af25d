# SPDX-License-Identifier: Apache-2.0
"""Motions written in a line: ``quintic:to=1.57,duration=2``, as `flexarm simulate --trajectory` takes them.

A family's name, a colon, and its settings; where a setting has a value per joint (or per axis), they are
separated by semicolons. Everything but a family's required settings may be left out:

============== ============================== ==========================================================
family         settings                       motion
============== ============================== ==========================================================
paper          to, duration                   the case study's, `profiles.paper_profile`
quintic        to, duration                   `profiles.quintic`
smooth         to, duration, smoothness       `profiles.smooth`
least-exciting to, duration, torque-limit,    `least_exciting.least_exciting`
               velocity-limit
line           tip, duration, smoothness      the tip on a straight line, `tip_paths`
arc            tip, via, duration, smoothness the tip on a circle through a point on the way
============== ============================== ==========================================================

All of them take ``from`` (joint angles where the motion starts), ``shaper`` (zv, zvd), ``shape-modes`` (how many of
the arm's lowest modes it is for) and ``points``.
"""

import math
from pathlib import Path

import numpy as np

from flexarm_dynamics.errors import TrajectoryError

from ..motions import profiles, shapers
from . import files
from .request import JointTrajectoryData, validate
from .values import MAX_POINTS, SECOND

_COMMON = ("from", "duration", "shaper", "shape-modes", "points")
FAMILIES = {
    "paper": ("to",),
    "quintic": ("to",),
    "smooth": ("to", "smoothness"),
    "least-exciting": ("to", "torque-limit", "velocity-limit"),
    "line": ("tip", "smoothness"),
    "arc": ("tip", "via", "smoothness"),
}
REQUIRED = {"line": ("tip",), "arc": ("tip", "via")}
#: Points of a motion that is turned into a trajectory. Between them the jerk is right to 1e-6 of its peak for the
#: closed forms; where copies of a shaped quintic begin, with a step of jerk, the acceleration is off by 4e-4.
POINTS = 401
#: How far a tip's path is asked for: C^3, as the path itself is smooth.
TIP_SMOOTHNESS = 3
#: Modes that a shaper is for unless told otherwise; fewer where the arm has fewer.
SHAPE_MODES = 2


def load(text, model, start=None) -> JointTrajectoryData:
    """Return the trajectory of a file, or of a motion written in a line.

    Parameters
    ----------
    text : str
        A path that ends as `files.SUFFIXES`, or what `from_spec` takes.
    model : ArmModel
    start : (n,) array_like, optional
        Where a written motion starts [rad]; zero if not given.

    Raises
    ------
    FlexarmError
        As `files.read` and `from_spec`.
    """
    if Path(text).suffix.lower() in files.SUFFIXES:
        return files.read(text, model.joint_names, *limits(model))
    return from_spec(text, model, start)


def from_spec(text, model, start=None) -> JointTrajectoryData:
    """Return the trajectory of a motion written in a line.

    Parameters
    ----------
    text : str
        ``family`` or ``family:setting=value,...`` (module docstring).
    model : ArmModel
    start : (n,) array_like, optional
        Joint angles where it starts, unless it says ``from`` [rad]; zero if not given.

    Returns
    -------
    JointTrajectoryData
        With stamp 0, within the arm's limits.

    Raises
    ------
    TrajectoryError
        Naming the family or setting, its value, and what is wanted.
    FlexarmError
        What the families raise of motions that can't be.
    """
    family, settings = parse(text)
    settings, points = dict(settings), integer(settings.get("points", str(POINTS)), "points")
    settings.pop("points", None)
    start = np.zeros(model.n_joints) if start is None else start
    return sampled(motion(family, settings, model, start), model, points)


def sampled(profile, model, points=POINTS) -> JointTrajectoryData:
    """Return a motion as a trajectory of so many points, checked against the arm's limits."""
    if not 2 <= points <= MAX_POINTS:
        raise TrajectoryError(f"points is {points}: give 2 to {MAX_POINTS}")
    rows = [
        (round(t * SECOND), *values, [])
        for t, *values in zip(*(a.tolist() for a in profiles.sample(profile, points)), strict=True)
    ]
    return validate(model.joint_names, model.joint_names, 0, rows, *limits(model))


def limits(model):
    """Position limits, low and high, and speed limits of the arm file, each (n,)."""
    bounds = [joint.limits for joint in model.arm.joints]
    low, high = np.array([b.position for b in bounds], float).T
    return low, high, np.array([b.velocity for b in bounds], float)


def parse(text):
    """Split ``family:setting=value,...`` into the family and a dict of texts."""
    family, _, rest = text.strip().partition(":")
    check_family(family)
    settings = {}
    for item in filter(None, (word.strip() for word in rest.split(","))):
        key, equals, value = (word.strip() for word in item.partition("="))
        key = key.replace("_", "-")
        if not equals or not value:
            raise TrajectoryError(f"{text!r}: {item!r} is no setting: write name=value")
        if key in settings:
            raise TrajectoryError(f"{text!r}: {key} is given twice")
        settings[key] = value
    check_settings(family, settings)
    return family, settings


def check_family(family):
    """Refuse a name that is no family's."""
    if family not in FAMILIES:
        raise TrajectoryError(
            f"motion {family!r}: give a file that ends in {', '.join(files.SUFFIXES)}, or one of"
            f" {', '.join(FAMILIES)}, as quintic:to=1.57,duration=2"
        )


def check_settings(family, settings):
    """Refuse settings that a family has not, and those that it lacks."""
    known = (*FAMILIES[family], *_COMMON)
    for key in settings:
        if key not in known:
            raise TrajectoryError(f"{family} has no {key}: it takes {', '.join(known)}")
    for key in REQUIRED.get(family, ()):
        if key not in settings:
            raise TrajectoryError(f"{family} wants {key}: {key}=x;y;z in the base frame [m]")


def needs_model(family, settings):
    """Whether a motion depends on more of the arm than its number of joints."""
    return family in ("least-exciting", "line", "arc") or "shaper" in settings


def motion(family, settings, model, start):
    """Return the motion of a family: a `Profile`, or what has its methods.

    Parameters
    ----------
    family : str
    settings : mapping of str to str
        As `parse` returns them.
    model : ArmModel or None
        None will do where `needs_model` says so.
    start : (n,) array_like
        Where it starts, unless the settings say ``from`` [rad].

    Raises
    ------
    TrajectoryError
        Naming the setting, its value, and what is wanted.
    FlexarmError
        What the family raises of a motion that can't be.
    """
    check_family(family)
    check_settings(family, settings)
    start = np.asarray(start, float)
    if "from" in settings:
        start = numbers(settings["from"], start.size, "from", "angles, one per joint")
    duration = number(settings.get("duration", "2"), "duration")
    make = {"line": _tip_path, "arc": _tip_path}.get(family, _point_to_point)
    return make(family, settings, model, start, duration)


def _point_to_point(family, settings, model, start, duration):
    to = numbers(settings.get("to", repr(math.pi / 2)), start.size, "to", "angles, one per joint")
    if family == "paper":
        profile = profiles.paper_profile(duration, to - start, start)
    elif family == "quintic":
        profile = profiles.quintic(start, to, duration)
    elif family == "smooth":
        profile = profiles.smooth(start, to, duration, _smoothness(settings))
    else:
        profile = _least_exciting(settings, model, start, to, duration)
    shaper = shaper_of(settings, model, to)
    return profile if shaper is None else shaper.apply(profile)


def _least_exciting(settings, model, start, to, duration):
    from ..motions.least_exciting import least_exciting

    bounds = {}
    for key in ("torque-limit", "velocity-limit"):
        if key in settings:
            bounds[key.replace("-", "_")] = numbers(
                settings[key], model.n_joints, key, "numbers, one per joint"
            )
    return least_exciting(model, start, to, duration, **bounds).profile


def _tip_path(family, settings, model, start, duration):
    tip = numbers(settings["tip"], 3, "tip", "coordinates x;y;z", spread=False)

    from ..motions import tip_paths

    law = profiles.smooth(0.0, 1.0, duration, _smoothness(settings))
    if family == "line":
        path = tip_paths.line(model, start, tip, law)
    else:
        via = numbers(settings["via"], 3, "via", "coordinates x;y;z", spread=False)
        path = tip_paths.arc(model, start, via, tip, law)
    # The law is shaped, not the joints: the tip stays on its path.
    shaper = shaper_of(settings, model, path.position(path.duration))
    return path if shaper is None else path.with_law(shaper.apply(law))


def shaper_of(settings, model, end):
    """Return the shaper that the settings ask for, for the modes where the motion ends, or None."""
    if "shaper" not in settings:
        if "shape-modes" in settings:
            raise TrajectoryError("shape-modes without shaper: give shaper=zv or shaper=zvd too")
        return None
    modes = min(SHAPE_MODES, model.n_modes)
    if "shape-modes" in settings:
        modes = integer(settings["shape-modes"], "shape-modes")
    return shapers.for_arm(model, end, settings["shaper"], modes)


def _smoothness(settings):
    return integer(settings.get("smoothness", str(TIP_SMOOTHNESS)), "smoothness")


def number(text, name):
    """Read a number."""
    try:
        return float(text)
    except ValueError:
        raise TrajectoryError(f"{name} {text!r}: write a number") from None


def integer(text, name):
    """Read an integer."""
    try:
        return int(text)
    except ValueError:
        raise TrajectoryError(f"{name} {text!r}: write an integer") from None


def numbers(text, count, name, what, spread=True, separator=";"):
    """Read so many finite numbers; one stands for all where it may be spread."""
    try:
        values = [float(word) for word in text.split(separator)]
    except ValueError:
        raise TrajectoryError(f"{name} {text!r}: write numbers, separated by {separator}") from None
    values = values * count if spread and len(values) == 1 else values
    if len(values) != count or not all(map(math.isfinite, values)):
        raise TrajectoryError(f"{name} {text!r}: {count} finite {what} are wanted")
    return np.array(values)
