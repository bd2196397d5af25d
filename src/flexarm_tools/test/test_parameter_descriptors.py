# SPDX-License-Identifier: Apache-2.0
"""Every parameter tells `ros2 param describe` and rqt what it is, in what range, whether it can be set."""

import pytest

from flexarm_ros.parameters import descriptor
from flexarm_tools import parameter_tables

NODES = {
    node: {prefix + p.name: p for prefix, group in groups.items() for p in group}
    for node, groups in parameter_tables.groups().items()
}


@pytest.mark.parametrize("node", NODES)
def test_a_descriptor_has_text_unit_range_and_whether_it_is_read_only(node):
    assert len(NODES[node]) > 4
    for name, parameter in NODES[node].items():
        made = descriptor(parameter)
        assert len(made.description) > 15, name
        assert parameter.unit == "-" or made.description.endswith(f"[{parameter.unit}]"), name
        assert made.read_only is parameter.read_only, name
        spans = [*made.floating_point_range, *made.integer_range]
        if parameter.kind in ("float", "int"):
            (span,) = spans
            assert span.from_value <= parameter.default <= span.to_value, name
            assert len(made.floating_point_range) == (parameter.kind == "float"), name
        else:
            assert not spans, name
        if parameter.kind in ("float_array", "int_array"):  # ROS has ranges for single numbers only
            assert made.additional_constraints, name
        if parameter.choices:
            assert all(choice in made.additional_constraints for choice in parameter.choices), name
