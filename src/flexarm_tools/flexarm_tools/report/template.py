# SPDX-License-Identifier: Apache-2.0
"""Contains the page's HTML, style and script; the page needs nothing else."""

# ruff: noqa: E501  (HTML)

STYLE = """
:root { color-scheme: light; --ink: #1d2430; --soft: #5b6572; --line: #dfe3e8; --back: #f6f7f9; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--back); color: var(--ink);
  font: 15px/1.5 system-ui, "DejaVu Sans", Helvetica, Arial, sans-serif; }
main, header, nav { max-width: 1160px; margin: 0 auto; padding: 0 24px; }
header { padding-top: 28px; }
h1 { font-size: 26px; margin: 0 0 2px; letter-spacing: -0.01em; }
h2 { font-size: 18px; margin: 0 0 4px; }
header p { margin: 0; color: var(--soft); }
.chip { display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin-right: 6px; }
nav { position: sticky; top: 0; background: var(--back); border-bottom: 1px solid var(--line);
  padding-top: 10px; padding-bottom: 8px; margin-bottom: 18px; z-index: 5; }
nav a { color: var(--soft); text-decoration: none; margin-right: 16px; font-size: 14px; }
nav a:hover { color: var(--ink); text-decoration: underline; }
section { background: #fff; border: 1px solid var(--line); border-radius: 8px; padding: 16px 20px;
  margin-bottom: 18px; scroll-margin-top: 52px; }
section > p.caption { color: var(--soft); font-size: 14px; margin: 0 0 8px; max-width: 95ch; }
p.opening { margin: 2px 0 8px; max-width: 95ch; } ul.short { margin: 6px 0 0; padding-left: 20px; } ul.short li { margin: 4px 0; }
.notes li { color: #7a4a00; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
th, td { text-align: left; padding: 5px 12px 5px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td { font-variant-numeric: tabular-nums; }
thead th { border-bottom: 2px solid var(--ink); }
tbody th { font-weight: 500; color: var(--soft); width: 27%; }
td.bad { color: #b3261e; font-weight: 600; } td .small, .small { color: var(--soft); font-size: 13px; }
tr.group th { color: var(--ink); font-weight: 600; padding-top: 12px; }
.scroll { overflow-x: auto; } .tall { max-height: 320px; overflow-y: auto; }
.figure { position: relative; overflow-x: auto; } .figure svg, .figure img { display: block; width: 100%; height: auto; }
.figure svg text { font-family: "DejaVu Sans", Verdana, sans-serif; }
.cursor { position: absolute; width: 0; border-left: 1px solid #111; opacity: 0.55; pointer-events: none; }
#stage { width: 100%; height: 430px; display: block; border: 1px solid var(--line); border-radius: 6px;
  touch-action: none; cursor: grab; background: #fff; }
.controls { display: flex; flex-wrap: wrap; gap: 10px 16px; align-items: center; margin-top: 10px; font-size: 14px; }
.controls input[type=range] { accent-color: #1f5a94; } #scrub { flex: 1 1 320px; }
button { font: inherit; padding: 4px 14px; border: 1px solid #b9c1cb; border-radius: 6px; background: #fff; cursor: pointer; }
select { font: inherit; padding: 3px; } output { font-variant-numeric: tabular-nums; }
footer { color: var(--soft); font-size: 13px; padding-bottom: 40px; } footer dt { font-weight: 600; color: var(--ink); }
footer dd { margin: 0 0 6px; } code { font-size: 13px; }
@media print { nav, .controls { display: none; } section { break-inside: avoid; } }
"""

