# SPDX-License-Identifier: Apache-2.0
"""Computes the constants in `kernels.chain_data` from an arm: mode shapes, loads, modal integrals, work space."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.polynomial import legendre

from ..arm.description import DIRECTIONS, REDUCED
from ..arm.reduced import Shapes
from ..errors import ModelError
from ..kernels import chain_data as kernel
from . import beam, varied_beam
from .model import damping_matrix, rotation

_KIND = {"y": kernel.Y, "z": kernel.Z, "twist": kernel.TWIST, "reduced": kernel.REDUCED}

#: Fields of the kernels' data that are integers.
INTEGERS = (
    *("links", "level", "nodes", "count", "first", "direction", "spring", "housed"),
    *("rooted", "bodies", "host", "body_node", "reduced"),
)


def _shape(spec, sizes):
    return tuple(sizes[word] if isinstance(word, str) else word for word in spec)


def _sizes(links, modes, nodes, bodies, reduced):
    whole = {"N": links, "K": modes, "G": nodes, "B": bodies, "R": reduced}
    return whole | {"N+1": links + 1, "G+1": nodes + 1}


def _capacity(value, steps):
    return next(step for step in (*steps, value) if step >= value)


def roomy(data):
    """Array sizes that many arms share, so that they need only one compilation; unused space costs no time."""
    return _sizes(
        _capacity(data.links, (8, 32)),
        _capacity(data.s.shape[1], (16, 60)),
        _capacity(data.nodes, (92,)),
        _capacity(data.body_x.size, (8, 32)),
        _capacity(len(data.red_tip), (4,)),
    )


def work_space(data, dtype=float, sizes=None):
    """Work space of the recursions for an arm; `dtype` makes it one of complex numbers or of symbols."""
    sizes = sizes or _sizes(
        data.links, data.s.shape[1], data.nodes, data.body_x.size, len(data.red_tip)
    )
    return kernel.Work(
        **{name: np.zeros(_shape(spec, sizes), dtype) for name, spec in kernel.WORK.items()}
    )


def packed(values, specs, sizes):
    """A namedtuple of arrays as an array of one record, which compiled code takes by reference.

    The shapes are part of the record's type, so compiled code passes no single arrays and counts no references to them.
    Arrays are padded with zeros to the given `sizes`. `specs` has the axes of each field, by the names of `sizes`.
    """
    fields = {name: np.asarray(value) for name, value in values._asdict().items()}
    shapes = {name: _shape(specs[name], sizes) for name in fields}
    kind = [(name, field.dtype, shapes[name]) for name, field in fields.items()]
    # No recarray: its attribute look-ups in Python cost more per call than the kernels do.
    record = np.zeros(1, np.dtype(kind, align=True))
    for name, field in fields.items():
        record[name][(0, *(slice(n) for n in field.shape))] = field
    return record


def cumulative(points, ends):
    """Matrix that integrates a function given at Gauss points of [0, 1] from 0 to each of `ends`."""
    values = legendre.legvander(2.0 * points - 1.0, points.size - 1)
    primitives = [legendre.legint(row, lbnd=-1.0) for row in np.eye(points.size)]
    integrals = np.array([legendre.legval(2.0 * ends - 1.0, p) for p in primitives]).T
    return 0.5 * np.linalg.solve(values.T, integrals.T).T


def modes_of(link, shapes):
    """(shapes, number, direction) of each mode of a link, in the order of the arm's modal coordinates."""
    return [
        (shapes[link.name, direction], i, direction)
        for direction in DIRECTIONS
        if direction in link.flexible
        for i in range(link.flexible[direction].modes)
    ]


@dataclass(frozen=True)
class Load:
    """A rigid body in a frame: its mass, first moment and inertia about the frame's origin.

    Attributes
    ----------
    averaged : bool
        Whether it turns about the next joint; then the load of a beam does not include its first moment.
    """

    mass: float
    moment: np.ndarray
    inertia: np.ndarray
    averaged: bool = False

    def moved(self, R, p):
        """The same body in another frame, in which the old frame has its origin at p and the columns of R as axes."""
        moment = R @ self.moment
        cross = np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])
        first = np.outer(moment, p)
        shift = 2.0 * (moment @ p) * np.eye(3) - first - first.T
        return Load(
            self.mass,
            moment + self.mass * p,
            R @ self.inertia @ R.T + shift - self.mass * cross @ cross,
        )

    def __add__(self, other):
        return Load(
            self.mass + other.mass, self.moment + other.moment, self.inertia + other.inertia
        )


