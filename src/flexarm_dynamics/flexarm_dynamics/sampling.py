# SPDX-License-Identifier: Apache-2.0
r"""Samples one linear system exactly over periods that differ from sample to sample, without exponentials.

A loop that loses samples, or whose stamps jitter, needs a different period at every sample. With :math:`\Phi(h) =
e^{Ah}`, :math:`\Gamma(h) = \int_0^h e^{As}ds` and :math:`Q(h) = \int_0^h e^{As}Se^{A^Ts}ds`, steps add up,

.. math::
    \Phi(h_0 + e) = \Phi(e)\Phi(h_0), \quad \Gamma(h_0 + e) = \Gamma(h_0) + \Phi(h_0)\Gamma(e), \quad
    Q(h_0 + e) = \Phi(e)Q(h_0)\Phi(e)^T + Q(e),

so the step over a multiple :math:`h_0` of a short period g follows from the step over g by doubling, and is kept. The
steps over g and over the rest e < g are Taylor series whose coefficients do not depend on e:

.. math::
    \Phi(e) = \sum_k \frac{e^k}{k!}A^k, \quad \Gamma(e) = \sum_k \frac{e^{k+1}}{(k+1)!}A^k, \quad
    Q(e) = \sum_k \frac{e^{k+1}}{(k+1)!}L^kS, \quad L X = AX + XA^T.

With x = :math:`\|A\|g`, where the norm is taken after balancing, the remainder of the first series after K terms is
below :math:`x^K/K!\cdot e^x` in the balanced norm, and that of the others below :math:`(2x)^K/K!\cdot e^{2x}` of their
size. g is chosen so that x is below `REACH`, and K so that both remainders are below `ERROR`. The rest is not
negative, so covariances are only added, and nothing cancels.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import matrix_balance

from .linear import sampled, sampled_noise

#: Largest norm of A times the short period [-]; and the relative remainder of the series [-].
REACH, ERROR = 0.5, 1e-17
#: The short period is one of these [us]: common sampling periods are multiples of them.
PERIODS = (500, 250, 100, 50, 25, 10, 5, 2, 1)
#: Number of multiples of the short period whose steps are kept.
KEPT = 24


@dataclass(frozen=True)
class Step:
    """A linear system over one period; matrices of shape (N, N)."""

    length: float  # h [s]
    A: np.ndarray  # of the system
    Phi: np.ndarray  # transition, e^(Ah)
    Gamma: np.ndarray  # its integral
    Q: np.ndarray | None  # covariance that the noise adds


def discretise(A, length, density=None):
    """The `Step` over `length`, by the matrix exponential; `density` (N, N) of the noise on the state's rates."""
    Phi, Gamma = sampled(A, np.eye(len(A)), length)
    Q = None if density is None else sampled_noise(A, density, length)
    return Step(length, A, Phi, Gamma, Q)


class Sampling:
    """Steps of one linear system, cheap for any period.

    Parameters
    ----------
    A : ndarray, shape (N, N)
    density : ndarray, shape (N, N), optional
        Spectral density S of the noise on the state's rates.

    Attributes
    ----------
    grid : float
        The short period g [s].
    """

    def __init__(self, A, density=None):
        self._A, self._density, N = A, density, len(A)
        norm = np.linalg.norm(matrix_balance(A, permute=False)[0], 2)
        micros = next((p for p in PERIODS if 1e-6 * p * norm <= REACH), PERIODS[-1])
        self.grid, x = 1e-6 * micros, 1e-6 * micros * norm
        self._per_second = 1e6 / micros
        term, count = 1.0, 0
        while term * np.exp(2.0 * x) > ERROR:
            count += 1
            term *= 2.0 * x / count
        self._powers = np.arange(count + 2)
        self._terms = self._series(count + 1, N)
        self._kept = lru_cache(KEPT)(self._multiple)

    def _series(self, count, N):
        """Coefficients of e^k of Phi, Gamma and Q, flat: shape (count + 1, 2 N^2 or 3 N^2)."""
        A, S = self._A, self._density
        out = np.zeros((count + 1, 2 if S is None else 3, N, N))
        power, noise = np.eye(N), S
        for k in range(count):
            out[k, 0] = power
            out[k + 1, 1] = power / (k + 1)
            if S is not None:
                out[k + 1, 2] = noise = noise / (k + 1)
                noise = A @ noise
                noise = noise + noise.T
            power = A @ power / (k + 1)
        out[count, 0] = power
        return out.reshape(count + 1, -1)

    def _multiple(self, k):
        """The step over k short periods: the step over half of them twice, and one short step more if k is odd."""
        if k == 1:
            return self._short(self.grid)
        half = self._kept(k // 2)
        step = _after(half, half)
        step = _after(step, self._kept(1)) if k % 2 else step
        return replace(step, length=k * self.grid)

    def _short(self, rest):
        """The step over a `rest` that is no longer than the short period [s], by the series."""
        N, kinds = len(self._A), 2 if self._density is None else 3
        parts = (rest**self._powers @ self._terms).reshape(kinds, N, N)
        return Step(rest, self._A, parts[0], parts[1], None if kinds == 2 else parts[2])

    def step(self, length):
        """The `Step` over a `length` [s] that is not negative."""
        whole = int(length * self._per_second + 1e-6)
        rest = length - whole * self.grid
        first = self._kept(whole) if whole else None
        if first is not None and abs(rest) < 1e-12:
            return first
        then = self._short(max(rest, 0.0))
        return then if first is None else replace(_after(first, then), length=length)


def _after(first, then):
    """The `Step` of one system over the period of `first` and then over that of `then`."""
    Gamma = first.Gamma + first.Phi @ then.Gamma
    Q = first.Q
    if Q is not None:
        Q = then.Phi @ Q @ then.Phi.T + then.Q
        Q = 0.5 * (Q + Q.T)
    return Step(first.length + then.length, first.A, then.Phi @ first.Phi, Gamma, Q)
