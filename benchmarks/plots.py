# SPDX-License-Identifier: Apache-2.0
"""Figures of the measurements, PNG and SVG."""

from pathlib import Path

from matplotlib.ticker import FuncFormatter, NullFormatter

from flexarm_studies.plotting import STYLE, plt, save

COLOURS = {"own": "#1f5a94", "hand": "#8a8a8a", "peer": "#c1502e"}
KINDS = {"own": "flexarm", "hand": "loops written for these two arms", "peer": "other codes"}
CODES = {"loops": ("#c1502e", "general code in loops"), "generated": ("#1f5a94", "generated code")}
TITLES = {
    "one_link_pulse": "One link, torque pulse",
    "two_link_torque_x0p1": "Two links, small torque",
    "two_link_torque": "Two links, large torque",
    "three_link_torque": "Three links",
    "spatial_torque": "Two tubes in space",
}


def draw(summary, directory):
    """Write all figures of a `summary`, as `__main__` writes it, to a directory; the PNG files."""
    made = []
    with plt.rc_context(STYLE | {"axes.axisbelow": True, "lines.linewidth": 1.5}):
        for name, figure in (
            ("codes", _codes(summary["cases"])),
            ("links", _links(summary["links"])),
            ("modes", _modes(summary["modes"])),
            ("cores", _cores(summary["throughput"])),
        ):
            figure.tight_layout()
            made.append(save(figure, *(Path(directory, f"{name}.{s}") for s in ("png", "svg"))))
    return made


def _plain(axis):
    """Write the numbers on a logarithmic axis as decimals: 0.1 and 10."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _codes(cases):
    """Bar chart: time of every code in every case."""
    timed = {
        case: sorted(
            ((c["ms_per_s"], name, c) for name, c in result["codes"].items() if "ms_per_s" in c),
            key=lambda item: item[:2],
            reverse=True,
        )
        for case, result in cases.items()
    }
    figure, rows = plt.subplots(
        len(cases),
        sharex=True,
        squeeze=False,
        figsize=(8.0, 1.4 + 0.28 * sum(map(len, timed.values())) + 0.4 * len(cases)),
        height_ratios=[len(entries) + 1 for entries in timed.values()],
    )
    for axes, (case, entries) in zip(rows[:, 0], timed.items(), strict=True):
        for place, (value, _, code) in enumerate(entries):
            axes.barh(place, value, color=COLOURS[code["kind"]], height=0.7)
            axes.text(value * 1.08, place, f"{value:.3g}", va="center", fontsize=9)
        axes.set_yticks(range(len(entries)), [name for _, name, _ in entries])
        axes.set_xscale("log")
        axes.grid(False, axis="y")
        axes.set_title(f"{TITLES[case]}: tip within {1e6 * cases[case]['target']:g} µm", loc="left")
    lowest = min(e[0] for entries in timed.values() for e in entries)
    highest = max(e[0] for entries in timed.values() for e in entries)
    rows[-1, 0].set_xlim(lowest / 2.0, highest * 2.5)
    rows[-1, 0].set_xlabel("time per simulated second [ms]")
    _plain(rows[-1, 0].xaxis)
    patches = [plt.Rectangle((0, 0), 1, 1, color=COLOURS[kind]) for kind in KINDS]
    rows[0, 0].legend(patches, KINDS.values(), loc="upper right", fontsize=9)
    return figure


def _curves(axes, entries, over, label=lambda text: text, style="o-"):
    for code, (colour, name) in CODES.items():
        known = [entry for entry in entries if entry[code] is not None]
        axes.plot(
            [entry[over] for entry in known],
            [entry[code] for entry in known],
            style,
            color=colour,
            label=label(name),
        )


def _links(entries):
    """Cost against the number of links, with a line of proportional cost."""
    figure, axes = plt.subplots(figsize=(6.4, 4.2))
    _curves(axes, entries, "links")
    last = entries[-1]
    label = "in proportion to links"
    for code in CODES:
        if last[code] is not None:
            counts = [1, last["links"]]
            costs = [last[code] * n / last["links"] for n in counts]
            axes.plot(counts, costs, ":", color="#555555", linewidth=1.0, label=label)
            label = None
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    _plain(axes.xaxis)
    _plain(axes.yaxis)
    counts = [entry["links"] for entry in entries]
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.set_xlabel(f"links, {last['modes']} modes each")
    axes.set_ylabel("one evaluation [µs]")
    axes.set_title("Cost of the accelerations against links", loc="left")
    axes.legend()
    return figure


def _modes(entries):
    """Cost against the number of modes per link, for arms of one and two links."""
    figure, axes = plt.subplots(figsize=(6.4, 4.2))
    for links, style in ((1, "o-"), (2, "s--")):
        some = [entry for entry in entries if entry["links"] == links]
        number = "1 link" if links == 1 else f"{links} links"
        _curves(axes, some, "modes", lambda text, number=number: f"{text}, {number}", style)
    axes.set_yscale("log")
    _plain(axes.yaxis)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 1.2)
    counts = sorted({entry["modes"] for entry in entries})
    axes.set_xticks(counts)
    axes.set_xlabel("modes per link")
    axes.set_ylabel("one evaluation [µs]")
    axes.set_title("Cost of the accelerations against modes", loc="left")
    axes.legend(fontsize=9, loc="center left", bbox_to_anchor=(0.0, 0.55))
    return figure


def _cores(result):
    """Throughput against cores, with what the computer and perfect scaling would give."""
    figure, axes = plt.subplots(figsize=(6.4, 4.2))
    counts = [entry["cores"] for entry in result["cores"]]
    values = [entry["throughput"] for entry in result["cores"]]
    ideal = [values[0] * n for n in counts]
    axes.plot(counts, ideal, ":", color="#555555", label="in proportion to cores")
    there = [values[0] * entry["available"] for entry in result["cores"]]
    axes.plot(counts, there, "s--", color=COLOURS["hand"], label="threads that share nothing")
    axes.plot(counts, values, "o-", color=COLOURS["own"], label="batch.simulate")
    for entry in result["cores"]:
        axes.annotate(
            f"×{entry['speedup']:.2f}",
            (entry["cores"], entry["throughput"]),
            xytext=(10, 0),
            textcoords="offset points",
            color=COLOURS["own"],
        )
    axes.set_ylim(0.0, 1.12 * max(ideal + values + there))
    axes.set_xlim(0.0, counts[-1] + 1.0)
    axes.set_xticks(counts)
    axes.set_xlabel("cores")
    axes.set_ylabel("simulated seconds per second")
    axes.set_title(f"Two links, RK4 at 1 ms, batches of {result['runs']} trajectories", loc="left")
    axes.legend(loc="upper left")
    return figure
