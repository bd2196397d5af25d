# SPDX-License-Identifier: Apache-2.0
"""Declares parameters: one declaration gives type, unit, range, default and description.

The validation, the ROS parameter descriptors and the tables in the documentation come from it. Nothing here uses ROS.
"""

import math
import numbers
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .errors import ParameterError
from .shown import show

_KIND_OF = {float: "float", int: "int", bool: "bool", str: "string"}
KINDS = ("float", "int", "bool", "string", "float_array", "int_array", "string_array")
#: At the end of a length's name: the array may have any number of sets of that length.
SETS = "*"
#: A number that YAML reads as a string.
POWER_OF_TEN = re.compile(r"[+-]?\d+(\.\d*)?[eE][+-]?\d+")


@dataclass(frozen=True)
class Parameter:
    """One declared parameter.

    Parameters
    ----------
    name : str
        Dotted name, without the prefix of the component (`kp`, not `slow.kp`).
    kind : str
        One of `KINDS`.
    default : object
        The default. In a float array, a single element stands for all elements.
    description : str
        What it does, in a sentence.
    unit : str
        The unit; `-` if there is none.
    low, high : float, optional
        Closed range of every element.
    choices : tuple of str, optional
        The values that a string may take.
    length : str or int, optional
        Length of an array: a number, or a name looked up in the sizes given to `check`
        (`joints`, `modes`, `gauges`, `z`, `gain`). An array of one element is spread to that length. A name that
        ends in `*` takes any number of sets of that length.
    read_only : bool
        Whether the value is fixed once the node has started.
    """

    name: str
    kind: str
    default: object
    description: str
    unit: str = "-"
    low: float | None = None
    high: float | None = None
    choices: tuple = ()
    length: str | int | None = None
    read_only: bool = False

    def described(self, text):
        """The same parameter with a description: what it does, in a sentence."""
        return replace(self, description=text)

    def check(self, value, sizes: Mapping[str, int] | None = None, prefix: str = ""):
        """Return `value` in its canonical type, or raise an error if it can't be used.

        Parameters
        ----------
        value : object
            The value as it came from a file, a message or a caller.
        sizes : mapping, optional
            Lengths by name, for arrays whose `length` is a name.
        prefix : str
            Prefix of the name in error messages.

        Returns
        -------
        float, int, bool, str or list
            The value; arrays as lists of their full length.

        Raises
        ------
        ParameterError
            Naming the parameter, the value and the limit.
        """
        where = prefix + self.name
        if self.kind == "bool":
            if not isinstance(value, bool):
                raise _refusal(where, value, "is not a boolean", hint="write true or false")
            return value
        if self.kind == "string":
            if not isinstance(value, str):
                raise _refusal(where, value, "is not a string")
            if self.choices and value not in self.choices:
                choices = ", ".join(self.choices)
                raise _refusal(where, value, "is not one of the choices", limit=choices)
            return value
        if self.kind == "string_array":
            if isinstance(value, str) or not isinstance(value, Sequence):
                raise _refusal(where, value, "is not a list of strings")
            if not all(isinstance(item, str) for item in value):
                raise _refusal(where, list(value), "holds what is not a string")
            return list(value)
        if self.kind == "int_array":
            entries = enumerate(_listed(where, value, "integers"))
            return [self._int(f"{where}[{i}]", v) for i, v in entries]
        if self.kind == "int":
            return self._int(where, value)
        if self.kind == "float":
            return self._float(where, value)
        return self._float_array(where, value, sizes or {})

    def _int(self, where, value):
        if isinstance(value, bool) or not isinstance(value, numbers.Integral):
            raise _refusal(where, value, "is not an integer")
        return int(self._in_range(where, value))

    def _float(self, where, value):
        if isinstance(value, str) and POWER_OF_TEN.fullmatch(value):
            value = float(value)
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise _refusal(where, value, "is not a number")
        if not _is_finite(value):
            raise _refusal(where, value, "is not finite")
        if isinstance(value, numbers.Integral):
            hint = f"write {float(value)}"
            raise _refusal(where, value, "is an integer where a float is needed", hint=hint)
        return float(self._in_range(where, value))

    def _float_array(self, where, value, sizes):
        number = isinstance(value, numbers.Real) and not isinstance(value, bool)
        if number or (isinstance(value, str) and POWER_OF_TEN.fullmatch(value)):
            value = [value]  # one value for all
        value = _listed(where, value, "numbers")
        if value and all(
            isinstance(v, numbers.Integral) and not isinstance(v, bool) and _is_finite(v)
            for v in value
        ):
            problem = "is a list of integers where floats are needed"
            wanted = ", ".join(str(float(v)) for v in value[:12])
            raise _refusal(where, [int(v) for v in value], problem, hint=f"write [{wanted}]")
        out = [self._float(f"{where}[{i}]", v) for i, v in enumerate(value)]
        name = self.length.rstrip(SETS) if isinstance(self.length, str) else ""
        wanted = sizes.get(name) if name else self.length
        if wanted is None or len(out) == wanted:
            return out
        if len(out) == 1:
            return out * wanted
        several = name != self.length and name
        if several and out and wanted and not len(out) % wanted:
            return out
        what = f" ({name})" if name else ""
        problem = f"{len(out)} values where {wanted}{what}{', or sets of so many,' if several else ''} are needed"
        raise ParameterError(problem, field=where, hint="one value stands for all")

    def _in_range(self, where, value):
        if not _is_finite(value):
            raise _refusal(where, value, "is not finite")
        unit = "" if self.unit == "-" else f"{self.unit} "
        if self.low is not None and value < self.low:
            raise _refusal(where, value, f"{unit}is below its lower limit", limit=self.low)
        if self.high is not None and value > self.high:
            raise _refusal(where, value, f"{unit}is above its upper limit", limit=self.high)
        return value


