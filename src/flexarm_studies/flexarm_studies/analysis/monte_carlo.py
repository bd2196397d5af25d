# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo: runs many arms that differ from the control model in payload, stiffness, damping, delay and noise.

Sample i is drawn from ``SeedSequence(seed, spawn_key=(i,))`` alone, and its run is the same to the last bit on any
worker: neither the number of workers nor an interruption changes a result. With a directory, results are appended to a
JSON-lines file as they come; its first line is the specification.
"""

import hashlib
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError

from ..commands.options import at_least
from ..loop import scenario as scenarios
from ..store import Store, gather

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
    """Specification of what is drawn and run: plain data, stored in the file's first line.

    Attributes
    ----------
    scenario : dict
        The nominal run, from `Scenario.as_dict`.
    seed : int
    ranges : dict
        Name to (low, high).
    files : dict
        Digest of each arm file, so a changed file is noticed.
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

    Returns ``sample``, ``drawn``, and ``metrics`` with `METRICS`, ``lost``, ``reason``; a metric per joint is replaced
    by its largest value. A refused run counts as lost, with its error as the reason.
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
        Number of processes; one per core if not given. 1: all in this process.
    scheduler : str, optional
        As for `workers.results`.
    progress : Progress, optional

    Returns
    -------
    list of dict
        In the order of the samples.

    Raises
    ------
    FlexarmError
        For a file of another specification, and if Dask is not installed or its scheduler can't be reached.
    """
    at_least("--monte-carlo", count, 1)
    keep = Store(None if directory is None else Path(directory) / FILE, spec)
    missing = [(spec, n) for n in range(count) if n not in keep.results]
    done = count - len(missing)
    for i, _ in enumerate(gather(keep, _rows, missing, workers, scheduler), 1):
        if progress is not None:
            progress.fraction((done + i) / count)
    return [keep.results[n] for n in range(count)]


def _rows(spec, number):
    return [sample(spec, number)]


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
