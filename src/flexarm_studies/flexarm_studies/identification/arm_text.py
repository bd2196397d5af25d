# SPDX-License-Identifier: Apache-2.0
"""Writes an arm file with other values: the text of the given file, its comments kept where that is possible."""

from itertools import pairwise

import numpy as np
import yaml

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.units import to_si
from flexarm_dynamics.errors import FlexarmError

from .quantities import KEY, damping_of

#: Values are written with so many digits, and must be read back as well as that.
DIGITS, AS_GOOD = 8, 1e-6


class _Impossible(Exception):
    """The text can't be edited in place."""


def rewritten(text, identified, heading=()):
    """Text of the arm file with the identified values.

    Parameters
    ----------
    text : str
        Of the file that the fit started from.
    identified : Identified
    heading : sequence of str
        Lines of a comment put before it all.

    Returns
    -------
    str

    Raises
    ------
    FlexarmError
        When what would be written does not read as the identified arm.
    """
    system = (yaml.safe_load(text) or {}).get("units", "si")
    values = _changes(identified, system)
    top = "".join(f"# {line}".rstrip() + "\n" for line in heading)
    for make in (_edited, _dumped):
        try:
            made = top + make(text, values, identified.arm, system)
            if _reads_as(made, identified):
                return made
        except (_Impossible, yaml.YAMLError):
            continue
    raise FlexarmError("the arm file can't be written with these values: write it by hand")


def _reads_as(text, identified):
    try:
        arm = arm_file.parse(text)
    except FlexarmError:
        return False
    return all(
        np.isclose(q.get(arm), v, rtol=AS_GOOD, atol=AS_GOOD * q.scale)
        for q, v in zip(identified.quantities, identified.values, strict=True)
    )


def _changes(identified, system):
    """What is to be changed, nested as the file: keys and indices to text or to what is below."""
    arm, out = identified.arm, {}

    def put(value, dimension, *path):
        at = out
        for key in path[:-1]:
            at = at.setdefault(key, {})
        at[path[-1]] = _number(value, system, dimension)

    for q, width in zip(identified.quantities, identified.half_widths, strict=True):
        if np.isnan(width):
            continue
        value, where = q.get(arm), q.where
        if q.kind == "hub_inertia":
            put(value, q.dimension, "joints", where[0], "hub_inertia")
        elif q.kind in ("viscous", "coulomb"):
            put(value, q.dimension, "joints", where[0], "friction", q.kind)
        elif q.kind == "EI":
            put(value, q.dimension, "links", where[0], KEY[where[1]])
            flexibility = arm.links[where[0]].flexible[where[1]]
            if flexibility.frequencies:
                at = ("links", where[0], "flexible", where[1], "frequencies")
                put(flexibility.frequencies, "frequency", *at)
        elif q.kind == "damping":
            values = damping_of(arm.links[where[0]].flexible[where[1]])
            put(values, q.dimension, "links", where[0], "flexible", where[1], "damping")
        elif q.kind == "payload_mass":
            put(value, q.dimension, "payload", "mass")
        elif q.kind == "payload_inertia":
            put(_inertia(arm), q.dimension, "payload", "inertia")
        else:
            put(value, q.dimension, "gauges", where[0], q.kind)
    return out


def _inertia(arm):
    """One number where that says it all, else xx, yy, zz, xy, xz, yz."""
    i = np.array(arm.payload.inertia)
    if np.allclose(i, i[0, 0] * np.eye(3)):
        return i[0, 0]
    return i[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _number(value, system, dimension):
    if np.ndim(value):
        return "[" + ", ".join(_number(v, system, dimension) for v in value) + "]"
    word = f"{value / to_si(system, dimension):.{DIGITS}g}"
    if "e" in word and "." not in word:  # YAML 1.1 takes 1e-05 for text
        word = word.replace("e", ".0e")
    return word


# In place --------------------------------------------------------------------------------------


def _edited(text, changes, arm, system):
    edits = []
    _collect(yaml.compose(text), changes, edits)
    spans = sorted(edits)
    if any(a[1] > b[0] for a, b in pairwise(spans)):
        raise _Impossible
    for start, end, new in reversed(spans):
        text = text[:start] + new + text[end:]
    return text


def _collect(node, changes, edits):
    """Edits (start, end, new text) of a mapping or list node."""
    if isinstance(node, yaml.SequenceNode):
        for index, below in changes.items():
            _collect(node.value[index], below, edits)
        return
    if not isinstance(node, yaml.MappingNode) or not node.value:
        raise _Impossible
    below = {key.value: value for key, value in node.value}
    if "section" in below and any(k in changes for k in KEY.values()):
        raise _Impossible
    for key, change in changes.items():
        if key not in below:
            _insert(node, key, change, edits)
        elif isinstance(change, dict):
            _collect(below[key], change, edits)
        else:
            start, end = below[key].start_mark.index, below[key].end_mark.index
            if isinstance(below[key], yaml.SequenceNode) and not below[key].flow_style:
                raise _Impossible
            edits.append((start, end, change))


def _insert(node, key, change, edits):
    first = node.value[0][0].start_mark
    word = f"{key}: {_flow(change)}"
    if node.flow_style:
        edits.append((first.index, first.index, f"{word}, "))
    else:
        edits.append((first.index, first.index, f"{word}\n{' ' * first.column}"))


def _flow(change):
    if isinstance(change, dict):
        return "{" + ", ".join(f"{k}: {_flow(v)}" for k, v in change.items()) + "}"
    return change


# As a whole ------------------------------------------------------------------------------------


def _dumped(text, changes, arm, system):
    """The file's data written anew, its comments lost; a section becomes the stiffnesses it stood for."""
    data = yaml.safe_load(text)
    _apply(data, changes)
    for link, own in zip(data["links"], arm.links, strict=True):
        if "section" not in link or not any(k in link for k in KEY.values()):
            continue
        del link["section"]
        link["mass_per_length"] = own.mass_per_length / to_si(system, "mass_per_length")
        link["polar_inertia_per_length"] = own.polar_inertia_per_length / to_si(system, "mass")
        for direction, stiffness in own.stiffness.items():
            link[KEY[direction]] = stiffness / to_si(system, "stiffness")
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


def _apply(data, changes):
    for key, change in changes.items():
        if isinstance(change, dict):
            if isinstance(data, dict) and data.get(key) is None:
                data[key] = {}
            _apply(data[key], change)
        else:
            data[key] = yaml.safe_load(change)
