# SPDX-License-Identifier: Apache-2.0
"""The general chain: a second derivation of its equations, power, momentum, kinematics, frequencies, what it refuses.

`Reference` places every point of an arm that has mass by formulae of its own and takes velocities and
accelerations from truncated power series in time: d'Alembert's principle then gives every force without a
mass matrix, a recursion or a difference. It shares the mode shapes with the model, and nothing else.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial.legendre import leggauss
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, eigh
from scipy.optimize import brentq

from flexarm_dynamics.arm.description import (
    Arm,
    Body,
    Flexibility,
    Friction,
    Joint,
    Link,
    Payload,
    Piece,
)
from flexarm_dynamics.errors import ModelError, ShapeError
from flexarm_dynamics.kernels import generated, native
from flexarm_dynamics.models.chain import Chain, work_space
from flexarm_dynamics.models.fixed_step import METHODS
from flexarm_dynamics.models.model import ArmModel, Tableau, rotation

#: As in the other tests: the same examples on every run and every machine.
examples = settings(max_examples=40, deadline=None, derandomize=True, database=None)

EULER = Tableau(np.zeros((1, 1)), np.ones(1), np.zeros(1))
METHOD = METHODS["dop853"]
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
        pieces = varied(rng) if flexible.get("varied") else ()
        bodies = carried(rng, length) if flexible.get("carries") else ()
        root = tuple(rng.uniform(-0.2, 0.2, 3)) if flexible.get("carries") else (0.0,) * 3
        links.append(
            Link(f"link{i + 1}", length, rho, stiffness, modes, polar, pieces, bodies, root)
        )
    payload = Payload(rng.uniform(0.1, 0.5), body(rng, 0.05), tuple(rng.uniform(-0.1, 0.1, 3)))
    weight = tuple(rng.uniform(-9.0, 9.0, 3)) if gravity else (0.0, 0.0, 0.0)
    arm = Arm("random", tuple(joints), tuple(links), payload, gravity=weight)
    return at_level(arm, level)


def varied(rng):
    """Two parts of a link, each tapered, with a step between them; relative to the link's own numbers."""
    step = rng.uniform(0.3, 0.7)

    def taper():
        return {name: tuple(rng.uniform((0.6, -0.3, -0.2), (1.4, 0.2, 0.1))) for name in PROPERTIES}

    # The link's mass and polar inertia are those of the mean.
    pieces = [Piece(0.0, step, **taper()), Piece(step, 1.0, **taper())]
    for name in ("mass", "polar"):
        mean = sum((p.end - p.start) * np.polyint(getattr(p, name)[::-1]).sum() for p in pieces)
        pieces = [replace(p, **{name: tuple(np.array(getattr(p, name)) / mean)}) for p in pieces]
    return tuple(pieces)


def carried(rng, length):
    """Two bodies on a link."""
    return tuple(
        Body(x * length, rng.uniform(0.1, 0.5), body(rng, 0.05), tuple(rng.uniform(-0.1, 0.1, 3)))
        for x in rng.uniform((0.2, 0.0), (0.5, 1.0))
    )


PROPERTIES = ("mass", "y", "z", "twist", "polar")
FULL = {"y": (2, "loaded"), "z": (2, "clamped_free"), "twist": (1, "loaded")}


@st.composite
def layouts(draw, most=5):
    """What is flexible in each link of an arm; at most eight modes a link."""
    shapes = st.sampled_from(["clamped_free", "loaded", "from_frequencies"])
    links = []
    for _ in range(draw(st.integers(1, most))):
        directions = draw(st.sets(st.sampled_from(["y", "z", "twist"])))
        changes = draw(st.booleans())
        link = {
            d: (
                draw(st.integers(1, 2 if d == "twist" else 3)),
                draw(shapes.filter(lambda s: s != "from_frequencies") if changes else shapes),
            )
            for d in sorted(directions)
        }
        links.append({**link, "varied": changes, "carries": draw(st.booleans())})
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
        return self._map(
            np.arcsin, lambda x: (1 - x * x) ** -0.5, lambda x: x * (1 - x * x) ** -1.5
        )


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


def gauss(count):
    """Gauss's points and weights on [0, 1]."""
    nodes, weights = leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


XI, WEIGHTS = gauss(48)


