# SPDX-License-Identifier: Apache-2.0
r"""Reads and writes the bytes of messages whose strings and lengths seldom change.

The middleware carries XCDR1 (OMG DDS-XTypes 1.3, section 7.4.1): four bytes of encapsulation, then the fields one after
the other, each aligned to its own size, with a length before each string and array. On the control path only numbers
change from one message to the next. So one message shows where the numbers are. One comparison shows whether another
message has the same strings and lengths: it compares all bytes, except numbers and padding, as one large integer.
Arrays are views of the bytes. rclpy's conversion takes several times as long, because it goes through each attribute
and string.
"""

import struct
import sys
from operator import attrgetter

import numpy as np
from rclpy.serialization import deserialize_message

from flexarm_dynamics.errors import MessageError

#: XCDR1 in this machine's order of bytes.
LITTLE = sys.byteorder == "little"
ENCAPSULATION, ORDER = (b"\0\1", "<") if LITTLE else (b"\0\0", ">")
#: Bytes before the fields; alignment counts from there.
HEAD = 4
#: Formats of numbers in `struct`, and their size, which is also their alignment.
NUMBERS = {
    "boolean": ("?", 1),
    "uint8": ("B", 1),
    "int32": ("i", 4),
    "uint32": ("I", 4),
    "double": ("d", 8),
}


def _several(paths):
    """An `attrgetter` that gives a tuple, however many paths there are."""
    paths = list(paths)
    if len(paths) > 1:
        return attrgetter(*paths)
    gets = [attrgetter(path) for path in paths]
    return lambda thing: tuple(get(thing) for get in gets)


