# SPDX-License-Identifier: Apache-2.0
"""Messages to arrays and back: names, lengths, arrays written in place, and anything at all."""

import math
import os
import struct
import subprocess
import sys
from array import array
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_control.composite.design import design
from flexarm_control.loop.arm_controller import PARAMETERS, ArmController
from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import observe
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import check_all
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros import cdr
from flexarm_ros.messages import (
    CompositeStateWriter,
    ObserverStateWriter,
    StateReader,
    StateWriter,
    TorqueReader,
    TorqueWriter,
    set_stamp,
    stamp_ns,
    trajectory_points,
)

NAN, INF = math.nan, math.inf


def names(prefix, count):
    """Names with a number each."""
    return tuple(f"{prefix}{i + 1}" for i in range(count))


#: More joints, gauges and modes than any shipped arm, so that every order can be wrong.
ARM = SimpleNamespace(
    joint_names=names("joint", 3),
    gauge_names=names("gauge", 4),
    observed_modes=names("mode", 2),
    joints=range(3),
    gauges=range(4),
)


def over_the_wire(message):
    """The message as it arrives elsewhere."""
    return deserialize_message(serialize_message(message), type(message))


def good(**changes):
    """A state of `ARM` in which every number is different."""
    fields = {
        "session": 7,
        "sequence": 9,
        "joint_names": list(ARM.joint_names),
        "joint_position": [1.0, 2.0, 3.0],
        "joint_velocity": [4.0, 5.0, 6.0],
        "joint_torque": [7.0, 8.0, 9.0],
        "gauge_names": list(ARM.gauge_names),
        "strain": [0.1, 0.2, 0.3, 0.4],
        "mode_names": list(ARM.observed_modes),
        "modal_amplitude": [0.5, 0.6],
        "modal_rate": [0.7, 0.8],
        **changes,
    }
    message = ArmState(**fields)
    set_stamp(message.header.stamp, 12_345_678_901)
    return over_the_wire(message)


def read(message, reader=None):
    """A sample filled from a message."""
    sample = ArmSample(3, 2, 4)
    (reader or StateReader(ARM)).read(message, sample)
    return sample


# StateReader -----------------------------------------------------------------------------------


def test_a_state_is_read_field_by_field():
    sample = read(good())
    assert (sample.session, sample.sequence, sample.stamp_ns) == (7, 9, 12_345_678_901)
    assert sample.position.tolist() == [1.0, 2.0, 3.0]
    assert sample.velocity.tolist() == [4.0, 5.0, 6.0] and sample.velocity_known
    assert sample.torque.tolist() == [7.0, 8.0, 9.0]
    assert sample.strain.tolist() == [0.1, 0.2, 0.3, 0.4]
    assert sample.amplitude.tolist() == [0.5, 0.6]
    assert sample.rate.tolist() == [0.7, 0.8]


def test_names_in_another_order_are_put_in_the_arms_and_the_next_message_in_its_own():
    reader = StateReader(ARM)
    turned = good(
        joint_names=["joint3", "joint1", "joint2"],
        gauge_names=["gauge2", "gauge1", "gauge4", "gauge3"],
        mode_names=["mode2", "mode1"],
    )
    joints_alone = good(joint_names=["joint2", "joint3", "joint1"])
    for message, position, strain, amplitude in (
        (turned, [2.0, 3.0, 1.0], [0.2, 0.1, 0.4, 0.3], [0.6, 0.5]),
        (good(), [1.0, 2.0, 3.0], [0.1, 0.2, 0.3, 0.4], [0.5, 0.6]),
        (joints_alone, [3.0, 1.0, 2.0], [0.1, 0.2, 0.3, 0.4], [0.5, 0.6]),
        (turned, [2.0, 3.0, 1.0], [0.2, 0.1, 0.4, 0.3], [0.6, 0.5]),
    ):
        sample = read(message, reader)
        assert sample.position.tolist() == position
        assert (sample.velocity - sample.position).tolist() == [3.0] * 3
        assert (sample.torque - sample.position).tolist() == [6.0] * 3
        assert sample.strain.tolist() == strain
        assert sample.amplitude.tolist() == amplitude


