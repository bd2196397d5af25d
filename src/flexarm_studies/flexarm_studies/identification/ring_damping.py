# SPDX-License-Identifier: Apache-2.0
r"""Fits the damping parameters of a fit of strains to the decay of free vibration in ring-downs.

A fit by a sum of squares of strains overestimates damping. If a model's frequency is off by a fraction s, model and arm
have opposite phase after 1/2s periods. From then on, the faster the model's vibration decays, the smaller the sum is.
The decay itself does not depend on the phase. The damping ratios of ring-downs are found in measured and in modelled
strains, :math:`\zeta_r` and :math:`\hat\zeta_r`. With the mean squares :math:`V_g` of the residuals of the gauges, this
module minimises

.. math::
    \sum_r \Bigl(\frac{\ln(\zeta_r/\hat\zeta_r)}{s_\zeta}\Bigr)^2 + \sum_g \Bigl(w\,\bigl(V_g/V_{g0} - 1\bigr)\Bigr)^2,

where :math:`V_{g0}` are the mean squares of the fit. So the damping may become correct, and the residuals grow by a few
per cent. All other parameters keep their values.
"""

import numpy as np
from scipy.optimize import least_squares

from ..recordings import rest, ring_down

#: Kinds of quantities that cause damping.
DAMPING = (
    "damping",
    "transmission_damping",
    "transmission_load_damping",
    "transmission_play_damping",
)
#: Standard deviation s of the logarithm of a damping ratio, and weight w of the residuals [-].
SPREAD, WEIGHT = 0.3, 6.0
#: Smallest damping ratio that is used, and smallest and largest factor of a quantity [-].
LEAST, LOW, HIGH = 1e-4, 0.01, 4.0
#: Relative step of differences, and number of evaluations.
STEP, EVALUATIONS = 0.03, 7
#: Number of ring-downs that are needed.
MIN_RING_DOWNS = 3


def fit(problem, report):
    """Change the free damping quantities of a fitted `problem` so that they match its recording's ring-downs.

    Parameters
    ----------
    problem : StrainProblem
        After `finish`.
    report : callable
        Called as ``report(label)`` with what is done.

    Returns
    -------
    list of int
        Indices of the quantities that were changed; none if there are too few ring-downs.
    """
    rings = _found(problem)
    which = [
        j
        for j, q in enumerate(problem.found)
        if q.kind in DAMPING and problem.free[j] and problem.values[j] > 0.0
    ]
    if len(rings) < MIN_RING_DOWNS or not which:
        problem.warnings.append(
            f"damping is not fitted to ring-downs: {len(rings)} were found, {MIN_RING_DOWNS} are needed"
            if which
            else "damping is not fitted to ring-downs: every damping is held"
        )
        return []
    report(f"damping from {len(rings)} ring-downs")
    base, first = problem.values.copy(), problem.made(problem.values)
    before = _squares(problem, first)

    def residuals(factor):
        values = base.copy()
        values[which] *= factor
        made = problem.made(values)
        if not np.isfinite(made).all():
            return np.full(len(rings) + before.size, 1.0 / SPREAD)
        logs = [np.log(_damping(problem, made, r) / r.damping) for r in rings]
        return np.r_[np.array(logs) / SPREAD, WEIGHT * (_squares(problem, made) / before - 1.0)]

    made = least_squares(
        residuals, np.ones(len(which)), bounds=(LOW, HIGH), diff_step=STEP, max_nfev=EVALUATIONS
    )
    problem.values[which] = base[which] * made.x
    return which


def _squares(problem, made):
    """Mean square of the residuals of each gauge that has readings."""
    error = np.where(problem.known, problem.measured - made, np.nan)
    return np.nanvar(error[:, problem.known.any(axis=0)], axis=0)


def _found(problem):
    run = problem.recording
    rings = ring_down.find(run, rest.stretches(run), np.sqrt(np.diag(problem.covariance_of_new)))
    return [r for r in rings if r.part.start >= problem.options.lead]


def _damping(problem, made, ring):
    modelled = ring_down.fit(made[ring.part, ring.gauge], problem.recording.period)
    return max(modelled.damping, LEAST)
