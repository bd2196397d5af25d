# SPDX-License-Identifier: Apache-2.0
"""The node `shaper`: trajectories, streams, bypass and stop in this process; goals over DDS."""

import time

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from harness import Bench
from in_process import InProcess
from rclpy.action import ActionClient, ActionServer
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_control.motions import shapers
from flexarm_control.shaping import strain_damping
from flexarm_control.shaping.piecewise import PiecewiseMotion
from flexarm_dynamics.errors import DesignError, ParameterError
from flexarm_msgs.action import FollowJointTrajectory as Follow
from flexarm_msgs.msg import ShaperState
from flexarm_ros.messages import set_stamp, stamp_ns

OUT = "arm_controller/joint_trajectory"
SETTINGS = {
    "joint_names": ["a", "b"],
    "output": "arm_controller",
    "shaper.type": "zvd",
    "shaper.frequencies": [4.0],
    "shaper.dampings": [0.02],
}


def message(*points, joints=("a", "b"), start_ns=0):
    """A `JointTrajectory` of (time, position of a, position of b), at rest in each point."""
    out = JointTrajectory(joint_names=list(joints))
    set_stamp(out.header.stamp, start_ns)
    for seconds, *positions in points:
        still = [0.0] * len(positions)
        point = JointTrajectoryPoint(positions=positions, velocities=still, accelerations=still)
        set_stamp(point.time_from_start, round(seconds * 1e9))
        out.points.append(point)
    return out


def motion(msg):
    """What a controller makes of a message, from its first point."""
    times = np.array([stamp_ns(p.time_from_start) for p in msg.points]) / 1e9
    fields = ("positions", "velocities", "accelerations")
    return PiecewiseMotion.through(
        times, [np.array([getattr(p, f) for p in msg.points]) for f in fields]
    )


THERE = message((0.0, 0.0, 0.0), (1.0, 0.6, -0.3))


class Shaper:
    """The node in this process."""

    def __init__(self, bench, **settings):
        self.bench = bench
        bench.start("shaper", {**SETTINGS, **settings})
        self.out = bench.tap(JointTrajectory, OUT)
        self.states = bench.tap(ShaperState, "shaper/state")
        self.input = bench.publisher(JointTrajectory, "joint_trajectory")

    def settle(self):
        """Have all messages delivered that are on their way."""
        while self.bench.queue.busy:
            self.bench.queue.serve()

    def send(self, msg):
        """Publish a trajectory; what the node has passed on since, and its newest state."""
        self.settle()
        self.out.messages.clear()
        self.input.publish(msg)
        self.settle()
        return self.out.messages, self.states.newest


@pytest.fixture
def bench():
    """The bench, without nodes."""
    with InProcess() as found:
        yield found


def test_a_trajectory_is_passed_on_shaped_with_its_start_end_and_cost_in_the_state(bench):
    out, state = Shaper(bench).send(message((0.0, -0.3, 0.6), (1.0, 0.3, 0.0), joints=("b", "a")))
    (shaped,) = out
    assert shaped.joint_names == ["a", "b"]
    assert stamp_ns(shaped.header.stamp) == 0
    train = shapers.impulses("zvd", 4.0, 0.02)
    given = motion(message((0.0, 0.6, -0.3), (1.0, 0.0, 0.3)))
    t = np.linspace(0.0, 1.4, 300)
    assert np.abs(motion(shaped).position(t) - train.apply(given).position(t)).max() < 1e-6
    assert list(shaped.points[-1].positions) == [0.0, 0.3]
    assert state.moving
    assert state.trajectory_id == 1
    assert state.added_time == pytest.approx(train.duration, abs=1e-6)
    span = stamp_ns(state.end) - stamp_ns(state.start)
    assert span / 1e9 == pytest.approx(1.0 + train.duration, abs=1e-6)
    assert state.rejected_reason == ""


MALFORMED = (
    (message((0.0, 0.0), joints=("a",)), "joint_names: 'b' is missing"),
    (message((0.0, 0.0, 0.0), joints=("a", "x")), "joint_names: 'x' is no joint"),
    (message((0.0, 0.0)), "points[0].positions: 1 is the wrong number"),
    (message((0.0, 0.0, np.nan)), "points[0].positions of joint b: nan rad is not finite"),
    (message((1.0, 0.0, 0.0), (0.5, 0.0, 0.0)), "points[1].time_from_start: 0.5 s is not later"),
    (message((0.5, 1.0, 1.0)), "points[0].time_from_start: 0.5 s is after the start"),
    (message((0.0, 0.0, 0.0), start_ns=7), "header.stamp"),
)


