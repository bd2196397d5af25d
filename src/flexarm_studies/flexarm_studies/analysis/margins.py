# SPDX-License-Identifier: Apache-2.0
"""Computes margins: the delay, drive gain, payload, stiffness and lower rate that the loop withstands; noise at rest.

A margin is the value at which the sampled full-order loop with full state, linearised at the motion's end, loses
stability (`full_order.closed_loop`, by bisection). The observer is not part of it. With runs, the nonlinear loop with
its observer is tried at 0.9 and 1.1 times the margin; if the margin of this loop is elsewhere, bisection by runs finds
it.
"""

from dataclasses import dataclass, replace

import numpy as np

from flexarm_control.composite import full_order
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import FlexarmError

from ..loop import scenario as scenarios
from ..loop.metrics import tip_path
from . import case as cases
from . import trial

#: Duration for which the arm is held to judge noise, and its first part that is left out [s].
HELD, SETTLING = 3.0, 1.0
#: Number of bisections by runs, and the largest multiple of the margin that they try [-].
RUNS, MAX_MULTIPLE = 4, 1.5


@dataclass(frozen=True)
class Margin:
    """One kind of margin.

    Attributes
    ----------
    name, unit, text : str
    start, end : float
        Nominal value, and the farthest value that is tried.
    poles : callable
        From the case and a value: keywords of `Case.poles`.
    run : callable
        From the scenario and a value: scenario and gain of a run.
    """

    name: str
    unit: str
    text: str
    start: float
    end: float
    poles: object
    run: object


def _plant(name):
    return (
        lambda s, v: {"plant": scaled(s.arm, **{name: v})},
        lambda c, v: (replace(c, **{f"{name}_scale": v}), 1.0),
    )


def kinds(case):
    """All margins of a case."""
    T = case.period
    delay = (lambda s, v: {"delay": v}, lambda c, v: (replace(c, delay=v), 1.0))
    gain = (lambda s, v: {"gain": v}, lambda c, v: (c, v))
    rate = (lambda s, v: {"period": 1.0 / v}, lambda c, v: (replace(c, rate=v), 1.0))
    return (
        Margin("delay", "s", "delay from measurement to torque, above", 0.0, 0.5, *delay),
        Margin("gain_high", "-", "torque times a factor above", 1.0, 100.0, *gain),
        Margin("gain_low", "-", "torque times a factor below", 1.0, 0.01, *gain),
        Margin("payload_high", "-", "payload times a factor above", 1.0, 30.0, *_plant("payload")),
        Margin("payload_low", "-", "payload times a factor below", 1.0, 0.0, *_plant("payload")),
        Margin("stiffness_high", "-", "stiffness times, above", 1.0, 30.0, *_plant("stiffness")),
        Margin("stiffness_low", "-", "stiffness times, below", 1.0, 0.02, *_plant("stiffness")),
        Margin("rate_low", "Hz", "samples per second below", 1.0 / T, 4.0, *rate),
    )


#: Other plants whose decay is always computed: name, factor.
PLANTS = tuple(
    [("payload", v) for v in (0.0, 0.5, 2.0, 3.0)] + [("stiffness", v) for v in (0.7, 1.0, 1.3)]
)
#: Margins that runs confirm.
TRIED = ("delay", "gain_high")


