# SPDX-License-Identifier: Apache-2.0
"""A recording as a driver: what it publishes, what it waits for, and that it applies nothing."""

import os

import numpy as np
import pytest
import rclpy

from flexarm_dynamics.errors import FlexarmError
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros.node import OK, WARN
from flexarm_studies.identification import recording
from flexarm_tools.replay.node import ReplayNode
from flexarm_tools.replay.playback import Playback, part

ROWS = 40


@pytest.fixture
def table(tmp_path):
    """A recording of `one_link` at 100 Hz that begins at 2 s: angle k, torque 10 k, strains k and 2 k microstrain."""
    k = np.arange(ROWS)
    values = np.column_stack([2.0 + 0.01 * k, k, 10.0 * k, 1e-6 * k, 2e-6 * k, 0.1 * k])
    header = "t,joint1_position,joint1_torque,root_strain,middle_strain,joint1_velocity"
    np.savetxt(tmp_path / "run.csv", values, "%.9g", ",", header=header, comments="")
    return tmp_path / "run.csv"


@pytest.fixture
def replay(monkeypatch, table):
    """Makes the node with parameters; what it publishes is kept in `states`."""
    monkeypatch.setitem(os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    nodes = []

    def make(**parameters):
        words = ["--ros-args", "-p", "arm:=one_link", "-p", f"recording:={table}"]
        for name, value in parameters.items():
            words += ["-p", f"{name}:={value}"]
        rclpy.init(args=words)
        node = ReplayNode()
        nodes.append(node)
        node.stopped, node.states = [], []
        assert node.autostart()
        node.state_publisher.publish = lambda m: node.states.append(
            (
                m.session,
                m.sequence,
                m.clock_stopped,
                m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec,
            )
        )
        return node

    yield make
    for node in nodes:
        node.destroy_node()
        rclpy.shutdown()


def torque(node, value, sequence=None, mode=JointTorque.ENABLED, session=None):
    """A controller's answer to the newest sample."""
    newest = node.states[-1]
    node._on_torque(
        JointTorque(
            session=newest[0] if session is None else session,
            sequence=newest[1] if sequence is None else sequence,
            joint_names=["joint1"], torque=[value], mode=mode, controller_id=7,
        )
    )  # fmt: skip


def estimate(node):
    session, sequence, *_ = node.states[-1]
    node._on_estimate(ArmState(session=session, sequence=sequence))


def test_in_lockstep_each_answer_brings_the_next_sample_with_the_recordings_times(replay):
    node = replay(lockstep="observer")
    node._resend()
    message = node.writer.message
    assert list(message.joint_position) == [0.0] and list(message.strain) == [0.0, 0.0]
    for _ in range(5):
        estimate(node)
    estimate_of_the_last = node.states[-1]
    node._on_estimate(ArmState(session=node.states[-1][0], sequence=2))  # an older one
    assert node.states[-1] is estimate_of_the_last
    assert [s[1] for s in node.states] == list(range(6))
    np.testing.assert_allclose([s[3] for s in node.states], 2.0 + 0.01 * np.arange(6))
    assert (message.joint_position[0], message.joint_torque[0]) == (5.0, 50.0)
    assert message.joint_velocity[0] == pytest.approx(0.5)
    np.testing.assert_allclose(message.strain, [5e-6, 10e-6])


def test_it_ends_with_the_recording_and_says_what_was_played(replay):
    node = replay(lockstep="controller")
    node._resend()
    for k in range(ROWS):
        assert not node.stopped
        estimate(node)  # of no effect in this mode
        torque(node, 10.0 * k + 3.0)
    assert node.stopped and len(node.states) == ROWS
    found = node.playback.summary()
    assert (found["played"], found["answered"]) == (ROWS, ROWS)
    assert found["sent_less_measured_rms_Nm"] == [pytest.approx(3.0)]
    assert node.diagnose()[:2] == (OK, "the recording is over")


def test_a_torque_is_shown_and_never_applied_nor_confirmed(replay, tmp_path):
    node = replay(lockstep="controller")
    node._resend()
    for k in range(10):
        torque(node, -1e3 * k)
        assert node.writer.message.controller_id == 0
        assert node.writer.message.joint_position[0] == k + 1.0
        assert node.writer.message.joint_torque[0] == 10.0 * (k + 1)
    values = node.diagnose()[2]
    assert values["torque sent, not applied [N m]"] == "-9000"
    assert values["torque measured [N m]"] == "90"
    node.playback.write(tmp_path / "out.csv", node.arm.joint_names)
    rows = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(rows["joint1_torque_sent"][:10], -1e3 * np.arange(10))
    assert np.isnan(rows["joint1_torque_sent"][10:]).all()
    np.testing.assert_array_equal(rows["joint1_torque"], 10.0 * np.arange(ROWS))


def test_what_is_no_answer_changes_nothing(replay):
    node = replay(lockstep="controller")
    node._resend()
    torque(node, 1.0, session=3)
    torque(node, float("nan"))
    assert len(node.states) == 1 and np.isnan(node.playback.sent).all()
    torque(node, 1.0, mode=JointTorque.DISABLED)  # an answer, but no torque
    assert len(node.states) == 2 and np.isnan(node.playback.sent).all()


def test_in_lockstep_a_sample_without_an_answer_is_sent_again(replay):
    node = replay(lockstep="observer")
    for _ in range(4):
        node._resend()
    assert [s[1] for s in node.states] == [0, 0, 0] and [s[2] for s in node.states] == [
        False,
        True,
        True,
    ]
    assert node.diagnose()[0] == OK
    assert node.diagnose()[:2] == (
        WARN,
        "nothing is played: no node subscribes to arm_state, or none answers",
    )


def test_in_real_time_it_waits_for_a_listener_and_goes_on_its_grid(replay):
    node = replay(real_time_factor=2.0)
    assert node.control_path.period == pytest.approx(0.005)
    node._on_period()
    assert node.states == []
    node.state_publisher.get_subscription_count = lambda: 1
    for _ in range(3):
        node._on_period()
    stamps = [s[3] for s in node.states]
    np.testing.assert_allclose(np.diff(stamps), 0.01, atol=1e-6)
    estimate(node)
    torque(node, 1.0)
    assert len(node.states) == 3 and node.playback.sent[2, 0] == 1.0


def test_a_part_of_it_may_be_played(table):
    whole = recording.read_csv(table)
    some = part(whole, 0.1, 0.25)
    assert some.start == pytest.approx(2.1) and len(some.position) == 26
    assert part(whole, 0.0, 0.0) is whole
    with pytest.raises(
        FlexarmError, match=r"begin: 1\.0 is beyond the end \(the recording lasts 0\.39 s\)"
    ):
        part(whole, 1.0, 0.0)


def test_speeds_are_published_where_all_are_known():
    rows = np.zeros((30, 2))
    made = recording.Recording(
        0.01, rows, np.nan * rows, rows, velocity=np.column_stack([rows[:, 0], np.nan * rows[:, 0]]),
        joint_names=("a", "b"), gauge_names=("c", "d"), held=("b",),
    )  # fmt: skip
    np.testing.assert_array_equal(Playback(made).velocity, 0.0)
    assert Playback(recording.replace(made, held=())).velocity is None
    assert Playback(recording.replace(made, strain=np.nan * rows)).strain is None


def test_options_that_can_not_be_used_are_refused(flexarm, table):
    code, _, err = flexarm("replay", table, "one_link", "--factor", "0")
    assert code == 1 and "--factor: 0.0 is out of range (at least 0.001)" in err
    code, _, err = flexarm("replay", table, "none")
    assert code == 1 and "'none' is neither a file nor a shipped arm" in err