def along(link, ends=1.0):
    """Gauss's points and weights from a link's base to each of `ends`, between its breaks; (..., points)."""
    xi, weights = gauss(28) if link.pieces else (XI, WEIGHTS)
    breaks = np.minimum(link.breaks, np.asarray(ends)[..., None])
    low, length = breaks[..., :-1, None], np.diff(breaks)[..., None]
    at, w = low + length * xi, length * weights
    return at.reshape(*at.shape[:-2], -1), w.reshape(*w.shape[:-2], -1)


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
        link, level = self.arm.links[i], level_of(self.arm)
        if level == "first order":
            return Jet(np.zeros((3, delta.c.shape[1], ends.size)))
        at, weights = along(link, ends)
        y, z, _ = self._shape(i, delta, at.ravel(), 1)
        u = y * y + z * z
        lost = 0.5 * u if level == "foreshortening" else 1.0 - (1.0 - u).sqrt()
        lost = lost.c.reshape(*lost.c.shape[:2], *at.shape)
        return Jet((lost * weights).sum(axis=-1) * link.length)

    def section(self, i, delta, xi):
        """Position and rotation of a section in its link's frame: jets (b, 3), (b, 3, 3)."""
        level, end = level_of(self.arm), np.array([xi])
        y, z, _ = (v[:, 0] for v in self._shape(i, delta, end))
        length = self.arm.links[i].length
        x, root = length * xi - self._shortening(i, delta, end)[:, 0], self.arm.links[i].root
        place = rows(x + root[0], y + root[1], z + root[2])
        sy, sz, _ = (v[:, 0] for v in self._shape(i, delta, end, 1))
        twist = self._shape(i, delta, end)[2][:, 0]
        a, b = sy, sz
        if level == "finite slope":
            a, b = (sy / (1.0 - sz * sz).sqrt()).arcsin(), sz.arcsin()
        if level != "first order":
            at, weights = along(self.arm.links[i], xi)
            bend, slope = self._shape(i, delta, at, 2)[0], self._shape(i, delta, at, 1)[1]
            twist = twist - Jet((bend * slope).c @ weights * length)
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

        def inertia(body, R):
            """A body's rotation; R (b, 3, 3)."""
            W, dW = spin(R)
            w, al = W[-1], dW[-1]
            moment = body @ al + np.cross(w, body @ w)
            sums["force"] += W[:-1] @ moment
            sums["kinetic"] += 0.5 * w @ body @ w
            sums["power"] += w @ moment
            sums["angular"] += R.c[0, -1] @ body @ w

        def wheels(inertias, R, axis, rate, acceleration):
            """Wheels (k,) that turn by a rate (b, k) about an axis fixed in R."""
            W, dW = spin(R)
            w, axis = W[-1], np.array(axis)
            own = W @ axis
            total = own[:, None] + rate
            change = dW[-1] @ axis + acceleration
            spins = inertias @ total[-1]
            sums["force"] += total[:-1] @ (inertias * change) + W[:-1] @ np.cross(w, axis) * spins
            sums["kinetic"] += 0.5 * inertias @ total[-1] ** 2
            sums["power"] += inertias @ (total[-1] * change)
            sums["angular"] += R.c[0, -1] @ axis * spins

        frames = self.frames(q, delta)
        for i, (joint, link) in enumerate(zip(self.arm.joints, self.arm.links, strict=True)):
            carrier, R, p = frames[i]
            masses(np.array([joint.motor_mass]), p[:, None])
            inertia(joint.hub_inertia * np.outer(joint.axis, joint.axis), R)
            turns = joint.gear_ratio * q.c[..., i : i + 1]
            wheels(np.array([joint.rotor_inertia]), carrier, joint.axis, turns[1], 2 * turns[2, -1])
            at, weights = along(link)
            y, zz, twist = self._shape(i, delta, at)
            x = link.length * at - self._shortening(i, delta, at)
            local = rows(x, y, zz) + np.array(link.root)
            points = p[:, None] + local @ transposed(R)
            masses(link.mass * weights * link.factor("mass", at), points)
            polar = link.polar_inertia_per_length * link.length * weights
            polar = polar * link.factor("polar", at)
            wheels(polar, R, (1.0, 0.0, 0.0), twist.c[1], 2.0 * twist.c[2, -1])
            for body in link.bodies:
                place, turn = self.section(i, delta, body.position / link.length)
                own = R @ turn
                centre = p + turned(R, place) + turned(own, body.offset)
                masses(np.array([body.mass]), centre[:, None])
                inertia(np.array(body.inertia), own)
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
            at, weights = along(link)
            stiffness = {
                d: link.stiffness.get(d, 0.0) * link.factor(d, at) for d in ("y", "z", "twist")
            }
            by, bz, _ = self._shape(i, delta, at, 2)
            sy, sz, turn = self._shape(i, delta, at, 1)
            ky2, kz2 = by * by, bz * bz
            if level_of(self.arm) == "finite slope":
                # Tangent by a about z, then b: curvatures b' and a' cos b, along the axis's own length.
                c = 1.0 - sz * sz
                root = (sy / c.sqrt()) * (sy / c.sqrt())
                db = bz / c.sqrt()
                da = (by / c.sqrt() + sy * sz * bz / (c * c.sqrt())) / (1.0 - root).sqrt()
                ky2, kz2 = da * da * c, db * db
            density = stiffness["y"] * ky2 + stiffness["z"] * kz2 + stiffness["twist"] * turn * turn
            energy = energy + Jet(0.5 * link.length * density.c @ weights)
        return energy.c[0, -1], energy.c[1, :-1], energy.c[1, -1]

    def damping(self):
        """Modal damping of all links, from the model's data."""
        data = self.model.data
        return block_diag(*(D[:k, :k] for D, k in zip(data.damping, data.count, strict=True)))


def coordinates(state):
    """(q, delta) and its rate."""
    q, delta, qd, delta_d = state
    return np.concatenate([q, delta]), np.concatenate([qd, delta_d])


