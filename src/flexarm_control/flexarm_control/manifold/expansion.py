# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the slow motion's deflections by central differences: what every manifold's orders are made of."""

from typing import NamedTuple

import numpy as np

from .. import kernels


def step(order):
    """Step of the central differences [s].

    For a motion of a second their error is at most 1e-6, and rounding is less. From order 3 on differences are taken of
    differences: a longer step then keeps rounding small.
    """
    return 1e-3 if order <= 2 else 4e-3


def reach(order):
    """Points of the stencil on either side that an order takes."""
    return (order + 1) // 2


class Expansion(NamedTuple):
    """The manifold at one point of the slow motion.

    Attributes
    ----------
    delta, rate, second : ndarray, shape (m,)
        Deflection, and its derivatives by time.
    torque : ndarray, shape (n,)
        Of the whole motion, from the joint rows of (2) [N m].
    beyond : ndarray, shape (n,)
        Of the bending beyond order 0 [N m].
    """

    delta: np.ndarray
    rate: np.ndarray
    second: np.ndarray
    torque: np.ndarray
    beyond: np.ndarray


def expand(terms, accelerations, order):
    """The `Expansion` at the centre of a stencil.

    Parameters
    ----------
    terms : Terms
        Of (2) without deflections, at the points of the slow motion, `step` apart, with a leading axis; `reach` on
        either side.
    accelerations : ndarray, shape (p, n)
        Of the joints [rad/s^2].
    order : int
        In mu.
    """
    t, centre = terms, len(terms.M) // 2
    out, torque = np.empty((3, t.f2.shape[1])), np.empty((2, t.f1.shape[1]))
    kernels.compiled().expanded(
        step(order), order, t.M, t.f2, t.C2, t.K2, accelerations, t.f1[centre], t.C1[centre], t.K1[centre], out, torque
    )  # fmt: skip
    return Expansion(*out, *torque)
