# SPDX-License-Identifier: Apache-2.0
"""Reads YAML files that people write, with checks; an error names its entry by its path, such as ``links[0].length``.

PyYAML reads them, and `_check_keys` refuses a key that is given twice. ruamel.yaml refuses one too, but without its
path, takes three times as long, and reads YAML 1.1 differently: `direction: y` would be `true`, `name: 1e3` a number.
"""

import difflib
import math

import yaml

from ..errors import ArmFileError
from ..shown import number, show
from .units import SI_UNIT, to_si

#: Largest number in a file; powers and products of smaller ones are finite.
MAX_NUMBER = 1e30


def read_yaml(text, where):
    """The `text` of the file `where` as dicts, lists and scalars; refuses a key that is given twice."""
    try:
        loader = yaml.SafeLoader(text)
        root = loader.get_single_node()
        if root is None:
            return None
        _check_keys(root, "", set())
        return loader.construct_document(root)
    except ArmFileError:
        raise
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        reason = getattr(error, "problem", None) or error
        raise ArmFileError(where + line, f"not YAML: {reason}") from None
    except Exception as error:
        # Errors that PyYAML lets through for a scalar that contradicts its tag, and for endless nesting.
        raise ArmFileError(where, f"not YAML: {type(error).__name__}: {error}") from None


def _check_keys(node, path, visited):
    if id(node) in visited:  # an alias
        return
    visited.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        for i, child in enumerate(node.value):
            _check_keys(child, f"{path}[{i}]", visited)
    elif isinstance(node, yaml.MappingNode):
        seen = set()
        for key, child in node.value:
            line = f"line {key.start_mark.line + 1}"
            if key.tag != "tag:yaml.org,2002:str" or not key.value:
                what = repr(key.value) if isinstance(key, yaml.ScalarNode) else "a collection"
                raise ArmFileError(path or line, f"the key {what} ({line}) is not a name")
            at = f"{path}.{key.value}" if path else key.value
            if key.value in seen:
                raise ArmFileError(at, f"given twice ({line})")
            seen.add(key.value)
            _check_keys(child, at, visited)