def close(ours, theirs, tolerance, what="", scale=None):
    """Assert agreement relative to the largest entry, or to a scale given."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    scale = np.abs(theirs).max(initial=0.0) if scale is None else scale
    error = np.abs(ours - theirs).max(initial=0.0)
    assert error <= tolerance * scale, f"{what}: {error / scale:.2e} of {scale:.2e}"


arms = {"seed": seeds, "layout": layouts(), "level": st.sampled_from(LEVELS)}


@examples
@given(**arms)
@pytest.mark.slow
def test_forces_are_those_of_a_second_derivation(seed, layout, level):
    arm = random_arm(seed, layout, level)
    chain, rng = Chain(arm), np.random.default_rng(seed)
    n, reference = chain.n_joints, Reference(chain)
    state = q, delta, qd, delta_d = random_state(seed, arm)
    z, zd = coordinates(state)
    damping = np.append(np.zeros(n), reference.damping() @ delta_d)
    friction = np.append(chain.friction(qd), np.zeros(delta.size))
    elastic = reference.elastic(z, zd)[1]
    # Everything, and each part of it with the larger ones left out.
    for speed, acceleration, deflected in ((1, 1, 1), (1, 0, 1), (0, 0, 1), (1, 0, 0), (0, 1, 0)):
        zdd = acceleration * 10.0 * rng.standard_normal(z.size)
        at = np.append(q, deflected * delta)
        sums = reference.motion(at, speed * zd, zdd)
        theirs = sums["force"] + sums["gravity"] + deflected * elastic
        theirs = theirs + speed * (damping + friction)
        motion = q, speed * qd, zdd[:n], deflected * delta, speed * delta_d, zdd[n:]
        ours = chain.inverse_dynamics(*motion)
        close(ours, theirs, 1e-11, f"{speed, acceleration, deflected}")
        close(ArmModel.inverse_dynamics(chain, *motion), theirs, 1e-11, "by the terms of (2)")
        close(ArmModel.mass_matrix(chain, q, delta), chain.mass_matrix(q, delta), 1e-14, "M")


@examples
@given(**arms)
@pytest.mark.slow
def test_energies_and_momenta_are_sums_over_all_that_has_mass(seed, layout, level):
    arm = random_arm(seed, layout, level)
    chain = Chain(arm)
    reference, state = Reference(chain), random_state(seed, arm)
    q, delta, qd, delta_d = state
    z, zd = coordinates(state)
    sums, elastic = reference.motion(z, zd, 0.0 * z), reference.elastic(z, zd)[0]
    assert chain.kinetic_energy(q, qd, delta, delta_d) == pytest.approx(sums["kinetic"], rel=1e-12)
    potential = chain.potential_energy(q, delta)
    assert abs(potential - sums["weight"] - elastic) < 1e-12 * (elastic + abs(sums["weight"]) + 10)
    linear, angular = chain.momentum(q, qd, delta, delta_d)
    close(linear, sums["linear"], 1e-12, "linear momentum")
    close(angular, sums["angular"], 1e-12, "angular momentum")


@examples
@given(**arms)
@pytest.mark.slow
def test_energy_changes_by_the_work_of_torque_damping_and_friction(seed, layout, level):
    """The rate of energy is exact: no difference of energies is taken."""
    arm = random_arm(seed, layout, level)
    chain = Chain(arm)
    n, reference = chain.n_joints, Reference(chain)
    state = random_state(seed, arm)
    (z, zd), qd, delta_d = coordinates(state), *state[2:]
    torque = 5.0 * np.random.default_rng(seed).standard_normal(n)
    rates = chain.derivative(np.concatenate([z, zd]), torque)
    np.testing.assert_array_equal(rates[: z.size], zd)
    sums = reference.motion(z, zd, rates[z.size :])
    stored = (sums["power"], zd @ sums["gravity"], reference.elastic(z, zd)[2])
    damped = delta_d @ reference.damping() @ delta_d
    lost = sum(
        v * (j.friction.viscous * v + j.friction.coulomb * np.tanh(v / j.friction.smoothing))
        for j, v in zip(arm.joints, qd, strict=True)
    )
    assert damped >= 0.0 and lost > 0.0
    scale = sum(map(abs, stored)) + abs(torque @ qd) + damped + lost
    assert abs(sum(stored) - (torque @ qd - damped - lost)) < 1e-11 * scale


@examples
@given(**arms)
def test_forward_dynamics_solve_what_the_terms_say(seed, layout, level):
    arm = random_arm(seed, layout, level)
    chain = Chain(arm)
    n = chain.n_joints
    q, delta, qd, delta_d = random_state(seed, arm)
    torque = np.append(np.random.default_rng(seed).standard_normal(n), np.zeros(delta.size))
    t = chain.terms(q, qd, delta, delta_d)
    scale = np.sqrt(np.diag(t.M))
    close(t.M, t.M.T, 1e-13, "M symmetric")
    assert np.linalg.eigvalsh(t.M / np.outer(scale, scale)).min() > 1e-9
    close((t.H @ t.M) * np.outer(scale, 1.0 / scale), np.eye(scale.size), 1e-9, "H M")
    f, C, K = (np.concatenate(pair) for pair in ((t.f1, t.f2), (t.C1, t.C2), (t.K1, t.K2)))
    whole = chain.forces(q, qd, delta, delta_d)
    friction = np.append(chain.friction(qd), np.zeros(delta.size))
    close(f + C @ delta_d + K @ delta, whole + friction, 1e-12, "f + C delta_d + K delta")
    state = np.concatenate([q, delta, qd, delta_d])
    accelerations = chain.derivative(state, torque[:n])[n + delta.size :]
    left, right = t.M @ accelerations, torque - whole - friction
    size = np.abs(t.M) @ np.abs(accelerations) + np.abs(right)
    assert (np.abs(left - right) <= 1e-10 * size).all()


@pytest.mark.parametrize("level", LEVELS)
def test_terms_are_the_derivatives_of_the_forces_at_the_straight_arm(level):
    """C and K against differences of eighth order."""
    arm = random_arm(11, [FULL, {}, FULL], level)
    chain = Chain(arm)
    q, delta, qd, delta_d = random_state(12, arm)
    t, zero, unit_steps = chain.terms(q, qd), np.zeros(chain.n_modes), np.eye(chain.n_modes)
    K = derivative(lambda x: chain.forces(q, qd, x, zero), zero, 2e-3 * unit_steps)
    C = derivative(lambda x: chain.forces(q, qd, zero, x), zero, unit_steps)
    close(np.vstack([t.K1, t.K2]), K / 2e-3, 1e-9, "K")
    close(np.vstack([t.C1, t.C2]), C, 1e-11, "C")
    assert np.abs(t.C1).max() > 0.1 and np.abs(t.K1).max() > 0.1
    bent = chain.terms(q, qd, delta, delta_d)
    for name in ("C1", "C2", "K1", "K2"):
        np.testing.assert_array_equal(getattr(bent, name), getattr(t, name), err_msg=name)
    K, C = chain.linearisation(q, qd, delta, delta_d)
    there = derivative(lambda x: chain.forces(q, qd, x, delta_d), delta, 1e-3 * unit_steps)
    close(K, there / 1e-3, 1e-9, "K of the bent arm")
    there = derivative(lambda x: chain.forces(q, qd, delta, x), delta_d, unit_steps)
    close(C, there, 1e-11, "C of the bent arm")


def derivative(function, at, steps):
    """Changes of a function along each of `steps`, by central differences of eighth order; last axis: step."""
    weights = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
    return np.stack(
        [
            sum(w * (function(at + k * s) - function(at - k * s)) for k, w in enumerate(weights, 1))
            for s in steps
        ],
        axis=-1,
    )


# --- momentum ----------------------------------------------------------------------------------


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("torque", [0.0, 1.7])
@pytest.mark.slow
def test_angular_momentum_about_the_first_joint_changes_by_its_torque_alone(level, torque):
    """Along the flow, by differences of eighth order.

    The first rotor turns faster than its joint: the torque that spins it up and the joint's differ by what
    the gear's housing takes.
    """
    arm = random_arm(21, [FULL, FULL], level, friction=False, gravity=False)
    first = replace(arm.joints[0], origin_xyz=(0.0, 0.0, 0.0))
    arm = replace(arm, joints=(first, *arm.joints[1:]))
    chain = Chain(arm)
    n, m = chain.n_joints, chain.n_modes
    axis = rotation(first.origin_rpy) @ first.axis
    advance = chain.stepper(METHOD)
    start = np.concatenate(random_state(22, arm))
    start = np.concatenate([start[: n + m], start[n + m :]])
    torques = np.array([torque, -0.8])
    spare = first.rotor_inertia * (first.gear_ratio**2 - first.gear_ratio)

    def momentum(t):
        state = start.copy()
        if t[0]:
            advance(state, torques, t[0] / 10, 10)
        q, delta, qd, delta_d = np.split(state, [n, n + m, 2 * n + m])
        return axis @ chain.momentum(q, qd, delta, delta_d)[1] + spare * qd[0]

    step = 1e-3
    rate = derivative(momentum, np.zeros(1), [np.array([step])])[0] / step
    about_others = np.abs(chain.forces(*np.split(start, [n, n + m, 2 * n + m])[::2], start[n:n + m],
                                       start[2 * n + m:])).max()  # fmt: skip
    assert about_others > 1.0  # forces are at work
    assert rate == pytest.approx(torque, abs=1e-9 * about_others)


# --- kinematics --------------------------------------------------------------------------------


@pytest.mark.long
@examples
@given(**arms, link=st.integers(0, 4), where=st.floats(0.0, 1.0))
def test_points_turn_and_move_as_in_the_second_derivation(seed, layout, level, link, where):
    arm = random_arm(seed, layout, level)
    chain, i = Chain(arm), link % len(layout)
    name, position = arm.links[i].name, where * arm.links[i].length
    offset = np.random.default_rng(seed).uniform(-0.2, 0.2, 3)
    state = q, delta, qd, delta_d = random_state(seed, arm)
    z, zd = coordinates(state)
    reference = Reference(chain)
    jets = reference._motion(z, zd, 0.0 * z)
    frames = reference.frames(*jets)
    _, R, p = frames[i]
    place, turn = reference.section(i, jets[1], where)
    point, turn = p + turned(R, place) + turned(R @ turn, offset), R @ turn
    close(chain.point(name, position, q, delta, offset), point.c[0, -1], 1e-12, "point")
    angular = np.einsum("bij,bj->bi", turn.c[0], spin(turn)[0])
    theirs = np.concatenate([point.c[1], angular], axis=1)
    close(chain.jacobian(name, position, q, delta, offset), theirs[:-1].T, 1e-9, "jacobian")
    ours = chain.velocity(name, position, q, qd, delta, delta_d, offset)
    close(ours, theirs[-1], 1e-9, "velocity")
    R, p = chain.frames(q, delta)
    for k, (_, Rk, pk) in enumerate(frames):
        close(R[k], Rk.c[0, -1], 1e-12, f"R[{k}]")
        close(p[k], pk.c[0, -1], 1e-12, f"p[{k}]", scale=1.0)
    ends = [
        pk.c[0, -1] + Rk.c[0, -1] @ reference.section(k, jets[1], 1.0)[0].c[0, -1]
        for k, (_, Rk, pk) in enumerate(frames[:-1])
    ]
    close(chain.link_ends(q, delta), ends, 1e-12, "ends")
    close(chain.tip_position(q, delta), ends[-1], 1e-12, "tip")
    close(
        chain.tip_velocity(q, qd, delta, delta_d), frames[-1][2].c[1, -1], 1e-11, "tip's velocity"
    )


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.slow
def test_jacobians_are_the_derivatives_of_points_and_frames(level):
    """By differences of the model's own points and frames."""
    arm = random_arm(41, [FULL, {}, FULL], level)
    chain, rng = Chain(arm), np.random.default_rng(42)
    n, m = chain.n_joints, chain.n_modes
    steps = 1e-2 * np.eye(n + m) * np.append(np.ones(n), np.full(m, 0.1))[:, None]
    scale = steps.sum(axis=0)
    for i, link in enumerate(arm.links):
        q, delta, qd, delta_d = random_state(43 + i, arm)
        z, zd = np.append(q, delta), np.append(qd, delta_d)
        for position in (rng.uniform() * link.length, link.length):
            offset = rng.uniform(-0.2, 0.2, 3)
            J = chain.jacobian(link.name, position, q, delta, offset)
            moved = derivative(
                lambda z, link=link, x=position, o=offset: chain.point(link.name, x, z[:n], z[n:], o),
                z, steps,
            )  # fmt: skip
            close(J[:3], moved / scale, 1e-9, "point")
            np.testing.assert_allclose(
                chain.velocity(link.name, position, q, qd, delta, delta_d, offset),
                J @ zd,
                rtol=1e-15,
            )
    R = chain.frames(z[:n], z[n:])[0]
    turns = derivative(lambda z: chain.frames(z[:n], z[n:])[0], z, steps) / scale
    for i, link in enumerate(arm.links):
        at_base = chain.jacobian(link.name, 0.0, z[:n], z[n:])[3:]
        at_tip = chain.jacobian(link.name, link.length, z[:n], z[n:])[3:]
        close(at_base, vee(np.moveaxis(turns[i], -1, 0) @ R[i].T).T, 1e-9, "base")
        if i == n - 1:
            close(at_tip, vee(np.moveaxis(turns[n], -1, 0) @ R[n].T).T, 1e-9, "tip")