def test_malformed_trajectories_are_refused_with_the_reason_and_nothing_is_passed_on(bench):
    shaper = Shaper(bench)
    for msg, problem in MALFORMED:
        out, state = shaper.send(msg)
        assert not out
        assert problem in state.rejected_reason
        assert not state.moving
    out, state = shaper.send(THERE)
    assert len(out) == 1
    assert state.rejected_reason == ""


def test_a_stop_and_a_trajectory_without_points_end_the_motion_smoothly(bench):
    shaper = Shaper(bench)
    shaper.send(THERE)
    assert bench.call(Trigger, "shaper/stop").message == "stops"
    bench.wait_for("the stop", lambda: len(shaper.out.messages) == 2)
    stop = shaper.out.messages[-1]
    assert stamp_ns(stop.header.stamp) > 0
    assert not any(stop.points[-1].velocities)
    assert shaper.states.newest.stopped == "asked for by the service stop"
    (again,), state = shaper.send(message())
    assert again.points
    assert "without points" in state.stopped


def test_measured_positions_are_where_a_trajectory_without_a_first_point_begins(bench):
    shaper = Shaper(bench)
    joints = bench.publisher(JointState, "joint_states")
    joints.publish(JointState(name=["b"], position=[7.0]))
    joints.publish(JointState(name=["b", "a"], position=[7.0]))
    joints.publish(JointState(name=["b", "a"], position=[np.nan, 0.0]))
    joints.publish(JointState(name=["b", "x", "a"], position=[0.2, 9.0, 0.1]))
    out, _ = shaper.send(message((1.0, 0.5, 0.5)))
    assert list(out[0].points[0].positions) == [0.1, 0.2]
    log = bench.log("shaper")
    assert "1 positions of 2 names are ignored" in log
    assert "a position is not finite" in log


def test_bypass_passes_on_what_comes_and_waits_for_the_end_of_a_motion(bench):
    shaper = Shaper(bench)
    assert bench.call(SetBool, "shaper/bypass", data=True).message == "bypassed"
    out, state = shaper.send(THERE)
    assert state.bypassed
    assert len(out[0].points) == 2
    assert state.added_time == 0.0
    answer = bench.call(SetBool, "shaper/bypass", data=False)
    assert "once the motion that is under way has ended" in answer.message


def test_limits_are_kept_by_a_slower_motion(bench):
    limits = {"limits.velocity": [0.5], "limits.acceleration": [2.0, 3.0]}
    out, state = Shaper(bench, **limits).send(THERE)
    assert state.stretch > 1.5
    found = motion(out[0])
    assert np.abs(found.velocity(np.linspace(0.0, found.duration, 999))).max() < 0.501


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"joint_names": [""]}, "joint_names: is empty"),
        ({"shaper.type": "zzz"}, "shaper.type: 'zzz' is not one of the choices"),
        ({"shaper.configurations": [0.1]}, "shaper.configurations: 1 values are no rows of 2"),
        ({"limits.velocity": [1.0, 2.0, 3.0]}, "limits.velocity: 3 values where 2"),
    ],
)
def test_parameters_that_can_not_be_used_keep_the_node_from_starting(bench, settings, problem):
    with pytest.raises((AssertionError, ParameterError)) as refused:
        bench.start("shaper", {**SETTINGS, **settings})
    assert problem in str(refused.value)


def set_at(node, **values):
    """Set parameters of a node all together; what it answers."""
    return node.set_parameters_atomically([Parameter(k, value=v) for k, v in values.items()])