def study(case, runs=True, tried=TRIED, progress=None):
    """All margins. With `runs`, nonlinear runs confirm those of `tried`, and noise is judged.

    Returns ``reason``; ``decay_per_s``; per margin ``value`` (None: none up to ``searched``) and, if tried,
    ``confirmed`` and ``simulated``; ``plants``: decay rate of the loop on other arms; ``noise``.
    """
    if case.without_poles:
        return {"reason": case.without_poles, "stable": None}
    nominal = case.decay()
    found = {"reason": "", "stable": nominal > -full_order.ROUNDING, "decay_per_s": nominal}
    every = {kind.name: of_poles(case, kind) for kind in kinds(case)}
    found["margins"] = every
    decays = [_decay(case, scaled(case.arm, **{name: v})) for name, v in PLANTS]
    found["plants"] = [
        {"what": name, "factor": v, "decay_per_s": decay}
        for (name, v), decay in zip(PLANTS, decays, strict=True)
    ]
    if runs and found["stable"]:
        names = [k for k in kinds(case) if k.name in tried and every[k.name]["value"] is not None]
        for i, kind in enumerate(names):
            every[kind.name] |= by_runs(case, kind, every[kind.name]["value"])
            if progress is not None:
                progress.fraction((i + 1) / (len(names) + 1))
    found["noise"] = noise(case) if runs else {"reason": "not computed with --quick"}
    return found


def _decay(case, arm):
    """As `Case.decay` for another arm; None if that arm does not rest."""
    try:
        return case.decay(plant=arm)
    except FlexarmError:
        return None


def of_poles(case, kind):
    """A margin by the poles of the sampled full-order loop."""

    def stable(value):
        try:
            return case.decay(**kind.poles(case, value)) > full_order.ROUNDING
        except FlexarmError:
            return False

    value = cases.first_loss(stable, kind.start, kind.end, scan=24, steps=12)
    return {"value": value, "searched": kind.end, "unit": kind.unit, "text": kind.text}


def _beside(kind, value, fraction):
    """A value on the safe side of a margin (fraction < 1), or beyond it."""
    if kind.start == 0.0:
        return fraction * value
    return kind.start * (value / kind.start) ** fraction if value > 0.0 else value


def by_runs(case, kind, value):
    """Check a margin by nonlinear runs; `kind` is the `Margin`, `value` that of the linear loop.

    Returns ``confirmed``: stable at 0.9 and unstable at 1.1 of the margin (of its logarithm for factors);
    ``simulated``: the margin of the loop with its observer if it differs, otherwise None; ``at_least``: whether that is
    only the largest value tried.
    """
    unstable = kind.poles(case, _beside(kind, value, 1.02))
    watched = trial.long_enough(case.poles(**unstable)[0])

    def stable(fraction):
        scenario, gain = kind.run(case.scenario, _beside(kind, value, fraction))
        return trial.dies_out(scenario, case.q, gain, watched)

    inside, beyond = stable(0.9), stable(1.1)
    if inside and not beyond:
        return {"confirmed": True, "simulated": None, "at_least": False}
    good, bad = (1.1, MAX_MULTIPLE) if inside else (0.0, 0.9)
    if inside and stable(bad):
        return {"confirmed": False, "simulated": _beside(kind, value, bad), "at_least": True}
    for _ in range(RUNS):
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if stable(middle) else (good, middle)
    return {"confirmed": False, "simulated": _beside(kind, value, good), "at_least": False}


def noise(case):
    """Rms motion of the tip while the arm is held at the motion's end, with the noise of the arm file."""
    gauges = case.arm.gauges
    if not any(g.noise or g.drift for g in gauges):
        return {"reason": f"the arm file of {case.arm.name} states none", "tip_rms_mm": None}
    q = case.q.tolist()
    hold = {"times": [0.0, 0.1], "positions": [q, q]}
    scenario = replace(case.scenario, trajectory=hold, noise=True, duration=HELD, repeat=1)
    record, metrics, loop = scenarios.run_loop(scenario)
    if metrics["lost"]:
        return {"reason": metrics["reason"], "tip_rms_mm": None}
    plant, late = loop.simulator.plant_model, record.time > SETTLING
    tip = tip_path(plant, record.plant_position[late], record.plant_amplitude[late])
    return {
        "reason": "",
        "tip_rms_mm": 1e3 * float(np.sqrt(tip.var(0).sum())),
        "torque_rms_Nm": record.torque[late].std(0).tolist(),
    }