@st.composite
def shapes(draw):
    """Names in some order, and which arrays there are; now and then what no `ARM` sends."""
    orders = {
        field: draw(st.permutations(known))
        for field, known in (
            ("joint_names", ARM.joint_names),
            ("gauge_names", ARM.gauge_names),
            ("mode_names", ARM.observed_modes),
        )
    }
    if draw(st.integers(0, 9)) == 0:
        orders[draw(st.sampled_from(list(orders)))] = ["stranger"]
    given = {"joint_position": 3, "joint_velocity": 3, "joint_torque": 3, "strain": 4}
    given |= {"modal_amplitude": 2, "modal_rate": 2}
    missing = draw(st.sets(st.sampled_from(list(given)), max_size=2))
    return orders, {field: 0 if field in missing else size for field, size in given.items()}


def outcome(reader, message):
    """What reading a message gives: a sample's fields as text, or the refusal."""
    sample = ArmSample(3, 2, 4)
    try:
        reader.read(message, sample)
    except MessageError as error:
        return str(error)
    return {
        name: np.array(value).tolist().__repr__() if value is not None else None
        for name in ArmSample.__slots__
        for value in [getattr(sample, name)]
    }


@settings(max_examples=100, deadline=None)
@given(st.lists(shapes(), min_size=1, max_size=3), st.data())
def test_a_stream_of_bytes_is_read_as_its_messages_one_by_one(stream, data):
    numbers = st.floats(allow_nan=True, allow_infinity=True, width=64)
    decode, reader = cdr.Reader(ArmState), StateReader(ARM)
    for names_, sizes in [shape for shape in stream for _ in range(3)]:
        arrays = {f: data.draw(st.lists(numbers, min_size=n, max_size=n)) for f, n in sizes.items()}
        message = ArmState(session=1, sequence=2, trust=data.draw(st.integers(0, 3)))
        for field, value in {**names_, **arrays}.items():
            setattr(message, field, list(value))
        set_stamp(message.header.stamp, data.draw(st.integers(0, 10**18)))
        fresh = outcome(StateReader(ARM), message)
        assert outcome(reader, decode(serialize_message(message))) == fresh


@pytest.mark.parametrize(
    ("changes", "reason"),
    (
        ({"joint_names": ["joint1", "joint2", "elbow"]}, "missing joint3; unknown elbow"),
        ({"joint_names": ["joint1", "joint2"]}, "missing joint3"),
        ({"joint_names": []}, "missing joint1, joint2, joint3"),
        ({"joint_names": ["joint1", "joint2", "joint3", "joint3"]}, "a name twice"),
        ({"joint_names": ["joint1", "joint2", "joint2"]}, "missing joint3"),
        ({"gauge_names": ["gauge1", "gauge2", "gauge3", "x"]}, "missing gauge4; unknown x"),
        ({"mode_names": ["mode1", "mode3"]}, "missing mode2; unknown mode3"),
        ({"joint_position": [1.0, 2.0]}, r"joint_position: 2 values \(3 names in joint_names\)"),
        ({"joint_position": []}, "joint_position: is empty"),
        ({"joint_velocity": [1.0] * 4}, r"joint_velocity: 4 values \(3 names"),
        ({"joint_torque": [1.0]}, r"joint_torque: 1 values \(3 names"),
        ({"strain": [0.1]}, r"strain: 1 values \(4 names in gauge_names"),
        ({"modal_amplitude": [0.1]}, r"modal_amplitude: 1 values \(2 names in mode_names"),
        ({"modal_rate": [0.1] * 3}, r"modal_rate: 3 values \(2 names"),
    ),
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_wrong_names_and_lengths_are_refused_by_name_and_a_good_state_is_read_after(
    changes, reason
):
    reader, sample = StateReader(ARM), ArmSample(3, 2, 4)
    with pytest.raises(MessageError, match=reason):
        reader.read(good(**changes), sample)
    assert (sample.session, sample.sequence, sample.stamp_ns) == (7, 9, 12_345_678_901)
    assert read(good(), reader).position.tolist() == [1.0, 2.0, 3.0]


def test_empty_arrays_are_not_known_whatever_was_read_before():
    reader, sample = StateReader(ARM), ArmSample(3, 2, 4)
    reader.read(good(), sample)
    nothing = ("joint_velocity", "joint_torque", "strain", "modal_amplitude", "modal_rate")
    reader.read(good(gauge_names=[], mode_names=[], **{key: [] for key in nothing}), sample)
    assert not sample.velocity_known
    assert np.isnan(sample.torque).all()
    assert sample.strain is None and sample.amplitude is None and sample.rate is None


# Anything at all -------------------------------------------------------------------------------

numbers = st.one_of(
    st.floats(-1.0, 1.0),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([NAN, INF, -INF, 1e300, -1e308, 5e-324, 0.0]),
)


def arrays(count):
    """Mostly of the right length."""
    right = st.lists(numbers, min_size=count, max_size=count)
    return st.one_of(right, right, right, st.lists(numbers, max_size=count + 2))


def some_names(right):
    """Mostly the right names, in any order."""
    any_names = st.lists(st.sampled_from([*right, "elbow", ""]), max_size=len(right) + 2)
    return st.one_of(st.permutations(right), st.permutations(right), any_names)


REAL = arm_file.load("one_link")
MODEL = model.build(REAL)

states = st.fixed_dictionaries(
    {
        "session": st.integers(0, 2),
        "sequence": st.one_of(st.integers(0, 5), st.integers(0, 2**32 - 1)),
        "joint_names": some_names(REAL.joint_names),
        "joint_position": arrays(1),
        "joint_velocity": arrays(1),
        "joint_torque": arrays(1),
        "gauge_names": some_names(REAL.gauge_names),
        "strain": arrays(2),
        "mode_names": some_names(REAL.observed_modes),
        "modal_amplitude": arrays(2),
        "modal_rate": arrays(2),
    }
)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(states, st.integers(0, 2**40)), min_size=1, max_size=5))
@pytest.mark.slow
def test_any_stream_of_states_is_a_finite_estimate_or_a_message_error(stream):
    reader = StateReader(REAL)
    observer = observe(MODEL, "filtered_derivative", {})
    sample = ArmSample(1, 2, 2)
    for fields, stamp in stream:
        message = ArmState(**fields)
        set_stamp(message.header.stamp, stamp)
        try:
            reader.read(over_the_wire(message), sample)
            observer.step(sample)
        except MessageError as error:
            assert str(error)
            continue
        for values, size in (
            (sample.position, 1),
            (observer.velocity, 1),
            (observer.observer.amplitude, 2),
            (observer.observer.rate, 2),
        ):
            assert values.shape == (size,)
            assert np.isfinite(values).all()


