# SPDX-License-Identifier: Apache-2.0
"""Handles options of several commands: the arm and its model, joint angles, lists of numbers, files to write."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import levels


def add_arm_arguments(parser, as_json="print JSON"):
    """Add the arm, and ``--json`` with this help."""
    parser.add_argument("arm", metavar="ARM", help="arm file: a shipped name or a path")
    parser.add_argument("--json", action="store_true", help=as_json)


def add_model_arguments(parser):
    """Add the options that change an arm's model."""
    parser.add_argument(
        "--modes", type=int, metavar="N", help="modes per flexible direction of every link"
    )
    parser.add_argument(
        "--level",
        choices=levels.LEVELS,
        help="kinematics of bending; stiffening: links keep their length, as they do when they spin; finite_slope: also"
        " exact curvature and tips' angles (auto)",
    )
    parser.add_argument(
        "--foreshortening", action="store_true", help="the same as --level stiffening"
    )
    parser.add_argument(
        "--finite-slope", action="store_true", help="the same as --level finite_slope"
    )


def add_settings(add):
    """Add ``--set`` by a parser's or a group's `add_argument`."""
    add(
        "--set",
        nargs="+",
        action="extend",
        metavar="NAME=VALUE",
        help="parameters beyond the file's: slow.kp=9 fast.type=none",
    )


def show(options, result, lines, **form):
    """Print a `result` as JSON, with the `form` of `json.dumps`, if requested; otherwise print these `lines`."""
    print(json.dumps(result, **form) if options.json else "\n".join(lines))


def load_arm(options):
    """The arm that the options describe."""
    arm = arm_file.load(options.arm)
    if options.modes is not None:
        arm = arm.with_modes(options.modes)
    level = level_of(options)
    if level != levels.AUTO:
        arm = levels.at_level(arm, level)
    return arm


def level_of(options):
    """The level of ``--level``, or of one of the flags in its place; `auto` if neither is given."""
    by_flag = {"--foreshortening": levels.STIFFENING, "--finite-slope": levels.FINITE_SLOPE}
    given = [(k, v) for k, v in by_flag.items() if getattr(options, k[2:].replace("-", "_"))]
    if not given:
        return options.level or levels.AUTO
    flag, level = given[-1]  # --finite-slope includes --foreshortening
    if options.level not in (None, level):
        hint = f"leave out {flag}, or --level"
        raise FlexarmError(
            f"contradicts {flag}", field="--level", value=options.level, limit=level, hint=hint
        )
    return level


def chain_of(arm_model):
    """The model itself if it is a chain, otherwise the chain of the same arm, for its kinematics."""
    from flexarm_dynamics.models.chain import Chain

    if isinstance(arm_model, Chain):
        return arm_model
    return Chain(replace(arm_model.arm, model="chain"))


def numbers(option, text, separator=","):
    """Read the finite numbers of an option's list."""
    try:
        values = [float(word) for word in text.split(separator)]
    except ValueError:
        values = [np.nan]
    if not np.isfinite(values).all():
        hint = f"give numbers, separated by {separator!r}"
        raise FlexarmError("is no list of finite numbers", field=option, value=text, hint=hint)
    return values


def span(text, option):
    """Beginning and end of ``FROM:TO``; None for an empty text."""
    if not text:
        return None
    try:
        start, end = (float(word) for word in text.split(":"))
    except ValueError:
        start, end = 1.0, 0.0
    if not start < end < np.inf:
        raise FlexarmError("is no part", field=option, value=text, limit="FROM:TO, as 14:60")
    return start, end


def angles(text, arm, option):
    """Joint angles written as ``q1,q2,...``; zero if none are given [rad]."""
    n = len(arm.joints)
    if text is None:
        return np.zeros(n)
    values = np.array(numbers(option, text))
    if values.size != n:
        problem, hint = (
            "is the wrong number of angles",
            f"give one for each of {', '.join(arm.joint_names)}",
        )
        raise FlexarmError(problem, field=option, value=values.size, limit=n, hint=hint)
    return values


def in_range(option, value, low, high):
    """Return the value of an option, or refuse one outside its range."""
    if not low <= value <= high:
        limit = f"{low:g} to {high:g}"
        raise FlexarmError("is out of range", field=option, value=value, limit=limit)
    return value


def at_least(option, value, least):
    """Refuse a value below the minimum; None is a value that was not given."""
    if value is not None and value < least:
        limit = f"{least} or more"
        raise FlexarmError("is too small", field=option, value=value, limit=limit)


def check_file(path, option="--plot"):
    """Return the path of a figure after making its folder, or refuse it."""
    path, suffixes = Path(path), (".png", ".svg", ".pdf")
    if path.suffix not in suffixes:
        limit = ", ".join(suffixes)
        raise FlexarmError("has the wrong suffix", field=option, value=str(path), limit=limit)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def new_path(path, option):
    """Return the path of what a command writes, or refuse one that exists."""
    path = Path(path)
    if path.exists():
        hint = "name another one or remove it"
        raise FlexarmError("exists already", field=option, value=str(path), hint=hint)
    return path


def whole_numbers(option, text):
    """The whole numbers of a list such as ``0-4,8``, each once, in order; `FlexarmError` for anything else."""
    found = set()
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        last = last or first
        if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last)):
            limit = "numbers and ranges of them, as 0-4,8"
            raise FlexarmError("is no list of numbers", field=option, value=text, limit=limit)
        found.update(range(int(first), int(last) + 1))
    return sorted(found)


def chosen(option, text, known):
    """The names in an option's text, each of which must be `known`."""
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in known:
            raise FlexarmError("is unknown", field=option, value=name, limit=", ".join(known))
    return names
