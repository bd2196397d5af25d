# SPDX-License-Identifier: Apache-2.0
"""Draws the figures of docs/dynamics.md and docs/tutorial/tuning.md: ``. tools/env.sh; python docs/figures.py``.

``python docs/figures.py tuning`` draws one alone.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Arm, Flexibility, Joint, Link, Payload
from flexarm_dynamics.models import model
from flexarm_sim.integrators import METHODS
from flexarm_studies.loop import scenario

HERE = Path(__file__).resolve().parent
TRUTH = HERE.parent / "tests" / "data"


def spin_up():
    """One link driven smoothly to three times its first bending frequency, with and without foreshortening."""
    arm = arm_file.load("one_link")
    first = model.build(arm).frequencies(locked=True)[0]
    top, ramp, end, step = 3.0 * first, 5.0, 8.0, 1e-3

    def acceleration(t):
        return top / ramp * (1.0 - np.cos(2.0 * np.pi * t / ramp)) if t < ramp else 0.0

    figure, (above, below) = plt.subplots(
        2, 1, figsize=(7.0, 5.0), sharex=True, height_ratios=(1, 2), layout="constrained"
    )
    t = np.arange(0.0, end, 0.01)
    speed = top * (
        np.clip(t / ramp, 0, 1) - np.sin(2 * np.pi * np.clip(t / ramp, 0, 1)) / (2 * np.pi)
    )
    above.plot(t, speed / first, color="black")
    above.axhline(1.0, color="0.6", ls="--", lw=0.8)
    above.set_ylabel("joint speed /\nfirst bending\nfrequency [-]")
    for label, each, colour in (
        ("first order: the link may stretch, so that centrifugal force softens it", arm, "tab:red"),
        (
            "foreshortening: the link keeps its length",
            replace(arm, foreshortening=True),
            "tab:blue",
        ),
    ):
        chain = model.build(each)
        advance, state = chain.driven_stepper(METHODS["dop853"]), np.zeros(6)
        times, tips = [0.0], [0.0]
        for k in range(round(end / step)):
            a, b = acceleration(k * step), acceleration((k + 1) * step)
            advance(state, np.array([a]), step, 1, None, np.array([b - a]))
            times.append((k + 1) * step)
            tips.append(chain.tip_deflection(state[1:3])[0])
            if abs(tips[-1]) > 0.4:
                break
        below.plot(times, 1e3 * np.array(tips), color=colour, label=label)
        print(
            f"{label}: largest {max(map(abs, tips)):.3f} m, last {tips[-1]:.2e} m at {times[-1]:.2f} s"
        )
    below.set_ylim(-300, 150)
    below.set_xlabel("time [s]")
    below.set_ylabel("tip deflection [mm]")
    below.legend(loc="lower right", fontsize=8)
    for ax in (above, below):
        ax.grid(alpha=0.3)
    figure.savefig(HERE / "spin_up.png", dpi=120)


def convergence():
    """Error of the natural frequencies of the two-link reference arm against the exact beam, by modes per link."""
    exact = json.loads((TRUTH / "frequencies.json").read_text())["two_link"]
    p = json.loads((TRUTH / "parameters.json").read_text())["two_link_torque"]
    figure, axes = plt.subplots(1, 2, figsize=(8.0, 3.6), sharey=True, layout="constrained")
    counts = range(1, 7)
    for ax, case in zip(axes, ("locked", "free"), strict=True):
        for rank, colour in enumerate(("tab:blue", "tab:orange", "tab:green", "tab:red")):
            worst = []
            for count in counts:
                chain = model.build(reference_arm(p, count))
                errors = [np.nan]
                for angle in (0, 60, -60, 90):
                    found = chain.frequencies(np.array([0.0, np.radians(angle)]), case == "locked")
                    if rank < found.size:
                        truth = exact[f"q2={angle} {case}"]["rad_s"][rank]
                        errors.append(abs(found[rank] / truth - 1.0))
                worst.append(np.nanmax(errors) if len(errors) > 1 else np.nan)
            ax.semilogy(counts, worst, "o-", color=colour, ms=4, label=f"frequency {rank + 1}")
        ax.axhline(0.01, color="0.6", ls="--", lw=0.8)
        ax.set_title(f"joints {case}", fontsize=10)
        ax.set_xlabel("modes per link")
        ax.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("largest relative error at\n0°, ±60°, 90° [-]")
    axes[1].legend(fontsize=8)
    figure.savefig(HERE / "convergence.png", dpi=120)


def reference_arm(p, modes):
    """The two-link arm of the reference data."""
    joints = (
        Joint("joint1", hub_inertia=p["Jh1"]),
        Joint("joint2", hub_inertia=p["Jh2"], motor_mass=p["Mm"]),
    )
    links = tuple(
        Link(name, p["L"], p["rhoA"], {"y": p["EI"]}, {"y": Flexibility(modes, "loaded")})
        for name in ("link1", "link2")
    )
    return Arm("reference", joints, links, Payload(p["Mp"]))


#: Title, and label to settings, of each row of the figure of gains.
GAINS = (
    (
        "slow.kp, slow.kv: critically damped",
        {f"kp {kp:g}, kv {2 * kp**0.5:.3g}": {"slow.kp": [kp], "slow.kv": [2 * kp**0.5]} for kp in (2.0, 6.25, 12.0)},
    ),
    ("fast.alpha", {f"alpha {a:g}": {"fast.alpha": a} for a in (1.0, 5.0, 12.0)}),
    ("fast.q of the rates", {f"q of rates {q:g}": {"fast.q": [1.0, 1.0, q, q]} for q in (1.0, 100.0, 3000.0)}),
    (
        "manifold.type and feedforward",
        {
            "quasi_steady, none: the paper's": {"manifold.type": "quasi_steady"},
            "corrected, none": {},
            "corrected, preview": {"feedforward": "preview"},
        },
    ),
)  # fmt: skip


def tuning():
    """What each gain does: arm R, 90 degrees in 2 s, with a third more payload than the controller knows of."""
    shipped = scenario.parameters("composite") | {"feedforward": "none"}
    arm = model.build(arm_file.load("R"))
    shape = arm.mode_shapes(arm.arm.links[0].name, "y")(1.0)
    figure, axes = plt.subplots(
        len(GAINS), 2, figsize=(9.0, 9.5), sharex=True, layout="constrained"
    )
    for (title, cases), (left, right) in zip(GAINS, axes, strict=True):
        for label, settings in cases.items():
            run = scenario.Scenario(
                "R", shipped | settings, "quintic:to=1.5708,duration=2", payload_scale=1.33
            )
            record, metrics = scenario.run(run)
            error = np.degrees(record.reference - record.plant_position)[:, 0]
            left.plot(record.time, error, lw=1.2, label=label)
            right.plot(record.time, 1e3 * record.plant_amplitude @ shape, lw=1.2)
            rest = metrics["residual_tip_rms_mm"]
            print(f"{title}; {label}: peak {np.abs(error).max():.3f} deg, residual {rest:.3g} mm")
        left.set_ylabel("joint error [°]")
        right.set_ylabel("tip deflection [mm]")
        left.set_title(title, fontsize=10, loc="left")
        left.legend(fontsize=8)
    for ax in axes.flat:
        ax.grid(alpha=0.3)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    figure.savefig(HERE / "tutorial" / "tuning.png", dpi=90)


if __name__ == "__main__":
    for draw in (spin_up, convergence, tuning):
        if not sys.argv[1:] or draw.__name__ in sys.argv[1:]:
            draw()
