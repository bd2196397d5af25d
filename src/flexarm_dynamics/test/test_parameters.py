# SPDX-License-Identifier: Apache-2.0
"""Declared parameters: what is taken, what is refused and with which words."""

import array
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import KINDS, Parameter, check_all
from flexarm_dynamics.shown import number

KP = Parameter("kp", "float_array", [6.25], "Gain.", "1/s^2", low=0.0, high=1e4, length="joints")
ALPHA = Parameter("alpha", "float", 5.0, "Degree of stability.", "1/s", low=0.0, high=100.0)
COUNT = Parameter("count", "int", 3, "How many.", low=1, high=10)
LAW = Parameter("law", "string", "pd", "Which.", choices=("pd", "lqr"))
NAMES = Parameter("names", "string_array", [], "Names.")
SWITCH = Parameter("switch", "bool", False, "On or off.")
ALL = (KP, ALPHA, COUNT, LAW, NAMES, SWITCH)


def refused(parameter, value, **more):
    with pytest.raises(ParameterError) as error:
        parameter.check(value, **more)
    return str(error.value)


def test_a_list_of_integers_is_told_how_to_write_floats():
    """What `ros2 param set /controller slow.kp "[6]"` gives."""
    message = refused(KP, [6], sizes={"joints": 1}, prefix="slow.")
    assert message == ("slow.kp: [6] is a list of integers where floats are asked for: write [6.0]")
    assert refused(KP, array.array("q", [6, -2])).endswith("write [6.0, -2.0]")
    assert refused(KP, np.array([6])).endswith("write [6.0]")


def test_an_integer_is_told_how_to_write_a_float():
    message = refused(ALPHA, 5, prefix="fast.")
    assert message == "fast.alpha: 5 is an integer where a float is asked for: write 5.0"
    assert refused(KP, [6.0, 7]) == ("kp[1]: 7 is an integer where a float is asked for: write 7.0")


def test_one_value_stands_for_every_joint():
    assert KP.check([2.5], {"joints": 3}) == [2.5, 2.5, 2.5]
    assert KP.check([1.0, 2.0], {"joints": 2}) == [1.0, 2.0]


def test_a_list_of_the_wrong_length_is_told_the_right_one():
    assert refused(KP, [1.0, 2.0], sizes={"joints": 3}) == (
        "kp: 2 values where 3 (joints) are needed; one value stands for all"
    )
    assert refused(KP, [], sizes={"joints": 3}).startswith("kp: 0 values where 3")
    fixed = Parameter("xyz", "float_array", [0.0], "Where.", length=3)
    assert fixed.check([1.0]) == [1.0, 1.0, 1.0]
    assert refused(fixed, [1.0, 2.0]) == (
        "xyz: 2 values where 3 are needed; one value stands for all"
    )


def test_lists_of_free_length_stay_as_they_are():
    free = Parameter("any", "float_array", [], "Anything.")
    assert free.check([]) == []
    assert free.check([1.5, 2.5]) == [1.5, 2.5]
    assert KP.check([1.0, 2.0, 3.0]) == [1.0, 2.0, 3.0]  # the size is not known here


def test_arrays_of_every_make_become_lists_of_float():
    for value in ([1.5, 2.0], (1.5, 2.0), array.array("d", [1.5, 2.0]), np.array([1.5, 2.0])):
        checked = KP.check(value, {"joints": 2})
        assert checked == [1.5, 2.0]
        assert all(type(v) is float for v in checked)
    assert type(ALPHA.check(np.float32(0.5))) is float
    assert type(COUNT.check(np.int32(4))) is int


def test_limits_belong_to_the_range():
    for value in (0.0, 100.0):
        assert ALPHA.check(value) == value
    for value in (1, 10):
        assert COUNT.check(value) == value


