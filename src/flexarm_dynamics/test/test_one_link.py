# SPDX-License-Identifier: Apache-2.0
"""The one-link arm: a second derivation, energy, kinematics, the compiled kernel, independent trajectories."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from flexarm_dynamics.arm.description import Arm, Flexibility, Friction, Joint, Link, Payload
from flexarm_dynamics.arm.units import FOOT, POUND_FORCE
from flexarm_dynamics.errors import ModelError, ShapeError
from flexarm_dynamics.models.fixed_step import METHODS
from flexarm_dynamics.models.model import Tableau
from flexarm_dynamics.models.one_link import OneLink
from flexarm_dynamics.models.paper_appendix import PaperAppendix

METHOD = METHODS["dop853"]
FREE = np.array([[0.0, 0.0, 1.0]])  # no friction


def an_arm(
    modes=3,
    shape="loaded",
    gravity=(1.3, -9.1, 2.2),
    rpy=(0.3, -0.5, 1.1),
    offset=0.08,
    damping=(),
    friction=None,
):
    """An arm with everything in it: payload offset and inertia, gear, tilted base."""
    friction = friction or Friction()
    joint = Joint(
        "joint1",
        origin_xyz=(0.1, -0.2, 0.3),
        origin_rpy=rpy,
        hub_inertia=0.04,
        rotor_inertia=2e-6,
        gear_ratio=50.0,
        friction=friction,
    )
    frequencies = (3.0, 21.0, 63.0) if shape == "from_frequencies" else ()
    flexible = {"y": Flexibility(modes, shape, frequencies, damping)}
    link = Link("link1", 0.9, 0.31, {"y": 6.5}, flexible)
    inertia = np.diag([1e-3, 2e-3, 3e-3])
    payload = Payload(0.21, tuple(map(tuple, inertia)), (offset, 0.0, 0.0))
    return Arm("test", (joint,), (link,), payload, gravity=gravity)


def a_state(rng, model):
    """Random state with deflections of centimetres."""
    m = model.n_modes
    return np.concatenate(
        [
            rng.uniform(-3, 3, 1),
            0.03 * rng.standard_normal(m),
            2 * rng.standard_normal(1),
            rng.standard_normal(m),
        ]
    )


def split(model, state):
    """(q, delta, qd, delta_d) of a state."""
    n, m = model.n_joints, model.n_modes
    return np.split(state, [n, n + m, 2 * n + m])


class Lagrangian:
    """Kinetic and potential energy summed over the points of the arm, straight from where they are.

    Nothing is shared with the model but the mode shapes: points are placed in the base frame, velocities are
    derivatives of positions, the mass matrix comes from the kinetic energy by polarisation, and derivatives
    of both by complex steps. All functions take complex coordinates p = (q, delta).
    """

    STEP = 1e-30

    def __init__(self, model):
        arm = model.arm
        self.link, self.joint, self.payload = arm.links[0], arm.joints[0], arm.payload
        self.shapes, self.m = model.shapes, model.n_modes
        self.gravity = np.array(arm.gravity)
        self.base = Rotation.from_euler("xyz", self.joint.origin_rpy).as_matrix()
        nodes, weights = leggauss(150)
        self.xi = 0.5 * (nodes + 1.0)
        self.mass = 0.5 * weights * self.link.mass_per_length * self.link.length
        self.phi = self.shapes(self.xi)
        length = self.link.length
        self.curvature = self.shapes(self.xi, 2) / length**2
        self.bending = 0.5 * weights * length * self.link.stiffness["y"]
        self.slope = self.shapes(1.0, 1) / length
        self.centre = self.shapes(1.0) + self.payload.offset[0] * self.slope

    def position(self, p):
        """Points of the beam and the payload's centre of mass, shape (points + 1, 3), in the base frame."""
        x = np.append(self.xi * self.link.length, self.link.length + self.payload.offset[0])
        y = np.append(self.phi @ p[1:], self.centre @ p[1:])
        cos, sin = np.cos(p[0]), np.sin(p[0])
        local = np.stack([cos * x - sin * y, sin * x + cos * y, 0.0 * y], axis=1)
        return np.array(self.joint.origin_xyz) + local @ self.base.T

    def velocity(self, p, v):
        """Derivative of `position` along v, exact: position is linear in delta and (cos q, sin q)."""
        x = np.append(self.xi * self.link.length, self.link.length + self.payload.offset[0])
        y = np.append(self.phi @ p[1:], self.centre @ p[1:])
        yd = np.append(self.phi @ v[1:], self.centre @ v[1:])
        cos, sin = np.cos(p[0]), np.sin(p[0])
        dcos, dsin = -sin * v[0], cos * v[0]
        local = np.stack([dcos * x - dsin * y - sin * yd, dsin * x + dcos * y + cos * yd, 0 * y], 1)
        return local @ self.base.T

    def kinetic(self, p, v):
        velocity = self.velocity(p, v)
        masses = np.append(self.mass, self.payload.mass)
        rotation = v[0] + self.slope @ v[1:]
        hub = self.joint.hub_inertia + self.joint.rotor_inertia * self.joint.gear_ratio**2
        return 0.5 * (
            masses @ np.sum(velocity * velocity, axis=1)
            + hub * v[0] ** 2
            + self.payload.inertia[2][2] * rotation**2
        )

    def potential(self, p):
        masses = np.append(self.mass, self.payload.mass)
        bend = self.curvature @ p[1:]
        origin = masses.sum() * np.array(self.joint.origin_xyz) @ self.gravity
        return 0.5 * self.bending @ bend**2 - masses @ (self.position(p) @ self.gravity) + origin

    def mass_matrix(self, p):
        basis = np.eye(1 + self.m)
        single = [self.kinetic(p, e) for e in basis]
        return np.array(
            [
                [self.kinetic(p, a + b) - single[i] - single[j] for j, b in enumerate(basis)]
                for i, a in enumerate(basis)
            ]
        )

    def gradient(self, function, p):
        """Derivative of a real function (or matrix) of p, last axis: coordinate."""
        steps = 1j * self.STEP * np.eye(p.size)
        return np.stack([np.imag(function(p + step)) / self.STEP for step in steps], axis=-1)

    def other_terms(self, p, v):
        """Everything in Lagrange's equations but M a and the outer forces."""
        dM = self.gradient(self.mass_matrix, p)
        coriolis = np.einsum("ijk,j,k->i", dM, v, v) - 0.5 * np.einsum("jki,j,k->i", dM, v, v)
        return coriolis + self.gradient(self.potential, p)


