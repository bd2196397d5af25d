# SPDX-License-Identifier: Apache-2.0
"""``flexarm identify --report``: writes a fit on one page of HTML, in the style of ``flexarm report``."""

import json
from pathlib import Path

import numpy as np
from jinja2 import Environment

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification import advice, scores
from flexarm_studies.plotting import plt

from ..report import figures, template
from ..report.page import digits

DEGREES, MICRO = 180.0 / np.pi, 1e6
#: Lags of the residuals' correlation [samples], and samples of a segment of the spectra.
LAGS, SEGMENT = 60, 512
#: A modelled frequency is near the measured one within this fraction, a damping ratio within this factor [-].
NEAR, DAMPED = 0.02, 1.5
#: Max. number of names along the matrix of correlations.
MAX_NAMES = 45


def write(found, run, predicted, result, path):
    """Write the page; return its path.

    Parameters
    ----------
    found : Identified or StrainFit
    run : Recording
        The recording that was predicted.
    predicted : ndarray, shape (s, n + g) or (s, g)
        Joint angles and strains, or strains alone, at the samples of the `run`.
    result : dict
        What the command prints as JSON.
    path : str or Path

    Raises
    ------
    FlexarmError
        For a path that can't be written.
    """
    path = Path(path)
    shown = channels(found, run, predicted)
    text = _page(found, run, shown, result)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise FlexarmError("can't be written", field=str(path), value=error.strerror) from None
    return str(path)


def channels(found, run, predicted):
    """What is compared: list of dict with ``name``, ``unit``, ``measured`` and ``predicted`` (s,).

    Parameters
    ----------
    found, run, predicted
        As of `write`.
    """
    arm = found.arm
    angles = predicted.shape[1] - len(arm.gauges)
    names = (*arm.joint_names[:angles], *arm.gauge_names)
    measured = np.hstack([run.position[:, :angles], run.strain])
    factors = [DEGREES] * angles + [MICRO] * len(arm.gauges)
    units = ["deg"] * angles + ["microstrain"] * len(arm.gauges)
    return [
        {"name": n, "unit": u, "measured": f * measured[:, c], "predicted": f * predicted[:, c]}
        for c, (n, f, u) in enumerate(zip(names, factors, units, strict=True))
    ]


def _page(found, run, shown, result):
    time = run.start + run.time
    traces = {
        "time": [round(float(time[0]), 6), run.period, len(time)],
        "spans": _spans(result),
        "channels": [
            c | {key: _rounded(c[key], _places(c)) for key in ("measured", "predicted")}
            for c in shown
        ],
    }
    environment = Environment(autoescape=True, trim_blocks=True)
    return environment.from_string(PAGE).render(
        title=f"Identification of {found.arm.name}",
        source=Path(result["source"]).name,
        style=template.STYLE,
        script=SCRIPT,
        short=short(result),
        traces=json.dumps(traces, allow_nan=False).replace("<", "\\u003c"),
        parts=_parts(result),
        rings=[_judged(ring) for ring in result.get("ring_downs", [])],
        picked=result.get("pickup"),
        currents=result.get("currents", []),
        spectra=_drawn(lambda axes: _spectra(axes, shown, run.period), "spectra", len(shown)),
        parameters=[_parameter(row) for row in result["parameters"]],
        correlation=_correlation(found),
        pairs=advice.strongest(found),
        alike=result.get("alike", []),
        next=advice.suggestions(found),
        notes=result["warnings"],
        digits=digits,
    )


def _places(channel):
    """Decimals with which a channel is written: about 10^-5 of its largest size."""
    size = np.nanmax(np.abs(channel["measured"]), initial=1e-9)
    return int(np.clip(5 - np.floor(np.log10(size)), 0, 8))


def _rounded(values, places):
    return [round(float(v), places) if np.isfinite(v) else None for v in values]


