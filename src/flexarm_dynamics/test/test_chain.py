"""The general chain: a second derivation of its equations, power, momentum, kinematics, frequencies, what it refuses.

`Reference` places every point of an arm that has mass by formulae of its own and takes velocities and
accelerations from truncated power series in time: d'Alembert's principle then gives every force without a
mass matrix, a recursion or a difference. It shares the mode shapes with the model, and nothing else.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial.legendre import leggauss
from scipy.integrate import DOP853
from scipy.linalg import eigh
from scipy.optimize import brentq

from flexarm_dynamics.arm import Arm, Flexibility, Friction, Joint, Link, Payload
from flexarm_dynamics.chain import Chain
from flexarm_dynamics.errors import ModelError, ShapeError
from flexarm_dynamics.kernels import generated
from flexarm_dynamics.model import Tableau, rotation

#: As in the other tests: the same examples on every run and every machine.
examples = settings(max_examples=40, deadline=None, derandomize=True, database=None)

EULER = Tableau(np.zeros((1, 1)), np.ones(1), np.zeros(1))
METHOD = Tableau(
    np.ascontiguousarray(DOP853.A[: DOP853.n_stages, : DOP853.n_stages]),
    np.ascontiguousarray(DOP853.B),
    np.ascontiguousarray(DOP853.C[: DOP853.n_stages]),
)
LEVELS = ("first order", "foreshortening", "finite slope")


def at_level(arm, level):
    """The same arm at another level of its model."""
    return replace(
        arm, foreshortening=level == "foreshortening", finite_slope=level == "finite slope"
    )


def level_of(arm):
    """Name of an arm's level."""
    return LEVELS[2 if arm.finite_slope else 1 if arm.foreshortening else 0]


# --- random arms -------------------------------------------------------------------------------


def unit(rng):
    """Random direction."""
    v = rng.standard_normal(3)
    return tuple(v / np.linalg.norm(v))


def body(rng, size):
    """Inertia of a random rigid body about its centre of mass, as rows."""
    points = size * rng.standard_normal((4, 3))
    inertia = sum((p @ p) * np.eye(3) - np.outer(p, p) for p in points)
    return tuple(map(tuple, inertia))


def flexibility(rng, direction, modes, shape, length, mass, stiffness, damped):
    """Modes in one direction; measured frequencies near those of the clamped beam."""
    frequencies = ()
    if shape == "from_frequencies":
        if direction == "twist":
            beta = np.array([1.5, 4.6, 7.9])[:modes] + rng.uniform(-0.2, 0.2, modes)
            frequencies = beta / length * np.sqrt(stiffness / mass) / (2.0 * np.pi)
        else:
            beta = np.array([1.8, 4.6, 7.8])[:modes] + rng.uniform(-0.2, 0.2, modes)
            frequencies = (beta / length) ** 2 * np.sqrt(stiffness / mass) / (2.0 * np.pi)
    damping = tuple(rng.uniform(0.005, 0.05, modes)) if damped else ()
    return Flexibility(modes, shape, tuple(frequencies), damping)


def random_arm(seed, layout, level="first order", friction=True, gravity=True):
    """An arm of which nothing is zero; `layout`: a dict direction -> (modes, shape) for each link."""
    rng = np.random.default_rng(seed)
    joints, links = [], []
    for i, flexible in enumerate(layout):
        joints.append(
            Joint(
                f"joint{i + 1}",
                axis=unit(rng),
                origin_xyz=tuple(rng.uniform(-0.2, 0.2, 3)),
                origin_rpy=tuple(rng.uniform(-3.0, 3.0, 3)),
                hub_inertia=rng.uniform(0.01, 0.1),
                motor_mass=rng.uniform(0.1, 1.0),
                rotor_inertia=rng.uniform(1e-4, 1e-3),
                gear_ratio=rng.uniform(-8.0, 12.0),
                friction=Friction(*rng.uniform(0.1, 0.5, 3)) if friction else Friction(),
            )
        )
        length, rho, polar = rng.uniform(0.4, 1.2), rng.uniform(0.2, 1.0), rng.uniform(1e-3, 1e-2)
        stiffness = dict(zip(("y", "z", "twist"), rng.uniform(3.0, 9.0, 3), strict=True))
        modes = {
            d: flexibility(
                rng, d, *flexible[d], length, polar if d == "twist" else rho, stiffness[d],
                damped=rng.random() < 0.7,
            )
            for d in ("y", "z", "twist")
            if d in flexible
        }  # fmt: skip
        links.append(Link(f"link{i + 1}", length, rho, stiffness, modes, polar))
    payload = Payload(rng.uniform(0.1, 0.5), body(rng, 0.05), tuple(rng.uniform(-0.1, 0.1, 3)))
    weight = tuple(rng.uniform(-9.0, 9.0, 3)) if gravity else (0.0, 0.0, 0.0)
    arm = Arm("random", tuple(joints), tuple(links), payload, gravity=weight)
    return at_level(arm, level)