def _payload(arm):
    p = arm.payload
    c = np.asarray(p.offset)
    inertia = np.asarray(p.inertia) + p.mass * (c @ c * np.eye(3) - np.outer(c, c))
    return Load(p.mass, p.mass * c, inertia)


def _body(body):
    """A body on a link, in its section's frame."""
    c = np.asarray(body.offset)
    inertia = np.asarray(body.inertia) + body.mass * (c @ c * np.eye(3) - np.outer(c, c))
    return Load(body.mass, body.mass * c, inertia)


def _straight(link, joint):
    """A link's undeformed beam with its hub and the motor at its base, in its base frame."""
    a = np.asarray(joint.axis)
    if link.reduced is not None:
        r = link.reduced
        inertia = r["inertia"] + joint.hub_inertia * np.outer(a, a)
        return Load(joint.motor_mass + link.mass, r["first_moment"], inertia)
    mass, first, second, polar = link.moments()
    return Load(
        joint.motor_mass + mass,
        np.array([first, 0.0, 0.0]),
        np.diag([polar, second, second]) + joint.hub_inertia * np.outer(a, a),
    )


def outboard(arm):
    """The `Load` on each link's tip, with all joints at zero and all links straight."""
    loads = [_payload(arm)]
    for link, joint in list(zip(arm.links, arm.joints, strict=True))[:0:-1]:
        rotor = Load(0.0, np.zeros(3), joint.rotor_inertia * np.outer(joint.axis, joint.axis))
        whole = loads[0].moved(np.eye(3), link.tip)
        for body in link.bodies:
            whole += _body(body).moved(np.eye(3), np.array([body.position, 0.0, 0.0]))
        motor = Load(joint.motor_mass, np.zeros(3), np.zeros((3, 3)))
        whole += _straight(link, replace(joint, motor_mass=0.0))
        whole = whole.moved(np.eye(3), np.array(link.root)) + motor + rotor
        whole += Load(0.0, np.zeros(3), np.asarray(joint.housing_inertia))
        whole = whole.moved(rotation(joint.origin_rpy), np.asarray(joint.origin_xyz))
        loads.insert(0, replace(whole, averaged=True))
    return loads


def shapes_of(link, direction, flexibility, load):
    """Mode shapes of a link in a direction, of the kind that the arm file names.

    The load of an inner link is averaged over the angles of the joints beyond it. It has its mass at the tip and its
    inertia about the tip; its first moment is left out.

    `flexibility` is the arm file's for that direction: kind of shape and number of modes.
    """
    L, rho, modes = link.length, link.mass_per_length, flexibility.modes
    if link.reduced is not None:
        moment = np.zeros(3) if load.averaged else load.moment
        return Shapes(link.reduced.loaded(load.mass, moment, load.inertia, modes))
    if link.pieces or (link.bodies and flexibility.shape != "from_frequencies"):
        return _varied_shapes(link, direction, flexibility, load)
    if direction == "twist":
        polar, GJ = link.polar_inertia_per_length, link.stiffness["twist"]
        if flexibility.shape == "from_frequencies":
            return beam.twist_from_frequencies(flexibility.frequencies[:modes], L, polar, GJ)
        tip = load.inertia[0, 0] if flexibility.shape == "loaded" else 0.0
        return beam.twist(modes, L, polar, tip)
    if flexibility.shape == "clamped_free":
        return beam.clamped_free(modes)
    if flexibility.shape == "from_frequencies":
        return beam.from_frequencies(
            flexibility.frequencies[:modes], L, rho, link.stiffness[direction]
        )
    mass, moment, inertia = _bending_load(load, direction)
    offset = moment / mass if mass > 0.0 else 0.0
    return beam.loaded(modes, L, rho, mass, inertia - mass * offset**2, offset)


