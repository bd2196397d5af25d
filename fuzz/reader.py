# SPDX-License-Identifier: Apache-2.0
"""Base class of what is fuzzed: readers, each with its inputs and with what must hold for every input."""

import reprlib
import tempfile
from pathlib import Path
from random import Random

from flexarm_dynamics.errors import FlexarmError


class Violation(Exception):
    """A property that does not hold."""


def demand(holds, what):
    """Raise `Violation` unless a property holds."""
    if not holds:
        raise Violation(what)


class Reader:
    """One reader: `make` an input, `read` it, `check` the result.

    Attributes
    ----------
    name : str
    weight : float
        Relative number of inputs that it gets; the weights are normalised afterwards [-].
    error : type
        The only errors that it may raise.
    words : tuple of str
        A refusal names at least one of them: fields, or other words that show where to look.
    batch : int
        Inputs in one run of `run`.
    """

    name, weight, batch = "", 1.0, 1
    error = FlexarmError
    words = ()
    #: A log line must not be longer [characters].
    MAX_LENGTH = 1500

    def make(self, rng):
        """An input."""
        raise NotImplementedError

    def read(self, given):
        """Give it to the code under test; return the result."""
        raise NotImplementedError

    def check(self, given, result):
        """Raise `Violation` unless what was read is valid."""

    def state(self):
        """State that a refused input must not change; it must support comparison."""
        return None

    def run(self, rng):
        """Run one batch; return how many inputs were refused.

        Raises
        ------
        Violation, or whatever the reader should not have raised
        """
        self.given = self.make(rng)
        before = self.state()
        try:
            result = self.read(self.given)
        except self.error as error:
            self.check_message(error)
            demand(self.state() == before, "what was refused has changed the reader")
            return 1
        self.check(self.given, result)
        return 0

    def check_message(self, error):
        """Check that a refusal says what is wrong, and where."""
        text = str(error)
        demand(text.strip(), f"a {type(error).__name__} without a word")
        demand(len(text) <= self.MAX_LENGTH, f"a message of {len(text)} characters: {text[:120]}…")
        named = not self.words or any(word in text for word in self.words)
        demand(named, f"the refusal names no field: {text}")

    def renew(self):
        """Start again after a failure."""


class FileReader(Reader):
    """A reader of a file: `read` writes its input to `path`, whose name ends in `suffix`."""

    suffix = ""

    def __init__(self):
        self._folder = tempfile.TemporaryDirectory(prefix="fuzz-")
        self.path = Path(self._folder.name) / f"given{self.suffix}"


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 400
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxarray = 12
_SHORT.maxlevel = 5


def show(value):
    """An input as text, truncated."""
    try:
        text = _SHORT.repr(value)
        return text if len(text) < 2000 else f"{text[:2000]}…"
    except Exception as error:
        return f"a {type(value).__name__} ({type(error).__name__} when shown)"


def generator(seed, name, number):
    """The generator of one input."""
    return Random(f"{seed} {name} {number}")