torques = st.fixed_dictionaries(
    {
        "mode": st.one_of(st.sampled_from([0, 1, 1, 1]), st.integers(0, 255)),
        "joint_names": some_names(ARM.joint_names),
        "torque": arrays(3),
    }
)


@settings(max_examples=150, deadline=None)
@given(st.lists(torques, min_size=1, max_size=4))
def test_any_stream_of_torques_is_none_or_finite_or_a_message_error(stream):
    reader = TorqueReader(ARM)
    for fields in stream:
        try:
            torque = reader.read(over_the_wire(JointTorque(**fields)))
        except MessageError as error:
            assert str(error)
            continue
        if torque is None:
            assert fields["mode"] == JointTorque.DISABLED
            continue
        assert torque.shape == (3,) and np.isfinite(torque).all()
        by_name = dict(zip(fields["joint_names"], fields["torque"], strict=True))
        assert torque.tolist() == [by_name[name] for name in ARM.joint_names]


# TorqueReader ----------------------------------------------------------------------------------


def torque(**changes):
    """A torque for `ARM`, as it arrives."""
    fields = {"mode": 1, "joint_names": list(ARM.joint_names), "torque": [1.0, 2.0, 3.0], **changes}
    return over_the_wire(JointTorque(**fields))


def test_torques_come_in_the_arms_order_and_disabled_is_none():
    reader = TorqueReader(ARM)
    assert reader.read(torque()).tolist() == [1.0, 2.0, 3.0]
    turned = torque(joint_names=["joint2", "joint3", "joint1"])
    assert reader.read(turned).tolist() == [3.0, 1.0, 2.0]
    assert reader.read(torque(mode=0, torque=[NAN], joint_names=[])) is None


@pytest.mark.parametrize(
    ("changes", "field"),
    (
        ({"mode": 7}, "mode"),
        ({"torque": [1.0, NAN, 3.0]}, "torque of joint2"),
        ({"torque": [1.0, 2.0, -INF]}, "torque of joint3"),
        ({"torque": [1e9, 2.0, 3.0]}, "torque of joint1"),
        ({"torque": []}, "torque"),
        ({"torque": [1.0]}, "torque"),
        ({"joint_names": ["a", "b", "c"]}, "joint_names"),
    ),
    ids=str,
)
def test_a_torque_that_is_none_is_refused_by_name(changes, field):
    reader = TorqueReader(ARM)
    with pytest.raises(MessageError) as error:
        reader.read(torque(**changes))
    assert error.value.field == field
    assert reader.read(torque()).tolist() == [1.0, 2.0, 3.0]


# Writers ---------------------------------------------------------------------------------------


