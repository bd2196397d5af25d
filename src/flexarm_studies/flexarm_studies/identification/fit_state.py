# SPDX-License-Identifier: Apache-2.0
"""Keeps what a fit has found so far in a file, so an interrupted fit can go on."""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from flexarm_dynamics.errors import FlexarmError


class FitState:
    """What `identify_strains` has found so far, kept in a JSON file.

    Parameters
    ----------
    path : str or Path
        Created if missing.
    key : str
        Hash of arm, recording and options, see `key_of`.

    Attributes
    ----------
    starts : dict
        Number of a start to its sum of squares and its values.
    best : dict or None
        State of the fit after the starts, as `StrainProblem.snapshot`.

    Raises
    ------
    FlexarmError
        If the file belongs to another fit, or is not a file of a fit.
    """

    def __init__(self, path, key):
        self.path, self.key = Path(path), key
        self.starts, self.best = {}, None
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self.path.exists():
            return
        try:
            kept = json.loads(self.path.read_text(encoding="utf-8"))
            known = kept["key"]
            self.starts = {int(k): (float(c), list(v)) for k, (c, v) in kept["starts"].items()}
            self.best = kept["best"]
        except (ValueError, KeyError, TypeError, AttributeError, UnicodeDecodeError):
            hint = "give another name, or remove it"
            raise FlexarmError("is no state of a fit", field=str(path), hint=hint) from None
        if known != key:
            raise FlexarmError(
                "is the state of a fit of another arm, recording or options", field=str(path),
                hint="give another name, or remove it",
            )  # fmt: skip

    def keep_start(self, number, cost, values):
        """Keep the result of start `number`: sum of squares `cost` and `values` (p,)."""
        self.starts[number] = float(cost), [float(v) for v in values]
        self._write()

    def keep_best(self, snapshot):
        """Keep a `snapshot`, plain data."""
        self.best = snapshot
        self._write()

    def _write(self):
        text = json.dumps({"key": self.key, "starts": self.starts, "best": self.best})
        new = self.path.with_name(self.path.name + ".new")
        new.write_text(text, encoding="utf-8")
        new.replace(self.path)


def key_of(arm, recording, options):
    """A hash of the `arm`, of the fitted part of the `recording`, and of the `options`."""
    made = hashlib.sha256(repr(arm).encode())
    for values in (recording.position, recording.strain):
        made.update(np.ascontiguousarray(values).tobytes())
    made.update(json.dumps([recording.period, asdict(options)]).encode())
    return made.hexdigest()
