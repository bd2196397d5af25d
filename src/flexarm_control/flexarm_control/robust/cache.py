# SPDX-License-Identifier: Apache-2.0
"""Cache of designs: one file for each design, in the cache directory beside the compiled kernels.

A file's name is a hash of all that its design depends on: arm, `Settings`, `Uncertainty` and the source code of the
design. A file that is unreadable, truncated or made for another design counts as absent, and is written again.
"""

import hashlib
import json
import os
import tempfile
from dataclasses import asdict
from functools import cache as once
from pathlib import Path

import flexarm_dynamics
from flexarm_dynamics.kernels.load import cache_directory

#: Fields of an arm on which no design depends.
WORDS = ("name", "description", "source")
#: Modules outside this package on which a design's gains depend.
TAKEN = ("fading.py", "feedforward/base.py", "low_pass.py", "schedule.py")


@once
def version():
    """Hash of the source code on which designs depend: this package, `TAKEN`, the kernels and `flexarm_dynamics`."""
    code, here = hashlib.sha256(), Path(__file__).parent
    paths = [here.parent / name for name in TAKEN]
    for folder in (here, here.parent / "kernels", Path(flexarm_dynamics.__file__).parent):
        paths += sorted(folder.rglob("*.py"))
    for path in paths:
        code.update(path.read_bytes())
    return code.hexdigest()


def key(arm, settings, uncertainty):
    """Name of the design for an `Arm` with these `Settings` and this `Uncertainty`."""
    content = {k: v for k, v in asdict(arm).items() if k not in WORDS}
    whole = [content, asdict(settings), asdict(uncertainty), version()]
    return _hash(json.dumps(whole, sort_keys=True, default=_plain))


def _plain(value):
    return value.tolist() if hasattr(value, "tolist") else repr(value)


def _hash(text):
    return hashlib.sha256(text.encode()).hexdigest()


def path_of(name):
    """File of the design with the `key` `name`."""
    return cache_directory() / "designs" / f"{name}.json"


def read(name):
    """The entry, a mapping, that was written under a `key`; None if there is no usable one."""
    try:
        found = json.loads(path_of(name).read_text(encoding="utf-8"))
        entry = found["entry"]
        whole = found["key"] == name and found["sum"] == _hash(_text(entry))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return entry if whole else None


def write(name, entry):
    """Keep an entry, plain data, under a `key`; if it cannot be written, the design is made again next time."""
    path = path_of(name)
    body = _text({"key": name, "sum": _hash(_text(entry)), "entry": entry})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # The file appears completely or not at all, even if two processes write at once.
        with tempfile.NamedTemporaryFile(
            "w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8"
        ) as file:
            file.write(body)
        os.replace(file.name, path)
    except OSError:
        return


def _text(entry):
    return json.dumps(entry, sort_keys=True)