def _spans(result):
    """Name, beginning and end [s] of the fitted and of the scored part, if they are of this recording."""
    spans = [("fit", result.get("fit_s"))]
    if not result.get("score_file"):
        spans.append(("score", result.get("score_s")))
    return [[name, *span] for name, span in spans if span]


def short(result):
    """The fit in sentences."""
    fitted = sum(row["half_width"] is not None for row in result["parameters"])
    yield f"{result['samples']} samples of {1e3 * result['period_s']:.3g} ms; {fitted} parameters are fitted."
    for part, gauges in result.get("parts", {}).items():
        what = "predicted, not fitted" if part == "score" else "fitted"
        cells = ", ".join(
            f"{name} {digits(row['model']['vaf'], 4)} %" for name, row in gauges.items()
        )
        yield f"Variance accounted for where {what}: {cells}."
    if (picked := result.get("pickup")) and picked["useful"]:
        score = result["parts"].get("score") or result["parts"]["fit"]
        cells = ", ".join(
            f"{name} {digits(row['with pickup']['vaf'], 4)} %"
            for name, row in score.items()
            if "with pickup" in row
        )
        yield f"With what all gauges pick up from the motor currents above {picked['above_hz']:g} Hz: {cells}."
    rings = [_judged(r) for r in result.get("ring_downs", []) if r["modelled_frequency"]]
    if rings:
        near, damped = (sum(ring[key] for ring in rings) for key in ("near", "damped"))
        yield (
            f"Of {len(rings)} ring-downs the model has {near} frequencies within {100.0 * NEAR:g} % and {damped}"
            f" damping ratios within a factor of {DAMPED:g}."
        )


def _judged(ring):
    """A ring-down, and whether the model's frequency and damping are near the measured ones."""
    frequency, damping = (ring[f"modelled_{what}"] for what in ("frequency", "damping"))
    near = frequency is not None and abs(frequency / ring["measured_frequency"] - 1.0) < NEAR
    ratio = (damping or 0.0) / max(ring["measured_damping"], 1e-9)
    return ring | {"near": near, "damped": 1.0 / DAMPED < ratio < DAMPED}


def _parts(result):
    """Tables of the scores: title, gauges, rows of cells."""
    made = []
    for part, gauges in result.get("parts", {}).items():
        start, end = result[f"{part}_s"]
        what = [k for k in next(iter(gauges.values())) if k != "residual_correlation"]
        rows = [
            (key, [None if row[key] is None else row[key] | {"rms": MICRO * row[key]["rms"]} for row in gauges.values()])
            for key in what
        ]  # fmt: skip
        white = [(row["residual_correlation"]["value"], row["residual_correlation"]["white_within"]) for row in gauges.values()]  # fmt: skip
        made.append(
            {
                "title": f"{part}, {start:g} to {end:g} s",
                "gauges": list(gauges),
                "rows": rows,
                "white": white,
            }
        )
    return made


def _parameter(row):
    kept = row.get("kept")
    note = f"{kept}: the file's value" if kept else ""
    if not kept and row.get("determined") is False:
        note = "not determined: held near the file's value by a wide prior"
    ratio = None
    if row["half_width"] is not None and row["value"]:
        ratio = 100.0 * abs(row["half_width"] / row["value"])
    return row | {"note": note, "percent": ratio}


# Figures ----------------------------------------------------------------------------------------


def _drawn(draw, name, rows):
    """SVG of a figure with `rows` rows of two panels, drawn by ``draw(axes)``."""
    with plt.rc_context(figures.STYLE):
        figure, axes = plt.subplots(
            rows, 2, figsize=(figures.WIDTH, 1.7 * rows + 0.6), squeeze=False, layout="constrained"
        )  # fmt: skip
        draw(axes)
        return _closed(figure, name)


