# SPDX-License-Identifier: Apache-2.0
r"""The slowest decay of a set of loops, and its gradient by the gains.

Each pole :math:`s = \ln(z)/h` of each loop has the value

.. math:: v = \Re s / d(|s|), \qquad d = \begin{cases}
    \omega_1\min\bigl(1, \sqrt{4\omega_1/|s|}\bigr) & |s| \le \omega_c \\
    \min(\omega_1, \zeta|s|) & \text{beyond,}\end{cases}

so that up to omega_c, where torque reaches, v is minus the decay over the lowest bending frequency omega_1 with the
joints locked; of modes that are much stiffer less is asked, since a motion hardly excites them. Still stiffer modes are
only asked to keep a fraction of their own damping zeta, and of loops that are less likely a fraction of all this is
asked. A pole that grows counts by omega_1, whatever it is. The largest v of all poles is what a design makes small.
With the right and left eigenvectors x, y of F - G K N,

.. math:: \frac{\partial s}{\partial K_{ab}} = -\frac{(y^HG)_a\,(Nx)_b}{h\,z\,y^Hx} .

A pole that hardly moves with any gain is left to itself: its mode is one that torque does not reach or gauges do not
see.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigvals, hessenberg

from ..kernels import compiled

#: A pole counts as one that no gain moves below this change of v by one unit of all scaled gains.
UNMOVED = 0.01
#: So many poles of a loop are looked at for one that gains move.
MOST = 12
#: Beyond this many times omega_1 less decay is asked.
SOFT = 4.0
#: Poles nearer to the origin of the z plane are those of delays and filters.
DEAD_BEAT = 1e-6


@dataclass(frozen=True)
class Wanted:
    """What is asked of poles; see the module."""

    omega_1: float  # [rad/s]
    omega_c: float  # [rad/s]
    zeta: float  # [-]

    def decay(self, s, fraction=1.0):
        """d of each pole [1/s], of a loop of which this fraction is asked."""
        size = np.maximum(np.abs(s), 1e-12)
        soft = self.omega_1 * np.minimum(1.0, np.sqrt(SOFT * self.omega_1 / size))
        beyond = np.minimum(self.omega_1, self.zeta * size)
        asked = fraction * np.where(size <= self.omega_c, soft, beyond)
        return np.where(s.real < 0.0, asked, self.omega_1)


def eigenvalues(loop, K):
    """The closed loop's matrix, and its eigenvalues in the upper half plane but for those of delays."""
    closed = loop.F - loop.G @ (K @ loop.N)
    z = eigvals(closed, check_finite=False)
    return closed, z[(np.abs(z) > DEAD_BEAT) & (z.imag >= 0.0)]


class Gradients:
    """Derivatives of the real parts of a closed loop's poles by the gains.

    The eigenvectors are found by inverse iteration on the loop's Hessenberg form, made once for all of its poles.

    Parameters
    ----------
    loop : Loop
    closed : ndarray, shape (N, N)
        F - G K N.
    """

    def __init__(self, loop, closed):
        self._loop, self._closed = loop, closed

    @cached_property
    def _reduced(self):
        """The Hessenberg form, and G and N in its coordinates."""
        H, Q = hessenberg(self._closed, calc_q=True, check_finite=False)
        return np.ascontiguousarray(H), Q.T @ self._loop.G, self._loop.N @ Q

    def __call__(self, z):
        """That of a pole z, shape of K; not finite where the matrix is singular to the last bit."""
        H, G, N = self._reduced
        right, left = compiled().eigenvectors(H, complex(z))
        left = left.conj()
        across = self._loop.period * complex(z) * (left @ right)
        return np.outer(left @ G, (N @ right) * (-1.0 / across)).real


class Poles(NamedTuple):
    """Poles of one loop, the largest v first."""

    loop: object
    gradients: Gradients
    z: np.ndarray  # (k,)
    s: np.ndarray  # (k,) [1/s]
    asked: np.ndarray  # d, (k,) [1/s]
    v: np.ndarray  # (k,) [-]


