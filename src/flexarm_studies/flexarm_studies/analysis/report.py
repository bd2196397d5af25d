# SPDX-License-Identifier: Apache-2.0
"""Writes the text of an analysis for a terminal."""

from flexarm_control.robust.limit_cycle import LimitCycle
from flexarm_control.robust.verdict import Bears

from ..loop.judged import words
from ..loop.scenario import type_of


def _digits(value):
    return "-" if value is None else f"{value:.4g}"


def _short(value):
    return "does not rest" if value is None else f"{value:.3g}"


def _row(label, value):
    return f"  {label:58}{value}"


def lines(found):
    """Lines of the whole report on what `command.study` has `found`."""
    scenario = found["scenario"]
    kinds = ", ".join(
        f"{k} {type_of(k, scenario['controller'])}"
        for k in ("slow", "fast", "manifold", "observer")
    )
    out = [f"{scenario['arm']}: {kinds}; {found['rate_Hz']:g} Hz; {scenario['trajectory']}"]
    for part, heading, text in (
        ("verdict", "Verdict", _verdict),
        ("scales", "Time scales", _scales),
        ("gain_sweep", "Slow gains and the bending: poles of the whole loop", _sweep),
        ("bound", "How large mu may be", _bound),
        ("margins", "Margins", _margins),
        ("attraction", "From how far off the arm comes back", _attraction),
        ("monte_carlo", "Monte Carlo", _monte_carlo),
    ):
        if found[part] is None:
            continue
        out += ["", heading]
        reason = found[part].get("reason")
        if reason:
            out.append(f"  {reason}")
        if not reason or part == "bound":
            out += text(found[part])
    return out


def _poles(poles):
    """Poles as text, conjugate pairs once."""
    if poles is None:
        return "-"
    size = max(abs(complex(*p)) for p in poles)
    # Undamped poles lie at zero, apart from rounding.
    upper = [(0.0 if abs(re) < 1e-10 * size else re, im) for re, im in poles if im >= 0.0]
    return ", ".join(f"{re:.4g}" + (f" +- {im:.4g}j" if im else "") for re, im in upper)


def _verdict(v):
    yield f"  {v['text']}"
    yield _row("the loop bears", words(Bears(**v["bears"])))
    for cycle in v["bears"]["limit_cycles"]:
        yield f"  {LimitCycle(**cycle).text}"


def _scales(s):
    p, along, over = s["spectra"], s["along_worst"], s["workspace"]
    yield _row("mu along the motion", f"{along['mu_min']:.4g} to {along['mu_max']:.4g}")
    count = over["count"]
    yield _row(f"mu in {count} configurations", f"{over['mu_min']:.4g} to {over['mu_max']:.4g}")
    yield _row("greatest at [rad]", _list(over["mu_max_at_rad"]))
    yield _row("separation, bending without and with control", _separation(p))
    yield _row("slow poles, open and closed [1/s]", f"0; {_poles(p['slow_closed'])}")
    yield _row("fast poles, open [1/s]", _poles(p["fast_open"]))
    yield _row("fast poles, closed [1/s]", _poles(p["fast_closed"]))
    yield _row("poles of the whole, sampled [1/s]", _poles(p["full_order"]))
    for name, where in (("along the motion", along), ("in the workspace", over)):
        word = "yes" if where["stabilisable"] else "NO"
        value = where["singular_value_min"]
        text = word if value is None else f"{word}, singular value from {value:.3g} on"
        text += f", at {_list(where['singular_value_min_at_rad'])} rad" if value is not None else ""
        yield _row(f"(A2, B2) stabilisable {name}", text)


def _separation(p):
    return f"{p['separation_open']:.4g}, {_digits(p['separation_closed'])}"


def _list(values):
    return "[" + ", ".join(f"{v:.4g}" for v in values) + "]"


def _sweep(s):
    yield f"  {'slow.kp [1/s^2]':26}{'slowest [1/s]':>14}  frequency [rad/s] (damping) of the fast ones"
    for row in s["rows"]:
        kp = _list(row["kp"])
        if row["poles"] is None:
            yield f"  {kp:26}{'-':>14}  the design fails"
            continue
        pairs = zip(row["fast_frequencies"], row["fast_damping"], strict=True)
        text = ", ".join(f"{w:.4g} ({z:.2f})" for w, z in pairs)
        yield f"  {kp:26}{row['slowest']:14.4g}  {text}"


def _bound(b):
    if b["bound"] is None:
        return
    c = b["constants"]
    verdict = "stable, proven" if b["mu"] < b["bound"] else "not proven by it"
    yield _row("mu at the motion's end", _digits(b["mu"]))
    yield _row("Saberi & Khalil: stable for all mu below", f"{b['bound']:.4g} ({verdict})")
    yield _row(
        "its constants beta1 beta2, gamma, d",
        f"{c['beta1'] * c['beta2']:.4g}, {c['gamma']:.4g}, {c['d']:.4g}",
    )
    for key, label in (
        ("linear_limit", "the same linear loop is stable up to mu"),
        ("redesign_limit", "redesigned for slower bending, sampled, up to mu"),
    ):
        value = b[key]
        yield _row(label, f"{b['searched']:.4g} at least" if value is None else _digits(value))
    sim = b["simulated"]
    if sim is not None:
        label = f"nonlinear runs at mu {sim['inside_mu']:.4g} and {sim['beyond_mu']:.4g}"
        yield _row(label, f"{_word(sim['inside'])}, {_word(sim['beyond'])}")


def _word(stable):
    return "stable" if stable else "unstable"


def _margins(m):
    if not m["stable"]:
        yield _row("the linear loop", "is NOT stable")
    yield _row("slowest pole decays with [1/s]", _digits(m["decay_per_s"]))
    for margin in m["margins"].values():
        unit = "" if margin["unit"] == "-" else f" {margin['unit']}"
        if margin["value"] is None:
            text = f"none up to {margin['searched']:g}{unit}"
        else:
            text = f"{margin['value']:.4g}{unit}"
        if "confirmed" in margin:
            text += ", confirmed by runs" if margin["confirmed"] else ", NOT confirmed by runs"
            if margin["simulated"] is not None:
                least = "at least " if margin["at_least"] else ""
                text += f": {least}{margin['simulated']:.4g}{unit} with the observer"
        yield _row(f"unstable with {margin['text']}", text)
    plants = ", ".join(
        f"{p['what']} {p['factor']:g}: {_short(p['decay_per_s'])}" for p in m["plants"]
    )
    yield _row("decay on other arms [1/s]", plants)
    noise = m["noise"]
    yield _row(
        "tip under the gauges' noise, rms [mm]", noise["reason"] or _digits(noise["tip_rms_mm"])
    )


def _attraction(a):
    for ray in a["rays"]:
        least = "at least " if ray["scale"] >= ray["searched"] else ""
        yield _row(f"{ray['direction']} [{ray['unit']}]", f"{least}{ray['scale']:.4g}")


def _monte_carlo(m):
    low, high = m["lost_share_95"]
    lost = f"{m['lost']} of {m['samples']} (95 % interval of the fraction {low:.3g} to {high:.3g})"
    yield _row("arm lost", lost)
    yield _row("not settled within the tolerance", str(m["not_settled"]))
    names = next(iter(m["quantiles"].values()), {})
    yield "  " + f"{'quantile':28}" + "".join(f"{k:>12}" for k in names)
    for name, values in m["quantiles"].items():
        yield "  " + f"{name:28}" + "".join(f"{v:12.4g}" for v in values.values())
    start, end = m["residual_window_s"]
    yield f"  residual: {start:g} to {end:g} s after the motion"
