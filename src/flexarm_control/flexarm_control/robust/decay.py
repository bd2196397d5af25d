# SPDX-License-Identifier: Apache-2.0
r"""The slowest decay of a set of loops, and its gradient with respect to the gains.

Each pole :math:`s = \ln(z)/h` of each loop has the value

.. math:: v = \Re s / d(|s|), \qquad d = \begin{cases}
    \omega_1\min\bigl(1, \sqrt{4\omega_1/|s|}\bigr) & |s| \le \omega_c \\
    \min(\omega_1, \zeta|s|) & \text{beyond,}\end{cases}

where d is the decay that is asked of the pole. Up to omega_c, where torque reaches, v is minus the decay over the
lowest bending frequency omega_1 with the joints locked. Beyond :math:`4\omega_1` less decay is asked, since a motion
hardly excites modes that stiff. Modes beyond omega_c are only asked to keep a fraction of their own damping, zeta. Of
loops that are less likely, a fraction of all this is asked. For a pole that grows, d is omega_1 at any frequency. A
design makes the largest v of all poles small. With the right and left eigenvectors x, y of F - G K N,

.. math:: \frac{\partial s}{\partial K_{ab}} = -\frac{(y^HG)_a\,(Nx)_b}{h\,z\,y^Hx} .

A pole that hardly moves with any gain does not count: torque does not reach its mode, or the gauges do not see it.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import matrix_balance

from ..kernels import compiled
from ..kernels.poles import DEAD_BEAT
from .threads import in_parts

#: Gains do not move a pole if the gradient of v by the scaled gains is no longer than this [-].
UNMOVED = 0.01
#: A pole with a larger v than this always counts, whether or not gains move it [-].
GROWS = 1e-9
#: The number of poles of a loop among which one that gains move is searched for.
MOST = 12
#: Poles count in the smooth maximum if v is at most this many widths below the largest one.
BELOW = 6.0


@dataclass(frozen=True)
class Wanted:
    """What is asked of poles; see the module."""

    omega_1: float  # [rad/s]
    omega_c: float  # [rad/s]
    zeta: float  # [-]

    def decay(self, s, fraction=1.0):
        """d of each pole s [1/s], in a loop of which this fraction of the decay is asked."""
        return np.vectorize(compiled().asked, otypes=[float])(s, fraction, *self.values)

    @property
    def values(self):
        """omega_1, omega_c and zeta, (3,)."""
        return np.array([self.omega_1, self.omega_c, self.zeta], float)


def eigenvalues(loop, K):
    """The closed loop's matrix, and its eigenvalues in the upper half plane except those of delays."""
    closed = loop.F - loop.G @ (K @ loop.N)
    z = np.linalg.eigvals(closed)
    return closed, z[(np.abs(z) > DEAD_BEAT) & (z.imag >= 0.0)]


class Stack:
    """Loops with equally many states, as arrays whose first index is the loop.

    The states are scaled so that rows and columns of the closed loop's matrix are about equally large: eigenvalues are
    accurate only then. The scaling is made for K = `scale`; other gains are assumed to be about as large.

    Parameters
    ----------
    loops : sequence of Loop
    scale : ndarray, shape (n, 3n + 2m)
    """

    def __init__(self, loops, scale):
        self.loops = tuple(loops)
        F, G, N = (np.array([getattr(loop, name) for loop in loops]) for name in "FGN")
        size = np.array([_sizes(one - g @ scale @ m) for one, g, m in zip(F, G, N, strict=True)])
        self.F = F * size[:, None, :] / size[:, :, None]
        self.G, self.N = G / size[:, :, None], N * size[:, None, :]
        self.period = np.array([loop.period for loop in loops])
        self.fraction = np.array([loop.fraction for loop in loops])


def _sizes(matrix):
    """Scales of the states, powers of two, that make rows and columns of a matrix about equally large."""
    return matrix_balance(matrix, permute=False, separate=True)[1][0]