class Slowest:
    """The largest v of a set of loops as a function of scaled gains.

    Parameters
    ----------
    loops : sequence of Loop
    wanted : Wanted
    scale : ndarray, shape (n, 3n + 2m)
        Unit of each gain; 0: the gain is none.
    """

    def __init__(self, loops, wanted, scale):
        self.loops, self.wanted, self.scale = loops, wanted, scale
        self.free = scale > 0.0
        self._unit = scale[self.free]
        self.size = self._unit.size  # of x

    def gains(self, x):
        """K of scaled gains x."""
        K = np.zeros_like(self.scale)
        K[self.free] = x * self._unit
        return K

    def scaled(self, K):
        """Scaled gains x of K."""
        return K[self.free] / self._unit

    def gains_of(self, loop, x):
        """K that a loop has under scaled gains x."""
        return self.gains(x)

    def values(self, x, loops=None):
        """The `Poles` of each loop, or of these loops, under scaled gains x."""
        found = []
        for loop in self.loops if loops is None else loops:
            closed, z = eigenvalues(loop, self.gains_of(loop, x))
            s = np.log(z) / loop.period
            asked = self.wanted.decay(s, loop.fraction)
            v = s.real / asked
            order = np.argsort(-v)
            gradients = Gradients(loop, closed)
            found.append(Poles(loop, gradients, z[order], s[order], asked[order], v[order]))
        return found

    def _slope(self, poles, i):
        """Gradient of the v of pole i by the scaled gains; zero where none is found."""
        with np.errstate(all="ignore"):
            slope = poles.gradients(poles.z[i])[self.free] * (self._unit / poles.asked[i])
        return slope if np.isfinite(slope).all() else np.zeros_like(slope)

    def worst(self, found):
        """The largest v of poles that gains move, with loop, s and the gradient by x; unmoved ones are passed over.

        `found` as `values` returns it. Returns v, gradient, loop, s, and the poles that were passed over.
        """
        candidates = [(v, k, i) for k, one in enumerate(found) for i, v in enumerate(one.v[:MOST])]
        candidates.sort(reverse=True)
        unmoved = []
        for v, k, i in candidates:
            loop, s, slope = found[k].loop, found[k].s[i], self._slope(found[k], i)
            if v > 1e-9 or np.linalg.norm(slope) > UNMOVED:
                return v, slope, loop, s, unmoved
            unmoved.append((loop, s))
        return -np.inf, np.zeros(self.size), None, 0.0, unmoved

    def smooth(self, loops, width):
        r"""A smooth function of x above the largest v of some loops, and its gradient.

        .. math:: w\ln\sum_i e^{v_i/w}

        over all poles that gains move, of a `width` w: all that are near the largest have a say.
        """

        def function(x):
            try:
                found = self.values(x, loops)
                worst, _, _, _, unmoved = self.worst(found)
                w = width * max(1.0, abs(worst))
                out = {(id(loop), s) for loop, s in unmoved}
                total, slope = 0.0, np.zeros(x.size)
                for poles in found:
                    for i, value in enumerate(poles.v):
                        if value < worst - 6.0 * w:
                            break
                        if (id(poles.loop), poles.s[i]) in out:
                            continue
                        g = self._slope(poles, i)
                        if value < 0.0 and np.linalg.norm(g) < UNMOVED:
                            continue
                        weight = np.exp((value - worst) / w)
                        total += weight
                        slope += weight * g
            except (np.linalg.LinAlgError, ValueError):
                return np.inf, np.zeros(x.size)
            return worst + w * np.log(total), slope / total

        return function


class SlowestScheduled(Slowest):
    """As `Slowest`, of several sets of gains at once: each loop has their mean with `weights` of its own.

    Parameters
    ----------
    loops, wanted, scale
        As of `Slowest`.
    weights : sequence of ndarray, shape (k,)
        Of each loop.
    """

    def __init__(self, loops, wanted, scale, weights):
        super().__init__(loops, wanted, scale)
        self._weights = {id(loop): np.array(w) for loop, w in zip(loops, weights, strict=True)}
        self.size *= len(weights[0])

    def gains(self, x):
        """All sets of scaled gains x, (k, n, 3n + 2m)."""
        return np.array([super(SlowestScheduled, self).gains(one) for one in self._split(x)])

    def scaled(self, K):
        return np.concatenate([super(SlowestScheduled, self).scaled(one) for one in K])

    def gains_of(self, loop, x):
        return super().gains(self._weights[id(loop)] @ self._split(x))

    def _split(self, x):
        return x.reshape(-1, self._unit.size)

    def _slope(self, poles, i):
        return np.outer(self._weights[id(poles.loop)], super()._slope(poles, i)).ravel()
