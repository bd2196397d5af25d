# SPDX-License-Identifier: Apache-2.0
"""A real arm's recording, where it is there: the observer without torque beside predictions that need no model.

The recording is of TUDOR
(J. Malzahn, R. F. Reinhart, T. Bertram: Dynamics identification of a damped multi elastic link robot arm under gravity,
ICRA 2014).
"""

import json
from pathlib import Path

import numpy as np
import pytest

from flexarm_studies.identification import left_over, one_step

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "real_arm.md").read_text(encoding="utf-8")
#: The arm file of the observer, and its noise levels.
ONE_STEP = Path(__file__).resolve().parents[1] / "examples" / "one_step"


def test_a_step_ahead_the_filter_is_better_than_persistence_and_than_regressions(real_arm, capsys):
    """The table of docs/real_arm.md, by its command: rms of 10 ms ahead, 60 to 80 s [microstrain]."""
    one_step.main([
        str(real_arm / "exp1.csv"), str(ONE_STEP / "rough.yaml"), "--mapping", "tudor", "--observer",
        str(ONE_STEP / "observer.yaml"), "--fit", "14:60", "--score", "60:80",
    ])  # fmt: skip
    printed = capsys.readouterr().out
    rows = [line.strip("| ").split(" | ") for line in printed.splitlines()[2:]]
    table = {name: np.array(cells, float) for name, *cells in rows}
    with_memory = table["motion_kalman, innovations of order 16"]
    assert (with_memory < 0.6 * table["persistence"]).all()
    assert (with_memory < 0.98 * table["autoregression of order 8"]).all()
    assert (with_memory < 1.01 * table["autoregression of order 16"]).all()
    assert (with_memory < 0.92 * table["motion_kalman"]).all()
    for line in printed.splitlines():
        assert line in PAGE


#: Variance accounted for from 60 to 80 s, in all and above 1 Hz [%], of the model, and with what the gauges pick up.
EXPLAINED, ABOVE = (99.4, 99.2, 90.7, 44.0), (90.0, 90.0, 50.0, 9.0)
WITH_PICKUP = (99.4, 99.2, 92.0, 55.0)


@pytest.mark.slow
def test_the_shipped_arm_explains_the_part_that_was_not_fitted(real_arm, flexarm):
    """The command of docs/real_arm.md that checks the shipped file."""
    code, printed, err = flexarm(
        "identify", real_arm / "exp1.csv", "tudor", "--mapping", "tudor", "--fit", "14:60", "--score", "60:80",
        "--hold", "joints*", "links*", "payload*", "gauges*gain", "* offset", "--starts", 1,
        "--pickup", 8, "--json",
    )  # fmt: skip
    assert code == 0, err
    result = json.loads(printed)
    rows = result["parts"]["score"].values()
    for row, least in zip(rows, WITH_PICKUP, strict=True):
        assert row["with pickup"]["vaf"] > least
    for row, least, above in zip(rows, EXPLAINED, ABOVE, strict=True):
        assert row["model"]["vaf"] > least and row["model"]["vaf_above"] > above
        for name in ("quasi-static", "rigid", "FIR"):
            assert row["model"]["vaf"] > row[name]["vaf"] + 3.0
            assert row["model"]["vaf_above"] > row[name]["vaf_above"] + 5.0
        assert row["ceiling"]["vaf"] > row["model"]["vaf"]
    rings = [r for r in result["ring_downs"] if r["measured_damping"] < 0.1]
    assert len(rings) > 10
    for ring in rings:
        assert ring["modelled_frequency"] == pytest.approx(ring["measured_frequency"], rel=0.02)
        near = 1.0 / 1.5 < ring["modelled_damping"] / ring["measured_damping"] < 1.5
        assert near or ring["from_s"] == pytest.approx(51.19, abs=0.1)  # two and a half periods
    shoulder, elbow = result["currents"]
    assert shoulder["left_of_scored"] < 0.08 and shoulder["explained"]
    assert not elbow["explained"]


@pytest.mark.slow
def test_the_joints_motion_does_not_tell_the_second_mode(real_arm, capsys):
    """The table of docs/real_arm.md of what is left of eps31, by its command."""
    left_over.main([
        str(real_arm / "exp1.csv"), "tudor", "--mapping", "tudor", "--gauge", "eps31", "--fit", "14:60",
        "--score", "60:80", "--band", "8:21",
    ])  # fmt: skip
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:7]]
    for name, *cells in rows:
        blocks, later = (float(cell) for cell in cells[1:])
        if "motion" in name or "accelerations" in name:
            assert blocks < 3.0 and later < 6.0, name
    assert float(rows[-1][2]) > 60.0 and float(rows[-1][3]) > 60.0


#: Begin of the ring-downs after fast motions [s].
RING_DOWNS = (17.6, 28.5, 54.3, 60.3, 76.5)


def test_what_rings_is_found_window_by_window(real_arm, flexarm):
    """3.0 to 3.3 Hz, 0.6 to 3 % of damping within the intervals; docs/resonance.md has the table."""
    code, printed, err = flexarm("resonance", real_arm / "exp1.csv", "--mapping", "tudor", "--json")
    assert code == 0, err
    found = {window["from_s"]: window["modes"][0] for window in json.loads(printed)["windows"]}
    for begin in RING_DOWNS:
        mode = found[min(found, key=lambda at: abs(at - begin))]
        assert min(abs(at - begin) for at in found) < 0.1
        assert 3.0 < mode["frequency_hz"] < 3.3 and mode["frequency_half_width_hz"] < 0.02
        width = mode["damping_half_width"]
        assert 0.006 - width < mode["damping"] < 0.03 and width < 0.006


RESONANCE = Path(__file__).resolve().parents[1] / "docs" / "resonance.md"


def lowest_modes():
    """The rows of the table of docs/resonance.md that lie between 3.0 and 3.3 Hz: (window, frequency, damping [%])."""
    rows = []
    for line in RESONANCE.read_text(encoding="utf-8").splitlines():
        cells = line.strip("| ").split(" | ")
        if len(cells) == 5 and cells[0].endswith(" s"):
            frequency, damping = (float(cell.split(" ± ")[0]) for cell in cells[2:4])
            rows.append((cells[0].removesuffix(" s").replace(" to ", ":"), frequency, damping))
    return [row for row in rows if 3.0 < row[1] < 3.3]


def test_its_ring_downs_have_the_frequency_and_damping_of_the_page_window_by_window(
    real_arm, flexarm
):
    rows = lowest_modes()
    assert len(rows) == 10
    listed = [row for row in rows if int(row[0].split(".")[0]) in (17, 28, 54, 60, 76)]
    windows = [word for row in listed for word in ("--window", row[0])]
    code, printed, err = flexarm(
        "resonance", real_arm / "exp1.csv", "--mapping", "tudor", *windows, "--json"
    )
    assert code == 0, err
    for window, (_, frequency, damping) in zip(json.loads(printed)["windows"], listed, strict=True):
        mode = min(window["modes"], key=lambda m: abs(m["frequency_hz"] - 3.1))
        assert 3.0 < mode["frequency_hz"] < 3.3
        assert 0.005 < mode["damping"] < 0.03
        # A window whose ends were rounded has a sample more or less.
        assert mode["frequency_hz"] == pytest.approx(frequency, abs=0.01)
        assert mode["damping"] == pytest.approx(damping / 100.0, abs=0.002)
