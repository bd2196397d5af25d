# SPDX-License-Identifier: Apache-2.0
"""Figures 2-11 of the paper, slow control against composite; one figure, one story.

Axes are in the paper's units (degrees, feet, lbf ft), so that they can be laid beside the published ones.
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from flexarm_dynamics.arm.units import FOOT, POUND_FORCE_FOOT

SLOW, COMPOSITE, REFERENCE = "#c1502e", "#1f5a94", "#555555"
#: One sample in four is drawn: 250 points a second, 17 a period of the second mode.
PLOTTED_EVERY = 4
STYLE = {
    "figure.figsize": (7.0, 3.8),
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "font.size": 10,
    "axes.titlesize": 11,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "svg.hashsalt": "flexarm",
}


def _degrees(values):
    return np.degrees(values[:, 0])


def draw(directory, title, slow, composite, model):
    """Write all figures of one arm as PNG and SVG.

    Parameters
    ----------
    directory : Path
        Made if it is not there.
    title : str
        Which arm and gain, in every title.
    slow, composite : Record
        The run without and with fast control.
    model : OneLinkEquations
        For the tip.

    Returns
    -------
    list of Path
        The PNG files.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    slow, composite = slow.thinned(PLOTTED_EVERY), composite.thinned(PLOTTED_EVERY)
    made = []

    def save(figure, name):
        figure.tight_layout()
        for suffix in ("png", "svg"):
            path = directory / f"{name}.{suffix}"
            figure.savefig(path, metadata={"Date": None} if suffix == "svg" else {"Software": None})
        made.append(directory / f"{name}.png")
        plt.close(figure)

    with plt.rc_context(STYLE):
        save(_profile(composite, title), "fig02_reference_velocity")
        for name, heading, unit, of in _comparisons(model):
            figure, axes = plt.subplots()
            for record, colour, label, width in (
                (slow, SLOW, "slow control alone", 0.9),
                (composite, COMPOSITE, "composite control", 1.6),
            ):
                axes.plot(record.time, of(record), color=colour, label=label, linewidth=width)
            _finish(axes, f"{heading}  ({title})", unit, slow)
            save(figure, name)
        save(_quasi_steady(composite, model, title), "fig05b_quasi_steady_state")
        save(_torques(slow, composite, title), "fig11_torques")
        save(overview(slow, composite, model, title), "overview")
    return made


def _finish(axes, title, unit, record):
    axes.set_title(title)
    axes.set_xlabel("time from the start of the trajectory [s]")
    axes.set_ylabel(unit)
    axes.axvspan(0.0, 2.0, color="#000000", alpha=0.04, linewidth=0)
    axes.axhline(0.0, color="#000000", linewidth=0.5)
    axes.set_xlim(0.0, record.time[-1])
    axes.legend(loc="upper right")


def _profile(record, title):
    figure, axes = plt.subplots()
    axes.plot(record.time, _degrees(record.reference_velocity), color=REFERENCE, label="reference")
    axes.plot(
        record.time,
        _degrees(record.velocity),
        color=COMPOSITE,
        linewidth=0.9,
        label="joint, composite control",
    )
    _finish(
        axes,
        f"Fig. 2  Reference joint velocity profile  ({title})",
        "joint velocity [deg/s]",
        record,
    )
    axes.set_xlim(0.0, 4.0)
    return figure