def _varied_shapes(link, direction, flexibility, load):
    """As `shapes_of`, for a link whose section changes along it."""
    if flexibility.shape == "from_frequencies":
        raise ModelError(
            "are for uniform links",
            field=f"shapes from_frequencies of {link.name}",
            hint="take shape loaded, and adjust the section's stiffness to the frequencies",
        )
    twist = direction == "twist"
    bodies = [_on_beam(link, direction, _body(b), b.position / link.length) for b in link.bodies]
    if flexibility.shape == "loaded":
        bodies.append(_on_beam(link, direction, load, 1.0))
    problem = varied_beam.BeamProblem(
        link.breaks,
        lambda xi: link.factor(direction, xi),
        lambda xi: link.factor("polar" if twist else "mass", xi),
        bodies,
        twist,
    )
    return problem.shapes(flexibility.modes)


def _on_beam(link, direction, load, place):
    """A load at a place of a link, in the form that its beam problem needs."""
    L = link.length
    if direction == "twist":
        own = link.polar_inertia_per_length * L
        return varied_beam.Body(place, 0.0, 0.0, load.inertia[0, 0] / own)
    mass, moment, inertia = _bending_load(load, direction)
    m = link.mass
    return varied_beam.Body(place, mass / m, moment / (m * L), inertia / (m * L**2))


def _bending_load(load, direction):
    """Mass, first moment along x and inertia about the section, of a load."""
    axis = 2 if direction == "y" else 1
    return load.mass, 0.0 if load.averaged else load.moment[0], load.inertia[axis, axis]


def _clamped_mass(link, direction, shapes, load):
    """Modal mass of a link with its base held and its load at its tip; modal damping is relative to it."""
    twist = direction == "twist"
    whole = link.polar_inertia_per_length * link.length if twist else link.mass
    out = whole * shapes.gram(weight=_along(link, "polar" if twist else "mass"))
    carried = [(_body(body), body.position / link.length) for body in link.bodies]
    for body, place in (*carried, (load, 1.0)):
        at, slope = shapes(place), shapes(place, 1) / link.length
        if twist:
            out += body.inertia[0, 0] * np.outer(at, at)
            continue
        mass, moment, inertia = _bending_load(body, direction)
        cross = moment * np.outer(at, slope)
        out += mass * np.outer(at, at) + cross + cross.T + inertia * np.outer(slope, slope)
    return out


def _along(link, name):
    """A property of a link as the weight of integrals along it."""
    return lambda xi: link.factor(name, xi)


def node_count(link, modes, level):
    """Number of quadrature nodes in each span of a link between its breaks, for this number of modes in a direction."""
    # Integrals of squared slopes are accurate to about 1e-12; those of roots like sqrt(1 - y'^2) to 1e-9, up to slopes
    # of 0.6.
    extra = 6 if level == kernel.FORESHORTENING else 12
    widest = np.diff(link.breaks).max()
    return int(np.ceil(3 * modes * min(1.0, 1.5 * widest))) + extra


@dataclass(frozen=True)
class Nodes:
    """Quadrature over a link, or over its part up to a section, in spans between its breaks.

    Attributes
    ----------
    xi, weights : ndarray, shape (G,)
        Gauss points and weights in units of the length; after them the sections of the bodies. These and the unused
        entries, at 0, have no weight.
    cumulate : ndarray, shape (G, G + 1)
        Weights of the integrals from the base to each node and, last, to the end.
    bodies : list of int
        Numbers of the nodes at the sections of the link's bodies.
    """

    xi: np.ndarray
    weights: np.ndarray
    cumulate: np.ndarray
    bodies: list


def nodes_of(link, count, size, end=1.0):
    """The `Nodes` of a link up to `end` [-], with `count` nodes a span, in arrays of `size`."""
    points, weights = np.polynomial.legendre.leggauss(count)
    points, weights = 0.5 * (points + 1.0), 0.5 * weights
    integrate = cumulative(points, points).T
    xi, w, cumulate = np.zeros(size), np.zeros(size), np.zeros((size, size + 1))
    breaks = np.minimum(link.breaks, end)
    for k, (low, high) in enumerate(pairwise(breaks)):
        own, beyond = slice(k * count, (k + 1) * count), slice((k + 1) * count, None)
        xi[own], w[own] = low + (high - low) * points, (high - low) * weights
        cumulate[own, own] = (high - low) * integrate
        cumulate[own, beyond] = w[own, None]
    first = (len(breaks) - 1) * count
    for k, body in enumerate(link.bodies):
        xi[first + k] = min(body.position / link.length, end)
        cumulate[:first, first + k] = np.where(xi[:first] < xi[first + k], w[:first], 0.0)
    return Nodes(xi, w, cumulate, list(range(first, first + len(link.bodies))))