class Layout:
    """Where the numbers are in the bytes of all messages that have these strings and lengths.

    Parameters
    ----------
    message : object
        Its type has numbers of `NUMBERS`, strings, arrays of doubles and of strings, and fields of such types.

    Attributes
    ----------
    template : bytearray
        The bytes of strings and lengths; zeros elsewhere.
    numbers : dict of str to (str, int)
        Format and place in the bytes of each number, by its path, such as ``header.stamp.sec``; in the order of places.
    arrays : dict of str to slice
        Place of each array in `doubles`, by its path.
    texts : list of str
        Paths of the strings, and of the arrays of strings.
    """

    def __init__(self, message):
        self.template, self._mask = bytearray(), bytearray()
        self.numbers, self.arrays, self.texts = {}, {}, []
        self._fix(ENCAPSULATION)
        self._leave(HEAD - len(ENCAPSULATION))
        self._walk(message, "")
        self._whole = int.from_bytes(self._mask, "little")
        self._known = int.from_bytes(self.template, "little")
        self._size, form, at = len(self.template), [ORDER], 0
        for code, place in self.numbers.values():
            form.append(f"{place - at}x{code}")
            at = place + struct.calcsize(code)
        self._struct = struct.Struct("".join(form))

    def unpack(self, raw):
        """The `numbers` in a message's bytes; None if its strings or lengths are others."""
        if len(raw) < self._size:  # bytes beyond it are the middleware's padding
            return None
        if int.from_bytes(raw, "little") & self._whole != self._known:
            return None
        return self._struct.unpack_from(raw)

    @staticmethod
    def doubles(raw):
        """View of a message's bytes as doubles; not aligned for the processor."""
        return np.frombuffer(raw, ORDER + "f8", (len(raw) - HEAD) // 8, HEAD)

    def bytes_of(self, path):
        """The place of an array in a message's bytes: a slice."""
        place = self.arrays[path]
        return slice(HEAD + 8 * place.start, HEAD + 8 * place.stop)

    def runs(self):
        """Runs of adjacent numbers: for each its `struct.Struct`, its place, and its slice of the numbers."""
        found, items = [], list(self.numbers.values())
        begin = 0
        for i in range(1, len(items) + 1):
            code, place = items[i - 1]
            if i == len(items) or items[i][1] != place + struct.calcsize(code):
                form = ORDER + "".join(code for code, _ in items[begin:i])
                found.append((struct.Struct(form), items[begin][1], slice(begin, i)))
                begin = i
        return found

    def _walk(self, message, prefix):
        for name, kind in message.get_fields_and_field_types().items():
            path, value = prefix + name, getattr(message, name)
            if kind in NUMBERS:
                code, size = NUMBERS[kind]
                self._align(size)
                self.numbers[path] = code, len(self.template)
                self._leave(size)
            elif kind == "string":
                self.texts.append(path)
                self._text(value)
            elif kind == "sequence<string>":
                self.texts.append(path)
                self._length(len(value))
                for text in value:
                    self._text(text)
            elif kind == "sequence<double>":
                self._doubles(path, len(value))
            else:
                self._walk(value, f"{path}.")

    def _doubles(self, path, count):
        self._length(count)
        if count:  # there is no padding before an empty one
            self._align(8)
        first = (len(self.template) - HEAD) // 8
        self.arrays[path] = slice(first, first + count)
        self._leave(8 * count)

    def _text(self, text):
        data = text.encode() + b"\0"
        self._length(len(data))
        self._fix(data)

    def _length(self, count):
        self._align(4)
        self._fix(struct.pack(ORDER + "I", count))

    def _align(self, size):
        self._leave(-(len(self.template) - HEAD) % size)

    def _fix(self, data):
        self.template += data
        self._mask += b"\xff" * len(data)

    def _leave(self, count):
        self.template += bytes(count)
        self._mask += bytes(count)


class Fields:
    """The fields of a message, and of the messages in it, without checks at assignment; arrays are read-only.

    Attributes
    ----------
    layout : Layout
        The layout that was used: while it is the same object, all strings and lengths are the same, too.
    doubles : ndarray
        As `Layout.doubles`.
    """

    def __init__(self, message, layout, prefix="", root=None):
        # Arrays are not among the attributes: `__getattr__` finds them in the present message's bytes.
        self._arrays, self._root = {}, self if root is None else root
        self.layout, self.doubles = layout, None
        for name in message.get_fields_and_field_types():
            value = getattr(message, name)
            if prefix + name in layout.arrays:
                self._arrays[name] = layout.arrays[prefix + name]
            elif hasattr(value, "get_fields_and_field_types"):
                setattr(self, name, Fields(value, layout, f"{prefix}{name}.", self._root))
            else:
                setattr(self, name, value)

    def __getattr__(self, name):
        if name in self.__dict__.get("_arrays", ()):
            return self._root.doubles[self._arrays[name]]
        raise AttributeError(name)


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
        """The message's `Fields`, valid until the next call.

        Parameters
        ----------
        raw : bytes or object
            A message's bytes; a message is returned as it is.

        Raises
        ------
        MessageError
            For bytes that are not a message of this kind.
        """
        if not isinstance(raw, bytes):
            return raw
        layout = self._layout
        numbers = None if layout is None else layout.unpack(raw)
        if numbers is None:
            return self._learn(raw)
        fields = self._fields
        fields.doubles = layout.doubles(raw)
        for attributes, names, part in self._groups:
            attributes.update(zip(names, numbers[part], strict=True))
        return fields

    def _learn(self, raw):
        """As `__call__`, for bytes with other strings or lengths than the last ones."""
        message = self.message(raw)
        layout = self._layout = Layout(message)
        fields = self._fields = Fields(message, layout)
        # In the order of the numbers: in most messages those of the header come first.
        self._groups, owners = [], [path.rpartition(".")[::2] for path in layout.numbers]
        for i, (owner, name) in enumerate(owners):
            if i == 0 or owner != owners[i - 1][0]:
                holder = attrgetter(owner)(fields) if owner else fields
                self._groups.append((vars(holder), [], slice(i, i)))
            attributes, names, part = self._groups[-1]
            names.append(name)
            self._groups[-1] = attributes, names, slice(part.start, i + 1)
        if layout.unpack(raw) is not None:
            fields.doubles = layout.doubles(raw)
        else:  # another byte order, or strings without their end: only rclpy reads these
            fields.doubles = np.zeros(max((a.stop for a in layout.arrays.values()), default=0))
            for path, place in layout.arrays.items():
                fields.doubles[place] = attrgetter(path)(message)
        return fields

    def message(self, raw):
        """The message itself, with all checks that rclpy makes; arguments and errors are those of `__call__`."""
        if not isinstance(raw, bytes):
            return raw
        try:
            return deserialize_message(raw, self._kind)
        except Exception as error:  # rclpy documents none
            problem = f"can't be read: {error}"
            raise MessageError(
                problem, field=f"{len(raw)} bytes of {self._kind.__name__}"
            ) from None


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
        message = self.message
        numbers, arrays = self._numbers(message), self._arrays(message)
        if self._texts(message) != self._known or list(map(len, arrays)) != self._lengths:
            self._learn()
        out = self._bytes
        for runs, at, part in self._runs:
            runs.pack_into(out, at, *numbers[part])
        for place, values in zip(self._places, arrays, strict=True):
            out[place] = values
        return bytes(out)

    def _learn(self):
        message = self.message
        layout, inside = Layout(message), _slots(message)
        self._bytes, self._runs = layout.template, layout.runs()
        self._places = [layout.bytes_of(path) for path in layout.arrays]
        self._numbers, self._arrays, self._texts = (
            _several(map(inside, paths)) for paths in (layout.numbers, layout.arrays, layout.texts)
        )
        self._lengths = [len(values) for values in self._arrays(message)]
        known = self._texts(message)
        # The lists may be changed in place.
        self._known = tuple(list(t) if isinstance(t, list) else t for t in known)


def _slots(message):
    """Function from a path of fields to that of the slots behind rclpy's properties: it avoids their Python calls."""

    def inside(path):
        slots = ".".join(f"_{name}" for name in path.split("."))
        try:
            attrgetter(slots)(message)
        except AttributeError:
            return path
        return slots

    return inside
