# SPDX-License-Identifier: Apache-2.0
"""What bridges pick up from the motors: found where it is, not where it is not, and not what a model lacks."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification import pickup
from flexarm_studies.identification import recording as recordings

RATE, ABOVE, FITTED = 100.0, 8.0, slice(0, 1000)
#: Strain per ampere of the current now and in the samples before.
TAPS = 1e-6 * np.array([1.5, -0.8, 0.5])


def recorded(seed=0):
    """Currents of two joints, of which the first one is picked up, and the noise of three gauges."""
    random = np.random.default_rng(seed)
    time = np.arange(1500) / RATE
    current = random.standard_normal((time.size, 2)) + np.sin(2.0 * np.pi * 0.4 * time)[:, None]
    run = recordings.uniform(
        time, {"position": np.zeros((time.size, 2)), "strain": np.zeros((time.size, 3))}
    )
    return replace(run, current=current), 1e-6 * random.standard_normal((time.size, 3))


def test_a_filter_that_all_gauges_share_is_found_and_holds_where_it_was_not_fitted():
    run, error = recorded()
    picked = np.convolve(run.current[:, 0], TAPS)[: len(error)]
    found = pickup.fit(run, error + picked[:, None], FITTED, ABOVE)
    assert found.useful and found.left < 0.6
    later = slice(1000, 1450)
    fast = pickup.high_passed(picked[:, None], run.period, ABOVE)[later, 0]
    assert np.var(fast - found.strain(run)[later]) < 0.05 * np.var(fast)
    assert found.joints == (0, 1) and found.taps.shape == (21, 2)


def test_what_does_not_follow_the_current_is_of_no_use():
    run, error = recorded()
    found = pickup.fit(run, error, FITTED, ABOVE)
    assert not found.useful
    assert np.std(found.strain(run)) < 0.1 * np.std(error)


def test_slow_errors_of_the_model_are_left_alone():
    run, error = recorded()
    slow = 5e-5 * np.sin(2.0 * np.pi * 0.4 * run.time)[:, None]
    found = pickup.fit(run, error + slow, FITTED, ABOVE)
    assert not found.useful


def test_what_each_gauge_reads_with_another_sign_is_no_pickup():
    run, error = recorded()
    vibration = np.outer(np.convolve(run.current[:, 0], TAPS)[: len(error)], [1.0, -1.0, 0.0])
    assert not pickup.fit(run, error + vibration, FITTED, ABOVE).useful


def test_a_joint_without_current_and_missing_strains_are_left_out():
    run, error = recorded()
    picked = np.convolve(run.current[:, 0], TAPS)[: len(error)]
    run.current[:, 1] = np.nan
    error[100:120, 1] = np.nan
    found = pickup.fit(run, error + picked[:, None], FITTED, ABOVE)
    assert found.joints == (0,) and found.useful


def test_what_cannot_be_fitted_is_refused():
    run, error = recorded()
    with pytest.raises(FlexarmError, match="has no motor current"):
        pickup.fit(replace(run, current=None), error, FITTED, ABOVE)
    with pytest.raises(FlexarmError, match="half of the rate"):
        pickup.fit(run, error, FITTED, 50.0)
