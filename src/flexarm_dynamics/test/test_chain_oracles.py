# SPDX-License-Identifier: Apache-2.0
"""The general chain against what knows nothing of it.

Two flexible links in a plane against sympy (`two_link_symbolic`), rigid spatial arms against MuJoCo, one link
against its closed form, and, for what none of them covers, the identities that Lagrange's equations imply.
"""

import importlib.util
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model


def _neighbour(name):
    """A module beside this file: pytest's importlib mode puts nothing on the path."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


symbolic = _neighbour("two_link_symbolic")


def plain(value):
    """Arrays and numpy numbers as YAML has them."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return value


def build(data):
    """The model of an arm given as nested dicts."""
    return model.build(arm_file.parse(yaml.safe_dump(plain({"name": "oracle", **data}))))


def force(chain, q, qd, delta, delta_d):
    """All that stands on the left of (2) but the accelerations, shape (n + m,)."""
    t = chain.terms(q, qd, delta, delta_d)
    return np.concatenate(
        [t.f1 + t.C1 @ delta_d + t.K1 @ delta, t.f2 + t.C2 @ delta_d + t.K2 @ delta]
    )


def assert_matrix(ours, theirs, tolerance):
    """Entries compared in the units of their row and column, so that small modes count too."""
    scale = np.sqrt(np.diag(theirs))
    error = np.abs(ours - theirs) / np.outer(scale, scale)
    worst = np.unravel_index(error.argmax(), error.shape)
    assert error.max() <= tolerance, f"M{worst}: {error.max():.2e}"


def assert_vector(ours, theirs, tolerance, what="", scale=None):
    scale = np.abs(theirs).max() if scale is None else scale
    error = np.abs(ours - theirs) / scale
    assert error.max() <= tolerance, f"{what}[{error.argmax()}]: {error.max():.2e} of {scale:.2e}"


def rotation(rpy):
    """URDF's fixed-axis roll, pitch, yaw."""
    return Rotation.from_euler("xyz", rpy).as_matrix()


def quadrature(count):
    """Gauss's points and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1.0) / 2.0, weights / 2.0


def inertia_matrix(six):
    """An inertia from its six numbers in the file's order."""
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def random_inertia(rng, size):
    """Inertia of a random rigid body, six numbers."""
    points = size * rng.standard_normal((4, 3))
    matrix = sum((p @ p) * np.eye(3) - np.outer(p, p) for p in points)
    return np.append(np.diag(matrix), matrix[[0, 0, 1], [1, 2, 2]])


def stiffnesses(rng):
    """Random EI and GJ of a link."""
    return {key: rng.uniform(2, 9) for key in ("EI_y", "EI_z", "GJ")}


def rigid_arm(rng, count):
    """A random arm of `count` rigid links, as the file's dicts."""

    def origin():
        return {"xyz": rng.uniform(-0.3, 0.3, 3), "rpy": rng.uniform(-3.0, 3.0, 3)}

    joints = [
        {
            "name": f"joint{i + 1}",
            "axis": rng.standard_normal(3),
            "origin": origin(),
            "hub_inertia": rng.uniform(0.01, 0.2),
            "motor_mass": rng.uniform(0.0, 2.0),
            "rotor_inertia": rng.uniform(1e-4, 1e-3),
            "gear_ratio": rng.uniform(1.0, 12.0),
        }
        for i in range(count)
    ]
    links = [
        {
            "name": f"link{i + 1}",
            "length": rng.uniform(0.1, 1.2),
            "mass_per_length": rng.uniform(0.2, 3.0),
            "polar_inertia_per_length": rng.uniform(1e-4, 1e-2),
        }
        for i in range(count)
    ]
    payload = {
        "mass": rng.uniform(0.1, 2.0),
        "inertia": random_inertia(rng, 0.1),
        "offset": rng.uniform(-0.3, 0.3, 3),
    }
    gravity = rng.uniform(-10.0, 10.0, 3)
    return {"joints": joints, "links": links, "payload": payload, "gravity": gravity}


# --- a) two flexible links in a plane, against sympy -------------------------------------------


SHAPES = {
    "clamped_free": ("clamped_free", "clamped_free"),
    "loaded": ("clamped_free", "loaded"),
    "from_frequencies": ("from_frequencies", "clamped_free"),
}
#: How the plane of motion lies in the arm file: direction of bending, axis, plane -> joint's frame.
PLANES = {
    "y": ("y", (0.0, 0.0, 1.0), np.eye(3)),
    "z": ("z", (0.0, -1.0, 0.0), np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])),
}


