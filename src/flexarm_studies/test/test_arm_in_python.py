# SPDX-License-Identifier: Apache-2.0
"""An arm in a few lines of Python, without ROS."""

import numpy as np
import pytest

from flexarm_dynamics.errors import TrajectoryError
from flexarm_studies.loop.arm import MIN_DURATION, MotionError, SimulatedArm


@pytest.fixture(scope="module")
def arm():
    with SimulatedArm("one_link", rate=500.0) as arm:
        yield arm


def test_a_move_ends_when_the_tip_rests_and_its_record_has_it(arm):
    with arm.recording() as run:
        arrival = arm.move(0.4, 1.5)
    assert 1.5 < arrival.seconds < 8.0
    assert 0.0 < arrival.tip_swing < 1e-3 * arm.arm.links[0].length
    state, record = arm.state, run.record
    assert state.supervisor == "HOLDING" and not state.reason
    np.testing.assert_allclose(state.reference, [0.4], atol=1e-12)
    assert record.time[0] == 0.0 and record.time[-1] == pytest.approx(arrival.seconds, abs=0.01)
    np.testing.assert_allclose(record.reference[-1], 0.4, atol=1e-12)
    assert abs(record.position[-1, 0] - 0.4) < 0.01
    # The tip, with what is left of the bending.
    length = arm.arm.links[0].length
    np.testing.assert_allclose(
        state.tip[:2], length * np.array([np.cos(0.4), np.sin(0.4)]), atol=0.02
    )


def test_without_a_duration_a_move_takes_a_comfortable_one(arm):
    start = arm.state.reference.copy()
    near, far = (arm.comfortable(start, start + by) for by in (0.01, 2.0))
    assert MIN_DURATION <= near <= far
    arm.move(start[0] - 0.2)
    np.testing.assert_allclose(arm.state.reference, start - 0.2, atol=1e-12)


def test_motions_come_from_points_and_lines_of_text(arm):
    here = arm.state.reference[0]
    arm.follow([(1.0, here + 0.05), (2.0, here)])
    np.testing.assert_allclose(arm.state.reference, [here], atol=1e-12)
    arm.follow(f"quintic:to={here + 0.1},duration=1")
    np.testing.assert_allclose(arm.state.reference, [here + 0.1], atol=1e-12)


@pytest.mark.parametrize(
    ("motion", "kind", "text"),
    [
        (lambda arm: arm.move([0.1, 0.2]), TrajectoryError, "to:"),
        (lambda arm: arm.move(np.nan), TrajectoryError, "finite"),
        (lambda arm: arm.move(0.5, -1.0), TrajectoryError, "duration"),
        (lambda arm: arm.follow(3), TrajectoryError, "is no motion"),
        (lambda arm: arm.follow("dance:to=1"), TrajectoryError, "dance"),
        (lambda arm: arm.move(3.0, 0.05), (TrajectoryError, MotionError), "limit"),
    ],
    ids=["joints", "NaN", "duration", "no motion", "no family", "too fast"],
)
def test_what_can_not_be_followed_is_refused_and_the_arm_goes_on(arm, motion, kind, text):
    before = arm.state.reference.copy()
    with pytest.raises(kind, match=text):
        motion(arm)
    arm.wait(0.05)
    np.testing.assert_array_equal(arm.state.reference, before)
    assert arm.state.supervisor in ("READY", "HOLDING")


def test_a_stop_brings_the_arm_to_rest_and_without_a_fault_there_is_nothing_to_recover(arm):
    arm.stop()
    assert arm.state.supervisor in ("READY", "HOLDING")
    assert not arm.recover()


def test_an_arm_that_differs_from_its_file_is_recorded_as_it_is():
    with SimulatedArm("one_link", rate=500.0, payload_scale=1.3) as arm:
        assert arm.move(0.2, 1.5).tip_swing <= 1e-3 * arm.arm.links[0].length