def test_type_and_modes_change_at_the_next_rest_and_what_does_not_fit_is_refused(bench):
    shaper = Shaper(bench)
    node = bench.nodes["shaper"]
    refused = set_at(node, **{"shaper.frequencies": [4.0, 9.0], "shaper.dampings": [0.1, 0.1, 0.1]})
    assert not refused.successful
    assert "shaper.dampings: 3 values" in refused.reason
    assert list(node.get_parameter("shaper.frequencies").value) == [4.0]
    _, state = shaper.send(THERE)
    before = state.added_time
    assert set_at(node, **{"shaper.type": "zv", "shaper.frequencies": [2.0]}).successful
    shaper.settle()
    assert shaper.states.newest.shaper == "zvd"  # the motion is under way
    end = stamp_ns(state.end)
    node.now_ns = lambda: end + 1
    bench.wait_for("the change", lambda: shaper.states.newest.shaper == "zv")
    _, state = shaper.send(message((0.0, 0.6, -0.3), (1.0, 0.0, 0.0)))
    assert before == pytest.approx(1.0 / 4.0, rel=1e-2)
    assert state.added_time == pytest.approx(0.5 / 2.0, rel=1e-2)


def test_a_path_without_times_gets_the_quickest_time_law_within_the_limits(bench):
    limits = {"limits.velocity": [1.0], "limits.acceleration": [5.0]}
    shaper = Shaper(bench, **{"time_law": "time_optimal", **limits, "shaper.type": "none"})
    (out,), state = shaper.send(message((0.0, 0.0, 0.0), (0.0, 0.6, -0.3), (0.0, 1.2, 0.0)))
    assert state.rejected_reason == ""
    assert 1.4 < stamp_ns(out.points[-1].time_from_start) / 1e9 < 2.2
    assert list(out.points[-1].positions) == [1.2, 0.0]
    speeds = np.array([p.velocities for p in out.points])
    assert 0.95 < np.abs(speeds).max() < 1.001


def test_a_stream_of_positions_is_shaped_and_malformed_inputs_are_ignored(bench):
    topic = "forward_position_controller/commands"
    shaper = Shaper(bench, stream_output=topic, stream_rate=500.0)
    commands = bench.tap(Float64MultiArray, topic)
    stream = bench.publisher(Float64MultiArray, "stream")
    stream.publish(Float64MultiArray(data=[0.0, 0.0]))
    bench.wait_for("a command", lambda: commands.messages)
    for bad in ([1.0], [np.nan, 0.0], []):
        stream.publish(Float64MultiArray(data=bad))
    stream.publish(Float64MultiArray(data=[0.4, -0.2]))
    bench.wait_for("the end", lambda: commands.newest.data[0] == pytest.approx(0.4))
    seen = len(commands.messages)
    bench.wait_for("more", lambda: len(commands.messages) > seen + 10)
    values = np.array([m.data for m in commands.messages])
    assert np.isfinite(values).all()
    steps, counts = np.unique(values[:, 0].round(9), return_counts=True)
    # ZVD: 1, 2 K, K^2 of a step, with hardly any damping; from one to the next over a sample.
    assert steps[0] == 0.0
    assert steps[counts > 5][-3:] == pytest.approx([0.1, 0.3, 0.4], abs=0.02)
    assert "stream: data: 1 values" in bench.log("shaper")
    assert shaper.bench is bench


def test_a_stream_of_velocities_ends_when_its_source_is_silent(bench):
    settings = {"stream_output": "commands", "stream_kind": "velocities", "stream_timeout": 0.05}
    Shaper(bench, **settings)
    commands = bench.tap(Float64MultiArray, "commands")
    stream = bench.publisher(Float64MultiArray, "stream")
    stream.publish(Float64MultiArray(data=[0.5, 0.1]))
    bench.wait_for("commands", lambda: commands.messages and commands.newest.data[0] > 0.1)
    # The steady clock is that of the machine.
    silent = time.monotonic() + 0.06
    bench.wait_for("the timeout", lambda: time.monotonic() > silent, patience=np.inf)
    bench.wait_for("rest", lambda: not any(commands.newest.data), patience=3.0)


#: Of the mode that the damping of the tests is made for: its frequency, and what the strain is of a joint's velocity.
FREQUENCY, SENSITIVITY = 3.0, 0.04
DAMPING = {
    "stream_output": "commands",
    "damping.joint": "b",
    "damping.gauge": 1,
    "damping.frequency": FREQUENCY,
    "damping.sensitivity": SENSITIVITY,
    "damping.phase": 1.57,
    "damping.target": 0.1,
}


