# SPDX-License-Identifier: Apache-2.0
"""The summary as text."""

from flexarm_studies.markdown import table


def _settings(settings):
    """Settings as short text; the step comes first, in ms."""
    parts = []
    if "step" in settings:
        parts.append(f"{1e3 * settings['step']:.3g} ms")
    for name, value in settings.items():
        if name != "step":
            parts.append(
                name if value is True else f"{name}={value:g}" if _number(value) else value
            )
    return ", ".join(parts)


def _number(value):
    return isinstance(value, (int, float))


def text(summary):
    """All tables of a `summary`, as `__main__` writes it."""
    lines = ["Times are those of the best turn, ratios the median of turns next to each other."]
    for case, result in summary["cases"].items():
        lines += _case(case, result)
    lines += ["", "RK4 at the same step, compiled loops alone [ms per simulated second]"]
    lines.append(f"  {'':24}{'step':>8}{'generated':>12}{'by hand':>12}{'ratio':>8}")
    for case, entries in summary["same_step"].items():
        for e in entries:
            lines.append(
                f"  {case:24}{1e3 * e['step']:5g} ms{e['generated']:12.4f}{e['hand']:12.4f}"
                f"{e['ratio']:8.2f}"
            )
    lines += ["", "One evaluation of the accelerations [us]"]
    lines.append(f"  {'links':>5}{'modes each':>12}{'in loops':>12}{'generated':>12}")
    for e in summary["links"] + summary["modes"]:
        lines.append(_cost(e))
    lines += ["  links that stiffen", *map(_cost, summary["stiffening"])]
    lines += [
        "",
        f"Batches of {summary['throughput']['runs']} trajectories, two links, RK4 at 1 ms",
    ]
    lines.append(f"  {'cores':>5}{'simulated s per s':>20}{'over one core':>16}{'to be had':>12}")
    for e in summary["throughput"]["cores"]:
        lines.append(
            f"  {e['cores']:5}{e['throughput']:20.0f}{e['speedup']:16.2f}{e['available']:12.2f}"
        )
    if summary["criteria"]:
        lines += ["", "Criteria"]
        lines += [_criterion(c) for c in summary["criteria"]]
    return "\n".join(lines).lstrip("\n")


def markdown(summary):
    """The tables of docs/performance.md."""
    rows = []
    for case, result in summary["cases"].items():
        for name, c in _fastest_first(result):
            ms, ratio = c.get("ms_per_s"), c.get("ratio")
            target = f"{1e6 * result['target']:.0f}"
            error = f"{1e6 * c['tip_error']:.0f}"
            rows.append((case, name, _settings(c["settings"]), error, target, ms, ratio))
    columns = ("case", "code", "settings", "tip off [um]", "wanted", "ms per s", "over flexarm's")
    lines = [*table(columns, rows), ""]
    rows = [
        (name, f"{1e3 * e['step']:g}", e["generated"], e["hand"], e["ratio"])
        for name, entries in summary["same_step"].items()
        for e in entries
    ]
    columns = ("arm", "step [ms]", "generated [ms per s]", "by hand [ms per s]", "ratio")
    lines += [*table(columns, rows), ""]
    first = {e["links"]: e for e in summary["links"]}
    rows = [
        (e["links"], *(x[code] for x in (first[e["links"]], e) for code in ("generated", "loops")))
        for e in summary["stiffening"]
    ]
    columns = ("links", "first order [us]", "in loops [us]", "stiffening [us]", "in loops [us]")
    return "\n".join(lines + table(columns, rows))


def _fastest_first(result):
    """Names and results of a case's codes, fastest first; codes that miss the target last."""
    return sorted(result["codes"].items(), key=lambda item: item[1].get("ratio", float("inf")))


def _cost(e):
    """One line of the cost of an evaluation."""
    generated = "-" if e["generated"] is None else f"{e['generated']:.4f}"
    return f"  {e['links']:5}{e['modes']:12}{e['loops']:12.3f}{generated:>12}"


def _case(case, result):
    """Table of one case, fastest first; codes that miss the target last."""
    lines = ["", f"{case}: tip within {1e6 * result['target']:g} um"]
    lines.append(f"  {'':40}{'ms per s':>10}{'ratio':>9}{'tip [um]':>10}  settings")
    for name, c in _fastest_first(result):
        time, ratio = "misses", ""
        if "ms_per_s" in c:
            time, ratio = f"{c['ms_per_s']:.4f}", f"{c['ratio']:.2f}" if "ratio" in c else "-"
        lines.append(
            f"  {name:40}{time:>10}{ratio:>9}{1e6 * c['tip_error']:10.1f}"
            f"  {_settings(c['settings'])}"
        )
    return lines


def _criterion(c):
    """One line of the list of criteria."""
    sign = ">=" if c["least"] else "<="
    mark = {True: "ok  ", False: "MISS", None: "-   "}[c["met"]]
    value = "not measured" if c["value"] is None else f"{c['value']:.3g}"
    return f"  {mark} {c['text']}: {value} (wanted {sign} {c['limit']:g})"
