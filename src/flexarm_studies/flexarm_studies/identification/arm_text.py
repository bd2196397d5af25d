# SPDX-License-Identifier: Apache-2.0
"""Writes an arm file with identified values: replaces numbers in the text of the given file, keeps its comments."""

import io

import numpy as np
from ruamel.yaml import YAML, YAMLError
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.util import load_yaml_guess_indent

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.units import to_si
from flexarm_dynamics.errors import FlexarmError

from .quantities import KEY, damping_of

#: Significant digits of the written values, and the relative error allowed when they are read back [-].
DIGITS, TOLERANCE = 8, 1e-6
#: Kind of a `Quantity`: the error of a joint's zero angle; it turns the joint's origin.
OFFSET = "offset"
#: Line width of the written YAML: so large that a gauge or a section stays on one line.
WIDTH = 4096


class _Number(str):
    """A number as it stands in the file."""


def rewritten(text, identified, heading=(), notes=None):
    """The `text` of the arm file from which the fit started, with the `identified` values, below a comment, `heading`.

    `notes` maps names of quantities to comments. A comment is written behind its number if the number has a line of its
    own. The new text is read back; it is refused if this does not give the identified arm.
    """
    try:
        made = _edited(text, identified, notes or {})
    except (YAMLError, LookupError, TypeError, AttributeError) as error:
        raise FlexarmError(
            f"can't be edited: {error}", field="arm file", hint="write the values by hand"
        ) from error
    made = "".join(f"# {line}".rstrip() + "\n" for line in heading) + made
    arm = arm_file.parse(made)
    for quantity, value in zip(identified.quantities, identified.values, strict=True):
        if quantity.kind == OFFSET:
            continue
        if not np.isclose(
            quantity.get(arm), value, rtol=TOLERANCE, atol=TOLERANCE * quantity.scale
        ):
            raise FlexarmError(
                "is not what the written arm file reads as", field=quantity.name, value=value, limit=quantity.get(arm),
                hint="write the values by hand",
            )  # fmt: skip
    turns = [np.array([j.origin_rpy for j in a.joints]) for a in (arm, identified.arm)]
    if not np.allclose(*turns, atol=TOLERANCE):
        raise FlexarmError(
            "is not what the written arm file reads as", field="origin of a joint", value=turns[1],
            limit=turns[0], hint="write the values by hand",
        )  # fmt: skip
    return made


def _edited(text, identified, notes):
    yaml = YAML()
    yaml.preserve_quotes, yaml.width = True, WIDTH
    yaml.representer.add_representer(
        _Number, lambda r, number: r.represent_scalar("tag:yaml.org,2002:float", number)
    )
    data, indent, offset = load_yaml_guess_indent(text, yaml=yaml)
    if indent is not None:
        yaml.indent(mapping=2, sequence=indent, offset=offset or 0)
    system = data.get("units", "si")
    changes = list(_changes(identified))
    for i in {
        path[1] for _, _, path, _ in changes if path[0] == "links" and path[2] in KEY.values()
    }:
        if "section" in data["links"][i]:
            _without_section(data["links"][i], identified.arm.links[i], system)
    beside = {}
    for value, dimension, path, name in changes:
        _put(data, path, _number(value, system, dimension))
        if name in notes:
            beside.setdefault(path, []).append(notes[name])
    for path, words in beside.items():
        _note(data, path, "; ".join(words))
    out = io.StringIO()
    yaml.dump(data, out)
    return out.getvalue()


def _changes(identified):
    """Yield value (SI), dimension, path in the file, and name of everything that the fit determined."""
    for q, width in zip(identified.quantities, identified.half_widths, strict=True):
        if not np.isnan(width):
            for value, dimension, path in _change(identified.arm, q):
                yield value, dimension, path, q.name


#: Kinds with an index of a joint, link or gauge: list and keys in the file.
_PLACES = {
    "hub_inertia": ("joints", "hub_inertia"),
    "motor_mass": ("joints", "motor_mass"),
    "viscous": ("joints", "friction", "viscous"),
    "coulomb": ("joints", "friction", "coulomb"),
    "mass_per_length": ("links", "mass_per_length"),
}


