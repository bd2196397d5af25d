# SPDX-License-Identifier: Apache-2.0
"""docs/random_arms.md: its tables are those of the rows that lie beside it."""

import json
from pathlib import Path

from flexarm_studies.random_arms import report

DOCS = Path(__file__).resolve().parents[1] / "docs"


def test_the_tables_are_those_of_the_rows():
    first, *rows = map(json.loads, (DOCS / "random_arms.jsonl").read_text().splitlines())
    seed = first["specification"]["random_arms_seed"]
    page = (DOCS / "random_arms.md").read_text()
    begin, end = (marker.format(seed) for marker in (report.BEGIN, report.END))
    table = page[page.index(begin) + len(begin) : page.index(end)]
    assert table.strip() == report.text(rows, seed).strip()
