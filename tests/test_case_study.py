# SPDX-License-Identifier: Apache-2.0
"""`flexarm demo`: the nodes give the loop without ROS; figures, bags, summary, tables.

`test_closed_loop` of flexarm_studies holds the loop without ROS to the paper's rows. Here each run of the nodes is held
to that loop, sample by sample: one run over DDS, the others in this process.
"""

import contextlib
import io
import json
import time
from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest
from in_process import InProcess

from flexarm_control.motions import profiles
from flexarm_dynamics.arm import arm_file
from flexarm_studies.case_study import heavier, tables
from flexarm_studies.case_study import runs as case_study
from flexarm_studies.loop.closed_loop import TRAJECTORY_START_NS
from flexarm_studies.progress import Progress
from flexarm_tools.case_study import demo, nodes
from flexarm_tools.recording import recorder
from flexarm_tools.running import lockstep

#: Runs of the nodes in the demo below, eight seconds each; the others run alone, for some of the motion.
WITH_NODES = [run for run in case_study.RUNS if run.model == "R_m11" and run.rates == "true"]
ALONE = [run for run in case_study.RUNS if run not in WITH_NODES]
SHORT = 0.8  # [s] from the start of the trajectory


def in_process(run, directory, progress=None):
    """As `nodes.run_nodes`, with the nodes in this process."""
    joints = arm_file.load(run.arm).joint_names
    start, begun = TRAJECTORY_START_NS, time.perf_counter()
    with InProcess() as bench:
        nodes.start_nodes(bench, run)
        message = lockstep.trajectory_message(joints, profiles.paper_profile(), 101, start)
        samples = bench.record(message, nodes.DURATION)
    recorder.write_bag(directory / "bag", samples, run.arm)
    count = len(samples["arm_state"])
    timing = lockstep.Timing(time.perf_counter() - begun, 1e-3 * count, count)
    return recorder.to_record(samples, start, run.arm), timing


def follows_the_loop_without_ros(bag, run, duration, over_dds=False):
    """The bag has every sample of every topic, and they are those of the loop without ROS.

    What rclpy serialises may end in padding, which rosbags does not take; what comes over DDS has none.
    """
    from rosbags.highlevel import AnyReader

    samples = {}
    with AnyReader([bag], default_typestore=recorder.typestore()) as reader:
        for connection, stamp, raw in reader.messages():
            topic = connection.topic.lstrip("/")
            assert recorder.raw_stamp_ns(raw) == stamp
            if over_dds and topic not in samples:
                message = reader.deserialize(raw, connection.msgtype)
                assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
            samples.setdefault(topic, {})[stamp] = raw
    assert set(samples) == set(recorder.TOPICS)
    assert {len(s) for s in samples.values()} == {round(1000 * duration) + 101}
    found = recorder.to_record(samples, TRAJECTORY_START_NS, run.arm)
    alone = case_study.run_without_ros(run)
    common = alone.time >= found.time[0] - 1e-9
    for name in ("time", "reference", "position", "velocity", "amplitude", "rate", "torque"):
        of_nodes, of_one = getattr(found, name), getattr(alone, name)[common]
        # NaN: rates before the observer has converged.
        np.testing.assert_allclose(of_nodes, of_one, rtol=0.0, atol=1e-9, err_msg=name)


@pytest.mark.parametrize(
    ("run", "how"),
    [(ALONE[-1], nodes.run_nodes), *((run, in_process) for run in ALONE)],
    ids=lambda found: getattr(found, "name", None) or found.__name__,
)
def test_nodes_give_every_sample_of_the_loop_without_ros(run, how, tmp_path, monkeypatch):
    monkeypatch.setattr(nodes, "DURATION", SHORT)
    monkeypatch.setattr(case_study, "DURATION", SHORT)
    how(run, tmp_path)
    follows_the_loop_without_ros(tmp_path / "bag", run, SHORT, how is nodes.run_nodes)


