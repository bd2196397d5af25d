# SPDX-License-Identifier: Apache-2.0
"""docs/random_arms.md: its tables are those of the rows beside it, and the designs beside it give these rows."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.robust.settings import Settings
from flexarm_control.robust.task import Task
from flexarm_control.robust.uncertain import Uncertainty
from flexarm_studies.random_arms import generator, report, study
from flexarm_studies.uncertain.baselines import task_of
from flexarm_studies.uncertain.controllers import DELAY, RATE

DOCS = Path(__file__).resolve().parents[1] / "docs"


def lines(name):
    """The seed of a file of the study, and its rows."""
    first, *rows = map(json.loads, (DOCS / name).read_text().splitlines())
    return first["specification"]["random_arms_seed"], rows


def test_the_tables_are_those_of_the_rows():
    seed, rows = lines("random_arms.jsonl")
    page = (DOCS / "random_arms.md").read_text()
    begin, end = (marker.format(seed) for marker in (report.BEGIN, report.END))
    table = page[page.index(begin) + len(begin) : page.index(end)]
    assert table.strip() == report.text(rows, seed).strip()


def test_every_designed_row_has_its_design():
    (seed, rows), (same, designs) = map(lines, ("random_arms.jsonl", "random_arms_designs.jsonl"))
    assert seed == same
    reached = {design["number"]: design["reached"] for design in designs}
    designed = [row for row in rows if row["controller"] == "designed_preview"]
    assert len(designed) == 600
    for row in designed:
        assert_allclose(row["decay"], reached[row["number"]], rtol=1e-5, err_msg=row["sample"])


# Those with the fastest growth, and those to which the rule applies. It takes part in the design, so a change of it may
# leave a published design behind.
@pytest.mark.slow
@pytest.mark.parametrize("number", [5, 58, 38, pytest.param(55, marks=pytest.mark.long)])
def test_a_published_design_is_marked_if_its_arm_may_hunt(number):
    (design,) = [d for d in lines("random_arms_designs.jsonl")[1] if d["number"] == number]
    case, given = generator.arm(number, 0), design["parameters"]
    start, middle, end = (tuple(q.tolist()) for q in task_of(case).places)
    settings = Settings(rate=RATE, delay=DELAY, configurations=(middle, start, end))
    task = Task(case.read(), settings, Uncertainty())
    n, m = len(task.arm.joints), task.nominal.n_modes
    pid = [np.reshape(given[f"slow.{k}"], (-1, n)) for k in ("stiffness", "damping", "integral")]
    joints = np.concatenate([part[:, None, :] * np.eye(n) for part in pid], axis=2)
    K = np.concatenate([joints, -np.reshape(given["fast.gain"], (-1, n, 2 * m))], axis=2)
    sampling = replace(task.sampling, torque_corner=given["slow.bandwidth"] or np.inf)
    assert task.hunts_apart(SimpleNamespace(K=K, sampling=sampling, decay=1.0)) == design["hunts"]


# One arm of each number of links; arms 26 and 85 were once lost with a heavier payload, arms 18 and 55 hunted while one
# joint stuck and others slid, arm 23 had a mode that rang, and arm 41 has a mode that no torque reaches.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "variants"),
    [
        (0, ["exact", "payload x1.3", "noisy"]),
        (18, ["noisy"]),
        pytest.param(55, ["stiffness x0.9"], marks=pytest.mark.long),
        pytest.param(26, ["payload x1.3"], marks=pytest.mark.long),
        pytest.param(41, ["noisy"], marks=pytest.mark.long),
        pytest.param(68, ["stiffness x0.9"], marks=pytest.mark.long),
        pytest.param(85, ["payload x1.3"], marks=pytest.mark.long),
        pytest.param(23, ["payload x1.3"], marks=pytest.mark.long),
    ],
)
def test_a_published_design_does_what_its_row_says(number, variants):
    seed, rows = lines("random_arms.jsonl")
    published = {row["sample"]: row for row in rows}
    (design,) = [d for d in lines("random_arms_designs.jsonl")[1] if d["number"] == number]
    for found in study.job(seed, number, "designed_preview", variants, design):
        row = published[found["sample"]]
        for name in ("lost", "refused", "settled", "at_rest"):
            assert found.get(name) == row.get(name), (name, found)
        # Rounding differs by processor, and friction makes more of it.
        peak = row["peak_joint_error_deg"]
        assert_allclose(found["peak_joint_error_deg"], peak, rtol=0.05, atol=0.01)
        assert_allclose(found["settling_periods"], row["settling_periods"], atol=0.3)
        assert_allclose(found["rest_joint_deg"], row["rest_joint_deg"], atol=0.01)


@pytest.mark.slow
@pytest.mark.long
def test_an_arm_that_hunted_while_one_joint_stuck_gets_a_design_with_which_it_does_not(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("FLEXARM_CACHE", str(tmp_path))
    (noisy,) = study.job(0, 18, "designed_preview", ["noisy"], *study.design_job(0, 18))
    assert noisy["settled"] and noisy["residual_tip"] < 3.0 * noisy["noise_tip"]