def state_is_written_in_place():
    writer = StateWriter(REAL)
    for k in range(3):  # again and again into the same arrays
        writer.head(10**9 + k, 2**32 - 1, k)
        writer.write("joint_position", np.array([k + 0.5]))
        writer.write("joint_velocity", None if k == 1 else np.array([k - 0.25]))
        writer.write("strain", np.array([k, -k], float))
        writer.write("modal_amplitude", np.arange(2) + k)  # integers: cast, not garbage
        got = over_the_wire(writer.message)
        assert (got.session, got.sequence, got.header.stamp.nanosec) == (2**32 - 1, k, k), got
        assert list(got.joint_position) == [k + 0.5], got
        assert list(got.joint_velocity) == ([] if k == 1 else [k - 0.25]), got
        assert list(got.strain) == [k, -k] and list(got.modal_amplitude) == [k, k + 1], got
        assert list(got.joint_torque) == [] and got.joint_names == ["joint1"], got


def torque_is_written_in_place():
    writer, sample = TorqueWriter(REAL, 2**32 - 1), ArmSample(1, 2)
    for k, enabled in enumerate((True, False, True)):
        sample.stamp_ns, sample.session, sample.sequence = 5 * 10**9 + k, 3, k
        got = over_the_wire(writer.answer(sample, enabled, np.array([k + 1.5])))
        assert (got.mode, list(got.torque)) == ((1, [k + 1.5]) if enabled else (0, [0.0])), got
        assert (got.session, got.sequence, got.controller_id) == (3, k, 2**32 - 1), got
        assert (got.header.stamp.sec, got.header.stamp.nanosec) == (5, k), got


def controllers_state_is_written_in_place():
    law = design(MODEL, {"type": "linear_model_following"}, {"type": "lqr"})
    settings = check_all(PARAMETERS, {"max_gap": 10.0}, {"joints": 1, "modes": 2})
    core, writer = ArmController(MODEL, law, settings), CompositeStateWriter(MODEL)
    sample = ArmSample(1, 2)
    sample.session, sample.rate = 1, np.array([0.01, -0.02])
    for k in range(3):
        sample.sequence, sample.stamp_ns = k, 10**9 + 10**6 * k
        sample.position[:], sample.velocity[:] = 0.1 * k, 0.02  # at rest, for the controller
        sample.amplitude[:] = [1e-3, -1e-4 * k]
        assert core.step(sample)
        got = over_the_wire(writer.fill(sample, core, np.float64(1e-4)))
        assert list(got.torque) == core.torque.tolist(), got
        assert k == 0 or list(got.torque) != [0.0], got  # the first is that of a ramp's start
        assert list(got.slow_torque) == law.slow_torque.tolist(), got
        assert list(got.fast_torque) == law.fast_torque.tolist() != [0.0], got
        assert list(got.fast_deviation) == law.deviation.tolist(), got
        assert list(got.quasi_steady_amplitude) == law.quasi_steady.tolist(), got
        assert list(got.position_error) == [-0.1 * k] and list(got.velocity_error) == [-0.02], got
        assert got.supervisor_state == int(core.state) and got.compute_time == 1e-4, got
    # A newer law has answered nothing yet; and without a torque nothing is left of an earlier sample.
    core.law = design(MODEL, {"type": "none"}, {"type": "none"})
    got = over_the_wire(writer.fill(sample, core, 0.0))
    assert list(got.slow_torque) == law.slow_torque.tolist()
    core.disable("because")
    got = over_the_wire(writer.fill(sample, core, 0))
    zero = (got.torque, got.slow_torque, got.fast_torque, got.position_error, got.fast_deviation)
    assert not any(map(any, zero)) and got.rejected_reason == "because", got


def observers_state_is_written_in_place():
    writer, sample = ObserverStateWriter(REAL), ArmSample(1, 2)
    innovation = np.array([1.0, 2.0])
    observer = SimpleNamespace(
        innovation=innovation, covariance_diagonal=np.zeros(0), converged=True
    )
    got = over_the_wire(writer.fill(sample, "x", observer, np.array([0.1, np.nan])))
    assert list(got.innovation) == [1.0, 2.0] and list(got.covariance_diagonal) == [], got
    assert list(got.gauge_health) == [0, 1] and got.converged and got.observer == "x", got
    assert list(over_the_wire(writer.fill(sample, "x", observer, None)).gauge_health) == [1, 1]


WRITERS = (
    state_is_written_in_place,
    torque_is_written_in_place,
    controllers_state_is_written_in_place,
    observers_state_is_written_in_place,
)


