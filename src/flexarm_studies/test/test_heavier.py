# SPDX-License-Identifier: Apache-2.0
"""The case study with a heavier payload: the designed control tracks and damps; words, table and figure say so."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.arm.units import FOOT
from flexarm_dynamics.models.model import build
from flexarm_studies.case_study import figures, heavier, tables


@pytest.fixture(scope="module")
def runs():
    return {control: heavier.run(control) for control in heavier.CONTROLS}


@pytest.fixture(scope="module")
def summaries(runs):
    return [heavier.summarise(control, metrics) for control, (_, metrics) in runs.items()]


def test_the_designed_control_tracks_as_the_slow_one_and_rests_sooner_than_both(summaries):
    slow, composite, designed = summaries
    assert designed["peak_joint_error_deg"] < slow["peak_joint_error_deg"] < 0.3
    assert designed["peak_joint_error_deg"] < 0.06 * composite["peak_joint_error_deg"]
    for other in (slow, composite):
        assert designed["residual_tip_rms_ft"] < 0.03 * other["residual_tip_rms_ft"]
        assert designed["settling_time_s"] < 0.2 * other["settling_time_s"]


def test_all_three_move_the_same_arm_in_the_same_loop(runs):
    for record, metrics in runs.values():
        assert_allclose(np.diff(record.time), 2e-3, rtol=1e-6)
        # The arm rests while the first torque is under way.
        assert not record.plant_position[record.time < heavier.DELAY + 1e-6].any()
        assert metrics["motion_s"] == 2.0 and metrics["simulated_s"] == 8.0
    peaks = [metrics["peak_torque_Nm"][0] for _, metrics in runs.values()]
    assert min(peaks) > 4.0


def test_the_sentences_have_the_runs_own_numbers(summaries):
    slow, composite, designed = summaries
    text = "\n".join(tables.gained(summaries))
    for row in summaries:
        assert f"{row['peak_joint_error_deg']:.2f} deg" in text
        assert f"{row['settling_time_s']:.2f} s after" in text
    ratio = composite["peak_joint_error_deg"] / designed["peak_joint_error_deg"]
    assert f"{float(f'{ratio:.2g}'):g} times less joint error" in text
    never = [slow | {"settling_time_s": None}, composite, designed]
    assert "does not come to rest within 1 mm" in "\n".join(tables.gained(never))
    assert "rests far sooner" in tables.compared(never)[1]
    rows = tables.heavier_table(never)[-3:]
    assert rows[0].split()[-2] == "never"
    assert f"{designed['residual_tip_rms_ft']:.2e}" in rows[2]


def test_the_readme_has_these_numbers(summaries):
    readme = (Path(__file__).resolve().parents[3] / "README.md").read_text(encoding="utf-8")
    rows = [line for line in readme.splitlines() if line.startswith("| ")]
    for start, key, factor in (
        ("| peak joint error", "peak_joint_error_deg", 1.0),
        ("| vibration of the tip", "residual_tip_rms_ft", 1e3 * FOOT),
        ("| tip within 1 mm", "settling_time_s", 1.0),
    ):
        cells = next(row for row in rows if row.startswith(start)).split("|")[2:5]
        for cell, row in zip(cells, summaries, strict=True):
            assert float(cell.split()[0].rstrip("°")) == pytest.approx(factor * row[key], rel=0.03)


def test_the_figure_has_all_three_controls_in_four_panels(runs, tmp_path, monkeypatch):
    held, close = [], plt.close
    monkeypatch.setattr(plt, "close", lambda figure: held.append(figure) or close(figure))
    arm = arm_file.load("R")
    records = {control: record for control, (record, _) in runs.items()}
    plant = build(scaled(arm, heavier.PAYLOAD))
    made = figures.draw_heavier(tmp_path, records, build(arm), plant)
    assert made == tmp_path / "overview.png" and (tmp_path / "overview.svg").is_file()
    (figure,) = held
    for axes in figure.axes:
        curves = [line for line in axes.get_lines() if line.get_label() in heavier.NAMES.values()]
        assert [line.get_label() for line in curves] == list(heavier.NAMES.values())
    errors, _, _, distances = figure.axes
    for axes, key, factor in ((errors, "peak_joint_error_rad", 180.0 / np.pi), (distances, "", 0)):
        for line, (_, metrics) in zip(axes.get_lines(), runs.values(), strict=False):
            wanted = factor * metrics[key][0] if key else metrics["peak_tip_error_mm"]
            assert np.abs(line.get_ydata()).max() == pytest.approx(wanted, rel=1e-3)