def test_tip_deflection_is_across_the_links_own_base():
    arm = random_arm(61, [FULL, {}, {"z": (2, "loaded")}], "foreshortening")
    chain = Chain(arm)
    q, delta, _, _ = random_state(62, arm)
    R, p = chain.frames(q, delta)
    ends = chain.link_ends(q, delta)
    for i, name in enumerate(("link1", "link2", "link3")):
        across = (R[i].T @ (ends[i] - p[i]))[1:]
        np.testing.assert_allclose(chain.tip_deflection(delta, name), across, atol=1e-14)
    np.testing.assert_array_equal(chain.tip_deflection(delta), chain.tip_deflection(delta, "link3"))
    assert np.abs(chain.tip_deflection(delta, "link1")).min() > 1e-4
    assert not chain.tip_deflection(delta, "link2").any()


def test_base_angles_of_a_planar_arm_add_up_joints_and_tip_slopes():
    """Axes that look either way; the angles count beyond a turn."""
    joints = (
        Joint("joint1", axis=(0.0, 0.0, 1.0), origin_rpy=(0.4, 0.1, -0.3)),
        Joint("joint2", axis=(0.0, 0.0, -1.0), origin_rpy=(0.0, 0.0, 0.5)),
        Joint("joint3", axis=(0.0, 0.0, 1.0)),
    )
    link = Link("link1", 0.8, 0.3, {"y": 4.0}, {"y": Flexibility(2)})
    links = (link, replace(link, name="link2"), replace(link, name="link3"))
    chain = Chain(Arm("planar", joints, links))
    q, delta = np.array([7.0, -0.4, 2.9]), 0.03 * np.array([1.0, -0.3, 0.8, 0.2, 0.5, 0.1])
    slope = chain.mode_shapes("link1", "y")(1.0, 1) / 0.8
    first, second = slope @ delta[:2], slope @ delta[2:4]
    turned_by = [7.0, 7.0 + first + 0.4, 7.0 + first + 0.4 + second + 2.9]
    np.testing.assert_allclose(
        chain.base_angles(q, delta) * [1.0, -1.0, 1.0], turned_by, atol=1e-12
    )
    assert Chain(random_arm(1, [{}, {}])).planar_axis is None


# --- one source, run three ways ----------------------------------------------------------------

MIXED = [{"y": (2, "loaded"), "twist": (1, "loaded")}, {"z": (2, "clamped_free")}]


@pytest.mark.parametrize("level", LEVELS)
def test_compiled_and_plain_kernels_agree(level):
    arm = random_arm(71, MIXED, level)
    compiled, plain = Chain(arm), Chain(arm, compiled=False)
    assert plain.straight_line is None
    q, delta, qd, delta_d = random_state(72, arm)
    state, torque = np.concatenate([q, delta, qd, delta_d]), np.array([1.2, -0.7])

    def everything(chain):
        yield "derivative", chain.derivative(state, torque)
        yield "mass matrix", chain.mass_matrix(q, delta)
        yield "forces", chain.forces(q, qd, delta, delta_d)
        yield "K", chain.linearisation(q, qd, delta, delta_d)[0]
        yield "C", chain.linearisation(q, qd, delta, delta_d)[1]
        yield "potential energy", chain.potential_energy(q, delta)
        yield "linear momentum", chain.momentum(q, qd, delta, delta_d)[0]
        yield "angular momentum", chain.momentum(q, qd, delta, delta_d)[1]
        yield "R", chain.frames(q, delta)[0]
        yield "p", chain.frames(q, delta)[1]
        yield "point", chain.point("link1", 0.2, q, delta, (0.01, 0.02, 0.03))
        yield "jacobian", chain.jacobian("link2", 0.2, q, delta, (0.01, 0.02, 0.03))
        for name, method in (("euler", EULER), ("dop853", METHOD), ("implicit", None)):
            moved = state.copy()
            chain.stepper(method, straight_line=False)(moved, torque, 1e-4, 3, change=0.1 * torque)
            yield name, moved

    for (name, one), (_, other) in zip(everything(compiled), everything(plain), strict=True):
        close(one, other, 1e-12, name)


