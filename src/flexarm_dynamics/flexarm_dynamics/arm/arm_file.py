# SPDX-License-Identifier: Apache-2.0
"""Reads arm files (YAML) and validates them; every error names its field by its path, such as ``links[0].length``.

A file gives an `Arm` or an `ArmFileError`, never an incomplete arm.
"""

import math
import os
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.polynomial import polynomial

from ..errors import ArmFileError
from . import fixed_joints, reduced
from .description import (
    BEAM_DIRECTIONS,
    ENCODERS,
    MAX_MODES,
    REDUCED,
    SAFE_ACTIONS,
    SHAPES,
    TRANSMISSION,
    Arm,
    Body,
    Flexibility,
    Friction,
    Gauge,
    Joint,
    Limits,
    Link,
    Payload,
    Piece,
    Transmission,
)
from .entries import MAX_NUMBER, Section, kind_of, read_yaml, value_error

JOINT_TYPES = ("revolute", "fixed")
#: Max. number of entries in a link's `sections`.
MAX_SECTIONS = 40
#: Largest resolution of a gauge's bridge [bit].
MAX_BITS = 32
#: Largest play of a transmission [rad].
MAX_PLAY = 0.2
#: Largest fraction of the transmitted torque that may be friction; beyond this a gear is self-locking [-].
MAX_LOAD_FRICTION = 0.9
#: Largest full scale of a gauge [-].
MAX_STRAIN = 0.1


def _friction(joint):
    if not joint.has("friction"):
        return Friction()
    s = joint.section("friction")
    out = Friction(
        viscous=s.number("viscous", "viscous", 0.0, low=0.0),
        coulomb=s.number("coulomb", "torque", 0.0, low=0.0),
        smoothing=s.number("smoothing", "none", 0.01, positive=True),
        breakaway=s.number("breakaway", "torque", 0.0, low=0.0),
        stribeck=s.number("stribeck", "none", Friction.stribeck, positive=True),
        load=s.number("load", "none", 0.0, low=0.0),
    )
    s.done()
    if 0.0 < out.breakaway < out.coulomb:
        problem, limit = "N m is below the Coulomb friction", f"at least {out.coulomb:g} N m"
        raise s.error("breakaway", problem, value=out.breakaway, limit=limit)
    if out.load > MAX_LOAD_FRICTION:
        problem, limit = "of the transmitted torque is too much", f"at most {MAX_LOAD_FRICTION:g}"
        raise s.error("load", problem, value=out.load, limit=limit)
    if out.load and not joint.has("transmission"):
        hint = "give the joint a transmission, whose torque it is a part of"
        raise s.error("load", "needs a transmission", value=out.load, hint=hint)
    return out


def _transmission(joint):
    if not joint.has("transmission"):
        return None
    s = joint.section("transmission")
    out = Transmission(
        stiffness=s.number("stiffness", "torque", positive=True),
        damping=s.number("damping", "viscous", 0.0, low=0.0),
        play=s.number("play", "angle", 0.0, low=0.0),
        load_damping=s.number("load_damping", "time", 0.0, low=0.0),
        rounding=s.number("rounding", "angle", 0.0, low=0.0),
        play_damping=s.number("play_damping", "viscous", 0.0, low=0.0),
    )
    s.done()
    if out.play > MAX_PLAY:
        hint = "the whole way from flank to flank; in degrees?"
        raise s.error(
            "play", "rad is too large", value=out.play, limit=f"at most {MAX_PLAY} rad", hint=hint
        )
    if out.rounding > MAX_PLAY or (out.rounding > 0.0 and out.play == 0.0):
        limit = f"at most {MAX_PLAY} rad, and 0 without play"
        raise s.error("rounding", "rad is out of range", value=out.rounding, limit=limit)
    if not joint.number("rotor_inertia", "inertia", 0.0) > 0.0:
        hint = "with a transmission the motor turns by itself: give the inertia of its rotor"
        raise joint.error("rotor_inertia", "must be greater than 0 kg m^2", hint=hint)
    return out


