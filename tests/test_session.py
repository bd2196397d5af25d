# SPDX-License-Identifier: Apache-2.0
"""A session as a user of ROS has it: sixty calls of services, parameters, topics and actions, and what each answers."""

import re

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from harness import PATIENT, Arm, Bench
from rcl_interfaces.srv import DescribeParameters, ListParameters
from std_srvs.srv import SetBool, Trigger
from test_goals import LINE, Client, R, trajectory
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_msgs.msg import CompositeState, JointTolerance, JointTrajectoryControllerState
from flexarm_msgs.srv import QueryTrajectoryState
from flexarm_ros.messages import set_stamp

#: Refused at once: parameter, value, and what the answer says.
REFUSED = [
    ("slow.kp", [-1.0], "slow.kp.*-1.0"),
    ("slow.kp", [1.0, 2.0], "slow.kp.*1"),
    ("slow.kp", [6], "write \\[6.0\\]"),
    ("slow.kp", "much", "slow.kp"),
    ("slow.type", "pdi", "slow.type.*pdi"),
    ("arm", "two_link", "read-only|read only"),
    ("speed_scaling", 2.0, "speed_scaling.*2.0"),
    ("cmd_timeout", -1.0, "cmd_timeout"),
    ("effort_in_points", "double", "effort_in_points.*double"),
    ("no.such.parameter", 1.0, "no.such.parameter|undeclared|not declared"),
]
#: Trajectories on the topic that are refused, and the reason in controller/state.
BAD = [
    (trajectory((1.0, float("nan"))), r"points\[0\]\.positions of joint joint1: nan"),
    (trajectory((1.0, 0.1), joints=["elbow"]), "'elbow' is no joint of this arm"),
    (trajectory(), "empty trajectory"),
    (trajectory((1.0, 0.1), stamp_ns=1), "in the past"),
    (trajectory((1.0, 0.1), stamp_ns=2 * 10**18), "stamp may be of another clock"),
    (trajectory((2.0, 0.1), (1.0, 0.2)), "is not later than"),
    (trajectory((0.05, 3.0)), "more than the torque limit"),
]


class Session60:
    """The bench, with every call counted."""

    def __init__(self, bench, arm, client):
        self.bench, self.arm, self.client, self.count = bench, arm, client, 0

    def __getattr__(self, name):
        """A call of the bench."""
        self.count += 1
        return getattr(self.bench, name)

    def publish(self, message):
        self.count += 1
        self.arm.publish_trajectory(message)

    def goal(self, message, **fields):
        self.count += 1
        return self.client.follow(message, **fields)

    def begin(self, message):
        self.count += 1
        handle, _ = self.client.send(message)
        self.bench.wait_for(
            "motion", lambda: self.arm.state.supervisor_state == CompositeState.TRACKING
        )
        return handle

    def until(self, what, condition):
        return self.bench.wait_for(what, condition)

    def last_set(self):
        """What /diagnostics says of the last parameters that were set."""
        found = self.bench.diagnostics("controller")
        values = {v.key: v.value for v in found[-1].values} if found else {}
        return values.get("last parameters set", "")


@pytest.fixture
def session(tmp_path_factory):
    with Bench(tmp_path_factory.mktemp("log")) as bench:
        bench.diagnostics("controller")
        bench.start_loop(controller=PATIENT, **LINE)
        bench.start("goals", {"arm": "R", "state_timeout": 5.0})
        arm = Arm(bench)
        arm.wait_ready()
        # Only the controller's states are looked at: to decode all others takes as long as the loop itself.
        for topic in ("arm_state", "arm_state_estimate", "joint_torque", "observer/state"):
            bench.untap(topic)
        client = Client(bench)
        yield Session60(bench, arm, client)
        client.client.destroy()


@pytest.mark.long
def test_sixty_calls_have_the_answers_that_they_should(session):
    """In the order of a session: what a part leaves behind, the next one begins with."""
    for part in (looked_at, refused, set_and_designed, called, sent, followed, streamed, failed):
        part(session)
    assert session.count >= 60


def looked_at(s):
    for node in ("simulator", "observer", "controller", "goals"):
        assert s.lifecycle(node) == "active"
    assert s.get("controller", "arm") == "R"
    assert s.get("controller", "speed_scaling") == 1.0
    assert s.get("goals", "constraints.tip") == 0.0
    assert s.get("controller", "no.such.parameter") is None
    names = s.call(ListParameters, "controller/list_parameters").result.names
    assert {"slow.kp", "cmd_timeout", "speed_scaling"} <= set(names)
    (found,) = s.call(
        DescribeParameters, "controller/describe_parameters", names=["cmd_timeout"]
    ).descriptors
    assert found.description.endswith("[s]")


def refused(s):
    for name, value, text in REFUSED:
        (result,) = s.set("controller", **{name.replace(".", "__"): value})
        assert not result.successful, name
        assert re.search(text, result.reason), result.reason
    assert s.get("controller", "slow.type") != "pdi"


