# SPDX-License-Identifier: Apache-2.0
r"""Finds poles of decaying sines in several channels by the matrix pencil, and those that are stable over the orders.

Column j of the Hankel matrix :math:`H_{(c,i),j} = y_c(i + j)` of samples of :math:`\sum_k r_{kc} z_k^t` is a sum of the
same n vectors for all i and c, so its right singular vectors :math:`V_n` fulfil

.. math:: V_n^{1:} = V_n^{:-1}\,\Phi, \qquad \mathrm{eig}(\Phi) = z_k = e^{p_k T}

(Hua & Sarkar 1990; the eigensystem realization algorithm of Juang & Pappa 1985 has the same poles). n is unknown. A
pole that is nearly the same for many orders n belongs to the signal; a pole that wanders belongs to the noise
(stabilisation).
"""

from itertools import pairwise

import numpy as np
from scipy.linalg import eigh

#: Max. number of columns of the Hankel matrix, and of samples that are used [-].
MAX_COLUMNS, MAX_SAMPLES = 350, 1500
#: Largest order; every second one is tried.
MAX_ORDER = 40
#: Two poles are the same if they differ by less than the sum of this fraction of their size [-] and this angle over the
#: duration [rad].
SAME, RESOLVED = 0.015, 0.4
#: Number of orders in which a pole must be the same.
STABLE = 2


def stable_poles(values, period, low, high, max_damping):
    r"""Poles that are stable over the orders.

    Parameters
    ----------
    values : ndarray, shape (s, c)
        Each channel minus its straight line, scaled to about 1.
    period : float
        [s]
    low, high : float
        Frequencies [Hz].
    max_damping : float
        Ratio [-].

    Returns
    -------
    list of complex
        :math:`-\sigma + j\omega` [1/s]; poles that occur in most orders come first.
    """
    near = RESOLVED / (period * min(len(values), MAX_SAMPLES))
    return _clusters(orders(values, period), near, low, high, max_damping)


def orders(values, period):
    """The poles [1/s] of each order, a list of arrays; `values` (s, c), one row per `period` [s]."""
    values = values[:MAX_SAMPLES]
    count = len(values)
    columns = min(count // 2, MAX_COLUMNS)
    rows = count - columns + 1
    gram = np.zeros((columns, columns))
    for channel in values.T:
        hankel = np.lib.stride_tricks.sliding_window_view(channel, columns)[:rows]
        gram += hankel.T @ hankel
    most = min(MAX_ORDER, columns // 2)
    V = eigh(gram, subset_by_index=(columns - most, columns - 1))[1][:, ::-1]
    found = []
    for order in range(2, most + 1, 2):
        moved = np.linalg.lstsq(V[:-1, :order], V[1:, :order], rcond=None)[0]
        z = np.linalg.eigvals(moved)
        found.append(np.log(z[(np.abs(z) > 1e-6) & (np.abs(z) < 1e6)]) / period)
    return found


def _clusters(of_orders, near, low, high, max_damping):
    """Poles that stay the same from one order to the next, grouped by frequency."""
    kept = [[p for p in poles if _rings(p, low, high, max_damping)] for poles in of_orders]
    stable = [
        p
        for before, now in pairwise(kept)
        for p in now
        if any(abs(p - q) < _tolerance(p, near) for q in before)
    ]
    clusters = []
    for pole in sorted(stable, key=lambda p: p.imag):
        if clusters and pole.imag - np.median(np.imag(clusters[-1])) < 2.0 * _tolerance(pole, near):
            clusters[-1].append(pole)
        else:
            clusters.append([pole])
    clusters = [c for c in clusters if len(c) >= STABLE]
    clusters.sort(key=len, reverse=True)
    return [complex(np.median(np.real(c)), np.median(np.imag(c))) for c in clusters]


def _rings(pole, low, high, max_damping):
    hertz = pole.imag / (2.0 * np.pi)
    return low <= hertz <= high and 0.0 < -pole.real < max_damping * abs(pole)


def _tolerance(pole, near):
    return SAME * abs(pole) + near