def _limits(joint):
    if not joint.has("limits"):
        return Limits()
    s = joint.section("limits")
    out = Limits(
        position=s.vector("position", 2, "angle", (-np.inf, np.inf)),
        velocity=s.number("velocity", "none", np.inf, positive=True),
        torque=s.number("torque", "torque", np.inf, positive=True),
        torque_rate=s.number("torque_rate", "torque", np.inf, positive=True),
    )
    s.done()
    if not out.position[0] < out.position[1]:
        low_high, hint = list(out.position), "low must be below high"
        raise s.error("position", "is empty", value=low_high, hint=hint)
    return out


#: Optional numbers of a joint's safe action, and their dimensions.
SAFE_NUMBERS = {
    "brake_torque": "torque",
    "damp_coefficient": "viscous",
    "damp_torque": "torque",
    "damp_time": "time",
}


def _fixed_joint(s):
    """A joint that does not turn: a name and an origin."""
    joint = Joint(s.name(), **_origin(s))
    s.done()
    return joint


def _origin(s):
    if not s.has("origin"):
        return {}
    o = s.section("origin")
    origin = {
        "origin_xyz": o.vector("xyz", 3, "length", (0.0,) * 3),
        "origin_rpy": o.vector("rpy", 3, "angle", (0.0,) * 3),
    }
    o.done()
    return origin


def _joint(s):
    axis = s.vector("axis", 3, default=(0.0, 0.0, 1.0))
    norm = math.hypot(*axis)
    if norm == 0.0:
        raise s.error("axis", "is of length zero", value=list(axis))
    optional = {
        key: s.number(key, dimension, low=0.0)
        for key, dimension in SAFE_NUMBERS.items()
        if s.has(key)
    }
    joint = Joint(
        name=s.name(),
        axis=tuple(a / norm for a in axis),
        **_origin(s),
        hub_inertia=s.number("hub_inertia", "inertia", 0.0, low=0.0),
        motor_mass=s.number("motor_mass", "mass", 0.0, low=0.0),
        housing_inertia=_tensor(s, "housing_inertia"),
        rotor_inertia=s.number("rotor_inertia", "inertia", 0.0, low=0.0),
        gear_ratio=s.number("gear_ratio", "none", 1.0, positive=True),
        friction=_friction(s),
        transmission=_transmission(s),
        encoder=s.text("encoder", "motor", ENCODERS),
        limits=_limits(s),
        safe_action=s.text("safe_action", "damp", SAFE_ACTIONS),
        encoder_counts=s.integer("encoder_counts", 0, low=0, high=2**31),
        continuous=s.flag("continuous"),
        **optional,
    )
    if joint.continuous and any(map(math.isfinite, joint.limits.position)):
        hint = "leave out limits.position, or continuous"
        raise s.error("continuous", "beside limits.position", value=True, hint=hint)
    s.done()
    return joint


def _damping(s):
    """Modal damping ratios."""
    damping = ()
    if s.has("damping"):
        given = s.raw("damping")
        damping = (
            s.vector("damping", len(given))
            if isinstance(given, list)
            else (s.number("damping", low=0.0),)
        )
    if any(not 0.0 <= z < 1.0 for z in damping):
        limit = "from 0 to below 1"
        raise s.error("damping", "is out of range", value=list(damping), limit=limit)
    return damping


def _flexibility(s):
    shape = s.text("shape", "clamped_free", SHAPES)
    modes = s.integer("modes", low=1, high=MAX_MODES)
    frequencies = ()
    if s.has("frequencies"):
        given = s.raw("frequencies")
        count = len(given) if isinstance(given, list) else modes
        frequencies = s.vector("frequencies", count, "frequency")
    if shape == "from_frequencies" and len(frequencies) < modes:
        problem = f"{len(frequencies)} frequencies for {modes} modes"
        raise s.error("frequencies", problem, hint="give one each")
    if any(f <= 0.0 for f in frequencies) or list(frequencies) != sorted(set(frequencies)):
        problem = "must be positive and ascending"
        raise s.error("frequencies", problem, value=list(frequencies))
    damping = _damping(s)
    s.done()
    return Flexibility(modes, shape, frequencies, damping)


#: Keys of a link's or a part's stiffnesses, in the order of `BEAM_DIRECTIONS`.
STIFFNESS_KEYS = ("EI_y", "EI_z", "GJ")
#: Keys that a part of a link inherits from the part before it, unless it states its own.
INHERITED = ("shape", "density", "youngs_modulus", "shear_modulus")
#: Places, from one end (0) to the other (1), where the properties of a tapered section are computed [-].
_TAPER = 0.5 - 0.5 * np.cos(np.pi * np.arange(9) / 8.0)


