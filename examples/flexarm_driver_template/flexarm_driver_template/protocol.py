# SPDX-License-Identifier: Apache-2.0
"""The protocol of the fake device, lines with a checksum: **replace it with that of your device**.

The device sends one line per sample: integers, then the checksum (exclusive or of the bytes, in hex)::

    S <number> <microseconds> <encoder counts ...> <bridge counts ...> <drive counts ...>*5A

The device receives ``T <drive counts ...>*5A``, and applies that torque until the next line; or ``X*58``, and takes the
safe action. It also takes the safe action after it has received nothing for a while.
"""

from dataclasses import dataclass
from functools import reduce
from operator import xor


@dataclass(frozen=True)
class Frame:
    """One sample, in counts of the device."""

    number: int  # [-] of the sample since power-on
    microseconds: int  # [us] of the device's own clock at the measurement
    encoder: list  # [counts] one per joint
    bridge: list  # [counts] one per gauge
    drive: list  # [counts] torque applied until now, one per joint


def seal(word, *numbers):
    """A line of a word and numbers with its checksum, as bytes."""
    text = " ".join([word, *map(str, numbers)]).encode()
    return text + b"*%02X\n" % reduce(xor, text)


def unseal(line):
    """The word and the numbers of a line; None if it was damaged in transit."""
    text, star, check = line.rpartition(b"*")
    try:
        if not star or int(check, 16) != reduce(xor, text, 0):
            return None
        word, *numbers = text.decode().split(" ")
        return word, [int(n) for n in numbers]
    except ValueError:
        return None


#: A larger number must be damaged: up to here a double holds every integer [-].
MAX_COUNT = 2**53


def frame(line, joints, gauges):
    """The `Frame` of a line; None if it is not one with these numbers of `joints` and `gauges`."""
    word, numbers = unseal(line) or ("", [])
    if word != "S" or len(numbers) != 2 + 2 * joints + gauges:
        return None
    # One damaged line in 256 has the right checksum.
    if min(numbers[:2]) < 0 or max(map(abs, numbers)) > MAX_COUNT:
        return None
    number, microseconds, *values = numbers
    encoder, bridge, drive = values[:joints], values[joints:-joints], values[-joints:]
    return Frame(number, microseconds, encoder, bridge, drive)


class Lines:
    """Whole lines from the pieces that arrive."""

    MAX_LENGTH = 65_536  # [bytes] a longer piece is not a line

    def __init__(self):
        self._rest = b""

    def feed(self, data):
        """The lines that end in `data`, without line ends."""
        *whole, self._rest = (self._rest + data).split(b"\n")
        self._rest = self._rest[-self.MAX_LENGTH :]
        return whole