class Planar:
    """A random two-link arm: its model and, from the same numbers, its symbolic twin."""

    def __init__(self, seed, shapes="clamped_free", plane="y", gravity=True, others=()):
        rng = np.random.default_rng(seed)
        direction, axis, turn = PLANES[plane]
        gx, gy = rng.uniform(-10.0, 10.0, 2) * gravity
        rpy = rng.uniform(-1.5, 1.5, 3)
        self.base = rotation(rpy) @ turn  # plane of motion -> base frame of the file
        self.start = rng.uniform(-0.5, 0.5, 3)
        across = rng.uniform(-10.0, 10.0) * gravity  # felt by the bearings alone
        data = rigid_arm(rng, 2)
        for joint, link, shape in zip(data["joints"], data["links"], SHAPES[shapes], strict=True):
            bending = {"modes": 2, "shape": shape}
            if shape == "from_frequencies":
                bending["frequencies"] = np.sort(rng.uniform([1.0, 15.0], [10.0, 60.0]))
            flexible = {direction: bending, **{other: {"modes": 2} for other in others}}
            joint |= {"axis": axis, "origin": {}}
            link |= {"length": rng.uniform(0.5, 1.5), **stiffnesses(rng), "flexible": flexible}
        joints, links, payload = data["joints"], data["links"], data["payload"]
        joints[0]["origin"] = {"xyz": self.start, "rpy": rpy}
        payload["offset"][1:] = 0.0
        if others:  # a payload that is its own mirror image in the plane
            payload["inertia"][3:] = across = 0.0
        data["gravity"] = self.base @ [gx, gy, across]
        self.chain = build(data)
        inertia = inertia_matrix(payload["inertia"])
        normal = turn[:, 2]
        self.twin = symbolic.TwoLink(
            tuple(self._link(*pair, direction) for pair in zip(joints, links, strict=True)),
            payload["mass"], normal @ inertia @ normal, payload["offset"][0], (gx, gy),
        )  # fmt: skip
        wanted = [f"link{i}_{direction}_mode{k}" for i in (1, 2) for k in (1, 2)]
        names = list(self.chain.mode_names)
        self.modes = np.array([names.index(name) for name in wanted])
        self.all = np.concatenate([[0, 1], 2 + self.modes])
        self.rng = rng

    def _link(self, joint, link, direction):
        """Integrals by a quadrature of our own: `ModeShapes` only says what the shapes are."""
        shapes = self.chain.mode_shapes(link["name"], direction)
        xi, weights = quadrature(100)
        phi, bend = shapes(xi), shapes(xi, 2)
        return symbolic.LinkData(
            length=link["length"],
            density=link["mass_per_length"],
            stiffness=link[f"EI_{direction}"],
            hub=joint["hub_inertia"],
            rotor=joint["rotor_inertia"],
            gear=joint["gear_ratio"],
            motor_mass=joint["motor_mass"],
            first=weights @ phi,
            moment=(weights * xi) @ phi,
            gram=phi.T @ (weights[:, None] * phi),
            bending=bend.T @ (weights[:, None] * bend),
            tip=shapes(1.0),
            slope=shapes(1.0, 1),
        )

    def state(self):
        """Random q, delta, qd, delta_d of the twin: nothing is zero, deflections of a decimetre."""
        rng = self.rng
        return (
            rng.uniform(-3, 3, 2),
            0.05 * rng.standard_normal(4),
            2 * rng.standard_normal(2),
            0.5 * rng.standard_normal(4),
        )

    def spread(self, delta):
        """The twin's four amplitudes among all of the model's."""
        out = np.zeros(self.chain.n_modes)
        out[self.modes] = delta
        return out

    def force(self, q, delta, qd, delta_d):
        out = force(self.chain, q, qd, self.spread(delta), self.spread(delta_d))
        return out[self.all]


PLANAR = [
    (1, "clamped_free", "y"),
    (2, "loaded", "y"),
    (3, "from_frequencies", "y"),
    (4, "loaded", "z"),
    (5, "from_frequencies", "z"),
]
planar_arms = pytest.mark.parametrize(("seed", "shapes", "plane"), PLANAR)
#: sympy takes seconds for its equations: of all processes that run tests, one derives them.
derived_once = pytest.mark.xdist_group("planar")
STATES = 5


@derived_once
@planar_arms
def test_planar_equations_of_motion(seed, shapes, plane):
    arm = Planar(seed, shapes, plane)
    twin, still = arm.twin, (np.zeros(2), np.zeros(4))
    for _ in range(STATES):
        q, delta, qd, delta_d = arm.state()
        M, v = twin.M(q, delta), np.concatenate([qd, delta_d])
        assert_matrix(arm.chain.terms(q, qd, delta, delta_d).M, M, 1e-10)
        energy = arm.chain.kinetic_energy(q, qd, delta, delta_d)
        assert energy == pytest.approx(0.5 * v @ M @ v, rel=1e-10)
        g, elastic = twin.g(q, delta), twin.K[:, 2:] @ delta
        assert_vector(arm.force(q, delta, *still) - elastic, g, 1e-10, "g")
        theirs = twin.h(q, delta, qd, delta_d) + g + elastic
        assert_vector(arm.force(q, delta, qd, delta_d), theirs, 1e-10, "force")
        torque, state = arm.rng.standard_normal(2), np.concatenate([q, delta, v])
        rates = arm.chain.derivative(state, torque)
        assert_vector(rates[:6], v, 1e-15, "rates")
        pushed = np.concatenate([torque, np.zeros(4)]) - theirs
        assert_vector(M @ rates[6:], pushed, 1e-9, "M acceleration")
        tip = np.append(twin.tip(q, delta), 0.0)
        assert_vector(arm.chain.tip_position(q, delta), arm.start + arm.base @ tip, 1e-12, "tip")
        e = 1e-6
        ahead, behind = (np.append(twin.tip(q + k * qd, delta + k * delta_d), 0) for k in (e, -e))
        velocity = arm.base @ (ahead - behind) / (2 * e)
        ours = arm.chain.tip_velocity(q, qd, delta, delta_d)
        assert_vector(ours, velocity, 1e-7, "tip velocity")