@dataclass(frozen=True)
class _Part:
    """Properties of a link between two places: polynomials of t from 0 to 1, lowest power first, in SI."""

    mass: tuple
    stiffness: dict
    polar: tuple


def _ends(s, key, dimension, default=None, low=None):
    """A number, or one for each end of a tapered part, as a polynomial with one or two coefficients."""
    if isinstance(s.raw(key), list):
        pair = s.vector(key, 2, dimension)
        for value in pair:
            if not value >= (1.0 / MAX_NUMBER if low is None else low):
                limit = "greater than 0 at both ends" if low is None else f"at least {low:g}"
                raise s.error(key, "is too small", value=list(s.raw(key)), limit=limit)
        return (pair[0], pair[1] - pair[0]) if pair[0] != pair[1] else pair[:1]
    return (s.number(key, dimension, default, low=low, positive=low is None),)


def _section_properties(s):
    """Mass, stiffnesses and polar inertia of a rectangular or tubular section, which may be tapered."""
    shape = s.text("shape", choices=("rectangle", "tube"))
    density = s.number("density", "density", positive=True)
    young = s.number("youngs_modulus", "stress", positive=True)
    shear = s.number("shear_modulus", "stress", default=young / 2.6, positive=True)
    of_sizes = _rectangle if shape == "rectangle" else _tube
    keys = ("size_y", "size_z") if shape == "rectangle" else ("outer_diameter", "wall")
    sizes = [_ends(s, key, "length") for key in keys]
    if shape == "tube":
        for end in (0.0, 1.0):
            diameter, wall = (float(_along(size)(end)) for size in sizes)
            if 2.0 * wall > diameter:
                problem = "m is more than the radius"
                raise s.error("wall", problem, value=wall, limit=f"{diameter / 2} m")
    s.done()
    if all(len(size) == 1 for size in sizes):
        area, inertia_y, inertia_z, torsion = ((v,) for v in of_sizes(*(v[0] for v in sizes)))
    else:
        at = of_sizes(*(_along(size)(_TAPER) for size in sizes))
        # Products of sizes are polynomials of degree four at most; the torsion constant is not.
        area, inertia_y, inertia_z = (tuple(polynomial.polyfit(_TAPER, v, 4)) for v in at[:3])
        torsion = tuple(polynomial.polyfit(_TAPER, at[3], 8))

    def times(factor, values):
        return tuple(float(factor * v) for v in values)

    stiffness = {"y": times(young, inertia_y), "z": times(young, inertia_z)}
    polar = [a + b for a, b in zip(inertia_y, inertia_z, strict=True)]
    return _Part(
        times(density, area),
        stiffness | {"twist": times(shear, torsion)},
        times(density, polar),
    )


def _along(coefficients):
    return lambda t: polynomial.polyval(t, coefficients)


def _rectangle(b, h):
    """Area, second moments and torsion constant of a rectangle of sizes b along y, h along z."""
    wide, thin = np.maximum(b, h), np.minimum(b, h)
    # Roark's torsion constant of a rectangle, accurate within 0.5 %.
    ratio = thin / wide
    torsion = wide * thin**3 * (1.0 / 3.0 - 0.21 * ratio * (1.0 - ratio**4 / 12.0))
    return b * h, h * b**3 / 12.0, b * h**3 / 12.0, torsion


def _tube(outer, wall):
    """Area, second moments and torsion constant of a tube."""
    inner = outer - 2.0 * wall
    area = math.pi * (outer**2 - inner**2) / 4.0
    second = math.pi * (outer**4 - inner**4) / 64.0
    return area, second, second, 2.0 * second


def _numbers(s, taper):
    """Properties given as numbers; with `taper`, the two ends may differ."""

    def read(key, dimension, default=None, low=None):
        if taper:
            return _ends(s, key, dimension, default, low)
        return (s.number(key, dimension, default, low=low, positive=low is None),)

    return _Part(
        read("mass_per_length", "mass_per_length"),
        {
            direction: read(key, "stiffness")
            for direction, key in zip(BEAM_DIRECTIONS, STIFFNESS_KEYS, strict=True)
            if s.has(key)
        },
        read("polar_inertia_per_length", "mass", 0.0, low=0.0),
    )


