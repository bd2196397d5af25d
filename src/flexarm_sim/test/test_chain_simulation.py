# SPDX-License-Identifier: Apache-2.0
"""Simulations of the general chain: against independent codes, orders, energy, prescribed motion, many at once."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm import arm_file, reduced
from flexarm_dynamics.arm.description import Arm, Flexibility, Friction, Joint, Link, Payload
from flexarm_dynamics.errors import ShapeError
from flexarm_dynamics.models import reduction
from flexarm_dynamics.models.chain import Chain
from flexarm_sim import batch
from flexarm_sim.integrators import METHODS, integrate, substeps

LEVELS = ("first order", "foreshortening", "finite slope")


def at_level(arm, level):
    """The same arm at another level of its model."""
    return replace(
        arm, foreshortening=level == "foreshortening", finite_slope=level == "finite slope"
    )


def split(chain, states):
    """(q, delta, qd, delta_d) of states."""
    n, m = chain.n_joints, chain.n_modes
    return np.split(states, [n, n + m, 2 * n + m], axis=-1)


# --- against two multibody codes ---------------------------------------------------------------


DATA = next(
    folder / "tests" / "data"
    for folder in Path(__file__).resolve().parents
    if (folder / "tests" / "data" / "parameters.json").is_file()
)


@pytest.fixture(scope="module")
def parameters():
    return json.loads((DATA / "parameters.json").read_text())


def one_link(parameters, modes):
    """The arm of ``one_link_pulse``."""
    p = parameters["one_link_pulse"]
    bending = {"y": Flexibility(modes, "loaded")}
    return Arm(
        "pulse",
        (Joint("joint1", hub_inertia=p["Jh"]),),
        (Link("link1", p["L"], p["rhoA"], {"y": p["EI"]}, bending),),
        Payload(p["Mp"], tuple(map(tuple, p["Jp"] * np.eye(3)))),
    )


def two_links(parameters, modes):
    """The arm of ``two_link_torque``."""
    p = parameters["two_link_torque"]
    bending = {"y": Flexibility(modes, "loaded")}
    return Arm(
        "reference",
        (
            Joint("joint1", hub_inertia=p["Jh1"]),
            Joint("joint2", hub_inertia=p["Jh2"], motor_mass=p["Mm"]),
        ),
        tuple(Link(f"link{i}", p["L"], p["rhoA"], {"y": p["EI"]}, bending) for i in (1, 2)),
        Payload(p["Mp"], tuple(map(tuple, p["Jp"] * np.eye(3)))),
    )


def errors(chain, states, table):
    """Largest distances of a run at 100 Hz from the reference."""
    q, delta, _, _ = split(chain, states)
    ends = np.array([chain.link_ends(*z) for z in zip(q, delta, strict=True)])
    out = {
        "theta1": np.abs(q[:, 0] - table["theta1"]).max(),
        "tip": np.hypot(ends[:, -1, 0] - table["tip_x"], ends[:, -1, 1] - table["tip_y"]).max(),
    }
    if "defl1" in table.dtype.names:
        across = [chain.tip_deflection(z, "link1")[0] for z in delta]
        out["deflection"] = np.abs(across - table["defl1"]).max()
    if chain.n_joints == 2:
        elbow = np.hypot(ends[:, 0, 0] - table["elbow_x"], ends[:, 0, 1] - table["elbow_y"])
        angles = [chain.base_angles(*z)[1] for z in zip(q, delta, strict=True)]
        out["elbow"] = elbow.max()
        out["alpha2"] = np.abs(angles - table["alpha2"]).max()
    return out


def within(found, limits):
    """Assert that errors are below their limits, and say all of them if not."""
    assert all(found[name] <= limit for name, limit in limits.items()), found


@pytest.mark.parametrize(
    "level, modes, limits",
    [
        ("first order", 2, {"tip": 0.25e-3, "theta1": 5e-6, "deflection": 20e-6}),
        ("foreshortening", 2, {"tip": 20e-6, "theta1": 1e-6, "deflection": 20e-6}),
        ("finite slope", 2, {"tip": 20e-6, "theta1": 1e-7, "deflection": 20e-6}),
        ("finite slope", 3, {"tip": 1e-6, "theta1": 1e-8, "deflection": 1e-6}),
    ],
)
@pytest.mark.slow
def test_one_link_follows_two_multibody_codes(parameters, level, modes, limits):
    """A torque pulse there and back."""
    table = np.genfromtxt(DATA / "one_link_pulse.csv", delimiter=",", names=True)
    chain = Chain(at_level(one_link(parameters, modes), level))
    T, t = parameters["one_link_pulse"]["T"], table["t"][:-1]
    torque = np.where(t < 0.5 - 1e-9, T, np.where(t < 1.0 - 1e-9, -T, 0.0))[:, None]
    count = substeps(chain, 0.01)
    states = np.zeros((table.size, 2 + 2 * modes))
    chain.stepper(METHODS["dop853"]).trajectory(states, torque, torque, 0.01 / count, count)
    found = errors(chain, states, table)
    within(found, limits)
    if level == "first order":  # what is left is that it does not draw back
        assert found["tip"] == pytest.approx(table["short1"].max(), abs=5e-6)


@pytest.mark.parametrize(
    "case, level, modes, limits",
    [
        ("x0p1", "first order", 2, {"theta1": 5e-5, "tip": 24e-6, "elbow": 24e-6, "alpha2": 2e-5}),
        ("x0p1", "foreshortening", 2, {"theta1": 5.5e-5, "tip": 5e-6, "elbow": 6e-6, "alpha2": 2e-5}),
        ("x0p1", "foreshortening", 3, {"theta1": 2e-6, "tip": 1e-6, "elbow": 1e-6, "alpha2": 1e-6}),
        ("x0p1", "finite slope", 3, {"theta1": 2e-6, "tip": 1e-6, "elbow": 1e-6, "alpha2": 1e-6}),
        ("", "first order", 2, {"theta1": 7.5e-3, "deflection": 5.7e-3}),
        ("", "foreshortening", 2, {"theta1": 1e-3, "tip": 1e-4, "elbow": 1e-4, "alpha2": 3e-4}),
        ("", "finite slope", 3, {"theta1": 5e-5, "tip": 2e-5, "elbow": 2e-5, "alpha2": 2e-5}),
    ],
)  # fmt: skip
@pytest.mark.slow
def test_two_links_follow_two_multibody_codes(parameters, case, level, modes, limits):
    """Sinusoidal torques, and a tenth of them; what each level can not know is in the limits."""
    name = "two_link_torque" + ("_x0p1" if case else "")
    table = np.genfromtxt(DATA / f"{name}.csv", delimiter=",", names=True)
    chain = Chain(at_level(two_links(parameters, modes), level))
    t = np.linspace(0.0, 4.0, 4001)
    size = 0.1 if case else 1.0
    torque = size * np.stack([np.sin(np.pi * t), 0.4 * np.sin(1.6 * np.pi * t)], axis=1)
    states = np.zeros((t.size, 4 + 4 * modes))
    count = substeps(chain, 1e-3)
    advance = chain.stepper(METHODS["dop853"])
    advance.trajectory(states, torque[:-1], torque[1:], 1e-3 / count, count)
    found = errors(chain, states[::10], table)
    within(found, limits)
    if (case, level) == ("", "first order"):
        assert found["theta1"] > 5e-3  # the levels differ by what they leave out
    if (case, level) == ("", "foreshortening"):
        assert found["theta1"] > 1e-4


@pytest.mark.parametrize("modes, limit", [(2, 50e-6), (3, 25e-6)])
@pytest.mark.slow
def test_tapered_links_follow_a_multibody_code(modes, limit):
    """Sinusoidal torques on the shipped arm with tapered links, without friction and damping."""
    table = np.genfromtxt(DATA / "tapered_torque.csv", delimiter=",", names=True)
    arm = at_level(bare(arm_file.load("tapered").with_modes(modes)), "finite slope")
    chain = Chain(arm)
    t = np.linspace(0.0, table["t"][-1], 10 * (table.size - 1) + 1)
    torque = np.stack([8.0 * np.sin(np.pi * t), 0.8 * np.sin(1.6 * np.pi * t)], axis=1)
    states = np.zeros((t.size, 4 + 4 * modes))
    count = substeps(chain, 1e-3)
    advance = chain.stepper(METHODS["rk4"], straight_line=False)
    advance.trajectory(states, torque[:-1], torque[1:], 1e-3 / count, count)
    within(errors(chain, states[::10], table), {"tip": limit, "elbow": limit})


@pytest.mark.slow
def test_a_boom_of_finite_elements_follows_a_multibody_code():
    """Exudyn's floating frame with the same reduced body: without weight, friction, hub and damping."""
    table = np.genfromtxt(DATA / "solid_boom.csv", delimiter=",", names=True)
    arm = bare(arm_file.load("solid_boom").with_modes(8))
    joint = replace(arm.joints[0], hub_inertia=0.0)
    chain = Chain(replace(arm, joints=(joint,), gravity=(0.0, 0.0, 0.0)))
    t = np.linspace(0.0, table["t"][-1], 50 * (table.size - 1) + 1)
    torque = (20.0 * np.sin(3.0 * np.pi * t))[:, None]
    states = np.zeros((t.size, 2 + 16))
    count = substeps(chain, 2e-4)
    advance = chain.stepper(METHODS["rk4"], straight_line=False)
    advance.trajectory(states, torque[:-1], torque[1:], 2e-4 / count, count)
    q, delta, _, _ = split(chain, states[::50])
    tips = np.array([chain.tip_position(*z) for z in zip(q, delta, strict=True)])
    far = np.linalg.norm(tips - np.column_stack([table[f"tip_{axis}"] for axis in "xyz"]), axis=1)
    assert far.max() < 5e-6