def parameter(name, default, unit="-", low=None, high=None, *, kind=None, **options):
    """Declare a parameter; its kind follows from the default.

    Parameters
    ----------
    name, default, unit, low, high, kind
        As in `Parameter`; `kind` is needed if the default does not show it: an empty list, or None.
    **options
        The other fields of `Parameter`: `choices`, `length`, `read_only`.

    Returns
    -------
    Parameter
        Without a description, which `Parameter.described` adds.

    Examples
    --------
    >>> kp = parameter("kp", [6.25], "1/s^2", 0.0, 1e6, length="joints").described("Position gain.")
    >>> kp.kind
    'float_array'
    """
    if kind is None:
        several = isinstance(default, (list, tuple))
        first = default[0] if several else default
        kind = _KIND_OF[type(first)] + ("_array" if several else "")
    return Parameter(name, kind, default, "", unit, low, high, **options)


def _refusal(where, value, problem, **more):
    """The error for a value; a NumPy scalar is shown as the number that it is."""
    value = value.item() if isinstance(value, np.generic) else value
    return ParameterError(problem, field=where, value=value, **more)


def _listed(where, value, what):
    """The entries of a list, an array or another sequence."""
    if not isinstance(value, str) and hasattr(value, "__len__"):
        try:
            return list(value)
        except TypeError:  # a NumPy array without dimensions has `__len__`, but no length
            pass
    raise _refusal(where, value, f"is not a list of {what}")


def _is_finite(value):
    """Whether it is finite as a float; an integer or a fraction may be too large for a float."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def sizes(model):
    """Lengths of array parameters by the names that declarations use.

    ``joints``, ``modes``, ``gauges``, ``z`` for z_f, and ``gain`` for all numbers of K_f.
    """
    n, m = model.n_joints, model.n_modes
    return {"joints": n, "modes": m, "gauges": len(model.arm.gauges), "z": 2 * m, "gain": 2 * n * m}


def check_all(declared, values, sizes=None, prefix=""):
    """Check a mapping of values against declarations, filling in defaults.

    Parameters
    ----------
    declared : sequence of Parameter
        The parameters that there are.
    values : mapping
        Name to value; a missing parameter takes its default.
    sizes : mapping, optional
        Lengths by name.
    prefix : str
        Prefix of names in error messages.

    Returns
    -------
    dict
        Every declared name with its checked value.

    Raises
    ------
    ParameterError
        For an unknown name or an unusable value.
    """
    known = {p.name: p for p in declared}
    for name in values:
        if name not in known:
            field = prefix + (name if isinstance(name, str) else show(name))
            hint = f"there are {', '.join(sorted(known)) or 'none'}"
            raise ParameterError("no such parameter", field=field, hint=hint)
    return {name: p.check(values.get(name, p.default), sizes, prefix) for name, p in known.items()}


def merge(*groups):
    """Merge declarations of several components under one prefix; a name must have one meaning.

    If one component takes several sets and another a single set, the merged parameter takes several. Each component
    checks its own value.

    `groups` are sequences of `Parameter`.

    Raises
    ------
    ParameterError
        If two components declare a name differently.
    """
    merged: dict[str, Parameter] = {}
    for group in groups:
        for parameter in group:
            other = merged.setdefault(parameter.name, parameter)
            if parameter.length == f"{other.length}{SETS}":
                merged[parameter.name] = parameter
            if _meaning(other) != _meaning(parameter):
                raise ParameterError(
                    f"is declared twice, as {other.kind} [{other.unit}] and as {parameter.kind} [{parameter.unit}]",
                    field=parameter.name,
                    hint="rename it in one of the components",
                )
    return tuple(merged.values())


def _meaning(parameter):
    """What must be equal in two declarations of one name."""
    length = parameter.length
    return (
        parameter.kind,
        length.rstrip(SETS) if isinstance(length, str) else length,
        parameter.unit,
    )
