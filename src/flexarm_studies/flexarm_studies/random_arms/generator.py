# SPDX-License-Identifier: Apache-2.0
r"""Generates random arms as a user may have them, described as in an arm file, each with a motion.

Arm i of a seed is drawn from ``SeedSequence(seed, spawn_key=(i,))`` alone: the first ten of a hundred are those of ten.
The layouts alternate: 1 to 4 links, planar (all axes along z) and spatial (yaw, then pitch; links bend both ways), each
with and without gravity. The rest is drawn: reach, links of strip or tube in aluminium, steel or CFRP, payload, hubs,
gears, motors at the elbows, friction, damping, sensors. A draw whose first frequency with joints locked is outside
`FREQUENCIES`, that sags by more than `MAX_SAG`, or whose links have more strain than their material bears, is replaced
by the next draw.

The motion turns every joint by 60 to 90 degrees in two periods of the lowest mode with joints locked (quintic). The
torque limits are 1.5 to 2 times what the rigid arm needs for it, weight and friction included.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import yaml

from flexarm_control.motions import profiles
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.errors import FlexarmError, ModelError
from flexarm_dynamics.models import model

#: Layouts in turn: joints' axes, and number of links.
LAYOUTS = tuple((kind, count) for count in (1, 2, 3, 4) for kind in ("planar", "spatial"))
#: First frequency with joints locked, at both ends of the motion [Hz].
FREQUENCIES = (0.5, 15.0)
#: Whole length [m], mass of the payload as a multiple of the links' [-], modal damping ratio [-].
REACH, PAYLOAD, DAMPING = (0.3, 3.0), (0.01, 2.0), (0.001, 0.01)
#: Angle by which every joint turns [rad], and duration in locked periods.
ANGLE, PERIODS = (np.pi / 3.0, np.pi / 2.0), 2.0
#: Torque limit as a multiple of what the motion needs, and limit of the speed as a multiple of the motion's.
TORQUE, SPEED = (1.5, 2.0), (1.5, 2.5)
#: Largest deflection of the tip as a fraction of the reach: at rest under gravity, and moving slowly [-].
MAX_SAG, MAX_BENDING = 0.1, 0.2
#: With more modes than this, each direction has one mode in place of two.
MAX_MODES = 8
#: A generator that redraws more often than this has a mistake.
MAX_DRAWS = 2000
GRAVITY = 9.81  # [m/s^2]


class Material(NamedTuple):
    """A material: density [kg/m^3], elastic moduli [Pa], and the strain that it bears for long [-]."""

    density: float
    young: float
    shear: float
    strain: float


MATERIALS = {
    "aluminium": Material(2700.0, 70e9, 26e9, 2e-3),
    "steel": Material(7850.0, 205e9, 79e9, 2e-3),
    "CFRP": Material(1600.0, 120e9, 5e9, 4e-3),
}


@dataclass(frozen=True)
class RandomArm:
    """A drawn arm and its motion.

    Attributes
    ----------
    name : str
    arm : dict
        As in an arm file: plain data.
    motion : str
        Motion as one line, as `trajectory.specs` reads it.
    period : float
        Period of the lowest mode with joints locked, the longer of those at the two ends of the motion [s].
    """

    name: str
    arm: dict
    motion: str
    period: float

    @property
    def text(self):
        """The arm file, YAML."""
        return yaml.safe_dump(self.arm, sort_keys=False)

    def read(self):
        """The `Arm`, read as from a file."""
        return _read(self.text, self.name)


@lru_cache(maxsize=4)
def _read(text, name):
    return arm_file.parse(text, name)


def arms(count, seed=0, start=0):
    """Yield `count` random arms of a `seed`, from number `start` on."""
    for index in range(start, start + count):
        yield arm(index, seed)


def arm(index, seed=0):
    """Arm number `index` of a `seed`."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    kind, count = LAYOUTS[index % len(LAYOUTS)]
    heavy = (index + index // len(LAYOUTS)) % 2 == 0
    name = f"{kind}{count}{'g' if heavy else ''}_{seed}_{index}"
    for _ in range(MAX_DRAWS):
        found = _draw(rng, name, kind, count, heavy)
        if found is not None:
            return found
    raise FlexarmError(f"no arm within limits in {MAX_DRAWS} draws", field=name)


# One draw --------------------------------------------------------------------------------------


def _draw(rng, name, kind, count, heavy):
    """One draw; None if it is outside the limits."""
    material, links = _links(rng, kind, count)
    carried = _log(rng, 0.1, 1.0) if count > 1 else 0.0
    mass = [_mass(link) for link in links]
    payload = float(rng.uniform(*PAYLOAD)) * sum(mass)
    radius = (3.0 * payload / (4.0 * np.pi * MATERIALS["steel"].density)) ** (1.0 / 3.0)
    data = {
        "name": name,
        "description": f"Random arm: {kind}, {count} links of {material}",
        "units": "si",
        "gravity": _weight(kind, heavy),
        "joints": [],
        "links": links,
        "payload": {"mass": _short(payload), "inertia": _short(0.4 * payload * radius**2)},
    }
    motors = [0.0, *(carried * m for m in mass[1:])]
    inertia = _outboard(links, motors, payload)
    geared = rng.random() < 0.5
    for i in range(count):
        data["joints"].append(_joint(rng, kind, i, inertia[i], motors[i], geared, heavy))
    try:
        return _with_motion(rng, data, MATERIALS[material], geared)
    except ModelError:  # it folds under its own weight
        return None


def _log(rng, low, high):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _short(value):
    """A number with five digits, written as by a person."""
    return float(f"{value:.5g}")


def _weight(kind, heavy):
    down = [0.0, -GRAVITY, 0.0] if kind == "planar" else [0.0, 0.0, -GRAVITY]
    return down if heavy else [0.0, 0.0, 0.0]


def _links(rng, kind, count):
    """Name of a material, and links of one sort of section."""
    material = str(rng.choice(sorted(MATERIALS)))
    tube = rng.random() < 0.5
    shares = rng.uniform(0.6, 1.4, count)
    lengths = _log(rng, *REACH) * shares / shares.sum()
    slender = _log(rng, 20.0, 120.0) if tube else _log(rng, 60.0, 400.0)
    # A strip across the plane of the motion; one that bends both ways is nearly square.
    aspect = _log(rng, 4.0, 20.0) if kind == "planar" else _log(rng, 1.2, 4.0)
    upright, wall = bool(rng.random() < 0.5), _log(rng, 0.05, 0.15)
    directions = ("y",) if kind == "planar" else ("y", "z")
    modes = 2 if 2 * count * len(directions) <= MAX_MODES else 1
    damping = _short(_log(rng, *DAMPING))
    links = []
    for i, length in enumerate(lengths):
        thin = length / (slender * rng.uniform(0.8, 1.25))
        links.append(
            {
                "name": f"link{i + 1}",
                "length": _short(length),
                "section": _section(material, tube, thin, aspect, wall, kind, upright),
                "flexible": {
                    d: {"modes": modes, "shape": "loaded", "damping": [damping]} for d in directions
                },
            }
        )
    return material, links


def _section(material, tube, thin, aspect, wall, kind, upright):
    """A section as in an arm file, from its thickness or diameter [m]; in tenths of a millimetre."""
    m = MATERIALS[material]
    known = {"density": m.density, "youngs_modulus": m.young, "shear_modulus": m.shear}
    if tube:
        outer = max(_tenths(thin), 4e-3)
        size = {
            "outer_diameter": outer,
            "wall": min(max(_tenths(wall * outer), 5e-4), 0.25 * outer),
        }
        return {"shape": "tube", **known, **size}
    thin = max(_tenths(thin), 5e-4)
    wide = _tenths(aspect * thin)
    flat = kind == "planar" or upright
    size = {"size_y": thin, "size_z": wide} if flat else {"size_y": wide, "size_z": thin}
    return {"shape": "rectangle", **known, **size}


def _tenths(metres):
    return round(float(metres), 4)


def _area(section):
    if section["shape"] == "tube":
        outer, wall = section["outer_diameter"], section["wall"]
        return np.pi * wall * (outer - wall)
    return section["size_y"] * section["size_z"]


def _mass(link):
    return link["section"]["density"] * _area(link["section"]) * link["length"]


def _thickness(section, direction):
    """Thickness of a section in the direction in which it bends [m]."""
    return section["outer_diameter"] if section["shape"] == "tube" else section[f"size_{direction}"]


def _outboard(links, motors, payload):
    """Inertia of the straight arm about each joint, (n,) [kg m^2]."""
    bases = np.concatenate([[0.0], np.cumsum([link["length"] for link in links])])
    found = []
    for i, base in enumerate(bases[:-1]):
        total = payload * (bases[-1] - base) ** 2
        for k, link in enumerate(links[i:], i):
            middle, length = bases[k] - base + 0.5 * link["length"], link["length"]
            total += (
                _mass(link) * (middle**2 + length**2 / 12.0) + motors[k] * (bases[k] - base) ** 2
            )
        found.append(total)
    return found


def _joint(rng, kind, number, inertia, motor, geared, heavy):
    """A joint as in an arm file, still without friction and limits; its hub is light, heavy, or that of a gear."""
    axis = [0, 0, 1] if kind == "planar" or number == 0 else [0, 1, 0]
    hub = _log(rng, 0.01, 0.1) if geared or rng.random() < 0.5 else _log(rng, 0.1, 3.0)
    joint = {"name": f"joint{number + 1}", "axis": axis, "hub_inertia": _short(hub * inertia)}
    if geared:
        ratio = float(rng.choice([30.0, 50.0, 80.0, 100.0, 120.0, 160.0]))
        rotor = _log(rng, 0.1, 2.0) * inertia / ratio**2
        joint |= {"rotor_inertia": _short(rotor), "gear_ratio": ratio}
    if motor:
        joint["motor_mass"] = _short(motor)
    joint["safe_action"] = "brake" if heavy else "damp"
    joint["encoder_counts"] = 2 ** int(rng.integers(16, 20))
    return joint


# Motion, and what follows from it ----------------------------------------------------------------


def _with_motion(rng, data, material, geared):
    """The drawn arm with motion, friction, limits and gauges; None if it is outside the limits."""
    count = len(data["joints"])
    middle = rng.uniform(-0.8, 0.8, count)
    turn = rng.uniform(*ANGLE, count) * rng.choice([-1.0, 1.0], count)
    ends = np.round([middle - 0.5 * turn, middle + 0.5 * turn], 4)
    plain = model.build(arm_file.parse(yaml.safe_dump(data)))
    omega = min(plain.frequencies(q, locked=True)[0] for q in ends)
    if not FREQUENCIES[0] <= omega / (2.0 * np.pi) <= FREQUENCIES[1]:
        return None
    period = 2.0 * np.pi / omega
    profile = profiles.quintic(*ends, round(PERIODS * period, 3))
    _limit(rng, data, plain, profile, geared)
    _add_gauges(rng, data)
    whole = model.build(arm_file.parse(yaml.safe_dump(data)))
    strain = _peak_strain(whole, profile)
    if strain is None or strain.max() > material.strain:
        return None
    for gauge, largest in zip(data["gauges"], strain, strict=True):
        # The full scale leaves room for vibration, but is no coarser than needed.
        gauge["full_scale"] = next(s for s in (1e-3, 2e-3, 5e-3, 1e-2, 2e-2) if s >= 4.0 * largest)
    start, end = (";".join(f"{angle:.4f}" for angle in q) for q in ends)
    motion = f"quintic:from={start},to={end},duration={profile.duration:g}"
    return RandomArm(data["name"], data, motion, float(period))


def _limit(rng, data, plain, profile, geared):
    """Give the joints friction, and limits within which the motion stays."""
    times = np.linspace(0.0, profile.duration, 61)
    q, qd, qdd = (np.array([profile.derivative(k, t) for t in times]) for k in range(3))
    load = np.array([_rigid_torque(plain, *x) for x in zip(q, qd, qdd, strict=True)])
    for i, joint in enumerate(data["joints"]):
        speed, need = np.abs(qd[:, i]).max(), np.abs(load[:, i]).max()
        viscous = _short(rng.uniform(0.0, 0.05) * need / speed)
        coulomb = _short(rng.uniform(0.0, 0.1 if geared else 0.03) * need)
        joint["friction"] = {"viscous": viscous, "coulomb": coulomb, "smoothing": 0.01}
        rubbed = load[:, i] + viscous * qd[:, i] + coulomb * np.tanh(qd[:, i] / 0.01)
        room = rng.uniform(0.5, 1.0)
        joint["limits"] = {
            "position": [_short(q[:, i].min() - room), _short(q[:, i].max() + room)],
            "velocity": _short(rng.uniform(*SPEED) * speed),
            "torque": _short(rng.uniform(*TORQUE) * np.abs(rubbed).max()),
        }
        if joint["safe_action"] == "brake":
            joint["brake_torque"] = _short(1.5 * joint["limits"]["torque"])


def _rigid_torque(plain, q, qd, qdd):
    """Torque of the rigid arm, (n,) [N m]."""
    terms = plain.terms(q, qd)
    return terms.M[: q.size, : q.size] @ qdd + terms.f1


def _add_gauges(rng, data):
    """Add as many gauges as modes, on every link in every direction, at the root and where the second mode bends."""
    noise, bits = _short(_log(rng, 3e-7, 2e-6)), int(rng.choice([14, 16]))
    data["gauges"] = [
        {
            "name": f"{link['name']}_{direction}{i + 1}",
            "link": link["name"],
            "position": _short(place * link["length"]),
            "direction": direction,
            "surface_distance": _short(0.5 * _thickness(link["section"], direction)),
            "noise": noise,
            "bits": bits,
            "full_scale": 0.02,
        }
        for link in data["links"]
        for direction, flexible in link["flexible"].items()
        for i, place in enumerate((0.02, 0.5)[: flexible["modes"]])
    ]


def _peak_strain(whole, profile):
    """Largest strain of each gauge when the arm follows its motion without inertia of the bending, (gauges,) [-].

    None if the arm bends too far, at rest or in motion.
    """
    rows, n = gauge_rows(whole, whole.arm.gauges), whole.n_joints
    reach = whole.arm.reach
    strains = []
    for t in np.linspace(0.0, profile.duration, 21):
        q, qd, qdd = (profile.derivative(k, t) for k in range(3))
        terms = whole.terms(q, qd)
        bent = np.linalg.solve(terms.K2, -terms.f2 - terms.M[n:, :n] @ qdd)
        resting = t in (0.0, profile.duration)
        if resting:
            bent = whole.static_deflection(q)
        away = whole.tip_position(q, bent) - whole.tip_position(q, np.zeros(whole.n_modes))
        if np.linalg.norm(away) > (MAX_SAG if resting else MAX_BENDING) * reach:
            return None
        strains.append(np.abs(rows @ bent))
    return np.max(strains, axis=0)
