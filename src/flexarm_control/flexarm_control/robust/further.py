# SPDX-License-Identifier: Apache-2.0
"""The search that goes on from gains that hold, for gains with which motions leave less behind."""

from dataclasses import replace
from typing import NamedTuple

from .loop import ARM, MARGIN
from .settling import AfterMotion, residuals

#: The slowest pole of all loops keeps this part of the decay that was reached, and no less than the second number. If
#: it had less than that, it keeps all of it [-].
KEEP, LEAST = 0.8, 0.05
#: The search takes fewer evaluations for more configurations than these.
PLACES = 3
#: Its gains are not taken if, where joints rub, the slowest pole that rings loses more than this part of its decay, and
#: then has less than this times the speed (over omega_1). Such gains make J smaller, but simulated arms settle later.
SHORTER, RINGS = 0.1, 0.03


class Further(NamedTuple):
    """A search for gains that leave less, and when it is made."""

    much: float  # J of `settling.AfterMotion` above which it is made, if full speed was asked [-]
    enough: float  # J at which it ends, likewise [-]
    evaluations: int  # at most
    eased: float  # part of what was asked that loops are asked that are there for a margin [-]


#: The first one that applies. Where motions leave very much, margins are paid for it.
FURTHER = (Further(3.5, 2.1, 800, 0.5), Further(2.0, 0.9, 400, 1.0))


def leaving_less(task, found, progress, speed=None):
    """Gains near those that were found with which motions leave less behind, where these leave much.

    Parameters
    ----------
    task : design.Task
    found : design.Sets
        They hold.
    progress : callable
        Called with a fraction of the work, and the decay that was found.
    speed : float, optional
        That was asked, from which the task's may have been lowered; the task's if not given [-].

    Returns
    -------
    design.Sets or None
        None if nothing is searched, or nothing better found.
    """
    loops, weights = task.held(found.sampling, len(found.K))
    whole = task.search_of(loops, weights, found.sampling)
    left = [
        (min(k, len(found.K) - 1), one)
        for k, q in enumerate(task.at)
        for one in residuals(task.nominal, q, found.sampling, task.uncertainty)
    ]
    after, x = AfterMotion(whole.slowest, left), whole.slowest.scaled(found.K)
    decays = whole.decays(x)
    if not left or min(decays) <= 0.0:
        return None
    leaves, speed = after(x)[0], speed or task.speed
    chosen = next((one for one in FURTHER if leaves >= one.much / speed), None)
    if chosen is None:
        return None
    eased = [
        replace(one, fraction=part * one.fraction)
        for one, part in zip(loops, _parts(loops, decays, chosen.eased), strict=True)
    ]
    search = task.search_of(eased, weights, found.sampling)
    # A pole that hardly moves with the gains counts where less is asked of it.
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


def later(now, before):
    """Whether an arm settles later under its torque limits, by the `Recovery` with some gains and with those before.

    J is without limits. Where the two contradict each other, the gains are not taken; nor are they if the arm came back
    from its limits before and does not now.
    """
    if now is None or before is None:
        return False
    return now.limited > before.limited or (before.comes_back and not now.comes_back)


def _kept(reached):
    """The least decay that the search keeps, of the least that was `reached` [-]."""
    return max(KEEP * reached, min(reached, LEAST))


def _rings_longer(now, before, speed):
    """Whether the slowest decays that ring, where joints rub, are a reason not to take gains [-]."""
    return now < min(before - SHORTER * abs(before), RINGS * speed)


def _parts(loops, decays, eased):
    """Of the decay that each loop is asked, the part that is asked of it in the search.

    `eased` of loops that are there for a margin. A loop of the moving arm keeps `LEAST`, or what it has, also where the
    slowest of all loops is slower.
    """
    keep = _kept(min(decays))
    for loop, own in zip(loops, decays, strict=True):
        least = max(min(own, LEAST) / keep, 1.0) if loop.kind == ARM else 1.0
        yield eased if loop.kind == MARGIN else least
