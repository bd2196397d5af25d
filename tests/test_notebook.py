# SPDX-License-Identifier: Apache-2.0
"""The notebook's cells run one after the other, and its figure shows what its text says."""

import json
from pathlib import Path

import matplotlib
import numpy as np
import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "examples" / "arm_to_figure.ipynb"


@pytest.mark.long
@pytest.mark.slow
def test_the_notebook_goes_from_an_arm_file_to_a_figure(tmp_path, monkeypatch):
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names = {}
    for cell in cells:
        assert not cell.get("outputs")  # outputs are made by who runs it
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), NOTEBOOK.name, "exec"), names)
    assert Path("strip.png").stat().st_size > 5000
    assert names["bears"].payload[0] < 0.7 and names["bears"].payload[1] > 1.3
    assert set(names["runs"]) == {1.0, 0.7, 1.3}
    for record in names["runs"].values():
        # The joint has come to rest where it should, with each payload.
        assert np.degrees(np.abs(record.reference - record.position))[-1].max() < 0.1