@pytest.mark.slow
def test_reduced_matrices_of_tapered_links_follow_those_links():
    """Both links of the shipped arm as archives, their second order included: stiffening, sinusoidal torques."""
    beams = Chain(at_level(bare(arm_file.load("tapered")), "foreshortening"))
    links = []
    for link in beams.arm.links:
        arrays = reduction.of_link(beams, link.name)
        del arrays["modal_damping"]
        made = reduced.of_arrays(arrays)
        flexible = {"reduced": Flexibility(made.modes, "reduced")}
        links.append(replace(link, stiffness={}, flexible=flexible, pieces=(), reduced=made))
    arm = replace(beams.arm, links=tuple(links), gauges=(), observed_modes=())
    t = np.linspace(0.0, 2.0, 2001)
    torque = np.stack([8.0 * np.sin(np.pi * t), 0.8 * np.sin(1.6 * np.pi * t)], axis=1)
    tips = []
    for chain in (beams, Chain(arm)):
        states = np.zeros((t.size, 12))
        count = substeps(chain, 1e-3)
        advance = chain.stepper(METHODS["rk4"], straight_line=False)
        advance.trajectory(states, torque[:-1], torque[1:], 1e-3 / count, count)
        q, delta, _, _ = split(chain, states[::10])
        tips.append([chain.tip_position(*z) for z in zip(q, delta, strict=True)])
    assert_allclose(tips[1], tips[0], atol=2e-6)


