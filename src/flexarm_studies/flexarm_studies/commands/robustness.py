# SPDX-License-Identifier: Apache-2.0
r"""``flexarm robustness``: finds how many lost samples, how much random delay and which other arms a loop tolerates.

A motion is simulated on arms that are not the controller's model (`uncertain.plants`), for nominal and worst errors.
With the arm of the file, it is simulated with samples that are lost independently with a probability. Separately, it is
simulated with every sample delayed by a time uniform from 0 to a maximum (`network`). There are several seeds at each
level; observer, controller, limits and the driver's timeout are included. A run is stable if the loop did not lose the
arm and, compared with the same run without loss and delay,

- the largest joint error is at most `TRACKING` times as large, plus `ALLOWED`;
- the largest bending, :math:`\sqrt{\delta^T K\delta}` with the links' stiffness K, is at most `BENDING` times as large;
- the largest tip error over the last 0.5 s of the window after the motion is at most `SETTLED` of the arm's reach
  larger.

Errors are relative to the reference at that time, not to the older reference that the answer to a late sample used.
"""

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from flexarm_control.robust import default
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError

from .. import markdown, workers
from ..comparison.controllers import Setup
from ..loop import scenario as scenarios
from ..loop.metrics import tracking_metrics
from ..progress import Progress
from ..store import Store, gather
from ..uncertain import report, runs
from ..uncertain.plants import VARIANTS, names_for
from ..uncertain.trial import ArmTask
from .options import add_arm_arguments, chosen, in_range, numbers, show

#: Bounds of a stable run; see the module. `ALLOWED` in rad, `SETTLED` as a fraction of the reach.
TRACKING, ALLOWED, BENDING, SETTLED = 2.0, 0.05, 1.5, 0.005
#: Swept fields of `Scenario`: name in words, factor to the command's unit, and that unit.
SWEPT = {
    "loss": ("samples lost", 100.0, "%"),
    "jitter": ("delay uniform from 0 to", 1e3, "ms"),
}
#: More levels must be a mistake in a range.
MAX_LEVELS = 200
COLUMNS = (
    "controller", "disturbance", "level", "unit", "stable", "of",
    "joint error [deg]", "bending [-]", "tip at rest [mm]", "why",
)  # fmt: skip


def add_arguments(parser):
    """Arguments of ``robustness``."""
    parser.description = (
        "Simulates a motion on arms that differ from the arm file, and separately with samples lost at random and with "
        "random delays, at rising levels, and reports nominal and worst errors, and where the loop becomes unstable."
    )
    parser.epilog = (
        "example: flexarm robustness R --controller paper_composite --loss 0:0.1:0.9 --delay 0:4:40"
    )
    add = parser.add_argument
    add_arm_arguments(parser, "rows as JSON: plants, sweeps")
    add(
        "--controller",
        action="append",
        metavar="FILE",
        help="parameter file of the nodes, shipped name or path; may be repeated (the nodes' defaults: default)",
    )
    add("--trajectory", default="paper", metavar="FILE|SPEC", help="the motion (paper)")
    add("--rate", type=float, default=500.0, help="samples per second (500)")
    add("--loss", default="0:0.1:0.9", metavar="FROM:STEP:TO", help="fraction lost (0:0.1:0.9)")
    add("--delay", default="0:4:40", metavar="FROM:STEP:TO", help="largest delay [ms] (0:4:40)")
    add("--seeds", type=int, default=3, help="runs at each level (3)")
    add("--noise", action="store_true", help="gauges have the arm file's noise")
    add("--window", type=float, default=3.0, help="time after the motion [s] (3)")
    names = ",".join(VARIANTS)
    add("--plants", default=names, help=f"uncertain set, separated by commas; or none ({names})")
    workers.add_arguments(add)
    add(
        "--out",
        metavar="FILE.jsonl",
        help="keep every result; those in it are not computed again, so an interrupted command goes on",
    )
    add("--figure", metavar="FILE.png", help="draw the sweeps")


@dataclass(frozen=True)
class Specification:
    """Settings that all results of a file have in common."""

    robustness: dict


def robustness(options):
    """Run ``robustness``."""
    in_range("--seeds", options.seeds, 1, 1000)
    levels = {
        "loss": levels_of("--loss", options.loss, 1.0),
        "jitter": [1e-3 * ms for ms in levels_of("--delay", options.delay, 1000.0)],
    }
    names = () if options.plants == "none" else chosen("--plants", options.plants, VARIANTS)
    variants = names_for(arm_file.load(options.arm), names)
    scenario_of, calls = _scenarios(options), {}
    for name, scenario in scenario_of.items():
        calls |= {f"{name}/{v}": (on_plant, name, scenario, v) for v in variants}
        for what, values in levels.items():
            calls |= {
                f"{name}/{what} {x}": (at, name, scenario, what, x, options.seeds) for x in values
            }
    settings = {name: scenario.as_dict() for name, scenario in scenario_of.items()}
    found = _computed(options, calls, Specification({"seeds": options.seeds, "runs": settings}))
    plants = [row for row in found if "variant" in row]
    sweeps = [row for row in found if "variant" not in row]
    lines = [*report.table(plants), "", *report.verdicts(plants), ""] if plants else []
    lines += [*table(sweeps), "", *breaks(sweeps)]
    show(options, {"plants": plants, "sweeps": sweeps}, lines, indent=1)
    if options.figure:
        draw(sweeps, options.figure, f"{options.arm}, {options.trajectory}, {options.rate:g} Hz")


