# SPDX-License-Identifier: Apache-2.0
"""A further search, from gains that are stable, for gains with which motions leave less behind."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .loop import ARM, MARGIN
from .settling import AfterMotion, residuals, rings, together

#: The slowest pole of all loops keeps the fraction `KEEP` of the decay that was reached, and at least `LEAST`. If its
#: decay was less than `LEAST`, it keeps all of it [-].
KEEP, LEAST = 0.8, 0.05
#: With more configurations than this, the search takes fewer evaluations.
PLACES = 3
#: New gains are not taken if, in loops whose joints friction damps, the slowest pole that rings loses more than the
#: fraction `SHORTER` of its decay and then has less than `RINGS` times the speed (over omega_1). Such gains make J
#: smaller, but simulated arms settle later.
SHORTER, RINGS = 0.1, 0.03


class Further(NamedTuple):
    """A search for gains with which motions leave less, and when it is made."""

    much: float  # J of `settling.AfterMotion` from which the search is made, for a requested speed of 1 [-]
    enough: float  # J at which the search ends, likewise [-]
    evaluations: int  # at most
    eased: float  # factor of the decay that is asked of loops for a margin [-]


#: The first one that applies is used. If motions leave very much behind, part of the margins is given up in return.
FURTHER = (Further(3.5, 2.1, 800, 0.5), Further(2.0, 0.9, 400, 1.0))


def leaving_less(task, found, progress, speed=None):
    """If motions leave much behind: gains near the `found` ones with which they leave less.

    Parameters
    ----------
    task : design.Task
    found : design.Sets
        With stable loops.
    progress : callable
        Called with the fraction of the work that is done, and the decay of `found`.
    speed : float, optional
        The requested speed, if the task has a lower one; the task's if not given [-].

    Returns
    -------
    design.Sets or None
        None if no search is made, or it finds nothing better.
    """
    loops, weights = task.held(found.sampling, len(found.K))
    whole = task.search_of(loops, weights, found.sampling)
    left = _residuals(task, found)
    after, x = AfterMotion(whole.slowest, left), whole.slowest.scaled(found.K)
    decays = whole.decays(x)
    if not left or min(decays) <= 0.0:
        return None
    left_now, speed = after(x)[0], speed or task.speed
    chosen = next((one for one in FURTHER if left_now >= one.much / speed), None)
    if chosen is None:
        return None
    eased = [
        replace(one, fraction=part * one.fraction)
        for one, part in zip(loops, _parts(loops, decays, chosen.eased), strict=True)
    ]
    search = task.search_of(eased, weights, found.sampling)
    # If less is asked of a loop, v and its gradient are larger: a pole may count that did not move enough before.
    reached = min(decays + search.decays(x))
    if reached <= 0.0:
        return None
    budget = chosen.evaluations * task.settings.effort * min(1.0, PLACES / len(task.at))
    other = search.sooner(
        x,
        after,
        _kept(reached),
        max(1, round(budget)),
        chosen.enough / speed,
        lambda fraction: progress(fraction, found.decay),
    )
    if other is x or _rings_longer(after.ringing(other), after.ringing(x), task.speed):
        return None
    used = found.evaluations + whole.evaluations + search.evaluations
    return task.sets(whole, other, used)


def leaves(task, found):
    """J of the `found` gains (`settling.AfterMotion`): about how late the tip settles after a motion [-].

    Parameters
    ----------
    task : design.Task
    found : design.Sets
    """
    return together([one(found.K[k])[0] for k, one in _residuals(task, found)])


def _residuals(task, found):
    """A `Residual` for each arm and configuration, after the number of its set of gains."""
    return [
        (min(k, len(found.K) - 1), one)
        for k, q in enumerate(task.at)
        for one in residuals(task.nominal, q, found.sampling, task.uncertainty)
    ]


def rings_longer(task, found, other, than):
    """Whether the gains `than`, found in the task `other`, ring longer than the `found` ones of `task`.

    This is the test by which new gains of `leaving_less` are refused, with `LEAST` in place of `RINGS`: another search
    may end at gains with which a mode rings a little longer or shorter.
    """
    now, before = (rings(_residuals(*one), one[1].K) for one in ((other, than), (task, found)))
    return _rings_longer(now, before, task.speed, LEAST)


def later(now, before):
    """Whether, under its torque limits, an arm settles later with the new gains (`now`) than with the old (`before`).

    J does not include the limits, so J may be smaller and this time longer. In that case the new gains are not taken.
    They are not taken either if the arm came back from its limits before and does not now.
    """
    if now is None or before is None:
        return False
    return now.limited > before.limited or (before.comes_back and not now.comes_back)


def _kept(reached):
    """The least decay that the search may leave, from the least one that was `reached` [-]."""
    return max(KEEP * reached, min(reached, LEAST))


def _rings_longer(now, before, speed, least=RINGS):
    """Whether gains are refused for ringing; `now` and `before` are decays of `AfterMotion.ringing` [-].

    At a speed of 1, gains with which `now` is at least `least` are not refused.
    """
    if np.isinf(before):  # no mode rang
        return now < least * speed
    return now < min(before - SHORTER * abs(before), least * speed)


def _parts(loops, decays, eased):
    """Factors of the decay that is asked of each loop in the search.

    The factor is `eased` for loops for a margin. A loop of kind `ARM` keeps `LEAST`, or its own decay if that is less,
    even if the slowest of all loops is slower.
    """
    keep = _kept(min(decays))
    for loop, own in zip(loops, decays, strict=True):
        least = max(min(own, LEAST) / keep, 1.0) if loop.kind == ARM else 1.0
        yield eased if loop.kind == MARGIN else least
