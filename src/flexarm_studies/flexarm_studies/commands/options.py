# SPDX-License-Identifier: Apache-2.0
"""Options and checks that several commands share: the arm's model, joint angles, files to write."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError, ModelError


def add_model_arguments(parser):
    """What changes an arm's model, for every sub-command that evaluates one."""
    parser.add_argument(
        "--modes", type=int, metavar="N", help="modes per flexible direction of every link"
    )
    parser.add_argument(
        "--foreshortening",
        action="store_true",
        help="links keep their length: needed when they spin fast",
    )
    parser.add_argument(
        "--finite-slope",
        action="store_true",
        help="exact curvature and angle of the tip for large deflections; includes --foreshortening",
    )


def load_arm(options):
    """The arm that the options describe."""
    arm = arm_file.load(options.arm)
    if options.modes is not None:
        arm = arm.with_modes(options.modes)
    if options.foreshortening or options.finite_slope:
        if arm.model != "chain":
            raise ModelError(
                f"{arm.name}: model {arm.model} knows neither foreshortening nor finite slope; model chain does"
            )
        arm = replace(
            arm, foreshortening=True, finite_slope=arm.finite_slope or options.finite_slope
        )
    return arm


def angles(text, arm, option):
    """Joint angles written as ``q1,q2,...``; zero where nothing is given [rad]."""
    n = len(arm.joints)
    if text is None:
        return np.zeros(n)
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        raise FlexarmError(f"{option} {text}: numbers with commas between are wanted") from None
    if values.size != n or not np.isfinite(values).all():
        raise FlexarmError(
            f"{option} {text}: {n} finite angles are wanted, for {', '.join(arm.joint_names)}"
        )
    return values


def check_file(path):
    """The path, its directory made; a FlexarmError when that can't be."""
    path = Path(path)
    if path.suffix not in (".png", ".svg", ".pdf"):
        raise FlexarmError(f"--plot {path}: a name that ends with .png, .svg or .pdf is wanted")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
