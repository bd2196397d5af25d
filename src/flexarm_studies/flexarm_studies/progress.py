# SPDX-License-Identifier: Apache-2.0
"""Shows the progress of long commands: a bar on a terminal, a line per step elsewhere."""

import sys
import time


class Progress:
    """Progress of a long command, written to `stream`, or to standard error."""

    WIDTH = 24

    def __init__(self, stream=None):
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._started = time.monotonic()
        self._label = ""

    def step(self, label, number=None, total=None):
        """Begin a step."""
        self.done()
        self._label = f"[{number}/{total}] {label}" if number else label
        if self._live:
            self.fraction(0.0)
        else:
            print(f"{self._elapsed()} {self._label}", file=self._stream, flush=True)

    def fraction(self, done):
        """Show the fraction of the step that is done, 0 to 1."""
        if self._live:
            full = round(self.WIDTH * min(max(done, 0.0), 1.0))
            bar = "#" * full + "." * (self.WIDTH - full)
            self._stream.write(f"\r\x1b[K{self._elapsed()} [{bar}] {self._label}")
            self._stream.flush()

    def done(self):
        """End the last step."""
        if self._live and self._label:
            self.fraction(1.0)
            self._stream.write("\n")
            self._stream.flush()

    def _elapsed(self):
        return f"{time.monotonic() - self._started:5.0f} s"
