# SPDX-License-Identifier: Apache-2.0
r"""Mode shapes of a uniform Euler-Bernoulli beam clamped at its base.

Every shape here has the form (Siciliano & Book 1986, (A1), rewritten to avoid cancellation)

.. math::
    \phi(\xi) = a\cos\beta\xi + b\sin\beta\xi + c\,e^{-\beta\xi} + d\,e^{-\beta(1-\xi)},
    \qquad a = -(c + d e^{-\beta}), \quad b = c - d e^{-\beta},

with :math:`\xi = \eta/L`; `a` and `b` follow from :math:`\phi(0) = \phi'(0) = 0`. The textbook's
:math:`\cosh - \sinh` loses all digits near :math:`\beta = 36`; here every term is at most of order one,
so the tenth mode is as accurate as the first. Shapes are scaled to :math:`\int_0^1 \phi^2 d\xi = 1` and signed so
that :math:`\phi''(0) > 0`: the tip of the first mode moves to the positive side.

Derivatives are with respect to :math:`\xi`; divide by `L` once for a slope, twice for a curvature.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq

from ..errors import ModelError

#: Error of the modal integrals, relative to the largest entry (Gauss-Legendre, tested).
INTEGRAL_TOLERANCE = 1e-12

#: Heaviest tip load for which the lowest wave number is accurate, in units of the beam's m and m L^2.
MAX_LOAD = 1e10


@lru_cache(maxsize=32)
def _gauss_legendre(n):
    """Nodes and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return 0.5 * (nodes + 1.0), 0.5 * weights


@dataclass(frozen=True)
class ModeShapes:
    r"""Shapes :math:`\phi_i`, i = 1..m, of one link in one direction.

    Attributes
    ----------
    beta : ndarray, shape (m,)
        Wave numbers :math:`\beta_i` [-].
    c, d : ndarray, shape (m,)
        Coefficients of the decaying and of the growing exponential, scaled [-].
    """

    beta: np.ndarray
    c: np.ndarray
    d: np.ndarray

    def __post_init__(self):
        for name in ("beta", "c", "d"):
            getattr(self, name).setflags(write=False)

    @property
    def count(self):
        """Number of modes."""
        return self.beta.size

    def __call__(self, xi, derivative=0):
        r"""Values of :math:`d^k\phi_i/d\xi^k`.

        Parameters
        ----------
        xi : float or ndarray, shape (p,)
            Positions along the beam, 0 at the clamp, 1 at the tip [-].
        derivative : int
            k = 0, 1, 2, 3.

        Returns
        -------
        ndarray, shape (m,) or (p, m)
            One column per mode.
        """
        x = np.asarray(xi, dtype=float)[..., None]
        beta, c, d = self.beta, self.c, self.d
        edge = np.exp(-beta)
        a, b = -(c + d * edge), c - d * edge
        cos, sin = np.cos(beta * x), np.sin(beta * x)
        # d/dxi turns (cos, sin) into beta * (-sin, cos); after four derivatives the functions repeat.
        wave = (a * cos + b * sin, -a * sin + b * cos, -a * cos - b * sin, a * sin - b * cos)[
            derivative % 4
        ]
        decay = (-1.0) ** derivative * c * np.exp(-beta * x)
        growth = d * np.exp(-beta * (1.0 - x))
        return beta**derivative * (wave + decay + growth)

    def integral(self, weight=lambda xi: np.ones_like(xi)):
        r""":math:`\int_0^1 w(\xi)\phi_i\,d\xi`, shape (m,), to `INTEGRAL_TOLERANCE`."""
        xi, w = self._quadrature()
        return (w * weight(xi)) @ self(xi)

    def gram(self, derivative=0, weight=lambda xi: np.ones_like(xi)):
        r""":math:`\int_0^1 w(\xi)\phi_i^{(k)}\phi_j^{(k)}d\xi`, shape (m, m), to `INTEGRAL_TOLERANCE`."""
        xi, w = self._quadrature()
        phi = self(xi, derivative)
        gram = phi.T @ ((w * weight(xi))[:, None] * phi)
        return 0.5 * (gram + gram.T)

    def _quadrature(self):
        # For products of two shapes, 32 nodes and six more per unit of the highest wave number are enough.
        return _gauss_legendre(32 + int(6 * np.max(self.beta)))


def _shapes(beta, c, d):
    """Shapes of unit norm, with positive curvature at the clamp."""
    raw = ModeShapes(np.asarray(beta, float), np.asarray(c, float), np.asarray(d, float))
    norm = np.sqrt(np.diag(raw.gram()))
    sign = np.where(raw(0.0, 2) < 0.0, -1.0, 1.0)
    return ModeShapes(raw.beta.copy(), raw.c * sign / norm, raw.d * sign / norm)


