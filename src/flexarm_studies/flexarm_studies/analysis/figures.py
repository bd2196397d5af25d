# SPDX-License-Identifier: Apache-2.0
"""Draws the figures of an analysis: mu along the motion, poles over the slow gain, the bound on mu, quantiles."""

from pathlib import Path

import numpy as np

from ..plotting import COMPOSITE, REFERENCE, SLOW, STYLE, plt, save


def draw(found, directory):
    """Write the figures for which the analysis has data; return their paths.

    Parameters
    ----------
    found : dict
        As `command.study` returns it.
    directory : Path
        Made if it does not exist.
    """
    made, parts = (
        [],
        {
            "scales": ("mu", _mu),
            "gain_sweep": ("slow_gain", _slow_gain),
            "bound": ("bound", _bound),
        },
    )
    with plt.rc_context(STYLE):
        for part, (name, draw_part) in parts.items():
            if not found[part].get("reason"):
                figure = draw_part(found)
                figure.tight_layout()
                made.append(save(figure, Path(directory, f"{name}.png")))
    return made


def _mu(found):
    s = found["scales"]
    figure, axes = plt.subplots()
    axes.plot(s["along"]["time_s"], s["along"]["mu"], color=COMPOSITE, label="along the motion")
    low, high = s["workspace"]["mu_min"], s["workspace"]["mu_max"]
    axes.axhspan(low, high, color=REFERENCE, alpha=0.15, label="over the workspace")
    axes.set(xlabel="time [s]", ylabel="mu [-]", title="Slow over fast frequency", ylim=(0.0, None))
    axes.legend()
    return figure


def _slow_gain(found):
    figure, axes = plt.subplots()
    rows = [r for r in found["gain_sweep"]["rows"] if r["poles"] is not None]
    colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, len(rows)))
    for row, colour in zip(rows, colours, strict=True):
        re, im = np.transpose(row["poles"])
        axes.plot(re, im, ".", color=colour, label=f"{row['factor']:.2g}")
    axes.axvline(0.0, color="#000000", linewidth=0.5)
    axes.set(xlabel="real part [1/s]", ylabel="imaginary part [rad/s]")
    axes.set_title("Poles of the whole loop; colour: slow.kp times, kv critically damped")
    axes.legend(fontsize=7, ncols=2)
    return figure


def _bound(found):
    b = found["bound"]
    labels = {
        "mu": "mu",
        "bound": "bound (theorem)",
        "linear_limit": "linear loop",
        "redesign_limit": "redesigned, sampled",
    }
    figure, axes = plt.subplots(figsize=(7.0, 2.6))
    for i, (key, label) in enumerate(labels.items()):
        value = b[key]
        colour = SLOW if key == "bound" else COMPOSITE
        axes.barh(i, b["searched"] if value is None else value, color=colour)
        axes.text(b["mu"] * 0.02, i, f"{label}: {'beyond' if value is None else f'{value:.3g}'}")
    axes.set_yticks([])
    axes.invert_yaxis()
    axes.set(xlabel="mu [-]", title="How large mu may be")
    return figure