@pytest.mark.parametrize(
    "parameter, value, message",
    [
        (ALPHA, -1e-9, "alpha: -1e-09 is below its lower limit 0.0 [1/s]"),
        (ALPHA, 100.1, "alpha: 100.1 is above its upper limit 100.0 [1/s]"),
        (ALPHA, math.nan, "alpha: nan is not finite"),
        (ALPHA, np.float32("nan"), "alpha: nan is not finite"),
        (ALPHA, math.inf, "alpha: inf is not finite"),
        (ALPHA, 10**400, f"alpha: {number(10**400)} is not finite"),
        (ALPHA, Fraction(10**400), f"alpha: {number(10**400)} is not finite"),
        (ALPHA, "5.0", "alpha: '5.0' is not a number"),
        (ALPHA, True, "alpha: True is not a number"),
        (ALPHA, None, "alpha: None is not a number"),
        (ALPHA, [5.0], "alpha: [5.0] is not a number"),
        (KP, [1.0, -1.0], "kp[1]: -1.0 is below its lower limit 0.0 [1/s^2]"),
        (KP, [1.0, math.nan], "kp[1]: nan is not finite"),
        (KP, [True], "kp[0]: True is not a number"),
        (KP, [10**400], f"kp[0]: {number(10**400)} is not finite"),
        (KP, "6.25", "kp: '6.25' is not a list of numbers"),
        (KP, 6.25, "kp: 6.25 is not a list of numbers"),
        (KP, ["6.25"], "kp[0]: '6.25' is not a number"),
        (COUNT, 0, "count: 0 is below its lower limit 1 [-]"),
        (COUNT, 11, "count: 11 is above its upper limit 10 [-]"),
        (COUNT, 3.0, "count: 3.0 is not an integer"),
        (COUNT, True, "count: True is not an integer"),
        (LAW, "pid", "law: 'pid' is not one of pd, lqr"),
        (LAW, 1, "law: 1 is not a string"),
        (NAMES, "a", "names: 'a' is not a list of strings"),
        (NAMES, ["a", 1], "names: ['a', 1] holds what is not a string"),
        (NAMES, None, "names: None is not a list of strings"),
        (SWITCH, 1, "switch: 1 is not a boolean: write true or false"),
        (SWITCH, "true", "switch: 'true' is not a boolean: write true or false"),
    ],
    ids=lambda v: v.name if isinstance(v, Parameter) else None,
)
def test_what_can_not_be_used_is_refused_with_the_reason(parameter, value, message):
    assert refused(parameter, value) == message


def test_strings_and_switches_pass():
    assert LAW.check("lqr") == "lqr"
    assert Parameter("free", "string", "", "Text.").check("anything") == "anything"
    assert NAMES.check(("a", "b")) == ["a", "b"]
    assert SWITCH.check(True) is True


def test_defaults_fill_in_what_is_not_given():
    values = check_all(ALL, {"alpha": 2.0}, {"joints": 2})
    assert values == {
        "kp": [6.25, 6.25],
        "alpha": 2.0,
        "count": 3,
        "law": "pd",
        "names": [],
        "switch": False,
    }


def test_an_unknown_parameter_is_refused_with_what_there_is():
    with pytest.raises(ParameterError) as error:
        check_all((KP, ALPHA), {"kd": 1.0}, prefix="slow.")
    assert str(error.value) == "slow.kd: no such parameter; there are alpha, kp"
    with pytest.raises(ParameterError, match="there are none"):
        check_all((), {"kd": 1.0})


def test_the_prefix_is_in_every_message():
    with pytest.raises(ParameterError, match=r"^fast\.alpha: nan"):
        check_all(ALL, {"alpha": math.nan}, prefix="fast.")


def test_a_checked_list_is_nobody_elses():
    given_list = [1.0, 2.0]
    KP.check(given_list, {"joints": 2})[0] = 9.0
    NAMES.check(NAMES.default).append("x")
    assert given_list == [1.0, 2.0]
    assert NAMES.default == []


ANYTHING = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.just(-(10**400)),
        st.floats(),
        st.fractions(),
        st.decimals(),
        st.complex_numbers(),
        st.text(max_size=5),
        st.binary(max_size=5),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.tuples(inner),
        st.dictionaries(st.text(max_size=3), inner, max_size=3),
    ),
    max_leaves=6,
)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(value=ANYTHING, size=st.integers(1, 3))
def test_any_value_is_canonical_or_a_parameter_error(kind, value, size):
    parameter = Parameter("p", kind, None, "Anything.", low=-5, high=5, length="joints")
    try:
        checked = parameter.check(value, {"joints": size})
    except ParameterError as error:
        assert str(error).startswith("p")
        return
    wanted = {"float": float, "int": int, "bool": bool, "string": str}
    if kind == "float_array":
        assert len(checked) == size
        assert all(type(v) is float and -5 <= v <= 5 for v in checked)
    elif kind == "int_array":
        assert all(type(v) is int and -5 <= v <= 5 for v in checked)
    elif kind == "string_array":
        assert all(isinstance(v, str) for v in checked)
    else:
        assert type(checked) is wanted[kind]
    assert parameter.check(checked, {"joints": size}) == checked


def test_an_integer_array_names_the_element_that_is_none():
    cpus = Parameter("cpus", "int_array", [], "Some numbers.", low=0, high=7)
    assert cpus.check([]) == []
    assert cpus.check([0, 7]) == [0, 7]
    with pytest.raises(ParameterError, match=r"^cpus\[1\]: 8 is above its upper limit 7"):
        cpus.check([0, 8])
    with pytest.raises(ParameterError, match=r"^cpus\[0\]: 1.0 is not an integer"):
        cpus.check([1.0])
    with pytest.raises(ParameterError, match="not a list of integers"):
        cpus.check(3)
