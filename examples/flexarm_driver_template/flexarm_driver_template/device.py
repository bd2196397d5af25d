# SPDX-License-Identifier: Apache-2.0
"""The arm's electronics behind a serial line: frames in, commands out, and the time of measurement."""

import os
import select
import termios
import tty

from flexarm_dynamics.errors import FlexarmError

from . import protocol


class DeviceError(FlexarmError):
    """The device can't be opened, or is gone."""


class Device:
    """A serial line, such as ``/dev/ttyUSB0`` or the fake device's.

    Parameters
    ----------
    port : str
    joints, gauges : int
        How many values of each a frame has.

    Attributes
    ----------
    damaged : int
        Lines that were no frame.

    Raises
    ------
    DeviceError
    """

    def __init__(self, port, joints, gauges):
        self._port, self._sizes = port, (joints, gauges)
        try:
            self._file = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(self._file, termios.TCSANOW)
            termios.tcflush(self._file, termios.TCIFLUSH)  # old measurements
        except (OSError, termios.error) as error:
            hint = "is the device on, and may you open it?"
            raise DeviceError(f"{port}: {error}", field="port", hint=hint) from None
        self._lines = protocol.Lines()
        self.damaged = 0

    def frames(self, wait):
        """Wait at most `wait` seconds for data; the whole frames that have come.

        Raises
        ------
        DeviceError
            When the line is gone.
        """
        try:
            ready, _, _ = select.select([self._file], [], [], wait)
            lines = self._lines.feed(os.read(self._file, 65_536)) if ready else []
        except OSError as error:
            raise DeviceError(f"{self._port}: {error}", field="port") from None
        found = [protocol.frame(line, *self._sizes) for line in lines]
        self.damaged += found.count(None)
        return [f for f in found if f]

    def torque(self, counts):
        """Apply torque, in counts of the drive."""
        self._write(protocol.seal("T", *counts))

    def safe(self):
        """Take the safe action."""
        self._write(protocol.seal("X"))

    def _write(self, line):
        try:
            os.write(self._file, line)
        except BlockingIOError:
            pass  # the device does not read: its own watchdog will act
        except OSError as error:
            raise DeviceError(f"{self._port}: {error}", field="port") from None

    def close(self):
        """Close the line."""
        os.close(self._file)


class MeasurementTime:
    """Moves times of the device's clock to this machine's clock.

    A frame takes at least as long to arrive as the quickest one: the smallest difference between arrival and
    measurement is the offset of the clocks. A frame that was delayed keeps its time of measurement, so
    that stamps have no jitter. A device clock that goes back has restarted, and is measured anew.
    """

    #: Device time in which the first quickest frame is looked for [ns].
    SETTLE = 500_000_000
    #: The clocks drift apart by less than DRIFT [-]; stamps move towards those of a quicker frame by DRAW [-].
    DRIFT, DRAW = 2e-4, 0.5

    def __init__(self):
        self._offset = self._last = self._first = None

    def stamp(self, device_ns, host_ns):
        """Host time [ns] of a measurement at `device_ns` that arrived at `host_ns`; None: not known yet."""
        newest = host_ns - device_ns
        if self._offset is None or device_ns < self._last:
            self._offset, self._last, self._first = newest, device_ns, device_ns
        step, self._last = device_ns - self._last, device_ns
        if device_ns - self._first < self.SETTLE:
            self._offset = min(newest, self._offset)
            return None
        low, high = self._offset - round(self.DRAW * step), self._offset + round(self.DRIFT * step)
        self._offset = min(max(newest, low), high)
        return device_ns + self._offset