FULL = {"y": (2, "loaded"), "z": (2, "clamped_free"), "twist": (1, "loaded")}


@st.composite
def layouts(draw, most=5):
    """What is flexible in each link of an arm; at most eight modes a link."""
    shapes = st.sampled_from(["clamped_free", "loaded", "from_frequencies"])
    links = []
    for _ in range(draw(st.integers(1, most))):
        directions = draw(st.sets(st.sampled_from(["y", "z", "twist"])))
        links.append(
            {
                d: (draw(st.integers(1, 2 if d == "twist" else 3)), draw(shapes))
                for d in sorted(directions)
            }
        )
    return links


seeds = st.integers(0, 2**32 - 1)


def random_state(seed, arm):
    """Q, delta, qd, delta_d: nothing is zero, slopes of the axis reach 0.4."""
    rng = np.random.default_rng(seed)
    n = len(arm.joints)
    size = []
    for mode in arm.modes:
        length = arm.link(mode.link).length
        size.append((0.06 * length if mode.direction != "twist" else 0.2) / mode.number**2)
    size = np.array(size)
    return (
        rng.uniform(-3.0, 3.0, n),
        rng.uniform(-1.0, 1.0, size.size) * size,
        2.0 * rng.standard_normal(n),
        10.0 * rng.standard_normal(size.size) * size,
    )


# --- a second derivation -----------------------------------------------------------------------


class Jet:
    """Values that depend on time: power series x0 + x1 t + x2 t^2, coefficients along the first axis."""

    __array_ufunc__ = None  # array * jet is the jet's business

    def __init__(self, c):
        self.c = np.asarray(c)

    @classmethod
    def of(cls, value):
        """A constant."""
        value = np.asarray(value, float)
        return cls(np.stack([value, 0.0 * value, 0.0 * value]))

    @staticmethod
    def _of(value):
        return value if isinstance(value, Jet) else Jet.of(value)

    def __getitem__(self, key):
        return Jet(self.c[(slice(None), *(key if isinstance(key, tuple) else (key,)))])

    def __neg__(self):
        return Jet(-self.c)

    def __add__(self, other):
        other = Jet._of(other)
        return Jet(np.stack([self.c[k] + other.c[k] for k in range(3)]))

    __radd__ = __add__

    def __sub__(self, other):
        return self + -Jet._of(other)

    def __rsub__(self, other):
        return -self + other

    def _product(self, other, by):
        a, b = self.c, Jet._of(other).c
        return Jet(
            np.stack([by(a[0], b[0]), by(a[0], b[1]) + by(a[1], b[0]),
                      by(a[0], b[2]) + by(a[1], b[1]) + by(a[2], b[0])])
        )  # fmt: skip

    def __mul__(self, other):
        return self._product(other, np.multiply)

    __rmul__ = __mul__

    def __matmul__(self, other):
        return self._product(other, np.matmul)

    def __truediv__(self, other):
        return self * Jet._of(other)._map(lambda x: 1 / x, lambda x: -1 / x**2, lambda x: 2 / x**3)

    def _map(self, f, f1, f2):
        """A function of it, given with its first two derivatives."""
        x0, x1, x2 = self.c
        return Jet(np.stack([f(x0), f1(x0) * x1, f1(x0) * x2 + 0.5 * f2(x0) * x1 * x1]))

    def sin(self):
        return self._map(np.sin, np.cos, lambda x: -np.sin(x))

    def cos(self):
        return self._map(np.cos, lambda x: -np.sin(x), lambda x: -np.cos(x))

    def sqrt(self):
        return self._map(np.sqrt, lambda x: 0.5 / np.sqrt(x), lambda x: -0.25 * x**-1.5)

    def arcsin(self):
        return self._map(np.arcsin, lambda x: (1 - x * x) ** -0.5, lambda x: x * (1 - x * x) ** -1.5)


