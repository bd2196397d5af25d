# SPDX-License-Identifier: Apache-2.0
"""Declared parameters: what is accepted, and what is refused, why."""

import array
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import KINDS, Parameter, check_all, parameter

KP = Parameter("kp", "float_array", [6.25], "Gain.", "1/s^2", low=0.0, high=1e4, length="joints")
ALPHA = Parameter("alpha", "float", 5.0, "Degree of stability.", "1/s", low=0.0, high=100.0)
COUNT = Parameter("count", "int", 3, "How many.", low=1, high=10)
LAW = Parameter("law", "string", "pd", "Which.", choices=("pd", "lqr"))
NAMES = Parameter("names", "string_array", [], "Names.")
CPUS = Parameter("cpus", "int_array", [], "Some numbers.", low=0, high=7)
SWITCH = Parameter("switch", "bool", False, "On or off.")
ALL = (KP, ALPHA, COUNT, LAW, NAMES, SWITCH)


def refused(parameter, value, **more):
    with pytest.raises(ParameterError) as error:
        parameter.check(value, **more)
    return error.value


@pytest.mark.parametrize(
    "parameter, value, field, hint",
    [
        (KP, [6], "kp", "write [6.0]"),  # ros2 param set /controller slow.kp "[6]"
        (KP, array.array("q", [6, -2]), "kp", "write [6.0, -2.0]"),
        (KP, np.array([6]), "kp", "write [6.0]"),
        (KP, [6.0, 7], "kp[1]", "write 7.0"),
        (ALPHA, 5, "alpha", "write 5.0"),
    ],
)
def test_integers_are_refused_with_how_to_write_a_float(parameter, value, field, hint):
    error = refused(parameter, value)
    assert (error.field, error.hint) == (field, hint)


def test_one_value_stands_for_every_joint():
    assert KP.check([2.5], {"joints": 3}) == [2.5, 2.5, 2.5]
    assert KP.check([1.0, 2.0], {"joints": 2}) == [1.0, 2.0]


def test_a_list_of_the_wrong_length_is_refused_with_the_right_one():
    assert str(refused(KP, [1.0, 2.0], sizes={"joints": 3})) == (
        "kp: 2 values where 3 (joints) are needed; one value stands for all"
    )
    assert refused(KP, [], sizes={"joints": 3}).problem.startswith("0 values where 3")
    fixed = Parameter("xyz", "float_array", [0.0], "Where.", length=3)
    assert fixed.check([1.0]) == [1.0, 1.0, 1.0]
    assert refused(fixed, [1.0, 2.0]).problem == "2 values where 3 are needed"


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


def test_one_number_stands_for_all_and_a_power_of_ten_that_yaml_leaves_a_string_is_a_number():
    assert KP.check(6.25, {"joints": 2}) == [6.25, 6.25]
    assert KP.check("1e1", {"joints": 2}) == KP.check(["1e1"], {"joints": 2}) == [10.0, 10.0]
    assert ALPHA.check("1e1") == 10.0


def test_limits_belong_to_the_range():
    for value in (0.0, 100.0):
        assert ALPHA.check(value) == value
    for value in (1, 10):
        assert COUNT.check(value) == value


@pytest.mark.parametrize(
    "parameter, value, field, problem, limit",
    [
        (ALPHA, -1e-9, "alpha", "1/s is below its lower limit", 0.0),
        (ALPHA, 100.1, "alpha", "1/s is above its upper limit", 100.0),
        (ALPHA, math.nan, "alpha", "is not finite", None),
        (ALPHA, np.float32("nan"), "alpha", "is not finite", None),
        (ALPHA, math.inf, "alpha", "is not finite", None),
        (ALPHA, 10**400, "alpha", "is not finite", None),
        (ALPHA, Fraction(10**400), "alpha", "is not finite", None),
        (ALPHA, "5.0", "alpha", "is not a number", None),
        (ALPHA, True, "alpha", "is not a number", None),
        (ALPHA, None, "alpha", "is not a number", None),
        (ALPHA, [5.0], "alpha", "is not a number", None),
        (KP, [1.0, -1.0], "kp[1]", "1/s^2 is below its lower limit", 0.0),
        (KP, [1.0, math.nan], "kp[1]", "is not finite", None),
        (KP, [True], "kp[0]", "is not a number", None),
        (KP, [10**400], "kp[0]", "is not finite", None),
        (KP, "6.25", "kp", "is not a list of numbers", None),
        (KP, True, "kp", "is not a list of numbers", None),
        (KP, ["6.25"], "kp[0]", "is not a number", None),
        (COUNT, 0, "count", "is below its lower limit", 1),
        (COUNT, 11, "count", "is above its upper limit", 10),
        (COUNT, 3.0, "count", "is not an integer", None),
        (COUNT, True, "count", "is not an integer", None),
        (CPUS, [0, 8], "cpus[1]", "is above its upper limit", 7),
        (CPUS, [1.0], "cpus[0]", "is not an integer", None),
        (CPUS, 3, "cpus", "is not a list of integers", None),
        (LAW, "pid", "law", "is not one of the choices", "pd, lqr"),
        (LAW, 1, "law", "is not a string", None),
        (NAMES, "a", "names", "is not a list of strings", None),
        (NAMES, ["a", 1], "names", "holds what is not a string", None),
        (NAMES, None, "names", "is not a list of strings", None),
        (SWITCH, 1, "switch", "is not a boolean", None),
        (SWITCH, "true", "switch", "is not a boolean", None),
    ],
    ids=lambda v: v.name if isinstance(v, Parameter) else None,
)
def test_what_can_not_be_used_is_refused_with_the_reason(parameter, value, field, problem, limit):
    error = refused(parameter, value, prefix="fast.")
    assert (error.field, error.problem, error.limit) == (f"fast.{field}", problem, limit)
    bad = value[int(field[-2])] if field.endswith("]") else value
    assert error.value == bad or (
        error.value != error.value and bad != bad
    )  # the same, or both NaN
    assert type(error.value) in (type(bad), float)


def test_a_refusal_is_written_out_with_value_unit_and_limit():
    assert str(refused(ALPHA, 100.1)) == "alpha: 100.1 1/s is above its upper limit (100.0)"
    assert str(refused(LAW, "pid")) == "law: 'pid' is not one of the choices (pd, lqr)"
    assert str(refused(SWITCH, 1)) == "switch: 1 is not a boolean; write true or false"
    assert str(refused(ALPHA, np.float32("nan"))) == "alpha: nan is not finite"


@pytest.mark.parametrize("wanted", [KP, ALPHA, COUNT, LAW, SWITCH], ids=lambda p: p.name)
def test_a_short_declaration_takes_its_kind_from_the_default(wanted):
    p = wanted
    more = {"choices": p.choices, "length": p.length}
    short = parameter(p.name, p.default, p.unit, p.low, p.high, **more)
    assert short.described(p.description) == p
    assert parameter("cpus", [], kind="int_array").kind == "int_array"


def test_strings_switches_and_integers_pass():
    assert CPUS.check([]) == [] and CPUS.check([0, 7]) == [0, 7]
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


def test_a_checked_list_is_a_copy():
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