def _comparisons(model):
    """(file name, heading, y label, function of a record) of figures 3 to 10."""
    x = lambda r: np.subtract(*r.tip_x(model)) * -1.0 / FOOT  # noqa: E731
    xd = lambda r: np.subtract(*r.tip_x_rate(model)) * -1.0 / FOOT  # noqa: E731
    return [
        (
            "fig03_joint_angle_error",
            "Fig. 3  Joint angle tracking error",
            "reference - joint angle [deg]",
            lambda r: _degrees(r.reference - r.position),
        ),
        (
            "fig04_joint_velocity_error",
            "Fig. 4  Joint velocity tracking error",
            "reference - joint velocity [deg/s]",
            lambda r: _degrees(r.reference_velocity - r.velocity),
        ),
        (
            "fig05_mode1_deflection",
            "Fig. 5  First mode deflection",
            r"$\delta_1$ [ft]",
            lambda r: r.amplitude[:, 0] / FOOT,
        ),
        (
            "fig06_mode2_deflection",
            "Fig. 6  Second mode deflection",
            r"$\delta_2$ [ft]",
            lambda r: r.amplitude[:, 1] / FOOT,
        ),
        (
            "fig07_mode1_rate",
            "Fig. 7  First mode deflection rate",
            r"$\dot\delta_1$ [ft/s]",
            lambda r: r.rate[:, 0] / FOOT,
        ),
        (
            "fig08_mode2_rate",
            "Fig. 8  Second mode deflection rate",
            r"$\dot\delta_2$ [ft/s]",
            lambda r: r.rate[:, 1] / FOOT,
        ),
        (
            "fig09_tip_position_error",
            "Fig. 9  End point position tracking error along $X_0$",
            "rigid arm on the reference - end point [ft]",
            x,
        ),
        (
            "fig10_tip_velocity_error",
            "Fig. 10  End point velocity tracking error along $X_0$",
            "rigid arm on the reference - end point [ft/s]",
            xd,
        ),
    ]


def _quasi_steady(record, model, title):
    """What figure 5 does not show: the deflection that the fast control holds on to."""
    figure, axes = plt.subplots()
    axes.plot(
        record.time,
        record.quasi_steady[:, 0] / FOOT,
        color=REFERENCE,
        linestyle="--",
        label=r"quasi-steady state $\bar\delta_1$, (9)",
    )
    axes.plot(record.time, record.amplitude[:, 0] / FOOT, color=COMPOSITE, label=r"$\delta_1$")
    _finish(
        axes,
        f"First mode and its quasi-steady state, composite control  ({title})",
        "deflection [ft]",
        record,
    )
    axes.set_xlim(0.0, 4.0)
    return figure


def _torques(slow, composite, title):
    figure, (left, right) = plt.subplots(1, 2, sharey=True, figsize=(9.0, 3.8))
    left.plot(slow.time, slow.torque[:, 0] / POUND_FORCE_FOOT, color=SLOW, label="slow = total")
    _finish(left, "slow control alone", "joint torque [lbf ft]", slow)
    for values, colour, label in (
        (composite.slow_torque, SLOW, r"slow $\bar u$"),
        (composite.fast_torque, "#6a994e", "fast $u_f$"),
        (composite.torque, COMPOSITE, r"total $u = \bar u + u_f$"),
    ):
        right.plot(composite.time, values[:, 0] / POUND_FORCE_FOOT, color=colour, label=label)
    _finish(right, "composite control", "", composite)
    for axes in (left, right):
        axes.set_xlim(0.0, 4.0)
        axes.set_xticks(range(5))
    figure.suptitle(f"Fig. 11  Control torques  ({title})", fontsize=11)
    return figure


def overview(slow, composite, model, title):
    """The whole case study on one page: tip, vibration, joint error, torque."""
    figure, axes = plt.subplots(2, 2, figsize=(11.0, 6.4))
    panels = [
        (
            "Tip deflection: what rings",
            "tip deflection [ft]",
            lambda r: r.tip_deflection(model) / FOOT,
        ),
        (
            "The same after the motion",
            "tip deflection [ft]",
            lambda r: r.tip_deflection(model) / FOOT,
        ),
        (
            "Joint angle error: what damping costs",
            "reference - joint angle [deg]",
            lambda r: _degrees(r.reference - r.position),
        ),
        ("Torque", "joint torque [lbf ft]", lambda r: r.torque[:, 0] / POUND_FORCE_FOOT),
    ]
    for ax, (heading, unit, of) in zip(axes.flat, panels, strict=True):
        ax.plot(slow.time, of(slow), color=SLOW, linewidth=0.9, label="slow control alone")
        ax.plot(composite.time, of(composite), color=COMPOSITE, linewidth=1.6, label="composite")
        _finish(ax, heading, unit, slow)
    axes[0, 1].set_xlim(3.0, slow.time[-1])
    late = slow.time >= 3.0
    size = 1.3 * np.abs(slow.tip_deflection(model)[late]).max() / FOOT
    axes[0, 1].set_ylim(-size, size)
    axes[1, 1].set_xlim(0.0, 4.0)
    figure.suptitle(
        f"{title}: 90 deg in 2 s (shaded), with and without the fast control", fontsize=12
    )
    return figure
