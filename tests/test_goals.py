# SPDX-License-Identifier: Apache-2.0
"""Trajectories as action goals, over real DDS: results, feedback, cancelling, replacing, and what goes wrong."""

import os
import time

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from harness import Arm, Bench
from rclpy.action import ActionClient
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_msgs.action import FollowJointTrajectory as Follow
from flexarm_msgs.msg import CompositeState, JointTolerance
from flexarm_ros.messages import set_stamp

R = Follow.Result
LINE = {"arm": "R", "lockstep": True, "pause_at": -1.0, "rate": 500.0, "design_process": False}
#: Random goals; FLEXARM_GOALS=100 for more, FLEXARM_SEED for others.
SENT = int(os.environ.get("FLEXARM_GOALS", "7"))
SEED = int(os.environ.get("FLEXARM_SEED", "0"))


def trajectory(*points, joints=("joint1",), stamp_ns=0):
    """A `JointTrajectory` of (time, position) with quintics from rest to rest."""
    message = JointTrajectory(joint_names=list(joints))
    set_stamp(message.header.stamp, stamp_ns)
    for seconds, position in points:
        point = JointTrajectoryPoint(positions=[position], velocities=[0.0], accelerations=[0.0])
        set_stamp(point.time_from_start, round(seconds * 1e9))
        message.points.append(point)
    return message


class Client:
    """An action client of a bench."""

    def __init__(self, bench, name="controller/follow_trajectory", kind=Follow):
        self.bench, self.kind = bench, kind
        self.client = ActionClient(bench.node, kind, name)
        bench.wait_for("the action server", self.client.server_is_ready)

    def send(self, message, **fields):
        """Send a goal; its handle once it is accepted, and the feedback that comes."""
        feedback = []
        futures, again = [], 0.0

        def answered():
            nonlocal again
            # A server that has not found the client yet drops its answer; a busy one takes seconds.
            if time.monotonic() > again:
                again = time.monotonic() + 10.0
                futures.append(
                    self.client.send_goal_async(
                        self.kind.Goal(trajectory=message, **fields),
                        feedback_callback=lambda m: feedback.append(m.feedback),
                    )
                )
            return next((f.result() for f in futures if f.done()), None)

        return self.bench.wait_for("the goal's answer", answered), feedback

    def result(self, handle):
        """Status and result of a goal."""
        future = handle.get_result_async()
        self.bench.wait_for("the result", future.done)
        return future.result().status, future.result().result

    def follow(self, message, **fields):
        """Send a goal and wait; status and result."""
        handle, _ = self.send(message, **fields)
        assert handle.accepted
        return self.result(handle)


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """Arm R in lockstep, running, with the action server."""
    with Bench(tmp_path_factory.mktemp("log")) as bench:
        bench.start_loop(**LINE)
        bench.start("goals", {"arm": "R", "state_timeout": 5.0})
        arm = Arm(bench)
        arm.wait_ready()
        client = Client(bench)
        yield bench, arm, client
        client.client.destroy()


def home(line):
    """Bring the arm back to zero, at rest, whatever a test has left."""
    bench, arm, client = line
    arm.recover()
    bench.wait_for("torque", arm.ready)
    assert client.follow(trajectory((1.0, 0.0)))[1].error_code == R.SUCCESSFUL
    # States come on another topic, later than the result: no test may take one of this motion for its own.
    bench.wait_for("zero", lambda: abs(arm.state.reference_position[0]) < 1e-9)


def test_a_goal_succeeds_when_the_tip_rests_and_not_when_the_joints_are_there(line):
    home(line)
    _, arm, client = line
    handle, feedback = client.send(trajectory((1.0, 0.3)))
    status, result = client.result(handle)
    assert (status, result.error_code) == (GoalStatus.STATUS_SUCCEEDED, R.SUCCESSFUL)
    assert 0.0 < result.tip_swing <= 1e-3 * 1.2192
    assert feedback and feedback[-1].joint_names == ["joint1"]
    actual = [f.actual.positions[0] for f in feedback]
    assert max(actual) <= 0.35 and abs(arm.state.reference_position[0] - 0.3) < 1e-9
    assert all(
        np.isclose(f.desired.positions[0] - f.actual.positions[0], f.error.positions[0])
        for f in feedback
    )


