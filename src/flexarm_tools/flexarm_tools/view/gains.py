# SPDX-License-Identifier: Apache-2.0
"""Chooses the sliders for a controller's gains: which parameters have one, and its range. No ROS."""

import re
from dataclasses import dataclass, replace

#: Prefixes of the laws' parameters.
LAWS = {"slow.": "flexarm.slow_laws", "fast.": "flexarm.fast_laws"}
#: A slider ends at this multiple of the starting value, within the declared range.
SPAN = 4.0
#: End of a slider whose starting value is zero.
FROM_ZERO = 1.0
STEPS = 400


@dataclass(frozen=True)
class Gain:
    """One number of a parameter, with its slider.

    Attributes
    ----------
    name : str
        Of the parameter.
    index : int or None
        Index into an array; None: the parameter is a single number.
    value, low, high, step : float
        Values of the slider, in the parameter's unit.
    hint : str
        What the gain does.
    owner : str
        Joint or mode to which it belongs; empty: its number is shown.
    unit : str
        Empty: none.
    """

    name: str
    index: int | None
    value: float
    low: float
    high: float
    step: float
    hint: str
    owner: str = ""
    unit: str = ""

    @property
    def label(self):
        """Its text on the page, such as ``slow.kp elbow [1/s^2]``."""
        which = "" if self.index is None else f" {self.owner}" if self.owner else f"[{self.index}]"
        return f"{self.name}{which}" + (f" [{self.unit}]" if self.unit else "")


def of_parameters(values, ranges, hints, laws=None, owners=None):
    """Gains of a controller's parameters.

    Parameters
    ----------
    values : mapping of str to object
        Parameters with their values; floats and arrays of floats that have a range get sliders.
    ranges : mapping of str to (low, high)
    hints : mapping of str to str
    laws : mapping of str to set of str, optional
        Prefix to the names that the active law declares; other names are left out. Names with a prefix that is not in
        it stay.
    owners : mapping of str to sequence of str, optional
        Parameter to the joints or modes to which its numbers belong.

    Returns
    -------
    list of Gain
        In the order of `values`, fast.alpha first.
    """
    out = []
    for name, value in sorted(values.items(), key=lambda item: item[0] != "fast.alpha"):
        prefix = name.split(".")[0] + "."
        if prefix not in LAWS or name not in ranges:
            continue
        if laws and prefix in laws and name[len(prefix) :] not in laws[prefix]:
            continue
        many = isinstance(value, (list, tuple))
        for i, number in enumerate(value if many else [value]):
            if isinstance(number, float):
                low, high = span(number, *ranges[name])
                gain = Gain(name, i if many else None, number, low, high, 0.0, hints.get(name, ""))
                whose = (owners or {}).get(name, ())
                owner = whose[i] if many and len(whose) == len(value) else ""
                unit = unit_of(gain.hint)
                out.append(replace(gain, step=(high - low) / STEPS, owner=owner, unit=unit))
    return out


def unit_of(description):
    """The unit with which a parameter's description ends; empty without one."""
    found = re.search(r"\[([^][]+)\]$", description)
    return found[1] if found else ""


def owners_of(constraints, arm):
    """Joints or modes to which the numbers of an array belong, from a descriptor's text such as ``length joints``."""
    found = re.search(r"length (\w+)", constraints)
    names = {"joints": arm.joint_names, "modes": arm.mode_names}
    return tuple(names.get(found[1], ())) if found else ()


def span(value, low, high):
    """Ends of a slider that starts at `value`, within the declared range `low` to `high`."""
    size = SPAN * abs(value) or FROM_ZERO
    return max(low, -size if low < 0.0 else 0.0), min(high, size)


def range_of(constraints):
    """(low, high) of a descriptor's text such as ``from 0.0 to 100.0; length joints``; None without one."""
    found = re.search(r"from (\S+) to ([^\s;]+)", constraints)
    return (float(found[1]), float(found[2])) if found else None


def changed(values, changes):
    """Whole values of parameters after `changes` of numbers in them, a mapping of (name, index) to float."""
    out = {}
    for (name, index), number in changes.items():
        if index is None:
            out[name] = float(number)
        else:
            out.setdefault(name, list(values[name]))[index] = float(number)
    return out