SIMPLE = Arm(
    "simple",
    (Joint("joint1"), Joint("joint2", hub_inertia=1.0, motor_mass=1.0, rotor_inertia=1.0)),
    (
        Link("link1", 1.0, 1.0, {"y": 1.0}, {"y": Flexibility(1)}),
        Link("link2", 1.0, 2.0, {"y": 1.0}, {"y": Flexibility(1, "loaded")}),
    ),
)
#: Constants that happen to be zero or one leave no trace in straight-line code.
STRUCTURES = {
    "mixed": random_arm(75, MIXED),
    "simple": SIMPLE,
    "simple with payload": replace(
        SIMPLE, payload=Payload(1.0, tuple(map(tuple, np.eye(3)))), gravity=(0.0, -1.0, 0.0)
    ),
    "turned axes": replace(
        SIMPLE,
        joints=(
            Joint("joint1", axis=(1.0, 0.0, 0.0), hub_inertia=1.0),
            Joint("joint2", axis=(0.0, -1.0, 0.0), origin_xyz=(0.0, 1.0, 0.0), gear_ratio=-1.0),
        ),
        payload=Payload(1.0),
    ),
}


def stepped_accelerations(chain, states, torques, **options):
    """Yield each state's accelerations in a compiled stepper and by `derivative`.

    One step of Euler's method with a step of one second adds the accelerations to the state.
    """
    advance = chain.stepper(EULER, **options)
    for state, torque in zip(states, torques, strict=True):
        after = state.copy()
        advance(after, torque, 1.0)
        yield after - state, chain.derivative(state, torque)


LOOPS = {level: (random_arm(73, MIXED, level), False) for level in LEVELS}
CODES = {**LOOPS, **{name: (arm, True) for name, arm in STRUCTURES.items()}}
CODES |= {f"generated, {level}": (at_level(SIMPLE, level), True) for level in LEVELS[1:]}
CODES["generated, both ways"] = (
    random_arm(74, [{"y": (2, "loaded"), "z": (1, "loaded")}, {}], LEVELS[2]),
    True,
)


@pytest.mark.parametrize("name", CODES)
@pytest.mark.slow
def test_steppers_have_the_accelerations_of_the_model(name):
    """The recursion in loops at each level, and straight-line code for each structure."""
    arm, straight = CODES[name]
    chain = Chain(arm)
    if straight:
        assert chain.straight_line[0].__name__.startswith("flexarm_generated_")
    states = [np.concatenate(random_state(seed, arm)) for seed in range(10)]
    torques = np.random.default_rng(76).standard_normal((10, 2))
    for found, expected in stepped_accelerations(chain, states, torques, straight_line=straight):
        close(found, expected, 1e-12)