@pytest.fixture(params=["loaded", "clamped_free", "from_frequencies"])
def model(request):
    return OneLink(an_arm(shape=request.param))


def test_equations_of_motion_and_energies_equal_those_of_an_independent_derivation(model):
    """M; C, K and f together as forces; accelerations; energies: at random states."""
    rng = np.random.default_rng(1)
    lagrangian = Lagrangian(model)
    for _ in range(20):
        state, torque = a_state(rng, model), rng.standard_normal(1)
        q, delta, qd, delta_d = split(model, state)
        p, v = np.concatenate([q, delta]), np.concatenate([qd, delta_d])
        t, M = model.terms(q, qd, delta, delta_d), lagrangian.mass_matrix(p)
        np.testing.assert_allclose(t.M, M, rtol=0, atol=1e-12)
        ours = np.concatenate(
            [t.f1 + t.C1 @ delta_d + t.K1 @ delta, t.f2 + t.C2 @ delta_d + t.K2 @ delta]
        )
        theirs = lagrangian.other_terms(p, v)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-11 * np.abs(theirs).max())
        pushed = np.append(torque, np.zeros(model.n_modes)) - theirs
        expected = np.concatenate([v, np.linalg.solve(M, pushed)])
        found = model.derivative(state, torque)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
        T, V = model.kinetic_energy(q, qd, delta, delta_d), model.potential_energy(q, delta)
        assert pytest.approx(lagrangian.kinetic(p, v), rel=1e-12) == T
        assert pytest.approx(lagrangian.potential(p), rel=1e-12, abs=1e-12) == V
        assert model.energy(state) == pytest.approx(T + V, rel=1e-15)