@derived_once
@planar_arms
def test_planar_velocity_and_elastic_forces_by_themselves(seed, shapes, plane):
    """Without gravity: elastic forces alone, then each rate alone and each pair, so that no term hides another."""
    arm = Planar(seed, shapes, plane, gravity=False)
    q, delta, qd, delta_d = arm.state()
    zd = np.concatenate([qd, delta_d])
    at_rest = arm.force(q, delta, np.zeros(2), np.zeros(4))
    assert_vector(at_rest, arm.twin.K[:, 2:] @ delta, 1e-10, "K delta")
    for i in range(6):
        for j in range(i, 6):
            kept = np.zeros(6)
            kept[[i, j]] = zd[[i, j]]
            h = arm.twin.h(q, delta, kept[:2], kept[2:])
            ours = arm.force(q, delta, kept[:2], kept[2:]) - at_rest
            # Some are no more than the rounding of the elastic forces.
            scale = max(np.abs(h).max(), 1e-4 * np.abs(at_rest).max())
            assert_vector(ours, h, 1e-10, f"h of rates {i}, {j}", scale)


@derived_once
@pytest.mark.parametrize("plane", ["y", "z"])
def test_planar_motion_stays_planar(plane):
    """Links that bend and twist out of the plane too: a mirror-symmetric motion excites none of it."""
    others = tuple(d for d in ("y", "z", "twist") if d != plane)
    arm = Planar(6, "loaded", plane, others=others)
    out_of_plane = np.setdiff1d(np.arange(2 + arm.chain.n_modes), arm.all)
    assert arm.chain.n_modes == 12
    for _ in range(STATES):
        q, delta, qd, delta_d = arm.state()
        twin = arm.twin
        M = arm.chain.terms(q, qd, arm.spread(delta), arm.spread(delta_d)).M
        assert_matrix(M[np.ix_(arm.all, arm.all)], twin.M(q, delta), 1e-10)
        scale = np.sqrt(np.diag(M))
        cross = (M / np.outer(scale, scale))[np.ix_(arm.all, out_of_plane)]
        assert np.abs(cross).max() < 1e-12
        theirs = twin.h(q, delta, qd, delta_d) + twin.g(q, delta) + twin.K[:, 2:] @ delta
        whole = force(arm.chain, q, qd, arm.spread(delta), arm.spread(delta_d))
        assert_vector(whole[arm.all], theirs, 1e-10, "force")
        assert np.abs(whole[out_of_plane]).max() < 1e-12 * np.abs(theirs).max()


@derived_once
@planar_arms
def test_planar_control_model(seed, shapes, plane):
    """Without deflections `terms` is the linearisation about them (docstring of `ArmModel.terms`)."""
    arm = Planar(seed, shapes, plane)
    q, _, qd, _ = arm.state()
    twin, zero, e = arm.twin, np.zeros(4), 1e-4

    def whole(delta, delta_d):
        return twin.h(q, delta, qd, delta_d) + twin.g(q, delta) + twin.K[:, 2:] @ delta

    steps = e * np.eye(4)
    K = np.array([8 * (whole(s, zero) - whole(-s, zero)) for s in steps])
    K = (K - np.array([whole(2 * s, zero) - whole(-2 * s, zero) for s in steps])).T / (12 * e)
    # The forces are quadratic in the rates: one step of any size is exact.
    C = np.array([whole(zero, d) - whole(zero, -d) for d in np.eye(4)]).T / 2
    terms = arm.chain.terms(q, qd)
    assert_matrix(terms.M, twin.M(q, zero), 1e-10)
    assert_vector(np.concatenate([terms.f1, terms.f2]), whole(zero, zero), 1e-10, "f")
    assert_vector(np.vstack([terms.K1, terms.K2]).ravel(), K.ravel(), 1e-8, "K")
    assert_vector(np.vstack([terms.C1, terms.C2]).ravel(), C.ravel(), 1e-10, "C")


# --- b) rigid spatial arms, against MuJoCo -----------------------------------------------------


