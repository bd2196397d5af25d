# SPDX-License-Identifier: Apache-2.0
"""Draws what rings: spectrum, decay and fit, frequencies, and what each shaper leaves at which delay."""

import numpy as np

from ..commands.options import check_file
from ..plotting import COMPOSITE, REFERENCE, SLOW, plt, save
from ..recordings.summary import UNITS, spectrum

#: Number of windows whose decay is drawn.
DECAYS = 3


def draw(made, path):
    """Draw the `Study` that was `made`; return the path.

    Raises
    ------
    FlexarmError
        If the path is not that of a picture.
    """
    path = check_file(path, "--figure")
    figure = plt.figure(figsize=(13.0, 8.0), layout="constrained")
    left, right = figure.subfigures(1, 2)
    decays = left.subplots(min(len(made.windows), DECAYS), 1, squeeze=False)[:, 0]
    for ax, window in zip(decays, _strongest(made), strict=True):
        _decay(ax, made.channels, window)
    decays[-1].set_xlabel("time [s]")
    spectra, frequencies, delays = right.subplots(3, 1)
    _spectra(spectra, made)
    _frequencies(frequencies, made)
    _delays(delays, made.recommendation)
    return str(save(figure, path, dpi=110))


def _strongest(made):
    """The windows that ring most for their channel, in the order of time."""
    size = made.channels.values.std(axis=0)
    order = sorted(made.windows, key=lambda w: -(w.fit.measured.std(axis=0) / size).max())
    return sorted(order[:DECAYS], key=lambda w: w.begin)


def _decay(ax, channels, window):
    made = window.fit
    at = int(np.argmax(made.explained))
    ax.plot(
        window.begin + made.time, made.measured[:, at], ".", ms=3, color=REFERENCE, label="measured"
    )
    ax.plot(window.begin + made.time, made.fitted[:, at], color=COMPOSITE, label="fit")
    modes = ", ".join(f"{m.frequency:.3g} Hz ({100.0 * m.damping:.2g} %)" for m in made.modes)
    ax.set(title=modes, ylabel=f"{channels.names[at]} [{UNITS[channels.quantities[at]]}]")
    ax.legend(fontsize=7, loc="upper right")


def _spectra(ax, made):
    channels = made.channels
    for name, values in zip(channels.names, channels.values.T, strict=True):
        frequency, power = spectrum(values, channels.period)
        ax.semilogy(frequency[1:], np.sqrt(power[1:] / power[1:].max()), lw=0.8, label=name)
    for spread in made.spreads:
        ax.axvspan(spread.low, spread.high, color="0.88", lw=0.0)
    highest = 2.0 * max(s.high for s in made.spreads)
    ax.set(xlim=(0.0, min(highest, frequency[-1])), ylim=(1e-3, 1.5))
    ax.set(title="spectra of the channels, over their largest value", xlabel="frequency [Hz]")
    ax.legend(fontsize=7, ncols=2)


def _frequencies(ax, made):
    for number, family in enumerate(made.families):
        at = [made.windows[i].begin for i in family.windows]
        value, width = family.values("frequency"), family.values("frequency_width")
        ax.errorbar(at, value, width, fmt="o", ms=4, color=f"C{number}")
    ax.set(
        yscale="log",
        title="modes, with 95 % intervals",
        xlabel="time of the window [s]",
        ylabel="[Hz]",
    )


def _delays(ax, found):
    for candidate in found.candidates:
        colour = SLOW if candidate is found.chosen else COMPOSITE
        ax.plot(candidate.delay, 100.0 * candidate.residual, "o", color=colour)
        where = (candidate.delay, 100.0 * candidate.residual)
        ax.annotate(candidate.kind, where, (4, 4), textcoords="offset points", fontsize=7)
    ax.axhline(100.0 * found.wanted, color=REFERENCE, ls="--", lw=0.8)
    ax.set(
        yscale="log",
        title="what is left, and at which delay",
        xlabel="delay [s]",
        ylabel="residual [%]",
    )
