# SPDX-License-Identifier: Apache-2.0
"""The node `shaper` while it makes a time law in a thread: what moves goes on, and what is newer takes its place."""

from types import SimpleNamespace

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from in_process import InProcess
from rclpy.action import CancelResponse
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger
from test_shaper_nodes import Shaper, message, motion
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_control.nodes.shaping_job import AHEAD
from flexarm_control.shaping import time_law
from flexarm_control.shaping.piecewise import PiecewiseMotion
from flexarm_msgs.action import FollowJointTrajectory as Follow
from flexarm_msgs.msg import JointTolerance
from flexarm_ros.messages import set_stamp

RETIMED = {"shaper.type": "retimed", "shaper.frequencies": [4.0], "shaper.dampings": [0.02]}
PLAYS = {"play_trajectories": True, "stream_output": "commands"}


class Held:
    """In place of the node's threads: does its work when the test says so."""

    def __init__(self):
        self._work = []

    def submit(self, function, *args):
        self._work.append((function, args))

    def run(self):
        """Do all of it, the oldest first."""
        work, self._work = self._work, []
        for function, args in work:
            function(*args)

    def shutdown(self, wait=True, cancel_futures=False):
        self._work.clear()


class Slow(Shaper):
    """A node that retimes, on the bench's time, with a thread that is held."""

    def __init__(self, bench, **settings):
        super().__init__(bench, **{**RETIMED, **settings})
        self.node = bench.nodes["shaper"]
        self.node.now_ns = lambda: round(1e9 * (100.0 + bench.queue.time))
        self.thread = self.node.job._thread = Held()

    def made(self):
        """Have the thread do its work; what is passed on."""
        self.thread.run()
        self.settle()
        return self.out.messages

    def go_on(self, seconds):
        """Serve for some time."""
        end = self.bench.queue.time + seconds
        self.bench.wait_for("the time", lambda: self.bench.queue.time >= end)


def straight(*points):
    """A `JointTrajectory` of (time, position of a), b moves half as far the other way; straight, with a top speed."""
    out = JointTrajectory(joint_names=["a", "b"])
    (begin, first), (end, last) = points
    ramp = (end - begin) / 3.0
    speed = (last - first) / (2.0 * ramp)
    done = 0.5 * ramp * speed
    rows = [(begin, first, 0.0), (begin + ramp, first + done, speed)]
    rows += [(end - ramp, last - done, speed), (end, last, 0.0)]
    for time, position, velocity in rows:
        point = JointTrajectoryPoint()
        point.positions, point.velocities = [position, -0.5 * position], [velocity, -0.5 * velocity]
        set_stamp(point.time_from_start, round(time * 1e9))
        out.points.append(point)
    return out


@pytest.fixture
def bench():
    """The bench, without nodes."""
    with InProcess() as found:
        yield found


def test_nothing_is_passed_on_before_the_time_law_is_made_and_then_all_of_it(bench):
    shaper = Slow(bench)
    out, state = shaper.send(straight((0.0, 0.0), (1.0, 0.6)))
    shaper.go_on(0.5)
    assert not out and not state.moving
    (made,) = shaper.made()
    assert list(made.points[0].positions) == [0.0, 0.0]
    assert list(made.points[-1].positions) == [0.6, -0.3]
    state = shaper.states.newest
    assert state.moving
    assert state.added_time == pytest.approx(0.25 + 0.5, abs=0.02)  # a period, and the time waited


def test_a_newer_trajectory_takes_the_place_of_the_one_that_is_worked_on(bench):
    shaper = Slow(bench)
    shaper.send(straight((0.0, 0.0), (1.0, 0.6)))
    _, state = shaper.send(straight((0.0, 0.0), (1.0, 0.2)))
    assert "replaced by a newer trajectory" in state.rejected_reason
    (made,) = shaper.made()
    assert list(made.points[-1].positions) == [0.2, -0.1]
    assert shaper.states.newest.rejected_reason == ""
    assert shaper.states.newest.trajectory_id == 1


def test_a_stop_while_it_is_worked_on_drops_it(bench):
    shaper = Slow(bench)
    shaper.send(straight((0.0, 0.0), (1.0, 0.6)))
    assert bench.call(Trigger, "shaper/stop").message == "stops"
    assert not shaper.made()
    assert "stopped before it began" in shaper.states.newest.rejected_reason
    assert bench.call(Trigger, "shaper/stop").message == "nothing moves"


def test_a_motion_that_can_not_be_is_refused_from_the_thread_with_the_reason(bench):
    shaper = Slow(bench)
    shaper.send(message((0.5, 1.0, 1.0)))  # where it begins is unknown
    assert not shaper.made()
    assert "points[0].time_from_start" in shaper.states.newest.rejected_reason
    assert not shaper.node.job.busy


