# SPDX-License-Identifier: Apache-2.0
"""Errors of predictions a sample ahead: of arms that are simulated, by hand, and the command's refusals."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification import one_step, strain_coverage

FITTED = 800
PARAMETERS = {
    "strain_noise": 3e-7, "common_noise": [1e-6], "position_noise": 1e-6, "jerk_noise": [20.0],
    "bending_force_noise": [1.0], "plausibility": False,
}  # fmt: skip


@pytest.fixture(scope="module")
def moved():
    """A rigid-joint arm file, and the recording of an arm with play."""
    arm = arm_file.parse(strain_coverage.NOMINAL)
    joint = replace(arm.joints[0], transmission=None)
    run, _ = strain_coverage.drawn([1, 1])
    return replace(arm, joints=(joint,)), run.part(1200)


def test_the_table_has_the_errors_of_each_way_to_predict(moved):
    arm, run = moved
    table = one_step.compare(arm, PARAMETERS | {"innovation_order": 4}, run, FITTED, order=3)
    assert list(table) == [
        "persistence", "autoregression of order 3", "autoregression of order 4", "motion_kalman",
        "motion_kalman, innovations of order 4",
    ]  # fmt: skip
    differences = np.diff(run.strain, axis=0)[FITTED - 1 :]
    assert_allclose(table["persistence"], np.sqrt(np.mean(differences**2, axis=0)))
    assert all(np.isfinite(rms).all() for rms in table.values())
    assert (table["motion_kalman, innovations of order 4"] < table["motion_kalman"]).all()
    without = one_step.compare(arm, PARAMETERS, run, FITTED, order=3)
    assert list(without) == ["persistence", "autoregression of order 3", "motion_kalman"]
    assert_allclose(without["motion_kalman"], table["motion_kalman"])


def test_an_autoregression_finds_the_process_that_made_the_readings():
    random = np.random.default_rng(3)
    made = np.zeros((3000, 1))
    for k in range(2, 3000):
        made[k] = 1.6 * made[k - 1] - 0.8 * made[k - 2] + random.standard_normal()
    errors = one_step.regression_errors(made, 2000, 2)
    assert np.isnan(errors[:2]).all()
    assert errors[2000:].std() == pytest.approx(1.0, rel=0.06)


def test_what_was_learnt_is_kept_after_the_fitted_part(moved):
    arm, run = moved
    values = PARAMETERS | {"innovation_order": 2}
    kept, learning = (one_step.filter_errors(arm, values, run, k)[1] for k in (FITTED, 2000))
    assert_allclose(kept[:FITTED], learning[:FITTED])
    assert not np.allclose(kept[FITTED + 2 :], learning[FITTED + 2 :], rtol=1e-9)


def test_the_command_refuses_what_it_can_not_compare(tmp_path):
    file = tmp_path / "observer.yaml"
    file.write_text("/**: {ros__parameters: {observer: {type: kalman}}}", encoding="utf-8")
    with pytest.raises(FlexarmError, match=r"observer.yaml: kalman|is another observer"):
        one_step.observer_parameters(file)
    words = ["x.csv", "tudor", "--observer", str(file), "--fit", "0:5", "--score", "6:9"]
    with pytest.raises(SystemExit, match="does not follow --fit"):
        one_step.main(words)