def test_constant_terms_are_those_without_deflections(model):
    """Assumptions a) and b) of the paper: M at zero deflection, C1 and K1 of the joints alone."""
    q, qd = np.array([0.7]), np.array([1.9])
    m = model.n_modes
    control, full = model.terms(q, qd), model.terms(q, qd, np.zeros(m), np.ones(m))
    for name in ("M", "f1", "f2", "C1", "C2", "K1", "K2"):
        np.testing.assert_array_equal(getattr(control, name), getattr(full, name), err_msg=name)
    assert not control.C1.any()
    bent = model.terms(q, qd, 0.01 * np.ones(m), np.ones(m))
    assert bent.M[0, 0] > control.M[0, 0]
    assert bent.C1.any()


def test_terms_at_one_state_do_not_change_those_at_another(model):
    m = model.n_modes
    before = model.terms(np.zeros(1), np.zeros(1)).M.copy()
    model.terms(np.ones(1), np.ones(1), np.ones(m), np.ones(m)).M[0, 0] = 99.0
    np.testing.assert_array_equal(model.terms(np.zeros(1), np.zeros(1)).M, before)


def test_tip_stands_where_base_joint_and_bending_put_it():
    model = OneLink(an_arm(rpy=(0.0, 0.0, np.pi / 2)))
    delta = np.array([0.02, 0.0, 0.0])
    y = model.shapes(1.0)[0] * 0.02
    np.testing.assert_allclose(model.tip_deflection(delta), [y, 0.0])
    # The base turns x into y and y into -x.
    np.testing.assert_allclose(
        model.tip_position(np.zeros(1), delta), [0.1 - y, -0.2 + 0.9, 0.3], atol=1e-15
    )
    np.testing.assert_allclose(
        model.tip_position(np.array([np.pi / 2]), delta), [0.1 - 0.9, -0.2 - y, 0.3], atol=1e-15
    )


def test_a_horizontal_arm_in_gravity_hangs_down_as_a_cantilever():
    """Static deflection under its own weight and the payload's, many modes, against beam tables."""
    arm = an_arm(modes=20, gravity=(0, -9.81, 0), rpy=(0, 0, 0), offset=0.0)
    model = OneLink(arm)
    t = model.terms(np.zeros(1), np.zeros(1))
    delta = -np.linalg.solve(t.K2, t.f2)
    link, M, g = arm.links[0], arm.payload.mass, 9.81
    L, EI = link.length, link.stiffness["y"]
    sag = link.mass_per_length * g * L**4 / (8 * EI) + M * g * L**3 / (3 * EI)
    assert model.tip_deflection(delta)[0] == pytest.approx(-sag, rel=2e-5)
    weight = g * (link.mass * L / 2 + M * L)
    assert t.f1[0] == pytest.approx(weight, rel=1e-12)


@pytest.mark.parametrize("name", ["P3", "R", "one link"])
def test_an_unforced_undamped_arm_keeps_its_energy_in_scipy_and_in_the_compiled_stepper(
    name, shipped
):
    """Ten seconds, in the stepper at 1 ms; the published model has an energy of its own."""
    model = OneLink(an_arm(modes=2)) if name == "one link" else shipped(name)
    state = np.array([0.4, 0.03, -0.002, 0.8, 0.2, -0.1])
    times = np.linspace(0.0, 10.0, 21)
    result = solve_ivp(
        lambda t, s: model.derivative(s, np.zeros(1)), (0.0, 10.0), state, "DOP853", times,
        rtol=1e-9, atol=1e-11,
    )  # fmt: skip
    advance, stepped = model.stepper(METHOD), [state.copy()]
    for _ in range(20):
        stepped.append(stepped[-1].copy())
        advance(stepped[-1], np.zeros(1), 1e-3, 500, FREE)
    for states in (result.y.T, stepped):
        energy = np.array([model.energy(s) for s in states])
        exchanged = np.ptp([model.potential_energy(*split(model, s)[:2]) for s in states])
        assert np.ptp(energy) < 1e-8 * exchanged


