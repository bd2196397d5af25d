# SPDX-License-Identifier: Apache-2.0
"""Profiles: closed forms against hand-computed values, their integrals and each other."""

import numpy as np
import pytest
from scipy.integrate import quad_vec

from flexarm_control.motions.profiles import (
    MAX_SMOOTHNESS,
    paper_profile,
    quintic,
    rows,
    sample,
    smooth,
)
from flexarm_control.trajectory import ReferenceGenerator, validate
from flexarm_dynamics.errors import NOT_GIVEN, TrajectoryError

S = 10**9  # [ns]
NAN, INF = float("nan"), float("inf")
PROFILES = [
    paper_profile(),
    paper_profile(3.0, [0.5, -1.0], [0.1, 0.2]),
    quintic(0.2, -1.3, 0.7),
    quintic([0.0, 1.0], [2.0, 1.0], 5.0),
    smooth([0.3, 1.0], [2.0, 1.0], 1.7, 3),
    smooth(0.0, -1.0, 0.4, 7),
]


def test_the_paper_profile_is_45_degrees_per_second_and_ends_at_90_degrees():
    profile = paper_profile()
    t = np.linspace(0.0, 2.0, 101)
    expected = np.radians(45.0 * (1.0 + np.sin(2.0 * np.pi * t / 2.0 - np.pi / 2.0)))
    np.testing.assert_allclose(profile.velocity(t)[:, 0], expected, atol=1e-15)
    # by hand: at T / 2 the half of the way, twice the mean speed, no acceleration; at T / 4
    # 90 (1/4 - 1 / (2 pi)) deg, 45 deg/s, 45 pi deg/s^2
    np.testing.assert_allclose(np.degrees(profile.position(1.0)), [45.0], rtol=1e-14)
    np.testing.assert_allclose(np.degrees(profile.velocity(1.0)), [90.0], rtol=1e-14)
    np.testing.assert_allclose(profile.acceleration(1.0), [0.0], atol=1e-15)
    quarter = 90.0 * (0.25 - 0.5 / np.pi)
    np.testing.assert_allclose(np.degrees(profile.position(0.5)), [quarter], rtol=1e-14)
    np.testing.assert_allclose(np.degrees(profile.velocity(0.5)), [45.0], rtol=1e-14)
    np.testing.assert_allclose(np.degrees(profile.acceleration(0.5)), [45.0 * np.pi], rtol=1e-14)
    np.testing.assert_allclose(np.degrees(profile.position(2.0)), [90.0], rtol=1e-14)


def test_the_quintic_has_its_hand_computed_middle():
    profile = quintic([0.0, 1.0], [1.0, -1.0], 2.0)
    np.testing.assert_allclose(profile.position(1.0), [0.5, 0.0], atol=1e-15)
    np.testing.assert_allclose(profile.velocity(1.0), [15 / 16, -15 / 8], rtol=1e-14)
    np.testing.assert_allclose(profile.position(0.5), [53 / 512, 1 - 53 / 256], rtol=1e-14)
    np.testing.assert_allclose(profile.acceleration(0.5), [45 / 32, -45 / 16], rtol=1e-14)


def test_smooth_motions_are_the_polynomials_that_are_written_out_elsewhere():
    s = np.linspace(0.0, 1.0, 23)
    quintics = smooth(0.2, -1.3, 0.7, 2), quintic(0.2, -1.3, 0.7)
    for name in ("position", "velocity", "acceleration"):
        a, b = (getattr(motion, name)(0.7 * s) for motion in quintics)
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)
    # Biagiotti & Melchiorri (2008), (2.20): the septic from rest to rest.
    septic = np.polynomial.Polynomial([0, 0, 0, 0, 35, -84, 70, -20])
    motion = smooth(0.0, 1.0, 1.0, 3)
    np.testing.assert_allclose(motion.position(s)[:, 0], septic(s), atol=1e-13)
    np.testing.assert_allclose(motion.velocity(s)[:, 0], septic.deriv()(s), atol=1e-12)
    np.testing.assert_allclose(motion.acceleration(s)[:, 0], septic.deriv(2)(s), atol=1e-12)


@pytest.mark.parametrize("k", [2, 3, 5, MAX_SMOOTHNESS])
def test_smoothness_is_how_many_derivatives_vanish_at_the_ends(k):
    """theta leaves its ends as s^(k+1) / ((k+1) B): derivative k vanishes there and k + 1 does not."""
    motion, small = smooth(0.0, 1.0, 1.0, k), 1e-3
    leading = small ** (k + 1) * np.exp(
        sum(np.log((k + 1 + i) / i) for i in range(1, k + 1))
    )  # 1 / ((k+1) B(k+1, k+1)) = (2k+1)! / (k! (k+1)!)
    assert motion.position(small)[0] == pytest.approx(leading, rel=0.05)
    assert 1.0 - motion.position(1.0 - 0.2)[0] == pytest.approx(motion.position(0.2)[0], rel=1e-9)