def bare(arm):
    """An arm without friction and modal damping."""
    joints = tuple(replace(j, friction=Friction()) for j in arm.joints)
    links = tuple(
        replace(link, flexible={d: replace(f, damping=()) for d, f in link.flexible.items()})
        for link in arm.links
    )
    return replace(arm, joints=joints, links=links)


# --- orders and stability of the integrators ---------------------------------------------------


def planar(EI=(4.0, 6.0), modes=2, gravity=(0.0, 0.0, 0.0), damping=(), friction=None):
    """Two links in a plane."""
    friction = friction or Friction()
    links = tuple(
        Link(f"link{i + 1}", 0.7, 0.4, {"y": stiffness}, {"y": Flexibility(modes, "loaded", (), damping)})
        for i, stiffness in enumerate(EI)
    )  # fmt: skip
    joints = tuple(
        Joint(f"joint{i}", hub_inertia=0.05, motor_mass=0.3, friction=friction) for i in (1, 2)
    )
    return Arm("planar", joints, links, Payload(0.2), gravity=gravity)


def spatial(level="first order", friction=False):
    """Three links, the middle one rigid, that bend both ways and twist under gravity."""
    rng = np.random.default_rng(5)
    slip = Friction(0.1, 0.2, 0.5) if friction else Friction()
    axes = ((0.0, 0.0, 1.0), (0.6, 0.8, 0.0), (0.0, -1.0, 0.0))
    joints = tuple(
        Joint(
            f"joint{i + 1}", axis, (0.1, 0.0, 0.05), tuple(rng.uniform(-1, 1, 3)),
            hub_inertia=0.05, motor_mass=0.3, rotor_inertia=1e-4, gear_ratio=10.0, friction=slip,
        )
        for i, axis in enumerate(axes)
    )  # fmt: skip
    stiffness = {"y": 5.0, "z": 7.0, "twist": 3.0}
    every = {d: Flexibility(1, "loaded") for d in stiffness}
    links = tuple(
        Link(f"link{i + 1}", 0.6, 0.5, stiffness, {} if i == 1 else every, 2e-3) for i in range(3)
    )
    inertia = ((2e-3, 1e-4, 0.0), (1e-4, 3e-3, 0.0), (0.0, 0.0, 4e-3))
    arm = Arm(
        "spatial",
        joints,
        links,
        Payload(0.2, inertia, (0.05, 0.02, -0.03)),
        gravity=(1.0, -2.0, -9.0),
    )
    return at_level(arm, level)


