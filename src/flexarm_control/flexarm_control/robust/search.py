# SPDX-License-Identifier: Apache-2.0
"""The search for the gains that make the slowest pole as fast as possible."""

from dataclasses import replace

import numpy as np
from scipy.linalg import eigh

from .nonsmooth import minimise

#: Starts: natural frequency of the joints over omega_1 and over the speed. From stiffer starts the search for a slow
#: design ends at once, with gains that ask for much torque.
STARTS = (0.5, 0.15)
#: Weight of the gains' size against the slowest pole.
SMALL_GAINS = 1e-6
#: Widths of the smooth maximum, one after the other.
WIDTHS = (0.3, 0.1, 0.03, 0.01)
#: Evaluations of one descent, before the loops are chosen again.
DESCENT = 60
#: Evaluations of all loops for each start, then for the best start of each search, then for the best of all.
FIRST, MIDDLE, LAST = 80, 120, 320
#: Evaluations for gains in and between several configurations together, in each round, and the number of rounds. After
#: a round, the loops whose decay is within the third number, a factor, of the least decay are relaxed: from then on the
#: fourth number, a fraction of the decay, is asked of them.
TOGETHER, ROUNDS, NEAR, RELAXED = 120, 3, 1.15, 0.4
#: Evaluations of all loops from each start near the best gains, and the standard deviation of these starts from the
#: best, relative to each gain [-].
AGAIN, APART = 240, 0.1
#: After this many such starts in a row that each improve the value by less than this fraction, there are no more.
PATIENCE, MORE = 3, 0.01
#: Loops with more states than this get fewer evaluations.
SIZE = 65
#: For the search that reduces what motions leave behind (`Search.sooner`): `NARROW` is the width of the smooth maximum
#: of the poles. `STEEP` is the weight of the penalty, the square of the shortfall of the decay over the least allowed
#: decay. `AIM` is the decay at which the search aims, over the least allowed one: with such a penalty the decay ends
#: slightly below the aim. (Where poles meet, their gradients have no bound. With a penalty proportional to the
#: shortfall, searches ended there.)
NARROW, STEEP, AIM = 0.003, 500.0, 1.02
#: New gains are taken only if they leave less than this fraction of what the old ones leave: linear loops do not
#: predict smaller differences. Progress is reported each time after this many evaluations.
TAKEN, REPORTED = 0.85, 20
#: The search goes on with a width as long as a descent improves the value by at least this fraction.
GAIN = 0.02


class Search:
    """Minimises the value of the slowest pole of a set of loops, with a penalty for noise.

    A descent considers only the few worst loops. Then the worst of the others are added, until none of them is worse.

    Parameters
    ----------
    slowest : Slowest
    noise : Noise
    enough : float
        Decay at which a search ends [-].
    handicap : float
        The decay is divided by this before it is compared with that of other searches [-].
    sampling : Sampling
        Of its loops.

    Attributes
    ----------
    evaluations : float
        Number of evaluations so far, in evaluations of all loops.
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
        """The value of the slowest pole of all loops, plus the penalties."""
        return self._with_penalty(self._each(x), x)

    def decays(self, x):
        """For each loop, the decay of the slowest pole that gains move, as a list; infinite if they move none [-]."""
        return [-value for value in self._each(x)]

    def relaxed(self, x, kept=(), least=0.0):
        """All loops, with less asked of those that limit the decay, and the numbers of the latter.

        A search improves only the slowest pole of all. If that is a mode that torque hardly moves or a joint that
        sticks, all others would stay as slow. None in place of the loops: there is nothing to relax.

        Parameters
        ----------
        x : ndarray
            Scaled gains that the search has reached.
        kept : collection of int
            Numbers of loops that were relaxed before.
        least : float
            Decay that the relaxed loops keep if the others get no faster than now. It has an effect only if it asks
            more of them than `RELAXED` [-].
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
        """Scaled gains near x with which motions leave less behind, and the decay of no loop is below `keep`.

        Parameters
        ----------
        x : ndarray
            Scaled gains with which all loops are stable.
        after : AfterMotion
        keep : float
            Least decay [-].
        budget : int
            At most about so many evaluations.
        enough : float
            Value of `after` at which the search ends.
        progress : callable, optional
            Called with the fraction of the work that is done.

        Returns
        -------
        ndarray
            x itself, if no gains are found that keep the decay and leave less than `TAKEN` times what x leaves.
        """
        slow, low, done = self._smooth(self.slowest.loops, NARROW), -AIM * keep, 0

        def function(x):
            nonlocal done
            done += 1
            if progress is not None and done % REPORTED == 0:
                progress(min(done / budget, 1.0))
            pole, by_pole = slow(x)  # penalties included
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
        """For each loop, the value v of the slowest pole that gains move."""
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
        """The function that a descent minimises, for some loops."""
        part = self.slowest.smooth(loops, width)

        def function(x):
            value, gradient = part(x)
            extra, slope = self._penalty(x)
            return value + extra, gradient + slope

        return function


