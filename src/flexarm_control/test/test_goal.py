# SPDX-License-Identifier: Apache-2.0
"""When a motion has reached its goal: tolerances, and a tip that rests."""

import numpy as np
import pytest

from flexarm_control.trajectory.goal import (
    PARAMETERS,
    Code,
    GoalCheck,
    TipSwing,
    tolerances,
)
from flexarm_dynamics.errors import TrajectoryError

S = 10**9
NAMES = ("a", "b")
DEFAULTS = {p.name: p.default for p in PARAMETERS}
INF = np.inf


def made(values=None, **own):
    return tolerances(NAMES, 2.0, DEFAULTS | (values or {}), **own)


def test_parameters_count_where_a_goal_states_nothing():
    limits = made({"constraints.trajectory": [0.1, 0.2], "constraints.goal_time": 3.0})
    np.testing.assert_array_equal(limits.path, [[0.1, 0.2], [INF, INF]])
    np.testing.assert_array_equal(limits.goal, [[INF, INF], [0.01, 0.01]])
    assert (limits.time, limits.tip) == (3.0, 2e-3)


def test_a_goals_own_tolerances_replace_them_and_negative_ones_judge_nothing():
    values = {"constraints.trajectory": [0.1], "constraints.goal": [0.05]}
    limits = made(
        values,
        path=[("b", 0.3, 1.0), ("a", -1.0, 0.0)],
        goal=[("a", 0.0, -1.0)],
        time=-1.0,
        tip=-1.0,
    )
    np.testing.assert_array_equal(limits.path, [[INF, 0.3], [INF, 1.0]])
    np.testing.assert_array_equal(limits.goal, [[0.05, 0.05], [INF, 0.01]])
    assert (limits.time, limits.tip) == (INF, INF)


@pytest.mark.parametrize(
    ("own", "field"),
    [
        ({"path": [("c", 0.1, 0.0)]}, "path_tolerance[0].name"),
        ({"goal": [("a", 0.1, 0.0), ("b", np.nan, 0.0)]}, "goal_tolerance[1].position of b"),
        ({"goal": [("a", 0.1, np.inf)]}, "goal_tolerance[0].velocity of a"),
        ({"tip": np.nan}, "tip_tolerance"),
        ({"time": np.inf}, "goal_time_tolerance"),
    ],
)
def test_what_can_not_be_kept_to_is_refused_by_field(own, field):
    with pytest.raises(TrajectoryError) as refused:
        made(**own)
    assert refused.value.field == field


@pytest.mark.parametrize("phase", np.linspace(0.0, np.pi, 7))
@pytest.mark.parametrize("step", [0.01, 0.1, 0.3])
def test_a_swing_is_between_one_and_two_amplitudes_at_any_phase_and_rate_of_looks(phase, step):
    """Harmonic, period 1 s; looks that are far apart make the time longer, and so more of the swing."""
    swing, amplitude = TipSwing(1.0), 3e-3
    for k in range(60):
        t = k * step
        place = [0.0, amplitude * np.cos(2.0 * np.pi * t + phase), 1.0]
        swing.add(round(t * S), place)
    assert 0.95 * amplitude <= swing.value <= 2.0 * amplitude + 1e-12


def test_a_swing_is_unknown_until_half_a_period_has_been_seen_and_old_motion_is_forgotten():
    swing = TipSwing(1.0)
    for k in range(50):
        assert np.isnan(swing.value)
        swing.add(k * S // 100, [1.0, 0.0, 0.0])
    swing.add(S // 2, [1.0, 0.0, 0.0])
    assert swing.value == 0.0
    swing.add(S // 2 + 1, [1.5, 0.0, 0.0])
    assert swing.value == 0.5
    swing.add(S // 2, [9.0, 0.0, 0.0])  # not later: left out
    assert swing.value == 0.5
    for k in range(52, 120):
        swing.add(k * S // 100, [1.0, 0.0, 0.0])
    assert swing.value == 0.0


def look(check, time, error=(0.0, 0.0), velocity=(0.0, 0.0), tip=(0.0, 0.0, 0.0)):
    return check.at_the_end(round(time * S), np.array(error), np.array(velocity), np.array(tip))


def test_a_goal_succeeds_at_rest_after_its_end_and_not_before():
    check = GoalCheck(NAMES, made(), 2 * S, 0.4)
    assert all(look(check, t) is None for t in np.arange(1.0, 2.0, 0.02))
    times = np.arange(2.0, 3.0, 0.02)
    first = next(t for t in times if (found := look(check, t)) is not None)
    assert (found.code, found.swing) == (Code.SUCCESSFUL, 0.0)
    assert 2.2 <= first < 2.23


def test_a_tip_that_swings_holds_a_goal_back_until_its_time_is_over():
    check = GoalCheck(NAMES, made(time=1.0), 0, 0.4)
    for t in np.arange(0.0, 3.0, 0.02):
        outcome = look(check, t, tip=(0.0, 5e-3 * np.sin(2.0 * np.pi * t / 0.4), 0.0))
        if outcome is not None:
            break
    assert outcome.code == Code.GOAL_TOLERANCE_VIOLATED and 1.0 < t < 1.05
    assert outcome.text.startswith("goal_time_tolerance of 1 s is over: the tip swings by")
    assert 5e-3 <= outcome.swing <= 1e-2


def test_joints_that_are_not_there_or_still_move_hold_it_back():
    check = GoalCheck(NAMES, made(goal=[("b", 0.1, 0.0)], time=0.5, tip=-1.0), 0, 0.4)
    assert look(check, 0.1, error=(5.0, 0.2)) is None
    assert look(check, 0.2, velocity=(0.0, 0.02)) is None
    outcome = look(check, 0.7, error=(0.0, -0.2))
    assert outcome.code == Code.GOAL_TOLERANCE_VIOLATED
    assert outcome.text.endswith("b is off by 0.2 rad, 0.1 rad are allowed")
    assert look(check, 0.3, error=(5.0, 0.09)).code == Code.SUCCESSFUL


def test_the_joint_that_is_farthest_beyond_its_path_tolerance_is_named():
    check = GoalCheck(NAMES, made(path=[("a", 0.1, 0.0), ("b", 0.1, 2.0)]), 0, 0.4)
    assert check.on_the_way(np.array([0.1, -0.1]), np.array([50.0, 2.0])) is None
    outcome = check.on_the_way(np.array([0.15, -0.1]), np.array([0.0, -5.0]))
    assert outcome.code == Code.PATH_TOLERANCE_VIOLATED
    assert outcome.text == "path tolerance violated: b is off by 5 rad/s, 2 rad/s are allowed"