class Poles:
    """Poles of a stack of loops under gains, those of each loop with the largest v first; see `poles_of`.

    Parameters
    ----------
    stack : Stack
    K : ndarray, shape (L, n, 3n + 2m)

    Attributes
    ----------
    s, asked, v : ndarray, shape (L, N)
        [1/s], d [1/s] and v [-]; v is -inf after the last one.
    slopes : ndarray, shape (L, p, n, 3n + 2m)
        Derivatives of the real part of the first p poles s by the gains of their loop; 0 where not known.
    """

    def __init__(self, stack, K):
        self.stack, shape = stack, stack.F.shape[:2]
        self._K = np.ascontiguousarray(K)
        self._H, self._tau = np.empty(stack.F.shape), np.empty(shape)
        self._z, self.s = np.empty(shape, complex), np.empty(shape, complex)
        self.asked, self.v, self._count = np.empty(shape), np.empty(shape), np.empty(len(K), int)
        self._known = np.zeros(len(K), int)  # of how many first poles the gradients are known
        self.slopes = np.zeros((len(K), 0, *K.shape[1:]))

    def ranking(self, wanted):
        """The call for `in_parts` that finds the poles."""
        stack, values = self.stack, wanted.values
        arrays = (
            stack.F, stack.G, stack.N, self._K, stack.period, stack.fraction,
            self._H, self._tau, self._z, self.s, self.asked, self.v, self._count,
        )  # fmt: skip
        return partial(compiled().ranked_poles, values), arrays, stack.F.shape[1]

    @property
    def found(self):
        """Whether the eigenvalues of all loops were found."""
        return (self._count >= 0).all()

    def missing(self, count):
        """Calls for `in_parts` that find missing gradients, those of the first `count` (L,) poles of each loop."""
        if (count <= self._known).all():
            return
        stack, before, known = self.stack, self.slopes, self._known
        self._known = count = np.maximum(count, known)
        self.slopes = np.zeros((len(before), count.max(), *before.shape[2:]))
        self.slopes[:, : before.shape[1]] = before
        arrays = (
            self._H, self._tau, stack.G, stack.N, self._z, known, count, stack.period, self.slopes,
        )  # fmt: skip
        yield compiled().pole_gradients, arrays, stack.F.shape[1]


def poles_of(stacks, gains, wanted):
    """`Poles` of the loops of some stacks.

    Parameters
    ----------
    stacks : sequence of Stack
    gains : sequence of ndarray, shape (L, n, 3n + 2m)
        Gains of each loop, one array for each stack.
    wanted : Wanted

    Raises
    ------
    numpy.linalg.LinAlgError
        If the eigenvalues of a loop are not found.
    """
    all_ = [Poles(stack, K) for stack, K in zip(stacks, gains, strict=True)]
    in_parts([one.ranking(wanted) for one in all_])
    if not all(one.found for one in all_):
        raise np.linalg.LinAlgError("eigenvalues that are not found")
    return all_


def find_gradients(all_, counts):
    """Find the gradients of the first poles of each loop; `counts` has their numbers, one array (L,) per stack."""
    in_parts([call for one, count in zip(all_, counts, strict=True) for call in one.missing(count)])


class Moved(NamedTuple):
    """Of the poles of a loop that gains move, the one with the largest v."""

    v: float  # [-]; -inf: gains move none
    s: complex  # [1/s]
    slope: float  # length of the gradient of v by the scaled gains [-]
    passed: tuple  # poles with larger v that gains do not move [1/s]


