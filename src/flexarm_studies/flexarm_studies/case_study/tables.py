# SPDX-License-Identifier: Apache-2.0
"""The case study's tables, beside the published numbers."""

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
        "Nonlinear arm, 90 deg in 2 s: three nodes at 1 kHz (n) beside the continuous loop (c)",
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
