# SPDX-License-Identifier: Apache-2.0
"""Metrics of a record: by hand, in the reference table's units."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_control.composite.design import design
from flexarm_dynamics.arm.units import FOOT, POUND_FORCE, POUND_FORCE_FOOT
from flexarm_studies.loop.metrics import Record, case_study_metrics, linear_metrics


def test_joint_errors_are_in_degrees_over_the_windows(arm_r, make_record):
    # error: 3 deg before the start, up to 2 deg during the motion, -0.5 deg from 3 s on
    error = lambda t: 3.0 if t < 0 else (2.0 * t if t <= 1.0 else -0.5)  # noqa: E731
    record = make_record(
        arm_r, reference=lambda t: 1.0, position=lambda t: 1.0 - np.radians(error(round(t, 9)))
    )
    found = case_study_metrics(record, arm_r, settle=3.0, until=4.0)
    assert_allclose(found["peak_joint_error_deg"], 2.0, rtol=1e-12)
    assert_allclose(found["max_joint_error_after_3s_deg"], 0.5, rtol=1e-12)


def test_both_ends_of_the_window_belong_to_it(arm_r, make_record):
    for edge, peak in ((0.0, 1.0), (-0.01, 0.0), (4.0, 1.0), (3.99, 1.0)):
        record = make_record(
            arm_r, position=lambda t, e=edge: np.radians(1.0) * (abs(t - e) < 1e-6)
        )
        found = case_study_metrics(record, arm_r, until=4.0)
        assert_allclose(found["peak_joint_error_deg"], peak, rtol=1e-12, atol=1e-15)
    record = make_record(arm_r, position=lambda t: np.radians(1.0) * (abs(t - 4.0) < 1e-6))
    assert case_study_metrics(record, arm_r, until=3.98)["peak_joint_error_deg"] == 0.0
    record = make_record(arm_r, position=lambda t: np.radians(1.0) * (abs(t - 3.0) < 1e-6))
    assert case_study_metrics(record, arm_r)["max_joint_error_after_3s_deg"] > 0.9


def test_tip_deflections_are_in_feet_with_the_tip_shapes(arm_r, make_record):
    # phi_e = (2, -2): y = 2 (0.03 - 0.01) ft until 3 s, then a sine of 0.02 ft
    def amplitude(t):
        return FOOT * np.array([0.03, 0.01] if t < 2.999 else [0.01 * np.sin(2 * np.pi * t), 0.0])

    found = case_study_metrics(make_record(arm_r, amplitude=amplitude), arm_r, until=4.0)
    assert_allclose(found["peak_tip_deflection_ft"], 0.04, rtol=1e-9)
    # one period of a sine, its first zero twice: 101 samples instead of 100
    rms = 0.02 / np.sqrt(2.0) * np.sqrt(100.0 / 101.0)
    assert_allclose(found["residual_tip_rms_ft"], rms, rtol=1e-9)


def test_peak_torques_are_magnitudes_in_pound_feet(arm_r, make_record):
    record = make_record(
        arm_r,
        slow_torque=lambda t: -2.0 * POUND_FORCE_FOOT * (0 < t < 1),
        fast_torque=lambda t: 1.5 * POUND_FORCE_FOOT * (2 < t < 3),
        torque=lambda t: -3.0 * POUND_FORCE_FOOT * (1 < t < 2) + 99.0 * (t < -0.005),
    )
    found = case_study_metrics(record, arm_r)["peak_torque_lbf_ft"]
    for name, wanted in (("slow", 2.0), ("fast", 1.5), ("total", 3.0)):
        assert_allclose(found[name], wanted, rtol=1e-12)


def test_metrics_are_plain_finite_numbers_even_before_the_observer_has_converged(
    arm_r, make_record
):
    record = make_record(arm_r, rate=lambda t: [np.nan, np.nan] if t < 0.5 else [0.0, 0.0])
    json.dumps(case_study_metrics(record, arm_r, until=4.0), allow_nan=False)


def test_the_end_point_is_a9_and_a10(arm_r, make_record):
    q, qd, y, yd = 0.3, 1.5, 0.02, -0.4
    record = make_record(
        arm_r,
        position=lambda t: q,
        velocity=lambda t: qd,
        reference=lambda t: 0.5,
        reference_velocity=lambda t: 1.2,
        amplitude=lambda t: [y / 2.0, 0.0],
        rate=lambda t: [0.0, -yd / 2.0],
    )
    length = 4.0 * FOOT
    actual, rigid = record.tip_x(arm_r)
    assert_allclose(actual, length * np.cos(q) - y * np.sin(q), rtol=1e-9)
    assert_allclose(rigid, length * np.cos(0.5), rtol=1e-12)
    actual, rigid = record.tip_x_rate(arm_r)
    wanted = (-length * np.sin(q) - y * np.cos(q)) * qd - yd * np.sin(q)
    assert_allclose(actual, wanted, rtol=1e-9)
    assert_allclose(rigid, -length * np.sin(0.5) * 1.2, rtol=1e-12)


def test_the_rate_of_the_end_point_is_the_derivative_of_the_end_point(arm_r, make_record):
    record = make_record(
        arm_r,
        position=lambda t: np.sin(t),
        velocity=lambda t: np.cos(t),
        amplitude=lambda t: [0.01 * np.sin(3 * t), 0.002 * np.cos(2 * t)],
        rate=lambda t: [0.03 * np.cos(3 * t), -0.004 * np.sin(2 * t)],
    )
    slope = np.gradient(record.tip_x(arm_r)[0], record.time, edge_order=2)
    assert_allclose(slope[1:-1], record.tip_x_rate(arm_r)[0][1:-1], atol=2e-4)


def test_a_thinned_record_keeps_every_nth_row(arm_r, make_record):
    record = make_record(arm_r, position=lambda t: t)
    thin = record.thinned(4)
    for name in Record.__dataclass_fields__:
        assert_array_equal(getattr(thin, name), getattr(record, name)[::4])


@pytest.mark.parametrize("gain", ["m11", "h11"])
def test_linear_metrics_are_in_the_papers_units_with_the_papers_sign(arm_r, gain):
    slow = {"type": "linear_model_following", "gain": gain}
    q = (POUND_FORCE**2 * np.array([1.0, 1.0, 50.0, 30000.0])).tolist()
    law = design(arm_r, slow, {"type": "lqr", "q": q, "configuration": [np.pi / 2]})
    found = linear_metrics(arm_r, law, np.array([np.pi / 2]))
    assert_allclose(found["open_loop_frequencies_rad_s"], [13.885, 87.410], rtol=4e-5)
    assert_allclose(found["k_f"], [-127.04, -7283.8, -16.998, -183.31], rtol=1e-4)
    assert_allclose(found["closed_loop_frequencies_rad_s"], [18.578, 90.402], rtol=3e-5)
    assert_allclose(found["closed_loop_damping"], [0.7755, 0.4052], rtol=1.3e-4)
    slowest = found["full_order_poles"][0]
    assert (slowest == pytest.approx([-1.773, 0.0], abs=6e-4)) is (gain == "m11")
    json.dumps(found, allow_nan=False)


def test_full_order_poles_of_slow_control_alone_are_those_of_the_errata():
    from flexarm_dynamics.arm import arm_file
    from flexarm_dynamics.models import model

    arm = model.build(arm_file.load("P3"))
    law = design(arm, {"type": "linear_model_following"}, {"type": "none"})
    poles = linear_metrics(arm, law, np.zeros(1))["full_order_poles"]
    wanted = [(-2.347, 0), (-2.702, 0), (-0.359, -13.78), (-0.359, 13.78)]
    assert_allclose(poles, [*wanted, (-0.042, -89.79), (-0.042, 89.79)], atol=6e-3)
