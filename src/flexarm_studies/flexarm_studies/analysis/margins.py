# SPDX-License-Identifier: Apache-2.0
"""What the loop withstands of what it was not told: delay, gain of the drives, payload, stiffness, a lower rate; noise.

Each margin is where the sampled full-order loop, linear at the motion's end, loses stability: `full_order.closed_loop`
with the full state, found by bisection. The loop's observer is not part of it. Where runs are wanted, the nonlinear
loop with its observer is tried at 0.9 and 1.1 times the margin, and where its own is elsewhere, that is found by
bisection.
"""

from dataclasses import dataclass, replace

import numpy as np

from flexarm_control.composite import full_order
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import FlexarmError

from ..loop import scenario as scenarios
from . import case as cases
from . import trial

#: How long the arm is held while noise is judged, the first part left out [s].
HELD, SETTLING = 3.0, 1.0
#: Bisections by runs, and how far beyond the margin they look.
RUNS, FARTHEST = 4, 1.5


@dataclass(frozen=True)
class Margin:
    """One kind of margin.

    Attributes
    ----------
    name, unit, text : str
    start, end : float
        From the nominal value to the farthest that is looked at.
    poles : callable
        Of the case and the value: keywords of `Case.poles`.
    run : callable
        Of the scenario and the value: the scenario, and the gain, of a run.
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


#: Plants that are always looked at: name, factor.
PLANTS = tuple(
    [("payload", v) for v in (0.0, 0.5, 2.0, 3.0)] + [("stiffness", v) for v in (0.7, 1.0, 1.3)]
)
#: Margins that runs look at.
TRIED = ("delay", "gain_high")


def study(case, runs=True, tried=TRIED, progress=None):
    """All margins.

    Parameters
    ----------
    case : Case
    runs : bool
        Whether nonlinear runs confirm those of `tried`, and noise is judged.
    tried : sequence of str
    progress : Progress, optional

    Returns
    -------
    dict
        ``reason``; ``decay_per_s``; per margin ``value`` (None: none up to ``searched``) and, where tried,
        ``confirmed`` and ``simulated``; ``plants``: how fast the loop dies out on other arms; ``noise``.
    """
    if case.without_poles:
        return {"reason": case.without_poles, "stable": None}
    nominal = case.decay()
    found = {"reason": "", "stable": nominal > -full_order.ROUNDING, "decay_per_s": nominal}
    every = {kind.name: of_poles(case, kind) for kind in kinds(case)}
    found["margins"] = every
    found["plants"] = [
        {
            "what": name,
            "factor": v,
            "decay_per_s": case.decay(plant=scaled(case.arm, **{name: v})),
        }
        for name, v in PLANTS
    ]
    if runs and found["stable"]:
        names = [k for k in kinds(case) if k.name in tried and every[k.name]["value"] is not None]
        for i, kind in enumerate(names):
            every[kind.name] |= by_runs(case, kind, every[kind.name]["value"])
            if progress is not None:
                progress.fraction((i + 1) / (len(names) + 1))
    found["noise"] = noise(case) if runs else {"reason": "not asked for: --quick"}
    return found


def of_poles(case, kind):
    """A margin by the poles of the sampled full-order loop."""

    def stable(value):
        try:
            return case.decay(**kind.poles(case, value)) > full_order.ROUNDING
        except FlexarmError:
            return False

    value = cases.first_loss(stable, kind.start, kind.end, scan=24, steps=12)
    return {"value": value, "searched": kind.end, "unit": kind.unit, "text": kind.text}


def _beside(kind, value, share):
    """A value that lies on the safe side of a margin (share < 1), or beyond."""
    if kind.start == 0.0:
        return share * value
    return kind.start * (value / kind.start) ** share if value > 0.0 else value


def by_runs(case, kind, value):
    """What nonlinear runs say of a margin.

    `kind` is the margin's name, `value` what the linear loop says.

    Returns
    -------
    dict
        ``confirmed``: stable at 0.9, unstable at 1.1 of the way (in the logarithm for factors); ``simulated``:
        where the loop with its observer loses stability if it is elsewhere, else None; ``at_least``: whether
        that is only how far was looked.
    """
    unstable = kind.poles(case, _beside(kind, value, 1.02))
    watched = trial.long_enough(case.poles(**unstable)[0])

    def stable(share):
        scenario, gain = kind.run(case.scenario, _beside(kind, value, share))
        return trial.dies_out(scenario, case.q, gain, watched)

    inside, beyond = stable(0.9), stable(1.1)
    if inside and not beyond:
        return {"confirmed": True, "simulated": None, "at_least": False}
    good, bad = (1.1, FARTHEST) if inside else (0.0, 0.9)
    if inside and stable(bad):
        return {"confirmed": False, "simulated": _beside(kind, value, bad), "at_least": True}
    for _ in range(RUNS):
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if stable(middle) else (good, middle)
    return {"confirmed": False, "simulated": _beside(kind, value, good), "at_least": False}


def noise(case):
    """Rms motion of the tip while the arm is held at the motion's end, with the noise that the arm file states."""
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
    tip = np.array(
        [
            plant.tip_position(q, d)
            for q, d in zip(record.plant_position[late], record.plant_amplitude[late], strict=True)
        ]
    )
    return {
        "reason": "",
        "tip_rms_mm": 1e3 * float(np.sqrt(tip.var(0).sum())),
        "torque_rms_Nm": record.torque[late].std(0).tolist(),
    }
