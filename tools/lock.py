#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write the hashes of all that `make build` installs into ``requirements/locked``: ``make lock``.

The lists in ``requirements/`` name every package with its version. uv looks up the hashes of all files that PyPI has
of these versions; pip compares them with what it downloads (``tools/bootstrap.py``), so that a file which was
replaced is not installed.
"""

import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "requirements"
#: Lists that `tools/bootstrap.py` installs.
LISTS = ("python.txt", "low-watermark.txt", "dev.txt", "ros-wheels.txt")
#: The oldest Python that they are for.
OLDEST = "3.10"
HEAD = "# Written by `make lock` from requirements/{}: hashes of all files of these versions on PyPI.\n"


def lock(name):
    """Text of the lock of one list."""
    command = [
        sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--no-config", "--universal", "--no-deps",
        "--no-header", "--no-annotate", "--generate-hashes", "--python-version", OLDEST, str(FOLDER / name),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr.strip()}")
    return HEAD.format(name) + done.stdout


def main():
    """Write all locks, or none."""
    found = {name: lock(name) for name in LISTS}
    (FOLDER / "locked").mkdir(exist_ok=True)
    for name, text in found.items():
        (FOLDER / "locked" / name).write_text(text, encoding="utf-8")
        print(f"requirements/locked/{name}: {text.count('==')} packages")


if __name__ == "__main__":
    main()
