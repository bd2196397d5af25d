# SPDX-License-Identifier: Apache-2.0
"""Writes the case study's tables, beside the published numbers."""

from flexarm_dynamics.arm.units import FOOT

from . import heavier

#: Section 5 of Siciliano & Book (1986), magnitudes, in the paper's units.
PRINT = {
    "k_f": (75.50, 6375.64, 17.07, 173.10),
    "closed_loop_frequencies_rad_s": (18.59, 94.10),
    "closed_loop_damping": (0.766, 0.753),
    "open_loop_frequencies_rad_s": (14.0, 90.0),
}


def linear_table(summaries):
    """Lines of the table of gains, frequencies and damping: published | P3 | R."""
    composite = {s["model"]: s for s in summaries if s["control"] == "composite"}
    p3, r = composite["P3_m11"], composite["R_m11"]
    lines = [
        "Fast subsystem at the end of the motion: open loop, and closed by the optimal fast control",
        f"{'':34}{'published':>12}{'P3':>12}{'R':>12}",
    ]
    labels = {
        "open_loop_frequencies_rad_s": ("open loop, mode {} [rad/s]", "~{:.0f}"),
        "closed_loop_frequencies_rad_s": ("closed loop, mode {} [rad/s]", "{:.2f}"),
        "closed_loop_damping": ("damping ratio, mode {} [-]", "{:.3f}"),
    }
    for key, (label, digits) in labels.items():
        for i, printed in enumerate(PRINT[key]):
            lines.append(
                f"{label.format(i + 1):34}{digits.format(printed):>12}"
                f"{p3[key][i]:12.4f}{r[key][i]:12.4f}"
            )
    names = ("mode 1 [lbf]", "mode 2 [lbf]", "rate 1 [lbf s]", "rate 2 [lbf s]")
    for i, printed in enumerate(PRINT["k_f"]):
        name = f"k_f, {names[i]}"
        lines.append(f"{name:34}{printed:12.2f}{abs(p3['k_f'][i]):12.3f}{abs(r['k_f'][i]):12.3f}")
    lines.append("(k_f: magnitudes; for R all of u_f = -k z_f are negative with tip shapes (+, -))")
    return lines


def nonlinear_table(summaries, references):
    """Lines of the table of the nonlinear runs: nodes beside the continuous loop."""
    lines = [
        "Nonlinear arm, 90 deg in 2 s: three nodes at 1 kHz (n; P3_h11: one process) beside the continuous loop (c)",
        f"{'':26}{'peak joint':>15}{'max error':>17}{'tip residual':>19}{'peak tip':>17}{'peak torque':>15}",
        f"{'':26}{'error [deg]':>15}{'t > 3 s [deg]':>17}{'rms 3-8 s [ft]':>19}{'[ft]':>17}{'[lbf ft]':>15}",
        f"{'':26}"
        + f"{'n':>8}{'c':>7}{'n':>9}{'c':>8}{'n':>10}{'c':>9}{'n':>9}{'c':>8}{'n':>8}{'c':>7}",
    ]
    for s in summaries:
        key = (s["model"], s["control"])
        c = references[key]
        who = f"{s['model']} {s['control']}" + (", observer" if s["rates"] == "observer" else "")
        lines.append(
            f"{who:26}"
            f"{s['peak_joint_error_deg']:8.4f}{c['peak_joint_error_deg']:7.3f}"
            f"{s['max_joint_error_after_3s_deg']:9.4f}{c['max_joint_error_after_3s_deg']:8.4f}"
            f"{s['residual_tip_rms_ft']:10.2e}{c['residual_tip_rms_ft']:9.2e}"
            f"{s['peak_tip_deflection_ft']:9.4f}{c['peak_tip_deflection_ft']:8.4f}"
            f"{s['peak_torque_lbf_ft']['total']:8.3f}{c['peak_torque_lbf_ft']['total']:7.3f}"
        )
    return lines


def heavier_table(summaries):
    """Lines of the table of the controls with a payload that they do not know."""
    lines = [
        f"The same motion of arm R, payload {heavier.PAYLOAD:.2f} times that of the arm file, {heavier.RATE:g} Hz,"
        f" delay {1e3 * heavier.DELAY:g} ms, rates from the gauges",
        f"{'':26}{'peak joint':>15}{'tip residual':>17}{'tip within 1 mm':>19}{'peak torque':>15}",
        f"{'':26}{'error [deg]':>15}{'rms 3-8 s [ft]':>17}{'after motion [s]':>19}{'[lbf ft]':>15}",
    ]
    for s in summaries:
        settled = s["settling_time_s"]
        lines.append(
            f"{heavier.NAMES[s['control']]:26}{s['peak_joint_error_deg']:15.3f}{s['residual_tip_rms_ft']:17.2e}"
            f"{'never' if settled is None else format(settled, '.2f'):>19}"
            f"{s['peak_torque_lbf_ft']['total']:15.3f}"
        )
    return lines


def gained(summaries):
    """Sentences on the improvement by the designed control over the paper's two, for the same payload."""
    by = {s["control"]: s for s in summaries}
    lines = [
        "What is gained: the payload is a third heavier than the controller knows, and torque is"
        f" {1e3 * heavier.DELAY:g} ms late."
    ]
    for control, s in by.items():
        settled = s["settling_time_s"]
        rest = (
            "does not come to rest within 1 mm"
            if settled is None
            else f"is at rest within 1 mm {settled:.2f} s after the motion"
        )
        lines.append(
            f"  {heavier.NAMES[control] + ':':20} the joint is up to {s['peak_joint_error_deg']:.2f} deg off; the tip"
            f" vibrates by {1e3 * FOOT * s['residual_tip_rms_ft']:.2g} mm rms and {rest}"
        )
    return lines + [f"  {sentence}" for sentence in compared(summaries)]


def compared(summaries):
    """The designed control compared with each of the paper's two, a sentence each."""
    by, found = {s["control"]: s for s in summaries}, []
    for control in ("composite", "slow"):
        error, residual, settling = (
            _ratio(by[control][key], by["designed"][key])
            for key in ("peak_joint_error_deg", "residual_tip_rms_ft", "settling_time_s")
        )
        found.append(
            f"Against the {heavier.NAMES[control]}, the designed control has {error} less joint error and {residual}"
            f" less vibration, and rests {settling} sooner."
        )
    return found


def _ratio(value, designed):
    """How many times smaller the designed control's value is, in words."""
    if value is None or not designed:
        return "far"
    return f"{float(f'{value / designed:.2g}'):g} times"
