# SPDX-License-Identifier: Apache-2.0
"""Identifies an arm without torque from one part of a recording, and scores it on another."""

from dataclasses import dataclass, replace

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from ..recordings import rest
from ..recordings.summary import quiet_and_rings
from . import pickup, scores
from .currents import motor_fits
from .prescribed import MotionPredictor
from .strain_fit import Options, identify_strains, predict

#: If joints move at the beginning of the fitted part, the prediction begins up to this time before it [s].
LEAD = 10.0


@dataclass(frozen=True)
class Study:
    """What to fit and what to score.

    Attributes
    ----------
    fit, score : tuple of float, or None
        Beginning and end, as the recording counts the time [s]. If `fit` is None, all of it is fitted. If `score` is
        None, only the fitted part is scored, and all of another recording if there is one.
    above : float
        Corner of the additional high-passed scores [Hz].
    pickup : float, or None
        Frequency above which gauges are assumed to pick up the motor currents, see `pickup` [Hz]; None: they do not.
    """

    fit: tuple | None = None
    score: tuple | None = None
    above: float = 1.0
    pickup: float | None = None


def whole_of(recording):
    """Beginning and end of a recording [s]."""
    return recording.start, recording.start + recording.period * len(recording.position)


def study(arm, recording, wanted, options=None, other=None, **fitting):
    """Identify an arm from the strains of a part of a recording, and score it on another.

    Parameters
    ----------
    arm : Arm
    recording : Recording
        With the arm's joints and gauges.
    wanted : Study
    options : Options, optional
        Its `lead` is replaced here.
    other : Recording, optional
        Another recording that is scored; its biases are determined anew from its longest rest.
    fitting
        Further arguments of `identify_strains`.

    Returns
    -------
    found : StrainFit
    result : dict
        Plain data: ``parts`` with scores by gauge, ``ring_downs`` (those of `other`, if given), ``currents``,
        ``pickup``.
    run : tuple
        Recording, measured and predicted strains (s, g), from the beginning to the end of all that was predicted.
    """
    fit = wanted.fit or whole_of(recording)
    score = wanted.score or (None if other is None else whole_of(other))
    spans = [fit] if other is not None or score is None else [fit, score]
    begin = _begin(recording, min(a for a, _ in spans))
    run = recording.between(begin, max(b for _, b in spans))
    fitted = _rows(run, fit)
    options = replace(options or Options(), lead=fitted.start)
    found = identify_strains(arm, run.part(fitted.stop), options, **fitting)
    middle = 0.5 * (fitted.stop - 1) * run.period
    predicted = predict(found, run, options, middle)
    picked = _picked(run, predicted, fitted, wanted)
    given = found, recording, run, predicted, picked
    parts = {"fit": _scored(*given, fitted, fitted, wanted, options)}
    if other is not None:
        scored = _rows(other, score)
        parts["score"] = _other(found, other, score, picked, wanted, options)
    elif score is not None:
        scored = _rows(run, score)
        parts["score"] = _scored(*given, scored, fitted, wanted, options)
    else:
        scored = fitted
    shown = (run, predicted) if other is None else (other, predict(found, other, options))
    rings = scores.ring_downs(*shown, _noise(other or recording, found))
    motors = motor_fits(found, run, fitted, scored, options.corner, other)
    result = {
        "fit_s": fit,
        "score_s": score,
        "parts": parts,
        "currents": [_motor(m) for m in motors],
        "ring_downs": [_ring(shown[0], *r) for r in rings],
        "pickup": _pickup(picked),
    }
    return found, result, (run, predicted)


def _begin(recording, start):
    """Beginning of the prediction [s]: the last rest up to `start` [s]; if none is within `LEAD`, `LEAD` before it."""
    still = rest.still(recording)
    row = min(max(round((start - recording.start) / recording.period), 0), len(still) - 1)
    before = max(row - round(LEAD / recording.period), 0)
    standing = np.flatnonzero(still[before : row + 1])
    return recording.start + recording.period * (before + (standing[-1] if standing.size else 0))


def _picked(run, predicted, fitted, wanted):
    """The requested `Pickup`, or None."""
    if wanted.pickup is None:
        return None
    return pickup.fit(run, run.strain - predicted, fitted, wanted.pickup)