class MuJoCo:
    """The same rigid arm in MuJoCo.

    A geared rotor is a body of its own on the previous link, whose angle is then tied to the joint's by the
    gear: x = P q, so that M = P^T M_x P and so on. Rods without thickness and hubs about one axis alone are
    no bodies that MuJoCo's compiler accepts: it compiles placeholders, which we overwrite.
    """

    def __init__(self, data):
        data = plain(data)
        self.joints, self.links, self.payload = data["joints"], data["links"], data["payload"]
        self.count = len(self.links)
        self.model = mujoco.MjModel.from_xml_string(self._xml(data["gravity"]))
        for i in range(self.count):
            self._set(f"link{i}", *self._link(i))
            if self.joints[i]["rotor_inertia"]:
                axis = np.array(self.joints[i]["axis"]) / np.linalg.norm(self.joints[i]["axis"])
                spin = self.joints[i]["rotor_inertia"] * np.outer(axis, axis)
                self._set(f"rotor{i}", 0.0, np.zeros(3), spin)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_setConst(self.model, self.data)
        self.P = np.zeros((self.model.nv, self.count))
        for i, joint in enumerate(self.joints):
            self.P[self.model.joint(f"joint{i}").dofadr[0], i] = 1.0
            if joint["rotor_inertia"]:
                self.P[self.model.joint(f"turn{i}").dofadr[0], i] = joint["gear_ratio"]

    def _xml(self, gravity):
        def row(values):
            return " ".join(repr(float(v)) for v in values)

        # Off centre and turned, so that the compiler takes no short cut for what we overwrite.
        blank = '<inertial pos=".1 .2 .3" mass="1" fullinertia="2 3 4 .1 .2 .3"/>'
        text = f'<site name="tip" pos="{self.links[-1]["length"]!r} 0 0"/>'
        for i in reversed(range(self.count)):
            origin = self.joints[i].get("origin", {"xyz": [0.0] * 3, "rpy": [0.0] * 3})
            before = self.links[i - 1]["length"] if i else 0.0
            xyz = np.add(origin["xyz"], [before, 0.0, 0.0])
            x, y, z, w = Rotation.from_euler("xyz", origin["rpy"]).as_quat()
            place = f'pos="{row(xyz)}" quat="{row((w, x, y, z))}"'
            axis = f'type="hinge" axis="{row(self.joints[i]["axis"])}"'
            link = f'{blank}<joint name="joint{i}" {axis}/>{text}'
            text = f'<body name="link{i}" {place}>{link}</body>'
            if self.joints[i]["rotor_inertia"]:  # else its body would have no inertia at all
                turn = f'{blank}<joint name="turn{i}" {axis}/>'
                text = f'<body name="rotor{i}" {place}>{turn}</body>{text}'
        return (
            f'<mujoco><compiler angle="radian"/><option gravity="{row(gravity)}"/>'
            f"<worldbody>{text}</worldbody></mujoco>"
        )

    def _link(self, i):
        """Mass, centre and inertia about it of link i and all that is fixed to it."""
        link, joint = self.links[i], self.joints[i]
        length, mass = link["length"], link["length"] * link["mass_per_length"]
        polar = link.get("polar_inertia_per_length", 0.0) * length
        square = mass * length**2 / 12.0
        parts = [(mass, np.array([length / 2, 0, 0]), np.diag([polar, square, square]))]
        axis = np.array(joint["axis"]) / np.linalg.norm(joint["axis"])
        parts.append((0.0, np.zeros(3), joint["hub_inertia"] * np.outer(axis, axis)))
        tip = np.array([length, 0.0, 0.0])
        if i + 1 < self.count:
            following = self.joints[i + 1]
            at = tip + following.get("origin", {"xyz": np.zeros(3)})["xyz"]
            parts.append((following["motor_mass"], at, np.zeros((3, 3))))
        else:
            inertia = inertia_matrix(self.payload["inertia"])
            parts.append((self.payload["mass"], tip + self.payload["offset"], inertia))
        total = sum(m for m, _, _ in parts)
        centre = sum(m * c for m, c, _ in parts) / total
        inertia = np.zeros((3, 3))
        for m, c, own in parts:
            r = c - centre
            inertia += own + m * ((r @ r) * np.eye(3) - np.outer(r, r))
        return total, centre, inertia

    def _set(self, name, mass, centre, inertia):
        k = self.model.body(name).id
        squares, axes = np.linalg.eigh(inertia)
        axes[:, 0] *= np.linalg.det(axes)
        x, y, z, w = Rotation.from_matrix(axes).as_quat()
        self.model.body_mass[k], self.model.body_ipos[k] = mass, centre
        self.model.body_inertia[k], self.model.body_iquat[k] = squares, (w, x, y, z)

    def at(self, q, qd):
        """Mass matrix, bias forces, tip's position and velocity, potential energy."""
        m, d = self.model, self.data
        # All joints are hinges: positions are numbered as the degrees of freedom are.
        d.qpos[:], d.qvel[:] = self.P @ q, self.P @ qd
        mujoco.mj_forward(m, d)
        M = np.zeros((m.nv, m.nv))
        for row, unit in zip(M, np.eye(m.nv), strict=True):
            mujoco.mj_mulM(m, d, row, unit)
        mujoco.mj_energyPos(m, d)
        jacobian = np.zeros((3, m.nv))
        mujoco.mj_jacSite(m, d, jacobian, None, m.site("tip").id)
        bias = self.P.T @ d.qfrc_bias
        tip = d.site("tip").xpos.copy()
        return self.P.T @ M @ self.P, bias, tip, jacobian @ d.qvel, float(d.energy[0])


NONE = np.zeros(0)


def test_mujoco_by_hand():
    """The double pendulum with hubs, geared rotors, motor and payload, from a textbook's formulae."""
    joint = {"axis": [0, 0, 1.0], "motor_mass": 0.7}
    first = {**joint, "hub_inertia": 0.05, "rotor_inertia": 3e-3, "gear_ratio": 4.0}
    second = {**joint, "hub_inertia": 0.08, "rotor_inertia": 2e-3, "gear_ratio": 7.0}
    l1, l2, rho1, rho2, mp, jp = 0.8, 0.6, 1.2, 0.9, 0.4, 0.03
    payload = {"mass": mp, "inertia": [0.01, 0.02, jp, 0, 0, 0], "offset": [0.1, 0, 0]}
    links = [{"length": l1, "mass_per_length": rho1}, {"length": l2, "mass_per_length": rho2}]
    arm = {"joints": [first, second], "links": links, "payload": payload, "gravity": [0, -9.81, 0]}
    q, qd = np.array([0.4, -1.1]), np.array([1.3, -0.6])
    M, bias, tip, velocity, _ = MuJoCo(arm).at(q, qd)

    m2 = rho2 * l2 + mp
    moment2 = rho2 * l2**2 / 2 + mp * (l2 + 0.1)
    I2 = 0.08 + rho2 * l2**3 / 3 + mp * (l2 + 0.1) ** 2 + jp
    cross = l1 * moment2 * np.cos(q[1])
    m11 = 0.05 + 16 * 3e-3 + rho1 * l1**3 / 3 + (0.7 + m2) * l1**2 + I2 + 2 * cross + 2e-3
    m12 = I2 + cross + 7 * 2e-3
    theirs = np.array([[m11, m12], [m12, I2 + 49 * 2e-3]])
    assert_matrix(M, theirs, 1e-13)
    k = l1 * moment2 * np.sin(q[1])
    far = 9.81 * moment2 * np.cos(q.sum())
    near = 9.81 * (rho1 * l1**2 / 2 + (0.7 + m2) * l1) * np.cos(q[0])
    coriolis = np.array([-k * (2 * qd[0] * qd[1] + qd[1] ** 2), k * qd[0] ** 2])
    assert_vector(bias, np.add(coriolis, [near + far, far]), 1e-13)
    a, b = q[0], q.sum()
    assert_vector(
        tip[:2], [l1 * np.cos(a) + l2 * np.cos(b), l1 * np.sin(a) + l2 * np.sin(b)], 1e-13
    )
    across = np.array([-l1 * np.sin(a), l1 * np.cos(a)]) * qd[0]
    across += np.array([-l2 * np.sin(b), l2 * np.cos(b)]) * qd.sum()
    assert_vector(velocity[:2], across, 1e-13)