class Slowest:
    """The largest v of a set of loops as a function of scaled gains.

    Parameters
    ----------
    loops : sequence of Loop
    wanted : Wanted
    scale : ndarray, shape (n, 3n + 2m)
        Unit of each gain; 0: there is no such gain.
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

    def of_loops(self, loops, x):
        """K of each of the `loops` under scaled gains x, (L, n, 3n + 2m)."""
        return np.repeat(self.gains(x)[None], len(loops), axis=0)

    def _of_all(self, loops, slopes):
        """Gradient by x from those by the scaled gains of each loop, (L, gains)."""
        return slopes.sum(axis=0)

    def _lengths(self, loops, slopes):
        """Lengths of the gradients by x from those by the scaled gains of each loop, (L, p, gains)."""
        return np.sqrt((slopes**2).sum(axis=-1))

    def each(self, x):
        """The `Moved` of each loop under scaled gains x, a list in the order of the loops.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the eigenvalues of a loop are not found.
        """
        found = [None] * len(self.loops)
        for (at, _), poles in zip(
            self._all, self._poles([s for _, s in self._all], x), strict=True
        ):
            for number, moved in zip(at, self._moved(poles), strict=True):
                found[number] = moved
        return found

    def _moved(self, poles):
        """The `Moved` of each loop of a stack."""
        found, passed = [None] * len(poles.v), [()] * len(poles.v)
        for at in range(min(MOST, poles.v.shape[1])):
            left = [k for k, v in enumerate(poles.v[:, at]) if found[k] is None and v > -np.inf]
            if not left:
                break
            count = np.zeros(len(found), int)
            count[left] = at + 1
            find_gradients([poles], [count])
            lengths = self._near(poles, at + 1)[1]
            for k in left:
                v, s, slope = float(poles.v[k, at]), complex(poles.s[k, at]), float(lengths[k, at])
                if v > GROWS or slope > UNMOVED:
                    found[k] = Moved(v, s, slope, passed[k])
                else:
                    passed[k] += (s,)
        none = (Moved(-np.inf, 0j, 0.0, rest) for rest in passed)
        return [one or other for one, other in zip(found, none, strict=True)]

    def _near(self, poles, count):
        """Gradients of v of the first `count` poles of each loop by its own scaled gains, and lengths of those by x.

        The shapes are (L, count, gains) and (L, count). `find_gradients` must have been called before.
        """
        slopes = poles.slopes[:, :count, self.free]
        slopes = slopes * (self._unit / poles.asked[:, :count, None])
        return slopes, self._lengths(poles.stack.loops, slopes)

    def smooth(self, loops, width):
        r"""A smooth function of x above the largest v of some loops, and its gradient.

        .. math:: w\ln\sum_i e^{v_i/w}

        The sum is over all poles that gains move and whose v is near the largest. The `width` w is relative to the
        largest v if that is above 1. The function is infinite where eigenvalues are not found.
        """
        stacks = [stack for _, stack in self._stacks(loops)]

        def function(x):
            try:
                found = self._poles(stacks, x)
            except np.linalg.LinAlgError:
                return np.inf, np.zeros(x.size)
            worst = max(poles.v.max() for poles in found)
            while np.isfinite(worst):
                w = width * max(1.0, abs(worst))
                least = worst - BELOW * w
                near = self._moving(found, least)
                most = max(v.max(initial=-np.inf) for v, _ in near)
                if most == worst:
                    return self._sum(found, near, worst, w)
                if most == -np.inf:  # gains move none of them
                    most = max(poles.v[poles.v < least].max(initial=-np.inf) for poles in found)
                worst = most
            return np.inf, np.zeros(x.size)

        return function

    def _moving(self, found, least):
        """For each stack the v of poles from `least` on, and their gradients; v is -inf for poles that do not count."""
        counts = [(poles.v >= least).sum(axis=1) for poles in found]
        find_gradients(found, counts)
        near = []
        for poles, count in zip(found, counts, strict=True):
            most = count.max()
            slopes, lengths = self._near(poles, most)
            v = poles.v[:, :most].copy()
            v[(v < least) | ((v <= GROWS) & (lengths <= UNMOVED))] = -np.inf
            near.append((v, slopes))
        return near

    def _sum(self, found, near, worst, w):
        """The value of `smooth`, and its gradient."""
        total, slope = 0.0, 0.0
        for poles, (v, slopes) in zip(found, near, strict=True):
            weight = np.exp((v - worst) / w)
            total += weight.sum()
            of_loops = (weight[:, None, :] @ slopes)[:, 0, :]
            slope = slope + self._of_all(poles.stack.loops, of_loops)
        return worst + w * np.log(total), slope / total

    def _poles(self, stacks, x):
        return poles_of(stacks, [self.of_loops(stack.loops, x) for stack in stacks], self.wanted)

    @cached_property
    def _all(self):
        return self._stacks(self.loops)

    def _stacks(self, loops):
        """Groups of loops with equally many states: the numbers of the loops, and their `Stack`."""
        sizes = [len(loop.F) for loop in loops]
        same = [[k for k, size in enumerate(sizes) if size == one] for one in sorted(set(sizes))]
        return [(at, Stack([loops[k] for k in at], self.scale)) for at in same]


class SlowestScheduled(Slowest):
    """As `Slowest`, for several sets of gains at once: each loop has their mean, weighted with its own `weights`.

    Parameters
    ----------
    loops, wanted, scale
        As of `Slowest`.
    weights : sequence of ndarray, shape (k,)
        Weights of the sets in each loop.
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

    def of_loops(self, loops, x):
        return np.tensordot(self._of(loops), self.gains(x), 1)

    def _of(self, loops):
        """Weights of all sets in each of the `loops`, (L, k)."""
        return np.array([self._weights[id(loop)] for loop in loops])

    def _split(self, x):
        return x.reshape(-1, self._unit.size)

    def _of_all(self, loops, slopes):
        return (self._of(loops).T @ slopes).ravel()

    def _lengths(self, loops, slopes):
        return np.linalg.norm(self._of(loops), axis=1)[:, None] * super()._lengths(loops, slopes)
