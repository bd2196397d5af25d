# SPDX-License-Identifier: Apache-2.0
"""Links given by reduced matrices: against beams of the same properties, Lagrange's equations, and solid elements."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from scipy.linalg import block_diag

from flexarm_dynamics.arm import arm_file, reduced
from flexarm_dynamics.arm.description import Arm, Flexibility, Joint, Link, Payload
from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.arm.urdf import PieceChain
from flexarm_dynamics.errors import ArmFileError
from flexarm_dynamics.models import levels, reduction
from flexarm_dynamics.models.chain import Chain

LEVELS = ("first_order", "stiffening")
DIRECTIONS = {"y": 2, "z": 2, "twist": 1}


def spatial():
    """Two beams that bend and twist, about askew axes."""
    joints = (
        Joint("joint1", (0.6, 0.8, 0.0), (0.1, 0.0, 0.05), (0.2, -0.4, 0.3), hub_inertia=0.05),
        Joint("joint2", (0.0, -0.6, 0.8), (0.03, 0.02, 0.0), (0.5, 0.3, -0.6), 0.04, 0.5),
    )
    stiffness = {"y": 5.0, "z": 7.0, "twist": 3.0}
    flexible = {d: Flexibility(n, "clamped_free", (), (0.02,)) for d, n in DIRECTIONS.items()}
    links = tuple(Link(f"link{i}", 0.6 + 0.1 * i, 0.5, stiffness, flexible, 2e-3) for i in (1, 2))
    payload = Payload(
        0.2, ((2e-3, 0.0, 1e-4), (0.0, 3e-3, 0.0), (1e-4, 0.0, 4e-3)), (0.05, 0.02, 0.0)
    )
    return Arm("spatial", joints, links, payload, gravity=(1.0, -2.0, -9.0))


def pair(level, which=(0, 1)):
    """A chain of beams, the same with links given by their reduced matrices, and the beams' amplitudes from theirs."""
    beams = Chain(levels.at_level(spatial(), level), compiled=False)
    links, mix = list(beams.arm.links), []
    for i, link in enumerate(links):
        arrays = reduction.of_link(beams, link.name)
        if i not in which:
            mix.append(np.eye(len(arrays["translation"])))
            continue
        made = reduced.of_arrays(arrays)
        flexible = {"reduced": Flexibility(made.modes, "reduced")}
        links[i] = replace(link, stiffness={}, flexible=flexible, reduced=made)
        places = [np.concatenate([a[f"station_{part}"].transpose(0, 2, 1).reshape(-1, made.modes)
                                  for part in ("translation", "rotation")]) for a in (arrays, made)]  # fmt: skip
        mix.append(np.linalg.lstsq(*places, rcond=None)[0])
    kept = [link.name for i, link in enumerate(links) if i not in which]
    shapes = {key: shape for key, shape in beams._shapes.items() if key[0] in kept}
    shapes |= {(links[i].name, "reduced"): reduced.Shapes(links[i].reduced) for i in which}
    chain = Chain(replace(beams.arm, links=tuple(links)), compiled=False, shapes=shapes)
    return beams, chain, block_diag(*mix)


def state(chain, size=0.02):
    rng = np.random.default_rng(4)
    n, m = chain.n_joints, chain.n_modes
    return (
        rng.uniform(-2, 2, n),
        size * rng.uniform(-1, 1, m),
        rng.standard_normal(n),
        0.3 * rng.standard_normal(m),
    )


@pytest.mark.parametrize("which", [(0, 1), (0,), (1,)])
def test_at_first_order_it_is_the_beam(which):
    beams, chain, mix = pair("first_order", which)
    q, delta, qd, rates = state(chain)
    B = block_diag(np.eye(2), mix)
    M = B.T @ beams.mass_matrix(q, mix @ delta) @ B
    assert_allclose(chain.mass_matrix(q, delta), M, atol=1e-12 * np.abs(M).max())
    force = B.T @ beams.forces(q, qd, mix @ delta, mix @ rates)
    assert_allclose(chain.forces(q, qd, delta, rates), force, atol=1e-11 * np.abs(force).max())
    assert_allclose(chain.tip_position(q, delta), beams.tip_position(q, mix @ delta), atol=1e-13)
    assert_allclose(
        chain.potential_energy(q, delta), beams.potential_energy(q, mix @ delta), atol=1e-12
    )
    for one, other in zip(
        chain.momentum(q, qd, delta, rates),
        beams.momentum(q, qd, mix @ delta, mix @ rates),
        strict=True,
    ):
        assert_allclose(one, other, atol=1e-12)
    assert_allclose(chain.frequencies(q), beams.frequencies(q), rtol=1e-9)