@pytest.mark.parametrize("without", [(), ("rotor_inertia",), ("rotor_inertia", "hub_inertia")])
@pytest.mark.parametrize("count", range(1, 8))
def test_rigid_arm(count, without):
    """`without`: leave parts out, so that a failure says by its name what is wrong."""
    rng = np.random.default_rng(100 + count)
    data = rigid_arm(rng, count)
    for joint in data["joints"]:
        joint.update(dict.fromkeys(without, 0.0))
    chain, other = build(data), MuJoCo(data)
    still = build({**data, "gravity": [0, 0, 0]})
    assert chain.n_modes == 0
    potential = []
    for _ in range(4):
        q, qd = rng.uniform(-3, 3, count), 2 * rng.standard_normal(count)
        M, bias, tip, velocity, energy = other.at(q, qd)
        gravity = other.at(q, np.zeros(count))[1]
        assert_matrix(chain.terms(q, qd, NONE, NONE).M, M, 1e-9)
        assert_vector(force(chain, q, 0 * qd, NONE, NONE), gravity, 1e-9, "gravity")
        velocity_forces = force(still, q, qd, NONE, NONE)
        # One joint alone has no velocity forces: what is left is rounding of the energy's scale.
        scale = max(np.abs(bias - gravity).max(), 1e-3 * (qd @ M @ qd))
        assert_vector(velocity_forces, bias - gravity, 1e-9, "velocity", scale)
        assert_vector(force(chain, q, qd, NONE, NONE), bias, 1e-9, "bias")
        assert_vector(chain.tip_position(q, NONE), tip, 1e-9, "tip")
        assert_vector(chain.tip_velocity(q, qd, NONE, NONE), velocity, 1e-9, "tip velocity")
        assert chain.kinetic_energy(q, qd, NONE, NONE) == pytest.approx(0.5 * qd @ M @ qd, rel=1e-9)
        potential.append((chain.potential_energy(q, NONE), energy))
        without_deflections = chain.terms(q, qd)
        assert_matrix(without_deflections.M, M, 1e-9)
        assert_vector(without_deflections.f1, bias, 1e-9, "f1")
    # What does not move (the first motor) may or may not be counted: a constant.
    ours, theirs = np.diff(potential, axis=0).T
    assert_vector(ours, theirs, 1e-9, "potential")


# --- c) one link, against its closed form ------------------------------------------------------


ONE_LINK_SHAPES = ("clamped_free", "loaded", "from_frequencies")


def one_link_data(rng, shape, modes=2, damping=None):
    """A one-link arm with a tilted base and a geared rotor, as the file's dicts."""
    bending = {"modes": modes, "shape": shape}
    if shape == "from_frequencies":
        bending["frequencies"] = [3.1, 17.0, 52.0, 110.0][:modes]
    if damping:
        bending["damping"] = damping[:modes]
    rpy = rng.uniform(-1.5, 1.5, 3)
    joint = {"hub_inertia": 0.04, "rotor_inertia": 2e-5, "gear_ratio": 50.0, "motor_mass": 1.3}
    link = {"length": 0.9, "mass_per_length": 0.31, "EI_y": 6.5, "flexible": {"y": bending}}
    return {
        "gravity": rotation(rpy) @ [1.7, -9.2, 0.0],
        "joints": [{"name": "joint1", "origin": {"xyz": [0.1, -0.2, 0.3], "rpy": rpy}, **joint}],
        "links": [{"name": "link1", **link}],
        "payload": {"mass": 0.21, "inertia": [1e-3, 2e-3, 3e-3, 0, 0, 0]},
    }


