# SPDX-License-Identifier: Apache-2.0
"""Motions written in one line: ``quintic:to=1.57,duration=2``, as for `flexarm simulate --trajectory`.

A family's name, a colon, and its settings. The values of a setting per joint (or per axis) are separated by
semicolons. All settings are optional except the tip and via of tip paths:

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

All families take ``from`` (joint angles at the start), ``shaper`` (zv, mzv, zvd, ei, 2hump_ei, zvdd), ``shape-modes``
(for how many of the arm's lowest modes) and ``points``.
"""

import math
from pathlib import Path

import numpy as np

from flexarm_dynamics.errors import TrajectoryError

from ..motions import profiles, shapers
from . import files
from .request import JointTrajectoryData, validate
from .values import MAX_POINTS

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
#: Default number of points of a trajectory. Between them the jerk of the closed forms is right to 1e-6 of its peak.
#: The copies of a shaped quintic begin with a step of jerk; there the acceleration is off by 4e-4.
POINTS = 401
#: Default smoothness of `smooth` and of the time law of tip paths.
TIP_SMOOTHNESS = 3
#: Default number of modes of a shaper; fewer if the arm has fewer.
SHAPE_MODES = 2
POINTS_RANGE = f"2 to {MAX_POINTS}"


def load(text, model, start=None) -> JointTrajectoryData:
    """Return the trajectory of a file, or of a motion written in one line.

    Parameters
    ----------
    text : str
        A path that ends as `files.SUFFIXES`, or what `from_spec` takes.
    model : ArmModel
    start : (n,) array_like, optional
        Joint angles at which a written motion starts [rad]; zero if not given.
    """
    if Path(text).suffix.lower() in files.SUFFIXES:
        return files.read(text, model.joint_names, *limits(model))
    return from_spec(text, model, start)


def from_spec(text, model, start=None) -> JointTrajectoryData:
    """Return the trajectory of a motion written in one line, with stamp 0 and within the arm's limits.

    Parameters
    ----------
    text : str
        ``family`` or ``family:setting=value,...`` (module docstring).
    model : ArmModel
    start : (n,) array_like, optional
        Joint angles at the start, unless the text sets ``from`` [rad]; zero if not given.

    Raises
    ------
    TrajectoryError
        It names the family or setting, and its value.
    FlexarmError
        As the families raise it.
    """
    family, settings = parse(text)
    start = np.zeros(model.n_joints) if start is None else start
    profile = motion(family, settings, model, start)
    return sampled(profile, model, _number(int, settings, "points", POINTS))


def sampled(profile, model, points=POINTS) -> JointTrajectoryData:
    """Return a motion as a trajectory with this number of points, checked against the arm's limits."""
    if not 2 <= points <= MAX_POINTS:
        raise TrajectoryError("is out of range", field="points", value=points, limit=POINTS_RANGE)
    names, rows = model.joint_names, profiles.rows(profiles.sample(profile, points))
    return validate(names, names, 0, rows, *limits(model))


def limits(model):
    """Position limits, low and high, and speed limits of the arm file, each (n,)."""
    return *model.arm.position_limits.T, model.arm.velocity_limits


def parse(text):
    """Split ``family:setting=value,...`` into the family and a dict of texts, which `motion` checks."""
    family, _, rest = text.strip().partition(":")
    settings = {}
    for item in filter(None, (word.strip() for word in rest.split(","))):
        key, equals, value = (word.strip() for word in item.partition("="))
        key = key.replace("_", "-")
        if not equals or not value:
            hint = "write name=value"
            raise TrajectoryError("is no setting", field=family, value=item, hint=hint)
        if key in settings:
            raise TrajectoryError("is given twice", field=family, value=key)
        settings[key] = value
    return family, settings


def _check(family, settings):
    """Refuse an unknown family, settings that it does not have, and required ones that are missing."""
    if family not in FAMILIES:
        raise TrajectoryError(
            "is no family of motions",
            field="motion",
            value=family,
            limit=", ".join(FAMILIES),
            hint=f"or give a file that ends in {', '.join(files.SUFFIXES)}",
        )
    known, problem = (*FAMILIES[family], *_COMMON), "is no setting of this family"
    for key in settings:
        if key not in known:
            raise TrajectoryError(problem, field=family, value=key, limit=", ".join(known))
    for key in REQUIRED.get(family, ()):
        if key not in settings:
            hint = f"give {key}=x;y;z in the base frame [m]"
            raise TrajectoryError(f"{key} is missing", field=family, hint=hint)