def test_it_stiffens_as_the_beam_does():
    """To first order in the deflections: what is left is of their square."""
    beams, chain, mix = pair("stiffening")
    q, _, qd, _ = state(chain)
    B = block_diag(np.eye(2), mix)
    K, C = chain.linearisation(q, 3.0 * qd)
    K0, C0 = beams.linearisation(q, 3.0 * qd)
    assert_allclose(K, B.T @ K0 @ mix, atol=1e-9 * np.abs(K).max())
    assert_allclose(C, B.T @ C0 @ mix, atol=1e-9 * np.abs(C).max())


def differences(function, z, n):
    """Derivatives by all coordinates, of eighth order."""
    weights = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
    steps = np.where(np.arange(z.size) < n, 1e-2, 1e-3)
    return np.array([
        sum(w * (function(z + k * h * e) - function(z - k * h * e)) / h for k, w in enumerate(weights, 1))
        for h, e in zip(steps, np.eye(z.size), strict=True)
    ])  # fmt: skip


@pytest.mark.parametrize("level", LEVELS)
def test_forces_are_lagranges_of_its_mass_matrix_and_power_balances(level):
    _, chain, _ = pair(level)
    q, delta, qd, rates = state(chain)
    n, z, v = 2, np.concatenate([q, delta]), np.concatenate([qd, rates])
    slopes = differences(lambda z: chain.mass_matrix(z[:n], z[n:]), z, n)
    rate = np.tensordot(v, slopes, 1)
    h = rate @ v - 0.5 * np.einsum("ijk,j,k->i", slopes, v, v)
    weight = differences(lambda z: chain.potential_energy(z[:n], z[n:]), z, n)
    d, damped = chain.data, np.zeros(z.size)
    for i in range(n):
        at = slice(d.first[i], d.first[i] + d.count[i])
        damped[n:][at] = d.damping[i, : d.count[i], : d.count[i]] @ rates[at]
    ours = chain.forces(q, qd, delta, rates)
    assert_allclose(ours, weight + h + damped, atol=1e-10 * np.abs(ours).max())
    # The power of torque and damping is the rate of the energy: M', weight as above.
    torque = np.array([1.0, -2.0])
    rates_of = chain.derivative(np.concatenate([z, v]), torque)
    M = chain.mass_matrix(q, delta)
    power = v @ M @ rates_of[z.size :] + 0.5 * v @ rate @ v + v @ weight
    assert power == pytest.approx(torque @ qd - v @ damped, rel=1e-9)


# --- from the arm file -------------------------------------------------------------------------


def arrays_of():
    return reduction.of_link(Chain(spatial(), compiled=False), "link1")


@pytest.fixture
def write(tmp_path):
    """Writes arrays and reads the arm that has them."""

    def read(arrays, **more):
        np.savez(tmp_path / "link.npz", **arrays)
        data = {
            "name": "arm", "joints": [{"name": "joint"}],
            "links": [{"name": "boom", "reduced": {"file": "link.npz", **more.pop("reduced", {})}}],
            "payload": {"mass": 0.3}, **more,
        }  # fmt: skip
        (tmp_path / "arm.yaml").write_text(yaml.safe_dump(data))
        return arm_file.load(tmp_path / "arm.yaml")

    return read