def _change(arm, q):
    """Value, dimension and path of each entry in the file that a quantity changes."""
    where, dimension = q.where, q.dimension
    if q.kind == OFFSET:
        yield arm.joints[where[0]].origin_rpy, "angle", ("joints", where[0], "origin", "rpy")
        return
    value = q.get(arm)
    if q.kind in _PLACES:
        part, *keys = _PLACES[q.kind]
        yield value, dimension, (part, where[0], *keys)
    elif q.kind.startswith("transmission_"):
        path = ("joints", where[0], "transmission", q.kind.removeprefix("transmission_"))
        yield value, dimension, path
    elif q.kind == "EI":
        yield value, dimension, ("links", where[0], KEY[where[1]])
        flexibility = arm.links[where[0]].flexible[where[1]]
        if flexibility.frequencies:
            path = ("links", where[0], "flexible", where[1], "frequencies")
            yield flexibility.frequencies, "frequency", path
    elif q.kind == "damping":
        values = damping_of(arm.links[where[0]].flexible[where[1]])
        yield values, dimension, ("links", where[0], "flexible", where[1], "damping")
    elif q.kind == "payload_mass":
        yield value, dimension, ("payload", "mass")
    elif q.kind == "payload_inertia":
        yield _inertia(arm), dimension, ("payload", "inertia")
    else:
        yield value, dimension, ("gauges", where[0], q.kind)


def _inertia(arm):
    """The payload's inertia: one number if it is the same about all axes, otherwise xx, yy, zz, xy, xz, yz."""
    i = np.array(arm.payload.inertia)
    if np.allclose(i, i[0, 0] * np.eye(3)):
        return i[0, 0]
    return i[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _number(value, system, dimension):
    if np.ndim(value):
        row = CommentedSeq(_number(v, system, dimension) for v in value)
        row.fa.set_flow_style()
        return row
    text = f"{value / to_si(system, dimension):.{DIGITS}g}"
    if "." not in text:  # YAML 1.1 takes 1e-05 for text
        head, e, exponent = text.partition("e")
        text = f"{head}.0{e}{exponent}"
    return _Number(text)


def _put(data, path, value):
    """Set an entry and keep the comments around it; keys missing on its path are added after the first key."""
    for key in path[:-1]:
        if isinstance(data, CommentedMap) and data.get(key) is None:
            _add(data, key, CommentedMap())
            data[key].fa.set_flow_style()
        data = data[key]
    key = path[-1]
    if isinstance(value, list) and isinstance(data.get(key), list) and len(data[key]) == len(value):
        data[key][:] = value
    elif key in data:
        data[key] = value
    else:
        _add(data, key, value)


def _note(data, path, words):
    """Write a comment behind an entry and replace an existing one; does nothing in a mapping on one line."""
    for key in path[:-1]:
        if isinstance(data, CommentedMap) and data.fa.flow_style():
            return
        data = data[key]
    if isinstance(data, CommentedMap) and not data.fa.flow_style():
        data.yaml_add_eol_comment(words, path[-1])


def _add(data, key, value):
    # Not at the end: the comment before the file's next part is attached there.
    data.pop(key, None)
    data.insert(min(1, len(data)), key, value)


def _without_section(link, own, system):
    """Replace a link's section by the mass, the inertia and the stiffnesses that follow from it."""
    at, comment = list(link).index("section"), link.ca.items.get("section")
    del link["section"]
    values = {"mass_per_length": (own.mass_per_length, "mass_per_length")}
    values["polar_inertia_per_length"] = (own.polar_inertia_per_length, "mass")
    values |= {KEY[d]: (stiffness, "stiffness") for d, stiffness in own.stiffness.items()}
    for i, (key, (value, dimension)) in enumerate(values.items()):
        number = _number(value, system, dimension)
        if key in link:
            link[key] = number
        else:
            link.insert(at + i, key, number)
    if comment is not None:
        link.ca.items["mass_per_length"] = comment
