# SPDX-License-Identifier: Apache-2.0
"""Runs a controller on uncertain plants: it is set up once for an arm, and gives a row for each plant."""

import time

from flexarm_dynamics.errors import FlexarmError

from . import trial
from .plants import VARIANTS

#: Significant digits of the numbers in a row.
DIGITS = 6


def key(arm, controller, variant):
    """Key of a run in a file of rows."""
    return f"{arm}/{controller}/{variant}"


def rows(case, label, controller, make, variants, seed=0):
    """Set a controller up for an arm and run these variants.

    Parameters
    ----------
    case : RandomArm or ArmTask
    label : str or int
        Label of the arm in keys.
    controller : str
    make : callable
        Makes the `Setup` from the case. A FlexarmError that it raises refuses all variants.
    variants : sequence of str
    seed : int
        Of the noise.

    Returns
    -------
    list of dict
        Rows, each with ``sample`` (its `key`), ``arm``, ``controller``, ``variant``, ``seconds`` of computing,
        properties ``found`` of the setup's design, and what `trial.run` returns.
    """
    begin, refused, setup = time.monotonic(), None, None
    try:
        setup = make(case)
    except FlexarmError as error:
        refused = str(error)
    found = []
    for variant in variants:
        if refused is None:
            result = setup.found | trial.run(case, setup, VARIANTS[variant], seed=seed)
        else:
            result = {"refused": refused}
        now = time.monotonic()
        found.append(
            {
                "sample": key(label, controller, variant),
                "arm": case.name,
                "controller": controller,
                "variant": variant,
                "seconds": round(now - begin, 3),
                **{name: _short(value) for name, value in result.items()},
            }
        )
        begin = now
    return found


def _short(value):
    """A number with `DIGITS` significant digits; anything else as it is."""
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
