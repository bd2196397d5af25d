# SPDX-License-Identifier: Apache-2.0
"""docs/jtc.md: each row of what joint_trajectory_controller does, and what flexarm does, names a test that there is."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in (ROOT / "docs" / "jtc.md").read_text().splitlines()
    if line.startswith("| ") and not line.startswith("| JTC |")
]


def test_there_are_rows_about_trajectories_goals_and_the_rest():
    assert len(ROWS) > 25


@pytest.mark.parametrize("row", ROWS, ids=[row[0][:60] for row in ROWS])
def test_a_row_names_a_test_that_there_is(row):
    assert len(row) == 3 and all(row)
    path, _, name = re.fullmatch(r"`([^`]+)` ?", row[2])[1].partition("::")
    text = (ROOT / path).read_text()
    assert not name or f"def {name}(" in text