def test_a_push_is_damped_in_the_stream_by_strain_until_the_sensor_is_silent(bench):
    Shaper(bench, **DAMPING)
    node = bench.nodes["shaper"]
    node.now_ns = lambda: round(1e9 * bench.queue.time)
    commands = bench.tap(Float64MultiArray, "commands")
    strain = bench.publisher(Float64MultiArray, "strain")
    bench.publisher(Float64MultiArray, "stream").publish(Float64MultiArray(data=[0.2, 0.1]))
    swing, p = 1e-3 + 0j, strain_damping.pole(FREQUENCY, 0.005)

    def periods(count, sensor=True):
        nonlocal swing
        found = []
        for _ in range(count):
            if sensor:
                strain.publish(Float64MultiArray(data=[7.0, swing.real]))
            seen = len(commands.messages)
            bench.wait_for("a command", lambda seen=seen: len(commands.messages) > seen)
            found.append(commands.newest.data)
            u = found[-1][1] - 0.1
            swing = strain_damping.moved(swing, p, 1j * SENSITIVITY, u, 0.008)
        return np.array(found)

    found = periods(250)
    free = 1e-3 * np.exp(p.real * 2.0)
    assert abs(swing) < 0.3 * free
    assert set(found[:, 0]) == {0.2}
    corrections = found[:, 1] - 0.1
    assert 1e-3 < np.abs(corrections).max() <= 0.02
    swing = 1e-3 + 0j
    periods(20)
    strain.publish(Float64MultiArray(data=[1.0]))
    gone = periods(60, sensor=False)
    assert gone[-1, 1] == 0.1
    assert "no reading 1" in bench.log("shaper")
    _, text, values = node.diagnose()
    assert text == "no damping: the sensor is silent"
    assert values["damping"] == "off: the sensor is silent"


def test_a_push_is_damped_in_a_stream_of_velocities_and_the_joint_comes_back(bench):
    Shaper(bench, **DAMPING, stream_kind="velocities", stream_timeout=60.0)
    node = bench.nodes["shaper"]
    node.now_ns = lambda: round(1e9 * bench.queue.time)
    commands = bench.tap(Float64MultiArray, "commands")
    strain = bench.publisher(Float64MultiArray, "strain")
    bench.publisher(Float64MultiArray, "stream").publish(Float64MultiArray(data=[0.0, 0.0]))
    swing, p = 1e-3 + 0j, strain_damping.pole(FREQUENCY, 0.005)
    away, largest = 0.0, 0.0
    for _ in range(500):
        strain.publish(Float64MultiArray(data=[7.0, swing.real]))
        seen = len(commands.messages)
        bench.wait_for("a command", lambda seen=seen: len(commands.messages) > seen)
        other, rate = commands.newest.data
        assert other == 0.0
        assert abs(rate) <= 0.5
        away += 0.008 * rate
        largest = max(largest, abs(away))
        swing = strain_damping.moved(swing, p, 1j * SENSITIVITY, away, 0.008)
    assert abs(swing) < 0.1 * 1e-3 * np.exp(p.real * 4.0)
    assert 1e-3 < largest < 0.021
    assert abs(away) < 0.05 * largest


IMU = {
    **DAMPING,
    "damping.sensor": "imu",
    "damping.axis": "z",
    "damping.full_scale": 40.0,
    "damping.sensitivity": SENSITIVITY * (2.0 * np.pi * FREQUENCY) ** 2,
    "damping.phase": 1.57 - np.pi,
}