class Section:
    """A mapping in the file; it knows its path and which of its keys were read.

    Parameters
    ----------
    data : object
        What the file has at `path`; anything but a mapping is refused.
    path : str
        Such as ``links[0]``; empty for the file itself.
    system : str
        ``si`` or ``imperial``, see `units`.

    Raises
    ------
    ArmFileError
        From every method that meets a wrong value, with its path.
    """

    def __init__(self, data, path, system):
        if not isinstance(data, dict):
            raise ArmFileError(path or "file", f"a mapping is wanted, not {kind_of(data)}")
        self.data, self.path, self.system = data, path, system
        self.read = set()

    def at(self, key):
        """Path of the entry `key`."""
        name = number(key) if isinstance(key, str) else show(key)
        return f"{self.path}.{name}" if self.path else name

    def error(self, key, problem, **more):
        """The error about the field `key`, with its `problem` and `more` arguments of `ArmFileError`."""
        return ArmFileError(self.at(key), problem, **more)

    def has(self, key):
        """Whether there is an entry `key`; it then counts as read."""
        self.read.add(key)
        return self.data.get(key) is not None

    def raw(self, key, default=None, required=False):
        """The entry `key` as it is, or the `default`; one that is `required` must be there."""
        if not self.has(key):
            if required:
                raise self.error(key, "missing", hint=self._near(key))
            return default
        return self.data[key]

    def _near(self, key):
        """A hint when a key not yet read looks like the missing one."""
        close = difflib.get_close_matches(key, [k for k in self.data if k not in self.read], 1)
        return f"is {close[0]!r} meant to be it?" if close else ""

    def number(self, key, dimension="none", default=None, low=None, positive=False):
        """The finite number `key` in SI, of a `dimension`, at least `low`; `default` None makes it required."""
        value = self.raw(key, default, required=default is None)
        if not self.has(key):
            return value
        value = _number(value, self.at(key))
        if positive and not value >= 1.0 / MAX_NUMBER:
            unit = "" if SI_UNIT[dimension] == "-" else f" {SI_UNIT[dimension]}"
            limit = f"at least {1.0 / MAX_NUMBER:g}" if value > 0.0 else f"greater than 0{unit}"
            raise self.error(key, "is too small", value=value, limit=limit)
        if low is not None and value < low:
            raise self.error(key, "is too small", value=value, limit=f"at least {low:g}")
        return value * to_si(self.system, dimension)

    def vector(self, key, length, dimension="none", default=None):
        """The entry `key`: `length` finite numbers in SI, of a `dimension`; `default` None makes it required."""
        value = self.raw(key, default, required=default is None)
        if not self.has(key):
            return value
        if not isinstance(value, list) or len(value) != length:
            what = f"{len(value)} values" if isinstance(value, list) else kind_of(value)
            raise self.error(key, f"a list of {length} numbers is wanted, not {what}")
        factor = to_si(self.system, dimension)
        return tuple(_number(v, f"{self.at(key)}[{i}]") * factor for i, v in enumerate(value))

    def integer(self, key, default=None, low=None, high=None):
        """The integer `key` from `low` to `high`; `default` None makes it required."""
        value = self.raw(key, default, required=default is None)
        if isinstance(value, bool) or not isinstance(value, int):
            raise value_error(self.at(key), value, "is not an integer")
        if (low is not None and value < low) or (high is not None and value > high):
            raise value_error(self.at(key), value, "is out of range", limit=f"{low} to {high}")
        return value

    def text(self, key, default=None, choices=None):
        """The text `key`, one of the `choices` if given; `default` None makes it required."""
        value = self.raw(key, default, required=default is None)
        if not isinstance(value, str):
            raise value_error(self.at(key), value, "is not text")
        if choices and value not in choices:
            limit, hint = ", ".join(choices), _meant(value, choices)
            problem = "is not one of the choices"
            raise self.error(key, problem, value=value, limit=limit, hint=hint)
        return value

    def flag(self, key):
        """The entry `key`, true or false; false if not there."""
        value = self.raw(key, False)
        if not isinstance(value, bool):
            raise value_error(self.at(key), value, "is neither true nor false")
        return value

    def name(self):
        """The entry ``name``, not empty."""
        value = self.text("name")
        if not value.strip():
            raise self.error("name", "empty")
        return value

    def section(self, key):
        """The mapping `key`, as a `Section`."""
        return Section(self.raw(key, required=True), self.at(key), self.system)

    def sections(self, key, required=False):
        """The list of mappings `key`, each as a `Section`; empty if not there, unless it is `required`."""
        value = self.raw(key, [], required)
        if not isinstance(value, list):
            raise self.error(key, f"a list is wanted, not {kind_of(value)}")
        return [Section(v, f"{self.at(key)}[{i}]", self.system) for i, v in enumerate(value)]

    def done(self):
        """Refuse a field that was not read: a misspelt one is an error, not a default."""
        for key in self.data:
            if key not in self.read:
                known = sorted(self.read)
                limit, hint = f"known here: {', '.join(known)}", _meant(str(key), known)
                raise self.error(key, "no such field", limit=limit, hint=hint)


def _meant(name, known):
    """A hint with the known name that is spelt most like this one."""
    close = difflib.get_close_matches(name, known, 1)
    return f"did you mean {close[0]!r}?" if close else ""


def value_error(path, value, problem, **more):
    """The error for a `value` at a `path`, with its `problem` and `more`; a collection is shown by its kind."""
    if isinstance(value, (str, bool, float)) or kind_of(value) == show(value):
        return ArmFileError(path, problem, value=value, **more)
    return ArmFileError(path, f"{kind_of(value)} {problem}", **more)


def kind_of(value):
    """What a `value` is, for messages."""
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, int) and value.bit_length() > 64:
        return "an integer of more than 64 bits"
    return "a list" if isinstance(value, list) else show(value)


def _number(value, path):
    if isinstance(value, str):
        # YAML 1.1 reads 1e-3 (no dot) as text, but the user means the number.
        try:
            value = float(value)
        except ValueError:
            raise ArmFileError(path, "is not a number", value=value) from None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise value_error(path, value, "is not a number")
    if isinstance(value, float) and not math.isfinite(value):
        raise ArmFileError(path, "is not finite", value=value)
    if abs(value) > MAX_NUMBER:
        raise value_error(path, value, "is too large", limit=f"at most {MAX_NUMBER:g}")
    return float(value)
