# SPDX-License-Identifier: Apache-2.0
"""Draws the report's figures as SVG inside the page; a figure that is too large becomes a PNG.

All figures have the same time axis, and each run has one colour. Series are thinned to the smallest and largest value
of each bin, so no peak is lost.
"""

import base64
import io
import re
from dataclasses import dataclass

import matplotlib
import numpy as np

from flexarm_studies.plotting import COMPOSITE, DESIGNED, REFERENCE, SLOW, plt
from flexarm_studies.plotting import STYLE as PAPER_STYLE

from . import analysis
from .run import FAULT, STATES
from .timeline import broken, stretches, thinned

STYLE = PAPER_STYLE | {
    "svg.fonttype": "none",
    "font.size": 9,
    "axes.titlesize": 10,
    "lines.linewidth": 1.2,
    "axes.titlelocation": "left",
}
COLOURS = (COMPOSITE, SLOW, DESIGNED, "#8a5fa8", "#b8860b", "#4f8f9f", "#a0456e", "#6b6b6b")
#: Colours of the supervisor's states, in their order.
STATE_COLOURS = ("#d0d0d0", "#9cc3e0", "#2e7d4f", "#8fcf9f", "#e0a030", "#c62828")
UNKNOWN = "#f4f4f4"
WIDTH = 10.5
#: Bins of a thinned series across the whole width; largest SVG, beyond which a figure becomes a PNG [bytes].
BINS, MAX_SVG = 900, 350_000
#: Largest number of panels with modes or gauges.
MAX_PANELS = 12
DEGREES = 180.0 / np.pi


@dataclass(frozen=True)
class Figure:
    """A figure of the page.

    Attributes
    ----------
    name, title, caption : str
    image : str
        HTML.
    times : list of (float, float, float, float, float, float)
        Time axes: left, right, bottom and top as fractions of the figure, and their limits [s].
    """

    name: str
    title: str
    caption: str
    image: str
    times: list


def plain(text):
    """A name escaped for matplotlib, so a dollar starts no formula, and a leading underscore hides nothing."""
    text = text.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def colour(i):
    """Colour of the i-th run."""
    return COLOURS[i % len(COLOURS)]


def draw(runs, moves, spectra, label, png=False):
    """Draw all figures for which the runs have data; return a list of `Figure`.

    Parameters
    ----------
    runs : list of Run
    moves : list of list of Motion
    spectra : list of (Spectrum or None)
    label : str
        Meaning of time zero, in words.
    png : bool
        Draw all figures as PNG.
    """
    paper = _Paper(runs, moves, label, png)
    with plt.rc_context(STYLE):
        made = [
            paper.supervisor(),
            paper.tracking(),
            paper.modes(),
            paper.spectra(spectra),
            paper.torques(),
            paper.strains(),
            paper.timing(),
        ]
    return [figure for figure in made if figure is not None]