@pytest.mark.parametrize(
    ("value", "late", "problem"),
    [
        (np.nan, 0.0, "not finite"),
        (50.0, 0.0, "beyond its full scale"),
        (9.81, 0.5, "not of now"),
        (9.81, None, "not of now"),
    ],
)
def test_a_push_is_damped_by_an_imu_until_it_is_in_doubt(bench, value, late, problem):
    Shaper(bench, **IMU)
    node = bench.nodes["shaper"]
    node.now_ns = lambda: round(1e9 * (100.0 + bench.queue.time))
    commands = bench.tap(Float64MultiArray, "commands")
    imu = bench.publisher(Imu, "imu")
    bench.publisher(Float64MultiArray, "stream").publish(Float64MultiArray(data=[0.2, 0.1]))
    swing, p = 1e-3 + 0j, strain_damping.pole(FREQUENCY, 0.005)

    def period(acceleration, stamp_ns):
        nonlocal swing
        msg = Imu()
        msg.linear_acceleration.z = float(acceleration)
        set_stamp(msg.header.stamp, stamp_ns)
        imu.publish(msg)
        seen = len(commands.messages)
        bench.wait_for("a command", lambda: len(commands.messages) > seen)
        u = commands.newest.data[1] - 0.1
        swing = strain_damping.moved(swing, p, 1j * SENSITIVITY, u, 0.008)
        return u

    for _ in range(200):
        period(9.81 - swing.real * abs(p) ** 2, node.now_ns())
    assert abs(swing) < 0.4e-3
    swing, stuck = 1e-3 + 0j, node.now_ns()
    for _ in range(20):
        period(9.81 - swing.real * abs(p) ** 2, node.now_ns())
    for _ in range(60):
        u = period(value, stuck if late is None else node.now_ns() - round(1e9 * late))
    assert u == 0.0
    assert problem in node.diagnose()[1]


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"damping.sensor": "imu"}, "less than an accelerometer's"),
        ({"damping.joint": "x"}, "no joint of the stream"),
        ({"stream_output": ""}, "no stream of positions or velocities"),
        (
            {"damping.joint": "", "play_trajectories": True, "stream_output": ""},
            "no stream of positions",
        ),
        ({"play_trajectories": True, "stream_kind": "velocities"}, "no stream of positions"),
        ({"damping.target": 0.01, "damping.damping": 0.02}, "no more than the mode has"),
    ],
)
def test_a_damping_that_can_not_be_is_refused(bench, changes, problem):
    with pytest.raises((ParameterError, DesignError, AssertionError)) as refused:
        Shaper(bench, **{**DAMPING, **changes})
    assert problem in str(refused.value)


def test_trajectories_are_played_as_positions_with_the_damping_and_need_joint_states(bench):
    shaper = Shaper(bench, **{**DAMPING, **PLAYS})
    node = bench.nodes["shaper"]
    node.now_ns = lambda: round(1e9 * (100.0 + bench.queue.time))
    commands = bench.tap(Float64MultiArray, "commands")
    out, state = shaper.send(THERE)
    assert not out
    assert "joint_states: have not come" in state.rejected_reason
    joints = bench.publisher(JointState, "joint_states")
    joints.publish(JointState(name=["a", "b"], position=[0.0, 0.0]))
    out, state = shaper.send(THERE)
    assert state.moving
    assert not out  # nothing goes to the controller of trajectories
    strain, swing, p = (
        bench.publisher(Float64MultiArray, "strain"),
        1e-3 + 0j,
        strain_damping.pole(3.0, 0.005),
    )
    corrections, ways = [], []
    while state.moving or len(ways) < 250:
        strain.publish(Float64MultiArray(data=[0.0, swing.real]))
        seen = len(commands.messages)
        bench.wait_for("a command", lambda seen=seen: len(commands.messages) > seen)
        played = node.core.state(node.now_ns())[0]
        ways.append(commands.newest.data[0] - played[0])
        corrections.append(commands.newest.data[1] - played[1])
        swing = strain_damping.moved(swing, p, 1j * SENSITIVITY, corrections[-1], 0.008)
        state = shaper.states.newest
    assert np.abs(ways).max() < 0.02  # a period's way at most
    assert list(node.core.state(node.now_ns())[0]) == [0.6, -0.3]
    assert commands.newest.data[0] == 0.6
    assert abs(swing) < 0.3e-3
    assert 1e-3 < np.abs(corrections[-250:]).max() < 0.04


class Controller:
    """The action server of a controller, whose goals end when the test says so."""

    def __init__(self, bench, name):
        self.goals, self._ends = [], []
        self.server = ActionServer(bench.node, Follow, name, self._execute)

    async def _execute(self, handle):
        self.goals.append(handle)
        self._ends.append(Future())
        handle.publish_feedback(Follow.Feedback(joint_names=["a", "b"]))
        succeeds = await self._ends[self.goals.index(handle)]
        handle.succeed() if succeeds else handle.abort()
        code = Follow.Result.SUCCESSFUL if succeeds else Follow.Result.GOAL_TOLERANCE_VIOLATED
        return Follow.Result(error_code=code, error_string="of the controller")

    def end(self, number, succeeds=True):
        """End a goal."""
        self._ends[number].set_result(succeeds)