def _parts(s, length):
    """The parts of a link of this length: (end [m], `_Part`) from base to tip."""
    if s.has("section") and s.has("sections"):
        raise s.error("sections", "beside a section", hint="give one of them")
    for key in (*STIFFNESS_KEYS, "mass_per_length", "polar_inertia_per_length"):
        if (s.has("section") or s.has("sections")) and s.has(key):
            hint = "give either a section or the stiffnesses"
            raise s.error(key, "beside a section", hint=hint)
    if s.has("section"):
        return [(length, _section_properties(s.section("section")))]
    if not s.has("sections"):
        return [(length, _numbers(s, taper=False))]
    given = s.sections("sections")
    if not 1 <= len(given) <= MAX_SECTIONS:
        raise s.error("sections", "is out of range", value=len(given), limit=f"1 to {MAX_SECTIONS}")
    parts, before, material = [], 0.0, {}
    for part in given:
        last = part is given[-1]
        end = part.number("to", "length", default=length if last else None, positive=True)
        if last and abs(end - length) <= 1e-9 * length:
            end = length
        if not (before < end <= length) or (last and end != length):
            limit = (
                f"{length:.6g} m, the link's length" if last else f"{before:.6g} to {length:.6g} m"
            )
            hint = "parts go from base to tip; the last one ends at the tip"
            raise part.error("to", "m is out of place", value=end, limit=limit, hint=hint)
        part.data = {**material, **part.data}
        if {"shape", "outer_diameter", "size_y"} & set(part.data):
            parts.append((end, _section_properties(part)))
        else:
            parts.append((end, _numbers(part, taper=True)))
            part.done()
        if set(parts[-1][1].stiffness) != set(parts[0][1].stiffness):
            wanted = ", ".join(
                k
                for d, k in zip(BEAM_DIRECTIONS, STIFFNESS_KEYS, strict=True)
                if d in parts[0][1].stiffness
            )
            raise ArmFileError(
                part.path, "has other stiffnesses than the first part", limit=wanted or "none"
            )
        before, material = end, {k: v for k, v in part.data.items() if k in INHERITED}
    return parts


def _pieces(parts, length):
    """Reference values of a link, and its `Piece`s; a uniform link has none."""
    first = parts[0][1]
    stiffness = {d: c[0] for d, c in first.stiffness.items()}
    if len(parts) == 1 and all(
        len(c) == 1 for c in (first.mass, first.polar, *first.stiffness.values())
    ):
        return first.mass[0], stiffness, first.polar[0], ()
    ends = [0.0, *(end / length for end, _ in parts)]
    steps = np.diff(ends)

    def mean(name):
        values = (getattr(part, name) for _, part in parts)
        return float(sum(h * sum(c / (k + 1.0) for k, c in enumerate(v))
                         for h, v in zip(steps, values, strict=True)))  # fmt: skip

    mass, polar = mean("mass"), mean("polar")

    def relative(values, unit):
        return tuple(float(v / unit) for v in values) if unit > 0.0 else (1.0,)

    pieces = tuple(
        Piece(
            ends[k],
            ends[k + 1],
            mass=relative(part.mass, mass),
            polar=relative(part.polar, polar),
            **{d: relative(c, stiffness[d]) for d, c in part.stiffness.items()},
        )
        for k, (_, part) in enumerate(parts)
    )
    return mass, stiffness, polar, pieces


def _reduced_link(s, folder):
    """A link given by reduced matrices."""
    name, part = s.name(), s.section("reduced")
    where = part.at("file")
    file = part.text("file")
    matrices = reduced.read(Path(folder or ".", file).expanduser(), where)
    count = part.integer("modes", matrices.modes, low=1, high=matrices.modes)
    damping = _damping(part)
    if damping and "modal_damping" in matrices.arrays:
        hint = "the archive has modal_damping: leave one of them out"
        raise part.error("damping", "given twice", hint=hint)
    part.done()
    root = s.vector("root", 3, "length", (0.0,) * 3)
    for key in (
        "length",
        "section",
        "sections",
        "flexible",
        "bodies",
        "mass_per_length",
        *STIFFNESS_KEYS,
    ):
        if s.has(key):
            raise s.error(key, "beside reduced matrices", hint="they hold all of it")
    s.done()
    length = float(np.linalg.norm(matrices["tip"]))
    return Link(
        name, length, float(matrices["mass"]) / length, {},
        {REDUCED: Flexibility(count, REDUCED, (), damping)}, root=root, reduced=matrices,
    )  # fmt: skip


