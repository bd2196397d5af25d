# SPDX-License-Identifier: Apache-2.0
"""Arms drawn at random, with play, friction, noise that gauges share, and drift: found within their intervals."""

import numpy as np
import pytest

from flexarm_studies.identification import strain_coverage


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
def test_play_is_found_within_a_tenth():
    table = strain_coverage.run(1, seed=5, count=1)
    play = table["joints[0].transmission.play"]
    assert play["arms"] == 1 and max(play["errors"]) < 0.1
    # Intervals of 95 % are too narrow on some arms (docs/identification.md): no more is promised of them here.
    assert all(row["covered"] <= row["arms"] == 1 for row in table.values())
    assert "joints[0].transmission.play" in "\n".join(strain_coverage.text(table))