def _scenarios(options):
    """The undisturbed `Scenario` of each controller, by its file's name without folder and suffix."""
    found = {}
    for file in options.controller or ["default"]:
        name = Path(file).stem
        if name in found:
            raise FlexarmError("is there twice", field="--controller", value=name)
        found[name] = scenarios.Scenario(
            options.arm,
            {} if file == "default" else scenarios.parameters(file),
            trajectory=options.trajectory,
            rate=options.rate,
            noise=options.noise,
            window=options.window,
        )
    return found


def _computed(options, calls, specification):
    """Rows of `calls`, a function with its arguments each, by their keys."""
    keep, progress = Store(options.out, specification), Progress()
    left = [(key, *call) for key, call in calls.items() if key not in keep.results]
    done = len(calls) - len(left)
    for i, _ in gather(keep, _kept, left, options.workers, options.scheduler):
        done += 1
        progress.step(left[i][0], done, len(calls))
    progress.done()
    return [keep.results[key]["row"] for key in calls]


def _kept(key, function, *arguments):
    return [{"sample": key, "row": function(*arguments)}]


def on_plant(name, scenario, variant):
    """Row of `runs.rows` of the controller `name` and motion of a `scenario`, on one of the uncertain plants."""
    given = dict(scenario.controller) | {"rate": scenario.rate}
    # Runs take an arm that was read; it gets a design only if one is wanted.
    if default.is_wanted(scenario.arm, given, given.get("design.type", default.AUTO)):
        given["design.type"] = default.ROBUST
    task = ArmTask(scenario.arm, arm_file.load(scenario.arm), scenario.trajectory)
    (row,) = runs.rows(task, scenario.arm, name, lambda case: Setup(given), [variant])
    return {k: v for k, v in row.items() if k not in ("sample", "seconds")}


def levels_of(option, text, most):
    """Numbers from ``from:step:to``, or a single one."""
    parts = numbers(option, text, ":")
    first, step, last = parts if len(parts) == 3 else (parts[0], 1.0, parts[0])
    count = np.floor((last - first) / step + 1e-9) + 1 if step > 0.0 else 0
    possible = len(parts) in (1, 3) and 0.0 <= first <= last <= most and 1 <= count <= MAX_LEVELS
    if not possible:
        raise FlexarmError(
            "is no possible range",
            field=option,
            value=text,
            limit=f"0 to {most:g}, at most {MAX_LEVELS} levels",
            hint="give FROM:STEP:TO, such as 0:0.1:0.9",
        )
    return (first + step * np.arange(int(count))).round(12).tolist()


class Judge:
    """Decides whether runs are stable, by comparison with the undisturbed run of a `scenario`."""

    def __init__(self, scenario):
        self.scenario = scenario
        # The smallest possible jitter: the same loop, with samples on its clock.
        record, _, loop = scenarios.run_loop(replace(scenario, jitter=1e-9))
        if loop.lost:
            raise FlexarmError(f"lost the arm without any loss or delay: {loop.lost}", field="loop")
        self._reference = record
        motion = scenarios.trajectory_of(scenario.trajectory, loop.model, loop.simulator.position)
        self._end = 1e-9 * int(motion.times_ns[-1])
        self._reach = loop.model.arm.reach
        self.undisturbed = self._sizes(record, loop)

    def run(self, **disturbance):
        """Run the scenario with fields replaced by those of the `disturbance`.

        Returns the largest joint error [rad], the largest bending relative to the undisturbed one [-], the tip's error
        at rest [m], and why the run is not stable; empty if it is.
        """
        try:
            record, _, loop = scenarios.run_loop(replace(self.scenario, **disturbance))
        except FlexarmError as error:
            return np.nan, np.nan, np.nan, str(error)
        error, bending, rest = self._sizes(record, loop)
        error0, bending0, rest0 = self.undisturbed
        ratio = bending / bending0 if bending0 else 0.0
        why = loop.lost
        if not why and error > TRACKING * error0 + ALLOWED:
            why = f"a joint is {np.degrees(error):.3g} deg off its reference"
        elif not why and ratio > BENDING:
            why = f"bent {ratio:.3g} times as far as undisturbed"
        elif not why and rest > rest0 + SETTLED * self._reach:
            why = f"the tip is still {1e3 * rest:.3g} mm off"
        return error, ratio, rest, why

    def _sizes(self, record, loop):
        """Largest joint error [rad], bending [J^0.5] and the tip's error at rest [m]."""
        kept = self._reference
        columns = [np.interp(record.time, kept.time, x) for x in kept.reference.T]
        record = replace(record, reference=np.stack(columns, axis=1))
        moving = record.time >= 0.0
        error = np.abs(record.reference - record.plant_position)[moving].max(initial=0.0)
        plant = loop.simulator.plant_model
        stiffness = plant.terms(record.plant_position[0], np.zeros(plant.n_joints)).K2
        delta = record.plant_amplitude[moving]
        with np.errstate(over="ignore", invalid="ignore"):
            energy = np.einsum("ki,ij,kj->k", delta, stiffness, delta)
            found = tracking_metrics(record, loop.model, plant, self._end, self.scenario.window)
        rest = 1e-3 * found["final_tip_error_mm"]
        return float(error), float(np.sqrt(energy.max(initial=0.0))), rest


