# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo: many runs of arms that differ from the control model in payload, stiffness, damping, delay and noise.

Sample i is drawn from ``SeedSequence(seed, spawn_key=(i,))`` alone, and its run is the same to the last bit on any
worker: neither the number of workers nor an interruption changes a result. With a directory, results are appended to a
JSON-lines file as they come; its first line is the specification.
"""

import hashlib
import json
import math
import os
from concurrent.futures import as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError

from ..commands.options import at_least
from ..loop import scenario as scenarios
from ..workers import processes

FILE = "monte_carlo.jsonl"
#: Uniform ranges: factors of payload, stiffness and damping [-], and the delay [s].
RANGES = {
    "payload_scale": (0.0, 3.0),
    "stiffness_scale": (0.7, 1.3),
    "damping_scale": (0.5, 2.0),
    "delay": (0.0, 0.002),
}
METRICS = (
    "peak_joint_error_rad",
    "peak_tip_error_mm",
    "residual_tip_rms_mm",
    "final_tip_error_mm",
    "settling_time_s",
    "peak_torque_Nm",
    "saturation_share",
)
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True)
class Specification:
    """What is drawn and run: plain data, stored in the file's first line.

    Attributes
    ----------
    scenario : dict
        The nominal run, from `Scenario.as_dict`.
    seed : int
    ranges : dict
        Name to (low, high).
    files : dict
        Digest of each arm file, so that a changed one is noticed.
    """

    scenario: dict
    seed: int = 0
    ranges: dict = field(default_factory=lambda: {k: list(v) for k, v in RANGES.items()})
    files: dict = field(default_factory=dict)


def specification(scenario, seed=0):
    """The specification of runs about a `scenario`; a negative seed and a missing arm file are refused."""
    at_least("--seed", seed, 0)
    arms = {a for a in (scenario.arm, scenario.plant_arm) if a}
    files = {a: hashlib.sha256(arm_file.find(a).read_bytes()).hexdigest() for a in sorted(arms)}
    return Specification(scenario.as_dict(), seed, files=files)


def draw(spec, number):
    """Sample `number`: fields of `Scenario`."""
    rng = np.random.default_rng(np.random.SeedSequence(spec.seed, spawn_key=(number,)))
    drawn = {name: float(rng.uniform(*spec.ranges[name])) for name in sorted(spec.ranges)}
    return drawn | {"seed": int(rng.integers(2**31)), "noise": True}


def sample(spec, number):
    """Run sample `number` of the specification `spec`; also called in other processes.

    Returns ``sample``, ``drawn``, and ``metrics`` with `METRICS`, ``lost``, ``reason``; of metrics per joint the
    largest. A refused run counts as lost, with its error as the reason.
    """
    drawn = draw(spec, number)
    try:
        found = scenarios.run(replace(scenarios.Scenario(**spec.scenario), **drawn))[1]
    except FlexarmError as error:
        found = {"lost": True, "reason": str(error)}
    metrics = {name: _one(found.get(name)) for name in METRICS}
    metrics |= {"lost": found["lost"], "reason": found["reason"]}
    return {"sample": number, "drawn": drawn, "metrics": metrics}


def _one(value):
    value = max(value) if isinstance(value, list) else value
    return None if value is None or not math.isfinite(value) else float(value)


def run(spec, count, directory=None, workers=None, scheduler=None, progress=None):
    """Run the samples from 0 to count - 1; those in the directory's file are not run again.

    Parameters
    ----------
    spec : Specification
    count : int
    directory : str or Path, optional
        For the file of results.
    workers : int, optional
        Number of processes; one per core if not given. 1: everything in this process.
    scheduler : str, optional
        Address of a Dask scheduler to use instead; its workers need flexarm.
    progress : Progress, optional

    Returns
    -------
    list of dict
        In the order of the samples.

    Raises
    ------
    FlexarmError
        For a file of another specification, and where Dask is not installed or its scheduler can't be reached.
    """
    at_least("--monte-carlo", count, 1)
    at_least("--workers", workers, 1)
    keep = None if directory is None else Store(Path(directory) / FILE, spec)
    results = {} if keep is None else {n: r for n, r in keep.results.items() if n < count}
    missing = [n for n in range(count) if n not in results]
    try:
        for result in _results(spec, missing, workers, scheduler):
            results[result["sample"]] = result
            if keep is not None:
                keep.append(result)
            if progress is not None:
                progress.fraction(len(results) / count)
    finally:
        if keep is not None:
            keep.close()
    return [results[n] for n in range(count)]


def _results(spec, missing, workers, scheduler):
    """Yield results as they come."""
    if not missing:
        return
    workers = min(workers or os.cpu_count() or 1, len(missing))
    if scheduler is None and workers == 1:
        yield from (sample(spec, n) for n in missing)
        return
    with processes(workers) if scheduler is None else _dask(scheduler) as executor:
        yield from through(executor, spec, missing)


def through(executor, spec, missing):
    """Yield results of samples, as they come, from any `concurrent.futures` executor."""
    waiting = [executor.submit(sample, spec, n) for n in missing]
    try:
        for future in as_completed(waiting):
            yield future.result()
    finally:
        for future in waiting:
            future.cancel()


@contextmanager
def _dask(address):
    try:
        from distributed import Client
    except ImportError:
        raise FlexarmError(
            "needs Dask, which is not installed",
            field="--scheduler",
            hint="pip install distributed (and flexarm on its workers)",
        ) from None
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError, TimeoutError) as error:
        raise FlexarmError(
            f"is no Dask scheduler that can be reached: {error}", field="--scheduler", value=address
        ) from None
    with client, client.get_executor(pure=False) as executor:
        yield executor


class Store:
    """Results in a JSON-lines file.

    Parameters
    ----------
    path : Path
        Created if missing. A last line that an interruption cut off is dropped.
    spec : Specification

    Attributes
    ----------
    results : dict
        Those already in the file, by sample number.

    Raises
    ------
    FlexarmError
        For a file of another specification, and for any other file.
    """

    def __init__(self, path, spec):
        self.path = Path(path)
        header = {"specification": json.loads(json.dumps(asdict(spec)))}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        whole = self._whole() if self.path.exists() else []
        self.results = {}
        if whole:
            self._check(whole[0], header)
            self.results = {row["sample"]: row for row in whole[1:]}
        self._file = self.path.open("a", encoding="utf-8")
        if not whole:
            self.append(header)

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
            raise FlexarmError(
                f"not a file of Monte Carlo results: {error}", field=str(self.path)
            ) from None
        if not rows and data and not data.startswith(b'{"specification"'):
            raise FlexarmError("not a file of Monte Carlo results", field=str(self.path))
        os.truncate(self.path, end)
        return rows

    def _check(self, there, wanted):
        if there == wanted:
            return
        old, new = there.get("specification"), wanted["specification"]
        if not isinstance(old, dict):
            raise FlexarmError("not a file of Monte Carlo results", field=str(self.path))
        other = sorted(k for k in {*old, *new} if old.get(k) != new.get(k))
        raise FlexarmError(
            f"has results of another specification ({', '.join(other)} differ)",
            field=str(self.path),
            hint="use another --out, or remove the file",
        )

    def append(self, row):
        """Write a `row` to the file at once."""
        self._file.write(json.dumps(row, allow_nan=False) + "\n")
        self._file.flush()

    def close(self):
        """Close the file."""
        self._file.close()


def summary(results):
    """Fraction of lost runs among the `results`, and quantiles of the other runs' metrics.

    Returns ``samples``, ``lost``, ``lost_share`` (a fraction), ``lost_share_95``: its 95 % interval after Wilson;
    ``not_settled``; ``quantiles``: per metric those of `QUANTILES`, and ``max``; ``lost_samples``: numbers and reasons.
    """
    lost = [r for r in results if r["metrics"]["lost"]]
    kept = [r["metrics"] for r in results if not r["metrics"]["lost"]]
    quantiles = {}
    for name in METRICS:
        values = [m[name] for m in kept if m[name] is not None]
        if values:
            levels = np.quantile(values, QUANTILES).tolist()
            quantiles[name] = dict(zip(map(str, QUANTILES), levels, strict=True))
            quantiles[name]["max"] = max(values)
    return {
        "samples": len(results),
        "lost": len(lost),
        "lost_share": len(lost) / len(results),
        "lost_share_95": _wilson(len(lost), len(results)),
        "not_settled": sum(m["settling_time_s"] is None for m in kept),
        "quantiles": quantiles,
        "lost_samples": [{"sample": r["sample"], "reason": r["metrics"]["reason"]} for r in lost],
    }


def _wilson(k, n, z=1.959963984540054):
    p, square = k / n, z * z / n
    middle = (p + 0.5 * square) / (1.0 + square)
    half = z * math.sqrt(p * (1.0 - p) / n + 0.25 * square / n) / (1.0 + square)
    return [max(0.0, middle - half), min(1.0, middle + half)]
