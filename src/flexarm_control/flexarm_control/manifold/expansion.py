# SPDX-License-Identifier: Apache-2.0
"""Expansion of the slow motion's deflections in mu by central differences, which every manifold uses."""

from typing import NamedTuple

import numpy as np

from .. import kernels


def step(order):
    """Step of the central differences [s].

    For a motion of a second their error is at most 1e-6, and the rounding error is smaller. From order 3 on,
    differences of differences are taken; a longer step then keeps the rounding error small.
    """
    return 1e-3 if order <= 2 else 4e-3


def reach(order):
    """Number of stencil points on either side that an order needs."""
    return (order + 1) // 2


class Expansion(NamedTuple):
    """The manifold at one point of the slow motion.

    Attributes
    ----------
    delta, rate, second : ndarray, shape (m,)
        Deflection and its time derivatives.
    torque : ndarray, shape (n,)
        Torque of the whole motion, from the joint rows of (2) [N m].
    beyond : ndarray, shape (n,)
        Torque of the bending beyond order 0 [N m].
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
        Terms of (2) without deflections. The leading axis counts points of the slow motion, `step` apart, with `reach`
        of them on either side.
    accelerations : ndarray, shape (p, n)
        Accelerations of the joints [rad/s^2].
    order : int
        Order in mu.
    """
    t, centre = terms, len(terms.M) // 2
    out, torque = np.empty((3, t.f2.shape[1])), np.empty((2, t.f1.shape[1]))
    kernels.compiled().expanded(
        step(order), order, t.M, t.f2, t.C2, t.K2, accelerations, t.f1[centre], t.C1[centre], t.K1[centre], out, torque
    )  # fmt: skip
    return Expansion(*out, *torque)
