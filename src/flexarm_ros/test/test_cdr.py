# SPDX-License-Identifier: Apache-2.0
"""Messages read from their bytes, and written to them, are those of rclpy's conversion."""

import math
import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from flexarm_dynamics.errors import MessageError
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros.cdr import Layout, Reader, Writer
from flexarm_ros.messages import set_stamp

WORDS = st.lists(
    st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=5),
    max_size=4,
)
NUMBERS = st.lists(st.floats(allow_nan=False), max_size=4)
UINT32 = st.integers(0, 2**32 - 1)


@st.composite
def states(draw):
    """Any `ArmState`."""
    message = ArmState(
        session=draw(UINT32),
        sequence=draw(UINT32),
        controller_id=draw(UINT32),
        joint_names=draw(WORDS),
        gauge_names=draw(WORDS),
        mode_names=draw(WORDS),
        trust=draw(st.integers(0, 255)),
        clock_stopped=draw(st.booleans()),
        doubt=draw(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9)),
    )  # fmt: skip
    for field in (
        "joint_position",
        "joint_velocity",
        "joint_torque",
        "strain",
        "modal_amplitude",
        "modal_rate",
    ):
        setattr(message, field, draw(NUMBERS))
    set_stamp(message.header.stamp, draw(st.integers(0, 2**31 * 10**9 - 1)))
    message.header.frame_id = draw(st.sampled_from(["", "base", "base_link"]))
    return message


def alike(mine, its):
    """Whether two strings or arrays are equal, NaN and all."""
    pairs = zip(mine, its, strict=True)
    return len(mine) == len(its) and all(a == b or (a != a and b != b) for a, b in pairs)


def same(read, message):
    """Whether what was read has the fields of a message."""
    for name in message.get_fields_and_field_types():
        mine, its = getattr(read, name), getattr(message, name)
        if hasattr(its, "get_fields_and_field_types"):
            equal = same(mine, its)
        else:
            equal = mine == its if not hasattr(its, "__len__") else alike(mine, its)
        if not equal:
            return False
    return True


@settings(max_examples=150, deadline=None)
@given(st.lists(states(), min_size=1, max_size=3))
def test_any_stream_of_messages_is_read_as_rclpy_reads_it(stream):
    reader = Reader(ArmState)
    for message in stream:
        for _ in range(2):  # the second time without rclpy
            message.sequence = (message.sequence + 1) % 2**32
            assert same(reader(serialize_message(message)), message)


@settings(max_examples=150, deadline=None)
@given(st.lists(states(), min_size=1, max_size=3))
def test_any_stream_of_messages_is_written_as_rclpy_writes_it(stream):
    message = ArmState()
    write = Writer(message)
    for wanted in stream:
        for _ in range(2):
            wanted.sequence = (wanted.sequence + 1) % 2**32
            for name in wanted.get_fields_and_field_types():
                setattr(message, name, getattr(wanted, name))
            assert deserialize_message(write(), ArmState) == wanted


@settings(max_examples=60, deadline=None)
@example(
    ArmState(mode_names=[""], modal_rate=[1.0], strain=[2.0]), [(12, 0)], 0
)  # a string without its end
@given(
    states(),
    st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=4),
    st.integers(-9, 9),
)
def test_bytes_that_were_tampered_with_are_read_as_rclpy_reads_them_or_refused_with_it(
    message, changes, longer
):
    reader, raw = Reader(ArmState), bytearray(serialize_message(message))
    reader(bytes(raw))
    for place, byte in changes:
        raw[place % len(raw)] = byte
    raw = bytes(raw[:longer] if longer < 0 else raw + bytes(longer))
    try:
        wanted = deserialize_message(raw, ArmState)
    except Exception:  # rclpy states none
        with pytest.raises(MessageError):
            reader(raw)
    else:
        assert same(reader(raw), wanted)


def test_padding_may_hold_anything():
    message = JointTorque(joint_names=["a"], torque=[1.0, 2.0])
    clean = Writer(message)()
    layout = Layout(message)
    numbers = {
        i for code, at in layout.numbers.values() for i in range(at, at + struct.calcsize(code))
    }
    numbers.update(*(range(a.start, a.stop) for a in map(layout.bytes_of, layout.arrays)))
    padding = [i for i in range(4, len(clean)) if not layout._mask[i] and i not in numbers]
    assert padding
    dirty = bytearray(clean)
    for i in padding:
        dirty[i] = 0xAA
    reader = Reader(JointTorque)
    reader(clean)
    assert layout.unpack(bytes(dirty)) is not None
    assert same(reader(bytes(dirty)), message)


def test_numbers_are_read_without_rclpy_and_other_strings_or_lengths_with_it(monkeypatch):
    reader, calls = Reader(JointTorque), []
    learn = reader._learn
    monkeypatch.setattr(reader, "_learn", lambda raw: calls.append(raw) or learn(raw))
    message = JointTorque(joint_names=["a", "b"], torque=[1.0, 2.0])
    for torque, names, learnt in (
        ([3.0, math.inf], ["a", "b"], 1),
        ([4.0, 5.0], ["a", "b"], 1),
        ([4.0, 5.0], ["a", "c"], 2),  # of the same length
        ([4.0], ["a", "c"], 3),
        ([6.0], ["a", "c"], 3),
    ):
        message.torque, message.joint_names = torque, names
        assert same(reader(serialize_message(message)), message)
        assert len(calls) == learnt


def test_messages_in_the_other_order_of_bytes_are_read_each_time_by_rclpy(monkeypatch):
    reader, wanted = Reader(JointTorque), JointTorque(joint_names=["a"], torque=[1.0, 2.0])
    monkeypatch.setattr(reader, "message", lambda raw: wanted)
    for _ in range(2):
        assert same(reader(b"\0\0\0\0" + bytes(60)), wanted)


def test_a_field_that_there_is_not_is_no_attribute():
    fields = Reader(JointTorque)(serialize_message(JointTorque(torque=[1.0])))
    assert fields.torque.tolist() == [1.0]
    with pytest.raises(AttributeError):
        fields.strain  # noqa: B018


def test_arrays_of_names_changed_in_place_are_written():
    message = JointTorque(joint_names=["a", "b"])
    write = Writer(message)
    message.joint_names[1] = "c"
    assert deserialize_message(write(), JointTorque).joint_names == ["a", "c"]


def test_messages_of_the_other_byte_order_are_left_to_rclpy():
    raw = serialize_message(JointTorque(joint_names=["a"], torque=[1.0]))
    assert Layout(deserialize_message(raw, JointTorque)).unpack(b"\0\0" + raw[2:]) is None


@pytest.mark.parametrize("raw", [b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 40])
def test_bytes_that_are_no_message_are_refused(raw):
    with pytest.raises(MessageError, match=r"bytes of ArmState.*can't be read"):
        Reader(ArmState)(raw)


def test_a_message_is_returned_as_it_is():
    message = JointTorque()
    assert Reader(JointTorque)(message) is message
