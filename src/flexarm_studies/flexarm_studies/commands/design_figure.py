# SPDX-License-Identifier: Apache-2.0
"""Draws the results of `flexarm design`: poles and decay of all loops, what they bear, and the noise in the torque."""

import numpy as np
from matplotlib.ticker import NullLocator

from flexarm_control.robust.card import FARTHEST, poles
from flexarm_control.robust.decay import Wanted
from flexarm_control.robust.settings import NOISIEST
from flexarm_control.robust.uncertain import own_damping

from ..plotting import COMPOSITE, DESIGNED, REFERENCE, SLOW, STYLE, plt, save

LESS = "another loop: less is asked"
#: Loops with the arm as in its file, with another arm, and those with lower requirements.
KINDS = {"as in the file": DESIGNED, "another arm": COMPOSITE, LESS: SLOW}
#: Poles above this many times omega_c are not drawn.
DRAWN = 3.0


def draw(found, bears, path):
    """Draw a `Design` and its `Card`; return the file."""
    with plt.rc_context(STYLE | {"axes.titlesize": 10, "font.size": 9}):
        figure, axes = plt.subplots(2, 2, figsize=(11.0, 7.6), layout="constrained")
        _poles(axes[0, 0], found)
        _decays(axes[0, 1], found)
        _borne(axes[1, 0], found, bears)
        _noise(axes[1, 1], found, bears)
        figure.suptitle(
            f"Design for {found.arm.name}: {len(found.slowest)} loops, {found.settings.rate:g} Hz, delay"
            f" {1e3 * found.settings.delay:.3g} ms",
            fontsize=12,
        )
        return save(figure, path)


def draw_trade(rows, path):
    """Draw what designs of several speeds reach and bear; `rows` are (`Design`, `Card`), the file is returned."""
    speed = [found.settings.speed for found, _ in rows]
    found, bears = (list(column) for column in zip(*rows, strict=True))
    with plt.rc_context(STYLE | {"axes.titlesize": 10, "font.size": 9}):
        figure, axes = plt.subplots(2, 2, figsize=(10.0, 6.4), layout="constrained", sharex=True)
        (decay, factors), (margins, noise) = axes
        decay.plot(
            speed,
            [-f.worst.pole.real for f in found],
            "o-",
            color=DESIGNED,
        )
        decay.set_title("Slowest pole in the worst loop")
        decay.set_ylabel("decay [1/s]")
        decay.set_ylim(bottom=0.0)
        for name, colour in (("gain", COMPOSITE), ("payload", DESIGNED), ("stiffness", SLOW)):
            low, high = np.clip([getattr(b, name) for b in bears], 1.0 / FARTHEST, FARTHEST).T
            factors.plot(speed, high, "o-", color=colour, label=name)
            factors.plot(speed, low, "o-", color=colour)
        factors.set_yscale("log")
        _factor_ticks(factors.yaxis)
        factors.set_title(
            f"Stable between the curves (at 1/{FARTHEST:g} or {FARTHEST:g}: no limit found)"
        )
        factors.set_ylabel("factor [-]")
        factors.legend(fontsize=8)
        margins.plot(
            speed, [1e3 * b.delay for b in bears], "o-", color=COMPOSITE, label="longest delay [ms]"
        )
        margins.plot(
            speed,
            [np.degrees(b.phase) for b in bears],
            "o-",
            color=SLOW,
            label="phase margin [deg]",
        )
        margins.set_ylim(bottom=0.0)
        margins.set_title("Longest delay in all, and phase margin")
        margins.legend(fontsize=8)
        noise.plot(speed, [100.0 * max(f.noise) for f in found], "o-", color=DESIGNED)
        noise.plot(
            speed, [100.0 * NOISIEST * s for s in speed], "--", color=REFERENCE, label="allowed"
        )
        noise.set_title("Sensor noise in the torque")
        noise.set_ylim(bottom=0.0)
        noise.set_ylabel("rms over the torque limit [%]")
        noise.legend(fontsize=8)
        for ax in axes[1]:
            ax.set_xlabel("--speed [-]")
        first = found[0]
        figure.suptitle(
            f"Speed against robustness: {first.arm.name}, {first.settings.rate:g} Hz, delay"
            f" {1e3 * first.settings.delay:.3g} ms",
            fontsize=12,
        )
        return save(figure, path)


def _factor_ticks(axis):
    up = [2, 4, 8, int(FARTHEST)]
    axis.set_ticks(
        [1 / k for k in reversed(up)] + [1, *up],
        [*(f"1/{k}" for k in reversed(up)), "1", *map(str, up)],
    )
    axis.set_minor_locator(NullLocator())


def _kind(name, fraction):
    if fraction < 1.0:
        return LESS
    return "as in the file" if name.startswith("payload x 1, stiffness x 1,") else "another arm"


