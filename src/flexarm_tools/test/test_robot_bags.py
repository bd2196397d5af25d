# SPDX-License-Identifier: Apache-2.0
"""Bags of any robot: joint states and IMUs, whole, odd and broken."""

import json

import numpy as np
import pytest
from geometry_msgs.msg import Vector3
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from flexarm_dynamics.errors import FlexarmError
from flexarm_ros.messages import set_stamp
from flexarm_tools.recording import robot
from flexarm_tools.recording.recorder import BagWriter

SECONDS, OMEGA, DAMPING = 5.0, 2.0 * np.pi * 4.0, 0.02


def swing(time):
    """What rings from 1 s on."""
    since = np.maximum(time - 1.0, 0.0)
    return np.exp(-DAMPING * OMEGA * since) * np.sin(OMEGA * since)


def states(rate=125.0, names=("a", "b"), change=lambda k, m: m):
    for k in range(int(SECONDS * rate)):
        time = k / rate
        moved = 0.3 * min(time, 1.0)
        values = {"a": moved, "b": 0.0}
        message = JointState(name=list(names), position=[values.get(n, 0.0) for n in names])
        set_stamp(message.header.stamp, round(1e9 * (50.0 + time)))
        yield message.header.stamp, change(k, message)


def readings(rate=250.0, change=lambda k, m: m):
    for k in range(int(SECONDS * rate)):
        time = k / rate
        message = Imu(linear_acceleration=Vector3(x=float(swing(time)), z=9.81))
        message.angular_velocity_covariance[0] = -1.0
        set_stamp(message.header.stamp, round(1e9 * (50.0 + time)))
        yield message.header.stamp, change(k, message)


def written(path, **topics):
    """A bag with messages by topic; the types are those of the first message."""
    with BagWriter(path) as out:
        for topic, messages in topics.items():
            kind = None
            for stamp, message in messages:
                if kind is None and message is not None:
                    kind = f"{type(message).__module__.split('.')[0]}/msg/{type(message).__name__}"
                    out.add(topic, kind)
                if message is not None:
                    raw = (
                        message if isinstance(message, bytes) else bytes(serialize_message(message))
                    )
                    out.write(topic, stamp.sec * 10**9 + stamp.nanosec, raw)
    return path


def test_an_imu_beside_joint_states_gives_the_mode(tmp_path, flexarm):
    path = written(tmp_path / "bag", joint_states=states(), imu=readings())
    code, out, err = flexarm("resonance", path, "--json")
    assert code == 0, err
    found = json.loads(out)
    assert found["joints"] == ["a", "b"] and found["channels"] == ["imu_x"]
    (window,) = found["windows"]
    (mode,) = window["modes"]
    assert mode["frequency_hz"] == pytest.approx(4.0, rel=1e-3)
    assert mode["damping"] == pytest.approx(DAMPING, rel=0.02)
    assert window["configuration"] == pytest.approx([0.3, 0.0], abs=1e-3)


def test_joints_in_another_order_are_sorted_and_those_of_another_robot_left_out(tmp_path):
    def change(k, message):
        if k % 3 == 1:
            message.name, message.position = message.name[::-1], message.position[::-1]
        if k % 3 == 2:
            message.name = ["gripper", "finger"]
        return message

    made = robot.read(written(tmp_path / "bag", joint_states=states(change=change)))
    assert made.joint_names == ("a", "b")
    assert made.position[-1] == pytest.approx([0.3, 0.0]) and np.all(made.position[:, 1] == 0.0)


def odd(k, message):
    message.position = message.position[:1]
    return message


def nameless(k, message):
    message.name, message.position = [], []
    return message


def infinite(k, message):
    message.position[1] = np.nan if k == 70 else 0.0
    return message


REFUSED = [
    (lambda: {"chatter": [(next(iter(states()))[0], String(data="hello"))]}, "neither sensor_msgs"),
    (lambda: {"joint_states": states(change=odd)}, "without a position of each joint"),
    (lambda: {"joint_states": states(change=nameless)}, "no joint names"),
    (lambda: {"joint_states": states(change=infinite)}, "position of b: is not finite"),
    (lambda: {"joint_states": list(states())[:5]}, "5 samples can be used"),
    (lambda: {"joint_states": states()}, "nothing rings freely"),
]


@pytest.mark.parametrize("topics, message", REFUSED)
def test_a_bag_that_is_of_no_use_is_refused_by_name(topics, message, tmp_path, flexarm):
    code, out, err = flexarm("resonance", written(tmp_path / "bag", **topics()))
    assert (code, out) == (1, "") and message in err


def test_bytes_that_are_no_message_are_left_out_with_a_note(tmp_path):
    def change(k, message):
        return bytes(serialize_message(message))[:9] if k == 200 else message

    made = robot.read(written(tmp_path / "bag", joint_states=states(change=change)))
    assert "/joint_states: 1 messages can't be read, and are left out" in made.notes


def test_a_bag_that_breaks_off_is_read_as_far_as_it_goes(tmp_path):
    path = written(tmp_path / "bag", joint_states=states(), imu=readings())
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: int(0.6 * file.stat().st_size)])
    try:
        made = robot.read(path)
    except FlexarmError as error:
        assert str(path) in str(error)
    else:
        assert any("broken" in note for note in made.notes)