def _link(s, folder):
    if s.has("reduced"):
        return _reduced_link(s, folder)
    name = s.name()
    length = s.number("length", "length", positive=True)
    per_length, stiffness, polar, pieces = _pieces(_parts(s, length), length)
    flexible = {}
    if s.has("flexible"):
        f = s.section("flexible")
        for direction, key in zip(BEAM_DIRECTIONS, STIFFNESS_KEYS, strict=True):
            if f.has(direction):
                flexible[direction] = _flexibility(f.section(direction))
                if direction not in stiffness:
                    hint = f"the link is flexible in {direction}"
                    raise s.error(key, "missing", hint=hint)
                if pieces and flexible[direction].shape == "from_frequencies":
                    problem, hint = "is for uniform links", "take loaded, and fit the stiffness"
                    at = f.section(direction)
                    raise at.error("shape", problem, value="from_frequencies", hint=hint)
        f.done()
    if "twist" in flexible and not polar > 0.0:
        raise s.error(
            "polar_inertia_per_length",
            "missing",
            hint="a link that twists needs the polar inertia of its sections (rho I_p), or a section",
        )
    bodies = tuple(_body(b, length) for b in s.sections("bodies"))
    root = s.vector("root", 3, "length", (0.0,) * 3)
    s.done()
    return Link(name, length, per_length, stiffness, flexible, polar, pieces, bodies, root)


def _body(s, length):
    """A rigid body on a link of this length."""
    body = Body(
        position=s.number("position", "length", low=0.0),
        mass=s.number("mass", "mass", 0.0, low=0.0),
        inertia=_tensor(s, "inertia"),
        offset=s.vector("offset", 3, "length", (0.0,) * 3),
    )
    s.done()
    if body.position > length * (1.0 + 1e-12):
        problem, limit = "m is not on the link", f"0 to {length:.6g} m"
        raise s.error("position", problem, value=body.position, limit=limit)
    if not body.mass and not any(map(any, body.inertia)):
        raise s.error("mass", "missing", hint="a body has a mass, an inertia, or both")
    return replace(body, position=min(body.position, length))


def _tensor(s, key):
    """Rows of an inertia; the file has one number for all axes, or xx, yy, zz, xy, xz, yz, or nothing for zero."""
    inertia = np.zeros((3, 3))
    if s.has(key):
        if isinstance(s.raw(key), list):
            v = s.vector(key, 6, "inertia")
            inertia = np.array([[v[0], v[3], v[4]], [v[3], v[1], v[5]], [v[4], v[5], v[2]]])
        else:
            inertia = s.number(key, "inertia") * np.eye(3)
    if np.linalg.eigvalsh(inertia).min() < -1e-12 * np.abs(inertia).max():
        raise s.error(key, "not positive semi-definite")
    return tuple(map(tuple, inertia.tolist()))


def _payload(s):
    mass, inertia = s.number("mass", "mass", 0.0, low=0.0), _tensor(s, "inertia")
    offset = s.vector("offset", 3, "length", (0.0,) * 3)
    s.done()
    return Payload(mass, inertia, offset)


def _gauge(s, links):
    name = s.name()
    link = s.text("link", choices=tuple(links))
    gauge = Gauge(
        name=name,
        link=link,
        **_gauge_place(s, links[link]),
        gain=s.number("gain", "none", 1.0),
        bias=s.number("bias", "none", 0.0),
        noise=s.number("noise", "none", 0.0, low=0.0),
        bits=s.integer("bits", 0, low=0, high=MAX_BITS),
        full_scale=s.number("full_scale", "none", Gauge.full_scale, positive=True),
        drift=s.number("drift", "none", 0.0, low=0.0),
    )
    s.done()
    if gauge.point:
        return gauge
    _check_gauge(s, gauge, links[link].length)
    _check_jump(s, gauge, links[link])
    return gauge


