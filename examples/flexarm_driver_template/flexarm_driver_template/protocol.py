# SPDX-License-Identifier: Apache-2.0
"""The line protocol of the fake device; yours has its own, and this file is what you replace first.

From the device, one line a sample, all whole numbers, then the checksum (exclusive or of the bytes, in hex)::

    S <number> <microseconds> <encoder counts ...> <bridge counts ...> <drive counts ...>*5A

To the device: ``T <drive counts ...>*5A`` applies torque until the next line, ``X*58`` takes the safe action.
The device takes it by itself when it receives nothing for a while.
"""

from dataclasses import dataclass
from functools import reduce
from operator import xor


@dataclass(frozen=True)
class Frame:
    """One sample, as the device counts."""

    number: int  # [-] of the sample, since the device was switched on
    microseconds: int  # [us] of the device's own clock at the measurement
    encoder: list  # [counts] a joint each
    bridge: list  # [counts] a gauge each
    drive: list  # [counts] torque applied until now, a joint each


def seal(word, *numbers):
    """A line with its checksum, as bytes."""
    text = " ".join([word, *map(str, numbers)]).encode()
    return text + b"*%02X\n" % reduce(xor, text)


def unseal(line):
    """The word and the numbers of a line; None where it was damaged on its way."""
    text, star, check = line.rpartition(b"*")
    try:
        if not star or int(check, 16) != reduce(xor, text, 0):
            return None
        word, *numbers = text.decode().split(" ")
        return word, [int(n) for n in numbers]
    except ValueError:
        return None


#: A larger number is a damaged one: a double holds each count up to here [-].
MOST = 2**53


def frame(line, joints, gauges):
    """The `Frame` of a line; None where it is not one of `joints` and `gauges`."""
    word, numbers = unseal(line) or ("", [])
    if word != "S" or len(numbers) != 2 + 2 * joints + gauges:
        return None
    if (
        min(numbers[:2]) < 0 or max(map(abs, numbers)) > MOST
    ):  # one checksum in 256 is right by chance
        return None
    values = numbers[2:]
    return Frame(
        *numbers[:2], values[:joints], values[joints : joints + gauges], values[joints + gauges :]
    )


class Lines:
    """Whole lines from pieces as they come."""

    LONGEST = 65_536  # [bytes] what grows beyond has no line in it

    def __init__(self):
        self._rest = b""

    def feed(self, data):
        """The lines that end in `data`, without their line ends."""
        *whole, self._rest = (self._rest + data).split(b"\n")
        self._rest = self._rest[-self.LONGEST :]
        return whole
