# SPDX-License-Identifier: Apache-2.0
"""Trajectories on the topic, with stamp 0 or an explicit one; two of them over DDS, published as users do."""

import itertools
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
from harness import PATIENT, Arm, trajectory
from in_process import InProcess
from rclpy.serialization import serialize_message

from flexarm_control.motions import profiles
from flexarm_control.nodes.trajectory_inbox import TrajectoryInbox
from flexarm_control.trajectory import ReferenceGenerator
from flexarm_control.trajectory.streams import PLAIN
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models.model import build
from flexarm_msgs.msg import CompositeState, JointTorque

J = ["joint1"]
MS = 1_000_000


def standing_loop(bench):
    """The three nodes in lockstep, paused at 10 ms, with an arm that has limits."""
    lockstep = {"lockstep": True, "pause_at": 0.01, "resend_period": 0.02}
    # Some of the motions here take more torque than the arm has.
    controller = {**PATIENT, "fast.type": "none", "trajectory_torque_margin": 0.0}
    bench.start_loop(lockstep, controller=controller, arm="one_link")
    arm = Arm(bench, pauses_at=10)
    arm.wait_standing()
    return arm


@pytest.fixture(scope="module")
def loop():
    """The loop in this process."""
    with InProcess() as bench:
        yield standing_loop(bench)


@pytest.fixture
def arm(loop, counter=itertools.count(1)):  # noqa: B008
    """The loop in a new session, paused at 10 ms, READY, nothing refused."""
    # An accepted trajectory clears the reason of the last refusal, the reset then forgets it.
    loop.reset()
    loop.offer(trajectory(J, (10.0 + 0.001 * next(counter), [0.0])))
    loop.reset()
    assert loop.state.supervisor_state == CompositeState.READY
    assert loop.state.rejected_reason == ""
    return loop


def column(samples, field, begin=0, end=2**63):
    """A field of joint1 over the samples from begin to end [ns]."""
    return np.array([getattr(m, field)[0] for s, m in samples.items() if begin <= s <= end])


# Refusals --------------------------------------------------------------------------------------

