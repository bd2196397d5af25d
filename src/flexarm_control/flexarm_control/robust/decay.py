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
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg.lapack import dgehrd, dgehrd_lwork, dorghr, dorghr_lwork

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
    z = np.linalg.eigvals(closed)
    return closed, z[_counted(z)]


def _counted(z):
    return (np.abs(z) > DEAD_BEAT) & (z.imag >= 0.0)


@lru_cache(maxsize=256)
def _work(size):
    """Sizes of LAPACK's work space for a matrix."""
    return [int(query(size, 0, size - 1)[0]) for query in (dgehrd_lwork, dorghr_lwork)]


def hessenberg(matrix):
    """H and Q of a square matrix Q H Q^T, without the checks of scipy.linalg's: these cost more than the work.

    What stands below H's first subdiagonal is not zero, and means nothing.
    """
    size = len(matrix)
    reduced, own = _work(size)
    H, tau, _ = dgehrd(matrix, 0, size - 1, lwork=reduced)
    Q, _ = dorghr(H, tau, 0, size - 1, lwork=own)
    return np.ascontiguousarray(H), Q


class Poles:
    """Poles of one closed loop, the largest v first.

    Parameters
    ----------
    loop : Loop
    closed : ndarray, shape (N, N)
        F - G K N.
    z, s, asked : ndarray, shape (k,)
        [-], [1/s], and d [1/s].
    v : list of float
        [-]
    """

    def __init__(self, loop, closed, z, s=None, asked=None, v=None):
        self.loop, self.z, self.s, self.asked, self.v = loop, z, s, asked, v
        self._closed, self._known = closed, ()

    @cached_property
    def _reduced(self):
        """The Hessenberg form, and G and N in its coordinates."""
        H, Q = hessenberg(self._closed)
        return H, Q.T @ self.loop.G, self.loop.N @ Q

    def gradients(self, count):
        """Derivatives of the real part of the first `count` poles s by the gains, (count, n, 3n + 2m).

        The eigenvectors are found by inverse iteration on the loop's Hessenberg form, made once for all of its poles.
        Zero where the matrix is singular to the last bit.
        """
        if len(self._known) < count:
            H, G, N = self._reduced
            found = np.empty((count, G.shape[1], N.shape[0]))
            compiled().pole_gradients(H, G, N, self.z[:count], self.loop.period, found)
            finite = np.isfinite(found).all(axis=(1, 2))
            self._known = found if finite.all() else np.where(finite[:, None, None], found, 0.0)
        return self._known[:count]


class _Batch:
    """Loops with equally many states, as stacks of matrices: one call finds the eigenvalues of all."""

    def __init__(self, loops, at):
        self.at = at  # their numbers
        self.loops = [loops[k] for k in at]
        self._F, self._G, self._N = (
            np.array([getattr(loop, name) for loop in self.loops]) for name in "FGN"
        )
        self._period = np.array([loop.period for loop in self.loops])
        self._fraction = np.array([loop.fraction for loop in self.loops])

    def poles(self, K, wanted):
        """`Poles` of each loop with its gains K (k, n, 3n + 2m)."""
        closed = self._F - self._G @ (K @ self._N)
        z = np.linalg.eigvals(closed)
        counted = _counted(z)
        row, z = np.nonzero(counted)[0], z[counted]
        s = np.log(z) / self._period[row]
        asked = wanted.decay(s, self._fraction[row])
        v = s.real / asked
        order = np.lexsort((-v, row))
        z, s, asked, v = z[order], s[order], asked[order], v[order].tolist()
        ends = np.cumsum(counted.sum(axis=1)).tolist()
        for loop, matrix, a, b in zip(self.loops, closed, [0, *ends], ends, strict=False):
            yield Poles(loop, matrix, z[a:b], s[a:b], asked[a:b], v[a:b])


def _batches(loops):
    """The `_Batch`es of some loops."""
    sizes = [len(loop.F) for loop in loops]
    return [
        _Batch(loops, [k for k, size in enumerate(sizes) if size == one])
        for one in sorted(set(sizes))
    ]


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

    @cached_property
    def _all(self):
        return _batches(self.loops)

    def values(self, x):
        """The `Poles` of each loop under scaled gains x."""
        return self._values(x, self._all, len(self.loops))

    def _values(self, x, batches, count):
        found = [None] * count
        for batch in batches:
            K = np.array([self.gains_of(loop, x) for loop in batch.loops])
            for k, poles in zip(batch.at, batch.poles(K, self.wanted), strict=True):
                found[k] = poles
        return found

    def _slopes(self, poles, count):
        """Gradients of the v of the first `count` poles by the scaled gains of the loop, (count, gains)."""
        found = poles.gradients(count)[:, self.free]
        return found * (self._unit / poles.asked[:count, None])

    def _of_all(self, loop, slope):
        """Gradient by x from that by a loop's own scaled gains."""
        return slope

    def _length(self, loop, slopes):
        """Lengths of the gradients by x from those by a loop's own scaled gains, (..., gains)."""
        return np.sqrt((slopes**2).sum(axis=-1))

    def worst(self, found):
        """The largest v of poles that gains move, with loop, s and the gradient by x; unmoved ones are passed over.

        `found` as `values` returns it. Returns v, gradient, loop, s, and the poles that were passed over.
        """
        k, i, slope, unmoved = self._first_moved(found)
        passed = [(found[k].loop, found[k].s[i]) for k, i in unmoved]
        if slope is None:
            return -np.inf, np.zeros(self.size), None, 0.0, passed
        poles = found[k]
        return poles.v[i], self._of_all(poles.loop, slope), poles.loop, poles.s[i], passed

    def _first_moved(self, found):
        """Numbers of loop and pole of the largest v that gains move, its gradient, and the numbers passed over."""
        unmoved, at = [], [0] * len(found)
        while True:
            left = [
                (poles.v[i], k)
                for k, (poles, i) in enumerate(zip(found, at, strict=True))
                if i < min(MOST, len(poles.v))
            ]
            if not left:
                return None, None, None, unmoved
            v, k = max(left)
            i, at[k] = at[k], at[k] + 1
            slope = self._slopes(found[k], i + 1)[i]
            if v > 1e-9 or self._length(found[k].loop, slope) > UNMOVED:
                return k, i, slope, unmoved
            unmoved.append((k, i))

    def smooth(self, loops, width):
        r"""A smooth function of x above the largest v of some loops, and its gradient.

        .. math:: w\ln\sum_i e^{v_i/w}

        over all poles that gains move, of a `width` w: all that are near the largest have a say.
        """
        batches = _batches(loops)

        def function(x):
            try:
                found = self._values(x, batches, len(loops))
                k, i, _, _ = self._first_moved(found)
                worst = -np.inf if k is None else found[k].v[i]
                w = width * max(1.0, abs(worst))
                total, slope = 0.0, np.zeros(x.size)
                for poles in found:
                    count = sum(value >= worst - 6.0 * w for value in poles.v)
                    if not count:
                        continue
                    v, slopes = np.array(poles.v[:count]), self._slopes(poles, count)
                    stays = (v < 0.0) & (self._length(poles.loop, slopes) < UNMOVED)
                    weight = np.where(stays, 0.0, np.exp((v - worst) / w))
                    total += weight.sum()
                    slope += self._of_all(poles.loop, weight @ slopes)
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

    def _of_all(self, loop, slope):
        return np.outer(self._weights[id(loop)], slope).ravel()

    def _length(self, loop, slopes):
        return np.linalg.norm(self._weights[id(loop)]) * super()._length(loop, slopes)