class InThisProcess:
    """An executor that calls at once."""

    @staticmethod
    def submit(function, *arguments):
        future = Future()
        future.set_result(function(*arguments))
        return future


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Results of the demo, and what it printed; of its seven runs four, two of them with the nodes.

    `test_lockstep` measures the relay.
    """
    out, printed = tmp_path_factory.mktemp("case_study"), io.StringIO()

    def with_nodes(run, directory, progress=None):
        return in_process(run, directory / run.name) if run in WITH_NODES else demo._timed(run)

    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(demo, "RUNS", (*WITH_NODES, *(r for r in ALONE if r.model == "P3_m11")))
        patch.setattr(demo, "TIMED", WITH_NODES[-1])
        patch.setattr(demo, "processes", lambda count: contextlib.nullcontext(InThisProcess()))
        patch.setattr(demo, "_with_nodes", with_nodes)
        patch.setattr(demo, "_relay", lambda directory: 1e-3)
        demo.demo(out, Progress())
    return SimpleNamespace(
        out=out, summary=json.loads((out / "summary.json").read_text()), printed=printed.getvalue()
    )


def entry(made, model, control):
    runs = [r for r in made.summary["runs"] if (r["model"], r["control"]) == (model, control)]
    return runs[0]


def test_the_demo_has_seven_runs():
    assert len(demo.RUNS) == 7 and demo.RUNS is case_study.RUNS


def test_summary_has_its_runs_with_every_field(made):
    assert len(made.summary["runs"]) == len(made.summary["continuous_loop"]) == 4
    for run in made.summary["runs"]:
        assert set(run) == {
            "model", "control", "rates", "open_loop_frequencies_rad_s", "k_f",
            "closed_loop_frequencies_rad_s", "closed_loop_damping", "full_order_poles",
            "peak_joint_error_deg", "max_joint_error_after_3s_deg", "residual_tip_rms_ft",
            "peak_tip_deflection_ft", "peak_torque_lbf_ft", "wall_seconds", "simulated_seconds",
        }  # fmt: skip
        assert set(run["peak_torque_lbf_ft"]) == {"slow", "fast", "total"}
        assert run["simulated_seconds"] >= 8.0
        assert len(run["full_order_poles"]) == 6
    assert made.summary["lockstep"]["ratio"] > 0.0


def test_p3_reproduces_the_published_design(made):
    run = entry(made, "P3_m11", "composite")
    np.testing.assert_allclose(np.abs(run["k_f"]), [75.505, 6376.58, 17.072, 173.098], rtol=2e-4)
    np.testing.assert_allclose(np.abs(run["k_f"]), tables.PRINT["k_f"], rtol=2e-4)
    for key in ("closed_loop_frequencies_rad_s", "closed_loop_damping"):
        np.testing.assert_allclose(run[key], tables.PRINT[key], rtol=3e-4)


def test_a_run_in_one_process_has_a_bag_of_the_same_samples(tmp_path, monkeypatch):
    monkeypatch.setattr(case_study, "DURATION", SHORT)
    run = next(run for run in case_study.RUNS if run.model == demo.IN_ONE_PROCESS)
    record, _ = demo._timed(run, tmp_path)
    follows_the_loop_without_ros(tmp_path / run.name / "bag", run, SHORT)
    assert record.time[-1] == pytest.approx(SHORT)


@pytest.mark.parametrize("run", WITH_NODES, ids=lambda run: run.name)
def test_bag_of_the_demo_equals_the_loop_without_ros(made, run):
    follows_the_loop_without_ros(made.out / run.name / "bag", run, case_study.DURATION)


def test_figures_2_to_11_are_there_as_png_and_svg(made):
    for model in ("P3_m11", "R_m11"):
        folder = made.out / "figures" / model
        names = {p.name for p in folder.iterdir() if p.stat().st_size > 5000}
        for number in range(2, 12):
            for suffix in ("png", "svg"):
                assert any(
                    n.startswith(f"fig{number:02d}_") and n.endswith(suffix) for n in names
                ), (model, number, suffix)


def test_terminal_shows_the_table_beside_the_published_numbers(made):
    for number in ("6375.64", "18.59", "0.766", "P3_m11 composite", "ratio"):
        assert number in made.printed
    assert f"{entry(made, 'R_m11', 'composite')['peak_joint_error_deg']:.4f}" in made.printed
    assert str(made.out / "summary.json") in made.printed


def test_the_last_lines_and_the_report_say_what_the_designed_control_gains(made):
    by = {s["control"]: s for s in made.summary["heavier_payload"]}
    assert list(by) == ["slow", "composite", "designed"]
    assert {s["payload_scale"] for s in by.values()} == {4.0 / 3.0}
    last = made.printed.split("What is gained")[1]
    page = (made.out / "report.html").read_text()
    for control, name in heavier.NAMES.items():
        assert f"{name}:" in last and f"{by[control]['peak_joint_error_deg']:.2f} deg" in last
        assert name in page and (made.out / f"R_heavier_{control}" / "bag").is_dir()
    for sentence in tables.compared(made.summary["heavier_payload"]):
        assert sentence in last and sentence in page
    assert len(last.splitlines()) <= 8
    for suffix in ("png", "svg"):
        assert (made.out / "figures" / "R_heavier" / f"overview.{suffix}").stat().st_size > 5000
