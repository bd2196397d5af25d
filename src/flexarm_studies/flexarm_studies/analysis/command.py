# SPDX-License-Identifier: Apache-2.0
"""``flexarm analyze``: computes time scales, bound on mu, margins, domain of attraction, Monte Carlo of a design."""

import json
import sys
from pathlib import Path

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model

from .. import workers
from ..commands.options import add_settings, at_least
from ..loop import scenario as scenarios
from ..loop.judged import verdict_of
from ..loop.metrics import residual_window
from ..progress import Progress
from . import attraction, bound, margins, monte_carlo, report, scales
from . import case as cases
from .default_motion import default_motion


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Analyses an arm and a controller before the arm moves; in part by short runs of the "
        "nonlinear loop."
    )
    parser.epilog = (
        "example: flexarm analyze R paper_composite --out results/analysis --monte-carlo 100"
    )
    add = parser.add_argument
    add("arm", help="a shipped name or the path of an arm file")
    add("controller", help="parameter file of the nodes: a shipped name or a path")
    add(
        "--trajectory",
        metavar="FILE|SPEC",
        help="the motion it is for, as `flexarm simulate` takes it (paper, or where the arm can't do that, a motion"
        " within its limits)",
    )
    add_settings(add)
    add("--rate", type=float, help="samples per second [Hz] (as in the file, or 1000)")
    add(
        "--delay",
        type=float,
        default=0.0,
        metavar="S",
        help="from a measurement until its torque acts, for verdict and runs (0) [s]",
    )
    add(
        "--configurations", type=int, default=200, metavar="N", help="number in the workspace (200)"
    )
    add("--quick", action="store_true", help="no nonlinear runs, a shorter search for the bound")
    add("--monte-carlo", type=int, metavar="N", help="N runs of arms that differ from the model")
    add("--seed", type=int, default=0, help="seed of configurations and samples (0)")
    workers.add_arguments(add, " for the Monte Carlo")
    add(
        "--out",
        metavar="DIR",
        help="figures, analysis.json, and the Monte Carlo's results, resumed",
    )
    add("--json", action="store_true", help="the results as JSON")


def analyze(options):
    """Run the sub-command."""
    at_least("--configurations", options.configurations, 1)
    at_least("--seed", options.seed, 0)
    if options.monte_carlo is None and (options.workers or options.scheduler):
        raise FlexarmError("only with --monte-carlo", field="--workers, --scheduler")
    values = scenarios.parameters(options.controller, options.set or (), options.arm)
    motion = options.trajectory
    if motion is None:
        arm_model = model.build(arm_file.load(options.arm))
        motion = default_motion(arm_model, values.get("fast.configuration"))
    scenario = scenarios.Scenario(
        options.arm, values, trajectory=motion, rate=options.rate, delay=options.delay
    )
    found = study(scenario, options, Progress())
    text = json.dumps(found, allow_nan=False)
    if options.out:
        from . import figures

        directory = Path(options.out)
        directory.mkdir(parents=True, exist_ok=True)
        (directory / "analysis.json").write_text(text + "\n", encoding="utf-8")
        figures.draw(found, directory)
    print(text if options.json else "\n".join(report.lines(found)), file=sys.stdout)


def study(scenario, options, progress):
    """Run the requested analyses.

    Parameters
    ----------
    scenario : Scenario
    options : namespace
        ``quick``, ``configurations``, ``seed``, ``monte_carlo``, ``workers``, ``scheduler``, ``out``.
    progress : Progress

    Returns
    -------
    dict
        Ready for JSON: ``verdict``, ``scenario``, ``scales``, ``gain_sweep``, ``bound``, ``margins``, ``attraction``
        (None if quick), ``monte_carlo`` (None if not requested).
    """
    total = 4 + (not options.quick) + (options.monte_carlo is not None)
    progress.step("verdict", 1, total)
    case = cases.of(scenario)
    judged = verdict_of(scenarios.loop_of(case.scenario), case.places, scenario.delay)
    found = {"verdict": judged.as_dict(), "scenario": scenario.as_dict()}
    found["rate_Hz"] = 1.0 / case.period
    progress.step("time scales and full-order poles", 2, total)
    found["scales"] = s = _or_reason(scales.study, case, options.configurations, options.seed)
    progress.fraction(0.5)
    found["gain_sweep"] = _or_reason(scales.gain_sweep, case, rows=[])
    progress.step("bound on mu", 3, total)
    if s["reason"]:
        found["bound"] = {"bound": None, "reason": s["reason"]}
    else:
        found["bound"] = _or_reason(_bound, case, options.quick, bound=None)
    progress.step("margins", 4, total)
    found["margins"] = _or_reason(margins.study, case, not options.quick, stable=None)
    found["attraction"] = None
    if not options.quick:
        progress.step("domain of attraction", 5, total)
        found["attraction"] = _or_reason(attraction.study, case, rays=[])
    found["monte_carlo"] = None
    if options.monte_carlo is not None:
        progress.step(f"Monte Carlo, {options.monte_carlo} runs", total, total)
        spec = monte_carlo.specification(scenario, options.seed)
        results = monte_carlo.run(
            spec,
            options.monte_carlo,
            options.out,
            options.workers,
            options.scheduler,
            progress,
        )
        window = list(residual_window(scenario.window))
        found["monte_carlo"] = monte_carlo.summary(results) | {"residual_window_s": window}
    progress.done()
    return found


def _bound(case, quick):
    mu = scales.at(case, case.q, 0.0 * case.q, scales.slow_poles(case))["mu"]
    return bound.study(case, mu, quick)


def _or_reason(study, *arguments, **empty):
    """A part of the analysis; if arm or control does not allow it, only the ``reason`` and the `empty` entries."""
    try:
        return study(*arguments)
    except (FlexarmError, np.linalg.LinAlgError) as error:
        return {"reason": str(error), **empty}