class Played(Slow):
    """The node plays positions; joints stand at 0."""

    def __init__(self, bench, **settings):
        super().__init__(bench, **{**PLAYS, **settings})
        self.stand(0.0, 0.0)
        self.commands = bench.tap(Float64MultiArray, "commands")
        self.send(straight((0.0, 0.0), (1.0, 0.6)))
        self.thread.run()
        self.settle()

    def stand(self, *positions):
        """Say where the joints are."""
        joints = self.bench.publisher(JointState, "joint_states")
        joints.publish(JointState(name=["a", "b"], position=list(positions)))

    def positions(self):
        """What joint a was commanded, (k,)."""
        return np.array([m.data[0] for m in self.commands.messages])


@pytest.mark.parametrize("in_time", [True, False])
def test_while_another_motion_is_made_the_old_one_is_played_and_the_change_is_no_step(
    bench, in_time
):
    shaper = Played(bench)
    shaper.go_on(0.4)
    old = shaper.node.core
    before = old.snapshot()
    shaper.send(straight((0.3, 0.5), (1.3, 0.2)))
    sent = shaper.node.now_ns()
    if in_time:
        shaper.made()
    shaper.go_on(0.9 * AHEAD / 1e9)
    played = shaper.node.core.state(shaper.node.now_ns())
    assert np.abs(played - before.state(shaper.node.now_ns())).max() == 0.0
    assert shaper.states.newest.trajectory_id == 1
    shaper.go_on(0.2 * AHEAD / 1e9)
    assert shaper.states.newest.trajectory_id == 2
    if not in_time:  # too late: it changes nothing any more
        before = shaper.node.core.state(sent + 2 * AHEAD)
        shaper.made()
        assert np.abs(shaper.node.core.state(sent + 2 * AHEAD) - before).max() == 0.0
    bench.wait_for("the end", lambda: not shaper.states.newest.moving)
    shaper.go_on(0.02)
    steps = np.diff(shaper.positions())
    assert np.abs(steps).max() < 1.5 * 0.9 / 125.0  # no more than the speed allows in a period
    assert shaper.positions()[-1] == pytest.approx(0.2, abs=1e-9)


@pytest.mark.parametrize("in_time", [True, False])
def test_a_stop_begins_in_time_whether_its_time_law_is_made_or_not(bench, in_time):
    shaper = Played(bench)
    shaper.go_on(0.4)
    assert bench.call(Trigger, "shaper/stop").message == "stops"
    if in_time:
        shaper.made()
    shaper.go_on(1.1 * AHEAD / 1e9)
    assert shaper.states.newest.stopped == "asked for by the service stop"
    bench.wait_for("the end", lambda: not shaper.states.newest.moving)
    shaper.go_on(0.02)
    assert shaper.positions()[-1] < 0.55
    assert np.abs(np.diff(shaper.positions())).max() < 1.2 * 0.9 / 125.0


def goal(node, msg, **tolerances):
    """Have the node take a goal; its handle and a list that gets its status and result."""
    ends = []
    request = Follow.Goal(trajectory=msg, **tolerances)
    handle = SimpleNamespace(request=request, is_cancel_requested=False)
    for name, status in (
        ("succeed", GoalStatus.STATUS_SUCCEEDED),
        ("abort", GoalStatus.STATUS_ABORTED),
        ("canceled", GoalStatus.STATUS_CANCELED),
    ):
        setattr(handle, name, lambda status=status: ends.append(status))
    handle.feedback = []
    handle.publish_feedback = handle.feedback.append
    server = SimpleNamespace(action_type=Follow, finish=lambda h, end: ends.append(end(h)))
    node._goals.take(server, handle)
    return handle, ends


def test_a_goal_that_is_cancelled_while_it_is_worked_on_ends_and_the_one_before_goes_on(bench):
    shaper = Played(bench)
    bench.wait_for("the end", lambda: not shaper.states.newest.moving)
    shaper.stand(0.6, -0.3)
    shaper.settle()
    first, ends = goal(shaper.node, straight((0.0, 0.6), (1.0, 0.1)))
    assert not ends and not first.feedback
    shaper.made()
    first_one, state = first.feedback[0], shaper.states.newest
    seconds = lambda stamp: stamp.sec + 1e-9 * stamp.nanosec  # noqa: E731
    assert first_one.header.stamp == state.start
    assert list(first_one.desired.positions) == [0.1, -0.05]
    lasts = seconds(first_one.desired.time_from_start)
    assert lasts == pytest.approx(seconds(state.end) - seconds(state.start), abs=1e-6)
    shaper.go_on(0.1)
    assert 0.0 < seconds(first.feedback[-1].desired.time_from_start) < 0.2
    second, refused = goal(shaper.node, straight((0.5, 0.4), (1.0, 0.1)))
    assert shaper.node._goals.may_cancel(second) == CancelResponse.ACCEPT
    second.is_cancel_requested = True
    shaper.settle()
    assert refused[0] == GoalStatus.STATUS_CANCELED
    assert "cancelled before it began" in refused[1].error_string
    shaper.made()
    bench.wait_for("the first goal's end", lambda: ends)
    assert ends[0] == GoalStatus.STATUS_SUCCEEDED
    assert shaper.positions()[-1] == pytest.approx(0.1, abs=1e-3)
    assert shaper.node._goals.may_cancel(first) == CancelResponse.REJECT