def test_compiled_stepper_follows_scipy_under_torque_and_friction():
    model = OneLink(an_arm(damping=(0.01,), friction=Friction(0.2, 0.4, 0.5)))
    start = np.array([0.4, 0.03, -0.002, 0.0005, 0.8, 0.2, -0.1, 0.05])
    torque = np.array([1.7])
    state = start.copy()
    model.stepper(METHOD)(state, torque, 2.5e-4, 4000, model.friction_table())
    result = solve_ivp(
        lambda t, s: model.derivative(s, torque), (0, 1), start, "DOP853", rtol=1e-10, atol=1e-12
    )
    np.testing.assert_allclose(state, result.y[:, -1], atol=1e-9)


def test_stepper_takes_the_friction_that_it_is_given():
    """A brake of the plant is friction of another size, not the joint's own."""
    model = OneLink(an_arm(gravity=(0, 0, 0), friction=Friction(0.2, 0.4, 0.5)))
    advance = model.stepper(METHOD)
    state = np.zeros(8)
    state[4] = 1.0
    braked = state.copy()
    advance(state, np.zeros(1), 1e-4, 100, FREE)
    advance(braked, np.zeros(1), 1e-4, 100, np.array([[0.0, 5.0, 0.01]]))
    momentum = model.terms(np.zeros(1), np.zeros(1)).M[0]
    assert momentum @ state[4:] == pytest.approx(momentum[0], rel=1e-3)
    assert momentum @ braked[4:] < momentum[0] - 0.04


def test_power_balance_with_torque_friction_and_damping():
    """Energy changes by the torque's work less what friction and damping take, at every state."""
    friction = Friction(viscous=0.3, coulomb=0.7, smoothing=0.4)
    model = OneLink(an_arm(damping=(0.01, 0.02, 0.03), friction=friction))
    rng = np.random.default_rng(6)
    for _ in range(20):
        state, torque = a_state(rng, model), rng.standard_normal(1)
        rate = model.derivative(state, torque)
        # Fourth-order central difference of the energy along the motion.
        h = 1e-4

        def along(k, state=state, rate=rate, h=h):
            return model.energy(state + k * h * rate)

        power = (8 * (along(1) - along(-1)) - (along(2) - along(-2))) / (12 * h)
        _, _, qd, delta_d = split(model, state)
        lost = friction.viscous * qd[0] ** 2
        lost += friction.coulomb * qd[0] * np.tanh(qd[0] / friction.smoothing)
        lost += delta_d @ model.coefficients.D @ delta_d
        assert power == pytest.approx(torque[0] * qd[0] - lost, abs=1e-6 * (1 + abs(lost)))


def test_friction_opposes_motion_and_adds_up():
    model = OneLink(an_arm(friction=Friction(0.3, 0.7, 0.4)))
    np.testing.assert_array_equal(model.friction_table(), [[0.3, 0.7, 0.4]])
    speed = np.array([0.4])
    expected = 0.3 * 0.4 + 0.7 * np.tanh(1.0)
    assert model.friction(speed)[0] == pytest.approx(expected, rel=1e-15)
    assert model.friction(-speed)[0] == pytest.approx(-expected, rel=1e-15)
    with_gravity = model.terms(np.zeros(1), speed).f1 - model.terms(np.zeros(1), np.zeros(1)).f1
    assert with_gravity[0] == pytest.approx(expected, rel=1e-12)


def kernel_difference(modes):
    """Largest relative difference of the kernel's accelerations and `derivative` over random states.

    One step of Euler's method with a step of one second adds the accelerations to the state.
    """
    arm = an_arm(modes=modes, damping=(0.01,), friction=Friction(0.2, 0.4, 0.5))
    model = OneLink(arm)
    advance = model.stepper(Tableau(np.zeros((1, 1)), np.ones(1), np.zeros(1)))
    rng = np.random.default_rng(7)
    worst = 0.0
    for _ in range(20):
        state, torque = a_state(rng, model), rng.standard_normal(1)
        expected, after = model.derivative(state, torque), state.copy()
        advance(after, torque, 1.0, 1, model.friction_table())
        worst = max(worst, np.abs(after - state - expected).max() / np.abs(expected).max())
    return worst


