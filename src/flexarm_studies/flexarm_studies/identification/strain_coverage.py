# SPDX-License-Identifier: Apache-2.0
"""How often the intervals of fits to strains alone cover the truth, for simulated arms with play drawn at random.

``python -m flexarm_studies.identification.strain_coverage --arms 100`` draws arms around `NOMINAL`, moves their joint
as a position control would, and measures. The strains have bias, drift, a delay and noise. Most of the noise is common
to the gauges and correlated from sample to sample. The motor's current includes friction. Each arm is identified from
the nominal arm's file.
"""

import argparse
import itertools
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model

from .. import workers
from ..recordings.motion import CORNER
from . import recording as recordings
from .currents import motor_fits, torques
from .fit import NORMAL
from .strain_fit import Options, StrainProblem, identify_strains

NOMINAL = """
name: geared
gravity: [0.0, -9.81, 0.0]
joints:
- {name: shoulder, axis: [0, 0, 1], hub_inertia: 0.03, rotor_inertia: 1.0e-4, gear_ratio: 50.0,
   friction: {viscous: 1.0, coulomb: 1.0, smoothing: 0.03},
   transmission: {stiffness: 600.0, damping: 2.0, play: 0.012, load_damping: 0.05,
   rounding: 0.001, play_damping: 0.5}}
links:
- {name: beam, length: 0.6, mass_per_length: 0.4, EI_y: 28.0,
   flexible: {y: {modes: 1, shape: loaded, damping: [0.012]}}}
payload: {mass: 1.0}
gauges:
- {name: root, link: beam, position: 0.05, direction: y, surface_distance: 0.003}
- {name: middle, link: beam, position: 0.3, direction: y, surface_distance: 0.003}
"""
#: Parameters that the user knows; they are held at the true value.
HOLD = ("joints[0].hub_inertia", "payload.mass")
#: Largest relative deviation of each parameter from the nominal one [-], and largest bias [strain], drift over the
#: recording [strain], delay [s] and offset [rad].
SPREAD = 0.2
BIAS, DRIFT, DELAY, OFFSET = 50e-6, 15e-6, 0.008, 0.03
#: Noise that the gauges share [strain], its autoregression [-], noise of each gauge [strain] and of the current [A],
#: and torque per ampere [N m/A].
COMMON, MEMORY, OWN, OF_CURRENT, CONSTANT = 1.0e-6, 0.5, 0.3e-6, 0.03, 12.0
RATE, SECONDS = 100.0, 10.0
#: Steps of the simulation per step of the fit: the simulation must not have the fit's integration errors.
FINER = 4
#: Starts of each fit.
STARTS = 3


def motion():
    """Joint angle (s,) of moves through the upper position, with rests [rad]."""
    time = np.arange(0.0, SECONDS, 1.0 / RATE)
    angle = np.full(time.size, 0.4)
    moves = (
        (0.6, 0.6, 1.2),
        (2.6, 0.5, 1.0),
        (4.6, 0.7, -1.4),
        (7.0, 0.5, 1.6),
    )
    for at, long, size in moves:
        s = np.clip((time - at) / long, 0.0, 1.0)
        angle += size * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return time, angle


def drawn(seed):
    """A `Recording` of an arm drawn at random, and the true values by name."""
    random, (time, angle) = np.random.default_rng(seed), motion()
    arm = arm_file.parse(NOMINAL)
    signals = {"position": angle[:, None], "strain": np.zeros((time.size, 2))}
    run = recordings.uniform(time, signals, joint_names=("shoulder",), gauge_names=arm.gauge_names)
    problem = StrainProblem(arm, run, Options(hold=HOLD))
    sizes = {"bias": BIAS, "drift": DRIFT, "delay": DELAY, "offset": OFFSET}
    values = problem.file.copy()
    for j in np.flatnonzero(problem.free):
        size = sizes.get(problem.found[j].kind)
        spread = random.uniform(-1.0, 1.0)
        values[j] = size * spread if size else values[j] * (1.0 + SPREAD * spread)
    setup = problem.at(values)
    problem.predictor.substeps *= FINER
    strain = problem.strains(setup, problem.states(setup))
    noise = np.zeros(time.size)
    for k, new in enumerate(random.standard_normal(time.size) * np.sqrt(1.0 - MEMORY**2)):
        noise[k] = MEMORY * noise[k - 1] + new
    strain += COMMON * noise[:, None] + OWN * random.standard_normal(strain.shape)
    friction = {name: float(random.uniform(0.5, 1.5)) for name in ("viscous", "coulomb")}
    torque, predictor = torques(setup.arm, run, CORNER, setup.offset)
    speed = predictor.velocity[:, 0]
    effort = torque[:, 0] + friction["viscous"] * speed
    effort += friction["coulomb"] * np.tanh(speed / arm.joints[0].friction.smoothing)
    current = effort / CONSTANT + OF_CURRENT * random.standard_normal(time.size)
    truth = {q.name: float(v) for q, v in zip(problem.found, values, strict=True)}
    truth |= {"current: constant": CONSTANT}
    truth |= {f"current: {name}": value for name, value in friction.items()}
    return replace(run, strain=strain, current=current[:, None]), truth


