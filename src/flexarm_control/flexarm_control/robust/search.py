# SPDX-License-Identifier: Apache-2.0
"""The search for the gains whose slowest pole is the fastest."""

from dataclasses import replace

import numpy as np
from scipy.linalg import eigh

from .nonsmooth import minimise

#: Starts: natural frequency of the joints over omega_1, times the speed. From stiffer ones a search for a slow design
#: ends at once, with gains that ask for much torque.
STARTS = (0.5, 0.15)
#: Weight of the gains' size against the slowest pole.
SMALL_GAINS = 1e-6
#: Widths of the smooth maximum, one after the other.
WIDTHS = (0.3, 0.1, 0.03, 0.01)
#: Evaluations of one descent, until the loops are chosen anew.
DESCENT = 60
#: Evaluations of all loops for each start, then for the best start of each search, then for the best of all.
FIRST, MIDDLE, LAST = 80, 120, 320
#: The same for gains at and between several configurations together, in each of so many rounds: after each, loops whose
#: decay is within this factor of the least are asked this part from then on.
TOGETHER, ROUNDS, NEAR, RELAXED = 120, 3, 1.15, 0.4
#: Evaluations of all loops from each start nearby, and how far these are from the best, in parts of each gain [-].
AGAIN, APART = 240, 0.1
#: So many of them in a row may bring less than this fraction: then there are no more.
PATIENCE, MORE = 3, 0.01
#: Loops with more states get fewer evaluations.
SIZE = 65
#: What motions leave behind: width of the smooth maximum of the poles; weight of the square of what the decay is below
#: the least, over that; and by how much more than the least is aimed at, since such a penalty leaves a little less.
#: (Where poles meet, their slopes have no bound: a penalty in proportion ended searches.)
NARROW, STEEP, AIM = 0.003, 500.0, 1.02
#: Gains have to leave less than this part of what the others leave: linear loops predict it no better. Progress is
#: reported after so many evaluations.
TAKEN, REPORTED = 0.85, 20
#: A width goes on for as long as it gains this fraction.
GAIN = 0.02