@pytest.mark.parametrize("damping", [None, [0.01, 0.02]])
@pytest.mark.parametrize("modes", [1, 2, 4])
@pytest.mark.parametrize("shape", ONE_LINK_SHAPES)
def test_one_link_closed_form(shape, modes, damping):
    rng = np.random.default_rng(7 + modes)
    data = one_link_data(rng, shape, modes, damping)
    chain, closed = build(data), build({**data, "model": "one_link"})
    assert type(chain) is not type(closed), "the default model is the closed form itself"
    energies = []
    for _ in range(STATES):
        q, qd = rng.uniform(-3, 3, 1), 2 * rng.standard_normal(1)
        delta, delta_d = 0.03 * rng.standard_normal(modes), 0.5 * rng.standard_normal(modes)
        theirs = closed.terms(q, qd, delta, delta_d)
        assert_matrix(chain.terms(q, qd, delta, delta_d).M, theirs.M, 1e-12)
        for speed, rate in ((qd, delta_d), (0 * qd, 0 * delta_d), (qd, 0 * delta_d)):
            whole = force(closed, q, speed, delta, rate)
            assert_vector(force(chain, q, speed, delta, rate), whole, 1e-12, "force")
        # The undeflected arm: no elastic force to hide behind.
        zero = 0 * delta
        whole = force(closed, q, qd, zero, zero)
        assert_vector(force(chain, q, qd, zero, zero), whole, 1e-12, "gravity")
        ours, theirs = chain.terms(q, qd), closed.terms(q, qd)
        assert_matrix(ours.M, theirs.M, 1e-12)
        for name in ("f1", "f2", "C1", "C2", "K1", "K2"):
            a, b = np.ravel(getattr(ours, name)), np.ravel(getattr(theirs, name))
            assert_vector(a, b, 1e-12, name, max(np.abs(b).max(), 1e-3))
        for a, b in (
            (chain.tip_position(q, delta), closed.tip_position(q, delta)),
            (chain.tip_velocity(q, qd, delta, delta_d), closed.tip_velocity(q, qd, delta, delta_d)),
        ):
            assert_vector(a, b, 1e-12, "tip")
        energies.append((chain.potential_energy(q, delta), closed.potential_energy(q, delta)))
    ours, theirs = np.diff(energies, axis=0).T
    assert_vector(ours, theirs, 1e-11, "potential")


# --- d) what the others leave out: twist, and bending in space ---------------------------------


def test_twist_closed_form():
    """A shaft turned about its own axis: torsion, with the payload's centre off the axis."""
    rng = np.random.default_rng(11)
    L, polar, GJ, Jh, N, Jr = 0.8, 4e-3, 3.0, 0.02, 6.0, 1e-4
    mass, offset, six = 0.5, np.array([0.1, 0.07, -0.05]), random_inertia(rng, 0.05)
    joint = {"axis": [1, 0, 0], "hub_inertia": Jh, "rotor_inertia": Jr, "gear_ratio": N}
    link = {"length": L, "mass_per_length": 0.4, "polar_inertia_per_length": polar, "GJ": GJ}
    chain = build(
        {
            "gravity": [1.0, -9.0, 2.0],
            "joints": [{"name": "joint1", **joint}],
            "links": [{"name": "link1", **link, "flexible": {"twist": {"modes": 2}}}],
            "payload": {"mass": mass, "inertia": six, "offset": offset},
        }
    )
    shapes = chain.mode_shapes("link1", "twist")
    xi, weights = quadrature(60)
    phi, tip = shapes(xi), shapes(1.0)
    ends = six[0] + mass * (offset[1] ** 2 + offset[2] ** 2)
    beam = np.block(
        [
            [np.ones((1, 1)), (weights @ phi)[None, :]],
            [(weights @ phi)[:, None], phi.T @ (weights[:, None] * phi)],
        ]
    )
    both = np.concatenate([[1.0], tip])
    M = polar * L * beam + ends * np.outer(both, both)
    M[0, 0] += Jh + Jr * N**2
    slopes = shapes(xi, 1)
    K = GJ / L * slopes.T @ (weights[:, None] * slopes)
    for _ in range(STATES):
        q, qd = rng.uniform(-3, 3, 1), 2 * rng.standard_normal(1)
        delta, delta_d = 0.2 * rng.standard_normal(2), rng.standard_normal(2)
        assert_matrix(chain.terms(q, qd, delta, delta_d).M, M, 1e-11)
        angle = q[0] + tip @ delta
        c, s = np.cos(angle), np.sin(angle)
        y, z = -s * offset[1] - c * offset[2], c * offset[1] - s * offset[2]  # d/d angle
        theirs = -mass * (-9.0 * y + 2.0 * z) * both + np.concatenate([[0.0], K @ delta])
        assert_vector(force(chain, q, qd, delta, delta_d), theirs, 1e-10, "force")


def spatial_arm(seed, count=3):
    """A random spatial arm whose links bend both ways and twist."""
    rng = np.random.default_rng(seed)
    data = rigid_arm(rng, count)
    every = {"y": {"modes": 2}, "z": {"modes": 1}, "twist": {"modes": 1}}
    for i, link in enumerate(data["links"]):
        link["length"] += 0.3
        link.update(stiffnesses(rng))
        if i != 1:  # a rigid link among them
            link["flexible"] = every
    data["links"][0]["flexible"] = {"y": {"modes": 2}, "twist": {"modes": 1}}
    return build(data), rng


def differences(function, z, n):
    """Derivative along each coordinate, by central differences of eighth order; n joints."""
    weights = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
    # A centimetre of bending turns the tip of a short link far.
    steps = np.where(np.arange(z.size) < n, STEP, 0.1 * STEP)
    return np.array(
        [
            sum(
                w * (function(z + k * step * e) - function(z - k * step * e)) / step
                for k, w in enumerate(weights, 1)
            )
            for step, e in zip(steps, np.eye(z.size), strict=True)
        ]
    )