NAN, INF = math.nan, math.inf
REFUSED = {
    "wrong joint": (trajectory(["jointX"], (1.0, [0.1])), "'jointX' is no joint"),
    "no joints": (trajectory([], (1.0, [])), "'joint1' is missing"),
    "extra joint": (trajectory(["joint1", "joint2"], (1.0, [0.1, 0.1])), "'joint2' is no joint"),
    "joint twice": (
        trajectory(["joint1", "joint1"], (1.0, [0.1, 0.1])),
        "'joint1' is given 2 times",
    ),
    "too many positions": (
        trajectory(J, (1.0, [0.1, 0.2])),
        r"points\[0\]\.positions: 2 is the wrong number",
    ),
    "no positions": (trajectory(J, (1.0, [])), r"points\[0\]\.positions: is empty"),
    "too many velocities": (
        trajectory(J, (1.0, [0.1], [0.0]), (2.0, [0.1], [0.0, 0.0])),
        r"points\[1\]\.velocities: 2 is the wrong number",
    ),
    "velocities not everywhere": (
        trajectory(J, (1.0, [0.1], [0.0]), (2.0, [0.1])),
        r"points\[1\]\.velocities: is empty",
    ),
    "accelerations alone": (trajectory(J, (1.0, [0.1], [], [0.0])), "accelerations but no velo"),
    "NaN position": (trajectory(J, (1.0, [NAN])), r"points\[0\]\.positions of joint joint1: nan"),
    "NaN velocity": (trajectory(J, (1.0, [0.1], [NAN])), r"\.velocities of joint joint1: nan"),
    "inf position": (
        trajectory(J, (1.0, [0.1]), (2.0, [INF])),
        r"points\[1\]\.positions of joint joint1: inf",
    ),
    "inf acceleration": (
        trajectory(J, (1.0, [0.1], [0.0], [-INF])),
        r"\.accelerations of joint joint1: -inf",
    ),
    "equal times": (
        trajectory(J, (1.0, [0.1]), (1.0, [0.2])),
        r"points\[1\]\.time_from_start: 1\.0 s is not later than points\[0\]",
    ),
    "times that go back": (
        trajectory(J, (2.0, [0.1]), (1.0, [0.2])),
        r"points\[1\]\.time_from_start: 1\.0 s is not later than points\[0\] at 2 s",
    ),
    "negative time": (
        trajectory(J, (-1.0, [0.1])),
        r"points\[0\]\.time_from_start: -1\.0 s is negative",
    ),
    "no points": (trajectory(J), "empty trajectory"),
    "past stamp": (
        trajectory(J, (1.0, [0.1]), stamp=5 * MS),
        r"header\.stamp: 5000000 ns is .* in the past",
    ),
    "beyond the position limit": (
        trajectory(J, (5.0, [3.5])),
        r"joint1: 3\.5 rad is above the limit \(3\.14",
    ),
    "below the position limit": (
        trajectory(J, (5.0, [-3.2])),
        r"joint1: -3\.2 rad is below the limit \(-3\.14",
    ),
    "beyond the velocity limit": (
        trajectory(J, (1.0, [0.1], [11.0]), (2.0, [0.2], [0.0])),
        r"joint1: 11\.0 rad/s is beyond the speed limit \(10\.0",
    ),
    "too fast between points": (
        trajectory(J, (1.0, [0.0]), (1.1, [3.0])),
        r"joint1: (30|29\.99)\S* rad/s on average",
    ),
    "too fast to the first point": (
        trajectory(J, (0.1, [3.0])),
        r"joint1: (30|29\.99)\S* rad/s on average from the reference",
    ),
    "moving at the end": (
        trajectory(J, (1.0, [0.1], [0.5])),
        r"velocities of joint joint1: 0\.5 rad/s is not zero at the last point",
    ),
    "a jump at time 0": (trajectory(J, (0.0, [1.0])), r"joint1: 1\.0 rad away from the reference"),
    "effort": (trajectory(J, (1.0, [0.1], [], [], [1.0])), r"points\[0\]\.effort: is not empty"),
}


def test_a_hundred_thousand_points_are_refused_and_the_loop_goes_on(arm):
    point = trajectory(J, (1.0, [0.1])).points[0]
    message = trajectory(J)
    message.points = [point] * 100_000
    assert "points: 100000 are too many (at most 10000)" in arm.refused(message)
    assert arm.state.supervisor_state == CompositeState.READY


def test_a_trajectory_of_thousands_of_points_is_followed(arm):
    t = np.arange(1, 2001) * 1e-4
    s = np.sin(np.pi * t)
    number = arm.offer(trajectory(J, *((at, [0.1 * x]) for at, x in zip(t, s, strict=True))))
    samples = arm.run(0.5)  # near positions are smoothed, and end later
    assert arm.state.accepted_trajectory_id == number
    assert arm.state.reference_position[0] == 0.1 * s[-1]
    assert len(samples) > 250


def test_trajectories_streamed_at_50_hz_make_one_smooth_motion(arm):
    goals, first = 0.02 * np.arange(1, 11), arm.state.accepted_trajectory_id
    for goal in goals:
        arm.offer(trajectory(J, (0.1, [goal])))
        arm.run(0.02)
    samples = arm.run(0.2)
    assert arm.state.accepted_trajectory_id == first + len(goals)
    assert arm.state.reference_position[0] == pytest.approx(goals[-1])
    assert arm.state.supervisor_state == CompositeState.HOLDING
    position = column(samples, "reference_position")
    steps = np.abs(np.diff(position) / np.diff(list(samples)))
    assert steps.max() < 3e-9  # [rad/ns] never a jump: a ramp of 0.1 s to the goal ahead