class Goals:
    """A client of the shaper's server."""

    def __init__(self, bench):
        self._bench = bench
        self._client = ActionClient(bench.node, Follow, "shaper/follow_trajectory")
        bench.wait_for("the shaper", self._client.server_is_ready)

    def send(self, msg):
        """A goal's handle, and its feedback."""
        feedback, futures, again = [], [], 0.0

        def answered():
            nonlocal again
            # A server that has not found the client yet drops its answer.
            if time.monotonic() > again:
                again = time.monotonic() + 3.0
                goal = Follow.Goal(trajectory=msg)
                futures.append(self._client.send_goal_async(goal, feedback.append))
            return next((f.result() for f in futures if f.done()), None)

        return self._bench.wait_for("the answer", answered), feedback

    def result(self, handle):
        """Status and result of a goal."""
        future = handle.get_result_async()
        self._bench.wait_for("the result", future.done)
        return future.result().status, future.result().result


PLAYS = {"play_trajectories": True, "stream_output": "commands"}


def test_a_goal_that_is_played_succeeds_at_its_end_and_is_cancelled_by_a_smooth_stop(tmp_path):
    with Bench(tmp_path) as bench:
        bench.start("shaper", {**SETTINGS, **PLAYS})
        goals = Goals(bench)
        states = bench.publisher(JointState, "joint_states")
        at = JointState(name=["a", "b"], position=[0.0, 0.0])

        def known():
            states.publish(at)
            return goals.result(goals.send(message((0.0, 0.0, 0.0), (0.05, 0.0, 0.0)))[0])[0] == (
                GoalStatus.STATUS_SUCCEEDED
            )

        bench.wait_for("the joint states", known)
        commands = bench.tap(Float64MultiArray, "commands")
        handle, feedback = goals.send(message((0.0, 0.0, 0.0), (0.2, 0.1, -0.1)))
        status, found = goals.result(handle)
        assert status == GoalStatus.STATUS_SUCCEEDED
        assert found.error_code == Follow.Result.SUCCESSFUL
        bench.wait_for("the end", lambda: list(commands.newest.data) == [0.1, -0.1])
        assert feedback
        handle, _ = goals.send(message((20.0, 2.0, 2.0)))
        handle.cancel_goal_async()
        status, found = goals.result(handle)
        assert status == GoalStatus.STATUS_CANCELED
        assert "stopped" in found.error_string
        assert commands.newest.data[0] < 1.0


def test_goals_are_shaped_and_sent_on_and_results_sent_back(tmp_path):
    with Bench(tmp_path) as bench:
        bench.start("shaper", SETTINGS)
        goals = Goals(bench)
        send, result = goals.send, goals.result

        status, found = result(send(THERE)[0])
        assert status == GoalStatus.STATUS_ABORTED
        assert "no action server" in found.error_string

        controller = Controller(bench, "arm_controller/follow_trajectory")

        def accepted(msg):
            """As `send`, once the controller has the goal."""
            count = len(controller.goals)

            def sent():
                handle, feedback = send(msg)
                future = handle.get_result_async()
                arrived = lambda: len(controller.goals) > count  # noqa: E731
                bench.wait_for("the controller", lambda: arrived() or future.done())
                return (handle, feedback) if arrived() else None

            return bench.wait_for("the controller's server to be found", sent)

        handle, feedback = accepted(THERE)
        assert len(controller.goals[0].request.trajectory.points) == 6
        bench.wait_for("feedback", lambda: feedback)
        controller.end(0)
        status, found = result(handle)
        assert status == GoalStatus.STATUS_SUCCEEDED
        assert found.error_string == "of the controller"

        status, found = result(send(message((0.0, 0.0)))[0])
        assert status == GoalStatus.STATUS_ABORTED
        assert "points[0].positions" in found.error_string

        handle, _ = accepted(message((2.0, 0.0, 0.0)))
        cancelled = handle.cancel_goal_async()
        bench.wait_for("the stop", lambda: len(controller.goals) == 3)
        stop = controller.goals[2].request.trajectory
        assert not any(stop.points[-1].velocities)
        controller.end(1, succeeds=False)  # replaced by the stop
        controller.end(2)
        status, found = result(handle)
        assert cancelled.done()
        assert status == GoalStatus.STATUS_CANCELED
        assert "stopped" in found.error_string

        handle, _ = accepted(message((2.0, 0.3, 0.3)))
        controller.end(3, succeeds=False)
        status, found = result(handle)
        assert status == GoalStatus.STATUS_ABORTED
        assert found.error_code == Follow.Result.GOAL_TOLERANCE_VIOLATED
