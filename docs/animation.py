# SPDX-License-Identifier: Apache-2.0
"""Draws the README's animation: ``. tools/env.sh; python docs/animation.py``.

Arm R moves 90 degrees in 1.2 s with a payload a third heavier than the controller knows, under the paper's slow control
alone, under its composite control, and under the control that `flexarm design` makes; the nonlinear loops are run here,
the bending is drawn to scale.
"""

from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_studies.case_study import heavier
from flexarm_studies.loop import scenario
from flexarm_studies.plotting import COMPOSITE, DESIGNED, SLOW

HERE = Path(__file__).resolve().parent
MOTION = "quintic:to=1.5708,duration=1.2"
END = 4.0  # [s]
FRAMES_PER_SECOND = 20
COLOURS = {"slow": SLOW, "composite": COMPOSITE, "designed": DESIGNED}


def run(control):
    """One run of the nonlinear loop."""
    wanted = replace(heavier.scenario_of(control), trajectory=MOTION, duration=END)
    record, metrics = scenario.run(wanted)
    print(control, {name: metrics[name] for name in ("lost", "residual_tip_rms_mm")})
    return record


def axis_of(arm, shapes, q, delta):
    """Points of the link's axis [m], shape (2, k): along the joint's angle, bent across it."""
    length = arm.links[0].length
    xi = np.linspace(0.0, 1.0, 40)
    bent = shapes(xi) @ delta
    turn = np.array([[np.cos(q), -np.sin(q)], [np.sin(q), np.cos(q)]])
    return turn @ np.array([xi * length, bent])


def main():
    """Run all three, draw, write `animation.gif`."""
    arm = arm_file.load("R")
    equations = model.build(arm)
    shapes = equations.mode_shapes(arm.links[0].name, "y")
    records = {control: run(control) for control in COLOURS}
    times = np.arange(0.0, END, 1.0 / FRAMES_PER_SECOND)

    figure, (top, below) = plt.subplots(
        2, 1, figsize=(6.4, 5.6), height_ratios=(2.6, 1), layout="constrained"
    )
    top.set(xlim=(-0.9, 1.35), ylim=(-0.08, 1.32), aspect="equal")
    top.set_axis_off()
    clock = top.text(-0.86, 0.72, "", fontsize=11)
    below.set(
        xlim=(0.0, END), ylim=(-160.0, 160.0), xlabel="time [s]", ylabel="tip deflection [mm]"
    )
    below.grid(alpha=0.3)
    drawn = []
    for control, colour in COLOURS.items():
        record, label = records[control], heavier.NAMES[control]
        (bar,) = top.plot([], [], color=colour, lw=3, solid_capstyle="round", label=label)
        (tip,) = top.plot([], [], "o", color=colour, ms=7)
        (trace,) = below.plot([], [], color=colour, lw=1.5)
        tips = 1e3 * record.plant_amplitude @ shapes(1.0)
        drawn.append((record, bar, tip, trace, tips))
    (wanted,) = top.plot([], [], color="0.6", lw=1, ls="--", label="reference, rigid")
    top.plot(0, 0, "s", color="black", ms=9)
    top.legend(loc="upper left", fontsize=9, frameon=False)

    def draw(frame):
        t = times[frame]
        clock.set_text(f"t = {t:.1f} s")
        for record, bar, tip, trace, tips in drawn:
            k = min(np.searchsorted(record.time, t), record.time.size - 1)
            points = axis_of(arm, shapes, record.plant_position[k, 0], record.plant_amplitude[k])
            bar.set_data(*points)
            tip.set_data(*points[:, -1:])
            trace.set_data(record.time[: k + 1], tips[: k + 1])
        angle = drawn[0][0].reference[k, 0]
        length = arm.links[0].length
        wanted.set_data([0, length * np.cos(angle)], [0, length * np.sin(angle)])

    writer = PillowWriter(fps=FRAMES_PER_SECOND)
    FuncAnimation(figure, draw, frames=times.size).save(HERE / "animation.gif", writer, dpi=80)


if __name__ == "__main__":
    main()