def test_a_tip_that_may_not_swing_at_all_is_waited_for_until_the_time_is_over(line):
    home(line)
    _, _, client = line
    message = trajectory((0.6, 0.05))
    limits = {"tip_tolerance": 1e-12}
    goal_time = Follow.Goal().goal_time_tolerance
    goal_time.sec = 1
    status, result = client.follow(message, goal_time_tolerance=goal_time, **limits)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, R.GOAL_TOLERANCE_VIOLATED)
    assert "goal_time_tolerance of 1 s is over: the tip swings by" in result.error_string


@pytest.mark.parametrize(
    ("message", "code", "text"),
    [
        (trajectory((1.0, 0.1), joints=["elbow"]), R.INVALID_JOINTS, "elbow"),
        (trajectory((1.0, float("nan"))), R.INVALID_GOAL, "points[0].positions"),
        (trajectory(), R.INVALID_GOAL, "points"),
        (trajectory((1.0, 0.1), stamp_ns=1), R.OLD_HEADER_TIMESTAMP, "in the past"),
        (trajectory((0.05, 3.0)), R.INVALID_GOAL, "more than the torque limit"),
    ],
    ids=["joints", "NaN", "empty", "past", "too fast"],
)
def test_what_the_controller_refuses_is_aborted_with_its_reason(line, message, code, text):
    status, result = line[2].follow(message)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, code)
    assert text in result.error_string


def test_a_tolerance_of_a_joint_that_there_is_not_is_refused(line):
    tolerance = [JointTolerance(name="elbow", position=0.1)]
    status, result = line[2].follow(trajectory((1.0, 0.1)), goal_tolerance=tolerance)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, R.INVALID_JOINTS)
    assert "goal_tolerance[0].name: 'elbow' is no joint of this arm" in result.error_string


def test_a_violated_path_tolerance_stops_the_arm(line):
    home(line)
    bench, arm, client = line
    tolerance = [JointTolerance(name="joint1", position=1e-5)]
    status, result = client.follow(trajectory((2.0, 0.8)), path_tolerance=tolerance)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, R.PATH_TOLERANCE_VIOLATED)
    assert "path tolerance violated: joint1 is off by" in result.error_string
    bench.wait_for("rest", lambda: arm.state.supervisor_state == CompositeState.HOLDING)
    assert abs(arm.state.reference_position[0]) < 0.8


def test_a_cancelled_goal_is_canceled_once_the_arm_has_stopped(line):
    home(line)
    bench, arm, client = line
    handle, _ = client.send(trajectory((60.0, 0.8)))
    bench.wait_for("motion", lambda: arm.state.reference_position[0] > 1e-6)
    handle.cancel_goal_async()
    status, result = client.result(handle)
    assert status == GoalStatus.STATUS_CANCELED
    assert result.error_string == "cancelled: the arm was stopped"
    # The result is on another topic than the state.
    bench.wait_for("rest", lambda: arm.state.supervisor_state == CompositeState.HOLDING)
    assert 0.0 < arm.state.reference_position[0] < 0.8


def test_a_goal_that_is_replaced_has_a_result(line):
    home(line)
    bench, arm, client = line
    first, _ = client.send(trajectory((60.0, 0.8)))
    bench.wait_for("motion", lambda: arm.state.supervisor_state == CompositeState.TRACKING)
    second, _ = client.send(trajectory((60.0, 0.1)))
    status, result = client.result(first)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, R.INVALID_GOAL)
    assert result.error_string == "replaced by a newer goal"
    bench.wait_for("the second", lambda: arm.state.supervisor_state == CompositeState.TRACKING)
    arm.publish_trajectory(trajectory((2.0, 0.0)))
    status, result = client.result(second)
    assert (status, result.error_string) == (
        GoalStatus.STATUS_ABORTED,
        "replaced by a newer trajectory",
    )


