# SPDX-License-Identifier: Apache-2.0
"""Keeps results as they come in a file of JSON lines, so none is computed twice."""

import json
import os
from dataclasses import asdict
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError

from .workers import results


class Store:
    """Results in a JSON-lines file, so an interrupted study can go on.

    Parameters
    ----------
    path : str, Path or None
        Created if missing. A last line that an interruption cut off is dropped. None: no file.
    spec : dataclass
        What all results have in common: plain data, written to the first line.

    Attributes
    ----------
    results : dict
        Results already in the file and those added, by their ``sample``.

    Raises
    ------
    FlexarmError
        For a file of another specification, and for any other file.
    """

    def __init__(self, path, spec):
        self._file, self.results = None, {}
        if path is None:
            return
        self.path = Path(path)
        header = {"specification": json.loads(json.dumps(asdict(spec)))}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        whole = self._whole() if self.path.exists() else []
        if whole:
            self._check(whole[0], header)
            self.results = {row["sample"]: row for row in whole[1:]}
        self._file = self.path.open("a", encoding="utf-8")
        if not whole:
            self._write(header)

    def _whole(self):
        """Rows of the complete lines; the file is cut after them."""
        data = self.path.read_bytes()
        end = data.rfind(b"\n") + 1
        try:
            rows = [json.loads(line) for line in data[:end].splitlines()]
            if any(not isinstance(r, dict) for r in rows) or any(
                "sample" not in r for r in rows[1:]
            ):
                raise ValueError("not rows of samples")
        except ValueError as error:
            raise FlexarmError(f"not a file of results: {error}", field=str(self.path)) from None
        if not rows and data and not data.startswith(b'{"specification"'):
            raise FlexarmError("not a file of results", field=str(self.path))
        os.truncate(self.path, end)
        return rows

    def _check(self, there, wanted):
        if there == wanted:
            return
        old, new = there.get("specification"), wanted["specification"]
        if not isinstance(old, dict):
            raise FlexarmError("not a file of results", field=str(self.path))
        other = sorted(k for k in {*old, *new} if old.get(k) != new.get(k))
        raise FlexarmError(
            f"has results of another specification ({', '.join(other)} differ)",
            field=str(self.path),
            hint="use another --out, or remove the file",
        )

    def append(self, row):
        """Keep a `row`, and write it to the file at once."""
        self.results[row["sample"]] = row
        if self._file is not None:
            self._write(row)

    def _write(self, row):
        self._file.write(json.dumps(row, allow_nan=False) + "\n")
        self._file.flush()

    def close(self):
        """Close the file."""
        if self._file is not None:
            self._file.close()


def gather(keep, function, calls, workers=None, scheduler=None):
    """Compute rows, keep each as it comes, and yield (i, rows) of every call; `keep` is closed at the end.

    Parameters
    ----------
    keep : Store
    function : callable
        Returns rows, each a dict with its ``sample``.
    calls, workers, scheduler
        As for `workers.results`.
    """
    try:
        for i, rows in results(function, calls, workers, scheduler):
            for row in rows:
                keep.append(row)
            yield i, rows
    finally:
        keep.close()