def bishop_integrals(data, index, weights):
    """int phi_j'' phi_k' dx for j along y and k along z of a link, from the nodes; shape (K, K)."""
    y, z = data.direction[index] == kernel.Y, data.direction[index] == kernel.Z
    out = np.einsum("g,gj,gk->jk", weights, data.node_bend[index], data.node_slope[index])
    return out * np.outer(y, z)


def assemble(arm, shapes, loads):
    """`kernels.chain_data.Data` of an arm."""
    N = len(arm.links)
    modes = [modes_of(link, shapes) for link in arm.links]
    K = max(1, *(len(m) for m in modes)) if N > 1 else max(1, len(modes[0]))
    level = kernel.FIRST_ORDER
    if arm.foreshortening:
        level = kernel.FORESHORTENING
    if arm.finite_slope:
        level = kernel.FINITE_SLOPE
    beams = [link for link in arm.links if link.reduced is None]
    most = max((f.modes for link in beams for f in link.flexible.values()), default=0)
    counts = [1] * N
    if level != kernel.FIRST_ORDER and most:
        counts = [node_count(link, most, level) for link in arm.links]
    G = max(
        c * (len(link.breaks) - 1) + len(link.bodies)
        for c, link in zip(counts, arm.links, strict=True)
    )
    bodies = [(i, body) for i, link in enumerate(arm.links) for body in link.bodies]
    B, reduced = max(1, len(bodies)), [i for i, link in enumerate(arm.links) if link.reduced]
    z = np.zeros
    a = {
        "links": N,
        "level": level,
        "nodes": G,
        "count": np.array([len(m) for m in modes], np.int64),
        "first": np.cumsum([0] + [len(m) for m in modes])[:-1].astype(np.int64),
        "direction": np.zeros((N, K), np.int64),
        "axis": np.array([j.axis for j in arm.joints]),
        "xyz": np.array([j.origin_xyz for j in arm.joints]),
        "turn": np.array([rotation(j.origin_rpy) for j in arm.joints]),
        "gear": np.array([j.gear_ratio for j in arm.joints]),
        "rotor": np.array([j.rotor_inertia for j in arm.joints]),
        "spring": _springs(arm.joints, sum(len(m) for m in modes)),
        "housed": np.array([i > 0 and j.housed for i, j in enumerate(arm.joints)], np.int64),
        "housing": np.array([j.housing_inertia for j in arm.joints], float),
        "slip": np.array([_slip_constants(j) for j in arm.joints]),
        "transmission": np.array([_spring_constants(j.transmission) for j in arm.joints]),
        "length": np.array([link.length for link in arm.links]),
        "mass": z(N), "moment": z(N), "inertia": z((N, 3, 3)), "s": z((N, K)), "e": z((N, K)),
        "gram": z((N, K, K)), "stiffness": z((N, K, K)), "damping": z((N, K, K)), "tip": z((N, K)),
        "slope": z((N, K)), "node_x": z((N, G)), "node_mass": z((N, G)), "node_phi": z((N, G, K)),
        "node_slope": z((N, G, K)), "node_bend": z((N, G, K)), "node_ei": z((N, G, 2)),
        "cumulate": z((N, G, G + 1)), "bishop": z((N, K, K)),
        "root": np.array([link.root for link in arm.links]), "root_mass": z(N),
        "rooted": np.array([any(link.root) for link in arm.links], np.int64),
        "reduced": np.array([reduced.index(i) if i in reduced else -1 for i in range(N)], np.int64),
        **_reduced_constants([_matrices(arm.links[i], shapes) for i in reduced], K, level),
        "bodies": len(bodies), "host": np.full(B, -1, np.int64), "body_node": np.zeros(B, np.int64),
        "body_x": z(B), "body_tip": z((B, K)), "body_slope": z((B, K)), "body_bishop": z((B, K, K)),
        "body_mass": z(B), "body_moment": z((B, 3)), "body_inertia": z((B, 3, 3)),
    }  # fmt: skip
    # An axis (0, 0, 1) of integers would have another type and cause another compilation.
    a = {name: v if name in INTEGERS else np.asarray(v, float) for name, v in a.items()}
    for i, (link, joint) in enumerate(zip(arm.links, arm.joints, strict=True)):
        L = link.length
        body = _straight(link, joint)
        if link.reduced is not None:
            a["mass"][i], a["inertia"][i], a["root_mass"][i] = body.mass, body.inertia, link.mass
            _fill_reduced(a, i, link, _matrices(link, shapes), loads[i])
            continue
        a["mass"][i] = body.mass + link.total_mass - link.mass
        a["moment"][i], a["inertia"][i], a["root_mass"][i] = body.moment[0], body.inertia, link.mass
        nodes = nodes_of(link, counts[i], G)
        _fill_bodies(a, i, link, modes[i], nodes, bodies)
        a["node_x"][i] = L * nodes.xi
        a["node_mass"][i] = link.mass * nodes.weights * link.factor("mass", nodes.xi)
        a["cumulate"][i] = L * nodes.cumulate
        for c, direction in enumerate(("y", "z")):
            EI = link.stiffness.get(direction, 0.0) * link.factor(direction, nodes.xi)
            a["node_ei"][i, :, c] = L * nodes.weights * EI
        for j, (shape, number, direction) in enumerate(modes[i]):
            _fill_mode(a, i, j, link, shape, number, direction, nodes.xi)
        for j, (shape, number, direction) in enumerate(modes[i]):
            for k, (other, second, across) in enumerate(modes[i]):
                a["gram"][i, j, k] = _gram(link, shape, number, direction, other, second, across)
        start = 0
        for direction in DIRECTIONS:
            if direction not in link.flexible:
                continue
            shape = shapes[link.name, direction]
            block = (i, slice(start, start + shape.count), slice(start, start + shape.count))
            start += shape.count
            power = 1 if direction == "twist" else 2
            gram = shape.gram(power, _along(link, direction))
            stiff = link.stiffness[direction] / L ** (2 * power - 1) * gram
            a["stiffness"][block] = stiff
            a["damping"][block] = damping_matrix(
                _clamped_mass(link, direction, shape, loads[i]),
                stiff,
                link.flexible[direction].damping,
            )
    body = _payload(arm)
    data = kernel.Data(
        **a,
        payload_mass=np.array([body.mass], float),
        payload_moment=np.asarray(body.moment, float),
        payload_inertia=np.asarray(body.inertia, float),
        gravity=np.asarray(arm.gravity, float),
    )
    if level != kernel.FIRST_ORDER:
        for i in range(N):
            data.bishop[i] = bishop_integrals(data, i, data.cumulate[i, :, -1])
        for b, (i, _) in enumerate(bodies):
            weights = data.cumulate[i, :, data.body_node[b]]
            data.body_bishop[b] = bishop_integrals(data, i, weights)
    return data