def swinging(chain, seed=3):
    """A state that turns and vibrates."""
    rng = np.random.default_rng(seed)
    n, m = chain.n_joints, chain.n_modes
    return np.concatenate(
        [rng.uniform(-1, 1, n), 0.02 * rng.uniform(-1, 1, m), rng.uniform(-1, 1, n), rng.uniform(-0.1, 0.1, m)]
    )  # fmt: skip


def final(chain, method, step, count, start, torque, change, **options):
    """State after `count` steps under torque that goes by `change` over all of them."""
    state = start.copy()
    chain.stepper(METHODS[method], **options)(state, torque, step, count, None, change)
    return state


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize(
    "method, order, step", [("rk4", 4, 1e-3), ("dop853", 8, 4e-3), ("implicit", 2, 5e-4)]
)
@pytest.mark.slow
def test_order_of_the_integrators(level, method, order, step):
    """Torque linear in time, friction and damping; steps halved twice."""
    arm = planar(EI=(20.0, 30.0), damping=(0.02,), friction=Friction(0.05, 0.1, 0.5))
    chain = Chain(at_level(arm, level))
    start, torque, change = swinging(chain), np.array([0.8, -0.5]), np.array([-1.1, 0.9])
    T = 0.16
    exact = final(chain, "dop853", 2.5e-4, round(T / 2.5e-4), start, torque, change)
    off = [
        np.abs(final(chain, method, h, round(T / h), start, torque, change) - exact).max()
        for h in (step, step / 2.0)
    ]
    assert off[1] > 1e-9  # above rounding, or the order means nothing
    assert np.log2(off[0] / off[1]) == pytest.approx(order, abs=0.06 * order)


def stiff(chain):
    """Highest free frequency [rad/s]."""
    return chain.frequencies()[-1]


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_the_implicit_method_damps_modes_that_blow_up_in_an_explicit_one(level):
    """The highest mode turns by 50 rad a step; it is set swinging."""
    chain = Chain(at_level(planar(), level))
    scale = (5e4 / stiff(chain)) ** 2
    chain = Chain(at_level(planar(EI=(4.0 * scale, 6.0 * scale)), level))
    assert stiff(chain) * 1e-3 == pytest.approx(50.0, rel=1e-9)
    _, shapes = chain.normal_modes()
    start = np.zeros(12)
    start[:6] = 1e-4 * shapes[:, -1] / np.abs(shapes[:, -1]).max()
    start[6:8] = 0.3, -0.5
    none = np.zeros(2)
    exploded = final(chain, "rk4", 1e-3, 20, start, none, none)
    assert not np.abs(exploded).max() < 1e3  # or not a number at all
    energies = [chain.energy(start)]
    for count in (1, 10, 100, 1000):
        energies.append(chain.energy(final(chain, "implicit", 1e-3, count, start, none, none)))
    turning = chain.kinetic_energy(start[:2], start[6:8], start[2:6], start[8:])
    assert energies[0] > 1.3 * turning
    assert energies[1] < energies[0] and energies[2] < turning * (1.0 + 1e-3)
    assert_allclose(energies[-2:], turning, rtol=1e-3)  # what turns goes on turning


