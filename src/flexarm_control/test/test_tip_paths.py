# SPDX-License-Identifier: Apache-2.0
"""Tip paths: the bent arm's tip is on them, joints and their derivatives belong together."""

import numpy as np
import pytest
from scipy.optimize import brentq

from flexarm_control.motions import profiles, shapers, tip_paths
from flexarm_control.trajectory import specs
from flexarm_dynamics.errors import FlexarmError, TrajectoryError

START = np.array([0.2, -0.3, 0.9, 0.2])
PLANAR = np.array([0.2, 1.2])


def resting_tip(arm, q):
    """Forward kinematics of the arm at rest, apart from what the paths use."""
    return arm.frames(q, arm.static_deflection(q))[1][-1]


@pytest.fixture(scope="module")
def lifted(long_reach):
    """A straight line of 0.7 m upwards and sideways, in 4 s."""
    end = resting_tip(long_reach, START) + np.array([-0.2, 0.5, 0.45])
    return tip_paths.line(long_reach, START, end, profiles.smooth(0.0, 1.0, 4.0)), end


def test_the_bent_arms_tip_is_on_the_line_all_the_way(long_reach, lifted):
    path, end = lifted
    begin = resting_tip(long_reach, START)
    law = profiles.smooth(0.0, 1.0, 4.0)
    worst = straight = 0.0
    for t in np.linspace(0.0, 4.0, 41):
        wanted = begin + law.position(t) * (end - begin)
        q = path.position(t)
        np.testing.assert_allclose(path.tip(t), wanted, atol=1e-12)
        worst = max(worst, np.linalg.norm(resting_tip(long_reach, q) - wanted))
        straight = max(straight, np.linalg.norm(long_reach.frames(q)[1][-1] - wanted))
    assert worst < 1e-6
    assert straight > 0.1  # the links do hang down, and that is compensated
    np.testing.assert_allclose(path.position(0.0), START, atol=1e-12)


@pytest.mark.parametrize("shaped", [False, True])
def test_velocities_and_accelerations_are_the_derivatives(lifted, shaped):
    path, small = lifted[0], 1e-5
    if shaped:
        law = shapers.zv(5.0, 0.1).apply(profiles.smooth(0.0, 1.0, 3.0))
        path = path.with_law(law)
        assert path.duration == law.duration
    t = np.linspace(0.01, path.duration - 0.01, 30)
    for f, df in ((path.position, path.velocity), (path.velocity, path.acceleration)):
        np.testing.assert_allclose((f(t + small) - f(t - small)) / (2 * small), df(t), atol=1e-7)
    for at in (0.0, path.duration):
        np.testing.assert_allclose(path.velocity(at), 0.0, atol=1e-12)
    np.testing.assert_allclose(path.position(path.duration), path.start + path.angle, atol=1e-12)


def test_an_arc_keeps_its_distance_from_its_centre(two_link):
    begin = resting_tip(two_link, PLANAR)
    via, end = np.array([0.35, 0.75, 0.0]), np.array([-0.05, 0.6, 0.0])
    path = tip_paths.arc(two_link, PLANAR, via, end, profiles.quintic(0.0, 1.0, 2.0))
    tips = np.array([resting_tip(two_link, path.position(t)) for t in np.linspace(0.0, 2.0, 33)])
    np.testing.assert_allclose(tips[[0, -1]], [begin, end], atol=1e-8)
    # The centre by perpendicular bisectors: 2 (p_i - p_0) c = |p_i|^2 - |p_0|^2.
    rows = 2.0 * np.array([via - begin, end - begin])[:, :2]
    sides = [via @ via - begin @ begin, end @ end - begin @ begin]
    centre = np.append(np.linalg.solve(rows, sides), 0.0)
    radius = np.linalg.norm(begin - centre)
    np.testing.assert_allclose(np.linalg.norm(tips - centre, axis=1), radius, atol=1e-7)
    angles = np.unwrap(np.arctan2(*(tips - centre).T[1::-1]))
    steps = np.diff(angles)
    np.testing.assert_array_equal(np.sign(steps), np.sign(steps[0]))

    def ahead(t):
        """How far the tip is ahead of `via`, along the chord [m^2]."""
        return (resting_tip(two_link, path.position(t)) - via) @ (end - begin)

    at_via = brentq(ahead, 0.1, 1.9, xtol=1e-12)
    np.testing.assert_allclose(resting_tip(two_link, path.position(at_via)), via, atol=1e-7)


def test_a_circle_turns_through_via_even_when_that_is_the_long_way():
    begin, via, end = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0.0, -1, 0]])
    curve = tip_paths.circle(begin, via, end)
    at = np.array([0.0, 1 / 3, 2 / 3, 1.0])
    np.testing.assert_allclose(curve(at), [begin, [0, 1, 0], via, end], atol=1e-12)


def test_a_line_is_written_as_a_spec_and_its_shaper_leaves_the_tip_on_it(two_link):
    begin, end = resting_tip(two_link, PLANAR), np.array([0.3, 0.5, 0.0])
    text = "line:tip=0.3;0.5;0,duration=2,shaper=zv,shape-modes=1,points=21"
    spec = specs.from_spec(text, two_link, PLANAR)
    assert spec.times[-1] > 2.1
    tips = np.array([resting_tip(two_link, q) for q in spec.positions])
    off = np.cross(tips - begin, (end - begin) / np.linalg.norm(end - begin))
    assert np.abs(off).max() < 1e-7
    np.testing.assert_allclose(tips[-1], end, atol=1e-8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "line:tip=1.5;0;0",
            r"beyond \d+ %: .* out of reach from there; the nearest found is .* m",
        ),
        ("line:tip=0.3;0.5;0.1", r"out of reach"),
        ("line:tip=nan;0;0", r"tip: 'nan;0;0' can't be used; give 3 finite coordinates"),
        ("line:tip=0.3;0.5;0,smoothness=1", r"smoothness: 1 is not possible"),
        ("arc:tip=0.3;0.5;0", r"arc: via is missing"),
    ],
)
def test_what_the_tip_cant_follow_is_refused(two_link, text, message):
    with pytest.raises(FlexarmError, match=message):
        specs.from_spec(text, two_link, PLANAR)


def test_a_line_past_the_base_or_of_no_length_and_an_arc_on_a_line_are_refused(two_link):
    begin, law = resting_tip(two_link, PLANAR), profiles.quintic(0.0, 1.0, 1.0)
    # Within 0.1 mm of the base the elbow has to fold and the shoulder to swing round at once.
    with pytest.raises(TrajectoryError, match=r"% of it, near q = .* nearly singular there"):
        tip_paths.line(two_link, PLANAR, -begin + [2e-4, 0.0, 0.0], law)
    with pytest.raises(TrajectoryError, match="is where the tip is already"):
        tip_paths.line(two_link, PLANAR, begin, law)
    with pytest.raises(TrajectoryError, match="are on a line"):
        tip_paths.arc(two_link, PLANAR, 1.1 * begin, 1.2 * begin, law)


def test_a_start_beyond_the_joints_limits_is_refused(long_reach):
    with pytest.raises(TrajectoryError) as error:
        tip_paths.line(long_reach, [0.0, 0.0, 3.0, 0.0], [2.0, 0.0, 0.0], profiles.quintic(0, 1, 1))
    assert (error.value.field, error.value.value) == ("start of joint elbow_pitch", 3.0)
