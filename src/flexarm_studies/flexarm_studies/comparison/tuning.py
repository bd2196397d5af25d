# SPDX-License-Identifier: Apache-2.0
"""Tunes by simulation, with the same search, metric and number of simulations for every controller.

A third of the budget goes to the first guess and a Latin hypercube. The rest goes to Nelder and Mead's simplex. It
starts from the best of these places; when it has converged, it starts again from the next best. The seed determines
everything.

A controller that can be judged without simulation, by the poles of a linear loop, is screened first: only the best
points of a large hypercube are simulated. Without this, most of a small budget would go to loops that can't be stable.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.stats import qmc

#: Fraction of the budget for exploration; edge of the first simplex and size at convergence, relative to the range [-].
EXPLORING, EDGE, CLOSE = 1.0 / 3.0, 0.15, 1e-3
#: Number of places that are screened without simulation.
SCREENED = 400


@dataclass(frozen=True)
class Free:
    """A number that may be tuned.

    Attributes
    ----------
    name : str
        With its unit.
    low, high, first : float
        Range, and the first guess.
    log : bool
        Whether its logarithm is searched.
    """

    name: str
    low: float
    high: float
    first: float
    log: bool = False

    def at(self, x):
        """Value at a place x of the range, 0 to 1."""
        x = min(max(float(x), 0.0), 1.0)
        if self.log:
            return float(self.low * (self.high / self.low) ** x)
        return self.low + x * (self.high - self.low)

    @property
    def place(self):
        """Place of the first guess, 0 to 1."""
        if self.log:
            return float(np.log(self.first / self.low) / np.log(self.high / self.low))
        return (self.first - self.low) / (self.high - self.low)


class _Spent(Exception):
    pass


def tune(cost, free, budget, seed=0, screen=None):
    """Best values of the free numbers.

    Parameters
    ----------
    cost : callable
        From a list of values: a number, smaller is better.
    free : sequence of Free
    budget : int
        Number of evaluations of `cost`.
    seed : int
    screen : callable, optional
        As `cost`, but without a simulation.

    Returns
    -------
    values : list of float
    cost : float
    history : list of float
        Cost of every evaluation in order.
    """
    tried = []

    def values_at(x):
        return [f.at(p) for f, p in zip(free, x, strict=True)]

    def at(x):
        if len(tried) >= budget:
            raise _Spent
        x = np.clip(x, 0.0, 1.0)
        value = float(cost(values_at(x)))
        tried.append((value, x))
        return value

    at(np.array([f.place for f in free]))
    explore = max(1, round(EXPLORING * budget)) - 1
    try:
        for x in _explored(free, explore, seed, screen):
            at(x)
        seeds = sorted(tried, key=lambda t: t[0])
        for _, x in seeds:
            options = {
                "initial_simplex": _simplex(x),
                "maxfev": budget,
                "xatol": CLOSE,
                "fatol": CLOSE,
            }
            minimize(at, x, method="Nelder-Mead", bounds=[(0.0, 1.0)] * len(free), options=options)
    except _Spent:
        pass
    best, x = min(tried, key=lambda t: t[0])
    return values_at(x), best, [value for value, _ in tried]


def _explored(free, count, seed, screen):
    """The first `count` places to try."""
    if not count:
        return ()
    places = qmc.LatinHypercube(len(free), seed=seed).random(SCREENED if screen else count)
    if screen is None:
        return places
    worth = [screen([f.at(p) for f, p in zip(free, x, strict=True)]) for x in places]
    return places[np.argsort(worth, kind="stable")[:count]]


def _simplex(x):
    """First simplex; its edges point into the range."""
    return np.vstack([x, x + np.diag(np.where(x < 0.5, EDGE, -EDGE))])
