# SPDX-License-Identifier: Apache-2.0
"""Runs the case study with a payload that the controller does not know: the paper's two controls, and a designed one.

All three run in the same loop: `RATE`, `DELAY`, and rates that the observer takes from the gauges.
"""

from ..loop import scenario

#: Factor of the arm file's payload [-], samples per second [Hz], and delay from a sample to its torque [s].
PAYLOAD, RATE, DELAY = 4.0 / 3.0, 500.0, 0.002
#: Control to its controller file; `flexarm design` has made the last one for `RATE` and `DELAY`.
CONTROLS = {"slow": "paper_slow", "composite": "paper_composite", "designed": "R_designed"}
NAMES = {
    "slow": "slow control alone",
    "composite": "composite control",
    "designed": "designed control",
}
#: Metrics in the summary of each control: keys of `case_study_metrics`.
METRICS = ("peak_joint_error_deg", "residual_tip_rms_ft", "peak_torque_lbf_ft")


def scenario_of(control):
    """The paper's motion under one of `CONTROLS`."""
    return scenario.Scenario(
        "R",
        scenario.parameters(CONTROLS[control]),
        "paper",
        payload_scale=PAYLOAD,
        rate=RATE,
        delay=DELAY,
        window=6.0,
    )


def run(control, recorder=None):
    """Record and metrics of a control's run; the `recorder` is that of `scenario.run_loop`."""
    return scenario.run_loop(scenario_of(control), recorder)[:2]


def summarise(control, metrics):
    """The control's entry in ``summary.json``; every value is computed from this run."""
    return {
        "model": "R",
        "control": control,
        "controller_file": CONTROLS[control],
        "payload_scale": PAYLOAD,
        "rate_hz": RATE,
        "delay_s": DELAY,
        **{key: metrics["case_study"][key] for key in METRICS},
        "settling_time_s": metrics["settling_time_s"],
    }
