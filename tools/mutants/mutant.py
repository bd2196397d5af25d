# SPDX-License-Identifier: Apache-2.0
"""One error that a test must find."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Mutant:
    """One error.

    Attributes
    ----------
    name : str
        What is wrong then.
    file : str
        Below ``src``.
    old, new : str
        Text that occurs once in the file, and what takes its place.
    tests : str
        Arguments of pytest, relative to ``src``.
    """

    name: str
    file: str
    old: str
    new: str
    tests: str


def of(package, folder, tests, *rows):
    """Mutants of modules in one folder: rows of (module, name, old, new), or with tests of their own at the end."""
    return [
        Mutant(
            name, str(Path(package, package, folder, f"{module}.py")), old, new, *(own or [tests])
        )
        for module, name, old, new, *own in rows
    ]