def _gauge_place(s, link):
    """Place of a gauge: on a beam its position and direction, otherwise a point that the archive names."""
    if link.reduced is None:
        return {
            "position": s.number("position", "length"),
            "direction": s.text("direction", "y", BEAM_DIRECTIONS),
            "surface_distance": s.number("surface_distance", "length"),
        }
    points = tuple(map(str, link.reduced.arrays.get("strain_names", ())))
    if not points:
        hint = "add strain_names and strain to the archive"
        raise s.error("link", "its archive has no points with strain", value=link.name, hint=hint)
    point = s.text("point", choices=points)
    return {"position": 0.0, "direction": REDUCED, "surface_distance": 1.0, "point": point}


def _check_gauge(s, gauge, length):
    """Refuse a gauge that does not fit on its link of this length, or that can't measure anything."""
    scale, near = gauge.full_scale, 0.5 * length
    for key, fits, problem, limit, hint in (
        ("position", 0.0 <= gauge.position <= length, f"m is outside {gauge.link}", f"0 to {length:.6g} m", ""),
        ("surface_distance", gauge.surface_distance != 0.0, "is too small", None,
         "a gauge on the neutral axis sees nothing"),
        ("surface_distance", abs(gauge.surface_distance) <= near, "m is too far from the neutral axis",
         f"at most half the length of {gauge.link}, {near:.6g} m", "in mm?"),
        ("gain", gauge.gain != 0.0, "is too small", None, "such a gauge sees nothing"),
        ("full_scale", scale <= MAX_STRAIN, "is too large", f"at most {MAX_STRAIN}", "in microstrain?"),
        ("bias", abs(gauge.bias) < scale, "is not within full_scale", f"{scale:g}", "in microstrain?"),
        ("noise", gauge.noise < scale, "is not within full_scale", f"{scale:g}", "in microstrain?"),
    ):  # fmt: skip
        if not fits:
            raise s.error(key, problem, value=getattr(gauge, key), limit=limit, hint=hint)


def _check_jump(s, gauge, link):
    """Refuse a gauge where its link's section jumps: strain has two values there."""
    for piece, after in pairwise(link.pieces):
        place = piece.end * link.length
        before = float(sum(getattr(piece, gauge.direction)))
        jumps = abs(before - getattr(after, gauge.direction)[0]) > 1e-9 * before
        if jumps and abs(gauge.position - place) <= 1e-6 * link.length:
            hint = "strain jumps with the section; move the gauge to one side"
            raise s.error(
                "position",
                f"m is where the section of {link.name} jumps",
                value=gauge.position,
                hint=hint,
            )


def _unique(things, path):
    seen = {}
    for i, thing in enumerate(things):
        if thing.name in seen:
            problem = f"is the name of {path}[{seen[thing.name]}], too"
            raise ArmFileError(f"{path}[{i}].name", problem, value=thing.name)
        seen[thing.name] = i


def _observed(s, modes, gauges):
    names = s.raw("observed_modes", [m.name for m in modes])
    if not isinstance(names, list):
        raise ArmFileError(
            "observed_modes", f"a list of mode names is wanted, not {kind_of(names)}"
        )
    known = {m.name: m for m in modes}
    for i, name in enumerate(names):
        if not isinstance(name, str) or name not in known:
            problem, limit = "is not a mode of this arm", ", ".join(known)
            raise value_error(f"observed_modes[{i}]", name, problem, limit=limit)
        if name in names[:i]:
            raise ArmFileError(f"observed_modes[{i}]", "given twice", value=name)
    for key in {(known[n].link, known[n].direction) for n in names}:
        seen_by = sum((g.link, g.direction) == key for g in gauges)
        wanted = sum((known[n].link, known[n].direction) == key for n in names)
        if gauges and seen_by < wanted:
            raise ArmFileError(
                "gauges",
                f"{seen_by} on {key[0]} in direction {key[1]} for {wanted} observed modes",
                hint="add gauges or list fewer observed_modes",
            )
    # In the arm's order of modes, whatever the order in the file.
    return tuple(m.name for m in modes if m.name in names)