@pytest.mark.parametrize("check", WRITERS)
def test_arrays_written_in_place_are_in_the_published_message(check):
    check()


@pytest.mark.slow
def test_arrays_are_written_in_place_whether_fields_are_checked_or_not():
    """What rclpy reads from the environment when it is imported, the other way round."""
    checked = "0" if os.environ.get("ROS_PYTHON_CHECK_FIELDS") == "1" else "1"
    code = f"import runpy; [check() for check in runpy.run_path({__file__!r})['WRITERS']]"
    environment = dict(os.environ, ROS_PYTHON_CHECK_FIELDS=checked)
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)


def test_a_writer_follows_a_change_of_length_and_back():
    writer = StateWriter(ARM)
    for values in ([1.0, 2.0, 3.0, 4.0], None, [5.0, 6.0], [7.0, 8.0], [1.0, 2.0, 3.0, 4.0]):
        writer.write("strain", values)
        assert over_the_wire(writer.message).strain == array("d", values or [])


def test_what_a_writer_wrote_a_reader_reads():
    writer, rng = StateWriter(ARM), np.random.default_rng(0)
    fields = {"joint_position": 3, "joint_velocity": 3, "joint_torque": 3}
    fields |= {"strain": 4, "modal_amplitude": 2, "modal_rate": 2}
    values = {field: rng.standard_normal(size) for field, size in fields.items()}
    for field, value in values.items():
        writer.write(field, value)
    writer.head(2**60, 1, 2)
    sample = read(over_the_wire(writer.message))
    assert sample.stamp_ns == 2**60
    names = ("position", "velocity", "torque", "strain", "amplitude", "rate")
    for name, value in zip(names, values.values(), strict=True):
        np.testing.assert_array_equal(getattr(sample, name), value)


def test_what_a_torque_writer_wrote_a_torque_reader_reads():
    writer, sample = TorqueWriter(ARM, 5), ArmSample(3)
    message = over_the_wire(writer.answer(sample, True, np.array([1.0, -2.0, 3.0])))
    assert TorqueReader(ARM).read(message).tolist() == [1.0, -2.0, 3.0]
    assert TorqueReader(ARM).read(writer.answer(sample, False, np.full(3, NAN))) is None


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_are_nanoseconds_to_the_last_one(ns):
    message = ArmState()
    set_stamp(message.header.stamp, ns)
    assert stamp_ns(over_the_wire(message).header.stamp) == ns


def test_trust_and_whose_torque_acts_go_over_the_wire_and_an_unknown_trust_is_refused():
    writer = StateWriter(ARM)
    writer.write("joint_position", np.zeros(3))
    writer.head(1, 2, 3, controller_id=4)
    writer.trust(ArmSample.STOP, "strain of root: lost")
    sample = read(over_the_wire(writer.message))
    assert (sample.controller_id, sample.trust, sample.doubt) == (
        4,
        ArmSample.STOP,
        "strain of root: lost",
    )
    writer.trust(3, "")
    with pytest.raises(MessageError, match="trust: 3 is no degree of trust"):
        read(writer.message)


@pytest.mark.parametrize("sec", [-(2**31), 0, 2**31 - 1])
@pytest.mark.parametrize("nanosec", [10**9, 2**32 - 1])
def test_a_stamp_with_a_second_of_nanoseconds_is_refused_and_its_answer_can_be_sent(sec, nanosec):
    message, sample = good(), ArmSample(3, 2, 4)
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    with pytest.raises(MessageError) as error:
        StateReader(ARM).read(message, sample)
    assert (error.value.field, error.value.value) == ("header.stamp.nanosec", nanosec)
    answer = over_the_wire(TorqueWriter(ARM, 5).answer(sample, False, np.zeros(3)))
    assert (answer.header.stamp.sec, answer.sequence) == (sec, message.sequence)


@pytest.mark.parametrize("count", [0, 1, 777])
@pytest.mark.parametrize("names", [[], ["joint1"], ["a", "", "shoulder"]])
@pytest.mark.parametrize("frame", ["", "b", "base"])
def test_the_points_of_a_serialised_trajectory_are_counted_without_reading_them(
    count, names, frame
):
    point = JointTrajectoryPoint(positions=[0.1] * len(names))
    message = JointTrajectory(joint_names=names, points=[point] * count)
    message.header.frame_id = frame
    raw = serialize_message(message)
    assert trajectory_points(raw) == count
    for cut in (0, 1, 5, 13):
        with pytest.raises((struct.error, IndexError)):
            trajectory_points(raw[:cut])