@pytest.mark.parametrize("modes", [1, 2, 5])
def test_kernel_gives_the_accelerations_of_the_model(modes):
    assert kernel_difference(modes) < 1e-12


def test_kernel_gives_the_same_without_compilation():
    """NUMBA_DISABLE_JIT=1 runs the same code as plain Python, in a process of its own."""
    code = (
        "import importlib.util as u, numba;"
        f"s = u.spec_from_file_location('t', {__file__!r}); t = u.module_from_spec(s);"
        "s.loader.exec_module(t);"
        "assert numba.config.DISABLE_JIT;"
        "d = t.kernel_difference(3); assert d < 1e-12, d;"
        "m = t.OneLink(t.an_arm()); x = t.np.full(8, 0.01);"
        "m.stepper(t.METHOD)(x, t.np.ones(1), 1e-3, 3, t.FREE);"
        "print(x.tolist())"
    )
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 0, run.stderr
    state = np.full(8, 0.01)
    OneLink(an_arm()).stepper(METHOD)(state, np.ones(1), 1e-3, 3, FREE)
    plain = np.array([float(v) for v in run.stdout.strip("[]\n").split(",")])
    np.testing.assert_allclose(state, plain, rtol=1e-12, atol=1e-14)


def test_derivative_refuses_a_state_of_the_wrong_shape():
    with pytest.raises(ShapeError) as error:
        OneLink(an_arm()).derivative(np.zeros(7), np.zeros(1))
    assert (error.value.field, error.value.value, error.value.limit) == ("state", (7,), (8,))


# --- against independent codes -----------------------------------------------------------------


def pulse_arm(parameters, modes=2, shape="loaded", payload_inertia=None):
    """The arm of ``one_link_pulse``."""
    p = parameters["one_link_pulse"]
    inertia = p["Jp"] if payload_inertia is None else payload_inertia
    return Arm(
        "pulse",
        (Joint("joint1", hub_inertia=p["Jh"]),),
        (Link("link1", p["L"], p["rhoA"], {"y": p["EI"]}, {"y": Flexibility(modes, shape)}),),
        Payload(p["Mp"], tuple(map(tuple, inertia * np.eye(3)))),
    )


def test_tip_follows_two_independent_multibody_codes(data, parameters):
    """Torque pulse, two loaded modes; what is left is the beam's foreshortening, 0.126 mm."""
    model = OneLink(pulse_arm(parameters))
    table = np.genfromtxt(data / "one_link_pulse.csv", delimiter=",", names=True)
    T = parameters["one_link_pulse"]["T"]
    advance = model.stepper(METHOD)
    state = np.zeros(6)
    tip, angle, across = [], [], []
    for t in table["t"]:
        tip.append(model.tip_position(state[:1], state[1:3])[:2])
        angle.append(state[0])
        across.append(model.tip_deflection(state[1:3])[0])
        torque = T if t < 0.5 - 1e-9 else -T if t < 1.0 - 1e-9 else 0.0
        advance(state, np.array([torque]), 1e-3, 10, FREE)
    error = np.hypot(*(np.array(tip) - np.stack([table["tip_x"], table["tip_y"]], axis=1)).T)
    assert error.max() < 0.25e-3
    assert np.abs(error - table["short1"]).max() < 20e-6
    assert np.abs(np.array(angle) - table["theta1"]).max() < 5e-6
    assert np.abs(np.array(across) - table["defl1"]).max() < 20e-6
    assert np.abs(table["defl1"]).max() > 0.016  # the arm did bend


@pytest.mark.parametrize("inertia", ["8.52e-5 (corrected)", "8.52e-3 (printed)"])
def test_locked_frequencies_with_loaded_modes_are_exact(frequencies, parameters, inertia):
    load = float(inertia.split()[0]) * POUND_FORCE * FOOT
    model = OneLink(pulse_arm(parameters, 4, payload_inertia=load))
    exact = frequencies["one_link"][f"clamped Jp={inertia}"]["rad_s"]
    np.testing.assert_allclose(model.frequencies(locked=True), exact, rtol=1e-8)


