# SPDX-License-Identifier: Apache-2.0
"""Turns declared parameters into ROS parameters: descriptors, validation, and what changed."""

import difflib

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterValueException
from rclpy.parameter import Parameter

from flexarm_dynamics.errors import FlexarmError, ParameterError
from flexarm_dynamics.parameters import SETS


def descriptor(parameter):
    """The ROS descriptor of a declared parameter: text for people, a range for sliders."""
    text = parameter.description + (f" [{parameter.unit}]" if parameter.unit != "-" else "")
    limits = []
    if parameter.low is not None and parameter.high is not None:
        limits.append(f"from {parameter.low} to {parameter.high}")
    elif parameter.low is not None:
        limits.append(f"at least {parameter.low}")
    elif parameter.high is not None:
        limits.append(f"at most {parameter.high}")
    if parameter.choices:
        limits.append("one of " + ", ".join(parameter.choices))
    if parameter.length is not None:
        length = str(parameter.length).replace(SETS, " or a multiple")
        limits.append(f"length {length}, or one value for all")
    out = ParameterDescriptor(
        description=text,
        additional_constraints="; ".join(limits),
        read_only=parameter.read_only,
        # Our own check looks at the type: its error message states what to write instead.
        dynamic_typing=True,
    )
    if parameter.low is not None and parameter.high is not None:
        if parameter.kind == "float":
            span = FloatingPointRange(
                from_value=float(parameter.low), to_value=float(parameter.high)
            )
            out.floating_point_range = [span]
        elif parameter.kind == "int":
            out.integer_range = [IntegerRange(from_value=parameter.low, to_value=parameter.high)]
    return out


def _give_empty_list(node, name, parameter):
    """Replace None by an empty list: ROS reads ``[]`` in a parameter file, as `ros2 param dump` writes it, as None."""
    given = node._parameter_overrides.get(name)
    if given is not None and given.value is None and parameter.kind.endswith("array"):
        node._parameter_overrides[name] = Parameter(name, value=[])


class NodeParameters:
    """All parameters of one node.

    Parameters
    ----------
    node : rclpy.node.Node
    groups : mapping
        Prefix (``""``, ``"slow."``) to the declared parameters under it.

    Raises
    ------
    ParameterError
        If a value given at the start can't be used.

    Attributes
    ----------
    given : set of str
        Full names of the parameters that the user has set, at the start or later. A file for all nodes adds also names
        that this node does not have.
    """

    def __init__(self, node, groups):
        self._node = node
        self._declared = {
            prefix + p.name: (prefix, p) for prefix, group in groups.items() for p in group
        }
        self._sizes = {}
        self._listener = self._judge = None
        for name, (prefix, parameter) in self._declared.items():
            _give_empty_list(node, name, parameter)
            try:
                node.declare_parameter(name, parameter.default, descriptor(parameter))
            except InvalidParameterValueException as error:
                # A scalar out of range: our own check reports it with the unit.
                parameter.check(node._parameter_overrides[name].value, prefix=prefix)
                raise ParameterError(f"{name}: {error}") from None
        self.given = set(node._parameter_overrides)
        self._warn_unknown()
        self._values = self._checked(self._given())
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._on_applied)

    def _warn_unknown(self):
        """Warn of a misspelt name in a parameter file, which ROS ignores.

        One file may serve all nodes, so warn only of names that are similar to one of this node's.
        """
        known = set(self._declared) | set(self._node._parameters)
        for name in self._node._parameter_overrides:
            close = difflib.get_close_matches(name, self._declared, 1, cutoff=0.75)
            if name not in known and close:
                self._node.get_logger().warning(
                    f"parameter {name} is not one of this node's; did you mean {close[0]}?"
                )

    def resolve(self, sizes):
        """Check again, with the lengths that are known when the arm is loaded.

        `sizes` maps the names that declarations use as lengths, for example ``joints``, to numbers.

        Raises
        ------
        ParameterError
        """
        self._sizes = dict(sizes)
        self._values = self._checked(self._given())

    def adopt(self, values):
        """Take `values` by full names for all parameters that the user has not set; no listener is called.

        Raises
        ------
        ParameterError
            For a value that can't be used.
        """
        new = {k: v for k, v in values.items() if k in self._declared and k not in self.given}
        new = [Parameter(k, value=v) for k, v in new.items() if v != self._values[k]]
        listener, given, self._listener = self._listener, set(self.given), None
        try:
            done = self._node.set_parameters_atomically(new)
        finally:
            self._listener, self.given = listener, given
        if not done.successful:
            raise ParameterError(done.reason)

    def on_change(self, listener):
        """Call ``listener(set of changed names)`` after a set has been taken."""
        self._listener = listener

    def judged_by(self, judge):
        """Call ``judge(all values by full names)`` before a set is taken; its `FlexarmError` refuses the set."""
        self._judge = judge

    def __getitem__(self, name):
        return self._values[name]

    def values(self):
        """All values by their full names."""
        return dict(self._values)

    def group(self, prefix, declared=None):
        """Values under a prefix, by names without it; only those of the parameters `declared`, if given."""
        names = None if declared is None else {p.name for p in declared}
        return {
            p.name: self._values[full]
            for full, (of, p) in self._declared.items()
            if of == prefix and (names is None or p.name in names)
        }

    def _given(self):
        """All values as the node holds them."""
        return {name: self._node.get_parameter(name).value for name in self._declared}

    def _checked(self, given):
        """Check the `given` values, by full names; parameters not declared here, such as rclpy's, are left out."""
        values = {}
        for name, value in given.items():
            if name in self._declared:
                prefix, parameter = self._declared[name]
                if hasattr(value, "tolist"):  # arrays come as array.array
                    value = value.tolist()
                values[name] = parameter.check(value, self._sizes, prefix)
        return values

    def _on_set(self, parameters):
        # Only validate: nothing is applied here, so a refused set changes nothing.
        try:
            changed = self._checked({p.name: p.value for p in parameters})
            if changed and self._judge is not None:
                self._judge({**self._values, **changed})
        except FlexarmError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_applied(self, parameters):
        changed = self._checked({p.name: p.value for p in parameters})
        if not changed:
            return
        self._values = {**self._values, **changed}
        self.given |= set(changed)
        if self._listener is not None:
            self._listener(set(changed))