#: Arrays of a reduced link by the names of the kernels' constants; level `first_order` leaves out the second order.
_REDUCED = {
    "red_C": "translation", "red_l": "rotation", "red_H": "first", "red_G": "second",
    "red_T": "tip_translation", "red_R": "tip_rotation",
}  # fmt: skip
_SECOND_ORDER = {
    "red_C2": "second_translation", "red_H2": "second_first", "red_T2": "second_tip", "red_R2": "second_twist",
}  # fmt: skip


def _matrices(link, shapes):
    """The reduced matrices of a link in the modes that the arm has."""
    return shapes[link.name, REDUCED].reduced


def _reduced_constants(links, K, level):
    """The shape integrals of reduced links, in arrays for K modes."""
    sizes = {"R": len(links), "K": K}
    names = ("red_first", "red_tip", *_REDUCED, *_SECOND_ORDER)
    out = {name: np.zeros(_shape(kernel.DATA[name], sizes)) for name in names}
    for r, matrices in enumerate(links):
        out["red_first"][r], out["red_tip"][r] = matrices["first_moment"], matrices["tip"]
        known = _REDUCED if level == kernel.FIRST_ORDER else _REDUCED | _SECOND_ORDER
        for name, source in known.items():
            value = matrices.get(source) if source in _SECOND_ORDER.values() else matrices[source]
            out[name][(r, *(slice(n) for n in value.shape))] = value
    return out