def free_end_shapes(beta):
    r"""Shapes (A1) with the free end's :math:`\phi''(1) = 0` for given wave numbers.

    This is (A1) with the sign of :math:`\nu_i` corrected (the published :math:`\nu_i > 0` does not give a free end).
    The shear :math:`\phi'''(1)` is zero, too, only for the clamped-free wave numbers.

    Parameters
    ----------
    beta : array_like, shape (m,)
        Wave numbers [-].

    Returns
    -------
    ModeShapes
    """
    beta = np.atleast_1d(np.asarray(beta, dtype=float))
    edge = np.exp(-beta)
    c = 1.0 + edge * (np.cos(beta) + np.sin(beta))
    d = np.sin(beta) - np.cos(beta) - edge
    return _shapes(beta, c, d)


def clamped_free(modes):
    r"""Exact modes of the clamped-free beam, :math:`\cos\beta\cosh\beta = -1`.

    Parameters
    ----------
    modes : int
        How many, from the lowest.

    Returns
    -------
    ModeShapes
        Orthonormal: the Gram matrix is the identity.
    """

    def scaled(b):
        # The equation divided by cosh: it does not overflow, and its roots are near odd multiples of pi/2.
        return np.cos(b) + 2.0 * np.exp(-b) / (1.0 + np.exp(-2.0 * b))

    brackets = [(i * np.pi, (i + 1.0) * np.pi) for i in range(modes)]
    beta = [brentq(scaled, max(lo, 0.5), hi, xtol=1e-15, rtol=8.9e-16) for lo, hi in brackets]
    return free_end_shapes(beta)


def from_frequencies(frequencies, length, mass_per_length, stiffness):
    r"""Shapes (A1) with :math:`\beta_i^4 = \rho A (2\pi f_i)^2 L^4 / EI` from measured frequencies.

    They satisfy the conditions at the clamp and :math:`\phi''(1) = 0`. They are not orthogonal, and differ from the
    exact loaded modes. The paper does it this way.

    Parameters
    ----------
    frequencies : array_like, shape (m,)
        Measured natural frequencies f [Hz].
    length : float
        L [m].
    mass_per_length : float
        rho A [kg/m].
    stiffness : float
        EI [N m^2].

    Returns
    -------
    ModeShapes
    """
    omega = 2.0 * np.pi * np.atleast_1d(np.asarray(frequencies, dtype=float))
    return free_end_shapes((mass_per_length * omega**2 * length**4 / stiffness) ** 0.25)


def _loaded_matrix(beta, mass, inertia, moment):
    """Tip conditions on (c, d), shape (2, 2); rows scaled by beta^2 and beta^3. All loads dimensionless.

    For wave numbers (k, 1) shape (2, k, 2).
    """
    unit = np.array([1.0, 1.0])
    edge = np.exp(-beta)
    # Columns: the shape for (c, d) = (1, 0) and (0, 1).
    c, d = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    a, b = -(c + d * edge), c - d * edge
    cos, sin = np.cos(beta), np.sin(beta)
    value = a * cos + b * sin + c * edge + d * unit
    slope = -a * sin + b * cos - c * edge + d * unit
    bend = -a * cos - b * sin + c * edge + d * unit
    shear = a * sin - b * cos - c * edge + d * unit
    return np.array(
        [
            bend - beta**2 * (inertia * beta * slope + moment * value),
            shear + beta * (mass * value + moment * beta * slope),
        ]
    )


