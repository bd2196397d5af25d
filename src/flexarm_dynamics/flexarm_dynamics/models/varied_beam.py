# SPDX-License-Identifier: Apache-2.0
r"""Computes mode shapes of a beam that is clamped at its base, has a varying section and carries rigid bodies.

The Rayleigh-Ritz method solves the beam problem of :math:`EI(\xi)`, :math:`m(\xi)`. Between two places where the
section jumps or a body sits, a shape is a polynomial. Value and slope are continuous where two polynomials meet. So the
curvature may jump where EI does, and the shear force at a body. In bending the trial functions of one span are

.. math:: H_1 \ldots H_4, \qquad B_k(s) = \int\!\!\int P_k, \quad k = 2, 3, \ldots

the Hermite cubics and the twice integrated Legendre polynomials (value and slope zero at both ends, curvatures
orthogonal). In torsion they are the two linear functions and :math:`\int P_k`, k = 1, 2 ... They converge
exponentially; the degree is chosen for about twelve digits of the highest mode. Shapes are scaled to
:math:`\int_0^1\phi^2d\xi = 1` and signed as those of `beam`.

Babuska, Szabo & Katz (1981), SIAM J. Numer. Anal. 18(3) (the p-version of the finite element method).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh

from .beam import ModeShapes, _gauss_legendre

#: Degree of the polynomials: the minimum, the increase per radian of the highest mode's wave, and the maximum.
MIN_DEGREE, DEGREE_PER_WAVE, MAX_DEGREE = 14, 1.4, 80


@dataclass(frozen=True)
class VariedShapes:
    r"""Shapes :math:`\phi_i`, i = 1..m, polynomials between breaks.

    Attributes
    ----------
    breaks : ndarray, shape (s + 1,)
        Where one polynomial ends and the next begins, from 0 to 1 [-].
    coefficients : ndarray, shape (s, p + 1, m)
        Of the Legendre polynomials in each span, whose ends are -1 and 1.
    """

    breaks: np.ndarray
    coefficients: np.ndarray

    def __post_init__(self):
        for name in ("breaks", "coefficients"):
            getattr(self, name).setflags(write=False)

    @property
    def count(self):
        """Number of modes."""
        return self.coefficients.shape[2]

    def __call__(self, xi, derivative=0):
        r"""Values of :math:`d^k\phi_i/d\xi^k`, as `beam.ModeShapes` gives them; at a break, those of the span before.

        Parameters
        ----------
        xi : float or ndarray, shape (p,)
            Positions along the beam, 0 at the clamp, 1 at the tip [-].
        derivative : int
            k = 0, 1, 2, 3.

        Returns
        -------
        ndarray, shape (m,) or (p, m)
        """
        x = np.asarray(xi, dtype=float)
        flat = np.atleast_1d(x).ravel()
        last = len(self.coefficients) - 1
        span = np.clip(np.searchsorted(self.breaks, flat) - 1, 0, last)
        out = np.empty((flat.size, self.count))
        for k in np.unique(span):
            low, high = self.breaks[k : k + 2]
            here = span == k
            local = (2.0 * flat[here] - low - high) / (high - low)
            c = self.coefficients[k]
            c = legendre.legder(c, derivative, scl=2.0 / (high - low)) if derivative else c
            out[here] = legendre.legval(local, c).T
        return out.reshape(*x.shape, self.count)

    integral = ModeShapes.integral
    gram = ModeShapes.gram

    def _quadrature(self):
        # Enough points for products of two shapes and a section's stiffness.
        return spans(self.breaks, self.coefficients.shape[1] + 8)


def spans(breaks, count):
    """Gauss points and weights of `count` points in each span of [0, 1] between `breaks`, joined."""
    points, weights = _gauss_legendre(count)
    breaks = np.asarray(breaks, float)
    length = np.diff(breaks)
    return (
        (breaks[:-1, None] + length[:, None] * points).ravel(),
        (length[:, None] * weights).ravel(),
    )


@lru_cache(maxsize=64)
def _trial(degree, twist):
    """Trial functions of one span as Legendre coefficients, (p + 1, p + 1), one column each; the inner ones last.

    Bending: value and slope (by the local coordinate) at the left end, the same at the right; twist: values.
    """
    out = np.zeros((degree + 1, degree + 1))
    if twist:
        out[:2, 0], out[:2, 1] = (0.5, -0.5), (0.5, 0.5)
        first, times = 2, 1
    else:
        # Hermite's cubics on [-1, 1].
        out[:4, 0] = (0.5, -0.6, 0.0, 0.1)
        out[:4, 1] = (1 / 6, -0.1, -1 / 6, 0.1)
        out[:4, 2] = (0.5, 0.6, 0.0, -0.1)
        out[:4, 3] = (-1 / 6, -0.1, 1 / 6, 0.1)
        first, times = 4, 2
    for column in range(first, degree + 1):
        k = column - first + times
        unit = np.zeros(k + 1)
        unit[k] = np.sqrt(2.0 * k + 1.0)
        bubble = legendre.legint(unit, times, lbnd=-1.0)
        out[: bubble.size, column] = bubble
    return out


@dataclass(frozen=True)
class Body:
    """A rigid body on a beam, with its properties for bending in one direction, or for twist.

    Attributes
    ----------
    place : float
        Of the section that carries it [-].
    mass, moment, inertia : float
        In units of the beam's m, m L, m L^2: its mass, mass times the distance of its centre of mass beyond the section
        along the beam, and inertia about the section; in torsion only the inertia, in units of the beam's polar one.
    """

    place: float
    mass: float
    moment: float
    inertia: float


class BeamProblem:
    """The beam problem of one direction.

    Parameters
    ----------
    breaks : sequence of float
        From 0 to 1: where the section jumps, and where bodies sit.
    stiffness, mass : callable
        EI (or GJ) and mass per length (polar inertia per length) at an array of places, in units of any reference.
    bodies : sequence of Body
    twist : bool
    """

    def __init__(self, breaks, stiffness, mass, bodies=(), twist=False):
        self.breaks = np.asarray(breaks, float)
        self.stiffness, self.mass, self.bodies, self.twist = stiffness, mass, bodies, twist

    def shapes(self, modes):
        """The lowest `modes` as `VariedShapes`."""
        degrees = self._degrees(modes)
        degree = max(degrees)
        K, M, rows = self._matrices(degrees)
        # The lowest modes have the largest mu of M v = mu K v, so they are accurate to all digits.
        _, vectors = eigh(M, K, subset_by_index=(len(M) - modes, len(M) - 1))
        vectors = vectors[:, ::-1]
        coefficients = np.zeros((len(degrees), degree + 1, modes))
        for k, (p, row) in enumerate(zip(degrees, rows, strict=True)):
            local = np.where((row >= 0)[:, None], vectors[row], 0.0)
            coefficients[k, : p + 1] = self._scaled_trial(k, p) @ local
        return _normalised(self.breaks, coefficients, 1 if self.twist else 2)

    def _degrees(self, modes):
        """Degree in each span, higher where waves are shorter."""
        xi, w = spans(self.breaks, 16)
        slowness = (self.mass(xi) / self.stiffness(xi)) ** (0.5 if self.twist else 0.25)
        waves = (w * slowness).reshape(-1, 16).sum(axis=1) / (w @ slowness)
        wanted = MIN_DEGREE + DEGREE_PER_WAVE * np.pi * (modes + 1) * waves
        return [min(MAX_DEGREE, int(np.ceil(p))) for p in wanted]

    def _scaled_trial(self, span, degree):
        """Trial functions of a span, whose slopes at its ends are derivatives by xi."""
        trial = _trial(degree, self.twist)
        if self.twist:
            return trial
        trial = trial.copy()
        trial[:, [1, 3]] *= 0.5 * (self.breaks[span + 1] - self.breaks[span])
        return trial

    def _matrices(self, degrees):
        """Stiffness and mass matrix, and for each span the rows of its trial functions (-1: clamped)."""
        ends = 1 if self.twist else 2
        shared = ends * (len(self.breaks) - 1)
        size = shared + sum(p + 1 - 2 * ends for p in degrees)
        K, M, rows, inner = np.zeros((size, size)), np.zeros((size, size)), [], shared
        for k, p in enumerate(degrees):
            low, high = self.breaks[k : k + 2]
            points, weights = _gauss_legendre(p + 8)
            xi = low + (high - low) * points
            weights = (high - low) * weights
            trial = self._scaled_trial(k, p)
            value = legendre.legval(2.0 * points - 1.0, trial).T
            bend = legendre.legder(trial, ends, scl=2.0 / (high - low))
            bend = legendre.legval(2.0 * points - 1.0, bend).T
            own = np.arange(inner, inner + p + 1 - 2 * ends)
            inner += own.size
            row = np.concatenate([np.arange(ends * (k - 1), ends * (k + 1)), own])
            if k == 0:
                row[:ends] = -1
            rows.append(row)
            free = row >= 0
            at = np.ix_(row[free], row[free])
            K[at] += (bend.T @ ((weights * self.stiffness(xi))[:, None] * bend))[free][:, free]
            M[at] += (value.T @ ((weights * self.mass(xi))[:, None] * value))[free][:, free]
        for body in self.bodies:
            self._load(M, body)
        return K, M, rows

    def _load(self, M, body):
        """Add a body to the mass matrix."""
        node = int(np.argmin(np.abs(self.breaks - body.place)))
        if node == 0:
            return
        if self.twist:
            M[node - 1, node - 1] += body.inertia
            return
        at = slice(2 * (node - 1), 2 * node)
        M[at, at] += np.array([[body.mass, body.moment], [body.moment, body.inertia]])


def _normalised(breaks, coefficients, derivative):
    """Shapes of unit norm, bent towards the positive side at the clamp."""
    raw = VariedShapes(breaks.copy(), coefficients.copy())
    scale = np.where(raw(0.0, derivative) < 0.0, -1.0, 1.0) / np.sqrt(np.diag(raw.gram()))
    return VariedShapes(breaks.copy(), coefficients * scale)