@pytest.mark.parametrize("level", LEVELS)
def test_the_implicit_method_follows_the_soft_modes_of_a_stiff_arm(level):
    """Link 1 is too stiff for the step, link 2 is not."""
    chain = Chain(at_level(planar(EI=(6e5, 6.0), damping=(0.01,)), level))
    assert stiff(chain) * 1e-3 > 10.0
    start, torque, change = np.zeros(12), np.array([2.0, -0.5]), np.array([-1.0, 1.0])
    start[4:6] = 0.03, -0.002
    T = 0.1
    exact = final(chain, "dop853", 1e-5, round(T / 1e-5), start, torque, change)
    off = []
    for h in (1e-3, 5e-4):
        found = final(chain, "implicit", h, round(T / h), start, torque, change)
        off.append(np.abs(found - exact)[[0, 1, 4, 5]].max())
    assert off[0] < 1e-3
    assert 3.3 < off[0] / off[1] < 4.7


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_the_implicit_method_takes_stiff_friction():
    """A brake whose slip is far faster than a step: implicit in the joints too."""
    friction = Friction(viscous=500.0, coulomb=2.0, smoothing=1e-2)
    chain = Chain(planar(EI=(40.0, 60.0), friction=friction))
    start, torque, none = np.zeros(12), np.array([50.0, -25.0]), np.zeros(2)
    start[6:8] = 1.0, -2.0
    exact = final(chain, "dop853", 1e-5, 5000, start, torque, none)
    state = final(chain, "implicit", 1e-3, 50, start, torque, none)
    for found, theirs in zip(split(chain, state)[:3], split(chain, exact)[:3], strict=True):
        assert_allclose(found, theirs, atol=0.05 * np.abs(theirs).max())
    assert not np.abs(final(chain, "rk4", 1e-3, 50, start, torque, none)).max() < 1e3


@pytest.mark.parametrize("smoothing", [1e-2, 1e-3])
@pytest.mark.parametrize("speed", [0.0, 0.02, -1.0])
def test_the_implicit_method_holds_a_joint_by_coulomb_friction(smoothing, speed):
    """Slipping or not to begin with, it ends in the slow creep at which friction equals the torque."""
    friction = Friction(coulomb=2.0, smoothing=smoothing)
    chain = Chain(planar(EI=(40.0, 60.0), damping=(0.1,), friction=friction))
    start, torque = np.zeros(12), np.array([1.0, -0.5])
    start[6] = speed
    state = final(chain, "implicit", 1e-3, 10_000, start, torque, np.zeros(2))
    assert_allclose(state[6:8], smoothing * np.arctanh([0.5, -0.25]), rtol=5e-3)


def test_the_implicit_method_takes_stiff_damping():
    """Modes damped almost critically: the rate of decay times the step is beyond what explicit methods bear."""
    chain = Chain(planar(EI=(4e5, 6e5), damping=(0.9,)))
    assert stiff(chain) * 1e-3 > 5.0
    start, none = np.zeros(12), np.zeros(2)
    start[2:6] = 1e-3, -1e-4, 1e-3, 1e-4
    state = final(chain, "implicit", 1e-3, 100, start, none, none)
    assert chain.energy(state) < 1e-6 * chain.energy(start)


# --- energy ------------------------------------------------------------------------------------

FREE = {
    "planar": planar(),
    "planar, foreshortening": at_level(planar(), "foreshortening"),
    "planar, finite slope": at_level(planar(), "finite slope"),
    "spatial, gravity": spatial(),
    "spatial, gravity, finite slope": spatial("finite slope"),
}


@pytest.mark.parametrize("name", FREE)
@pytest.mark.slow
def test_free_motion_keeps_its_energy_for_ten_seconds(name):
    chain = Chain(FREE[name])
    for more, drift in ((1, 2e-6), (2, 1e-8), (4, 1e-10)):  # than the substeps that the plant takes
        count = more * substeps(chain, 1e-2)
        states = np.zeros((1001, 2 * (chain.n_joints + chain.n_modes)))
        states[0] = swinging(chain)
        none = np.zeros((1000, chain.n_joints))
        chain.stepper(METHODS["dop853"]).trajectory(states, none, none, 1e-2 / count, count)
        q, delta, _, _ = split(chain, states[::10])
        energies = np.array([chain.energy(s) for s in states[::10]])
        exchanged = np.ptp([chain.potential_energy(*z) for z in zip(q, delta, strict=True)])
        assert np.ptp(energies) < drift * exchanged
    assert np.ptp(q, axis=0).min() > 0.5 and np.ptp(delta, axis=0).max() > 0.01


# --- prescribed motion -------------------------------------------------------------------------


