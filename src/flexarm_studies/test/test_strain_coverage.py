# SPDX-License-Identifier: Apache-2.0
"""Arms drawn at random, with play, friction, noise that gauges share, and drift: found within their intervals."""

import numpy as np
import pytest

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification import strain_coverage, strain_fit

pytestmark = pytest.mark.long


def test_what_is_drawn_is_noisy_as_it_says():
    run, truth = strain_coverage.drawn([3, 1])
    quiet = run.strain[:55]  # before the first move
    quiet = quiet - quiet.mean(axis=0)
    assert np.corrcoef(quiet.T)[0, 1] > 0.7
    assert quiet.std() == pytest.approx(
        np.hypot(strain_coverage.COMMON, strain_coverage.OWN), rel=0.5
    )
    assert 0.8 * 0.012 <= truth["joints[0].transmission.play"] <= 1.2 * 0.012
    other, different = strain_coverage.drawn([3, 2])
    assert truth != different and not np.allclose(run.strain, other.strain)


@pytest.mark.slow
def test_intervals_cover_and_play_is_found_within_a_tenth(tmp_path, monkeypatch):
    """One arm, from one start; docs/identification.md has a hundred."""
    monkeypatch.setattr(strain_coverage, "STARTS", 1)
    # The start has two of the moves, the rest of the fit all.
    monkeypatch.setattr(strain_fit, "START_SECONDS", 4.5)
    path = tmp_path / "arms.jsonl"
    made = strain_coverage.table(strain_coverage.run(1, seed=5, count=1, path=path))
    play = made["joints[0].transmission.play"]
    assert play["arms"] == 1 and max(play["errors"]) < 0.02
    assert sum(row["covered"] for row in made.values()) > 0.75 * len(made)
    assert np.mean([row["squares"] for row in made.values()]) < 3.0
    assert len(path.read_text().splitlines()) == 1


def test_arms_that_are_done_are_kept(tmp_path, monkeypatch):
    calls = []

    def one(seed):
        calls.append(seed)
        return [["play", 1.0, 1.0 + 0.1 * seed[1], 0.25]]

    monkeypatch.setattr(strain_coverage, "one", one)
    path = tmp_path / "arms.jsonl"
    strain_coverage.run(2, seed=3, count=1, path=path)
    rows = strain_coverage.run(4, seed=3, count=1, path=path)
    assert calls == [[3, 0], [3, 1], [3, 2], [3, 3]]
    (row,) = strain_coverage.table(rows).values()
    assert row["arms"] == 4 and row["covered"] == 3
    np.testing.assert_allclose(
        row["squares"], (1.96 * np.array([0.0, 0.1, 0.2, 0.3]) / 0.25) ** 2, rtol=1e-4
    )
    assert "| `play` | 3 of 4 |" in "\n".join(strain_coverage.text(strain_coverage.table(rows)))
    path.write_text("no JSON")
    with pytest.raises(FlexarmError, match="is no file of this study"):
        strain_coverage.run(1, path=path)
