# SPDX-License-Identifier: Apache-2.0
"""Ridge regressions on lagged signals: what they explain is found, and what they don't is not."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_studies.identification import left_over, ridge
from flexarm_studies.identification import recording as recordings

PERIOD, BAND = 0.01, (8.0, 21.0)
FITTED, SCORED = slice(100, 1500), slice(1500, 1900)


def test_lagged_columns_are_shifted_and_empty_beyond_the_ends():
    columns = np.arange(1.0, 5.0)[:, None]
    np.testing.assert_array_equal(
        ridge.lagged(columns, -1, 1).T, [[2.0, 3.0, 4.0, 0.0], [1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 2.0, 3.0]]
    )  # fmt: skip


def test_a_ridge_is_least_squares_where_all_is_explained_and_nothing_where_nothing_is():
    random = np.random.default_rng(0)
    X, of = random.standard_normal((400, 3)), np.array([1.0, -2.0, 0.5])
    both = np.column_stack([X @ of, X @ of])
    found, left = ridge.chosen(X, both, np.array([1.0, 3.0]))
    np.testing.assert_allclose(found, of, rtol=1e-3)
    assert left < 1e-6
    found, left = ridge.chosen(X, random.standard_normal((400, 1)), np.ones(1))
    assert left > 0.97 and np.abs(found).max() < 0.2


def recorded():
    """A recording of rest, the motion of a joint, and noise."""
    random = np.random.default_rng(1)
    run = recordings.uniform(
        PERIOD * np.arange(2000), {"position": np.zeros((2000, 1)), "strain": np.zeros((2000, 2))}
    )
    motion = tuple(random.standard_normal((2000, 1)) for _ in range(3))
    return run, motion, random.standard_normal(2000)


def explained(run, motion, error):
    found = {}
    for name, (columns, *lags) in left_over.signals(run, run.strain, motion, 1).items():
        found[name] = left_over.explained(columns, error, PERIOD, FITTED, SCORED, BAND, lags)
    return found


def test_what_follows_a_signal_is_explained_by_it_and_by_no_other():
    run, motion, noise = recorded()
    error = np.roll(motion[2][:, 0], 5) + 0.3 * noise
    current = np.random.default_rng(2).standard_normal((2000, 1))
    found = explained(replace(run, current=current), motion, error)
    blocks, later, size = found["joint accelerations, past"]
    assert blocks > 0.8 and later > 0.8 and size == 61
    for name in ("motor currents, past", "the other gauges"):
        assert max(found[name][:2]) < 0.1, name


def test_the_variance_is_spread_over_the_bands():
    time = PERIOD * np.arange(2000)
    error = sum(
        size * np.sin(2.0 * np.pi * f * time) for size, f in ((1.0, 2.0), (2.0, 12.0), (3.0, 30.0))
    )
    np.testing.assert_allclose(left_over.spread(error, PERIOD, BAND), np.array([1, 4, 9]) / 14)


def test_a_recording_without_currents_has_no_row_for_them():
    run, motion, noise = recorded()
    assert not any("current" in name for name in explained(run, motion, noise))


def test_a_gauge_that_is_not_there_is_refused():
    from flexarm_dynamics.arm import arm_file
    from flexarm_dynamics.errors import FlexarmError

    with pytest.raises(FlexarmError, match="is no gauge of this arm"):
        next(left_over.lines(arm_file.load("one_link"), None, "tip", (0, 1), (1, 2), BAND))