class Judged(Played):
    """A goal is played to 0.1 rad, without a shaper; the joints are reported `away` from where they should be."""

    def __init__(self, bench, away, speed=0.0, **tolerances):
        super().__init__(bench, **{"shaper.type": "none"})
        bench.wait_for("the end", lambda: not self.states.newest.moving)
        self.away, self.speed = away, speed
        self.report()
        self.settle()
        msg = message((0.0, 0.6, -0.3), (0.5, 0.1, -0.3))
        _, self.ends = goal(self.node, msg, **tolerances)

    def report(self):
        """Joint states now."""
        where = self.node.core.state(self.node.now_ns())[0]
        msg = JointState(name=["a", "b"], position=[where[0] + self.away, where[1]])
        msg.velocity = [self.speed, 0.0]
        self.bench.publisher(JointState, "joint_states").publish(msg)

    def result(self):
        """Status and result, with joint states all the time."""

        def ended():
            self.report()
            return self.ends

        return self.bench.wait_for("the result", ended)


def tolerance(position=0.0, velocity=0.0):
    return [JointTolerance(name="a", position=position, velocity=velocity)]


def test_a_played_goal_ends_once_its_joints_are_within_its_tolerances(bench):
    judged = Judged(bench, 0.02, goal_tolerance=tolerance(0.01, 0.05))
    bench.wait_for("the motion's end", lambda: judged.report() or not judged.states.newest.moving)
    judged.go_on(0.1)
    assert not judged.ends
    judged.away, judged.speed = 0.005, 0.1
    judged.report()
    judged.go_on(0.1)
    assert not judged.ends
    judged.speed = 0.01
    status, found = judged.result()
    assert (status, found.error_code) == (GoalStatus.STATUS_SUCCEEDED, Follow.Result.SUCCESSFUL)


@pytest.mark.parametrize(
    ("tolerances", "code", "text"),
    [
        (
            {"goal_tolerance": tolerance(0.01), "goal_time_tolerance": Duration(nanosec=10**8)},
            Follow.Result.GOAL_TOLERANCE_VIOLATED,
            "a is off by 0.02 rad, 0.01 rad are allowed",
        ),
        ({"path_tolerance": tolerance(0.01)}, Follow.Result.PATH_TOLERANCE_VIOLATED, "path tolerance"),
        ({"tip_tolerance": 0.1}, Follow.Result.INVALID_GOAL, "tip_tolerance"),
        (
            {"path_tolerance": [JointTolerance(name="x", position=1.0)]},
            Follow.Result.INVALID_JOINTS,
            "path_tolerance[0].name",
        ),
    ],
)  # fmt: skip
def test_a_played_goal_beyond_its_tolerances_is_aborted_with_the_joint_and_the_limit(
    bench, tolerances, code, text
):
    judged = Judged(bench, 0.02, **tolerances)
    status, found = judged.result()
    assert (status, found.error_code) == (GoalStatus.STATUS_ABORTED, code)
    assert text in found.error_string
    bench.wait_for("rest", lambda: not judged.states.newest.moving)
    on_the_way = code == Follow.Result.PATH_TOLERANCE_VIOLATED
    assert ("path tolerance" in judged.states.newest.stopped) == on_the_way


def test_a_played_goal_with_tolerances_and_no_joint_states_is_aborted(bench):
    judged = Judged(bench, 0.0, goal_tolerance=tolerance(0.01))
    judged.node._measured_at = -np.inf  # they have not come for long
    bench.wait_for("the result", lambda: judged.ends)
    assert "can't be judged" in judged.ends[1].error_string


def test_without_new_time_laws_nothing_waits_for_a_thread(bench, monkeypatch):
    shaper = Slow(bench, **{"shaper.type": "zvd"})
    monkeypatch.setattr(time_law, "retimed", None)
    out, _ = shaper.send(straight((0.0, 0.0), (1.0, 0.6)))
    assert isinstance(motion_of(out[0]), PiecewiseMotion)


def motion_of(msg):
    """As `motion`, of points without accelerations."""
    for point in msg.points:
        point.accelerations = [0.0] * len(point.positions)
    return motion(msg)


def test_a_node_that_ends_in_the_middle_of_the_work_leaves_nothing_behind(bench):
    shaper = Slow(bench)
    shaper.send(straight((0.0, 0.0), (1.0, 0.6)))
    node = shaper.node
    node.stop()
    assert not node.job.busy
    assert "the shaper was stopped" in node._state.rejected_reason
