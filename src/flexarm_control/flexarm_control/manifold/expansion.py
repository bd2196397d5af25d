# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the slow motion's deflections by central differences: what every manifold's orders are made of."""

import numpy as np
from scipy.linalg.lapack import dgetrf, dgetrs


def step(order):
    """Step of the central differences [s].

    For a motion of a second their error is at most 1e-6, and rounding is less. From order 3 on differences are taken of
    differences: a longer step then keeps rounding small.
    """
    return 1e-3 if order <= 2 else 4e-3


def reach(order):
    """Points of the stencil on either side that an order takes."""
    return (order + 1) // 2


class Point:
    """The modal rows of (2) at one point of the slow motion.

    Parameters
    ----------
    terms : Terms
        Without deflections.
    acceleration : ndarray, shape (n,)
        Of the joints [rad/s^2].

    Attributes
    ----------
    delta : ndarray, shape (m,)
        Deflection without the modes' own inertia and damping: order 0.
    """

    def __init__(self, terms, acceleration):
        n = terms.n
        self.terms, self.acceleration = terms, acceleration
        # LAPACK itself: what scipy.linalg checks around it costs ten times as much as a few modes do.
        self._factor = dgetrf(terms.K2)[:2] if terms.f2.size else None
        self.delta = -self._solve(terms.M[n:, :n] @ acceleration + terms.f2)

    def _solve(self, force):
        return force if self._factor is None else dgetrs(*self._factor, force)[0]

    def corrected(self, rate, second):
        """Deflection that also carries the modes' own inertia and damping, shape (m,)."""
        n = self.terms.n
        return self.delta - self._solve(self.terms.M[n:, n:] @ second + self.terms.C2 @ rate)

    def feedforward(self, delta, rate, second):
        """Joint torque of the bending beyond order 0, shape (n,) [N m]."""
        t, n = self.terms, self.terms.n
        return t.M[:n, n:] @ second + t.C1 @ rate + t.K1 @ (delta - self.delta)

    def torque(self, delta, rate, second):
        """Joint torque of the whole motion, shape (n,) [N m]: the joint rows of (2)."""
        t, n = self.terms, self.terms.n
        u = t.M[:n, :n] @ self.acceleration + t.M[:n, n:] @ second
        return u + t.f1 + t.C1 @ rate + t.K1 @ delta


def expand(points, order):
    """Deflection, rate and second derivative at the centre of a stencil.

    Parameters
    ----------
    points : dict
        `Point` by its place, from -reach to reach.
    order : int
        In mu.

    Returns
    -------
    delta, rate, second : ndarray, shape (m,)
    """
    level, h = {i: p.delta for i, p in points.items()}, step(order)
    rate, second = np.zeros_like(level[0]), np.zeros_like(level[0])
    for k in range(1, order + 1):
        if k % 2:  # the rates of the level before
            rate = (level[1] - level[-1]) / (2.0 * h)
            continue
        wide, higher = max(level), {}
        for i in range(1 - wide, wide):
            speed = (level[i + 1] - level[i - 1]) / (2.0 * h)
            bend = (level[i + 1] - 2.0 * level[i] + level[i - 1]) / h**2
            higher[i] = points[i].corrected(speed, bend)
            if i == 0:
                second = bend
        level = higher
    return level[0], rate, second
