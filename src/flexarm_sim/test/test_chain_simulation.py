"""Simulations of the general chain: against independent codes, orders, energy, prescribed motion, many at once."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm import Arm, Flexibility, Friction, Joint, Link, Payload
from flexarm_dynamics.chain import Chain
from flexarm_dynamics.errors import ShapeError
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


def data():
    """``tests/data`` of the repository, looked for upwards from here."""
    for parent in Path(__file__).resolve().parents:
        if (parent / "tests" / "data" / "parameters.json").is_file():
            return parent / "tests" / "data"
    raise FileNotFoundError(f"no tests/data above {__file__}")


@pytest.fixture(scope="module")
def parameters():
    return json.loads((data() / "parameters.json").read_text())


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
def test_one_link_follows_two_multibody_codes(parameters, level, modes, limits):
    """A torque pulse there and back."""
    table = np.genfromtxt(data() / "one_link_pulse.csv", delimiter=",", names=True)
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
def test_two_links_follow_two_multibody_codes(parameters, case, level, modes, limits):
    """Sinusoidal torques, and a tenth of them; what each level can not know is in the limits."""
    name = "two_link_torque" + ("_x0p1" if case else "")
    table = np.genfromtxt(data() / f"{name}.csv", delimiter=",", names=True)
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
        Joint(f"joint{i + 1}", axis, (0.1, 0.0, 0.05), tuple(rng.uniform(-1, 1, 3)), 0.05, 0.3, 1e-4, 10.0, slip)
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
    "method, order, step", [("rk4", 4, 2e-3), ("dop853", 8, 8e-3), ("implicit", 2, 5e-4)]
)
def test_order_of_the_integrators(level, method, order, step):
    """Torque linear in time, friction and damping; steps halved twice."""
    arm = planar(EI=(20.0, 30.0), damping=(0.02,), friction=Friction(0.05, 0.1, 0.5))
    chain = Chain(at_level(arm, level))
    start, torque, change = swinging(chain), np.array([0.8, -0.5]), np.array([-1.1, 0.9])
    T = 0.16
    exact = final(chain, "dop853", 5e-4, round(T / 5e-4), start, torque, change)
    print(
        method,
        [
            np.abs(final(chain, method, h, round(T / h), start, torque, change) - exact).max()
            for h in (step, step / 2, step / 4)
        ],
    )