def parse(text, where="arm", folder=None):
    """Read an arm from YAML text.

    Parameters
    ----------
    text : str
        The file's content.
    where : str
        Its name in messages about the YAML itself.
    folder : Path, optional
        Folder of the files that the text names; the working directory if not given.

    Returns
    -------
    Arm

    Raises
    ------
    ArmFileError
        Naming the field by its path, the value, and what is wanted.
    """
    top = Section(read_yaml(text, where), "", "si")
    top.system = top.text("units", "si", ("si", "imperial"))
    given = top.sections("joints", required=True)
    fixed = {i for i, s in enumerate(given) if s.text("type", "revolute", JOINT_TYPES) == "fixed"}
    joints = tuple(_fixed_joint(s) if i in fixed else _joint(s) for i, s in enumerate(given))
    links = tuple(_link(s, folder) for s in top.sections("links", required=True))
    if not links:
        raise ArmFileError("links", "empty", hint="an arm has at least one link")
    if len(joints) != len(links):
        raise ArmFileError(
            "joints",
            f"{len(joints)} joints for {len(links)} links",
            hint="a serial arm has one joint each",
        )
    _unique(joints, "joints")
    _unique(links, "links")
    joints, links = fixed_joints.merged(joints, links, fixed)
    by_name = {link.name: link for link in links}
    gauges = tuple(_gauge(s, by_name) for s in top.sections("gauges"))
    _unique(gauges, "gauges")
    model, options = _model(top)
    arm = Arm(
        name=top.name(),
        joints=joints,
        links=links,
        payload=_payload(top.section("payload")) if top.has("payload") else Payload(),
        gauges=gauges,
        gravity=top.vector("gravity", 3, "acceleration", (0.0, 0.0, 0.0)),
        foreshortening=top.flag("foreshortening"),
        finite_slope=top.flag("finite_slope"),
        model=model,
        model_options=options,
        description=top.text("description", ""),
        source=top.text("source", ""),
    )
    # Refuse misspelt fields first: a misspelt observed_modes would otherwise be reported as too few gauges.
    top.has("observed_modes")
    top.done()
    bending = [m for m in arm.modes if m.direction != TRANSMISSION]  # gauges measure only these
    return replace(arm, observed_modes=_observed(top, bending, gauges))


def _model(top):
    """Name of the model class, and the section that belongs to `paper_appendix` alone."""
    model = top.text("model", "chain")
    options = {}
    if top.has("paper_appendix"):
        if model != "paper_appendix":
            raise ArmFileError("paper_appendix", f"belongs to model paper_appendix, not {model}")
        s = top.section("paper_appendix")
        options = {
            "beam_mass": s.number("beam_mass", "mass", positive=True),
            "beam_inertia": s.number("beam_inertia", "inertia", positive=True),
            "m23_fit": s.number("m23_fit", "mass", 0.0),
        }
        s.done()
    elif model == "paper_appendix":
        hint = "model paper_appendix needs this section"
        raise ArmFileError("paper_appendix", "missing", hint=hint)
    return model, options


def arms_directories():
    """Folders that are searched for shipped arms: first the source tree, then the folders that colcon installed."""
    here = Path(__file__).resolve()
    places = [parent / "config" / "arms" for parent in here.parents]
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            places.append(Path(prefix) / "share" / "flexarm_bringup" / "config" / "arms")
    return [p for p in places if p.is_dir()]


def find(name):
    """Path of an arm given as a path or as a shipped name.

    Raises
    ------
    ArmFileError
        If there is no such file; the message lists the shipped names.
    """
    try:
        path = Path(name).expanduser()
        if path.is_file():
            return path
    except (OSError, RuntimeError) as error:  # too long a name, or the home of an unknown user
        raise ArmFileError("arm", f"{str(name)[:80]!r} is no path: {error}") from None
    for directory in arms_directories():
        candidate = directory / f"{name}.yaml"
        if candidate.is_file():
            return candidate
    shipped = sorted({p.stem for d in arms_directories() for p in d.glob("*.yaml")})
    problem, limit = "is neither a file nor a shipped arm", ", ".join(shipped) or "none"
    raise ArmFileError("arm", problem, value=str(name), limit=limit)


def load(name):
    """Read an arm by path or shipped name.

    Parameters
    ----------
    name : str or Path
        ``R``, ``two_link`` or another of ``config/arms``, or a path to a YAML file.

    Returns
    -------
    Arm

    Raises
    ------
    ArmFileError
        Naming the file and the field.
    """
    if not str(name):
        raise ArmFileError("arm", "no arm given", hint="write a shipped name (R) or a path")
    path = find(name)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ArmFileError(str(path), f"can't be read: {error}") from None
    try:
        return parse(text, path.name, path.parent)
    except ArmFileError as error:
        error.field = f"{path.name}: {error.field}"
        raise error from None
