# SPDX-License-Identifier: Apache-2.0
"""Draws what a recording shows: its channels over time, spectra, noise, ring-downs."""

import numpy as np

from ..commands.options import check_file
from ..plotting import plt, save
from .summary import UNITS, channels, spectrum

#: Factor and unit in which a signal is drawn.
DRAWN = {"strain": (1e6, "microstrain"), "position": (180.0 / np.pi, "deg")}
#: Signals over time, from the top.
OVER_TIME = ("position", "velocity", "torque", "current", "strain", "amplitude")


def draw(recording, found, path):
    """Draw a recording and the summary `found` of it; return the path.

    Raises
    ------
    FlexarmError
        For a path that is not that of a picture.
    """
    path = check_file(path)
    rows = [q for q in OVER_TIME if any(quantity == q for quantity, *_ in channels(recording))]
    height = max(len(rows), 3)
    figure = plt.figure(figsize=(14.0, 2.2 * height + 0.6), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(3, 2))
    for ax, quantity in zip(
        left.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0], rows, strict=True
    ):
        _over_time(ax, recording, found, quantity)
    ax.set_xlabel("time [s]")
    spectra, noise, rings = right.subplots(3, 1)
    _spectra(spectra, recording)
    _noise(noise, found["noise"])
    _rings(rings, found["ring_downs"])
    return str(save(figure, path, dpi=110))


def _over_time(ax, recording, found, quantity):
    factor, unit = DRAWN.get(quantity, (1.0, UNITS[quantity]))
    time = recording.start + recording.time
    for rest in found["rest"]:
        ax.axvspan(rest["from_s"], rest["to_s"], color="0.92", lw=0.0)
    for gap in found["gaps"]:
        ax.axvline(gap["at_s"], color="tab:red", lw=0.6)
    for name, values in [(n, v) for q, n, v in channels(recording) if q == quantity]:
        ax.plot(time, factor * values, lw=0.6, label=name)
    ax.set_ylabel(f"{quantity} [{unit}]")
    ax.legend(fontsize=7, ncols=4, loc="upper right")


def _spectra(ax, recording):
    for quantity, name, values in channels(recording):
        if quantity == "strain" and np.isfinite(values).all():
            frequency, power = spectrum(values, recording.period)
            ax.semilogy(frequency[1:], 1e6 * np.sqrt(power[1:]), lw=0.8, label=name)
    ax.set(xlabel="frequency [Hz]", ylabel="microstrain/Hz^0.5", title="spectra of the gauges")
    if ax.lines:
        ax.legend(fontsize=7)


def _noise(ax, noise):
    ax.set_title("correlation of the noise at rest")
    if noise is None:
        ax.text(0.5, 0.5, "no rest without vibration", ha="center")
        return
    table = np.array(noise["correlation"], float)
    names = noise["gauges"]
    ax.imshow(table, vmin=-1.0, vmax=1.0, cmap="RdBu_r", aspect="auto")
    ax.set_xticks(range(len(names)), names, fontsize=7)
    ax.set_yticks(range(len(names)), names, fontsize=7)
    for i, j in np.ndindex(table.shape):
        ax.text(j, i, f"{table[i, j]:.2f}", ha="center", va="center", fontsize=7)


def _rings(ax, rings):
    ax.set(title="ring-downs", xlabel="time [s]", ylabel="frequency [Hz]")
    damping = ax.twinx()
    damping.set_ylabel("damping ratio", color="tab:orange")
    for ring in rings:
        at = ring["from_s"]
        ax.errorbar(
            at,
            ring["frequency_hz"],
            ring["frequency_half_width_hz"],
            fmt="o",
            color="tab:blue",
            ms=4,
        )
        damping.errorbar(
            at, ring["damping"], ring["damping_half_width"], fmt="s", color="tab:orange", ms=3
        )