SCRIPT = r"""
"use strict";
(function () {
  var source = document.getElementById("film");
  var film = source ? JSON.parse(source.textContent) : null;
  var figures = Array.prototype.slice.call(document.querySelectorAll(".figure[data-times]"));
  var cursors = [];
  figures.forEach(function (figure) {
    JSON.parse(figure.dataset.times).forEach(function (place) {
      var line = document.createElement("div");
      line.className = "cursor";
      line.style.top = 100 * (1 - place[3]) + "%";
      line.style.height = 100 * (place[3] - place[2]) + "%";
      line.hidden = true;
      figure.appendChild(line);
      cursors.push({ line: line, place: place });
    });
    figure.addEventListener("click", function (event) {
      var box = figure.getBoundingClientRect(), x = (event.clientX - box.left) / box.width;
      JSON.parse(figure.dataset.times).some(function (p) {
        if (x < p[0] || x > p[1]) return false;
        go(p[4] + (x - p[0]) / (p[1] - p[0]) * (p[5] - p[4]));
        return true;
      });
    });
  });
  function mark(time) {
    cursors.forEach(function (c) {
      var p = c.place, share = (time - p[4]) / (p[5] - p[4]);
      c.line.hidden = share < 0 || share > 1;
      c.line.style.left = 100 * (p[0] + share * (p[1] - p[0])) + "%";
    });
  }
  if (!film) { window.reportGo = mark; function go(t) { mark(t); } return; }

  function numbers(text, unit) {
    if (!text) return null;
    var raw = atob(text), out = new Float64Array(raw.length / 2);
    for (var i = 0; i < out.length; i++) {
      var v = raw.charCodeAt(2 * i) | raw.charCodeAt(2 * i + 1) << 8;
      if (v > 32767) v -= 65536;
      out[i] = v === -32768 ? NaN : v * unit;
    }
    return out;
  }
  var colours = film.colours, states = film.states, stateColours = film.stateColours;
  var runs = film.runs.map(function (r) {
    return { label: r.label, links: r.links, state: r.state, straight: numbers(r.straight, r.unit),
      reference: numbers(r.reference, r.unit), bent: numbers(r.bent, r.bentUnit), shown: true };
  });
  var canvas = document.getElementById("stage"), pen = canvas.getContext("2d");
  var scrub = document.getElementById("scrub"), clock = document.getElementById("clock");
  var play = document.getElementById("play"), speed = document.getElementById("speed");
  var factorBar = document.getElementById("factor"), factorText = document.getElementById("factortext");
  var view = film.view.map(function (row) { return row.slice(); });
  var time = film.start, playing = false, last = 0, factor = film.factor;
  var lo = [1e9, 1e9, 1e9], hi = [-1e9, -1e9, -1e9];
  function stretch(values) {
    for (var i = 0; i < values.length; i++) {
      var c = i % 3;
      if (values[i] < lo[c]) lo[c] = values[i];
      if (values[i] > hi[c]) hi[c] = values[i];
    }
  }
  runs.forEach(function (r) { stretch(r.straight); if (r.reference) stretch(r.reference); });
  var margin = film.factor * film.most;
  var centre = [0, 1, 2].map(function (i) { return (lo[i] + hi[i]) / 2; });
  var half = [0, 1, 2].map(function (i) { return (hi[i] - lo[i]) / 2; });

  function extent(row) {
    return Math.abs(row[0]) * half[0] + Math.abs(row[1]) * half[1] + Math.abs(row[2]) * half[2] + margin;
  }
  function dot(row, x, y, z) {
    return row[0] * (x - centre[0]) + row[1] * (y - centre[1]) + row[2] * (z - centre[2]);
  }
  function frame() {
    var share = (time - film.start) / (film.end - film.start);
    return Math.max(0, Math.min(film.frames - 1, Math.round(share * (film.frames - 1))));
  }
  function draw() {
    var ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, w, h);
    var scale = Math.min(0.92 * w / (2 * extent(view[0])), 0.82 * h / (2 * extent(view[1])));
    function at(values, i) {
      var x = values[i], y = values[i + 1], z = values[i + 2];
      return [w / 2 + scale * dot(view[0], x, y, z), h / 2 + 6 - scale * dot(view[1], x, y, z)];
    }
    var k = frame();
    ruler(w, h, scale);
    runs.forEach(function (r, n) { if (r.shown) { ghost(r, k, at); trail(r, n, k, at); } });
    runs.forEach(function (r, n) { if (r.shown) arm(r, n, k, at); });
    banner(k);
    clock.textContent = (time < 0 ? "−" : "") + Math.abs(time).toFixed(2) + " s";
    scrub.value = k;
    mark(time);
  }
  function path(points, colour, width, dash) {
    if (points.some(function (p) { return isNaN(p[0]); })) return;
    pen.beginPath();
    points.forEach(function (p, i) { if (i) pen.lineTo(p[0], p[1]); else pen.moveTo(p[0], p[1]); });
    pen.strokeStyle = colour; pen.lineWidth = width; pen.setLineDash(dash || []);
    pen.lineJoin = pen.lineCap = "round"; pen.stroke(); pen.setLineDash([]);
  }
  function ghost(r, k, at) {
    for (var i = 0; i < r.links; i++) {
      var o = (k * r.links + i) * 6;
      path([at(r.straight, o), at(r.straight, o + 3)], "#c9ced6", 2.5);
      if (r.reference) path([at(r.reference, o), at(r.reference, o + 3)], "#555555", 1.2, [6, 4]);
    }
  }
  function point(r, k, i, j) {
    var o = (k * r.links + i) * 6, s = j / (film.points - 1), b = ((k * r.links + i) * film.points + j) * 3, out = [];
    for (var c = 0; c < 3; c++) {
      out.push(r.straight[o + c] * (1 - s) + r.straight[o + 3 + c] * s + factor * r.bent[b + c]);
    }
    return out;
  }
  function trail(r, n, k, at) {
    var points = [];
    for (var m = Math.max(0, k - 50); m <= k; m++) points.push(at(point(r, m, r.links - 1, film.points - 1), 0));
    pen.globalAlpha = 0.35; path(points, colours[n], 1.5); pen.globalAlpha = 1;
  }
  function arm(r, n, k, at) {
    for (var i = 0; i < r.links; i++) {
      var points = [];
      for (var j = 0; j < film.points; j++) points.push(at(point(r, k, i, j), 0));
      path(points, colours[n], 4);
      disc(points[0], 5, "#1d2430");
    }
    disc(at(point(r, k, r.links - 1, film.points - 1), 0), 5, colours[n]);
  }
  function disc(p, radius, colour) {
    pen.beginPath(); pen.arc(p[0], p[1], radius, 0, 7); pen.fillStyle = colour; pen.fill();
  }
  function ruler(w, h, scale) {
    var wanted = 120 / scale, power = Math.pow(10, Math.floor(Math.log10(wanted))), length = power;
    [2, 5].forEach(function (s) { if (s * power <= wanted) length = s * power; });
    var x = 16, y = h - 16;
    path([[x, y - 4], [x, y], [x + length * scale, y], [x + length * scale, y - 4]], "#5b6572", 1);
    pen.fillStyle = "#5b6572"; pen.font = "12px sans-serif";
    pen.fillText(length >= 1 ? length + " m" : Math.round(1000 * length) + " mm", x + 6, y - 6);
    pen.textAlign = "right";
    pen.fillText("deflection × " + shown(factor), w - 14, h - 14);
    pen.textAlign = "left";
  }
  function banner(k) {
    pen.font = "13px sans-serif";
    runs.forEach(function (r, n) {
      if (!r.shown) return;
      var y = 20 + 20 * n, s = r.state[k];
      disc([20, y - 4], 5, colours[n]);
      pen.fillStyle = "#1d2430"; pen.fillText(r.label, 32, y);
      if (s >= 0) {
        var x = 42 + pen.measureText(r.label).width;
        pen.fillStyle = stateColours[s]; pen.fillRect(x, y - 10, 10, 10);
        pen.fillStyle = "#5b6572"; pen.fillText(states[s], x + 16, y);
      }
    });
  }
  function shown(f) { return f >= 10 ? Math.round(f) : Math.round(10 * f) / 10; }
  function go(t) { time = Math.max(film.start, Math.min(film.end, t)); draw(); mark(t); }
  window.reportGo = go;
  function run(now) {
    if (!playing) return;
    time += (now - last) / 1000 * Number(speed.value);
    last = now;
    if (time > film.end) time = film.start;
    draw();
    requestAnimationFrame(run);
  }
  function toggle() {
    playing = !playing;
    play.textContent = playing ? "Pause" : "Play";
    last = performance.now();
    if (playing) requestAnimationFrame(run);
  }
  play.addEventListener("click", toggle);
  scrub.max = film.frames - 1;
  scrub.addEventListener("input", function () {
    time = film.start + (film.end - film.start) * scrub.value / (film.frames - 1); draw();
  });
  factorBar.max = Math.log10(20 * film.factor); factorBar.value = Math.log10(film.factor);
  function setFactor() { factor = Math.pow(10, factorBar.value); factorText.textContent = "× " + shown(factor); }
  factorBar.addEventListener("input", function () { setFactor(); draw(); });
  document.getElementById("true").addEventListener("click", function () {
    factorBar.value = Number(factorBar.value) > 0 ? 0 : Math.log10(film.factor); setFactor(); draw();
  });
  Array.prototype.forEach.call(document.querySelectorAll("input[data-run]"), function (box) {
    box.addEventListener("change", function () { runs[box.dataset.run].shown = box.checked; draw(); });
  });
  var from = null;
  function turned(a, b, angle) {
    var c = Math.cos(angle), s = Math.sin(angle);
    return [a.map(function (v, i) { return c * v + s * b[i]; }), b.map(function (v, i) { return c * v - s * a[i]; })];
  }
  canvas.addEventListener("pointerdown", function (e) { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", function () { from = null; });
  canvas.addEventListener("pointermove", function (e) {
    if (!from) return;
    var side = turned(view[0], view[2], -0.008 * (e.clientX - from[0]));
    view[0] = side[0]; view[2] = side[1];
    var tilt = turned(view[1], view[2], 0.008 * (e.clientY - from[1]));
    view[1] = tilt[0]; view[2] = tilt[1];
    from = [e.clientX, e.clientY]; draw();
  });
  canvas.addEventListener("dblclick", function () {
    view = film.view.map(function (row) { return row.slice(); }); draw();
  });
  document.addEventListener("keydown", function (e) {
    if (/INPUT|SELECT|BUTTON/.test(e.target.tagName)) return;
    var step = (film.end - film.start) / (film.frames - 1);
    if (e.key === " ") { toggle(); e.preventDefault(); }
    if (e.key === "ArrowRight") go(time + step);
    if (e.key === "ArrowLeft") go(time - step);
  });
  window.addEventListener("resize", draw);
  factor = Math.pow(10, factorBar.value); setFactor();
  var asked = /[#&]t=(-?[\d.]+)/.exec(location.hash);
  go(asked ? Number(asked[1]) : film.still);
})();
"""

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>{{ style|safe }}</style>
</head>
<body>
<header>
<h1>{{ title }}</h1>
<p>{% for run in runs %}<span class="chip" style="background:{{ run.colour }}"></span>{{ run.label }}
{%- if run.description %} <span class="small">({{ run.description }})</span>{% endif %}{% if not loop.last %} &nbsp;·&nbsp; {% endif %}{% endfor %}</p>
</header>
<nav><a href="#short">In short</a><a href="#summary">Summary</a>
{%- if film %}<a href="#animation">Animation</a>{% endif %}
{%- for f in figures %}<a href="#{{ f.name }}">{{ f.title }}</a>{% endfor %}
{%- if events %}<a href="#events">Events</a>{% endif %}</nav>
<main>
<section id="short"><h2>In short</h2>
{% if opening %}<p class="opening">{{ opening }}</p>
{% endif %}<ul class="short">{% for line in short %}<li>{{ line }}</li>{% endfor %}</ul>
{% if notes %}<h2 style="margin-top:14px">Notes</h2>
<ul class="short notes">{% for note in notes %}<li>{{ note }}</li>{% endfor %}</ul>{% endif %}
</section>
<section id="summary"><h2>Summary</h2>
<div class="scroll"><table>
<thead><tr><th></th>{% for run in runs %}<th scope="col"><span class="chip" style="background:{{ run.colour }}"></span>{{ run.label }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in rows %}
{% if row.group %}<tr class="group"><th scope="rowgroup" colspan="{{ runs|length + 1 }}">{{ row.group }}</th></tr>
{% else %}<tr><th scope="row">{{ row.name }}</th>{% for cell in row.cells %}<td{% if cell.bad %} class="bad"{% endif %}>{{ cell.text }}{% if cell.small %} <span class="small">{{ cell.small }}</span>{% endif %}</td>{% endfor %}</tr>
{% endif %}{% endfor %}</tbody>
</table></div></section>
{% if film %}<section id="animation"><h2>Animation</h2>
<p class="caption">{{ film_caption }}</p>
<canvas id="stage" role="img" aria-label="the moving arm"></canvas>
<div class="controls">
<button id="play" type="button">Play</button>
<label>speed <select id="speed"><option value="0.1">0.1</option><option value="0.25">0.25</option><option value="0.5">0.5</option><option value="1" selected>1</option><option value="2">2</option></select></label>
<input id="scrub" type="range" min="0" max="1" value="0" aria-label="time"><output id="clock"></output>
<label>deflection <input id="factor" type="range" min="0" max="1" step="0.01" aria-label="exaggeration"> <output id="factortext"></output></label>
<button id="true" type="button">true scale</button>
{% if film_runs|length > 1 %}{% for run in film_runs %}<label><input type="checkbox" checked data-run="{{ loop.index0 }}"> <span class="chip" style="background:{{ run.colour }}"></span>{{ run.label }}</label>{% endfor %}{% endif %}
</div>
<script type="application/json" id="film">{{ film|safe }}</script>
</section>{% endif %}
{% for f in figures %}<section id="{{ f.name }}"><h2>{{ f.title }}</h2>
<p class="caption">{{ f.caption }}</p>
<div class="figure"{% if f.times %} data-times="{{ f.times|tojson|forceescape }}"{% endif %}>{{ f.image|safe }}</div>
{% if f.name == "spectra" and frequencies %}<div class="scroll"><table>
<thead><tr><th>frequencies [Hz]</th><th scope="col">measured, strongest first</th><th scope="col">predicted, joints locked</th><th scope="col">predicted, joints free</th></tr></thead>
<tbody>{% for row in frequencies %}<tr><th scope="row">{{ row[0] }}</th>{% for cell in row[1:] %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</tbody></table></div>{% endif %}
</section>
{% endfor %}
{% if events %}<section id="events"><h2>Events</h2>
<p class="caption">What the supervisor decided, and why; times {{ time_label }}.{% if events_left %} The first {{ events|length }}; {{ events_left }} more are not shown.{% endif %}</p>
<div class="scroll tall"><table><thead><tr><th>run</th><th>time [s]</th><th>state</th><th>reason</th></tr></thead>
<tbody>{% for e in events %}<tr><td>{{ e[0] }}</td><td>{{ e[1] }}</td><td{% if e[2] == "FAULT" %} class="bad"{% endif %}>{{ e[2] }}</td><td>{{ e[3] }}</td></tr>{% endfor %}</tbody></table></div></section>{% endif %}
<footer><h2>How the numbers are made</h2><dl>{% for term, text in terms %}<dt>{{ term }}</dt><dd>{{ text }}</dd>{% endfor %}</dl>
<p>Made by <code>flexarm report</code> from {% for run in runs %}<code>{{ run.path }}</code>{% if not loop.last %}, {% endif %}{% endfor %}. All of it is in this file; it asks the network for nothing.</p></footer>
</main>
<script>{{ script|safe }}</script>
</body>
</html>
"""