def one(seed):
    """Rows of one arm: name, true value, value found, half-width."""
    run, truth = drawn(seed)
    found = identify_strains(arm_file.parse(NOMINAL), run, Options(hold=HOLD, starts=STARTS))
    rows = [
        (q.name, truth[q.name], float(v), float(w))
        for q, v, w in zip(found.quantities, found.values, found.half_widths, strict=True)
        if np.isfinite(w)
    ]
    everything = slice(0, len(run.position))
    for motor in motor_fits(found, run, everything, everything, CORNER):
        for name in ("constant", "viscous", "coulomb"):
            value, width = getattr(motor, name)
            rows.append((f"current: {name}", truth[f"current: {name}"], value, width))
    return rows


def run(arms, seed=0, count=None, progress=None, path=None):
    """Rows of `one` for this number of `arms`, each identified from its own recording.

    Parameters
    ----------
    arms : int
    seed : int
    count : int, optional
        Processes.
    progress : callable, optional
        ``progress(done)``
    path : str or Path, optional
        File with a line of JSON for each arm that is done; arms in it are not computed again.

    Raises
    ------
    FlexarmError
        For a file that can't be read.
    """
    done = _kept(path)
    missing = [k for k in range(arms) if (seed, k) not in done]
    for i, rows in workers.results(one, [([seed, k],) for k in missing], count):
        done[seed, missing[i]] = rows
        if path is not None:
            with Path(path).open("a", encoding="utf-8") as file:
                file.write(json.dumps({"seed": seed, "arm": missing[i], "rows": rows}) + "\n")
        if progress:
            progress(len(done))
    return [done[seed, k] for k in range(arms)]


def _kept(path):
    """Content of a file of `run`: (seed, arm) to rows."""
    if path is None or not Path(path).exists():
        return {}
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
        kept = [json.loads(line) for line in lines]
        return {(k["seed"], k["arm"]): k["rows"] for k in kept}
    except (ValueError, KeyError, TypeError, OSError):
        hint = "give another name, or remove it"
        raise FlexarmError(
            "is no file of this study", field=str(path), limit="lines of JSON", hint=hint
        ) from None


def table(rows_of_arms):
    """How many intervals covered the truth, with errors, half-widths and the mean square of error over deviation.

    Parameters
    ----------
    rows_of_arms : list
        Of `run`.

    Returns
    -------
    dict
        By the parameter's name.
    """
    made = {}
    for name, true, value, width in itertools.chain.from_iterable(rows_of_arms):
        row = made.setdefault(
            name, {"arms": 0, "covered": 0, "errors": [], "widths": [], "squares": []}
        )
        row["arms"] += 1
        row["covered"] += bool(abs(value - true) <= width)
        row["errors"].append(abs(value - true) / max(abs(true), 1e-300))
        row["widths"].append(width / max(abs(true), 1e-300))
        row["squares"].append((NORMAL * (value - true) / width) ** 2)
    return made


def text(made):
    """Lines of a `table`, as Markdown."""
    yield "| parameter | covered | median error [%] | largest [%] | median half-width [%] | (error / deviation)² |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for name, row in made.items():
        errors, widths = 100.0 * np.array(row["errors"]), 100.0 * np.array(row["widths"])
        yield (
            f"| `{name}` | {row['covered']} of {row['arms']} | {np.median(errors):.2g} | {errors.max():.2g} |"
            f" {np.median(widths):.2g} | {np.mean(row['squares']):.2f} |"
        )
    covered, arms = (sum(row[k] for row in made.values()) for k in ("covered", "arms"))
    mean = np.mean(np.concatenate([row["squares"] for row in made.values()]))
    yield f"| all | {100.0 * covered / arms:.1f} % | | | | {mean:.2f} |"


def main(words=None):
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int)
    parser.add_argument(
        "--out", metavar="FILE", help="keep each arm in this file; the same command goes on from it"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(words)
    model.build(arm_file.parse(NOMINAL))  # a clear error before the workers start
    shown = lambda done: print(f"{done} of {options.arms}", file=sys.stderr, flush=True)  # noqa: E731
    try:
        rows = run(options.arms, options.seed, options.workers, shown, options.out)
    except FlexarmError as error:
        sys.exit(f"strain_coverage: {error}")
    made = table(rows)
    print(json.dumps(made) if options.json else "\n".join(text(made)))


if __name__ == "__main__":
    main()
