# SPDX-License-Identifier: Apache-2.0
"""A figure of one arm's tip after a planner's motion and after the same motion shaped."""

import numpy as np

from flexarm_dynamics.models import model

from .. import plotting
from ..plotting import DESIGNED, SLOW, plt
from . import cases, study
from .position_arm import PositionArm

#: What is drawn, and for how many periods after the motion.
SHOWN = {"trapezoid": SLOW, "robust": DESIGNED}
AFTER = 8.0


def draw(path, seed=0):
    """Draw one link with its payload, its second motion; the file `path`. Durations by `seed`."""
    case = cases.payload(1.0, seed)
    arm = PositionArm(model.build(case.known), model.build(case.plant), 2.0 * np.pi / case.period)
    motion = case.motions[1]
    found = study.measured(arm, motion.end, motion.angle, case.period)
    given = study.candidates(motion, found, found, found)
    with plt.rc_context(plotting.STYLE):
        figure, axes = plt.subplots()
        for method, colour in SHOWN.items():
            swing = arm.follow(given[method], AFTER * case.period)
            _tip(axes, swing, method, colour)
        axes.set_xlabel("time from the start of the motion [s]")
        axes.set_ylabel("tip, from where it comes to rest [mm]")
        frequency = found.frequencies.min()
        axes.set_title(f"One link behind a position loop, {frequency:.2f} Hz measured")
        axes.legend()
        return plotting.save(figure, path)


def _tip(axes, swing, method, colour):
    """The tip along the direction in which it swings."""
    away = swing.tip - swing.tip[-1]
    after = away[swing.time >= swing.end]
    direction = np.linalg.svd(after, full_matrices=False)[2][0]
    axes.plot(swing.time, 1e3 * away @ direction, color=colour, label=method)
    axes.axvline(swing.end, color=colour, linestyle=":", linewidth=0.8)
    span = 3e3 * np.abs(after @ direction).max()
    if method == "trapezoid":
        axes.set_ylim(-span, span)