def _worst(each, chosen):
    """Numbers of the worst loops, at most two, that are worse than all `chosen` ones; `each` has the loops' values."""
    most = max((each[k] for k in chosen), default=-np.inf)
    worse = [k for k, value in enumerate(each) if value > most and k not in chosen]
    return sorted(worse, key=lambda k: -each[k])[:2]


def race(searches, effort=1.0, progress=None):
    """The best of several searches, each with its starts.

    After a short run from each start, the best start of each search goes on, then the best of all. The short runs alone
    do not decide: at first, very small stable gains look better than firm ones that are not yet stable.

    Parameters
    ----------
    searches : sequence of (Search, sequence of ndarray)
        Each with the scaled gains to start from.
    effort : float
        Factor of the evaluations; 1.0 is the usual number.
    progress : callable, optional
        Called with the fraction of the work that is done and the decay that is reached.

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
    """Scaled gains of a search that makes a short run from each of the `starts`, and goes on from the best result."""
    found = [search.refined(x, effort * FIRST, WIDTHS[:2]) for x in starts]
    value, x = min(found, key=lambda one: one[0])
    return x if value < -search.enough else search.refined(x, effort * MIDDLE)[1]


def nearby(search, x, count, enough, seed=0, progress=None):
    """The best (value, scaled gains) of a search from x, then of `count` - 1 from random gains near the best so far.

    The slowest pole of many loops has kinks. A search may end in one, while gains a tenth away lead to much better
    results.

    Parameters
    ----------
    search : Search
    x : ndarray
    count : int
    enough : float
        No further search begins at this decay [-].
    seed : int
    progress : callable, optional
        Called with the fraction of the work that is done and the decay that is reached.
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
    r"""Start gains of the joints alone, with the natural frequency a omega_1 as far as the delay `late` [s] allows.

    At first a torque does not move the whole arm, but only the inertia 1 / H_ii that remains when the links bend, with

    .. math:: H_{ii} = \sum_{\omega_k\le\omega_c}\phi_{ik}^2

    over the modes :math:`\phi_k`, normalised to mass 1, that a low pass with the `corner` :math:`\omega_c` lets pass;
    without a low pass H is the inverse of the mass matrix. K_qd H_ii late is limited to a third.

    Parameters
    ----------
    model : ArmModel
    at : ndarray, shape (k, n)
        Configurations [rad].
    scale : ndarray, shape (n, 3n + 2m)
        Unit of each gain.
    a : float
        Natural frequency over omega_1 [-].
    late : float
        Delay of the torque [s].
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
    """Acceleration of each joint per its torque, by the modes up to a `corner` [rad/s] only, (n,) [1/(kg m^2)]."""
    n, terms = model.n_joints, model.terms(q, np.zeros(model.n_joints))
    stiffness = np.zeros_like(terms.M)
    stiffness[n:, n:] = terms.K2
    square, modes = eigh(stiffness, terms.M)
    return (modes[:n, square <= corner**2] ** 2).sum(axis=1)