@settings(examples, max_examples=15)
@given(
    seeds,
    layouts(most=2),
    st.lists(st.sampled_from(["gravity", "axis", "origin", "rotor", "hub"])),
    st.sampled_from(LEVELS[:2]),
)
def test_straight_line_code_of_any_structure(seed, layout, plain, level):
    """Before it is compiled: it is Python. `plain`: what is left at nought or along an axis."""
    arm = random_arm(seed, layout, level, friction=False, gravity="gravity" not in plain)
    changes = {}
    if "axis" in plain:
        changes["axis"] = (0.0, 0.0, 1.0)
    if "origin" in plain:
        changes.update(origin_xyz=(0.0, 0.0, 0.0), origin_rpy=(0.0, 0.0, 0.0))
    if "rotor" in plain:
        changes.update(rotor_inertia=0.0, gear_ratio=1.0, motor_mass=0.0)
    if "hub" in plain:
        changes["hub_inertia"] = 1.0
    arm = replace(arm, joints=tuple(replace(joint, **changes) for joint in arm.joints))
    chain = Chain(arm)
    way = generated.ways(chain.data)[0]
    room = work_space(chain.data, object)
    program, constants, _ = generated.right_hand_side(chain.data, room, way)
    state = np.concatenate(random_state(seed, arm))
    torque = np.random.default_rng(seed).standard_normal(chain.n_joints)
    expected = chain.derivative(state, torque)
    c, m = (constants, ()) if way == generated.NONE else constants
    out = np.array(native.run(program, x=state, u=torque, c=c, m=m))
    # A joint about a light link's own axis makes the equations ill-conditioned.
    M = chain.mass_matrix(*np.split(state, [chain.n_joints, state.size // 2])[:2])
    scale = np.sqrt(np.diag(M))
    close(out, expected, 1e-14 * np.linalg.cond(M / np.outer(scale, scale)) + 1e-12)


def test_arms_of_one_structure_share_their_code_and_keep_their_own_constants():
    arm = STRUCTURES["mixed"]
    one, other = Chain(arm), Chain(replace(arm, gravity=tuple(1.3 * g for g in arm.gravity)))
    different = Chain(replace(arm, gravity=(0.0, *arm.gravity[1:])))
    (code, ones), (same, others) = one.straight_line, other.straight_line
    assert code is same and code.__name__ != different.straight_line[0].__name__
    assert ones.shape == others.shape and not np.array_equal(ones, others)
    states, torques = [np.concatenate(random_state(77, arm))], np.array([[1.0, 2.0]])
    for chain in (one, other, one):
        for found, expected in stepped_accelerations(chain, states, torques):
            close(found, expected, 1e-12)


def test_long_equations_stay_in_loops(monkeypatch):
    operations = generated.right_hand_side(*_recorded(Chain(SIMPLE)))[2]
    for limit in (operations - 1, operations):
        monkeypatch.setattr(generated, "MAX_OPERATIONS", limit)
        assert (Chain(SIMPLE).straight_line is None) == (limit < operations)


def _recorded(chain):
    """What `generated.right_hand_side` takes of a chain."""
    data = chain.data
    return data, work_space(data, object), generated.ways(data)[0]


@pytest.mark.parametrize("level", LEVELS[1:])
def test_arms_of_one_structure_share_their_code_at_every_level(level):
    arm = at_level(SIMPLE, level)
    longer = replace(arm, links=tuple(replace(link, length=1.3) for link in arm.links))
    (code, ones), (same, others) = (
        Chain(a).straight_line for a in (arm, replace(arm, name="same"))
    )
    assert code is same
    assert all(np.array_equal(*both) for both in zip(ones, others, strict=True))
    state, torques = np.concatenate(random_state(77, arm)), np.array([[1.0, 2.0]])
    for chain in (Chain(arm), Chain(longer), Chain(arm)):
        for found, expected in stepped_accelerations(chain, [state], torques):
            close(found, expected, 1e-12)


# --- foreshortening and finite slopes ----------------------------------------------------------


def one_beam(level, flexible, axis=(0.0, 0.0, 1.0), payload=None, hub=0.1, length=0.9):
    """One link of unit-like data on one joint."""
    stiffness = {"y": 6.5, "z": 4.5, "twist": 2.0}
    link = Link("link1", length, 0.31, stiffness, flexible, polar_inertia_per_length=2e-3)
    arm = Arm("beam", (Joint("joint1", axis, hub_inertia=hub),), (link,), payload or Payload())
    return Chain(at_level(arm, level))


BENT = np.array([0.05, -0.01, 0.004, 0.04, 0.012, -0.003])  # y and z, three modes each


@pytest.mark.parametrize("level", LEVELS)
def test_how_far_the_axis_keeps_its_length(level):
    """|dr/dx| - 1 with slope squared u: u/2 at first order, u^2/8 with foreshortening, nothing beyond."""
    bending = Flexibility(3)
    chain = one_beam(level, {"y": bending, "z": bending})
    q, L = np.zeros(1), 0.9
    worst = 0.0
    for xi in (0.1, 0.33, 0.5, 0.77, 0.95):
        slopes = [chain.mode_shapes("link1", d)(xi, 1) / L @ BENT[k : k + 3]
                  for d, k in (("y", 0), ("z", 3))]  # fmt: skip
        u = slopes[0] ** 2 + slopes[1] ** 2
        step = 2e-3
        tangent = derivative(
            lambda x: chain.point("link1", x[0], q, BENT), np.array([xi * L]), [np.array([step])]
        )[:, 0] / step  # fmt: skip
        stretch = np.linalg.norm(tangent) - 1.0
        exact = {"first order": np.sqrt(1.0 + u), "foreshortening": np.sqrt(1.0 + u * u / 4.0)}
        assert stretch == pytest.approx(exact.get(level, 1.0) - 1.0, abs=1e-9)
        worst = max(worst, u)
    assert worst > 0.05


def test_tip_angle_and_bending_energy_of_finite_slopes():
    chain = one_beam("finite slope", {"y": Flexibility(2, "loaded")})
    shapes, L, EI = chain.mode_shapes("link1", "y"), 0.9, 6.5
    for delta in ([0.08, 0.01], [-0.1, 0.02], [0.2, -0.01]):
        R = chain.frames(np.array([0.3]), np.array(delta))[0][-1]
        slope = shapes(1.0, 1) @ delta / L
        assert np.arctan2(R[1, 0], R[0, 0]) - 0.3 == pytest.approx(np.arcsin(slope), abs=1e-13)
        first, second = shapes(XI, 1) @ delta / L, shapes(XI, 2) @ delta / L**2
        energy = 0.5 * EI * L * WEIGHTS @ (second**2 / (1.0 - first**2))
        ours = chain.potential_energy(np.zeros(1), np.array(delta))
        assert ours == pytest.approx(energy, rel=1e-8)
        assert ours > 1.001 * 0.5 * np.array(delta) @ chain.stiffness_matrix() @ delta


def test_a_beam_that_bends_both_ways_does_not_twist():
    """Its tip against a frame carried along the axis without turning about it, by its differential equation.

    The rotation that two slopes make is of second order; the model takes it to that: halving the deflection
    divides the error by 16, and not by four.
    """
    bending = Flexibility(3)
    L, errors, without = 0.9, [], []
    chain = one_beam("finite slope", {"y": bending, "z": bending})
    y, z = (chain.mode_shapes("link1", d) for d in "yz")
    for size in (1.0, 0.5):
        delta = size * np.array([0.05, -0.01, 0.004, 0.04, 0.02, 0.006])

        def rate(x, frame, delta=delta):
            sy, sz = y(x / L, 1) @ delta[:3] / L, z(x / L, 1) @ delta[3:] / L
            by, bz = y(x / L, 2) @ delta[:3] / L**2, z(x / L, 2) @ delta[3:] / L**2
            along = np.sqrt(1.0 - sy**2 - sz**2)
            tangent = np.array([along, sy, sz])
            change = np.array([-(sy * by + sz * bz) / along, by, bz])
            return -(frame @ change) * tangent

        carried = solve_ivp(rate, (0.0, L), [0.0, 1.0, 0.0], rtol=1e-11, atol=1e-13).y[:, -1]
        R = chain.frames(np.zeros(1), delta)[0][-1]
        errors.append(np.arctan2(carried @ R[:, 2], carried @ R[:, 1]))
        # y after Rz(a) Ry(-b), with no turn about the tangent
        a = np.arctan2(R[1, 0], R[0, 0])
        without.append(np.arcsin(carried @ np.cross(R[:, 0], [-np.sin(a), np.cos(a), 0.0])))
    assert abs(without[0]) > 20.0 * abs(errors[0]) > 1e-5
    assert 14.0 < errors[0] / errors[1] < 18.0
    assert 3.5 < without[0] / without[1] < 4.5


#: First flapping frequency of a uniform cantilever on a hub of no radius, Wright, Smith, Thresher and Wang
#: (1982), J. Applied Mechanics 49, table 1: angular speed and frequency in units of sqrt(EI/(rho A L^4)).
FLAPPING = {0: 3.5160, 1: 3.6816, 2: 4.1373, 3: 4.7973, 6: 7.3604, 10: 11.2023}


def spun_finite_elements(speed, elements=40):
    """First flapping frequency by Hermite elements with the tension (1 - x^2) speed^2 / 2; all dimensionless."""
    h, xi = 1.0 / elements, 0.5 * (leggauss(6)[0] + 1.0)
    w = 0.5 * leggauss(6)[1]
    N = np.array([1 - 3 * xi**2 + 2 * xi**3, h * (xi - 2 * xi**2 + xi**3),
                  3 * xi**2 - 2 * xi**3, h * (xi**3 - xi**2)])  # fmt: skip
    N1 = np.array([6 * xi**2 - 6 * xi, h * (1 - 4 * xi + 3 * xi**2), 6 * xi - 6 * xi**2,
                   h * (3 * xi**2 - 2 * xi)]) / h  # fmt: skip
    N2 = np.array([12 * xi - 6, h * (6 * xi - 4), 6 - 12 * xi, h * (6 * xi - 2)]) / h**2
    M, K = np.zeros((2, 2 * elements + 2, 2 * elements + 2))
    for e in range(elements):
        block = np.s_[2 * e : 2 * e + 4, 2 * e : 2 * e + 4]
        tension = 0.5 * speed**2 * (1.0 - (h * (e + xi)) ** 2)
        M[block] += h * (N * w) @ N.T
        K[block] += h * ((N2 * w) @ N2.T + (N1 * w * tension) @ N1.T)
    return np.sqrt(eigh(K[2:, 2:], M[2:, 2:], eigvals_only=True)[0])


@pytest.mark.parametrize("speed", FLAPPING)
@pytest.mark.parametrize("level", LEVELS)
def test_a_spinning_beam_stiffens_as_published(level, speed):
    """Southwell: flapping (z, along the axis) and lagging (y, where the square of the speed comes off)."""
    chain = one_beam(level, {"y": Flexibility(4), "z": Flexibility(4)})
    assert spun_finite_elements(speed) == pytest.approx(FLAPPING[speed], abs=6e-5)
    link, found = chain.arm.links[0], {}
    M = chain.mass_matrix(np.zeros(1))[1:, 1:]
    for d, block in (("y", np.s_[:4]), ("z", np.s_[4:])):
        unit_speed = np.sqrt(link.stiffness[d] / link.mass_per_length) / link.length**2
        K = chain.terms(np.zeros(1), np.array([speed * unit_speed])).K2
        square = eigh(K[block, block], M[block, block], eigvals_only=True)[0] / unit_speed**2
        found[d] = np.sign(square) * np.sqrt(abs(square))
    if level == "first order":
        slack = 3.516015**2 - speed**2
        assert found["z"] == pytest.approx(3.516015, abs=1e-6)  # knows nothing of the speed
        assert found["y"] == pytest.approx(np.sign(slack) * np.sqrt(abs(slack)), abs=1e-6)
        return
    assert found["z"] == pytest.approx(spun_finite_elements(speed), rel=1e-5 * (1 + speed**2))
    assert found["z"] > spun_finite_elements(speed) - 1e-6  # Rayleigh-Ritz
    assert found["y"] == pytest.approx(np.sqrt(found["z"] ** 2 - speed**2), rel=1e-9)


def test_a_tip_mass_stiffens_a_spinning_beam_in_rayleighs_quotient():
    """Tension of payload and beam on one mode: k + W^2 int int T y'^2, and less W^2 m in the plane of spin."""
    payload = Payload(0.2)
    for level in LEVELS[1:]:
        chain = one_beam(level, {"y": Flexibility(1), "z": Flexibility(1)}, payload=payload)
        W, link = 4.0, chain.arm.links[0]
        L, rho = link.length, link.mass_per_length
        tension = W**2 * (0.5 * rho * L**2 * (1.0 - XI**2) + payload.mass * L)
        for k, d in enumerate("yz"):
            shape = chain.mode_shapes("link1", d)
            stiff = WEIGHTS @ (tension * shape(XI, 1)[:, 0] ** 2) / L
            mass = rho * L + payload.mass * shape(1.0)[0] ** 2
            elastic = link.stiffness[d] / L**3 * shape.gram(2)[0, 0]
            expected = elastic + stiff - (W**2 * mass if d == "y" else 0.0)
            found = chain.terms(np.zeros(1), np.array([W])).K2[k, k]
            assert found == pytest.approx(expected, rel=1e-10)
            assert stiff > 0.05 * elastic


# --- twist -------------------------------------------------------------------------------------


TIP = Payload(0.0, ((3e-3, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))


@pytest.mark.slow
def test_torsional_frequencies_of_a_held_bar():
    """Without a load, and with one."""
    for shape in ("clamped_free", "loaded"):
        chain = one_beam("first order", {"twist": Flexibility(4, shape)}, (1.0, 0.0, 0.0))
        exact = (np.arange(4) + 0.5) * np.pi / 0.9 * np.sqrt(2.0 / 2e-3)
        np.testing.assert_allclose(chain.frequencies(locked=True), exact, rtol=1e-12)
    ratio = 3e-3 / (2e-3 * 0.9)
    beta = [brentq(lambda b: np.cos(b) - ratio * b * np.sin(b), lo, lo + 0.5 * np.pi)
            for lo in np.pi * np.arange(3)]  # fmt: skip
    exact = np.array(beta) / 0.9 * np.sqrt(2.0 / 2e-3)
    chain = one_beam("first order", {"twist": Flexibility(3, "loaded")}, (1, 0, 0), TIP)
    np.testing.assert_allclose(chain.frequencies(locked=True), exact, rtol=1e-12)
    errors = []
    for modes in (1, 2, 4, 8):
        free = one_beam("first order", {"twist": Flexibility(modes)}, (1, 0, 0), TIP)
        errors.append(free.frequencies(locked=True)[0] / exact[0] - 1.0)
    assert errors[-1] > 0.0 and np.all(np.diff(errors) < 0.0) and errors[-1] < 0.02


def test_torsional_frequencies_of_a_bar_between_hub_and_load():
    """tan b (1 - r s b^2) = -b (r + s) with hub and load in units of the bar's inertia."""
    r, s = 0.1 / (2e-3 * 0.9), 3e-3 / (2e-3 * 0.9)
    beta = [brentq(lambda b: np.sin(b) * (1 - r * s * b * b) + b * (r + s) * np.cos(b), *ends)
            for ends in ((0.1, 2.0), (2.2, 4.5))]  # fmt: skip
    exact = np.array(beta) / 0.9 * np.sqrt(2.0 / 2e-3)
    errors = []
    for modes in (2, 4, 8):
        chain = one_beam("first order", {"twist": Flexibility(modes, "loaded")}, (1, 0, 0), TIP)
        errors.append(chain.frequencies()[:2] / exact - 1.0)
    errors = np.array(errors)
    assert (errors > -1e-12).all() and (np.diff(errors, axis=0) < 0.0).all()
    assert (errors[-1] < 1e-3).all()


# --- frequencies and damping -------------------------------------------------------------------


def reference_arm(parameters, modes, shape="loaded"):
    """The two-link arm of the reference data."""
    p = parameters["two_link_torque"]
    bending = {"y": Flexibility(modes, shape)}
    return Arm(
        "reference",
        (
            Joint("joint1", hub_inertia=p["Jh1"]),
            Joint("joint2", hub_inertia=p["Jh2"], motor_mass=p["Mm"]),
        ),
        tuple(Link(f"link{i}", p["L"], p["rhoA"], {"y": p["EI"]}, bending) for i in (1, 2)),
        Payload(p["Mp"], tuple(map(tuple, p["Jp"] * np.eye(3)))),
    )


CASES = [f"q2={angle} {how}" for angle in (0, 60, -60, 90) for how in ("locked", "free")]


@pytest.mark.parametrize("case", CASES)
def test_two_link_frequencies_converge_to_the_exact_ones_from_above(frequencies, parameters, case):
    exact = np.array(frequencies["two_link"][case]["rad_s"])
    q = np.array([0.4, np.radians(float(case.split()[0][3:]))])
    errors = {}
    for modes in (2, 4, 8):
        chain = Chain(reference_arm(parameters, modes))
        found = chain.frequencies(q, locked=case.endswith("locked"))
        assert np.all(np.diff(found) > 0.0)
        errors[modes] = found[:4] / exact - 1.0
    assert (errors[2][:2] < 1e-3).all()
    assert (errors[4] < 1e-4).all()
    assert (errors[8] < 1e-6).all()
    assert (np.array(list(errors.values())) > -1e-10).all()  # Rayleigh-Ritz
    for few, more in ((2, 4), (4, 8)):
        assert (errors[more] < np.maximum(0.3 * errors[few], 1e-10)).all()


@pytest.mark.parametrize("level", LEVELS)
def test_what_hangs_on_an_inner_link_shapes_its_modes(frequencies, parameters, level):
    """Its modes without what is beyond the elbow miss by per cents what two loaded ones have in a thousand."""
    for angle in (0, 60, 90):
        q = np.array([0.0, np.radians(angle)])
        exact = np.array(frequencies["two_link"][f"q2={angle} locked"]["rad_s"][:2])
        loaded = Chain(at_level(reference_arm(parameters, 2), level)).frequencies(q, locked=True)
        bare = Chain(at_level(reference_arm(parameters, 2, "clamped_free"), level))
        assert (loaded[:2] / exact - 1.0 < 1e-3).all()
        assert (bare.frequencies(q, locked=True)[:2] / exact - 1.0).max() > 0.01


@pytest.mark.parametrize("direction, shape", [("y", "loaded"), ("z", "clamped_free"), ("twist", "loaded"),
                                              ("y", "from_frequencies"), ("twist", "from_frequencies")])  # fmt: skip
def test_damping_ratios_are_those_of_a_links_own_modes_with_its_load(direction, shape):
    """Of one link those of the locked arm; of inner links, with what hangs on them stretched out."""
    ratios = (0.01, 0.03, 0.002)
    rng = np.random.default_rng(81)
    arm = random_arm(82, [{direction: (3, shape)}], friction=False, gravity=False)
    flexible = {direction: replace(arm.links[0].flexible[direction], damping=ratios)}
    offset = (0.05, 0.0, 0.0) if direction != "twist" else (0.05, 0.02, -0.03)
    payload = Payload(0.3, tuple(map(tuple, np.diag(rng.uniform(1e-3, 5e-3, 3)))), offset)
    chain = Chain(replace(arm, links=(replace(arm.links[0], flexible=flexible),), payload=payload))
    t = chain.terms(np.zeros(1), np.zeros(1))
    M = t.M[1:, 1:]
    state = np.block([[np.zeros((3, 3)), np.eye(3)],
                      [-np.linalg.solve(M, t.K2), -np.linalg.solve(M, t.C2)]])  # fmt: skip
    poles = np.linalg.eigvals(state)
    poles = sorted(poles[poles.imag > 0.0], key=abs)
    np.testing.assert_allclose([-p.real / abs(p) for p in poles], ratios, rtol=1e-8)
    np.testing.assert_allclose(np.abs(poles), chain.frequencies(locked=True), rtol=1e-9)


# --- what it refuses ---------------------------------------------------------------------------


def test_vectors_of_the_wrong_shape_are_refused_by_name():
    chain = Chain(random_arm(91, MIXED))
    sizes = {
        "q": 2,
        "qd": 2,
        "qdd": 2,
        "delta": 5,
        "delta_d": 5,
        "delta_dd": 5,
        "torque": 2,
        "state": 14,
    }
    for call, names in (
        (chain.terms, ("q", "qd", "delta", "delta_d")),
        (chain.forces, ("q", "qd", "delta", "delta_d")),
        (chain.momentum, ("q", "qd", "delta", "delta_d")),
        (chain.inverse_dynamics, ("q", "qd", "qdd", "delta", "delta_d", "delta_dd")),
        (chain.frames, ("q", "delta")),
        (chain.potential_energy, ("q", "delta")),
        (chain.tip_position, ("q", "delta")),
        (chain.mass_matrix, ("q", "delta")),
        (chain.derivative, ("state", "torque")),
    ):
        good = {name: np.zeros(sizes[name]) for name in names}
        call(**good)
        for name in set(names) - {"torque"}:
            for wrong in ((sizes[name] + 1,), (sizes[name], 1)):
                with pytest.raises(ShapeError) as error:
                    call(**{**good, name: np.zeros(wrong)})
                found = error.value.field, error.value.value, error.value.limit
                assert found == (name, wrong, (sizes[name],))


@pytest.mark.parametrize("position", [-1e-9, 0.9 * (1 + 1e-9), np.nan])
def test_a_point_beyond_the_link_is_refused(position):
    chain = one_beam("foreshortening", {"y": Flexibility(1)})
    with pytest.raises(ModelError) as error:
        chain.point("link1", position, np.zeros(1))
    assert (error.value.field, error.value.limit) == ("position on link1", "0 to 0.9 m")
    np.testing.assert_allclose(chain.point("link1", 0.9, np.zeros(1)), [0.9, 0.0, 0.0])


@pytest.mark.parametrize("where", [("link3", "y"), ("link1", "z"), ("link2", "twist")])
def test_mode_shapes_of_an_unknown_link_or_direction_are_refused(where):
    chain = Chain(random_arm(91, MIXED))
    with pytest.raises(ModelError) as error:
        chain.mode_shapes(*where)
    assert error.value.field == f"{where[0]} in {where[1]}"
    assert chain.mode_shapes("link1", "twist").count == 1


def test_a_load_too_heavy_for_loaded_modes_is_refused():
    heavy = Payload(0.31 * 0.9 * 2e10)
    with pytest.raises(ModelError) as error:
        one_beam("first order", {"y": Flexibility(1, "loaded")}, payload=heavy)
    assert error.value.value[0] == pytest.approx(2e10) and error.value.limit == "at most 1e+10"
    one_beam("first order", {"y": Flexibility(1)}, payload=heavy)


@pytest.mark.parametrize(
    "joints", [{"gear_ratio": 2, "rotor_inertia": 1}, {"origin_xyz": (1, 0, 0)}, {}]
)
def test_arms_of_whole_numbers_share_the_compiled_code_of_others(joints):
    def kind(number):
        joint = Joint("joint1", tuple(map(number, (0, 0, 1))), hub_inertia=number(1), **joints)
        link = Link("link1", number(1), number(1), {"y": number(6)}, {"y": Flexibility(1)})
        return Chain(Arm("beam", (joint,), (link,), Payload(number(1))))._data[0].dtype

    assert kind(int) == kind(float)