def test_a_stream_of_points_with_velocities_is_followed_without_steps_and_without_a_line_each(arm):
    """As of MoveIt Servo: one point in a message, 50 Hz; the arm comes to rest when they stop."""
    arm.bench.set("controller", allow_nonzero_velocity_at_trajectory_end=True, cmd_timeout=0.05)
    before = arm.bench.log("controller").count("accepted")
    try:
        for t in 0.02 * np.arange(1, 26):  # a velocity that rises smoothly
            arm.offer(trajectory(J, (0.02, [0.1 * t**3], [0.3 * t**2])))
            arm.run(0.02)
        samples = arm.run(1.0)
    finally:
        arm.bench.set("controller", allow_nonzero_velocity_at_trajectory_end=False)
    velocity = column(samples, "reference_velocity")
    assert np.abs(np.diff(velocity)).max() < 2e-3  # [rad/s] in 1 ms: 2 rad/s^2
    assert velocity.max() == pytest.approx(0.075, abs=2e-3)
    assert arm.state.supervisor_state == CompositeState.HOLDING
    assert arm.state.reference_velocity[0] == 0.0
    assert not any(sample.saturated for sample in samples.values())
    assert arm.bench.log("controller").count("accepted") < before + 10  # one in ten seconds


def test_speed_scaling_makes_a_motion_slower_and_holds_it_on_its_way(arm):
    arm.bench.set("controller", speed_scaling=0.5)
    try:
        arm.offer(trajectory(J, (1.0, [0.3], [0.0], [0.0])))
        samples = arm.run(0.6)
        there = np.ravel(profiles.quintic(0.0, 0.3, 1.0).position(0.3))[0]
        assert column(samples, "reference_position")[-1] == pytest.approx(there, abs=2e-3)
        arm.bench.set("controller", speed_scaling=0.0)
        arm.run(1.5)
        assert arm.state.supervisor_state == CompositeState.TRACKING
        assert arm.state.reference_velocity[0] == 0.0
        arm.bench.set("controller", speed_scaling=1.0)
        arm.run(1.5)
    finally:
        arm.bench.set("controller", speed_scaling=1.0)
    assert arm.state.supervisor_state == CompositeState.HOLDING
    assert arm.state.reference_position[0] == 0.3


@pytest.mark.parametrize("case", REFUSED)
def test_a_trajectory_that_cannot_be_followed_is_refused_with_a_reason_and_the_arm_holds(arm, case):
    check_refusal(arm, case)


def test_over_dds_a_trajectory_is_refused_and_another_followed(bench):
    arm = standing_loop(bench)
    check_refusal(arm, "NaN position")
    arm.offer(trajectory(J, (0.2, [0.3], [0.0], [0.0])))
    start = arm.now + MS
    follows(arm.run(0.3), start, profiles.quintic(0.0, 0.3, 0.2), 0.2)


def check_refusal(arm, case):
    message, reason = REFUSED[case]
    accepted = arm.state.accepted_trajectory_id
    assert re.search(reason, arm.refused(message)), arm.state.rejected_reason
    begin = arm.now
    samples = arm.run(0.02)
    assert arm.state.accepted_trajectory_id == accepted
    assert arm.state.supervisor_state == CompositeState.READY
    for field in ("reference_position", "reference_velocity", "reference_acceleration"):
        assert set(column(samples, field, begin)) == {0.0}, field
    modes = {
        m.mode for m in arm.torques.messages if m.session == arm.state.session and m.sequence > 10
    }
    assert modes == {JointTorque.ENABLED}


def test_a_refused_trajectory_leaves_the_one_that_is_followed(arm):
    quintic = profiles.quintic(0.0, 0.5, 0.4)
    number = arm.offer(trajectory(J, (0.4, [0.5], [0.0], [0.0])))
    start = arm.now + MS  # the first sample after the pause
    arm.run(0.1)
    assert "nan" in arm.refused(trajectory(J, (1.0, [NAN])))
    samples = arm.run(0.4)
    assert arm.state.accepted_trajectory_id == number
    follows(samples, start, quintic, 0.4)