def held_torque(chain, state, qdd):
    """Torque that gives joints an acceleration, from the inverse dynamics."""
    q, delta, qd, delta_d = split(chain, state)
    n, zero = chain.n_joints, np.zeros(chain.n_modes)
    rest = chain.inverse_dynamics(q, qd, qdd, delta, delta_d, zero)
    delta_dd = -np.linalg.solve(chain.mass_matrix(q, delta)[n:, n:], rest[n:])
    whole = chain.inverse_dynamics(q, qd, qdd, delta, delta_d, delta_dd)
    assert np.abs(whole[n:]).max() < 1e-9 * (1.0 + np.abs(rest).max())
    return whole[:n]


@pytest.mark.parametrize("level", LEVELS)
def test_prescribed_accelerations_move_the_joints_and_shake_the_links(level):
    """Against the same motion under the torques of the inverse dynamics."""
    chain = Chain(spatial(level))
    n, T = chain.n_joints, 0.3
    start = swinging(chain)
    first, change = np.array([3.0, -2.0, 4.0]), np.array([-5.0, 1.0, -6.0])
    state, count = start.copy(), 3 * substeps(chain, T)
    chain.driven_stepper(METHODS["dop853"])(state, first, T / count, count, None, change)
    q, delta, qd, _ = split(chain, state)
    q0, _, qd0, _ = split(chain, start)
    assert_allclose(qd, qd0 + T * (first + change / 2.0), atol=1e-12)
    assert_allclose(q, q0 + T * qd0 + T**2 * (first / 2.0 + change / 6.0), atol=1e-12)

    def torque(t, s):
        return held_torque(chain, s, first + change * t / T)

    pushed = integrate(chain, start, torque, np.array([0.0, T]), 1e-11, 1e-13)[-1]
    for ours, theirs in zip(split(chain, state), split(chain, pushed), strict=True):
        assert_allclose(ours, theirs, atol=1e-8 * np.abs(theirs).max())
    free = integrate(chain, start, lambda t, s: np.zeros(n), np.array([0.0, T]))[-1]
    assert np.abs(split(chain, free)[1] - delta).max() > 1e-3  # the links feel it


def test_the_implicit_method_takes_a_prescribed_motion_with_order_two():
    chain, T = Chain(spatial(friction=True)), 0.1
    first, change = np.array([3.0, -2.0, 4.0]), np.array([-5.0, 1.0, -6.0])

    def at_the_end(method, count):
        state = swinging(chain)
        chain.driven_stepper(METHODS[method])(state, first, T / count, count, None, change)
        return split(chain, state)

    exact = at_the_end("dop853", 3 * substeps(chain, T))
    count = 2 * substeps(chain, T)
    coarse, fine = at_the_end("implicit", count), at_the_end("implicit", 2 * count)
    assert_allclose(fine[2], exact[2], atol=1e-12)
    for k in (0, 1, 3):
        errors = [np.abs(found[k] - exact[k]).max() for found in (coarse, fine)]
        assert 3.5 < errors[0] / errors[1] < 4.5


def test_prescribed_motion_knows_no_friction():
    chain = Chain(spatial(friction=True))
    state, start = swinging(chain), swinging(chain)
    chain.driven_stepper(METHODS["dop853"])(state, np.zeros(3), 1e-4, 1000)
    q, _, qd, _ = split(chain, state)
    assert_allclose(qd, split(chain, start)[2], atol=1e-12)
    assert_allclose(q, split(chain, start)[0] + 0.1 * qd, atol=1e-12)


def spin_up(level, modes=2):
    """Tip deflections [m] at 100 Hz: in 4 s to three times the first frequency, then on for 6 s; that speed."""
    link = Link("link1", 1.0, 0.3, {"y": 2.0}, {"y": Flexibility(modes, "loaded", (), (0.03,))})
    chain = Chain(at_level(Arm("blade", (Joint("joint1", hub_inertia=0.1),), (link,)), level))
    speed, rise = 3.0 * chain.frequencies(locked=True)[0], 4.0
    t = np.linspace(0.0, 10.0, 1001)
    acceleration = np.where(t < rise, speed / rise * (1.0 - np.cos(2.0 * np.pi * t / rise)), 0.0)
    acceleration = acceleration[:, None]
    states = np.zeros((t.size, 2 * (1 + modes)))
    states[0, 1] = 1e-3
    count = 2 * substeps(chain, 1e-2)
    advance = chain.driven_stepper(METHODS["dop853"])
    advance.trajectory(states, acceleration[:-1], acceleration[1:], 1e-2 / count, count)
    _, delta, qd, _ = split(chain, states)
    assert_allclose(qd[-1], speed, rtol=1e-6)
    return delta @ chain.mode_shapes("link1", "y")(1.0)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_beam_spun_up_past_its_first_frequency_stays_straight_if_it_keeps_its_length():
    """Kane, Ryan and Banerjee (1987), J. Guidance 10(2): a beam that may stretch diverges."""
    grows = spin_up("first order")
    assert not np.abs(grows[-1]) < 1e3
    for level in LEVELS[1:]:
        y = spin_up(level)
        assert np.isfinite(y).all()
        assert 0.01 < np.abs(y).max() < 0.4  # bent while it speeds up
        assert np.abs(y[-100:]).max() < 0.02 * np.abs(y).max()