class _Paper:
    def __init__(self, runs, moves, label, png):
        self.runs, self.moves, self.label, self.png = runs, moves, label, png
        self.limits = min(r.time[0] for r in runs), max(r.time[-1] for r in runs)
        if self.limits[0] == self.limits[1]:
            self.limits = self.limits[0] - 0.5, self.limits[0] + 0.5

    # Drawing -----------------------------------------------------------------------------------

    def _grid(self, rows, columns, height, **kwargs):
        """A grid of axes of time, and the figure."""
        size = (WIDTH, max(height * rows + 0.55, 1.9))
        figure, axes = plt.subplots(
            rows, columns, figsize=size, squeeze=False, layout="constrained", **kwargs
        )
        return figure, axes

    def _panels(self, names, height, **kwargs):
        """A grid of axes, two in a row, for the first `MAX_PANELS` names: figure, axes, (axis, name) of each."""
        shown = names[:MAX_PANELS]
        columns = min(len(shown), 2)
        figure, axes = self._grid(-(-len(shown) // columns), columns, height, **kwargs)
        for ax in axes.ravel()[len(shown) :]:
            ax.axis("off")
        return figure, axes, list(zip(axes.ravel(), shown, strict=False))

    def _series(self, axes, run, values, bins=BINS, **style):
        if values is None or not np.isfinite(values).any():
            return False
        limit = 1.5 * run.period if run.period > 0.0 else np.inf
        axes.plot(*thinned(*broken(run.time, values, limit), bins), **style)
        return True

    def _times(self, axes):
        """Finish time axes."""
        for row in axes:
            for ax in row:
                ax.set_xlim(*self.limits)
                for moves, run in zip(self.moves, self.runs, strict=True):
                    for move in moves[:50] if len(self.runs) == 1 else []:
                        ax.axvspan(
                            run.time[move.start],
                            run.time[move.end - 1],
                            color="#000000",
                            alpha=0.04,
                            linewidth=0,
                        )
        for ax in axes[-1]:
            ax.set_xlabel(f"time {self.label} [s]")

    def _legend(self, figure, entries):
        """A legend above all axes."""
        entries = list(dict.fromkeys(entries))
        handles = [plt.Line2D([], [], **dict(style), label=plain(text)) for text, style in entries]
        if handles:
            figure.legend(handles=handles, loc="outside upper left", ncols=min(len(handles), 6))

    def _entries(self):
        return [
            (run.label, (("color", colour(i)),))
            for i, run in enumerate(self.runs)
            if len(self.runs) > 1
        ]

    def _finish(self, figure, name, title, caption, times=None, entries=()):
        self._legend(figure, entries)
        if times is not None:
            self._times(times)
        image = "" if self.png else svg(figure, name)
        if self.png or len(image) > MAX_SVG:
            image = _png(figure, title)
        places = []  # known only after saving, which does the layout
        for ax in () if times is None else times.ravel():
            box = ax.get_position()
            places.append((box.x0, box.x1, box.y0, box.y1, *ax.get_xlim()))
        plt.close(figure)
        return Figure(name, title, caption, image, places)

    # Figures -----------------------------------------------------------------------------------

    def supervisor(self):
        runs = [r for r in self.runs if r.has("controller/state")]
        if not runs:
            return None
        figure, axes = self._grid(1, 1, 0.34 * len(self.runs) + 0.45)
        ax, seen = axes[0, 0], set()
        for i, run in enumerate(self.runs):
            for state in range(-1, len(STATES)):
                spans = _spans(run, state, self.limits)
                if spans:
                    face = UNKNOWN if state < 0 else STATE_COLOURS[state]
                    ax.broken_barh(spans, (i - 0.36, 0.72), facecolor=face, linewidth=0)
                    seen.add(state)
            for start in np.flatnonzero(np.diff(run.timeline.epoch)) + 1:
                ax.plot([run.time[start]] * 2, [i - 0.45, i + 0.45], color="black", linewidth=1.0)
        ax.set_yticks(range(len(self.runs)), [plain(r.label) for r in self.runs])
        ax.set_ylim(len(self.runs) - 0.5, -0.5)
        ax.grid(False)
        handles = [
            plt.Rectangle(
                (0, 0),
                1,
                1,
                color=UNKNOWN if s < 0 else STATE_COLOURS[s],
                label="not in the bag" if s < 0 else STATES[s],
            )
            for s in sorted(seen)
        ]
        figure.legend(handles=handles, loc="outside upper left", ncols=7)
        caption = (
            "State of the controller's supervisor. INACTIVE and FAULT send no torque; a fault stays until ~/recover is"
            " called. Reasons are in the table below. A black line: the source of states restarted."
        )
        return self._finish(figure, "supervisor", "Supervisor", caption, axes)

    def tracking(self):
        names = max((r.joint_names for r in self.runs), key=len)
        if not any(r.has(r.base, "joint_position") for r in self.runs):
            return None
        errors = any(r.has("controller/state", "reference_position") for r in self.runs)
        figure, axes = self._grid(len(names), 2 if errors else 1, 1.75, sharex=True)
        entries = self._entries()
        for j, name in enumerate(names):
            left = axes[j, 0]
            for i, run in enumerate(self.runs):
                if j >= len(run.joint_names):
                    continue
                style = {"color": colour(i)}
                self._series(left, run, run.position(j) * DEGREES, BINS // 2, **style)
                reference = run.reference(j)
                if reference is not None:
                    line = {"color": REFERENCE, "linestyle": (0, (4, 2)), "linewidth": 1.0}
                    self._series(left, run, reference * DEGREES, BINS // 2, **line)
                    entries.append(("reference", tuple(line.items())))
                    self._series(axes[j, 1], run, run.error(j) * DEGREES, BINS // 2, **style)
            left.set_ylabel(f"{plain(name)} [deg]")
            if errors:
                axes[j, 1].set_ylabel(f"{plain(name)} error [deg]")
                axes[j, 1].axhline(0.0, color="black", linewidth=0.5)
        if len(self.runs) == 1 and errors:
            entries = [("measured", (("color", colour(0)),)), *entries]
        caption = "Joint angles" + (
            ": reference and measurement on the left, reference less measurement on the right. The error is"
            " drawn from the first torque on; the summary's peak and rms are over the motions and the rests after them."
            if errors
            else " as measured; without controller/state there is no reference in the bag."
        )
        return self._finish(figure, "tracking", "Tracking", caption, axes, entries)

    def modes(self):
        runs = [r for r in self.runs if r.amplitude_source]
        if not runs:
            return None
        names = max((r.mode_names for r in runs), key=len)
        figure, axes, panels = self._panels(names, 1.6, sharex=True)
        bins, entries = BINS // axes.shape[1], self._entries()
        for ax, name in panels:
            scale, unit = (DEGREES, "deg") if "twist" in name else (1e3, "mm")
            for i, run in enumerate(self.runs):
                if name not in run.mode_names or not run.amplitude_source:
                    continue
                k = run.mode_names.index(name)
                style = {"color": colour(i)}
                self._series(ax, run, run.amplitude(k) * scale, bins, **style)
                quasi = run.column("controller/state", "quasi_steady_amplitude", k)
                if quasi is not None:
                    quasi = np.where((run.state >= 1) & (run.state < FAULT), quasi, np.nan)
                    line = {"color": "black", "linestyle": (0, (4, 2)), "linewidth": 0.9}
                    if len(self.runs) > 1:
                        line["color"] = _darker(colour(i))
                    self._series(ax, run, quasi * scale, bins, **line)
                    entries.append(("quasi-steady", (("color", "black"), ("linestyle", "--"))))
            ax.set_ylabel(f"{plain(name)}\n[{unit}]")
        if len(self.runs) == 1:
            entries = [(_source(runs[0]), (("color", colour(0)),)), *entries]
        sources = ", ".join(dict.fromkeys(_source(r) for r in runs))
        caption = (
            f"Amplitude of each mode: {sources}. Dashed: the quasi-steady amplitude, which the arm would have if it"
            " only followed its slow motion. The oscillation about it is vibration, which the fast control damps."
        )
        if len(names) > len(panels):
            caption += f" The first {len(panels)} of {len(names)} modes."
        return self._finish(figure, "modes", "Modal amplitudes", caption, axes, entries)

    def spectra(self, spectra):
        there = [
            (i, r, s)
            for i, (r, s) in enumerate(zip(self.runs, spectra, strict=True))
            if s is not None
        ]
        if not there:
            return None
        names = max((s.names for _, _, s in there), key=len)
        figure, _, panels = self._panels(names, 2.3)
        lines = [(i, r, analysis.predicted(r, s.configuration)) for i, r, s in there]
        top = min(analysis.highest(r, cases) for _, r, cases in lines)
        low = max(min(s.frequency[0] for _, _, s in there) * analysis.PADDED / 2.0, 0.05)
        entries = self._entries()
        for ax, name in panels:
            for i, _, s in there:
                if name in s.names:
                    inside = (s.frequency <= top) & (s.frequency >= low)
                    scale = 1.0 if "mode" in name and "twist" in name else 1e3
                    density = s.density[inside, s.names.index(name)] * scale
                    ax.plot(s.frequency[inside], np.maximum(density, 1e-12), color=colour(i))
            entries += self._predictions(ax, lines, low, top)
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.set_xlim(low, top)
            ax.set_ylabel(f"{plain(name)}\n[mm/√Hz]")
            ax.set_xlabel("frequency [Hz]")
        caption = self._about_spectra(there)
        return self._finish(figure, "spectra", "Vibration spectra", caption, entries=entries)

    def _predictions(self, ax, lines, low, top):
        """Draw the frequencies that the model predicts; returns entries for the legend."""
        entries, drawn = [], set()
        for _, _, cases in lines:
            for (case, values), dash in zip(cases.items(), ("-", ":"), strict=False):
                style = {"color": "#444444", "linestyle": dash, "linewidth": 0.9}
                entries.append((f"predicted, {case}", tuple(style.items())))
                for f in values:
                    if low < f < top and (case, round(f, 6)) not in drawn:
                        drawn.add((case, round(f, 6)))
                        ax.axvline(f, zorder=0, **style)
        return entries

    def _about_spectra(self, there):
        seconds = ", ".join(f"{s.seconds:.3g} s" for _, _, s in there)
        what = (
            "of the links' tips"
            if any(r.model is not None for _, r, _ in there)
            else "of the modes"
        )
        after = any(m for m in self.moves)
        where = "while the arm rested after its motions" if after else "over the whole record"
        return (
            f"How strongly deflections {what} vibrate at each frequency, {where} ({seconds}; Welch's method). Vertical"
            " lines: natural frequencies of the arm file's model at the mean configuration, joints locked and joints"
            " free. A held joint is neither: peaks lie near these lines, and a damped mode has none."
        )

    def torques(self):
        names = max((r.joint_names for r in self.runs), key=len)
        sent = [
            [analysis.torque_column(r, j) for j in range(len(r.joint_names))] for r in self.runs
        ]
        if not any(t is not None and np.isfinite(t).any() for run in sent for t in run):
            return None
        split = any(r.has("controller/state", "slow_torque") for r in self.runs)
        figure, axes = self._grid(len(names), 3 if split else 1, 1.75, sharex=True)
        entries = self._entries()
        for j, name in enumerate(names):
            for i, run in enumerate(self.runs):
                if j >= len(run.joint_names):
                    continue
                style = {"color": colour(i), "linewidth": 1.0}
                self._series(axes[j, 0], run, sent[i][j], BINS // 3, **style)
                if split:
                    active = (run.state >= 1) & (run.state < FAULT)
                    for c, part in ((1, "slow_torque"), (2, "fast_torque")):
                        values = run.column("controller/state", part, j)
                        if values is not None:
                            values = np.where(active, values, np.nan)
                            self._series(axes[j, c], run, values, BINS // 3, **style)
            entries += self._limits(axes[j, 0], j)
            axes[j, 0].set_ylabel(f"{plain(name)} [N m]")
        for ax, title in zip(axes[0], ("sent", "slow part", "fast part"), strict=False):
            ax.set_title(title)
        caption = "The torque that was sent" + (
            ", and its two parts: the slow control follows the motion, the fast one damps the bending."
            if split
            else "."
        )
        caption += " Limits are drawn where they are near; all are in the summary."
        return self._finish(figure, "torques", "Torques", caption, axes, entries)

    def _limits(self, ax, j):
        """Draw the torque limits that are near the curves; returns entries for the legend."""
        low, high = ax.get_ylim()
        entries = []
        for run in self.runs:
            if run.arm is None or j >= len(run.arm.joints):
                continue
            limit = run.arm.joints[j].limits.torque
            for value in (limit, -limit):
                if np.isfinite(limit) and 2.0 * low - high <= value <= 2.0 * high - low:
                    style = {"color": "#c62828", "linewidth": 0.9, "linestyle": "-."}
                    ax.axhline(value, **style)
                    entries.append(("limit", tuple(style.items())))
        return entries

    def strains(self):
        runs = [r for r in self.runs if r.gauge_names and r.has(r.base, "strain")]
        if not runs:
            return None
        names = max((r.gauge_names for r in runs), key=len)
        figure, axes, panels = self._panels(names, 1.55, sharex=True)
        bad = 0
        for ax, name in panels:
            for i, run in enumerate(self.runs):
                if name not in run.gauge_names:
                    continue
                k = run.gauge_names.index(name)
                strain = run.column(run.base, "strain", k)
                if strain is not None:
                    self._series(ax, run, 1e6 * strain, BINS // axes.shape[1], color=colour(i))
                bad += self._health(ax, run, k, colour(i))
            ax.set_ylabel(f"{plain(name)} [µm/m]")
        watched = any(r.has("observer/state", "gauge_health") for r in runs)
        health = "The background is red where the observer did not trust a gauge."
        if not watched:
            health = "The bag holds no data on the gauges' health."
        elif not bad:
            health = "The observer trusted all gauges all the time."
        caption = f"Readings of the strain gauges, in millionths. {health}"
        return self._finish(figure, "strains", "Strain gauges", caption, axes, self._entries())

    def _health(self, ax, run, k, face):
        """Mark where a gauge was not good; returns how often."""
        health = run.column("observer/state", "gauge_health", k)
        if health is None:
            return 0
        spans = list(zip(*stretches(np.nan_to_num(health) > 0.0), strict=True))
        for a, b in spans[:200]:
            right = run.time[min(b, run.time.size - 1)]
            ax.axvspan(run.time[a], right, color="#c62828", alpha=0.12, linewidth=0)
        return len(spans)

    def timing(self):
        took = [r.column("controller/state", "compute_time") for r in self.runs]
        took = [None if t is None else np.where(t > 0.0, 1e3 * t, np.nan) for t in took]
        if not any(t is not None and np.isfinite(t).any() for t in took):
            return None
        figure, axes = self._grid(1, 2, 2.0)
        for i, (run, t) in enumerate(zip(self.runs, took, strict=True)):
            if t is None or not np.isfinite(t).any():
                continue
            self._series(axes[0, 0], run, t, BINS // 2, color=colour(i), linewidth=0.7)
            known = np.sort(t[np.isfinite(t)])
            q = np.unique(
                np.concatenate([np.linspace(0, 0.99, 100), 1 - np.logspace(-2, -6, 60), [1]])
            )
            value = known[np.minimum((q * known.size).astype(int), known.size - 1)]
            axes[0, 1].plot(value, 1.0 - q + 1.0 / known.size, color=colour(i))
        axes[0, 0].set_yscale("log")
        axes[0, 0].set_ylabel("compute time [ms]")
        axes[0, 1].set_xscale("log")
        axes[0, 1].set_yscale("log")
        axes[0, 1].set_xlabel("compute time [ms]")
        axes[0, 1].set_ylabel("fraction of samples above [-]")
        periods = {1e3 * r.period for r in self.runs if r.period > 0.0}
        for period in periods if len(periods) == 1 else ():
            axes[0, 1].axvline(period, color="#c62828", linestyle="-.", linewidth=0.9)
            axes[0, 1].text(period, 1.0, " period", color="#c62828", va="top", fontsize=8)
        caption = (
            "Time from a state's arrival in the controller to the torque's departure, for every sample. On the right:"
            " the fraction of samples that took longer."
        )
        return self._finish(figure, "timing", "Compute time", caption, axes[:, :1], self._entries())


def _spans(run, state, limits):
    """(start, width) of the stretches in a state, each wide enough to be seen [s]."""
    least = (limits[1] - limits[0]) / 2000.0
    out = []
    for a, b in zip(*stretches(run.state == state), strict=True):
        start, end = run.time[a], run.time[min(b, run.time.size - 1)]
        if out and start - sum(out[-1]) < least and end - sum(out[-1]) < least:
            continue  # the last one covers it
        out.append((float(start), float(max(end - start, least))))
    return out


def _source(run):
    return {
        "arm_state_estimate": "the observer's estimate",
        "arm_state": "as arm_state has it",
        "strain": "from the strains, by the arm file",
    }[run.amplitude_source]


def _darker(name):
    return tuple(0.6 * np.array(matplotlib.colors.to_rgb(name)))


def svg(figure, name):
    """The figure as SVG for a page: without a header, without references to other files."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    used = set(re.findall(r"url\(#([^)]+)\)", text)) | set(re.findall(r'href="#([^"]+)"', text))
    text = re.sub(r' id="([^"]*)"', lambda m: m.group(0) if m.group(1) in used else "", text)
    for each in used:  # ids must differ between figures
        text = text.replace(f'id="{each}"', f'id="{name}-{each}"')
        text = text.replace(f"#{each})", f"#{name}-{each})").replace(
            f'"#{each}"', f'"#{name}-{each}"'
        )
    return re.sub(r"\n\s*", "\n", text)


def _png(figure, title):
    """The figure as a PNG inside a page."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img alt="{title}" src="data:image/png;base64,{data}">'