@pytest.mark.parametrize("locked, case", [(True, "clamped"), (False, "pinned")])
@pytest.mark.parametrize("shape, last", [("clamped_free", 1e-4), ("loaded", 3e-8)])
def test_frequencies_converge_from_above_as_modes_are_added(
    frequencies, parameters, locked, case, shape, last
):
    exact = np.array(frequencies["one_link"][f"{case} Jp=8.52e-5 (corrected)"]["rad_s"])
    errors = []
    for modes in (2, 4, 8, 16):
        model = OneLink(pulse_arm(parameters, modes, shape))
        found = model.frequencies(locked=locked)
        assert np.all(np.diff(found) > 0.0)
        errors.append((found[:2] - exact[:2]) / exact[:2])
    errors = np.array(errors)
    assert np.all(errors > -1e-9)  # Rayleigh-Ritz: never below
    assert np.all(errors[1:] <= errors[:-1] + 1e-9)
    assert np.all(errors[-1] < last)


def test_loaded_modes_take_the_payload_with_its_offset_and_inertia_about_z():
    """Then mass and stiffness of the locked arm are both diagonal."""
    c = OneLink(an_arm(shape="loaded", offset=0.08)).coefficients
    for matrix in (c.M22, c.K):
        scale = np.sqrt(np.diag(matrix))
        np.testing.assert_allclose(matrix / np.outer(scale, scale), np.eye(3), atol=1e-12)


def test_frequencies_depend_on_gravity_only_through_the_joint():
    """At rest K2 is elastic: the same at every angle."""
    model = OneLink(an_arm())
    np.testing.assert_array_equal(model.frequencies(), model.frequencies(np.array([1.0])))


# --- what it refuses ---------------------------------------------------------------------------


def of_directions(*directions):
    """Changes that make the arm's link flexible in these directions."""
    flexible = {d: Flexibility(2) for d in directions}
    link = replace(AN_ARM.links[0], flexible=flexible, stiffness=dict.fromkeys(directions, 1.0))
    return {"links": (link,)}


AN_ARM = replace(an_arm(), model="one_link")
JOINT, PAYLOAD = AN_ARM.joints[0], AN_ARM.payload
REFUSED = [
    ({"joints": AN_ARM.joints * 2, "links": AN_ARM.links * 2}, "links", ["link1", "link1"]),
    *(
        ({"joints": (replace(JOINT, axis=axis),)}, "axis of joint1", list(axis))
        for axis in ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
    ),
    *(
        (of_directions(*given), "flexible of link1", list(given))
        for given in (("z",), ("y", "z"), ("y", "twist"), ())
    ),
    *(
        ({"payload": replace(PAYLOAD, offset=offset)}, "payload.offset", list(offset))
        for offset in ((0.0, 1e-3, 0.0), (0.1, 0.0, -1e-3))
    ),
]


@pytest.mark.parametrize(("changes", "field", "value"), REFUSED)
def test_an_arm_that_is_not_one_link_bending_in_the_plane_of_motion_is_refused(
    changes, field, value
):
    with pytest.raises(ModelError, match="is not for model one_link") as error:
        OneLink(replace(AN_ARM, **changes))
    assert (error.value.field, error.value.value) == (field, value)


@pytest.mark.parametrize("where", [("link2", "y"), ("link1", "z")])
def test_mode_shapes_of_another_link_or_direction_are_refused(where):
    model = OneLink(an_arm())
    assert model.mode_shapes("link1", "y") is model.shapes
    with pytest.raises(ModelError) as error:
        model.mode_shapes(*where)
    assert error.value.field == f"{where[0]} in {where[1]}"


def test_the_appendix_and_the_full_model_do_not_share_coefficients(shipped):
    assert isinstance(shipped("R"), PaperAppendix)
    assert not isinstance(shipped("one_link"), PaperAppendix)