def test_a_stop_and_a_fault_abort_with_the_controllers_own_reason(line):
    home(line)
    bench, arm, client = line
    handle, _ = client.send(trajectory((60.0, 0.8)))
    bench.wait_for("motion", lambda: arm.state.supervisor_state == CompositeState.TRACKING)
    assert bench.call(Trigger, "controller/stop").success
    status, result = client.result(handle)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, R.PATH_TOLERANCE_VIOLATED)
    assert result.error_string == "~/stop was called"
    home(line)
    handle, _ = client.send(trajectory((60.0, 0.8)))
    bench.wait_for("motion", lambda: arm.state.supervisor_state == CompositeState.TRACKING)
    assert bench.call(Trigger, "simulator/reset").success
    status, result = client.result(handle)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, R.PATH_TOLERANCE_VIOLATED)
    assert "restarted during a motion" in result.error_string


#: What becomes of a random goal: how often, and the status and code that it may end with besides its success.
FATES = {
    "wait": (4, ()),
    "cancel": (4, ((GoalStatus.STATUS_CANCELED, R.SUCCESSFUL),)),
    "replace": (4, ((GoalStatus.STATUS_ABORTED, R.INVALID_GOAL),)),
    "path tolerance": (2, ((GoalStatus.STATUS_ABORTED, R.PATH_TOLERANCE_VIOLATED),)),
    "tip tolerance": (2, ((GoalStatus.STATUS_ABORTED, R.GOAL_TOLERANCE_VIOLATED),)),
    "stop": (2, ((GoalStatus.STATUS_ABORTED, R.PATH_TOLERANCE_VIOLATED),)),
    "kill": (1, ((GoalStatus.STATUS_ABORTED, R.PATH_TOLERANCE_VIOLATED),)),
}
#: These can't succeed: no arm is within such a tolerance.
NEVER = ("path tolerance", "tip tolerance")


def random_goal(rng, position, fate):
    """A motion within the arm's torque from where it is about to be, and its tolerances."""
    to = position + rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.4)
    to = to if abs(to) < 0.8 else to - 2.0 * np.sign(to) * 0.4
    fields = {}
    if fate == "path tolerance":
        fields["path_tolerance"] = [JointTolerance(name="joint1", position=1e-6)]
    if fate == "tip tolerance":
        second = Follow.Goal().goal_time_tolerance
        second.nanosec = 300_000_000
        fields = {"tip_tolerance": 1e-12, "goal_time_tolerance": second}
    return trajectory((rng.uniform(1.0, 2.0), to)), fields


def meet(bench, arm, handle, fate, name):
    """What happens to a goal in the middle of its motion."""
    if fate == "cancel":
        handle.cancel_goal_async()
    elif fate == "stop":
        assert bench.call(Trigger, "controller/stop").success
    elif fate == "kill":
        bench.kill(name)


def restart(bench, arm, name):
    """Start a killed node again, and get the torque back."""
    bench.start(name, LIVES[name])
    seen = len(arm.states.messages)

    def back():
        if len(arm.states.messages) <= seen:  # the newest one is from before
            return False
        if not arm.ready():
            arm.recover()
        return arm.ready()

    bench.wait_for("the loop", back)
    arm.wait_ready()


#: Short patience: killed nodes are noticed soon, in the wall clock's time.
LIVES = {
    "simulator": LINE,
    "observer": LINE,
    "controller": {**LINE, "state_timeout": 1.0},
}