def rows(*entries):
    """A matrix (or vector, of single entries) of jets over the last axes."""
    size = np.broadcast_shapes(*(np.shape(x.c) for x in entries if isinstance(x, Jet)))
    entries = [np.broadcast_to(x.c if isinstance(x, Jet) else Jet.of(x + np.zeros(size[1:])).c, size)
               for x in entries]  # fmt: skip
    return Jet(np.stack(entries, axis=-1))


def matrix(*entries):
    """Three by three, of nine jets or numbers, row by row."""
    flat = rows(*entries)
    return Jet(flat.c.reshape(*flat.c.shape[:-1], 3, 3))


def turned(R, v):
    """R v."""
    return (R @ Jet._of(v)[..., None])[..., 0]


def transposed(R):
    return Jet(np.swapaxes(R.c, -1, -2))


def about(axis, angle):
    """Rotation about a unit vector, by Rodrigues' formula; angle a jet of shape (b,)."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    s, c = angle.sin()[..., None, None], angle.cos()[..., None, None]
    return Jet.of(np.eye(3)) + s * skew + (1.0 - c) * (skew @ skew)


def vee(S):
    """Vector of the skew part of matrices, (..., 3, 3)."""
    S = 0.5 * (S - np.swapaxes(S, -1, -2))
    return np.stack([S[..., 2, 1], S[..., 0, 2], S[..., 1, 0]], axis=-1)


def spin(R):
    """Angular velocity and acceleration of a rotating frame in its own coordinates."""
    back = np.swapaxes(R.c[0], -1, -2)
    # R' R'' is the angular acceleration's matrix and the square of the velocity's, which is symmetric.
    return vee(back @ R.c[1]), vee(back @ (2.0 * R.c[2]))


NODES, WEIGHTS = leggauss(48)
XI, WEIGHTS = 0.5 * (NODES + 1.0), 0.5 * WEIGHTS
#: Gauss points between the base and each node, and between the base and the tip.
INNER = np.append(XI, 1.0)[:, None] * XI[None, :]


class Reference:
    """Everything that the model says about motion, from where the arm's points are (module docstring).

    What is taken for granted: the axis of a link is at (x - s, y, z) with y, z linear in delta and s the
    foreshortening; its tip is turned by Rz(a) Ry(-b) Rx(t); the beam's sections have inertia about the
    link's x axis alone.
    """

    def __init__(self, model):
        self.model, self.arm = model, model.arm
        self.n, self.m = model.n_joints, model.n_modes

    def _shape(self, i, delta, at, derivative=0):
        """Deflections y, z, twist of link i at points `at` of [0, 1]; jets of shape (b, points)."""
        link, out = self.arm.links[i], {}
        for d in ("y", "z", "twist"):
            values = Jet(np.zeros((3, delta.c.shape[1], at.size)))
            if d in link.flexible:
                which = [k for k, mode in enumerate(self.arm.modes) if
                         (mode.link, mode.direction) == (link.name, d)]  # fmt: skip
                phi = self.model.mode_shapes(link.name, d)(at, derivative)
                values = Jet(delta.c[..., which] @ phi.T / link.length**derivative)
            out[d] = values
        return out["y"], out["z"], out["twist"]

    def _shortening(self, i, delta, ends):
        """How far the axis has drawn back at each of `ends`."""
        length, level = self.arm.links[i].length, level_of(self.arm)
        if level == "first order":
            return Jet(np.zeros((3, delta.c.shape[1], ends.size)))
        at = (ends[:, None] * XI).ravel()
        y, z, _ = self._shape(i, delta, at, 1)
        u = y * y + z * z
        lost = 0.5 * u if level == "foreshortening" else 1.0 - (1.0 - u).sqrt()
        lost = Jet(lost.c.reshape(*lost.c.shape[:2], ends.size, XI.size))
        return Jet((lost.c @ WEIGHTS) * ends * length)

    def section(self, i, delta, xi):
        """Position and rotation of a section in its link's frame: jets (b, 3), (b, 3, 3)."""
        level, end = level_of(self.arm), np.array([xi])
        y, z, _ = (v[:, 0] for v in self._shape(i, delta, end))
        length = self.arm.links[i].length
        place = rows(length * xi - self._shortening(i, delta, end)[:, 0], y, z)
        sy, sz, _ = (v[:, 0] for v in self._shape(i, delta, end, 1))
        twist = self._shape(i, delta, end)[2][:, 0]
        a, b = sy, sz
        if level == "finite slope":
            a, b = (sy / (1.0 - sz * sz).sqrt()).arcsin(), sz.arcsin()
        if level != "first order":
            bend = self._shape(i, delta, XI * xi, 2)[0]
            slope = self._shape(i, delta, XI * xi, 1)[1]
            twist = twist - Jet((bend * slope).c @ WEIGHTS * (length * xi))
        (sa, ca), (sb, cb), (s, c) = ((v.sin(), v.cos()) for v in (a, b, twist))
        Rz = matrix(ca, -sa, 0.0, sa, ca, 0.0, 0.0, 0.0, 1.0)
        Ry = matrix(cb, 0.0, -sb, 0.0, 1.0, 0.0, sb, 0.0, cb)
        Rx = matrix(1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c)
        return place, Rz @ Ry @ Rx

    def frames(self, q, delta):
        """(R of the carrier, R, p) of each link's base and last (R, R, p) of the tip."""
        count = q.c.shape[1]
        R, p, out = Jet.of(np.tile(np.eye(3), (count, 1, 1))), Jet.of(np.zeros((count, 3))), []
        for i, joint in enumerate(self.arm.joints):
            p = p + turned(R, joint.origin_xyz)
            carrier = R @ rotation(joint.origin_rpy)
            R = carrier @ about(joint.axis, q[:, i])
            out.append((carrier, R, p))
            place, turn = self.section(i, delta, 1.0)
            p, R = p + turned(R, place), R @ turn
        return [*out, (R, R, p)]

    def _motion(self, z, zd, zdd):
        """Jets of q and delta along each coordinate and, in the last row, along the motion itself."""
        size = z.size
        jet = np.zeros((3, size + 1, size))
        jet[0], jet[1, :size], jet[1, size], jet[2, size] = z, np.eye(size), zd, 0.5 * zdd
        return Jet(jet[..., : self.n]), Jet(jet[..., self.n :])

    def motion(self, z, zd, zdd):
        """Inertial forces, kinetic energy and its rate, momenta and what they change by.

        Returns
        -------
        dict
            force (n + m,): inertial less gravitational; kinetic, potential: energies; power: d/dt of the
            kinetic energy; linear, angular (3,): momenta; weight: gravitational energy.
        """
        q, delta = self._motion(z, zd, zdd)
        g = np.array(self.arm.gravity)
        sums = {"force": 0.0, "gravity": 0.0, "kinetic": 0.0, "power": 0.0, "weight": 0.0,
                "linear": np.zeros(3), "angular": np.zeros(3)}  # fmt: skip

        def masses(m, x):
            """Point masses m (k,) at x (b, k, 3)."""
            J, v, a = x.c[1, :-1], x.c[1, -1], 2.0 * x.c[2, -1]
            sums["force"] += np.einsum("k,jkx,kx->j", m, J, a)
            sums["gravity"] -= np.einsum("k,jkx,x->j", m, J, g)
            sums["kinetic"] += 0.5 * m @ np.sum(v * v, axis=1)
            sums["power"] += m @ np.sum(v * a, axis=1)
            sums["weight"] -= m @ x.c[0, -1] @ g
            sums["linear"] += m @ v
            sums["angular"] += m @ np.cross(x.c[0, -1], v)

        def inertia(I, R):  # noqa: E741
            """A body's rotation; R (b, 3, 3)."""
            W, dW = spin(R)
            w, al = W[-1], dW[-1]
            moment = I @ al + np.cross(w, I @ w)
            sums["force"] += W[:-1] @ moment
            sums["kinetic"] += 0.5 * w @ I @ w
            sums["power"] += w @ moment
            sums["angular"] += R.c[0, -1] @ I @ w

        def wheels(I, R, axis, rate, acceleration):
            """Wheels of inertia I (k,) that turn by a rate (b, k) about an axis fixed in R."""
            W, dW = spin(R)
            w, axis = W[-1], np.array(axis)
            own = W @ axis
            total = own[:, None] + rate
            change = dW[-1] @ axis + acceleration
            spins = I @ total[-1]
            sums["force"] += total[:-1] @ (I * change) + W[:-1] @ np.cross(w, axis) * spins
            sums["kinetic"] += 0.5 * I @ total[-1] ** 2
            sums["power"] += I @ (total[-1] * change)
            sums["angular"] += R.c[0, -1] @ axis * spins

        frames = self.frames(q, delta)
        for i, (joint, link) in enumerate(zip(self.arm.joints, self.arm.links, strict=True)):
            carrier, R, p = frames[i]
            masses(np.array([joint.motor_mass]), p[:, None])
            inertia(joint.hub_inertia * np.outer(joint.axis, joint.axis), R)
            turns = joint.gear_ratio * q.c[..., i : i + 1]
            wheels(np.array([joint.rotor_inertia]), carrier, joint.axis, turns[1], 2 * turns[2, -1])
            y, zz, twist = self._shape(i, delta, XI)
            x = link.length * XI - self._shortening(i, delta, XI)
            local = rows(x, y, zz)
            points = p[:, None] + local @ transposed(R)
            masses(link.mass * WEIGHTS, points)
            polar = link.polar_inertia_per_length * link.length * WEIGHTS
            wheels(polar, R, (1.0, 0.0, 0.0), twist.c[1], 2.0 * twist.c[2, -1])
        _, R, p = frames[-1]
        payload = self.arm.payload
        masses(np.array([payload.mass]), (p + turned(R, payload.offset))[:, None])
        inertia(np.array(payload.inertia), R)
        return sums

    def elastic(self, z, zd):
        """Elastic energy, its gradient (n + m,) and its rate along zd."""
        _, delta = self._motion(z, zd, 0.0 * zd)
        energy = Jet(np.zeros((3, z.size + 1)))
        for i, link in enumerate(self.arm.links):
            stiffness = {d: link.stiffness.get(d, 0.0) for d in ("y", "z", "twist")}
            by, bz, _ = self._shape(i, delta, XI, 2)
            sy, sz, turn = self._shape(i, delta, XI, 1)
            ky2, kz2 = by * by, bz * bz
            if level_of(self.arm) == "finite slope":
                # Tangent by a about z, then b: curvatures b' and a' cos b, along the axis's own length.
                c = 1.0 - sz * sz
                root = (sy / c.sqrt()) * (sy / c.sqrt())
                db = bz / c.sqrt()
                da = (by / c.sqrt() + sy * sz * bz / (c * c.sqrt())) / (1.0 - root).sqrt()
                ky2, kz2 = da * da * c, db * db
            density = stiffness["y"] * ky2 + stiffness["z"] * kz2 + stiffness["twist"] * turn * turn
            energy = energy + Jet(0.5 * link.length * density.c @ WEIGHTS)
        return energy.c[0, -1], energy.c[1, :-1], energy.c[1, -1]

    def damping(self):
        """Modal damping of each link with its base held, from its modes' own mass and stiffness."""
        return self.model.linearisation(np.zeros(self.n), np.zeros(self.n))[1][self.n :]


def coordinates(state):
    """Z = (q, delta) and its rate."""
    q, delta, qd, delta_d = state
    return np.concatenate([q, delta]), np.concatenate([qd, delta_d])