def at(name, scenario, what, level, seeds):
    """Run a controller's `scenario` at one level of a disturbance, `what`: ``loss`` [-] or ``jitter`` [s].

    Returns a row with the controller's `name` and the worst numbers of its `seeds` runs, keys `COLUMNS`; None if a run
    has no number.
    """
    judge, (words, factor, unit) = _judge(json.dumps(scenario.as_dict())), SWEPT[what]
    found = [judge.run(**{what: level, "seed": scenario.seed + k}) for k in range(seeds)]
    error, ratio, rest = (_worst([r[j] for r in found]) for j in range(3))
    reasons = [r[3] for r in found if r[3]]
    head = (name, words, round(factor * level, 9), unit, seeds - len(reasons), seeds)
    worst = (
        None if error is None else float(np.degrees(error)),
        ratio,
        None if rest is None else 1e3 * rest,
    )
    return dict(zip(COLUMNS, (*head, *worst, (reasons or [""])[0]), strict=True))


@lru_cache(maxsize=4)
def _judge(scenario):
    return Judge(scenarios.Scenario(**json.loads(scenario)))


def _worst(values):
    values = np.array(values)
    return float(values.max()) if np.isfinite(values).all() else None


def table(rows):
    """Lines of the table, Markdown."""
    return markdown.table(COLUMNS, (row.values() for row in rows))


def breaks(rows):
    """Lines with the level up to which each loop was stable in all of its runs."""
    lines = []
    for controller, what in dict.fromkeys((r["controller"], r["disturbance"]) for r in rows):
        own = [r for r in rows if (r["controller"], r["disturbance"]) == (controller, what)]
        bad = next((i for i, r in enumerate(own) if r["stable"] < r["of"]), None)
        unit, runs = own[0]["unit"], f"{own[0]['of']} of {own[0]['of']} runs"
        if bad is None:
            text = f" {own[-1]['level']:g} {unit}, the most tried: {runs} stable"
        else:
            first, upto = own[bad], own[bad - 1]["level"]
            text = f": stable in {runs} up to {upto:g} {unit}, " if bad else ": "
            text += f"breaks at {first['level']:g} {unit} in {first['of'] - first['stable']} of {first['of']}"
            text += f": {first['why']}"
        lines.append(f"{controller}: {what}{text}")
    return lines


def draw(rows, path, title):
    """Draw the worst joint error and tip error at rest over both disturbances; crosses are unstable runs."""
    from ..plotting import STYLE, plt, save

    kinds = list(dict.fromkeys((r["disturbance"], r["unit"]) for r in rows))
    measures = {
        "joint error [deg]": "largest joint error [deg]",
        "tip at rest [mm]": "tip's error at rest [mm]",
    }
    with plt.rc_context({**STYLE, "figure.figsize": (8.0, 5.6)}):
        figure, axes = plt.subplots(
            len(measures), len(kinds), sharex="col", sharey="row", squeeze=False
        )
        names = list(dict.fromkeys(r["controller"] for r in rows))
        for line, (key, label) in zip(axes, measures.items(), strict=True):
            line[0].set_ylabel(label)
            for column, (what, _) in zip(line, kinds, strict=True):
                for k, name in enumerate(names):
                    own = [r for r in rows if r["controller"] == name and r["disturbance"] == what]
                    _curve(column, own, key, f"C{k}", name)
                column.set_yscale("log")
        for column, (what, unit) in zip(axes[-1], kinds, strict=True):
            column.set_xlabel(f"{what} [{unit}]")
        axes[0, 0].legend()
        figure.suptitle(
            f"{title}: worst of {rows[0]['of']} runs; crosses: not stable in all", size=11
        )
        figure.tight_layout()
        save(figure, path)


def _curve(axes, rows, key, colour, name):
    """One loop's curve: dots where all runs were stable, crosses elsewhere."""
    level = np.array([r["level"] for r in rows])
    value = np.array([np.nan if r[key] is None else r[key] for r in rows])
    stable = np.array([r["stable"] == r["of"] for r in rows])
    axes.plot(level, value, color=colour, label=name)
    axes.plot(level[stable], value[stable], "o", color=colour, ms=4)
    axes.plot(level[~stable], value[~stable], "x", color=colour, ms=7)