def test_what_needs_more_torque_than_the_arm_has_is_refused_and_the_motion_goes_on(arm):
    (result,) = arm.bench.set("controller", trajectory_torque_margin=1.0)
    assert result.successful, result.reason
    try:
        quintic = profiles.quintic(0.0, 0.1, 0.4)
        number = arm.offer(trajectory(J, (0.4, [0.1], [0.0], [0.0])))
        start = arm.now + MS
        arm.run(0.1)
        reason = arm.refused(trajectory(J, (0.4, [2.0], [0.0], [0.0])))
        assert re.search(
            r"points\[0\]: torque of joint joint1 at 0\.\d+ s: -?\d+\.\d+ N m are needed there, more than the"
            r" torque limit \(13\.5\); give it \d\.\d+ times the time",
            reason,
        )
        samples = arm.run(0.4)
        assert arm.state.accepted_trajectory_id == number
        follows(samples, start, quintic, 0.4)
    finally:
        arm.bench.set("controller", trajectory_torque_margin=0.0)


def follows(samples, start, profile, duration, atol=1e-12):
    """Every sample from the start on has the profile's reference, and holds its end."""
    stamps = [s for s in samples if s >= start]
    t = np.minimum((np.array(stamps) - start) * 1e-9, duration)
    for field, of in (
        ("reference_position", profile.position),
        ("reference_velocity", profile.velocity),
        ("reference_acceleration", profile.acceleration),
    ):
        expected = np.array([np.ravel(of(x))[0] for x in t])
        if field != "reference_position":
            expected[t >= duration] = 0.0
        np.testing.assert_allclose(column(samples, field, start), expected, rtol=0, atol=atol * 1e3)


# Acceptance ------------------------------------------------------------------------------------


def test_stamp_0_starts_at_the_first_state_after_it_arrived(arm):
    arm.offer(trajectory(J, (0.2, [0.3], [0.0], [0.0])))
    standing = arm.now
    samples = arm.run(0.3)
    assert column(samples, "reference_position", standing, standing) == [0.0]
    follows(samples, standing + MS, profiles.quintic(0.0, 0.3, 0.2), 0.2)


def test_an_explicit_stamp_starts_there_to_the_nanosecond(arm):
    start = arm.now + 50 * MS + 300_000  # between two samples
    arm.offer(trajectory(J, (0.2, [0.3], [0.0], [0.0]), stamp=start))
    assert arm.state.supervisor_state == CompositeState.READY
    samples = arm.run(0.3)
    assert set(column(samples, "reference_position", 0, start)) == {0.0}
    follows(samples, start, profiles.quintic(0.0, 0.3, 0.2), 0.2)
    tracking = [s for s, m in samples.items() if m.supervisor_state == CompositeState.TRACKING]
    assert 0 <= tracking[0] - start < 5 * MS and 0 < start + 200 * MS - tracking[-1] < 5 * MS


def test_a_single_point_with_positions_only_ramps_there_and_is_held(arm):
    arm.offer(trajectory(J, (0.1, [0.05])))
    start = arm.now + MS
    samples = arm.run(0.3)
    ramp = column(samples, "reference_position", start, start + 100 * MS)
    t = np.array([stamp for stamp in samples if start <= stamp <= start + 100 * MS]) - start
    np.testing.assert_allclose(ramp, 0.5e-9 * t, rtol=0, atol=1e-12)
    assert ramp.size > 90
    held = column(samples, "reference_position", start + 100 * MS)
    assert held.size > 150 and set(held) == {0.05}
    assert set(column(samples, "reference_velocity", start + 100 * MS)) == {0.0}
    assert arm.state.supervisor_state == CompositeState.HOLDING


