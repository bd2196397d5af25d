#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The licence in the first line of each Python file: written, or with ``--check`` only missed."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINE = "# SPDX-License-Identifier: Apache-2.0"
FOLDERS = ("benchmarks", "docs", "examples", "fuzz", "soak", "src", "tests", "tools")


def files():
    """All Python files of the project."""
    return sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def lacks(text):
    """Whether a file's text does not begin with the licence, after a line for the shell at most."""
    return LINE not in text.split("\n", 2)[:2]


def headed(text):
    """The text with it."""
    if not text.startswith("#!"):
        return f"{LINE}\n{text}"
    first, _, rest = text.partition("\n")
    return f"{first}\n{LINE}\n{rest}"


def main(arguments):
    """Write, or check; the exit code is 1 where a file lacks it and is only checked."""
    check = "--check" in arguments
    wrong = [path for path in files() if lacks(path.read_text(encoding="utf-8"))]
    for path in wrong:
        if check:
            print(f"{path.relative_to(ROOT)}: no {LINE}; run tools/licences.py")
        else:
            path.write_text(headed(path.read_text(encoding="utf-8")), encoding="utf-8")
    return 1 if check and wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