@pytest.mark.long
def test_random_goals_with_cancel_preemption_tolerances_and_kills_always_have_the_right_result(
    tmp_path,
):
    """Each ends with the status and the code of its fate; none is left, and the arm can go on."""
    rng = np.random.default_rng(SEED)
    names, weights = list(FATES), np.array([often for often, _ in FATES.values()], float)
    # One of each, whatever their number; then at random.
    fates = [*names, *rng.choice(names, max(SENT - len(names), 0), p=weights / weights.sum())]
    with Bench(tmp_path) as bench:
        for name, values in LIVES.items():
            bench.start(name, values)
        bench.start("goals", {"arm": "R", "state_timeout": 2.0})
        arm = Arm(bench)
        arm.wait_ready()
        client, waiting, counts = Client(bench), [], {}

        def judge(handle, fate):
            status, result = client.result(handle)
            allowed = (
                FATES[fate][1]
                if fate in NEVER
                else ((GoalStatus.STATUS_SUCCEEDED, R.SUCCESSFUL), *FATES[fate][1])
            )
            reported = f"{fate}: {status}, {result.error_code}: {result.error_string}"
            assert (status, result.error_code) in allowed, reported
            counts[fate, status] = counts.get((fate, status), 0) + 1

        for fate in fates:
            message, fields = random_goal(rng, arm.state.reference_position[0], fate)
            handle, _ = client.send(message, **fields)
            assert handle.accepted
            wanted = arm.now + round(rng.uniform(0.0, 0.6) * 1e9)
            bench.wait_for("a while", lambda wanted=wanted: arm.now > wanted)
            for before in waiting:  # replaced by now
                judge(*before)
            waiting = [(handle, fate)]
            killed = str(rng.choice(list(LIVES)))
            meet(bench, arm, handle, fate, killed)
            if fate != "replace":
                judge(*waiting.pop())
            if fate == "kill":
                restart(bench, arm, killed)
        for last in waiting:
            judge(*last)
        print(counts)
        assert sum(counts.values()) == len(fates)
        assert client.follow(trajectory((2.0, 0.0)))[1].error_code == R.SUCCESSFUL
        client.client.destroy()


def test_without_a_controller_a_goal_is_aborted(tmp_path):
    with Bench(tmp_path) as bench:
        bench.start("goals", {"arm": "R", "state_timeout": 0.1})
        client = Client(bench)
        status, result = client.follow(trajectory((1.0, 0.1)))
        assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, R.INVALID_GOAL)
        assert "the controller has not answered for 0.5 s" in result.error_string
        client.client.destroy()


@pytest.mark.long
def test_where_control_msgs_is_installed_its_action_is_served_too(tmp_path, monkeypatch):
    """A stand-in of that name, with our own action: the wheels have no control_msgs."""
    package = tmp_path / "control_msgs" / "action"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").touch()
    (package / "__init__.py").write_text("from flexarm_msgs.action import FollowJointTrajectory\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    with Bench(tmp_path / "log") as bench:
        bench.start_loop(**LINE)
        bench.start("goals", {"arm": "R"})
        arm = Arm(bench)
        arm.wait_ready()
        client = Client(bench, "controller/follow_joint_trajectory")
        status, result = client.follow(trajectory((0.5, 0.01)))
        assert (status, result.error_code) == (GoalStatus.STATUS_SUCCEEDED, R.SUCCESSFUL)
        client.client.destroy()


def test_a_goal_whose_loop_is_killed_has_a_result(tmp_path):
    with Bench(tmp_path) as bench:
        for name, values in LIVES.items():
            bench.start(name, values)
        bench.start("goals", {"arm": "R", "state_timeout": 2.0})
        arm = Arm(bench)
        arm.wait_ready()
        client = Client(bench)
        reasons = {
            "controller": "no controller/state for 2 s",
            "simulator": "no arm_state_estimate for 1 s",
        }
        for killed, text in reasons.items():
            if killed != "controller":
                restart(bench, arm, "controller")
            handle, _ = client.send(trajectory((60.0, 0.8)))
            bench.wait_for("motion", lambda: arm.state.supervisor_state == CompositeState.TRACKING)
            bench.kill(killed)
            status, result = client.result(handle)
            aborted = GoalStatus.STATUS_ABORTED, R.PATH_TOLERANCE_VIOLATED
            assert (status, result.error_code) == aborted
            assert text in result.error_string
        client.client.destroy()
