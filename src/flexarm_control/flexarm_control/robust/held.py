# SPDX-License-Identifier: Apache-2.0
"""Where the loops must be stable: in the configurations of a design, and on the way between them.

Gains that are stable in a few configurations may be unstable between them: the modes for which the torque's delay is a
phase lag of more than 90 degrees change their phase from place to place. So the set has the loops in each
configuration, and at places between the first configuration and each of the others. Each loop has the weighted mean of
the sets of gains that the control has at that place (`flexarm_control.schedule`).
"""

from dataclasses import replace

import numpy as np

from ..schedule import Schedule
from .uncertain import rests, uncertain_loops

#: Places on the way from the first configuration to each of the others, as fractions of the way [-].
BETWEEN = (0.33, 0.67)


def places(nominal, at, count):
    """Places where loops with `count` sets of gains must be stable: first the configurations, then between them.

    Between the configurations, places where the arm does not rest are left out.

    Parameters
    ----------
    nominal : ArmModel
    at : ndarray, shape (k, n)
        Configurations [rad].
    count : int
        Of sets of gains, 1 or k.

    Yields
    ------
    str, ndarray, ndarray
        The place in words, q (n,) [rad], and the weights of the sets there, (count,).
    """
    schedule = Schedule(nominal, at if count > 1 else ())
    for k, q in enumerate(at, 1):
        yield f"at configuration {k}", q, schedule.weights(q).copy()
    for k, end in enumerate(at[1:], 2):
        for part in BETWEEN:
            q = (1.0 - part) * at[0] + part * end
            if rests(nominal, q):
                yield f"between configurations 1 and {k}", q, schedule.weights(q).copy()


def held_loops(nominal, at, sampling, uncertainty, count=1):
    """The loops at all `places`, and the weights of the sets of gains in each loop.

    Parameters
    ----------
    nominal : ArmModel
    at : ndarray, shape (k, n)
        Configurations [rad].
    sampling : Sampling
    uncertainty : Uncertainty
    count : int
        Of sets of gains, 1 or k.

    Returns
    -------
    list of Loop, list of ndarray
    """
    if len(at) == 1:
        found = uncertain_loops(nominal, at, sampling, uncertainty)
        return found, [np.ones(1)] * len(found)
    loops, weights = [], []
    for number, (place, q, w) in enumerate(places(nominal, at, count)):
        sticking = number < len(at)
        found = uncertain_loops(nominal, q[None], sampling, uncertainty, 1, sticking)
        loops += [replace(one, name=f"{one.name.split(', at conf')[0]}, {place}") for one in found]
        weights += [w] * len(found)
    return loops, weights