def _poles(axes, found):
    """The decay of each pole over its frequency, beside the required decay."""
    wanted = Wanted(found.omega_1, found.omega_c, own_damping(found.arm, found.uncertainty))
    lowest, slowest, seen = 0.2 * found.omega_1, np.inf, set()
    for name, fraction, s in poles(found):
        s, kind = s[np.abs(s) < DRAWN * found.omega_c], _kind(name, fraction)
        lowest = min(lowest, 0.8 * np.abs(s).min(initial=np.inf))
        slowest = min(slowest, (-s.real).min(initial=np.inf))
        label = None if kind in seen else kind
        seen.add(kind)
        axes.plot(
            np.abs(s) / (2.0 * np.pi), -s.real, "o", ms=4, alpha=0.7, color=KINDS[kind], label=label
        )
    omega = np.geomspace(lowest, DRAWN * found.omega_c, 400)
    asked = wanted.decay(-omega + 0j)
    # The curve of the required decay is that of real poles, whose frequency is their decay.
    axes.plot(
        omega / (2.0 * np.pi), asked, color=REFERENCE, linestyle="--", linewidth=1.0, label="asked"
    )
    axes.plot(
        omega / (2.0 * np.pi), found.decay * asked, color=REFERENCE, label="reached in all loops"
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.4 * slowest)
    axes.set_title("Poles of all loops")
    axes.set_xlabel("frequency |s| / 2 pi [Hz]")
    axes.set_ylabel("decay [1/s]")
    axes.legend(fontsize=8)


def _decays(axes, found):
    """Decay of the slowest pole of each loop over its required decay."""
    names = [row.name for row in found.slowest]
    fractions = [fraction for _, fraction, _ in poles(found)]
    values = [-row.value for row in found.slowest]
    colours = [KINDS[_kind(*row)] for row in zip(names, fractions, strict=True)]
    rows = np.arange(len(names))
    axes.barh(rows, values, color=colours, height=0.6)
    axes.axvline(found.decay, color=REFERENCE, linewidth=1.0)
    several = len(found.configurations) > 1
    short = [
        name.replace(" x ", " ").replace(", at configuration ", ", q" if several else "\0")
        for name in names
    ]
    labels = [name.split("\0")[0] for name in short]
    axes.set_yticks(rows, labels, fontsize=8 if len(names) < 12 else 6)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_title("Slowest pole of each loop")
    axes.set_xlabel("decay over what is asked of the loop [-]")


def _borne(axes, found, bears):
    """Factors within which the loops are stable, beside those for which the design is made."""
    uncertain, sampling = found.uncertainty, found.sampling
    rows = [
        ("gain", bears.gain, uncertain.gain),
        ("payload", bears.payload, uncertain.payload),
        ("stiffness", bears.stiffness, uncertain.stiffness),
    ]
    if sampling.delay > 0.0:
        later = 1.0 + uncertain.delay * sampling.period / sampling.delay
        rows.append(("delay", (1.0, bears.delay / sampling.delay), (1.0, later)))
    for k, (_, (low, high), designed) in enumerate(rows):
        ends = max(low, 1.0 / FARTHEST), min(high, FARTHEST)
        axes.plot(ends, (k, k), color=DESIGNED, linewidth=9.0, alpha=0.45, solid_capstyle="butt")
        axes.plot(designed, (k, k), color=DESIGNED, linewidth=9.0, solid_capstyle="butt")
        for end, known, marker in ((ends[0], low > 0.0, "<"), (ends[1], np.isfinite(high), ">")):
            if not known:
                axes.plot(end, k, marker, color=DESIGNED, ms=8, clip_on=False)
    axes.axvline(1.0, color=REFERENCE, linewidth=1.0)
    axes.set_xscale("log")
    axes.set_xlim(1.0 / FARTHEST, FARTHEST)
    _factor_ticks(axes.xaxis)
    axes.set_yticks(range(len(rows)), [name for name, _, _ in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    axes.set_title("Stable within (dark: designed for; arrow: no limit found)")
    axes.set_xlabel("factor of what the file and the options have, one at a time [-]")


def _noise(axes, found, bears):
    """Noise of each joint's torque; and the numbers that no axis has."""
    rows, names = np.arange(len(found.noise)), [joint.name for joint in found.arm.joints]
    axes.barh(rows, 100.0 * np.array(found.noise), color=DESIGNED, height=0.4)
    allowed = 100.0 * NOISIEST * found.settings.speed
    axes.axvline(allowed, color=REFERENCE, linestyle="--", linewidth=1.0)
    axes.set_yticks(rows, names)
    axes.set_ylim(3.0 * len(rows) - 0.6, -0.6)
    axes.grid(visible=False, axis="y")
    axes.set_title("Sensor noise in the torque (dashed: allowed)")
    axes.set_xlabel("rms over the torque limit [%]")
    numbers = (
        ("phase margin", f"{np.degrees(bears.phase):.2g} deg"),
        ("longest delay", f"{_number(1e3 * bears.delay)} ms"),
        ("damping ratio", f"{bears.damping:.2g} at least"),
        ("settling after a push at the tip", f"{bears.settling:.3g} s to 2 %"),
        ("tip stiffness, links alone", f"{_number(bears.tip_stiffness)} N/m"),
        ("tip stiffness, no integral", f"{_number(bears.tip_stiffness_proportional)} N/m"),
    )
    for k, (name, value) in enumerate(numbers):
        y = 0.58 - 0.1 * k
        axes.text(0.04, y, name, transform=axes.transAxes)
        axes.text(0.62, y, value, transform=axes.transAxes)


def _number(value):
    return "any" if not np.isfinite(value) else f"{value:.3g}"
