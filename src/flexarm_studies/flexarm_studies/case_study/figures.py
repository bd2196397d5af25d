# SPDX-License-Identifier: Apache-2.0
"""Draws figures 2-11 of the paper, slow control against composite control; each figure shows one thing.

Axes are in the paper's units (degrees, feet, lbf ft), so the figures can be compared with the published ones.
"""

from pathlib import Path

import numpy as np

from flexarm_dynamics.arm.units import FOOT, POUND_FORCE_FOOT

from ..loop.metrics import tip_path
from ..plotting import COMPOSITE, DESIGNED, REFERENCE, SLOW, STYLE, plt, save
from . import heavier

#: One sample in four is drawn: 250 points a second, 17 a period of the second mode.
PLOTTED_EVERY = 4
#: Time span of figures of the motion itself [s].
MOTION = 4.0


def draw(directory, title, slow, composite, model):
    """Write all figures of one arm as PNG and SVG to a `directory`; return the PNG files.

    `slow` and `composite` are the records without and with fast control; every `title` names arm and gain.
    """
    slow, composite = slow.thinned(PLOTTED_EVERY), composite.thinned(PLOTTED_EVERY)
    made = []
    with plt.rc_context(STYLE):
        for name, figure in _figures(slow, composite, model, title):
            figure.tight_layout()
            made.append(save(figure, *(Path(directory, f"{name}.{s}") for s in ("png", "svg"))))
    return made


def _figures(slow, composite, model, title):
    """Names and figures."""
    reference = {"color": REFERENCE, "label": "reference"}
    joint = {"color": COMPOSITE, "linewidth": 0.9, "label": "joint, composite control"}
    yield "fig02_reference_velocity", _figure(
        f"Fig. 2  Reference joint velocity profile  ({title})", "joint velocity [deg/s]",
        (composite, _degrees(composite.reference_velocity), reference),
        (composite, _degrees(composite.velocity), joint), until=MOTION,
    )  # fmt: skip
    alone = {"color": SLOW, "label": "slow control alone", "linewidth": 0.9}
    damped = {"color": COMPOSITE, "label": "composite control", "linewidth": 1.6}
    for name, heading, unit, of in _comparisons(model):
        curves = (slow, of(slow), alone), (composite, of(composite), damped)
        yield name, _figure(f"{heading}  ({title})", unit, *curves)
    # Figure 5 does not show the deflection at which the fast control holds the link.
    steady = {
        "color": REFERENCE,
        "linestyle": "--",
        "label": r"quasi-steady state $\bar\delta_1$, (9)",
    }
    mode = {"color": COMPOSITE, "label": r"$\delta_1$"}
    yield "fig05b_quasi_steady_state", _figure(
        f"First mode and its quasi-steady state, composite control  ({title})", "deflection [ft]",
        (composite, composite.quasi_steady[:, 0] / FOOT, steady),
        (composite, composite.amplitude[:, 0] / FOOT, mode), until=MOTION,
    )  # fmt: skip
    yield "fig11_torques", _torques(slow, composite, title)
    yield "overview", overview(slow, composite, model, title)


def _figure(title, unit, *curves, until=None):
    """A figure with one panel; each curve is a record, the values, and how they are drawn."""
    figure, axes = plt.subplots()
    for record, values, style in curves:
        axes.plot(record.time, values, **style)
    _finish(axes, title, unit, curves[0][0].time[-1] if until is None else until)
    return figure


def _finish(axes, title, unit, until):
    axes.set_title(title)
    axes.set_xlabel("time from the start of the trajectory [s]")
    axes.set_ylabel(unit)
    axes.axvspan(0.0, 2.0, color="#000000", alpha=0.04, linewidth=0)
    axes.axhline(0.0, color="#000000", linewidth=0.5)
    axes.set_xlim(0.0, until)
    axes.legend(loc="upper right")


def _degrees(values):
    return np.degrees(values[:, 0])


def _angle_error(record):
    return _degrees(record.reference - record.position)


def _torque(record):
    return record.torque[:, 0] / POUND_FORCE_FOOT


def _comparisons(model):
    """(file name, heading, y label, function of a record) of figures 3 to 10."""
    x = lambda r: np.subtract(*r.tip_x(model)) * -1.0 / FOOT  # noqa: E731
    xd = lambda r: np.subtract(*r.tip_x_rate(model)) * -1.0 / FOOT  # noqa: E731
    return [
        ("fig03_joint_angle_error", "Fig. 3  Joint angle tracking error",
         "reference - joint angle [deg]", _angle_error),
        ("fig04_joint_velocity_error", "Fig. 4  Joint velocity tracking error",
         "reference - joint velocity [deg/s]", lambda r: _degrees(r.reference_velocity - r.velocity)),
        ("fig05_mode1_deflection", "Fig. 5  First mode deflection",
         r"$\delta_1$ [ft]", lambda r: r.amplitude[:, 0] / FOOT),
        ("fig06_mode2_deflection", "Fig. 6  Second mode deflection",
         r"$\delta_2$ [ft]", lambda r: r.amplitude[:, 1] / FOOT),
        ("fig07_mode1_rate", "Fig. 7  First mode deflection rate",
         r"$\dot\delta_1$ [ft/s]", lambda r: r.rate[:, 0] / FOOT),
        ("fig08_mode2_rate", "Fig. 8  Second mode deflection rate",
         r"$\dot\delta_2$ [ft/s]", lambda r: r.rate[:, 1] / FOOT),
        ("fig09_tip_position_error", "Fig. 9  End point position tracking error along $X_0$",
         "rigid arm on the reference - end point [ft]", x),
        ("fig10_tip_velocity_error", "Fig. 10  End point velocity tracking error along $X_0$",
         "rigid arm on the reference - end point [ft/s]", xd),
    ]  # fmt: skip


