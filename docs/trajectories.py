# SPDX-License-Identifier: Apache-2.0
"""Prints the tables of docs/trajectories.md: the residual vibration of shapers and motions.

Run `python docs/trajectories.py`. Only the slow torque (10) of the motion acts on the arm, without feedback. The full
model is integrated from rest.
"""

import numpy as np

from flexarm_control.motions import excitation, profiles, shapers
from flexarm_control.motions.least_exciting import least_exciting
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_sim.integrators import METHODS

STEP, AFTER = 1e-3, 2.0  # [s]


def simulate(arm, motion):
    """Largest deflection of the last tip along the motion, and its amplitude afterwards [mm]; peak torque [N m]."""
    n, m = arm.n_joints, arm.n_modes
    times = np.arange(round((motion.duration + AFTER) / STEP) + 1) * STEP
    states = (f(times) for f in (motion.position, motion.velocity, motion.acceleration))
    torque = np.array([excitation.reduced(arm, *s)[0] for s in zip(*states, strict=True)])
    rows = np.zeros((times.size, 2 * (n + m)))
    rows[0, :n] = motion.start
    arm.stepper(METHODS["dop853"]).trajectory(rows, torque[:-1], torque[1:], STEP)
    tip = 1e3 * np.array([arm.tip_deflection(row[n : n + m])[0] for row in rows])
    left = tip[times > motion.duration]
    return np.abs(tip).max(), 0.5 * np.ptp(left), np.abs(torque).max(axis=0)


def motions(arm, start, end, duration):
    """Yield the families with their motions, all of the same duration: a shaped motion is shorter before shaping."""
    yield "quintic", profiles.quintic(start, end, duration)
    for k in (3, 4):
        yield f"smooth, smoothness {k}", profiles.smooth(start, end, duration, k)
    for kind, count in (("zv", 1), ("zv", 2), ("zvd", 1)):
        shaper = shapers.for_arm(arm, end, kind, count)
        if shaper.duration < 0.8 * duration:
            bare = profiles.quintic(start, end, duration - shaper.duration)
            yield f"quintic, {kind} of {count}", shaper.apply(bare)
    yield "least-exciting", least_exciting(arm, start, end, duration).profile


def shaper_table():
    """Print the residual vibration of the shapers for a wrong frequency of the mode."""
    offs = (0.0, 0.05, 0.1, 0.2, 0.3)
    print("| mode off by | " + " | ".join(f"{100 * off:g} %" for off in offs) + " |")
    print("|---" * (len(offs) + 1) + "|")
    for kind, make in shapers.SHAPERS.items():
        left = [100.0 * make(1.0, 0.0).residual(1.0 + off, 0.0) for off in offs]
        print(f"| {kind} | " + " | ".join(f"{v:.1f} %" for v in left) + " |")


def main():
    shaper_table()
    for name, start, end, durations in (
        ("R", [0.0], [np.pi / 2], (1.0, 2.0)),
        ("two_link", [0.0, 0.2], [0.8, 1.0], (1.5, 3.0)),
    ):
        arm = model.build(arm_file.load(name))
        start, end = np.array(start), np.array(end)
        for duration in durations:
            print(f"\n{name}, {np.round(end - start, 4)} rad in {duration:g} s\n")
            print(
                "| motion | tip deflection on the way [mm] | tip amplitude after [mm] | peak torque [N m] |"
            )
            print("|---|---|---|---|")
            for label, motion in motions(arm, start, end, duration):
                way, after, torque = simulate(arm, motion)
                peaks = ", ".join(f"{t:.2f}" for t in torque)
                print(f"| {label} | {way:.1f} | {after:.3f} | {peaks} |")


if __name__ == "__main__":
    main()