def test_an_identical_repeat_does_not_restart_the_motion_under_way_or_after_its_end(arm):
    motion = trajectory(J, (0.3, [0.4], [0.0], [0.0]))
    number = arm.offer(motion)
    start = arm.now + MS

    def repeat(fence):
        # On one publisher the order is kept: when the last one is refused, the repeats have been seen.
        for _ in range(3):
            arm.publish_trajectory(motion)
        arm.refused(trajectory([fence], (1.0, [0.0])))

    arm.run(0.1)
    repeat("fence1")
    arm.run(0.1)
    repeat("fence2")
    arm.run(0.2)
    assert arm.state.supervisor_state == CompositeState.HOLDING
    repeat("fence3")
    samples = arm.run(0.05)
    assert arm.state.accepted_trajectory_id == number
    assert arm.state.supervisor_state == CompositeState.HOLDING
    follows(samples, start, profiles.quintic(0.0, 0.4, 0.3), 0.3)


@pytest.mark.parametrize("fields", (2, 3), ids=("positions, velocities", "and accelerations"))
@pytest.mark.parametrize("stamped", (True, False), ids=("explicit stamp", "stamp 0"))
def test_a_new_trajectory_takes_over_with_a_continuous_reference_velocity(arm, fields, stamped):
    def point(at, position):
        return (at, *([position], [0.0], [0.0])[:fields])

    first = arm.offer(trajectory(J, point(1.0, 0.5)))
    arm.pause(False)
    arm.bench.wait_for("the motion", lambda: arm.state.reference_velocity[0] > 0.5)
    arm.stand()
    assert arm.state.reference_velocity[0] > 0.5
    start = arm.now + 10 * MS if stamped else 0
    goal = arm.state.reference_position[0] + 0.1
    assert arm.offer(trajectory(J, point(0.3, goal), stamp=start)) == first + 1
    samples = arm.run(0.4)
    velocity = column(samples, "reference_velocity")
    acceleration = np.abs(column(samples, "reference_acceleration")).max()
    # By the stamps: on a depth of one a sample may be lost on its way here.
    slope = np.abs(np.diff(velocity) / (np.diff(list(samples)) * 1e-9))
    assert slope.max() <= 1.01 * acceleration < 50.0  # a restart from rest jumps by 500 rad/s^2
    assert arm.state.reference_position[0] == goal
    assert arm.state.supervisor_state == CompositeState.HOLDING


# Plans -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("stamp", [0, 500 * MS])
def test_a_plan_is_waited_for_until_the_motions_own_start_or_until_it_is_there(stamp):
    """By the arm's clock: one that stands still, as in lockstep, leaves all the time."""
    model = build(arm_file.load("two_link"))
    reference = ReferenceGenerator(model.joint_names)
    reference.start(np.zeros(2), 10 * MS)
    waited, offered = [], []

    class Designing:
        """Makes a plan for ever; the arm's clock goes on."""

        def prepare(self, feedforward, ahead, start, waits):
            for now in (20, 400, 469, 471, 600):
                reference.sample(now * MS)
                waited.append(waits())
            return SimpleNamespace(note="a plan is missing")

    noted = []
    logger = SimpleNamespace(warning=noted.append, info=noted.append)
    node = SimpleNamespace(
        active=True, hand_over=lambda _, *given: offered.append(given), get_logger=lambda: logger
    )
    core = SimpleNamespace(
        model=model,
        held=None,
        streaming=PLAIN,
        reference=reference,
        torque_allowed=np.full(2, np.inf),
    )
    inbox = TrajectoryInbox(node, core, Designing())
    message = trajectory(["joint1", "joint2"], (1.0, [0.1, 0.1]), stamp=stamp)
    inbox._read_and_prepare(serialize_message(message), SimpleNamespace(plans=True))
    inbox.close()
    assert waited == ([True] * 5 if stamp == 0 else [True, True, True, False, False])
    assert offered[0][1].note == "a plan is missing" and "a plan is missing" in noted[0]
