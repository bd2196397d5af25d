# SPDX-License-Identifier: Apache-2.0
r"""Messages whose strings and lengths seldom change, read from their bytes and written to them.

The middleware carries XCDR1 (OMG DDS-XTypes 1.3, section 7.4.1): four bytes of encapsulation, then the fields one after
the other, each aligned to its own size, with a length before each string and array. On the control path only numbers
change from one message to the next. So one message tells where they are, and a `struct` reads or writes all of them at
once. rclpy's conversion goes through each attribute and string instead, which takes several times as long.
"""

import struct
from operator import attrgetter, itemgetter
from types import SimpleNamespace

from rclpy.serialization import deserialize_message

from flexarm_dynamics.errors import MessageError

#: Little-endian XCDR1.
ENCAPSULATION = b"\0\1"
#: Numbers: format of `struct`, and size, which is the alignment.
NUMBERS = {
    "boolean": ("?", 1),
    "uint8": ("B", 1),
    "int32": ("i", 4),
    "uint32": ("I", 4),
    "double": ("d", 8),
}


def _several(getter, keys):
    """An `itemgetter` or `attrgetter` that gives a tuple, however many keys there are."""
    keys = list(keys)
    if len(keys) > 1:
        return getter(*keys)
    gets = [getter(key) for key in keys]
    return lambda thing: tuple(get(thing) for get in gets)


class Layout:
    """Where the numbers of a message are in its bytes, as long as its strings and lengths are these.

    Parameters
    ----------
    message : object
        Of a kind that has numbers of `NUMBERS`, strings, arrays of doubles and of strings, and fields of such kinds.

    Attributes
    ----------
    values : list
        In the order of the bytes: numbers, strings and lengths.
    places : dict of str to int or slice
        Where in `values` each number and array is, by its path, such as ``header.stamp.sec``.
    texts : list of str
        Paths of the strings, and of the arrays of strings.
    """

    def __init__(self, message):
        self.values, self.places, self.texts = [], {}, []
        self._format, self._size, self._fixed = ["<"], 0, []
        self._bytes(ENCAPSULATION)
        self._format.append("2x")
        self._size = 0  # alignment counts from here
        self._walk(message, "")
        self._struct = struct.Struct("".join(self._format))
        self._pick = _several(itemgetter, self._fixed)
        self._known = self._pick(self.values)

    def unpack(self, raw):
        """The `values` of a message's bytes; None where its strings or lengths are others."""
        if len(raw) < self._struct.size:  # what is beyond it is the middleware's padding
            return None
        values = self._struct.unpack_from(raw)
        return values if self._pick(values) == self._known else None

    def pack(self):
        """The bytes of `values`."""
        return self._struct.pack(*self.values)

    def _walk(self, message, prefix):
        for name, kind in message.get_fields_and_field_types().items():
            path, value = prefix + name, getattr(message, name)
            if kind in NUMBERS:
                code, size = NUMBERS[kind]
                self._align(size)
                self.places[path] = len(self.values)
                self._add(code, size, value)
            elif kind == "string":
                self.texts.append(path)
                self._text(value)
            elif kind == "sequence<string>":
                self.texts.append(path)
                self._length(len(value))
                for text in value:
                    self._text(text)
            elif kind == "sequence<double>":
                self._doubles(path, value)
            else:
                self._walk(value, f"{path}.")

    def _doubles(self, path, values):
        count = len(values)
        self._length(count)
        self.places[path] = slice(len(self.values), len(self.values) + count)
        if count:  # there is no padding before an empty one
            self._align(8)
            self._add(f"{count}d", 8 * count, *values)

    def _text(self, text):
        data = text.encode() + b"\0"
        self._length(len(data))
        self._bytes(data)

    def _length(self, count):
        self._align(4)
        self._fixed.append(len(self.values))
        self._add("I", 4, count)

    def _bytes(self, data):
        self._fixed.append(len(self.values))
        self._add(f"{len(data)}s", len(data), data)

    def _align(self, size):
        padding = -self._size % size
        self._format.append(f"{padding}x")
        self._size += padding

    def _add(self, code, size, *values):
        self._format.append(code)
        self._size += size
        self.values += values


class Reader:
    """Reads messages of one kind.

    Parameters
    ----------
    kind : type
        Of the messages.
    """

    def __init__(self, kind):
        self._kind, self._layout = kind, None

    def __call__(self, raw):
        """An object with the message's fields, valid until the next call.

        Parameters
        ----------
        raw : bytes or object
            A message's bytes; a message is returned as it is.

        Raises
        ------
        MessageError
            For bytes that are no message of this kind.
        """
        if not isinstance(raw, bytes):
            return raw
        values = None if self._layout is None else self._layout.unpack(raw)
        if values is None:
            return self._learn(raw)
        for fields, names, pick in self._groups:
            fields.update(zip(names, pick(values), strict=True))
        return self._fields

    def _learn(self, raw):
        """As a call, for bytes with other strings or lengths than the last ones."""
        message = self.message(raw)
        self._layout, self._fields, groups = Layout(message), _plain(message), {}
        for path, place in self._layout.places.items():
            owner, _, name = path.rpartition(".")
            groups.setdefault(owner, {})[name] = place
        self._groups = []
        for owner, places in groups.items():
            holder = attrgetter(owner)(self._fields) if owner else self._fields
            self._groups.append(
                (vars(holder), tuple(places), _several(itemgetter, places.values()))
            )
        return self._fields

    def message(self, raw):
        """The message itself, with all checks that rclpy makes; arguments and errors as of a call."""
        if not isinstance(raw, bytes):
            return raw
        try:
            return deserialize_message(raw, self._kind)
        except Exception as error:  # rclpy states none
            problem = f"can't be read: {error}"
            raise MessageError(
                problem, field=f"{len(raw)} bytes of {self._kind.__name__}"
            ) from None


def _plain(message):
    """The fields of a message, and of the messages in it, without checks at assignment."""
    names = message.get_fields_and_field_types()
    values = {name: getattr(message, name) for name in names}
    nested = {n: _plain(v) for n, v in values.items() if hasattr(v, "get_fields_and_field_types")}
    return SimpleNamespace(**(values | nested))


class Writer:
    """Writes one message, whose fields may be assigned, and its arrays filled in place.

    Parameters
    ----------
    message : object
        As of `Layout`.
    """

    def __init__(self, message):
        self.message = message
        self._learn()

    def __call__(self):
        """The bytes of the message as it is now."""
        numbers = self._numbers(self.message)
        texts = self._texts(self.message)
        if texts != self._known or [len(numbers[i]) for i in self._arrays] != self._lengths:
            self._learn()
            return self._layout.pack()
        values = self._layout.values
        for place, number in zip(self._places, numbers, strict=True):
            values[place] = number
        return self._layout.pack()

    def _learn(self):
        layout = self._layout = Layout(self.message)
        self._places = list(layout.places.values())
        self._numbers = _several(attrgetter, layout.places)
        self._texts = _several(attrgetter, layout.texts)
        self._arrays = [i for i, place in enumerate(self._places) if isinstance(place, slice)]
        self._lengths = [len(self._numbers(self.message)[i]) for i in self._arrays]
        known = self._texts(self.message)
        # The lists may be changed in place.
        self._known = tuple(list(t) if isinstance(t, list) else t for t in known)