def test_an_archive_is_read_beside_its_arm_file(write):
    arrays = arrays_of() | {
        "strain_names": np.array(["root", "side"]),
        "strain": np.random.default_rng(1).random((2, 5)),
    }
    gauges = [
        {"name": "gauge", "link": "boom", "point": "side"},
        {"name": "other", "link": "boom", "point": "root"},
    ]
    arm = write(arrays, reduced={"modes": 2}, gauges=gauges)
    link = arm.links[0]
    assert arm.mode_names == ("boom_reduced_mode1", "boom_reduced_mode2")
    assert link.length == pytest.approx(0.7) and link.mass == pytest.approx(0.35)
    chain = Chain(arm, compiled=False)
    assert StrainMap(chain).rows.shape == (2, 2)
    assert (
        len(PieceChain(chain, 4).joint_values(np.array([0.3]), np.array([0.02, 0.01]))) == 1 + 3 * 5
    )
    assert arm.with_modes(3).mode_names[-1] == "boom_reduced_mode3"
    assert len(arm.with_modes(9).mode_names) == 5  # it has no more
    first, second = (
        chain.tip_deflection(np.array([0.01, 0.0])),
        chain.tip_deflection(np.array([0.0, 0.01])),
    )
    assert_allclose(np.abs([*first, *second]).max(), 0.02, rtol=1e-6)  # amplitudes are lengths


def spoilt(name):
    """Arrays with one thing wrong."""
    arrays = arrays_of()
    made = {
        "missing": lambda: arrays.pop("second"),
        "unknown": lambda: arrays.update(colour=np.zeros(3)),
        "shape": lambda: arrays.update(rotation=np.zeros((3, 5))),
        "text": lambda: arrays.update(mass=np.array("heavy")),
        "nan": lambda: arrays.update(tip=np.array([np.nan, 0.0, 0.0])),
        "asymmetric": lambda: arrays["modal_stiffness"].__setitem__((0, 1), 1e6),
        "free": lambda: arrays.update(modal_stiffness=np.diag([0.0, 1.0, 1.0, 1.0, 1.0])),
        "heavy shapes": lambda: arrays.update(translation=1e3 * arrays["translation"]),
        "behind": lambda: arrays.update(tip=np.array([-1.0, 0.0, 0.0])),
        "half a second order": lambda: arrays.update(second_tip=np.zeros((5, 5, 3))),
        "objects": lambda: arrays.update(mass=np.array([{}], dtype=object)),
    }[name]
    made()
    return arrays


@pytest.mark.parametrize(
    "name, array, words",
    [
        ("missing", "second", "missing"),
        ("unknown", "colour", "no such array"),
        ("shape", "rotation", "has the shape (3, 5) ((K, 3), K = 5)"),
        ("text", "mass", "real numbers"),
        ("nan", "tip", "is not finite"),
        ("asymmetric", "modal_stiffness", "is not symmetric"),
        ("free", "modal_stiffness", "is singular"),
        ("heavy shapes", "modal_mass", "are of no body"),
        ("behind", "tip", "x > 0"),
        ("half a second order", "second_translation", "missing"),
        ("objects", "", "can't be read"),
    ],
)
def test_what_is_wrong_with_an_archive_is_named(write, name, array, words):
    with pytest.raises(ArmFileError) as error:
        write(spoilt(name))
    field = "arm.yaml: links[0].reduced.file" + (f": {array}" if array else "")
    assert error.value.field == field and words in str(error.value)


@pytest.mark.parametrize(
    "link, field, words",
    [
        ({"reduced": {"file": "none.npz"}}, "links[0].reduced.file", "can't be read"),
        (
            {"reduced": {"file": "none.npz"}, "length": 1.0},
            "links[0].reduced.file",
            "can't be read",
        ),
    ],
)
def test_an_archive_that_is_not_there_is_named(link, field, words):
    with pytest.raises(ArmFileError) as error:
        arm_file.parse(
            yaml.safe_dump(
                {"name": "a", "joints": [{"name": "j"}], "links": [{"name": "l", **link}]}
            )
        )
    assert error.value.field == field and words in str(error.value)


def test_the_shipped_boom_has_the_frequencies_of_its_mesh():
    """Those of the whole mesh, its root held, without and with 0.2 kg at its tip (tests/data/solid_boom.py)."""
    for payload, exact in ((0.0, BARE), (0.2, LOADED)):
        arm = replace(arm_file.load("solid_boom"), payload=Payload(payload))
        chain = Chain(arm, compiled=False)
        found = chain.frequencies(np.zeros(1), locked=True)[: len(exact)] / (2.0 * np.pi)
        assert_allclose(found, exact, rtol=1e-4)


#: [Hz], printed by tests/data/solid_boom.py.
BARE = (16.96692498, 16.98041304, 75.1701423, 75.30019721)
LOADED = (11.02568513, 11.03885072, 56.7699794, 56.84948521)