def _with_pickup(made, sizes, picked, run):
    """Add to `made` the model's prediction plus what the gauges pick up, if the pickup is useful."""
    if picked is not None and picked.useful:
        made["with pickup"] = made["model"] + picked.strain(run)[:, None]
        sizes["with pickup"] = picked.taps.size


def _pickup(picked):
    if picked is None:
        return None
    return {"above_hz": picked.above, "left": picked.left, "useful": picked.useful}


def _noise(recording, found):
    quiet, _ = quiet_and_rings(recording, rest.stretches(recording))
    return found.noise if quiet is None else quiet.rms


def _scored(found, recording, run, predicted, picked, part, fitted, wanted, options):
    """Scores of the model and of the baselines without a model on a `part` of a run, as plain data."""
    if part.stop - part.start < 20:
        raise FlexarmError(
            "has too few samples", field="scored part", value=part.stop - part.start, limit=20
        )
    predictor = MotionPredictor(found.setup.arm, run, options.corner)
    motion = predictor.position, predictor.velocity, predictor.acceleration
    made, sizes = {"model": predicted}, {}
    _with_pickup(made, sizes, picked, run)
    for name, (values, size) in scores.baselines(motion, run.strain, fitted).items():
        made[name], sizes[name] = values, size
    return _table(found, recording, run, made, sizes, part, wanted.above)


def _other(found, other, score, picked, wanted, options):
    """Scores on another recording, with the biases of its longest rest."""
    predicted = predict(found, other, options)
    rests = sorted(rest.stretches(other), key=lambda p: p.stop - p.start)
    if rests:
        predicted = predicted + np.nanmean((other.strain - predicted)[rests[-1]], axis=0)
    part = _rows(other, score)
    made, sizes = {"model": predicted}, {}
    _with_pickup(made, sizes, picked, other)
    return _table(found, other, other, made, sizes, part, wanted.above)


def _rows(recording, span):
    """The samples of a recording from beginning to end of a `span` [s]."""
    rows = np.round((np.array(span) - recording.start) / recording.period).astype(int)
    return slice(max(int(rows[0]), 0), min(int(rows[1]), len(recording.position)))


def _table(found, recording, run, made, sizes, part, above):
    names = found.arm.gauge_names
    rows = {name: {} for name in names}
    for what, values in made.items():
        score = scores.explained(run.strain, values, part, run.period, above)
        for c, name in enumerate(names):
            rows[name][what] = {key: _number(value[c]) for key, value in score.items()}
            if what in sizes:
                rows[name][what]["coefficients"] = sizes[what]
    best = scores.ceiling(recording, run.strain, part, above)
    for c, name in enumerate(names):
        memory, bound = scores.whiteness((run.strain - made["model"])[part, c])
        rows[name]["residual_correlation"] = {"value": _number(memory), "white_within": bound}
        rows[name]["ceiling"] = (
            None if best is None else {k: _number(v[c]) for k, v in best.items()}
        )
    return rows


def _number(value):
    return float(value) if np.isfinite(value) else None


def _motor(made):
    pairs = {
        "torque_constant": made.constant, "viscous": made.viscous, "coulomb": made.coulomb,
        "inertia": made.inertia,
    }  # fmt: skip
    return {
        "joint": made.joint,
        **{
            name: {"value": _number(value), "half_width": _number(width)}
            for name, (value, width) in pairs.items()
        },
        "left_of_fitted": _number(made.left),
        "left_of_scored": _number(made.left_of_scored),
        "explained": made.explained,
    }


def _ring(run, measured, modelled):
    return {
        "from_s": run.start + run.period * measured.part.start,
        "to_s": run.start + run.period * measured.part.stop,
        "gauge": run.gauge_names[measured.gauge] if run.gauge_names else str(measured.gauge),
        "amplitude": measured.amplitude,
        **{
            f"{who}_{what}": _number(getattr(ring, what))
            for who, ring in (("measured", measured), ("modelled", modelled))
            for what in ("frequency", "damping")
        },
        "frequency_width": _number(measured.frequency_width),
        "damping_width": _number(measured.damping_width),
    }