@lru_cache(maxsize=256)
def loaded(modes, length, mass_per_length, tip_mass=0.0, tip_inertia=0.0, tip_offset=0.0):
    r"""Exact modes of the clamped beam that carries a rigid body at its tip.

    At :math:`\xi = 1`, with tip mass M, its inertia J about its own centre of mass, which lies d beyond the tip,

    .. math::
        \phi'' &= \beta^4\left[\tfrac{J + M d^2}{\rho A L^3}\phi' + \tfrac{M d}{\rho A L^2}\phi\right], \\
        \phi''' &= -\beta^4\left[\tfrac{M}{\rho A L}\phi + \tfrac{M d}{\rho A L^2}\phi'\right].

    Parameters
    ----------
    modes : int
        How many, from the lowest.
    length : float
        L [m].
    mass_per_length : float
        rho A [kg/m].
    tip_mass : float
        M [kg].
    tip_inertia : float
        J about the axis of bending through the payload's centre of mass [kg m^2].
    tip_offset : float
        d along the beam [m].

    Returns
    -------
    ModeShapes
        Orthogonal with respect to the mass of beam and load together; scaled to :math:`\int\phi^2 = 1`.

    Raises
    ------
    ModelError
        If the load is heavier than `MAX_LOAD`, or if the frequency equation has too few roots in the range searched.
    """
    mass = tip_mass / (mass_per_length * length)
    moment = tip_mass * tip_offset / (mass_per_length * length**2)
    inertia = (tip_inertia + tip_mass * tip_offset**2) / (mass_per_length * length**3)

    if max(mass, inertia) > MAX_LOAD:
        raise ModelError(
            "is too heavy, in units of the beam's m and m L^2",
            field="tip load",
            value=[float(mass), float(inertia)],
            limit=f"at most {MAX_LOAD:g}",
            hint="call the link rigid",
        )

    def determinant(beta):
        m = _loaded_matrix(beta, mass, inertia, moment)
        # Rows are scaled to unit norm: the roots stay, and the sign is clear even for a very heavy load.
        m = m / np.linalg.norm(m, axis=-1, keepdims=True)
        return m[0, ..., 0] * m[1, ..., 1] - m[0, ..., 1] * m[1, ..., 0]

    roots = []
    # With heavy loads two roots are near zero, at least a factor of 1.9 apart.
    step = np.pi / 64.0
    grid = np.append(
        np.geomspace(1e-3, step, 16, endpoint=False), np.arange(step, (modes + 1.5) * np.pi, step)
    )
    values = determinant(grid[:, None])
    for k in range(grid.size - 1):
        if values[k] * values[k + 1] < 0.0 and len(roots) < modes:
            roots.append(brentq(determinant, grid[k], grid[k + 1], xtol=1e-15, rtol=8.9e-16))
    if len(roots) < modes:
        raise ModelError(
            f"gives {len(roots)} roots of the frequency equation below beta = {grid[-1]:.1f}",
            field="tip load",
            value=[float(mass), float(inertia)],
            limit=f"{modes} are needed",
        )
    c, d = np.empty(modes), np.empty(modes)
    for i, beta in enumerate(roots):
        m = _loaded_matrix(beta, mass, inertia, moment)
        row = m[np.argmax(np.abs(m).max(axis=1))]
        c[i], d[i] = row[1], -row[0]
    return _shapes(roots, c, d)


def overlap(one, other, weight=lambda xi: np.ones_like(xi)):
    r""":math:`\int_0^1 w(\xi)\phi_i\psi_j\,d\xi` of two families of shapes, shape (m, k)."""
    xi, w = max((one._quadrature(), other._quadrature()), key=lambda q: q[0].size)
    return one(xi).T @ ((w * weight(xi))[:, None] * other(xi))


@dataclass(frozen=True)
class TwistShapes:
    r"""Shapes :math:`\theta_i = a_i\sin\beta_i\xi` of a uniform bar in torsion, clamped at its base.

    Attributes
    ----------
    beta : ndarray, shape (m,)
        Wave numbers [-].
    """

    beta: np.ndarray

    def __post_init__(self):
        self.beta.setflags(write=False)

    @property
    def count(self):
        """Number of modes."""
        return self.beta.size

    @property
    def _scale(self):
        return 1.0 / np.sqrt(0.5 - np.sin(2.0 * self.beta) / (4.0 * self.beta))

    def __call__(self, xi, derivative=0):
        r"""Values of :math:`d^k\theta_i/d\xi^k`, shape (m,) or (p, m), as `ModeShapes`."""
        x = self.beta * np.asarray(xi, dtype=float)[..., None]
        wave = (np.sin(x), np.cos(x), -np.sin(x), -np.cos(x))[derivative % 4]
        return self._scale * self.beta**derivative * wave

    integral = ModeShapes.integral
    gram = ModeShapes.gram
    _quadrature = ModeShapes._quadrature


def twist(modes, length, polar_inertia_per_length, tip_inertia=0.0):
    r"""Exact torsional modes of a clamped bar that carries an inertia at its tip.

    .. math:: \beta\tan\beta = \rho I_p L/J, \qquad \omega = \frac{\beta}{L}\sqrt{GJ/\rho I_p}

    Parameters
    ----------
    modes : int
        How many, from the lowest.
    length : float
        L [m].
    polar_inertia_per_length : float
        rho I_p [kg m].
    tip_inertia : float
        J about the bar's axis [kg m^2]; 0: free tip.

    Returns
    -------
    TwistShapes
    """
    ratio = tip_inertia / (polar_inertia_per_length * length)

    def tip_condition(b):
        return np.cos(b) - ratio * b * np.sin(b)

    # Brackets end slightly beyond pi/2: with a free tip the root is there, and the rounded cosine may have either sign.
    brackets = [(i * np.pi, (i + 0.5) * np.pi + 1e-9) for i in range(modes)]
    roots = [brentq(tip_condition, lo, hi, xtol=1e-15, rtol=8.9e-16) for lo, hi in brackets]
    return TwistShapes(np.array(roots))


def twist_from_frequencies(frequencies, length, polar_inertia_per_length, torsional_stiffness):
    r"""Shapes with :math:`\beta_i = 2\pi f_i L\sqrt{\rho I_p/GJ}` from measured frequencies [Hz]."""
    omega = 2.0 * np.pi * np.atleast_1d(np.asarray(frequencies, dtype=float))
    return TwistShapes(omega * length * np.sqrt(polar_inertia_per_length / torsional_stiffness))
