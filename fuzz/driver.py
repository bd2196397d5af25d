# SPDX-License-Identifier: Apache-2.0
"""The driver template's serial line: damaged lines, pieces of lines, clocks that jump."""

import sys
from pathlib import Path

from . import odd
from .reader import Reader, demand

sys.path.insert(
    0, str(Path(__file__).resolve().parents[1] / "examples" / "flexarm_driver_template")
)

from flexarm_driver_template import protocol
from flexarm_driver_template.device import MeasurementTime

JOINTS, GAUGES = 2, 4
#: No electronics counts higher; a double represents every integer up to this one.
MAX_COUNT = 2**53


class Lines(Reader):
    """`protocol`: a line is either a whole frame, of numbers that a message can hold, or none."""

    name, weight, error, batch = "serial line", 5.0, (), 5

    def run(self, rng):
        lines, found, clock = protocol.Lines(), [], MeasurementTime()
        data = b"".join(self._line(rng, k) for k in range(self.batch))
        self.given = data
        while data:
            size = rng.randint(1, 120)
            found += lines.feed(data[:size])
            data = data[size:]
        refused, host = self.batch, 10**18
        for line in found:
            frame = protocol.frame(line, JOINTS, GAUGES)
            if frame is None:
                continue
            refused -= 1
            demand(
                (len(frame.encoder), len(frame.bridge), len(frame.drive))
                == (JOINTS, GAUGES, JOINTS),
                "counts",
            )
            numbers = (
                frame.number,
                frame.microseconds,
                *frame.encoder,
                *frame.bridge,
                *frame.drive,
            )
            demand(all(abs(n) <= MAX_COUNT for n in numbers), "a count that no double holds")
            demand(frame.number >= 0 and frame.microseconds >= 0, "a clock before its start")
            host += 1_000_000
            stamp = clock.stamp(1000 * frame.microseconds, host)
            demand(stamp is None or isinstance(stamp, int), "stamp")
        return max(0, refused)

    @staticmethod
    def _line(rng, number):
        values = [
            number,
            1000 * number,
            *(rng.randint(-(2**20), 2**20) for _ in range(2 * JOINTS + GAUGES)),
        ]
        kind = rng.randrange(6)
        if kind == 0:
            values[rng.randrange(len(values))] = rng.choice(
                (*odd.INTS, 2**63, -(2**63), 10**30, 10**400)
            )
        line = protocol.seal("S", *values)
        if kind == 1:
            return odd.mangled(rng, line)
        if kind == 2:  # damaged in a way that its checksum does not see
            return protocol.seal("S", *values[: rng.randint(0, len(values))])
        if kind == 3:
            return protocol.seal(
                odd.text(rng, ("S", "T", "X")).replace("\n", ""), odd.text(rng).replace("\n", "")
            )
        return line
