# SPDX-License-Identifier: Apache-2.0
"""Draws one arm's tip after a planner's motion and after the same motion shaped."""

import numpy as np

from flexarm_dynamics.models import model

from .. import plotting
from ..plotting import DESIGNED, SLOW, plt
from . import cases, study
from .position_arm import PositionArm

#: Methods that are drawn, with their colours, and number of periods shown after the motion.
SHOWN = {"trapezoid": SLOW, "robust": DESIGNED}
AFTER = 8.0


def draw(path, seed=0):
    """Draw the tip of one link with its payload in its second motion, durations by `seed`; return the file `path`."""
    case = cases.payload(1.0, seed)
    arm = PositionArm(model.build(case.known), model.build(case.plant), 2.0 * np.pi / case.period)
    motion = case.motions[1]
    found = study.measured(arm, motion.end, motion.angle, case.period)
    given = study.candidates(motion, found, found, found)
    with plt.rc_context(plotting.STYLE):
        figure, axes = plt.subplots()
        for method, colour in SHOWN.items():
            swing = arm.follow(given[method], AFTER * case.period)
            _tip(axes, swing, 1.0 / found.frequencies.min(), method, colour)
        axes.set_xlabel("time from the start of the motion [s]")
        axes.set_ylabel("tip, from where it comes to rest [mm]")
        frequency = found.frequencies.min()
        axes.set_title(f"One link behind a position loop, {frequency:.2f} Hz measured")
        axes.legend()
        return plotting.save(figure, path)


def way(swing, period):
    """Distance of the tip from its place of rest, along the direction in which it swings, (k,) [m].

    Parameters
    ----------
    swing : Swing
        It has several periods after the motion.
    period : float
        Period of the swing; the mean over the last period is the place of rest [s].
    """
    rest = swing.tip[swing.time > swing.time[-1] - period].mean(axis=0)
    away = swing.tip - rest
    direction = np.linalg.svd(away[swing.time >= swing.end], full_matrices=False)[2][0]
    along = away @ direction
    return along if along[0] < 0.0 else -along


def _tip(axes, swing, period, method, colour):
    """The tip on the last part of its way, and as it swings."""
    along = 1e3 * way(swing, period)
    axes.plot(swing.time, along, color=colour, label=method)
    axes.axvline(swing.end, color=colour, linestyle=":", linewidth=0.8)
    if method == "trapezoid":
        span = 3.0 * np.abs(along[swing.time >= swing.end]).max()
        axes.set_ylim(-span, span)