def _torques(slow, composite, title):
    figure, (left, right) = plt.subplots(1, 2, sharey=True, figsize=(9.0, 3.8))
    left.plot(slow.time, _torque(slow), color=SLOW, label="slow = total")
    _finish(left, "slow control alone", "joint torque [lbf ft]", MOTION)
    for values, colour, label in (
        (composite.slow_torque, SLOW, r"slow $\bar u$"),
        (composite.fast_torque, "#6a994e", "fast $u_f$"),
        (composite.torque, COMPOSITE, r"total $u = \bar u + u_f$"),
    ):
        right.plot(composite.time, values[:, 0] / POUND_FORCE_FOOT, color=colour, label=label)
    _finish(right, "composite control", "", MOTION)
    for axes in (left, right):
        axes.set_xticks(range(5))
    figure.suptitle(f"Fig. 11  Control torques  ({title})", fontsize=11)
    return figure


def overview(slow, composite, model, title):
    """The whole case study on one page: tip, vibration, joint error, torque."""
    tip = lambda r: r.tip_deflection(model) / FOOT  # noqa: E731
    end = slow.time[-1]
    panels = [
        ("Tip deflection: what rings", "tip deflection [ft]", tip, end),
        ("The same after the motion", "tip deflection [ft]", tip, end),
        (
            "Joint angle error: what damping costs",
            "reference - joint angle [deg]",
            _angle_error,
            end,
        ),
        ("Torque", "joint torque [lbf ft]", _torque, MOTION),
    ]
    figure, axes = plt.subplots(2, 2, figsize=(11.0, 6.4))
    for ax, (heading, unit, of, until) in zip(axes.flat, panels, strict=True):
        ax.plot(slow.time, of(slow), color=SLOW, linewidth=0.9, label="slow control alone")
        ax.plot(composite.time, of(composite), color=COMPOSITE, linewidth=1.6, label="composite")
        _finish(ax, heading, unit, until)
    axes[0, 1].set_xlim(3.0, end)
    size = 1.3 * np.abs(tip(slow)[slow.time >= 3.0]).max()
    axes[0, 1].set_ylim(-size, size)
    figure.suptitle(
        f"{title}: 90 deg in 2 s (shaded), with and without the fast control", fontsize=12
    )
    return figure


def draw_heavier(directory, records, model, heavier_model):
    """Write the figure of the controls with a heavier payload as PNG and SVG to a `directory`; return the PNG file.

    `records` are those of `heavier.run`, by control; `heavier_model` is that of the simulated arm.
    """
    looks = {"slow": (SLOW, 0.9), "composite": (COMPOSITE, 1.3), "designed": (DESIGNED, 1.9)}
    panels = (
        ("Joint angle error", "reference - joint angle [deg]", _angle_error),
        ("The same, enlarged", "reference - joint angle [deg]", _angle_error),
        (
            "Tip deflection after the motion: what rings",
            "tip deflection [ft]",
            lambda r: r.tip_deflection(model) / FOOT,
        ),
        (
            "Distance of the tip from the reference (dashed: 1 mm)",
            "tip distance [mm]",
            lambda r: _tip_distance(r, model, heavier_model),
        ),
    )
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2, 2, figsize=(11.0, 6.4))
        for ax, (title, unit, of) in zip(axes.flat, panels, strict=True):
            for control, record in records.items():
                colour, width = looks[control]
                label = heavier.NAMES[control]
                ax.plot(record.time, of(record), color=colour, linewidth=width, label=label)
            _finish(ax, title, unit, record.time[-1])
        shown = 1.4 * max(np.abs(_angle_error(records[c])).max() for c in ("slow", "designed"))
        axes[0, 1].set_ylim(-shown, shown)
        axes[1, 0].set_xlim(2.0, record.time[-1])
        axes[1, 0].set_ylim(-0.03, 0.03)
        axes[1, 1].set_yscale("log")
        axes[1, 1].set_ylim(1e-3, 300.0)
        axes[1, 1].axhline(1.0, color=REFERENCE, linestyle="--", linewidth=0.9)
        figure.suptitle(
            f"arm R with {heavier.PAYLOAD:.2f} times the payload that the controller knows: 90 deg in 2 s (shaded),"
            f" {heavier.RATE:g} Hz, delay {1e3 * heavier.DELAY:g} ms",
            fontsize=12,
        )
        figure.tight_layout()
        return save(figure, *(Path(directory, f"overview.{s}") for s in ("png", "svg")))


def _tip_distance(record, model, heavier_model):
    """Distance of the simulated arm's tip from that of the rigid arm on the reference [mm]."""
    tip = tip_path(heavier_model, record.plant_position, record.plant_amplitude)
    straight = np.zeros((record.time.size, model.n_modes))
    return 1e3 * np.linalg.norm(tip - tip_path(model, record.reference, straight), axis=1)
