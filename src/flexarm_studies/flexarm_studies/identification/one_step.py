# SPDX-License-Identifier: Apache-2.0
"""How far predicted strains are off a sample ahead: the observer without torque beside what needs no model.

``python -m flexarm_studies.identification.one_step exp1.csv rough.yaml --mapping tudor --observer observer.yaml --fit
14:60 --score 60:80`` prints the rms errors of a part of a recording. An autoregression and the observer's memory of its
innovations are fitted on another part and then kept constant. Persistence takes the last reading as the prediction of
the next one. The autoregressions predict each gauge from all gauges.
"""

import argparse
import json
import sys

import numpy as np

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import observe
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model

from ..commands import options as options_of
from ..loop import parameter_files
from ..recordings import mapping as mappings
from . import recording as recordings

#: Past samples of the autoregression with which the observer is compared.
ORDER = 8
#: The observer that is run, and the prefix of its parameters.
OBSERVER, PREFIX = "motion_kalman", "observer."
MICRO = 1e6


def filter_errors(arm, parameters, run, learnt):
    """Measured minus predicted strain of each sample, for the filter alone and with its memory, shape (s, g) each.

    Parameters
    ----------
    arm : Arm
        It has the recording's joints and gauges.
    parameters : dict
        Of the observer, without its type.
    run : Recording
        It begins at rest.
    learnt : int
        Number of samples after which the memory's coefficients stay constant.
    """
    built = model.build(arm.known)  # as in the observer node: the links are fixed to the motors
    core = observe(built, OBSERVER, parameters)
    sample = ArmSample(built.n_joints, built.n_modes, len(arm.gauges))
    sample.velocity_known, sample.amplitude = False, None
    alone, whole = np.full((2, *run.strain.shape), np.nan)
    period = round(1e9 * run.period)
    for k, (position, strain) in enumerate(zip(run.position, run.strain, strict=True)):
        core.observer.memory.learning = k < learnt
        sample.stamp_ns, sample.session, sample.sequence = 10**9 + period * k, 1, k
        sample.position[:], sample.strain[:] = position, strain
        core.step(sample)
        alone[k], whole[k] = core.observer.strain_innovation, core.observer.strain_error
    return alone, whole


def regression_errors(strain, fitted, order):
    """Measured minus predicted `strain`, shape (s, g), by an autoregression.

    The autoregression has the given `order` and is fitted to the first `fitted` samples.
    """
    count = len(strain) - order
    past = [strain[order - 1 - k : order - 1 - k + count] for k in range(order)]
    past = np.hstack([*past, np.ones((count, 1))])
    now = strain[order:]
    of = np.linalg.lstsq(past[: fitted - order], now[: fitted - order], rcond=None)[0]
    return np.vstack([np.full((order, strain.shape[1]), np.nan), now - past @ of])


def compare(arm, parameters, run, fitted, order=ORDER):
    """Errors of each predictor after the first `fitted` samples: a dict of name to rms, shape (g,) [-].

    Parameters
    ----------
    arm : Arm
    parameters : dict
        Of the observer, without its type.
    run : Recording
        The fitted part and, directly after it, the scored part.
    fitted : int
        Samples of the fitted part.
    order : int
        Of the autoregression.
    """
    alone, whole = filter_errors(arm, parameters, run, fitted)
    persistence = np.vstack(
        [np.full((1, run.strain.shape[1]), np.nan), np.diff(run.strain, axis=0)]
    )
    made = {"persistence": persistence}
    memory = parameters.get("innovation_order", 0)
    for k in sorted({order, memory} - {0}):
        made[f"autoregression of order {k}"] = regression_errors(run.strain, fitted, k)
    made[OBSERVER] = alone
    if memory:
        made[f"{OBSERVER}, innovations of order {memory}"] = whole
    return {name: np.sqrt(np.mean(e[fitted:] ** 2, axis=0)) for name, e in made.items()}


def observer_parameters(name):
    """Parameters of the observer, without the type, from a controller file; `name` is a path or a shipped name."""
    values = parameter_files.load(name)["controller"]
    found = {k.removeprefix(PREFIX): v for k, v in values.items() if k.startswith(PREFIX)}
    if found.pop("type", OBSERVER) != OBSERVER:
        raise FlexarmError("is another observer", field=str(name), limit=OBSERVER)
    return found


def text(table, names):
    """Lines of the table of `compare`, as Markdown, for gauges of these `names`."""
    yield f"| error a sample ahead, rms [microstrain] | {' | '.join(names)} |"
    yield f"| --- | {' | '.join('---' for _ in names)} |"
    for name, rms in table.items():
        yield f"| {name} | {' | '.join(f'{MICRO * v:.2f}' for v in rms)} |"


def main(words=None):
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording")
    parser.add_argument("arm")
    mappings.add_option(parser)
    parser.add_argument(
        "--observer", required=True, metavar="FILE", help="its parameters, as of a controller file"
    )
    parser.add_argument("--fit", required=True, metavar="FROM:TO", help="[s]")
    parser.add_argument(
        "--score",
        required=True,
        metavar="FROM:TO",
        help="[s], from the end of --fit on",
    )
    parser.add_argument("--order", type=int, default=ORDER, help=f"of the autoregression ({ORDER})")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(words)
    try:
        table, names = _compared(options)
    except FlexarmError as error:
        sys.exit(f"one_step: {error}")
    if options.json:
        print(json.dumps({name: rms.tolist() for name, rms in table.items()}))
    else:
        print("\n".join(text(table, names)))


def _compared(options):
    fit, score = (options_of.span(getattr(options, k), f"--{k}") for k in ("fit", "score"))
    if fit[1] != score[0]:
        raise FlexarmError("does not follow --fit", field="--score", value=score[0], limit=fit[1])
    arm = arm_file.load(options.arm)
    whole = recordings.read_csv(options.recording, arm, mappings.of_options(options))
    run = whole.between(fit[0], score[1])
    fitted = round((fit[1] - fit[0]) / run.period)
    table = compare(arm, observer_parameters(options.observer), run, fitted, options.order)
    return table, arm.gauge_names


if __name__ == "__main__":
    main()
