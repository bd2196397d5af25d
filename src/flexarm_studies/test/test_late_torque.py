# SPDX-License-Identifier: Apache-2.0
"""A torque that acts late: the delay is measured, it is no error, and what happens to the control meanwhile."""

import numpy as np
import pytest

from flexarm_control.composite.design_process import dumps, loads
from flexarm_dynamics.arm import arm_file
from flexarm_studies.loop.scenario import Scenario, loop_of, parameters, trajectory_of
from flexarm_studies.uncertain.plants import with_noise

RATE, DELAY = 500.0, 0.002


def loop_with(arm="R", delay=DELAY, known=np.nan, noise=False, **given):
    """The loop of R with its own model, at 500 Hz, and a measured delay as `known`."""
    given = {"feedforward_modes": 0, "motion_delay": 0.004} | given
    scenario = Scenario(
        arm, parameters("R_designed") | given, delay=delay, rate=RATE, noise=noise, seed=1
    )
    loop = loop_of(scenario)
    loop.controller.torque_delay.known = known
    return loop


def moves(loop, angle, samples=900, begin=20, at=None, then=None):
    """Joint errors [rad] and torques beyond the feed-forward's [N m] in a motion of a second, (samples, 2).

    At the sample `at` of it `then` is called.
    """
    start, controller = loop.controller.reference.position.copy(), loop.controller
    trajectory = trajectory_of(f"quintic:to={angle},duration=1", loop.model, start)
    rows = []
    for k in range(samples):
        if k == begin:
            assert controller.offer(trajectory, loop.prepared(trajectory)).accepted
        if k == at:
            then()
        loop.step()
        law = controller.law
        fed_back = law.torque - law.feedforward.torque
        rows.append([abs(controller.position_error[0]), abs(fed_back[0])])
    return np.array(rows)


@pytest.mark.parametrize("delay", [0.002, 0.0035])
def test_a_late_torque_is_no_error_and_the_arm_is_on_time(delay):
    at_once, late = (moves(loop_with(delay=d, known=d), 0.5).max(axis=0) for d in (0.0, delay))
    assert at_once[1] < 1e-6
    assert late[0] == pytest.approx(at_once[0], rel=0.03)
    without = moves(loop_with(delay=delay, known=delay, motion_delay=0.0), 0.5).max(axis=0)
    assert without[1] > 0.1 and late[1] < 0.05 * without[1]


def test_the_delay_is_measured_at_rest_by_the_noise_of_the_sensors():
    arm = with_noise(arm_file.load("R"))
    loop = loop_with(arm, noise=True, delay=0.003, publish_joint_velocity=False)
    for _ in range(150):
        loop.step()
    assert loop.controller.torque_delay.known == pytest.approx(0.003, abs=1e-4)
    moves(loop, 0.5, 200)
    assert loop.controller.law._seen.late == pytest.approx(0.003, abs=1e-4)
    assert loop.controller.law._lead_ns == pytest.approx(3e6, abs=1e5)


def test_what_is_measured_during_a_motion_counts_after_it():
    loop = loop_with()

    def measures():
        loop.controller.torque_delay.known = DELAY

    moves(loop, 0.5, 500, at=200, then=measures)
    assert loop.controller.law._lead_ns == 0 and loop.controller.law._seen.late == 0.0
    moves(loop, 0.0, 500, begin=300)
    assert loop.controller.law._lead_ns == 2_000_000 and loop.controller.law._seen.late == DELAY


@pytest.mark.parametrize("sent", [False, True])
@pytest.mark.parametrize(
    ("before", "after"),
    [
        ({}, {}),
        ({"motion_delay": 0.0}, {}),
        ({}, {"motion_delay": 0.0}),
        ({"motion_delay": 0.0, "motion_velocity_bandwidth": 0.0, "motion_rate_bandwidth": 0.0}, {}),
    ],
)
def test_a_control_that_is_replaced_at_rest_does_not_move_the_arm(before, after, sent):
    """Away from zero, by one that was made here or was sent by another process."""
    loop, law = loop_with(known=DELAY, **before), loop_with(**after).controller.law
    if sent:
        law = loads(dumps(law, loop.model.arm), loop.model)
    assert moves(loop, 0.5, 1500)[-1].max() < 1e-4
    loop.controller.replace_law(law)
    rows = []
    for _ in range(300):
        loop.step()
        rows.append([loop.controller.position_error[0], loop.controller.torque[0]])
    assert np.abs(rows).max() < 1e-3
    moved = moves(loop, 0.0)
    assert loop.controller.law is law and moved[-1, 0] < 1e-4


@pytest.mark.parametrize("after", [0.004, 0.001, 0.0])
def test_a_control_that_is_replaced_in_motion_sees_it_as_late_as_the_one_before(after):
    loop, law = loop_with(known=DELAY), loop_with(motion_delay=after).controller.law
    rows = moves(loop, 0.5, at=300, then=lambda: loop.controller.replace_law(law))
    assert rows[250:, 1].max() < 0.1
    assert law._seen.late == min(DELAY, after)
    assert law._lead_ns == round(1e9 * law._seen.late)


def test_a_stop_in_motion_is_no_error_either():
    loop = loop_with(known=DELAY)
    rows = moves(loop, 0.5, at=250, then=lambda: loop.controller.brake("test"))
    assert rows[:, 1].max() < 0.05 and rows[-1, 0] < 1e-4
    still = loop_with(delay=0.0, known=0.0)
    wanted = moves(still, 0.5, at=250, then=lambda: still.controller.brake("test"))
    assert rows[:, 0].max() == pytest.approx(wanted[:, 0].max(), rel=0.05)
