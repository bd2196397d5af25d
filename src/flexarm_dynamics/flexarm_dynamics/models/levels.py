# SPDX-License-Identifier: Apache-2.0
"""Levels of the kinematics of bending, at which an arm is simulated.

`first_order`: displacements are linear in the deflections. `stiffening`: links keep their length to second order, so
that a spinning link is stiffer. `finite_slope`: they keep it exactly, and their curvature and their tips' angles hold
for large slopes. See docs/dynamics.md.
"""

from dataclasses import replace

from ..errors import ModelError

FIRST_ORDER, STIFFENING, FINITE_SLOPE = "first_order", "stiffening", "finite_slope"
AUTO = "auto"
#: What can be asked for.
LEVELS = (AUTO, FIRST_ORDER, STIFFENING, FINITE_SLOPE)


def level_of(arm):
    """The level of the model that `model.build` makes of an arm: its flags'."""
    if arm.finite_slope:
        return FINITE_SLOPE
    return STIFFENING if arm.foreshortening else FIRST_ORDER


def at_level(arm, level):
    """The same arm at a level.

    Parameters
    ----------
    arm : Arm
    level : str
        One of `LEVELS`, except `AUTO`.

    Returns
    -------
    Arm

    Raises
    ------
    ModelError
        For an unknown level, and for one above `first_order` of a model other than `chain`: the closed forms have
        their own kinematics.
    """
    if level not in LEVELS[1:]:
        raise ModelError("is unknown", field="level", value=level, limit=", ".join(LEVELS))
    if level != FIRST_ORDER and arm.model != "chain":
        problem = f"of {arm.name} supports neither foreshortening nor finite slope"
        raise ModelError(problem, field="model", value=arm.model, limit="chain")
    return replace(arm, foreshortening=level != FIRST_ORDER, finite_slope=level == FINITE_SLOPE)


def simulated(arm, level=AUTO):
    """The arm as it is simulated: at the `level` asked for, see `LEVELS`; with `auto` that of its file.

    Returns
    -------
    Arm
        Its flags `foreshortening` and `finite_slope` state the level taken.
    """
    return arm if level == AUTO else at_level(arm, level)
