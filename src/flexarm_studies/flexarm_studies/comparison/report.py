# SPDX-License-Identifier: Apache-2.0
"""Writes the tables of a comparison for the terminal and for docs/comparison.md."""

from .. import markdown
from ..uncertain import report as uncertain
from .controllers import OWN, PID, SHIPPED

BEGIN, END = "<!-- comparison: begin -->", "<!-- comparison: end -->"
HEAD = (
    "joint error, peak [mrad]",
    "tip error, peak [mm]",
    "rms [mm]",
    "residual, rms [mm]",
    "settled after [s]",
    "torque, peak [N m]",
)


def cells(row, window):
    """The table's cells of a row, one per name in `HEAD`."""
    if "refused" in row:
        return ["refused"] + [""] * (len(HEAD) - 1)
    if "lost" in row:
        return ["arm lost"] + [""] * (len(HEAD) - 1)
    return [
        f"{1e3 * row['peak_joint_error_rad']:.3g}",
        f"{row['peak_tip_mm']:.4g}",
        f"{row['rms_tip_mm']:.4g}",
        f"{row['residual_mm']:.3g}",
        settled(row, window),
        "; ".join(f"{u:.3g}" for u in row["peak_torque_Nm"]),
    ]


def settled(row, window):
    """Settling time as text."""
    if "cost" not in row or "refused" in row or "lost" in row:
        return ""
    return f"> {window:g}" if row["settling_s"] is None else f"{row['settling_s']:.2f}"


def text(found):
    """All tables, Markdown."""
    return "\n\n".join(part for case in found["cases"] for part in _case(case))


def _case(case):
    window = case["window_s"]
    yield (
        f"## {case['arm']}\n\n`{case['motion']}`, {case['rate_Hz']:g} Hz,"
        f" {case['budget']} simulations per tuning; residual: 0 to {window:g} s after the motion."
    )
    if case.get("plants"):
        rows = case["plants"]
        others = len({row["variant"] for row in rows} - {uncertain.NOMINAL})
        yield f"### {case['arm']}, uncertain plants\n\nMedian and worst of {others} plants; {uncertain.legend(rows)}."
        yield "\n".join(uncertain.table(rows))
        yield uncertain.bullets(uncertain.verdicts(rows))
    if case["controllers"] or case["combinations"]:
        yield f"### {case['arm']}, on the controllers' model"
    if case["controllers"]:
        yield _table(
            ("controller", *HEAD, "with noise: residual [mm]", "settled [s]", "cost"),
            [_candidate(name, c, window) for name, c in case["controllers"].items()],
        )
        yield _gains(case["controllers"])
        yield "\n".join(f"- {line}" for line in verdicts(case))
    if case["combinations"]:
        parts = ("slow", "fast", "manifold", "feedforward")
        rows = sorted(case["combinations"], key=lambda c: c["row"]["cost"])
        yield _table(
            (*parts, *HEAD, "cost"),
            [(*(c[p] for p in parts), *cells(c["row"], window), _cost(c["row"])) for c in rows],
        )


def _candidate(name, c, window):
    noisy = c["noisy"]
    complete = "residual_mm" in noisy
    residual = f"{noisy['residual_mm']:.3g}" if complete else cells(noisy, window)[0]
    return (name, *cells(c["row"], window), residual, settled(noisy, window), _cost(c["row"]))


def _cost(row):
    return "" if "refused" in row or "lost" in row else f"{row['cost']:.3g}"


def _gains(controllers):
    lines = []
    for name, c in controllers.items():
        if c["gains"]:
            gains = ", ".join(f"{k} = {v:.4g}" for k, v in c["gains"].items())
            lines.append(
                f"- {name}: {gains} (cost {c['first']:.3g} at the first guess, {c['best']:.3g} after"
                f" {c['simulations']} simulations)"
            )
    return "\n".join(lines)


def verdicts(case):
    """Conclusions from the rows, one sentence each."""
    controllers, window = case["controllers"], case["window_s"]
    if SHIPPED not in controllers:
        return []
    own = controllers[SHIPPED]["row"]
    if "residual_mm" not in own:
        return [f"The shipped controller fails: {own.get('lost') or own.get('refused')}."]
    lines = []
    baselines = {
        name: c["row"]
        for name, c in controllers.items()
        if name not in OWN and "residual_mm" in c["row"]
    }
    if PID in baselines:
        lines.append(_against_pid(own, baselines[PID], window))
    better = [
        name
        for name, row in baselines.items()
        if row["rms_tip_mm"] < own["rms_tip_mm"] and row["residual_mm"] < own["residual_mm"]
    ]
    lines.append(
        f"Better than the shipped controller in both tip tracking (rms) and residual: {', '.join(better)}."
        if better
        else "No baseline beats the shipped controller in both tip tracking (rms) and residual."
    )
    return lines


def _against_pid(own, pid, window):
    if own["settling_s"] is None:
        return f"The shipped controller does not settle within {window:g} s."
    late = window if pid["settling_s"] is None else pid["settling_s"]
    more = "more than " if pid["settling_s"] is None else ""
    torques = zip(own["peak_torque_Nm"], pid["peak_torque_Nm"], strict=True)
    ratio = max(a / b for a, b in torques if b)
    return (
        f"The shipped controller settles {more}{late / own['settling_s']:.2g} times sooner than the tuned joint PID,"
        f" with at most {ratio:.2f} times its peak torque in any joint."
    )


def _table(head, rows):
    return "\n".join(markdown.table(head, rows))


def write(found, file):
    """Put the tables of a comparison, as in its JSON, between the markers of a Markdown `file`."""
    markdown.write_between(file, BEGIN, END, f"\n{text(found)}\n")