STEP = 1e-2


@pytest.mark.parametrize("which", [21, 22, 23, *ONE_LINK_SHAPES])
def test_an_arm_obeys_lagrange(which):
    """Forces from the model's own mass matrix and potential energy; the tip's velocity from its position.

    No second derivation: M itself is compared in the other tests. A number: a random spatial chain; a shape: the
    closed form of one link.
    """
    if which in ONE_LINK_SHAPES:
        rng = np.random.default_rng(24)
        chain = build({**one_link_data(rng, which), "model": "one_link"})
    else:
        chain, rng = spatial_arm(which)
    n, m = chain.n_joints, chain.n_modes
    zero = np.zeros(n + m)

    def M(z):
        return chain.terms(z[:n], zero[:n], z[n:], zero[n:]).M

    for _ in range(2):
        z = np.concatenate([rng.uniform(-3, 3, n), 0.03 * rng.standard_normal(m)])
        v = np.concatenate([2 * rng.standard_normal(n), 0.5 * rng.standard_normal(m)])
        q, delta, qd, delta_d = z[:n], z[n:], v[:n], v[n:]
        energy = chain.kinetic_energy(q, qd, delta, delta_d)
        assert energy == pytest.approx(0.5 * v @ M(z) @ v, rel=1e-10)
        assert np.linalg.eigvalsh(M(z)).min() > 0.0

        slopes = differences(M, z, n)
        rate = np.tensordot(v, slopes, 1)
        h = rate @ v - 0.5 * np.einsum("ijk,j,k->i", slopes, v, v)
        weight = differences(lambda z: chain.potential_energy(z[:n], z[n:]), z, n)
        at_rest = force(chain, q, zero[:n], delta, zero[n:])
        assert_vector(at_rest, weight, 1e-10, "gravity and elastic")
        moving = force(chain, q, qd, delta, delta_d)
        assert_vector(moving - at_rest, h, 1e-10, "h")

        tip = differences(lambda z: chain.tip_position(z[:n], z[n:]), z, n)
        ours = chain.tip_velocity(q, qd, delta, delta_d)
        assert_vector(ours, v @ tip, 1e-9, "tip velocity")


class TipFrames:
    """Position and rotation of a link's tip, read off a model: where it puts the end of one more link.

    Which rotation small deflections make in space is a convention; this takes the model's, so that mass and
    gravity are compared, whatever it is. Only `tip_position` is believed.
    """

    def __init__(self, data, count):
        stub = {"name": "stub", "length": 1.0, "mass_per_length": 1.0}
        self.chains = []
        for xyz in np.vstack([np.zeros(3), np.eye(3)]):
            joint = {"name": "stub", "origin": {"xyz": xyz}}
            part = {
                "joints": [*data["joints"][:count], joint],
                "links": [*data["links"][:count], stub],
            }
            self.chains.append(build(part))
        self.n, self.m = count, self.chains[0].n_modes

    def __call__(self, q, delta):
        q, delta = np.append(q[: self.n], 0.0), delta[: self.m]
        start, *ends = (chain.tip_position(q, delta) for chain in self.chains)
        R = np.array(ends).T - start[:, None]
        return start - R[:, 0], R  # the stub is 1 m long


