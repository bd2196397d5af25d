# SPDX-License-Identifier: Apache-2.0
"""Bridge fields of a gauge in the arm file: read, checked, refused by path."""

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ArmFileError

ARM = """
name: a
joints: [{name: j}]
links: [{name: l, length: 1.0, mass_per_length: 1.0, EI_y: 1.0, flexible: {y: {modes: 1}}}]
gauges: [{name: g, link: l, position: 0.1, surface_distance: 0.001}]
"""


def gauge(**fields):
    tree = yaml.safe_load(ARM)
    tree["gauges"][0].update(fields)
    return arm_file.parse(yaml.safe_dump(tree)).gauges[0]


def test_what_is_not_given_is_an_ideal_bridge_of_a_thousand_microstrain():
    g = gauge()
    assert (g.bits, g.full_scale, g.drift, g.step) == (0, 1e-3, 0.0, 0.0)
    assert g.range == (-1e-3, 1e-3) and g.uncertainty == 0.0


def test_what_is_given_is_read():
    g = gauge(bits=12, full_scale=2e-3, drift=1e-8, noise=1e-6)
    assert (g.bits, g.full_scale, g.drift) == (12, 2e-3, 1e-8)
    assert g.step == 4e-3 / 4096


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("bits", -1, "-1 is out of range (0 to 32)"),
        ("bits", 33, "33 is out of range (0 to 32)"),
        ("bits", 12.0, "12.0 is not an integer"),
        ("bits", True, "True is not an integer"),
        ("full_scale", 0.0, "0.0 is too small"),
        ("full_scale", 1000.0, "1000.0 is too large (at most 0.1); in microstrain?"),
        ("full_scale", float("inf"), "is not finite"),
        ("drift", -1e-9, "-1e-09 is too small (at least 0)"),
        ("drift", "much", "'much' is not a number"),
        ("bias", 20.0, "20.0 is not within full_scale (0.001); in microstrain?"),
        ("bias", -1e-3, "is not within full_scale"),
        ("noise", 0.5, "0.5 is not within full_scale"),
        ("full_scal", 1e-3, "did you mean 'full_scale'?"),
    ],
)
def test_what_can_not_be_is_refused_by_path(field, value, reason):
    with pytest.raises(ArmFileError) as error:
        gauge(**{field: value})
    assert error.value.field == f"gauges[0].{field}"
    assert reason in str(error.value)


@settings(
    derandomize=True,
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],
)
@given(
    st.fixed_dictionaries(
        {},
        optional={
            "bits": st.one_of(st.integers(-2, 40), st.floats(), st.booleans(), st.none()),
            "full_scale": st.one_of(
                st.floats(), st.sampled_from(["", "1e-3", "x"]), st.integers(0, 3)
            ),
            "drift": st.one_of(st.floats(), st.lists(st.floats(), max_size=2)),
            "bias": st.floats(-2e-3, 2e-3),
        },
    )
)
def test_a_gauge_is_whole_or_refused(fields):
    try:
        g = gauge(**fields)
    except ArmFileError as error:
        assert error.field.startswith("gauges[0]")
        return
    low, high = g.range
    assert 0 <= g.bits <= 32 and g.drift >= 0.0 and 0.0 < g.full_scale <= 0.1
    assert low < 0.0 <= high <= g.full_scale and abs(g.bias) < g.full_scale