def _spectra(axes, shown, period):
    """Spectra of the measured signals and of the residuals, and the residuals' correlation over time."""
    from scipy.signal import welch

    for row, channel in zip(axes, shown, strict=True):
        measured = scores.filled(channel["measured"][:, None])[:, 0]
        error = scores.filled((channel["measured"] - channel["predicted"])[:, None])[:, 0]
        for values, label, colour in (
            (measured, "measured", "0.6"),
            (error, "residual", "tab:red"),
        ):
            f, density = welch(values, 1.0 / period, nperseg=min(SEGMENT, len(values)))
            row[0].loglog(f[1:], np.sqrt(density[1:]), label=label, color=colour)
        row[0].set_ylabel(f"{figures.plain(channel['name'])} [{channel['unit']}/√Hz]")
        e = error - error.mean()
        lags = min(LAGS, len(e) - 1)
        rho = [e[k:] @ e[: len(e) - k] / max(e @ e, 1e-300) for k in range(lags + 1)]
        bound = scores.whiteness(error)[1]
        row[1].bar(period * np.arange(lags + 1), rho, 0.7 * period, color="tab:red")
        row[1].axhspan(-bound, bound, color="0.85", zorder=0)
        row[1].set_ylabel("correlation [-]")
    axes[0, 0].legend(fontsize=8)
    axes[-1, 0].set_xlabel("frequency [Hz]")
    axes[-1, 1].set_xlabel("lag [s]")