class Search:
    """Minimises the slowest pole of a set of loops, its noise penalised.

    A descent is on the few loops that are the worst, to which the worst of the others are added until none is worse.

    Parameters
    ----------
    slowest : Slowest
    noise : Noise
    enough : float
        Decay at which a search ends [-].
    handicap : float
        Its decay counts as divided by this beside that of other searches [-].
    sampling : Sampling
        Of its loops.

    Attributes
    ----------
    evaluations : float
        So many times all loops were looked at.
    """

    def __init__(self, slowest, noise, enough, handicap=1.0, sampling=None):
        self.slowest, self.noise, self.enough = slowest, noise, enough
        self.handicap, self.sampling = handicap, sampling
        n = slowest.scale.shape[0]
        positive = np.zeros(slowest.scale.shape, bool)
        positive[:, :n] = positive[:, 2 * n : 3 * n] = True  # stiffness and integral
        free = positive[slowest.free]
        self._positive = np.tile(free, slowest.size // free.size)
        self.evaluations = 0.0

    def refined(self, x, budget, widths=WIDTHS):
        """(value, scaled gains) after a search from x with about `budget` evaluations of all loops."""
        budget = budget * min(1.0, (SIZE / self.slowest.loops[0].F.shape[0]) ** 2.2)
        loops, end = self.slowest.loops, self.evaluations + budget
        each = self._each(x)
        best, chosen, widths = (self._with_penalty(each, x), x), _worst(each, ()), list(widths)
        while widths and self.evaluations < end and best[0] > -self.enough:
            of = [loops[k] for k in chosen]
            x, _, used = minimise(
                self._smooth(of, widths[0]), x, DESCENT, lambda value: value < -self.enough
            )
            self.evaluations += used * len(of) / len(loops)
            each = self._each(x)
            last, found = best[0], self._with_penalty(each, x)
            best = min(best, (found, x), key=lambda f: f[0])
            worse = _worst(each, chosen)
            if worse:
                chosen += worse
            elif last - found < GAIN * abs(last):
                del widths[0]
                x = best[1]
        return best

    def value(self, x):
        """The slowest pole of all loops, with the penalties."""
        return self._with_penalty(self._each(x), x)

    def decays(self, x):
        """Decay of the slowest pole of each loop that gains move, a list; infinite where they move none [-]."""
        return [-value for value in self._each(x)]

    def relaxed(self, x, kept=(), least=0.0):
        """The loops, of which those that limit the others are asked less, and their numbers; without loops at an end.

        The slowest pole of all decides what a search looks for. Where a mode that torque hardly moves or a joint that
        sticks is the slowest, all others would be left as slow.

        Parameters
        ----------
        x : ndarray
            Scaled gains that the search has reached.
        kept : collection of int
            Numbers of loops that have been relaxed before.
        least : float
            Decay that they keep beside others that reach no more than now; where it is more than `RELAXED` [-].
        """
        each = self._each(x)
        worst = max(each)
        near = {k for k, v in enumerate(each) if v > NEAR * worst and k not in kept}
        if not -self.enough < worst < 0.0 or not near:
            return None, near
        others = -max((v for k, v in enumerate(each) if k not in near), default=-np.inf)
        part = max(RELAXED, min(least / others, 1.0)) if others > 0.0 else RELAXED
        return [
            replace(loop, fraction=part * loop.fraction) if k in near else loop
            for k, loop in enumerate(self.slowest.loops)
        ], near

    def sooner(self, x, after, keep, budget, enough, progress=None):
        """Scaled gains near x with which motions leave less, and no pole of any loop is slower than `keep`.

        Parameters
        ----------
        x : ndarray
            Scaled gains that hold.
        after : AfterMotion
        keep : float
            Least decay [-].
        budget : int
            At most about so many evaluations.
        enough : float
            Value of `after` at which the search ends.
        progress : callable, optional
            Called with a fraction of the work.

        Returns
        -------
        ndarray
            x itself, if none are found that keep the decay and leave less than `TAKEN` of what x leaves.
        """
        slow, low, done = self._smooth(self.slowest.loops, NARROW), -AIM * keep, 0

        def function(x):
            nonlocal done
            done += 1
            if progress is not None and done % REPORTED == 0:
                progress(min(done / budget, 1.0))
            pole, by_pole = slow(x)  # and the penalties
            value, slope = after(x) if np.isfinite(pole) else (np.inf, 0.0 * x)
            if not np.isfinite(value):
                return np.inf, np.zeros_like(x)
            if pole > low:
                over = (pole - low) / keep
                value, slope = value + STEEP * over**2, slope + 2.0 * STEEP * over / keep * by_pole
            return value, slope

        found, _, used = minimise(function, x, budget, lambda value: value < enough)
        self.evaluations += used
        less = after(found)[0] < TAKEN * after(x)[0]
        return found if less and self.value(found) < -0.99 * keep else x

    def _each(self, x):
        """The slowest pole of each loop that gains move, as a value."""
        self.evaluations += 1
        return [one.v for one in self.slowest.each(x)]

    def _with_penalty(self, each, x):
        return float(max(each) + self._penalty(x)[0])

    def _penalty(self, x):
        value, gradient = self.noise(x)
        below = np.where(self._positive, np.minimum(x, 0.0), 0.0)
        value += SMALL_GAINS * (x @ x) + 10.0 * below @ below
        return value, gradient + 2.0 * SMALL_GAINS * x + 20.0 * below

    def _smooth(self, loops, width):
        """What is minimised, of some loops."""
        part = self.slowest.smooth(loops, width)

        def function(x):
            value, gradient = part(x)
            extra, slope = self._penalty(x)
            return value + extra, gradient + slope

        return function


def _worst(each, chosen):
    """Numbers of the two worst loops of `each` value that are worse than all that are `chosen`."""
    most = max((each[k] for k in chosen), default=-np.inf)
    worse = [k for k, value in enumerate(each) if value > most and k not in chosen]
    return sorted(worse, key=lambda k: -each[k])[:2]


def race(searches, effort=1.0, progress=None):
    """The best of several searches, each with its starts.

    After a short run of each start the best one of each search goes on, then the best of all: stable gains that are
    hardly any look better at first than firm ones that are not stable yet.

    Parameters
    ----------
    searches : sequence of (Search, sequence of ndarray)
        Each with the scaled gains to start from.
    effort : float
        Of the search; 1.0 is the usual one.
    progress : callable, optional
        Called with a fraction of the work and the decay that is reached.

    Returns
    -------
    int, ndarray
        Number of the search, and its scaled gains.
    """
    entries = [(k, x) for k, (_, starts) in enumerate(searches) for x in starts]
    whole = FIRST * len(entries) + MIDDLE * len(searches) + LAST
    done, tried = 0, []

    def run(k, x, budget, widths):
        nonlocal done
        search = searches[k][0]
        found = search.refined(x, effort * budget, widths)
        value = found[0] / search.handicap if found[0] < 0.0 else found[0]
        tried.append((value, k, found[1]))
        tried.sort(key=lambda f: f[:2])
        done += budget
        if progress is not None:
            progress(done / whole, -tried[0][0])
        return tried[0][0] < -search.enough

    def best_of(k):
        return next(x for _, one, x in tried if one == k)

    if not any(run(k, x, FIRST, WIDTHS[:2]) for k, x in entries) and not any(
        run(k, best_of(k), MIDDLE, WIDTHS) for k in range(len(searches))
    ):
        run(*tried[0][1:], LAST, WIDTHS)
    if progress is not None and done < whole:
        progress(1.0, -tried[0][0])
    return tried[0][1:]


def follow(search, starts, effort=1.0):
    """Scaled gains of a search that goes on from the better one of its `starts`, after a short run of each."""
    found = [search.refined(x, effort * FIRST, WIDTHS[:2]) for x in starts]
    value, x = min(found, key=lambda one: one[0])
    return x if value < -search.enough else search.refined(x, effort * MIDDLE)[1]


def nearby(search, x, count, enough, seed=0, progress=None):
    """The best (value, scaled gains) of searches from x, then `count` - 1 times from random gains near the best so far.

    The slowest pole of many loops has kinks, in which a search ends far from what gains a tenth away lead to.

    Parameters
    ----------
    search : Search
    x : ndarray
    count : int
    enough : float
        Decay at which no further search begins [-].
    seed : int
    progress : callable, optional
        Called with a fraction of the work and the decay that is reached.
    """
    random, best, waited = np.random.default_rng(seed), (search.value(x), x), 0
    for k in range(count):
        if best[0] < -enough or waited == PATIENCE:
            break
        away = APART * random.standard_normal(x.size) if k else 0.0
        found = search.refined(best[1] * (1.0 + away), AGAIN)
        waited = 0 if not k or best[0] - found[0] > MORE * abs(best[0]) else waited + 1
        best = min(best, found, key=lambda one: one[0])
        if progress is not None:
            progress((k + 1) / count, -best[0])
    return best


def start(model, at, scale, a, late, corner=np.inf):
    r"""Gains of joints alone with a natural frequency of a omega_1, as far as a torque that is `late` [s] allows.

    What a torque moves at first is not the arm but the inertia that is left when the links bend, 1 / H_ii with

    .. math:: H_{ii} = \sum_{\omega_k\le\omega_c}\phi_{ik}^2

    over the modes :math:`\phi_k`, of mass 1, that a low pass of the `corner` lets pass; without one H is the inverse of
    the mass matrix. K_qd H_ii late is kept below a third.

    Parameters
    ----------
    model : ArmModel
    at : ndarray, shape (k, n)
        Configurations [rad].
    scale : ndarray, shape (n, 3n + 2m)
        Unit of each gain.
    a : float
        [-]
    late : float
        [s]
    corner : float
        Of the torque's low pass [rad/s]; infinite: none.

    Returns
    -------
    ndarray, shape (n, 3n + 2m)
    """
    K, n = np.zeros_like(scale), scale.shape[0]
    H = np.max([_mobility(model, q, corner) for q in at], axis=0)
    for i in range(n):
        damping = scale[i, n + i] * 2.0 * a
        fraction = min(1.0, 1.0 / (3.0 * H[i] * late) / damping)
        K[i, n + i] = fraction * damping
        K[i, i] = fraction * scale[i, i] * a**2 * 2.0
        K[i, 2 * n + i] = fraction * scale[i, 2 * n + i] * 0.3 * a**3
    return K


def _mobility(model, q, corner):
    """Joint acceleration per torque, as far as the modes up to a `corner` [rad/s] make it, (n,) [1/(kg m^2)]."""
    n, terms = model.n_joints, model.terms(q, np.zeros(model.n_joints))
    stiffness = np.zeros_like(terms.M)
    stiffness[n:, n:] = terms.K2
    square, modes = eigh(stiffness, terms.M)
    return (modes[:n, square <= corner**2] ** 2).sum(axis=1)
