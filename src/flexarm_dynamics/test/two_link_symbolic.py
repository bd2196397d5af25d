# SPDX-License-Identifier: Apache-2.0
r"""Independent oracle: the planar two-link arm with two modes per link, by sympy from its Lagrangian.

Nothing here comes from the model that it checks. Every point of the arm is
:math:`p = \sum_k b_k(x)\,P_k(z)` with known functions :math:`b = (1, x, \phi_1, \phi_2)` of the position along
a link and vectors :math:`P_k` of the coordinates :math:`z = (q_1, q_2, \delta_{11}, \delta_{12}, \delta_{21},
\delta_{22})`, so a link's kinetic energy is

.. math::
    T = \tfrac12\sum_{kl}\Bigl(\int\rho A\,b_k b_l\,dx\Bigr)\dot P_k\cdot\dot P_l ,

exact in the coordinates, with the modal integrals as symbols. Then

.. math::
    h_i = \sum_{jk}\Bigl(\frac{\partial M_{ij}}{\partial z_k}
          - \tfrac12\frac{\partial M_{jk}}{\partial z_i}\Bigr)\dot z_j\dot z_k,
    \qquad g_i = \frac{\partial V}{\partial z_i} .
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import sympy as sp


@dataclass(frozen=True)
class LinkData:
    """One link with the joint at its base (SI).

    Attributes
    ----------
    length, density, stiffness : float
        L [m], rho A [kg/m], EI [N m^2].
    hub, rotor, gear, motor_mass : float
        Jh, Jr [kg m^2], N [-], mass at the joint [kg], which hangs on the previous link.
    first, moment : ndarray, shape (2,)
        Integrals over xi of phi and of xi phi [-].
    gram, bending : ndarray, shape (2, 2)
        Integrals over xi of phi phi^T and of phi'' phi''^T [-].
    tip, slope : ndarray, shape (2,)
        phi and dphi/dxi at xi = 1 [-].
    """

    length: float
    density: float
    stiffness: float
    hub: float
    rotor: float
    gear: float
    motor_mass: float
    first: np.ndarray
    moment: np.ndarray
    gram: np.ndarray
    bending: np.ndarray
    tip: np.ndarray
    slope: np.ndarray

    def numbers(self):
        """In the order of `_Symbols`."""
        scalars = [self.length, self.density, self.hub, self.rotor, self.gear, self.motor_mass]
        gram = [self.gram[0, 0], self.gram[0, 1], self.gram[1, 1]]
        return np.concatenate([scalars, self.first, self.moment, gram, self.tip, self.slope])


class _Symbols:
    """The symbols of one link."""

    def __init__(self, i):
        def pair(name):
            return sp.Matrix(sp.symbols(f"{name}{i}_1:3"))

        self.L, self.rho, self.Jh, self.Jr, self.N, self.Mm = sp.symbols(
            f"L{i} rho{i} Jh{i} Jr{i} N{i} Mm{i}"
        )
        self.s, self.t = pair("s"), pair("t")
        g11, g12, g22 = sp.symbols(f"g{i}_11 g{i}_12 g{i}_22")
        self.G = sp.Matrix([[g11, g12], [g12, g22]])
        self.tip, self.slope = pair("tip"), pair("slope")
        scalars = [self.L, self.rho, self.Jh, self.Jr, self.N, self.Mm]
        self.all = [*scalars, *self.s, *self.t, g11, g12, g22, *self.tip, *self.slope]

    def products(self):
        """Integrals over the link of rho A b b^T, b = (1, x, phi_1, phi_2)."""
        L, s, t = self.L, self.s, self.t
        out = sp.zeros(4, 4)
        out[0, 0], out[0, 1], out[1, 1] = L, L**2 / 2, L**3 / 3
        for a in range(2):
            out[0, 2 + a], out[1, 2 + a] = L * s[a], L**2 * t[a]
            for b in range(a, 2):
                out[2 + a, 2 + b] = L * self.G[a, b]
        for k in range(4):
            for m in range(k):
                out[k, m] = out[m, k]
        return self.rho * out


@lru_cache(maxsize=1)
def derive():
    """Functions (M, h, g, points) of numbers: all take (z, zd, parameters).

    `points` gives the tip and the payload's centre of mass.
    """
    link1, link2 = _Symbols(1), _Symbols(2)
    Mp, Jp, d, gx, gy = sp.symbols("Mp Jp d gx gy")
    z = sp.Matrix(sp.symbols("q1 q2 d11 d12 d21 d22"))
    zd = sp.Matrix(sp.symbols("q1d q2d d11d d12d d21d d22d"))
    q1, q2 = z[0], z[1]
    delta1, delta2 = z[2:4, 0], z[4:6, 0]
    gravity = sp.Matrix([gx, gy])

    def turned(angle):
        c, s = sp.cos(angle), sp.sin(angle)
        return sp.Matrix([c, s]), sp.Matrix([-s, c])

    slope1 = link1.slope.dot(delta1) / link1.L
    slope2 = link2.slope.dot(delta2) / link2.L
    along1, across1 = turned(q1)
    elbow = link1.L * along1 + link1.tip.dot(delta1) * across1
    alpha2 = q1 + slope1 + q2
    along2, across2 = turned(alpha2)
    tip = elbow + link2.L * along2 + link2.tip.dot(delta2) * across2
    centre = tip + d * turned(alpha2 + slope2)[0]

    mass = sp.zeros(6, 6)
    potential = sp.Integer(0)

    def move(m, point):
        nonlocal mass, potential
        jacobian = point.jacobian(z)
        mass += m * jacobian.T * jacobian
        potential -= m * gravity.dot(point)

    def turn(inertia, angle):
        nonlocal mass
        jacobian = sp.Matrix([angle]).jacobian(z)
        mass += inertia * jacobian.T * jacobian

    def beam(link, base, along, across, delta):
        nonlocal mass, potential
        vectors = [base, along, delta[0] * across, delta[1] * across]
        jacobians = [v.jacobian(z) for v in vectors]
        products = link.products()
        for k in range(4):
            potential -= products[0, k] * gravity.dot(vectors[k])
            for m in range(4):
                mass += products[k, m] * jacobians[k].T * jacobians[m]

    beam(link1, sp.zeros(2, 1), along1, across1, delta1)
    beam(link2, elbow, along2, across2, delta2)
    move(link2.Mm, elbow)
    move(Mp, centre)
    turn(link1.Jh, q1)
    turn(link1.Jr, link1.N * q1)
    turn(link2.Jh, alpha2)
    turn(link2.Jr, q1 + slope1 + link2.N * q2)
    turn(Jp, alpha2 + slope2)

    by_z = [mass.diff(zk) for zk in z]
    rate = sum((by_z[k] * zd[k] for k in range(6)), sp.zeros(6, 6))
    energy_slopes = sp.Matrix([(zd.T * by_z[i] * zd)[0] / 2 for i in range(6)])
    h = rate * zd - energy_slopes
    g = sp.Matrix([potential]).jacobian(z).T

    parameters = sp.Matrix([*link1.all, *link2.all, Mp, Jp, d, gx, gy])

    def numeric(*expressions):
        flat = [entry for e in expressions for entry in e]
        call = sp.lambdify([list(z), list(zd), list(parameters)], flat, "numpy", cse=True)
        shapes = [e.shape for e in expressions]
        ends = np.cumsum([a * b for a, b in shapes])[:-1]

        def function(z, zd, p):
            parts = np.split(np.array(call(z, zd, p), float), ends)
            return [x.reshape(s).squeeze() for x, s in zip(parts, shapes, strict=True)]

        return function

    return numeric(mass), numeric(h), numeric(g), numeric(tip, centre)


@dataclass(frozen=True)
class TwoLink:
    """The arm in numbers.

    Attributes
    ----------
    links : tuple of LinkData
        The two links.
    payload_mass, payload_inertia, payload_offset : float
        Mp [kg], Jp about its centre of mass [kg m^2], d along the tip's tangent [m].
    gravity : tuple
        (gx, gy) [m/s^2].
    """

    links: tuple
    payload_mass: float = 0.0
    payload_inertia: float = 0.0
    payload_offset: float = 0.0
    gravity: tuple = (0.0, 0.0)

    @property
    def _parameters(self):
        first, second = (link.numbers() for link in self.links)
        payload = [self.payload_mass, self.payload_inertia, self.payload_offset]
        return np.concatenate([first, second, payload, self.gravity])

    def _call(self, which, q, delta, qd=(0.0,) * 2, delta_d=(0.0,) * 4):
        z, zd = np.concatenate([q, delta]), np.concatenate([qd, delta_d])
        return derive()[which](z, zd, self._parameters)

    def M(self, q, delta):
        """Mass matrix, shape (6, 6)."""
        return self._call(0, q, delta)[0]

    def h(self, q, delta, qd, delta_d):
        """Coriolis and centrifugal forces, shape (6,)."""
        return self._call(1, q, delta, qd, delta_d)[0]

    def g(self, q, delta):
        """Forces of gravity, on the side of the accelerations, shape (6,)."""
        return self._call(2, q, delta)[0]

    @property
    def K(self):
        """Elastic stiffness of all six coordinates, shape (6, 6)."""
        out = np.zeros((6, 6))
        for i, link in enumerate(self.links):
            rows = slice(2 + 2 * i, 4 + 2 * i)
            out[rows, rows] = link.stiffness / link.length**3 * link.bending
        return out

    def tip(self, q, delta):
        """Position of link 2's tip, shape (2,) [m]."""
        return self._call(3, q, delta)[0]