def _correlation(found):
    """SVG of the matrix of correlations of the fitted parameters; None if there are none, or too many."""
    fitted, rho = advice.correlations(found)
    if not 1 < len(fitted) <= MAX_NAMES:
        return None
    names = [figures.plain(found.quantities[j].name) for j in fitted]
    with plt.rc_context(figures.STYLE):
        size = 2.6 + 0.2 * len(names)
        figure, ax = plt.subplots(figsize=(size + 0.8, size), layout="constrained")
        drawn = ax.imshow(rho, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
        ax.grid(visible=False)
        ax.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
        ax.set_yticks(range(len(names)), names, fontsize=7)
        figure.colorbar(drawn, ax=ax, shrink=0.6, label="correlation [-]")
        return _closed(figure, "correlation")


def _closed(figure, name):
    """SVG of a figure, which is then closed."""
    text = figures.svg(figure, name)
    plt.close(figure)
    return text


# ruff: noqa: E501  (HTML from here on)
SCRIPT = r"""
"use strict";
(function () {
  var data = JSON.parse(document.getElementById("traces").textContent);
  var t0 = data.time[0], dt = data.time[1], count = data.time[2], end = t0 + dt * (count - 1);
  var from = t0, to = end, plots = [];
  var colours = { measured: "#8b939e", predicted: "#1f5a94", residual: "#c0392b" };
  data.channels.forEach(function (c) {
    c.residual = c.measured.map(function (v, k) { return v === null || c.predicted[k] === null ? null : v - c.predicted[k]; });
  });
  Array.prototype.forEach.call(document.querySelectorAll("canvas[data-channel]"), function (canvas) {
    var c = data.channels[Number(canvas.dataset.channel)];
    var plot = { canvas: canvas, pen: canvas.getContext("2d"), unit: c.unit, drag: null,
      series: canvas.dataset.kind === "residual" ? [["residual", c.residual]] : [["measured", c.measured], ["predicted", c.predicted]] };
    plots.push(plot);
    function at(event) {
      var box = canvas.getBoundingClientRect(), x = (event.clientX - box.left - 56) / (box.width - 66);
      return from + Math.max(0, Math.min(1, x)) * (to - from);
    }
    canvas.addEventListener("pointerdown", function (e) { plot.drag = [at(e), at(e)]; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointermove", function (e) { if (plot.drag) { plot.drag[1] = at(e); draw(plot); } });
    canvas.addEventListener("pointerup", function () {
      var d = plot.drag; plot.drag = null;
      if (d && Math.abs(d[1] - d[0]) > 5 * dt) { from = Math.min(d[0], d[1]); to = Math.max(d[0], d[1]); }
      all();
    });
    canvas.addEventListener("dblclick", function () { from = t0; to = end; all(); });
    canvas.addEventListener("wheel", function (e) {
      e.preventDefault();
      var m = at(e), f = e.deltaY > 0 ? 1.25 : 0.8;
      from = Math.max(t0, m - (m - from) * f); to = Math.min(end, m + (to - m) * f); all();
    }, { passive: false });
  });
  document.getElementById("whole").addEventListener("click", function () { from = t0; to = end; all(); });
  function all() {
    plots.forEach(draw);
    document.getElementById("range").textContent = from.toFixed(2) + " to " + to.toFixed(2) + " s";
  }
  function step(span) {
    var p = Math.pow(10, Math.floor(Math.log10(span / 5)));
    return [1, 2, 5, 10].map(function (k) { return k * p; }).filter(function (s) { return span / s <= 8; })[0];
  }
  function draw(plot) {
    var canvas = plot.canvas, pen = plot.pen, ratio = window.devicePixelRatio || 1;
    var w = canvas.clientWidth, h = canvas.clientHeight;
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.clearRect(0, 0, w, h);
    var a = Math.max(0, Math.floor((from - t0) / dt)), b = Math.min(count - 1, Math.ceil((to - t0) / dt));
    var lo = Infinity, hi = -Infinity;
    plot.series.forEach(function (s) {
      for (var k = a; k <= b; k++) { var v = s[1][k]; if (v !== null) { if (v < lo) lo = v; if (v > hi) hi = v; } }
    });
    if (!(hi > lo)) { lo -= 1; hi += 1; }
    var pad = 0.06 * (hi - lo); lo -= pad; hi += pad;
    function X(t) { return 56 + (t - from) / (to - from) * (w - 66); }
    function Y(v) { return h - 18 - (v - lo) / (hi - lo) * (h - 26); }
    pen.font = "11px sans-serif"; pen.fillStyle = "#5b6572"; pen.strokeStyle = "#e6e9ee"; pen.lineWidth = 1;
    var s = step(hi - lo), v;
    pen.textAlign = "right";
    for (v = Math.ceil(lo / s) * s; v <= hi; v += s) {
      pen.beginPath(); pen.moveTo(56, Y(v)); pen.lineTo(w - 10, Y(v)); pen.stroke(); pen.fillText(+v.toPrecision(6), 50, Y(v) + 4);
    }
    s = step(to - from); pen.textAlign = "center";
    for (v = Math.ceil(from / s) * s; v <= to; v += s) {
      pen.beginPath(); pen.moveTo(X(v), 8); pen.lineTo(X(v), h - 18); pen.stroke(); pen.fillText(+v.toPrecision(6), X(v), h - 5);
    }
    data.spans.forEach(function (span) {
      var l = Math.max(X(span[1]), 56), r = Math.min(X(span[2]), w - 10);
      if (r <= l) return;
      pen.fillStyle = span[0] === "fit" ? "rgba(31,90,148,0.05)" : "rgba(224,160,48,0.10)"; pen.fillRect(l, 8, r - l, h - 26);
      pen.fillStyle = "#5b6572"; pen.textAlign = "left"; pen.fillText(span[0] === "fit" ? "fitted" : "only predicted", l + 4, 18);
    });
    pen.save(); pen.beginPath(); pen.rect(56, 8, w - 66, h - 26); pen.clip();
    plot.series.forEach(function (s) {
      pen.strokeStyle = colours[s[0]]; pen.lineWidth = s[0] === "measured" ? 1.8 : 1.1; pen.beginPath();
      var up = true;
      for (var k = a; k <= b; k++) {
        var v = s[1][k];
        if (v === null) { up = true; continue; }
        if (up) pen.moveTo(X(t0 + k * dt), Y(v)); else pen.lineTo(X(t0 + k * dt), Y(v));
        up = false;
      }
      pen.stroke();
    });
    if (plot.drag) { pen.fillStyle = "rgba(31,90,148,0.18)"; pen.fillRect(X(plot.drag[0]), 8, X(plot.drag[1]) - X(plot.drag[0]), h - 26); }
    pen.restore();
  }
  window.addEventListener("resize", all);
  all();
})();
"""

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>{{ style|safe }}
canvas.trace { width: 100%; height: 190px; display: block; touch-action: none; cursor: crosshair; } canvas.residual { height: 110px; }
h3 { font-size: 15px; margin: 12px 0 0; font-weight: 600; }</style>
</head>
<body>
<header><h1>{{ title }}</h1><p>from {{ source }}</p></header>
<nav><a href="#short">In short</a><a href="#overlays">Measured and predicted</a>{% if parts %}<a href="#scores">Scores</a>{% endif %}
<a href="#residuals">Residuals</a><a href="#parameters">Parameters</a><a href="#correlations">Correlations</a><a href="#next">What to measure next</a></nav>
<main>
<section id="short"><h2>In short</h2><ul class="short">{% for line in short %}<li>{{ line }}</li>{% endfor %}</ul>
{% if notes %}<h2 style="margin-top:14px">Notes</h2><ul class="short notes">{% for note in notes %}<li>{{ note }}</li>{% endfor %}</ul>{% endif %}</section>
<section id="overlays"><h2>Measured and predicted</h2>
<p class="caption">Grey: measured; blue: predicted; red: measured less predicted. Drag over a time to zoom, turn the wheel to zoom about the pointer, double click for all. All figures show the same time, in seconds.</p>
<div class="controls"><button id="whole" type="button">All</button><output id="range"></output></div>
<div id="plots"></div>
<script type="application/json" id="traces">{{ traces|safe }}</script>
<script>
JSON.parse(document.getElementById("traces").textContent).channels.forEach(function (c, i) {
  var h = document.createElement("h3"); h.textContent = c.name + " [" + c.unit + "]"; document.getElementById("plots").appendChild(h);
  ["trace", "residual"].forEach(function (kind) {
    var e = document.createElement("canvas"); e.className = "trace " + kind; e.dataset.channel = i; e.dataset.kind = kind;
    e.setAttribute("role", "img"); e.setAttribute("aria-label", c.name + ", " + kind);
    document.getElementById("plots").appendChild(e);
  });
});
</script></section>
{% if parts %}<section id="scores"><h2>Scores</h2>
<p class="caption">Variance accounted for [%], the same above the frequency [%], rms of the residual [microstrain]; beside regressions that need no model, and beside what the noise at rest would leave to a perfect one (ceiling).{% if picked %} With pickup: the model, and what all gauges pick up from the motor currents above {{ digits(picked.above_hz) }} Hz.{% endif %}</p>
{% for part in parts %}<h3>{{ part.title }}</h3><div class="scroll"><table><thead><tr><th></th>{% for g in part.gauges %}<th scope="col">{{ g }}</th>{% endfor %}</tr></thead><tbody>
{% for key, cells in part.rows %}<tr><th scope="row">{{ key }}</th>{% for c in cells %}<td>{% if c %}{{ digits(c.vaf, 4) }} <span class="small">{{ digits(c.vaf_above) }}; {{ digits(c.rms) }}</span>{% else %}–{% endif %}</td>{% endfor %}</tr>
{% endfor %}<tr><th scope="row">residual, correlation from sample to sample</th>{% for value, bound in part.white %}<td>{{ digits(value, 2) }} <span class="small">(white: within {{ digits(bound, 2) }})</span></td>{% endfor %}</tr></tbody></table></div>
{% endfor %}
{% if rings %}<h3>Ring-downs</h3><p class="caption">Red: the model's frequency is off by more than 2 %, or its damping ratio by more than a factor of 1.5. Intervals of 95 %.</p><div class="scroll"><table><thead><tr><th>time [s]</th><th>gauge</th><th>measured [Hz]</th><th>modelled [Hz]</th><th>damping measured</th><th>modelled</th></tr></thead><tbody>
{% for r in rings %}<tr><td>{{ "%.2f"|format(r.from_s) }} to {{ "%.2f"|format(r.to_s) }}</td><td>{{ r.gauge }}</td><td>{{ digits(r.measured_frequency, 4) }} ± {{ digits(r.frequency_width, 2) }}</td><td{% if not r.near %} class="bad"{% endif %}>{{ digits(r.modelled_frequency, 4) }}</td><td>{{ digits(r.measured_damping) }} ± {{ digits(r.damping_width, 2) }}</td><td{% if not r.damped %} class="bad"{% endif %}>{{ digits(r.modelled_damping) }}</td></tr>
{% endfor %}</tbody></table></div>{% endif %}
{% if currents %}<h3>Motor currents</h3><p class="caption">The model's torque and friction, by regression. Left: fraction of the current's sum of squares that they do not explain.</p><div class="scroll"><table><thead><tr><th>joint</th><th>torque per ampere [N m/A]</th><th>viscous [N m s/rad]</th><th>Coulomb [N m]</th><th>left where fitted</th><th>left where scored</th></tr></thead><tbody>
{% for m in currents %}<tr><td>{{ m.joint }}</td>{% for k in ("torque_constant", "viscous", "coulomb") %}<td>{% if m.explained %}{{ digits(m[k].value) }} ± {{ digits(m[k].half_width, 2) }}{% else %}not explained{% endif %}</td>{% endfor %}<td>{{ digits(m.left_of_fitted) }}</td><td>{{ digits(m.left_of_scored) }}</td></tr>
{% endfor %}</tbody></table></div>{% endif %}
</section>{% endif %}
<section id="residuals"><h2>Residuals</h2><p class="caption">Left: amplitude spectra of what was measured and of the residual. Right: correlation of the residual over time; the grey band holds 95 % of white residuals. What sticks out is what the model lacks.</p>
<div class="figure">{{ spectra|safe }}</div></section>
<section id="parameters"><h2>Parameters</h2><p class="caption">With 95 % intervals, which hold if the model is right.</p>
<div class="scroll"><table><thead><tr><th>parameter</th><th>value</th><th>±</th><th>unit</th><th>± [%]</th><th></th></tr></thead><tbody>
{% for p in parameters %}<tr><th scope="row">{{ p.name }}</th><td>{{ digits(p.value, 5) }}</td><td>{{ digits(p.half_width, 2) }}</td><td>{{ p.unit }}</td><td{% if p.percent and p.percent > 50 %} class="bad"{% endif %}>{{ digits(p.percent, 2) }}</td><td class="small">{{ p.note }}</td></tr>
{% endfor %}</tbody></table></div></section>
<section id="correlations"><h2>Correlations</h2><p class="caption">Of the fitted parameters: near 1 or -1, the motion tells a combination of the two and not each.</p>
{% if pairs %}<ul class="short">{% for a, b, rho in pairs %}<li>{{ a }} and {{ b }}: {{ "%.3f"|format(rho) }}</li>{% endfor %}</ul>{% endif %}
{% if alike %}<ul class="short">{% for group in alike %}<li>no measurement changes along a combination of {{ group|join(", ") }}</li>{% endfor %}</ul>{% endif %}
{% if correlation %}<div class="figure">{{ correlation|safe }}</div>{% endif %}</section>
<section id="next"><h2>What to measure next</h2><p class="caption">What would make most of the other intervals narrower, and what this motion determines badly, the most useful first. Hold what you have measured (<code>--hold</code>).</p>
{% if next %}<ol>{% for s in next %}<li><b>{{ s.name }}</b>: {{ s.how }}. <span class="small">Why: {{ s.why }}.</span></li>{% endfor %}</ol>{% else %}<p>Every parameter is determined by itself.</p>{% endif %}</section>
<footer><p>Made by <code>flexarm identify --report</code>. All of it is in this file; it asks the network for nothing.</p></footer>
</main>
<script>{{ script|safe }}</script>
</body>
</html>
"""