@pytest.mark.parametrize("profile", PROFILES)
def test_velocity_and_acceleration_integrate_to_position_and_velocity(profile):
    for t in np.linspace(0.1, 1.0, 4) * profile.duration:
        way = quad_vec(profile.velocity, 0.0, t, epsabs=1e-12)[0]
        gain = quad_vec(profile.acceleration, 0.0, t, epsabs=1e-12)[0]
        np.testing.assert_allclose(profile.position(t) - profile.start, way, rtol=0, atol=1e-12)
        np.testing.assert_allclose(profile.velocity(t), gain, rtol=0, atol=1e-12)


@pytest.mark.parametrize("profile", PROFILES)
def test_profiles_rest_at_and_beyond_both_ends(profile):
    end = profile.start + profile.angle
    T = profile.duration
    for t, position in zip((-1.0, 0.0, T, T + 1.0), [profile.start] * 2 + [end] * 2, strict=True):
        np.testing.assert_allclose(profile.position(t), position, rtol=1e-15)
        np.testing.assert_allclose(profile.velocity(t), 0.0, atol=1e-15)
        np.testing.assert_allclose(profile.acceleration(t), 0.0, atol=1e-14)


def test_shapes_follow_the_times_and_the_joints():
    profile = paper_profile(angle=[1.0, 2.0, 3.0])
    assert profile.position(0.5).shape == (3,)
    assert profile.position(np.zeros(4)).shape == (4, 3)
    points = sample(profile, 5)
    np.testing.assert_array_equal(points.times, [0.0, 0.5, 1.0, 1.5, 2.0])
    for values in points[1:]:
        assert values.shape == (5, 3)


@pytest.mark.parametrize(
    ("profile", "n_points", "tolerance"),
    # A quintic is its own interpolation. Of another motion the quintic Hermite's error is at
    # most max|theta^(6)| h^6 / 46080 (h the time between points): for the paper's profile with
    # 21 points (pi / 2) (2 pi)^5 (1 / 20)^6 / 46080 = 5.3e-9 rad.
    [(quintic(0.2, -1.3, 0.7), 2, 1e-14), (paper_profile(), 21, 5.4e-9)],
)
def test_sampled_profiles_are_followed(profile, n_points, tolerance):
    points = rows(sample(profile, n_points))
    generator = ReferenceGenerator(["a"])
    generator.start(profile.start, 0)
    assert generator.offer(validate(["a"], ["a"], 0, points)).accepted
    for i in range(400):
        stamp = round(i * profile.duration / 390 * S)
        generator.sample(stamp)
        expected = profile.position(stamp / S)
        np.testing.assert_allclose(generator.position, expected, rtol=0, atol=tolerance)
    assert generator.finished


@pytest.mark.parametrize(
    ("make", "field", "value"),
    [
        (lambda: paper_profile(0.0), "duration", 0.0),
        (lambda: paper_profile(1.7e308), "duration", 1.7e308),
        (lambda: paper_profile(NAN), "duration", NAN),
        (lambda: quintic(0.0, 1.0, INF), "duration", INF),
        (lambda: quintic(0.0, [1.0, NAN], 1.0), "end[1]", NAN),
        (lambda: paper_profile(angle=INF), "angle[0]", INF),
        (lambda: quintic([0.0, 1.0], [1.0, 2.0, 3.0], 1.0), "start, end, duration", NOT_GIVEN),
        (lambda: quintic([[0.0]], 1.0, 1.0), "start, end", NOT_GIVEN),
        (lambda: quintic("x", 1.0, 1.0), "start, end, duration", NOT_GIVEN),
        (lambda: smooth(0.0, 1.0, 1.0, 1), "smoothness", 1),
        (lambda: smooth(0.0, 1.0, 1.0, 21), "smoothness", 21),
        (lambda: smooth(0.0, 1.0, 1.0, 3.0), "smoothness", 3.0),
        (lambda: smooth(0.0, 1.0, 0.0), "duration", 0.0),
        (lambda: sample(paper_profile(), 1), "n_points", 1),
        (lambda: sample(paper_profile(), 2.5), "n_points", 2.5),
    ],
)
def test_what_makes_no_profile_is_refused(make, field, value):
    with pytest.raises(TrajectoryError) as error:
        make()
    assert error.value.field == field
    assert repr(error.value.value) == repr(value)