def set_and_designed(s):
    before = s.get("controller", "fast.alpha")
    assert all(r.successful for r in s.set("controller", slow__kp=9.0))  # one value for all
    s.until("the gain", lambda: re.search(r"slow\.kp .*: active", s.last_set()))
    s.until("it in the state", lambda: s.arm.state.parameters_set == s.last_set())
    assert s.get("controller", "slow.kp") == 9.0
    assert all(r.successful for r in s.set("controller", fast__alpha=400.0))
    s.until("the design", lambda: re.search(r"fast\.alpha 400.0 .*: refused: ", s.last_set()))
    s.until("it in the state", lambda: ": refused: " in s.arm.state.parameters_set)
    assert s.get("controller", "fast.alpha") == before
    assert "design refused, the old law goes on" in s.log("controller")
    assert re.search(r"slow\.kp .*: active", s.log("controller"))


def called(s):
    assert "brought to rest and held" in s.call(Trigger, "controller/stop").message
    assert "not in fault" in s.call(Trigger, "controller/recover").message
    assert "off" in s.call(SetBool, "controller/enable_fast", data=False).message
    assert "on" in s.call(SetBool, "controller/enable_fast", data=True).message
    past = s.call(QueryTrajectoryState, "controller/query_trajectory_state", time=Time(sec=1))
    assert "is past: the arm's clock shows" in past.message
    ahead = s.call(QueryTrajectoryState, "controller/query_trajectory_state", time=Time(sec=10**9))
    assert ahead.success and list(ahead.velocity) == [0.0]


def sent(s):
    for message, text in BAD:
        s.publish(message)
        s.until(text, lambda text=text: re.search(text, s.arm.state.judged_reason))
    number = s.arm.state.accepted_trajectory_id
    good = trajectory((1.0, 0.2))
    s.publish(good)
    s.until("a motion", lambda: s.arm.state.accepted_trajectory_id == number + 1)
    assert s.arm.state.judged_reason == ""
    s.publish(good)  # a repeat, as of `ros2 topic pub` without --once
    s.until("its end", lambda: s.arm.state.supervisor_state == CompositeState.HOLDING)
    assert s.arm.state.accepted_trajectory_id == number + 1


def followed(s):
    status, result = s.goal(trajectory((1.0, 0.1)))
    assert (status, result.error_code) == (GoalStatus.STATUS_SUCCEEDED, R.SUCCESSFUL)
    assert result.tip_swing <= 1.3e-3
    status, result = s.goal(trajectory((1.0, 0.1), joints=["elbow"]))
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, R.INVALID_JOINTS)
    tolerance = [JointTolerance(name="joint1", position=1e-5)]
    status, result = s.goal(trajectory((2.0, 0.8)), path_tolerance=tolerance)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, R.PATH_TOLERANCE_VIOLATED)
    handle = s.begin(trajectory((6.0, 0.0)))
    s.count += 1
    handle.cancel_goal_async()
    status, result = s.client.result(handle)
    assert (status, result.error_string) == (
        GoalStatus.STATUS_CANCELED,
        "cancelled: the arm was stopped",
    )
    first = s.begin(trajectory((6.0, 0.5)))
    assert s.goal(trajectory((2.0, 0.0)))[0] == GoalStatus.STATUS_SUCCEEDED
    assert s.client.result(first)[1].error_string == "replaced by a newer goal"


def streamed(s):
    states = s.tap(JointTrajectoryControllerState, "controller/trajectory_state")
    allowed = "allow_nonzero_velocity_at_trajectory_end"
    assert all(r.successful for r in s.set("controller", **{allowed: True, "speed_scaling": 0.5}))
    lines = s.log("controller").count("accepted")
    for k in range(8):
        number, here = s.arm.state.accepted_trajectory_id, s.arm.state.reference_position[0]
        message = JointTrajectory(joint_names=["joint1"])
        # Slow enough to be possible from rest, too: in lockstep the arm may stop before the next point is there. And
        # different each time, wherever the reference is: the same message again would be a repeat.
        there = here + 0.002 + 1e-6 * k
        point = JointTrajectoryPoint(positions=[there], velocities=[0.01])
        set_stamp(point.time_from_start, 200_000_000)
        message.points.append(point)
        s.publish(message)
        s.until("it", lambda number=number: s.arm.state.accepted_trajectory_id > number)
    s.until("rest", lambda: s.arm.state.supervisor_state == CompositeState.HOLDING)
    assert np.abs(s.arm.state.reference_velocity).max() == 0.0
    assert s.log("controller").count("accepted") < lines + 8
    s.until("the factor", lambda: states.newest and states.newest.speed_scaling_factor == 0.5)
    assert all(r.successful for r in s.set("controller", speed_scaling=1.0))


def failed(s):
    handle = s.begin(trajectory((6.0, 0.8)))
    assert s.call(Trigger, "simulator/reset").success
    assert "restarted during a motion" in s.client.result(handle)[1].error_string
    assert s.arm.state.supervisor_state == CompositeState.FAULT
    status, result = s.goal(trajectory((1.0, 0.1)))
    assert status == GoalStatus.STATUS_ABORTED
    assert "in fault, call ~/recover first" in result.error_string
    assert "left the fault" in s.call(Trigger, "controller/recover").message
    s.until("torque", s.arm.ready)
    assert s.goal(trajectory((1.0, 0.1)))[0] == GoalStatus.STATUS_SUCCEEDED
    assert s.call(Trigger, "controller/stop").success