# --- many at once ------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("workers", [1, 2, None])
@pytest.mark.slow
def test_a_batch_equals_its_runs_one_by_one_bit_for_bit(method, workers):
    rng = np.random.default_rng(11)
    chains = [Chain(planar(EI=EI)) for EI in ((4.0, 6.0), (5.0, 5.5))]
    chains += [Chain(at_level(planar(), level)) for level in LEVELS[1:]]
    models = [chains[i] for i in (0, 1, 2, 3, 0, 2, 1)]
    states = np.array([swinging(chain, seed) for seed, chain in enumerate(models)])
    torque = rng.uniform(-1.0, 1.0, (len(models), 21, 2))
    starts, ends = torque[:, :-1], torque[:, 1:]
    out = batch.simulate(models, states, starts, ends, 1e-3, 2, method, workers)
    assert out.shape == (7, 21, 12)
    assert_array_equal(out[:, 0], states)
    for chain, run, *inputs in zip(models, out, starts, ends, strict=True):
        alone = np.empty((21, 12))
        alone[0] = run[0]
        advance = chain.stepper(METHODS[method])
        advance.trajectory(alone, *map(np.ascontiguousarray, inputs), 1e-3, 2)
        assert_array_equal(run, alone)
        step = run[0].copy()
        for u, v in zip(*inputs, strict=True):
            advance(step, u, 1e-3, 2, None, v - u)
        assert_array_equal(run[-1], step)
    assert np.isfinite(out).all() and np.abs(out[0, -1] - out[4, -1]).max() > 1e-3


def test_one_arm_and_one_torque_serve_all_states_of_a_batch():
    chain = Chain(planar())
    states = np.array([swinging(chain, seed) for seed in range(5)])
    torque = np.array([[1.0, -0.5], [0.5, 0.5], [0.0, 1.0]])
    out = batch.simulate(chain, states, torque[:-1], torque[1:], 1e-3, 3, "rk4", 2)
    every = [np.broadcast_to(x, (5, 2, 2)) for x in (torque[:-1], torque[1:])]
    assert_array_equal(out, batch.simulate([chain] * 5, states, *every, 1e-3, 3, "rk4", 1))
    alone = batch.simulate(chain, states[2], torque[:-1], torque[1:], 1e-3, 3, "rk4")
    assert_array_equal(alone, out[2:3])


def test_a_batch_of_nothing_is_nothing():
    torque = np.zeros((3, 2))
    nothing = batch.simulate(Chain(planar()), np.zeros((0, 12)), torque, torque, 1e-3)
    assert nothing.shape == (0, 4, 12)


def test_batches_of_the_wrong_shape_are_refused_with_both_sizes():
    chain, torque, good = Chain(planar()), np.zeros((3, 2)), np.zeros((4, 12))
    for models, states, starts, ends, field, value, limit in (
        (chain, np.zeros((4, 10)), torque, torque, "states", 10, 12),
        ([chain, Chain(spatial())], good[:2], torque, torque, "states", 12, 18),
        ([chain] * 3, good, torque, torque, "models", 3, 4),
        (chain, good, np.zeros((3, 3)), np.zeros((3, 3)), "torque", ((3, 3),) * 2, "(..., 2)"),
        (chain, good, torque, np.zeros((4, 2)), "torque", ((3, 2), (4, 2)), "(..., 2)"),
        (chain, good, np.zeros(2), np.zeros(2), "torque", ((2,), (2,)), "(..., 2)"),
    ):
        with pytest.raises(ShapeError) as error:
            batch.simulate(models, states, starts, ends, 1e-3)
        assert (error.value.field, error.value.value, error.value.limit) == (field, value, limit)
