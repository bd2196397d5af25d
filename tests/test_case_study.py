# SPDX-License-Identifier: Apache-2.0
"""`flexarm demo` as a user runs it: three processes over DDS, figures, bags, summary, table."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flexarm_studies.case_study import runs as case_study
from flexarm_studies.case_study import tables
from flexarm_studies.loop.closed_loop import TRAJECTORY_START_NS
from flexarm_tools.recording import recorder

#: The nonlinear rows of the reference table (lbf ft, ft, deg), see tests/data/README.md.
COLUMNS = (
    "peak_joint_error_deg",
    "max_joint_error_after_3s_deg",
    "residual_tip_rms_ft",
    "peak_tip_deflection_ft",
)
ROWS = {
    ("P3_h11", "slow"): ((2.031, 0.573, 5.66e-3, 0.0748), (2.827, 0.0, 2.827)),
    ("P3_h11", "composite"): ((4.655, 0.243, 2.15e-4, 0.0841), (3.752, 1.159, 3.537)),
    ("P3_m11", "slow"): ((0.0851, 0.0285, 5.72e-3, 0.0776), (2.897, 0.0, 2.897)),
    ("P3_m11", "composite"): ((3.720, 0.390, 3.00e-4, 0.0849), (3.787, 1.203, 3.569)),
    ("R_m11", "slow"): ((0.0851, 0.0285, 5.69e-3, 0.0774), (2.897, 0.0, 2.897)),
    ("R_m11", "composite"): ((3.457, 0.392, 2.64e-4, 0.0833), (3.726, 1.110, 3.512)),
}


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Results of one run of the demo, and what it printed."""
    out = tmp_path_factory.mktemp("case_study")
    done = subprocess.run(
        [sys.executable, "-m", "flexarm_bringup.cli", "demo", "--out", str(out)],
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    return out, json.loads((out / "summary.json").read_text()), done.stdout


def entry(summary, model, control, rates="true"):
    return next(
        r
        for r in summary["runs"]
        if (r["model"], r["control"], r["rates"]) == (model, control, rates)
    )


def test_summary_has_the_seven_runs_with_every_field(demo):
    _, summary, _ = demo
    assert len(summary["runs"]) == 7
    for run in summary["runs"]:
        assert set(run) == {
            "model", "control", "rates", "open_loop_frequencies_rad_s", "k_f",
            "closed_loop_frequencies_rad_s", "closed_loop_damping", "full_order_poles",
            "peak_joint_error_deg", "max_joint_error_after_3s_deg", "residual_tip_rms_ft",
            "peak_tip_deflection_ft", "peak_torque_lbf_ft", "wall_seconds", "simulated_seconds",
        }  # fmt: skip
        assert set(run["peak_torque_lbf_ft"]) == {"slow", "fast", "total"}
        assert run["simulated_seconds"] >= 8.0
        assert len(run["full_order_poles"]) == 6


@pytest.mark.parametrize(("model", "control"), ROWS)
def test_nodes_at_1_khz_are_within_2_percent_of_the_reference_rows(demo, model, control):
    _, summary, _ = demo
    run, (values, torques) = entry(summary, model, control), ROWS[model, control]
    for key, wanted in zip(COLUMNS, values, strict=True):
        tolerance = 0.08 if key == "max_joint_error_after_3s_deg" else 0.02
        assert run[key] == pytest.approx(wanted, rel=tolerance), key
    for key, wanted in zip(("slow", "fast", "total"), torques, strict=True):
        assert run["peak_torque_lbf_ft"][key] == pytest.approx(wanted, rel=0.02), key


@pytest.mark.parametrize(("model", "control"), ROWS)
def test_continuous_loop_is_within_half_a_percent_of_the_reference_rows(demo, model, control):
    _, summary, _ = demo
    (run,) = (
        r for r in summary["continuous_loop"] if (r["model"], r["control"]) == (model, control)
    )
    values, torques = ROWS[model, control]
    for key, wanted in zip(COLUMNS, values, strict=True):
        assert run[key] == pytest.approx(wanted, rel=0.005), key
    for key, wanted in zip(("slow", "fast", "total"), torques, strict=True):
        assert run["peak_torque_lbf_ft"][key] == pytest.approx(wanted, rel=0.005), key


def test_p3_reproduces_the_printed_design(demo):
    _, summary, _ = demo
    run = entry(summary, "P3_m11", "composite")
    np.testing.assert_allclose(np.abs(run["k_f"]), [75.505, 6376.58, 17.072, 173.098], rtol=2e-4)
    np.testing.assert_allclose(np.abs(run["k_f"]), tables.PRINT["k_f"], rtol=2e-4)
    for key in ("closed_loop_frequencies_rad_s", "closed_loop_damping"):
        np.testing.assert_allclose(run[key], tables.PRINT[key], rtol=3e-4)


def test_the_observer_row_stays_close_to_the_one_with_true_rates(demo):
    _, summary, _ = demo
    with_observer = entry(summary, "R_m11", "composite", "observer")
    true = entry(summary, "R_m11", "composite")
    assert with_observer["residual_tip_rms_ft"] == pytest.approx(
        true["residual_tip_rms_ft"], rel=0.1
    )
    assert with_observer["residual_tip_rms_ft"] != true["residual_tip_rms_ft"]


@pytest.mark.parametrize("run", case_study.RUNS, ids=lambda run: run.name)
def test_bag_reads_back_and_equals_the_loop_without_ros(demo, run):
    from rosbags.highlevel import AnyReader

    out, _, _ = demo
    samples = {}
    with AnyReader([out / run.name / "bag"], default_typestore=recorder.typestore()) as reader:
        for connection, stamp, raw in reader.messages():
            topic = connection.topic.lstrip("/")
            assert recorder.raw_stamp_ns(raw) == stamp
            if not samples.get(topic):
                message = reader.deserialize(raw, connection.msgtype)
                assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
            samples.setdefault(topic, {})[stamp] = raw
    assert set(samples) == set(recorder.TOPICS)
    assert {len(s) for s in samples.values()} == {8101}
    nodes = recorder.to_record(recorder.decode(samples), TRAJECTORY_START_NS)
    alone = case_study.run_without_ros(run)
    common = alone.time >= nodes.time[0] - 1e-9
    for name in ("time", "reference", "position", "velocity", "amplitude", "rate", "torque"):
        of_nodes, of_one = getattr(nodes, name), getattr(alone, name)[common]
        # NaN: rates before the observer has converged.
        np.testing.assert_allclose(of_nodes, of_one, rtol=0.0, atol=1e-9, err_msg=name)


def test_figures_2_to_11_are_there_as_png_and_svg(demo):
    out, _, _ = demo
    for model in ("P3_h11", "P3_m11", "R_m11"):
        names = {p.name for p in (out / "figures" / model).iterdir() if p.stat().st_size > 5000}
        for number in range(2, 12):
            for suffix in ("png", "svg"):
                assert any(
                    n.startswith(f"fig{number:02d}_") and n.endswith(suffix) for n in names
                ), (model, number, suffix)


def test_terminal_shows_the_table_beside_print(demo):
    out, summary, printed = demo
    for number in ("6375.64", "18.59", "0.766", "P3_h11 composite", "observer", "ratio"):
        assert number in printed
    run = entry(summary, "R_m11", "composite")
    assert f"{run['peak_joint_error_deg']:.4f}" in printed
    assert str(Path(out) / "summary.json") in printed