def _fill_reduced(a, i, link, r, load):
    """Modal mass, stiffness and damping of a link given by reduced matrices r."""
    m = slice(r.modes)
    a["direction"][i, m] = kernel.REDUCED
    a["gram"][i, m, m], a["stiffness"][i, m, m] = r["modal_mass"], r["modal_stiffness"]
    if "modal_damping" in r.arrays:
        a["damping"][i, m, m] = r["modal_damping"]
        return
    moment = np.zeros(3) if load.averaged else load.moment
    carried = r.carrying(load.mass, moment, load.inertia)
    ratios = link.flexible[REDUCED].damping
    a["damping"][i, m, m] = damping_matrix(carried, r["modal_stiffness"], ratios)


def _fill_bodies(a, i, link, modes, nodes, bodies):
    """Write the constants of the bodies on link i into the arrays of all links' bodies."""
    own = [b for b, (host, _) in enumerate(bodies) if host == i]
    for b, node in zip(own, nodes.bodies, strict=True):
        body = bodies[b][1]
        load, xi = _body(body), body.position / link.length
        a["host"][b], a["body_node"][b], a["body_x"][b] = i, node, body.position
        a["body_mass"][b], a["body_moment"][b] = load.mass, load.moment
        a["body_inertia"][b] = load.inertia
        for j, (shape, number, direction) in enumerate(modes):
            twist = direction == "twist"
            a["body_tip"][b, j] = 0.0 if twist else shape(xi)[number]
            slope = shape(xi)[number] if twist else shape(xi, 1)[number] / link.length
            a["body_slope"][b, j] = slope


def _springs(joints, bending):
    """Index of each joint's transmission in delta, after the links' modes; -1: the joint has none."""
    has = np.array([j.transmission is not None for j in joints])
    return np.where(has, bending + np.cumsum(has) - 1, -1).astype(np.int64)


def _slip_constants(joint):
    f = joint.friction
    return f.excess, f.stribeck, 0.0 if joint.transmission is None else f.load, f.smoothing


def _spring_constants(t):
    if t is None:
        return (0.0,) * 6
    return t.stiffness, t.damping, 0.5 * t.play, t.load_damping, t.rounding, t.play_damping


def _fill_mode(a, i, j, link, shape, number, direction, points):
    """The constants of one mode that involve no other mode."""
    L, rho = link.length, link.mass_per_length
    a["direction"][i, j] = _KIND[direction]
    if direction == "twist":
        own = link.polar_inertia_per_length * L
        a["s"][i, j] = own * shape.integral(_along(link, "polar"))[number]
        a["slope"][i, j] = shape(1.0)[number]
        return
    a["s"][i, j] = rho * L * shape.integral(_along(link, "mass"))[number]
    a["e"][i, j] = rho * L**2 * shape.integral(lambda xi: xi * link.factor("mass", xi))[number]
    a["tip"][i, j] = shape(1.0)[number]
    a["slope"][i, j] = shape(1.0, 1)[number] / L
    a["node_phi"][i, :, j] = shape(points)[:, number]
    a["node_slope"][i, :, j] = shape(points, 1)[:, number] / L
    a["node_bend"][i, :, j] = shape(points, 2)[:, number] / L**2


def _gram(link, shape, number, direction, other, second, across):
    """int phi_j phi_k dm of two modes of a link; zero between bending and twist."""
    if (direction == "twist") != (across == "twist"):
        return 0.0
    if direction == "twist":
        own = link.polar_inertia_per_length * link.length
        return own * shape.gram(weight=_along(link, "polar"))[number, second]
    weight = _along(link, "mass")
    if direction == across:
        return link.mass * shape.gram(weight=weight)[number, second]
    return link.mass * beam.overlap(shape, other, weight)[number, second]