@pytest.mark.parametrize("seed", [41, 42, 43])
def test_spatial_mass_and_gravity(seed):
    """Two links that bend both ways, the first twisting too, by quadrature over all that has mass."""
    rng = np.random.default_rng(seed)
    data = rigid_arm(rng, 2)
    bends = {"y": {"modes": 2}, "z": {"modes": 2}}
    for link, flexible in zip(
        data["links"], ({**bends, "twist": {"modes": 1}}, bends), strict=True
    ):
        link.update(stiffnesses(rng), flexible=flexible, length=rng.uniform(0.5, 1.2))
        link["polar_inertia_per_length"] = 1e-16  # twist carries what is beyond, not the beam
    chain = build(data)
    n, m = 2, chain.n_modes
    tips = [TipFrames(data, 1), TipFrames(data, 2)]
    xi, weights = quadrature(24)
    columns = {
        (f"link{i + 1}", d): [chain.mode_names.index(f"link{i + 1}_{d}_mode{k}") for k in (1, 2)]
        for i in range(2)
        for d in "yz"
    }
    axes = [np.array(j["axis"]) / np.linalg.norm(j["axis"]) for j in data["joints"]]

    def configuration(z):
        """Positions of beams, motor and payload; rotations of bases and tips: rows of three."""
        q, delta = z[:n], z[n:]
        frames, rows, rotations = [(np.zeros(3), np.eye(3))], [], []
        for i, (joint, link) in enumerate(zip(data["joints"], data["links"], strict=True)):
            before, turned = frames[-1]
            start = before + turned @ joint["origin"]["xyz"]
            R = turned @ rotation(joint["origin"]["rpy"])
            R = R @ Rotation.from_rotvec(q[i] * axes[i]).as_matrix()
            local = np.zeros((xi.size, 3))
            local[:, 0] = link["length"] * xi
            for axis, d in ((1, "y"), (2, "z")):
                shapes = chain.mode_shapes(link["name"], d)
                local[:, axis] = shapes(xi) @ delta[columns[link["name"], d]]
            rows += [start[None, :], start + local @ R.T]
            frames.append(tips[i](q, delta))
            rotations += [R, frames[-1][1]]
        rows.append((frames[-1][0] + frames[-1][1] @ data["payload"]["offset"])[None, :])
        return np.concatenate(rows + rotations)

    masses = [data["payload"]["mass"]]
    for joint, link in zip(data["joints"][::-1], data["links"][::-1], strict=True):
        beam = link["mass_per_length"] * link["length"] * weights
        masses = np.concatenate([[joint["motor_mass"]], beam, masses])
    K = np.zeros((n + m, n + m))
    for link in data["links"]:
        for d in link["flexible"]:
            which = [
                n + i for i, x in enumerate(chain.mode_names) if x.startswith(f"{link['name']}_{d}")
            ]
            order, power, name = (1, 1, "GJ") if d == "twist" else (2, 3, f"EI_{d}")
            bend = chain.mode_shapes(link["name"], d)(xi, order)
            gram = bend.T @ (weights[:, None] * bend)
            K[np.ix_(which, which)] = link[name] / link["length"] ** power * gram

    def spin(R, dR):
        """Angular velocity per coordinate, shape (n + m, 3)."""
        skew = dR @ R.T
        return np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)

    inertia = inertia_matrix(data["payload"]["inertia"])
    for _ in range(2):
        z = np.concatenate([rng.uniform(-3, 3, n), 0.05 * rng.standard_normal(m)])
        here, slopes = configuration(z), differences(configuration, z, n)
        points = slopes[:, : masses.size]
        M = np.einsum("p,ipx,jpx->ij", masses, points, points)
        rotations = here[masses.size :].reshape(-1, 3, 3)
        turns = slopes[:, masses.size :].reshape(n + m, -1, 3, 3)
        for R in rotations:
            assert np.abs(R @ R.T - np.eye(3)).max() < 1e-13
        spins = [spin(R, turns[:, k]) for k, R in enumerate(rotations)]
        parents = [np.zeros((n + m, 3)), spins[1]]
        for i, joint in enumerate(data["joints"]):
            axis = rotations[2 * i] @ axes[i]
            hub = spins[2 * i] @ axis
            rotor = parents[i] @ axis + joint["gear_ratio"] * np.eye(n + m)[i]
            M += joint["hub_inertia"] * np.outer(hub, hub)
            M += joint["rotor_inertia"] * np.outer(rotor, rotor)
        M += spins[3] @ rotations[3] @ inertia @ rotations[3].T @ spins[3].T
        q, delta = z[:n], z[n:]
        qd, delta_d = 2 * rng.standard_normal(n), 0.5 * rng.standard_normal(m)
        assert_matrix(chain.terms(q, qd, delta, delta_d).M, M, 1e-9)
        weight = -np.einsum("p,ipx,x->i", masses, points, data["gravity"])
        ours = force(chain, q, np.zeros(n), delta, np.zeros(m)) - K @ z
        assert_vector(ours, weight, 1e-9, "gravity", max(np.abs(weight).max(), 1.0))


@pytest.mark.parametrize("seed", [51, 52])
def test_tip_turns_by_its_slopes(seed):
    """To first order the tip turns by (twist, -z', y'), whatever the convention beyond."""
    rng = np.random.default_rng(seed)
    data = rigid_arm(rng, 1)
    link = data["links"][0]
    modes = {d: {"modes": 1} for d in ("y", "z", "twist")}
    link.update(length=0.7, EI_y=3.0, EI_z=4.0, GJ=2.0, flexible=modes)
    chain, tip = build(data), TipFrames(data, 1)
    q = rng.uniform(-3, 3, 1)
    base = tip(q, np.zeros(3))[1]
    e = 1e-5
    bend = [chain.mode_shapes("link1", d)(1.0, 1)[0] / 0.7 for d in "yz"]
    twist = chain.mode_shapes("link1", "twist")(1.0)[0]
    wanted = np.array([[0, 0, bend[0]], [0, -bend[1], 0], [twist, 0, 0]])
    for delta, turn in zip(e * np.eye(3), wanted, strict=True):
        change = base.T @ (tip(q, delta)[1] - tip(q, -delta)[1]) / (2 * e)
        vector = np.array([change[2, 1], change[0, 2], change[1, 0]])
        assert_vector(vector, turn, 1e-7, "slope")
        assert np.abs(change + change.T).max() < 1e-7


@pytest.mark.parametrize("seed", [31, 32])
def test_undeflected_spatial_arm_is_the_rigid_one(seed):
    """Locked modes leave MuJoCo's arm: joints' block of M, their forces, the tip."""
    rng = np.random.default_rng(seed)
    data = rigid_arm(rng, 4)
    other = MuJoCo(data)
    for link in data["links"]:
        link.update(EI_y=3.0, EI_z=4.0, GJ=2.0)
        link["flexible"] = {"y": {"modes": 2}, "z": {"modes": 1}, "twist": {"modes": 1}}
    chain = build(data)
    zero = np.zeros(chain.n_modes)
    for _ in range(STATES):
        q, qd = rng.uniform(-3, 3, 4), 2 * rng.standard_normal(4)
        M, bias, tip, velocity, _ = other.at(q, qd)
        assert_matrix(chain.terms(q, qd, zero, zero).M[:4, :4], M, 1e-9)
        assert_vector(force(chain, q, qd, zero, zero)[:4], bias, 1e-9, "bias")
        assert_vector(chain.tip_position(q, zero), tip, 1e-9, "tip")
        assert_vector(chain.tip_velocity(q, qd, zero, zero), velocity, 1e-9, "tip velocity")
