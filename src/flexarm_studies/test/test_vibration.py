# SPDX-License-Identifier: Apache-2.0
"""Arms behind a position loop: planners' motions, what is measured, and what is left of the swing."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_dynamics.models import model
from flexarm_sim.plant import Plant
from flexarm_studies.vibration import cases, figure, limit, pushes, report, study
from flexarm_studies.vibration.position_arm import MAX_SUBSTEPS, PositionArm, Swing
from flexarm_studies.vibration.time_laws import jerk_limited, resampled, trapezoid


def test_planners_motions_have_the_shapes_that_they_are_named_for():
    motion = trapezoid([0.0, 1.0], [1.5, 0.0], 3.0)
    assert_allclose(
        motion.velocity(np.array([0.5, 1.0, 1.5])), [[0.375, -0.25], [0.75, -0.5], [0.75, -0.5]]
    )
    assert_allclose(motion.end, [1.5, 0.0])
    smooth = jerk_limited(motion, 0.4)
    t = np.linspace(0.0, 3.4, 341)
    delayed = np.mean([motion.position(t - d) for d in np.linspace(0.0, 0.4, 2001)], axis=0)
    assert_allclose(smooth.position(t), delayed, atol=1e-4)
    jerk = np.diff(smooth.acceleration(t), axis=0) / 0.01
    assert np.abs(jerk[:, 0]).max() == pytest.approx(0.75 / 0.4, rel=1e-6)
    assert_allclose(resampled(motion, 0.1).position(t), motion.position(t), atol=2e-3)


def test_a_shaped_motion_leaves_a_tenth_of_the_swing_with_what_ringing_shows():
    case = cases.payload(1.0)
    arm = PositionArm(model.build(case.known), model.build(case.plant), 2.0 * np.pi / case.period)
    motion = case.motions[0]
    found = study.measured(arm, motion.end, motion.angle, case.period)
    assert found.frequencies[0] == pytest.approx(1.0 / case.period, rel=0.05)
    window = study.WINDOW * case.period
    unshaped = arm.follow(motion, window).residual(window)
    left = arm.follow(study.shaped(motion, "robust", found), window).residual(window)
    off = arm.follow(study.shaped(motion, "robust", found, 0.85), window).residual(window)
    assert left < 0.1 * unshaped
    assert off < 0.2 * unshaped


def test_a_stiff_arm_is_integrated_implicitly_and_moves_alike():
    case = cases.random_arm(
        14
    )  # the drive of its last joint, which is light, needs 3510 explicit steps per ms
    arm = PositionArm(model.build(case.known), model.build(case.plant), 2.0 * np.pi / case.period)
    start, way = case.motions[0].start, case.motions[0].angle
    motion = trapezoid(start, start + 0.02 * way, 0.05)
    implicit = arm.follow(motion, 0.0)
    assert arm.plant.damped_substeps(arm.loop.kd) == arm.plant.substeps
    arm.plant = Plant(arm.plant.model, arm.plant.period)
    assert arm.plant.damped_substeps(arm.loop.kd) > MAX_SUBSTEPS
    assert_allclose(implicit.tip, arm.follow(motion, 0.0).tip, atol=5e-6)


def test_modes_of_both_ends_are_given_once():
    end = study.Measured(np.array([8.7, 13.0]), np.array([0.08, 0.01]))
    start = study.Measured(np.array([6.8, 13.1]), np.array([0.06, 0.02]))
    both = study.together(end, start)
    assert_allclose(both.frequencies, [8.7, 13.0, 6.8])
    assert_allclose(both.dampings, [0.08, 0.01, 0.06])


def test_modes_along_a_motion_keep_their_order_and_one_that_is_missing_is_close_to_another():
    def row(frequencies):
        return study.Measured(np.array(frequencies), 0.01 * np.arange(1.0, 1.0 + len(frequencies)))

    # The loudest comes first; half-way two modes are one.
    frequencies, dampings = study.rows(row([8.3, 7.1]), (row([7.7]), row([8.6, 13.2])))
    assert_allclose(frequencies, [[8.6, 13.2], [7.7, 7.7], [7.1, 8.3]])
    assert_allclose(dampings, [[0.01, 0.02], [0.01, 0.01], [0.02, 0.01]])
    # A mode that rings only half-way counts everywhere.
    frequencies, _ = study.rows(row([0.96]), (row([1.15, 0.94]), row([1.3])))
    assert_allclose(frequencies, [[1.3, 1.3], [0.94, 1.15], [0.96, 0.96]])
    # Twice a frequency is another mode: what is found at the end alone stays as it is.
    frequencies, _ = study.rows(row([2.5, 5.2]), (row([2.3]), row([])))
    assert_allclose(frequencies, [[2.3, 5.2], [2.3, 5.2], [2.5, 5.2]])


def test_the_quickest_motions_on_a_line_are_the_trapezoid_and_one_with_less_jerk():
    motion = trapezoid([0.0, 1.0], [1.5, 1.0], 3.0)
    found = study.quickest(motion, 2.0)
    t = np.linspace(0.0, 3.0, 301)
    assert_allclose(found["toppra"].position(t), motion.position(t), atol=1e-5)
    smooth = found["ruckig, one period"]
    t = np.linspace(0.0, smooth.duration, 4001)
    assert np.abs(np.diff(smooth.acceleration(t)[:, 0])).max() / t[1] <= 0.75 / 2.0 * (1.0 + 1e-6)
    assert 3.0 < smooth.duration < 6.0


@pytest.mark.long
def test_a_motion_along_which_the_frequency_rises_needs_the_modes_of_both_ends_and_is_best_retimed():
    case = cases.random_arm(2)
    arm = PositionArm(model.build(case.known), model.build(case.plant), 2.0 * np.pi / case.period)
    motion, window = case.motions[1], study.WINDOW * case.period
    places = [motion.end, 0.5 * (motion.start + motion.end), motion.start]
    ways = [motion.angle, motion.angle, -motion.angle]
    end, *others = (
        study.measured(arm, p, w, case.period) for p, w in zip(places, ways, strict=True)
    )
    assert end.frequencies[0] > 1.2 * others[-1].frequencies[0]
    both, along = study.together(end, others[-1]), study.rows(end, others)
    made = [motion, *(study.shaped(motion, "robust", f) for f in (end, both))]
    made += [study.retimed(motion, along, off) for off in (1.0, 0.85, 1.15)]
    unshaped, one, two, *new = (arm.follow(m, window).residual(window) for m in made)
    assert two < 0.1 * unshaped < one
    assert max(new) < 0.06 * unshaped


@pytest.mark.long
def test_a_path_that_bends_is_shaped_by_the_modes_of_both_ends():
    case = cases.random_arm(2)
    motion = case.motions[0]
    given = study.bent(motion)
    t = np.linspace(0.0, given.duration, 1000)
    away = given.position(t) - motion.start
    away -= (away @ motion.angle)[:, None] / (motion.angle @ motion.angle) * motion.angle
    assert np.abs(away).max() == pytest.approx(0.25 * np.abs(motion.angle).max(), rel=0.1)
    for order in (1, 2):
        most = np.abs(motion.derivative(order, motion.knots[1:] - 1e-9)).max()
        assert np.abs(given.derivative(order, t)).max() < 1.001 * most
    rows = study.run_bent(replace(case, motions=case.motions[:1]))
    assert [row["method"] for row in rows] == list(study.BENT)
    shaped, *off = (row["residual"] / rows[0]["residual"] for row in rows[1:])
    assert shaped < 0.1
    assert max(off) < 0.2
    assert rows[1]["added"] < 1.2  # periods of the mode at the end; the lowest is lower
    assert study.run_bent(replace(cases.payload(1.0), motions=cases.payload(1.0).motions[:1])) == []


def test_the_table_counts_what_is_within_what_is_wanted():
    common = {"arm": "x", "frequencies": [2.0], "added": 1.0}
    rows = [
        {**common, "motion": m, "method": method, "residual": r}
        for m, found in enumerate([(1.0, 0.05), (1.0, 0.3)])
        for method, r in zip(("trapezoid", "retimed"), found, strict=True)
    ]
    (line,) = report.summary(rows)
    assert line[0] == "retimed"
    assert line[3:7] == (pytest.approx(0.3), 0.1, "1 of 2", "0 of 2")
    lines = ["- retimed: 0.30 of unshaped; x, motion 1; measured 2.00 Hz"]
    assert report.missed_lines(rows) == lines
    ((row, ratio),) = report.missed(rows, ("retimed",))
    assert row["motion"] == 1 and ratio == pytest.approx(0.3)
    assert (
        report.time_table([(row, [0.3, 0.1, 0.05, 0.01])])[2]
        == "| x, motion 1 | 0.3 | 0.1 | 0.05 | 0.01 |"
    )
    (line,) = report.places_table([(row, [0.3, 0.1, 0.05])])[2:]
    assert line == "| x, motion 1 | retimed | 0.1 | 0.3 | 0.1 | 0.05 |"
    (line,) = report.trials_table([(row, [0.3, 0.1, 0.05, 0.01, 0.01, 0.01])])[2:]
    assert line.startswith("| x, motion 1 | retimed | 0.1 | 0.3 | 0.1 | 0.05 |")


@pytest.mark.long
def test_the_least_that_a_time_law_leaves_is_far_below_what_modes_tell():
    case = cases.all_of(0)["payload x1"]()
    unshaped, left, least = study.at_least(case, 1)
    assert least < 0.5 * left < 0.05 * unshaped
    (line,) = report.limit_table([({"arm": "x", "motion": 1}, (0.04, 0.008, 0.0002))])[2:]
    assert line == "| x, motion 1 | 40 | 8 | 0.2 | 0.2 | 0.005 |"


def test_the_directions_of_the_norm_miss_little_of_it():
    vector = np.abs(np.random.default_rng(1).normal(size=(200, 3)))
    found = (vector @ limit.directions().T).max(axis=1) / np.linalg.norm(vector, axis=1)
    assert 0.985 < found.min() <= found.max() <= 1.0 + 1e-12


@pytest.mark.slow
def test_in_more_time_less_is_left():
    case = cases.all_of(0)["payload x1"]()
    one, three = study.in_more_time(case, 0, (0.3, 1.0))
    assert three < 0.02 < one


@pytest.mark.long
def test_by_modes_at_more_places_less_is_left_where_they_come_close():
    few, many = study.at_more_places(cases.random_arm(7), 2, (3, 5))
    assert many < 0.08 < 0.1 < few


@pytest.mark.long
def test_corrections_in_trials_take_out_what_the_measured_modes_have_missed():
    case = cases.random_arm(7)  # two modes of it come close half-way
    before, *_, after = study.in_trials(case, 0, 3)
    assert after < 0.06 < 0.1 < before  # 0.049 or 0.051, as the processor rounds


@pytest.mark.long
def test_a_push_decays_five_times_faster_with_damping_by_strain():
    found = pushes.decay(1.0)
    assert found.frequency == pytest.approx(3.78, rel=0.02)
    assert found.without > 5.0 * max(found.damped, found.low, found.high, found.noisy)
    assert found.largest < 0.01
    assert found.motion < 0.5
    assert found.without > 5.0 * found.imu
    assert found.imu_motion < 0.5


def test_the_table_of_pushes_has_times_and_factors():
    found = pushes.Decay(
        1.0, 3.0, 0.01, np.pi / 2.0, 6.0, 1.0, 1.2, 1.5, 2.0, 3.0, 0.004, 0.25, 1.5, 0.3
    )
    row = dict(zip(pushes.COLUMNS, found.row(), strict=True))
    assert row["faster"] == 6.0
    assert (row["-15 %"], row["+15 %"], row["made for payload 1"]) == (5.0, 4.0, 3.0)
    assert row["noise 1e-5"] == 2.0
    assert row["phase, degrees"] == pytest.approx(90.0)
    assert row["largest correction, mrad"] == pytest.approx(4.0)
    assert (row["IMU: faster"], row["IMU: after a motion"]) == (4.0, 0.3)


def test_the_figures_zero_is_where_the_tip_comes_to_rest_not_where_it_is_last():
    """A tip that comes along -x and still swings by 10 mm when the record ends."""
    time = np.arange(0.0, 6.0, 0.008)
    after = np.clip(time - 1.0, 0.0, None)
    x = np.where(time < 1.0, 1.0 - time, -0.01 * np.sin(2.0 * np.pi * after / 0.8))
    along = figure.way(Swing(time, 0.3 + np.outer(x, [1.0, 0.0, 0.0]), 1.0, False), 0.8)
    assert along[0] == pytest.approx(-1.0, abs=1e-3)
    assert along == pytest.approx(-x, abs=1e-3)