def needs_model(family, settings):
    """Whether a motion depends on more of the arm than its number of joints."""
    return family in ("least-exciting", "line", "arc") or "shaper" in settings


def motion(family, settings, model, start):
    """Return the `Motion` of a family.

    Parameters
    ----------
    family : str
    settings : mapping of str to str
        As `parse` returns them.
    model : ArmModel or None
        May be None unless `needs_model`.
    start : (n,) array_like
        Joint angles at the start, unless the settings have ``from`` [rad].

    Raises
    ------
    TrajectoryError
        It names the setting and its value.
    FlexarmError
        As the family raises it.
    """
    _check(family, settings)
    start = np.asarray(start, float)
    if "from" in settings:
        start = _numbers(settings["from"], start.size, "from", "angles, one per joint")
    duration = _number(float, settings, "duration", 2.0)
    make = _tip_path if family in ("line", "arc") else _point_to_point
    return make(family, settings, model, start, duration)


def _point_to_point(family, settings, model, start, duration):
    to = _numbers(settings.get("to", repr(math.pi / 2)), start.size, "to", "angles, one per joint")
    if family == "paper":
        profile = profiles.paper_profile(duration, to - start, start)
    elif family == "quintic":
        profile = profiles.quintic(start, to, duration)
    elif family == "smooth":
        profile = profiles.smooth(start, to, duration, _smoothness(settings))
    else:
        profile = _least_exciting(settings, model, start, to, duration)
    shaper = _shaper(settings, model, to)
    return profile if shaper is None else shaper.apply(profile)


def _least_exciting(settings, model, start, to, duration):
    from ..motions.least_exciting import least_exciting

    bounds = {
        key.replace("-", "_"): _numbers(settings[key], start.size, key, "numbers, one per joint")
        for key in ("torque-limit", "velocity-limit")
        if key in settings
    }
    return least_exciting(model, start, to, duration, **bounds).profile


def _tip_path(family, settings, model, start, duration):
    tip = _numbers(settings["tip"], 3, "tip", "coordinates x;y;z", spread=False)

    from ..motions import tip_paths

    law = profiles.smooth(0.0, 1.0, duration, _smoothness(settings))
    if family == "line":
        path = tip_paths.line(model, start, tip, law)
    else:
        via = _numbers(settings["via"], 3, "via", "coordinates x;y;z", spread=False)
        path = tip_paths.arc(model, start, via, tip, law)
    # The law is shaped, not the joints: the tip stays on its path.
    shaper = _shaper(settings, model, path.position(path.duration))
    return path if shaper is None else path.with_law(shaper.apply(law))


def _shaper(settings, model, end):
    """Return the shaper that the settings ask for, for the modes where the motion ends, or None."""
    if "shaper" not in settings:
        if "shape-modes" in settings:
            hint = f"give shaper={' or shaper='.join(shapers.SHAPERS)} too"
            raise TrajectoryError("is given without shaper", field="shape-modes", hint=hint)
        return None
    modes = _number(int, settings, "shape-modes", min(SHAPE_MODES, model.n_modes))
    return shapers.for_arm(model, end, settings["shaper"], modes)


def _smoothness(settings):
    return _number(int, settings, "smoothness", TIP_SMOOTHNESS)


def _number(kind, settings, key, default):
    """Read an int or a float."""
    problem = "is not a number" if kind is float else "is no integer"
    return _read(kind, settings.get(key, default), key, problem)


def _numbers(text, count, name, what, spread=True):
    """Read `count` finite numbers, (count,); with `spread` one number stands for all."""
    hint = f"give {count} finite {what}"
    semicolons = f"{hint}, separated by semicolons"
    values = [_read(float, word, name, "is not a number", semicolons) for word in text.split(";")]
    values = values * count if spread and len(values) == 1 else values
    if len(values) != count or not all(map(math.isfinite, values)):
        raise TrajectoryError("can't be used", field=name, value=text, hint=hint)
    return np.array(values)


def _read(kind, text, name, problem, hint=""):
    try:
        return kind(text)
    except ValueError:
        raise TrajectoryError(problem, field=name, value=text, hint=hint) from None
