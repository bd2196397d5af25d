# SPDX-License-Identifier: Apache-2.0
"""Declared parameters on a real node: descriptors, refusals, all or nothing, misspelt names."""

import math
import os
from dataclasses import replace
from types import SimpleNamespace

import pytest
import rclpy
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import Parameter, merge
from flexarm_ros.parameters import NodeParameters, descriptor

KP = Parameter(
    "kp", "float_array", [6.25], "Position gain.", unit="1/s^2", low=0.0, high=1e6, length="joints"
)
ALPHA = Parameter("alpha", "float", 5.0, "Degree of stability.", unit="1/s", low=0.0, high=1e3)
COUNT = Parameter("count", "int", 2, "A count.", low=0, high=20)
GAIN = Parameter("gain", "string", "m11", "Which gain.", choices=("m11", "h11"))
LABELS = Parameter("labels", "string_array", ["a"], "Some names.")
SWITCH = Parameter("switch", "bool", True, "On or off.")
ARM = Parameter("arm", "string", "", "Arm file.", read_only=True)
GROUPS = {"": (ARM, SWITCH, COUNT, LABELS), "slow.": (KP, GAIN), "fast.": (ALPHA,)}


@pytest.fixture(scope="module")
def context(domain):
    """A context of rclpy, on this machine only."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    yield context
    rclpy.try_shutdown(context=context)


@pytest.fixture
def make(context):
    """Makes nodes with parameters given at the start."""
    nodes = []

    def make(groups=GROUPS, **overrides):
        given = [RosParameter(k.replace("__", "."), value=v) for k, v in overrides.items()]
        node = Node(
            f"node{len(nodes)}", context=context, parameter_overrides=given, enable_rosout=False
        )
        nodes.append(node)
        return node, NodeParameters(node, groups)

    yield make
    for node in nodes:
        node.destroy_node()


def set_one(node, name, value):
    """Set a parameter as the service does; the result."""
    return node.set_parameters([RosParameter(name, value=value)])[0]


# Descriptors -----------------------------------------------------------------------------------


def test_descriptors_have_unit_range_choices_and_length(make):
    node, _ = make()
    kp = node.describe_parameter("slow.kp")
    assert kp.description == "Position gain. [1/s^2]"
    assert kp.additional_constraints == "from 0.0 to 1000000.0; length joints, or one value for all"
    assert not kp.read_only and len(kp.floating_point_range) == 0  # ROS has none for arrays
    (span,) = node.describe_parameter("fast.alpha").floating_point_range
    assert (span.from_value, span.to_value, span.step) == (0.0, 1e3, 0.0)
    (span,) = node.describe_parameter("count").integer_range
    assert (span.from_value, span.to_value) == (0, 20)
    assert node.describe_parameter("slow.gain").additional_constraints == "one of m11, h11"
    assert node.describe_parameter("switch").description == "On or off."
    assert node.describe_parameter("arm").read_only


def test_one_sided_ranges_are_in_the_text():
    low = descriptor(Parameter("x", "float", 1.0, "X.", low=0.0))
    high = descriptor(Parameter("x", "float", 1.0, "X.", high=2.0))
    assert low.additional_constraints == "at least 0.0"
    assert high.additional_constraints == "at most 2.0"


def test_defaults_and_overrides_are_read_by_full_name_and_by_group(make):
    _, parameters = make(slow__kp=[1.0, 2.0], arm="R", switch=False)
    assert parameters["slow.kp"] == [1.0, 2.0]
    assert parameters["arm"] == "R" and parameters["switch"] is False
    assert parameters.group("slow.") == {"kp": [1.0, 2.0], "gain": "m11"}
    assert parameters.group("slow.", [GAIN, ALPHA]) == {"gain": "m11"}
    assert parameters.group("fast.") == {"alpha": 5.0}
    assert isinstance(parameters["slow.kp"], list)  # not the array.array that rclpy gives


# Refusals at the start ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "field", "problem"),
    (
        ({"slow__kp": [6]}, "slow.kp", "is a list of integers where floats are needed"),
        ({"slow__kp": [-1.0]}, "slow.kp[0]", "1/s^2 is below its lower limit"),
        ({"slow__kp": True}, "slow.kp", "is not a list of numbers"),
        ({"fast__alpha": -1.0}, "fast.alpha", "1/s is below its lower limit"),
        ({"fast__alpha": 1e4}, "fast.alpha", "1/s is above its upper limit"),
        ({"fast__alpha": 5}, "fast.alpha", "is an integer where a float is needed"),
        ({"count": 21}, "count", "is above its upper limit"),
        ({"slow__gain": "m12"}, "slow.gain", "is not one of the choices"),
        ({"arm": 3}, "arm", "is not a string"),
        ({"switch": "yes"}, "switch", "is not a boolean"),
    ),
    ids=str,
)
def test_a_value_given_at_the_start_that_cannot_be_used_is_refused_by_name(
    make, given, field, problem
):
    with pytest.raises(ParameterError) as error:
        make(**given)
    assert (error.value.field, error.value.problem) == (field, problem)


def test_lengths_are_checked_once_the_arm_is_known_and_one_value_is_spread(make):
    node, parameters = make(slow__kp=[1.0, 2.0])
    with pytest.raises(ParameterError, match=r"slow\.kp: 2 values where 3 \(joints\)"):
        parameters.resolve({"joints": 3})
    node, parameters = make()
    parameters.resolve({"joints": 3})
    assert parameters["slow.kp"] == [6.25] * 3
    assert "2 values where 3 (joints)" in set_one(node, "slow.kp", [1.0, 2.0]).reason
    assert set_one(node, "slow.kp", [1.0, 2.0, 3.0]).successful
    assert set_one(node, "slow.kp", [4.0]).successful
    assert parameters["slow.kp"] == [4.0] * 3
    assert set_one(node, "slow.kp", 5.0).successful
    assert parameters["slow.kp"] == [5.0] * 3


# Sets ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    (
        ("slow.kp", [6], "write [6.0]"),
        ("slow.kp", "six", "'six' is not a list of numbers"),
        ("slow.kp", [-1.0], "below its lower limit"),
        ("slow.kp", [math.inf], "not finite"),
        ("fast.alpha", 5, "write 5.0"),
        ("fast.alpha", 1e4, "fast.alpha out of range"),
        ("fast.alpha", math.nan, "fast.alpha"),
        ("count", 21, "count out of range"),
        ("count", True, "count"),
        ("slow.gain", "m12", "not one of the choices"),
        ("labels", [1.0], "labels"),
        ("arm", "P3", "read-only"),
    ),
    ids=str,
)
def test_a_refused_set_gives_the_reason_keeps_the_value_and_notifies_no_one(
    make, name, value, reason
):
    node, parameters = make()
    notified = []
    parameters.on_change(notified.append)
    before = parameters[name]
    result = set_one(node, name, value)
    assert not result.successful
    assert reason in result.reason
    assert parameters[name] == before
    assert (
        node.get_parameter(name).value == before or list(node.get_parameter(name).value) == before
    )
    assert notified == []


def test_a_set_is_applied_once_taken_and_says_what_changed(make):
    node, parameters = make()
    notified = []
    parameters.on_change(lambda names: notified.append((names, parameters["slow.kp"])))
    assert set_one(node, "slow.kp", [9.0]).successful
    assert notified == [({"slow.kp"}, [9.0])]
    both = [RosParameter("slow.kp", value=[1.0]), RosParameter("fast.alpha", value=2.0)]
    assert node.set_parameters_atomically(both).successful
    assert notified[1:] == [({"slow.kp", "fast.alpha"}, [1.0])]


def test_an_atomic_set_is_all_or_nothing(make):
    node, parameters = make()
    notified = []
    parameters.on_change(notified.append)
    for last in (RosParameter("slow.gain", value="m12"), RosParameter("fast.alpha", value=-1.0)):
        result = node.set_parameters_atomically([RosParameter("slow.kp", value=[9.0]), last])
        assert not result.successful and last.name in result.reason
        assert parameters["slow.kp"] == [6.25]
        assert list(node.get_parameter("slow.kp").value) == [6.25]
    assert notified == []


def test_an_undeclared_name_is_refused_and_one_declared_elsewhere_is_none_of_ours(make):
    node, parameters = make()
    notified = []
    parameters.on_change(notified.append)
    with pytest.raises(rclpy.exceptions.ParameterNotDeclaredException, match="undeclared"):
        set_one(node, "slow.kq", [1.0])
    node.declare_parameter("mine", 1)
    assert set_one(node, "mine", 2).successful
    assert notified == []


def test_a_value_that_is_set_later_does_not_change_what_was_read_before(make):
    node, parameters = make()
    kept = parameters.group("slow.")
    assert set_one(node, "slow.kp", [9.0]).successful
    assert kept == {"kp": [6.25], "gain": "m11"}


# Misspelt names ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "warnings"),
    (
        ({"slow__kpp": [1.0]}, ["slow.kpp is not one of this node's; did you mean slow.kp?"]),
        ({"observer__bandwidth": 1.0}, []),  # another node's, in a file for all
        ({"slow__kp": [1.0]}, []),
    ),
    ids=str,
)
def test_a_misspelt_name_is_warned_of_and_another_nodes_is_not(make, monkeypatch, given, warnings):
    log = []
    monkeypatch.setattr(Node, "get_logger", lambda self: SimpleNamespace(warning=log.append))
    make(**given)
    assert log == [f"parameter {text}" for text in warnings]


def test_the_warning_goes_to_the_log_of_the_node(make, capfd):
    rclpy.logging.set_logger_level("node0", LoggingSeverity.INFO)
    make(slow__kpp=[1.0])
    captured = capfd.readouterr()
    assert "did you mean slow.kp?" in captured.err + captured.out


# Merging ---------------------------------------------------------------------------------------


def test_a_name_that_two_laws_share_is_one_parameter_and_must_mean_one_thing():
    assert merge((KP, GAIN), (KP, ALPHA)) == (KP, GAIN, ALPHA)
    sets = replace(KP, length="joints*")
    assert merge((KP, GAIN), (sets,)) == merge((sets, GAIN), (KP,)) == (sets, GAIN)
    other = Parameter("kp", "float_array", [1.0], "Something else.", unit="N m", length="joints")
    with pytest.raises(ParameterError, match=r"kp: is declared twice.*\[1/s\^2\].*\[N m\]"):
        merge((KP,), (other,))


# Values that follow from others ------------------------------------------------------------------


def test_what_is_adopted_leaves_what_the_user_has_set(make):
    node, parameters = make(fast__alpha=7.0)
    seen = []
    parameters.on_change(seen.append)
    assert set_one(node, "count", 3).successful
    parameters.adopt({"fast.alpha": 1.0, "count": 1, "slow.kp": [9.0], "of.others": 1.0})
    assert (parameters["fast.alpha"], parameters["count"]) == (7.0, 3)
    assert parameters["slow.kp"] == [9.0] == list(node.get_parameter("slow.kp").value)
    assert seen == [{"count"}] and "slow.kp" not in parameters.given
    parameters.adopt({"slow.kp": [4.0]})  # a second time
    assert parameters["slow.kp"] == [4.0]


def test_what_can_not_be_adopted_is_refused(make):
    _, parameters = make()
    with pytest.raises(ParameterError, match=r"slow.kp\[0\]: -1.0 .*below its lower limit"):
        parameters.adopt({"slow.kp": [-1.0]})
    assert parameters["slow.kp"] == [6.25]
