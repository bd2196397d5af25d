# SPDX-License-Identifier: Apache-2.0
"""Stepped and tapered links: exact beams, what their sections integrate to, and what the arm file refuses.

Their equations of motion are held against a second derivation in `test_chain`, their trajectories against another code
in `flexarm_sim`'s `test_chain_simulation`.
"""

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from scipy.linalg import eigh
from scipy.optimize import brentq
from scipy.special import iv, ivp, jv, jvp

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.arm.units import FOOT, POUND_FORCE
from flexarm_dynamics.arm.urdf import PieceChain
from flexarm_dynamics.errors import ArmFileError, ModelError
from flexarm_dynamics.models import beam, model
from flexarm_dynamics.models.chain import Chain
from flexarm_dynamics.models.varied_beam import BeamProblem, Body

XI = np.linspace(0.0, 1.0, 41)


def ones(xi):
    return np.ones_like(xi)


def frequencies(problem, count):
    """Natural frequencies of a beam problem, in units of sqrt(EI/(m L^4)), by Rayleigh's quotient of its shapes."""
    shapes = problem.shapes(count)
    order = 1 if problem.twist else 2
    M = shapes.gram(weight=problem.mass)
    for body in problem.bodies:
        at, slope = shapes(body.place), shapes(body.place, 1)
        cross = np.outer(at, slope)
        M += body.mass * np.outer(at, at) + body.moment * (cross + cross.T)
        M += body.inertia * (np.outer(at, at) if problem.twist else np.outer(slope, slope))
    return np.sqrt(eigh(shapes.gram(order, problem.stiffness), M, eigvals_only=True))


def roots(function, low, high, steps=4000):
    """Roots of a function between two ends."""
    x = np.linspace(low, high, steps)
    values = np.array([function(v) for v in x])
    change = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    return np.array([brentq(function, x[i], x[i + 1], xtol=1e-14) for i in change])


def test_a_uniform_beam_in_three_spans_has_the_closed_forms():
    breaks = [0.0, 0.3, 0.55, 1.0]
    for found, exact in (
        (BeamProblem(breaks, ones, ones).shapes(10), beam.clamped_free(10)),
        (BeamProblem(breaks, ones, ones, twist=True).shapes(4), beam.twist(4, 1.0, 1.0)),
        (
            BeamProblem([0.0, 1.0], ones, ones, [Body(1.0, 0.3, 0.03, 0.02)]).shapes(4),
            beam.loaded(4, 1.0, 1.0, 0.3, 0.02 - 0.003, 0.1),
        ),
    ):
        assert_allclose(found(XI), exact(XI), atol=1e-10)
        assert_allclose(found(XI, 2), exact(XI, 2), atol=1e-9 * np.abs(exact(XI, 2)).max())


@pytest.mark.parametrize("step, EI, m", [(0.4, 0.25, 0.5), (0.7, 4.0, 1.5)])
def test_a_stepped_beam_has_the_frequencies_of_its_transcendental_equation(step, EI, m):
    def determinant(omega):
        # y = cos, sin, cosh, sinh of each part; clamp, free end, and four conditions at the step.
        b1, b2 = np.sqrt(omega), np.sqrt(omega) * (m / EI) ** 0.25

        def rows(beta, x):
            c, s, C, S = np.cos(beta * x), np.sin(beta * x), np.cosh(beta * x), np.sinh(beta * x)
            return np.array(
                [
                    [c, s, C, S],
                    beta * np.array([-s, c, S, C]),
                    beta**2 * np.array([-c, -s, C, S]),
                    beta**3 * np.array([s, -c, S, C]),
                ]
            )

        A = np.zeros((8, 8))
        A[:2, :4] = rows(b1, 0.0)[:2]
        A[2:6, :4] = rows(b1, step)
        A[2:6, 4:] = -np.diag([1.0, 1.0, EI, EI]) @ rows(b2, 0.0)
        A[6:, 4:] = rows(b2, 1.0 - step)[2:]
        A /= np.abs(A).max(axis=1, keepdims=True)
        return np.linalg.det(A)

    exact = roots(determinant, 1.0, 140.0)[:4]
    problem = BeamProblem(
        [0.0, step, 1.0],
        lambda xi: np.where(xi <= step, 1.0, EI),
        lambda xi: np.where(xi <= step, 1.0, m),
    )
    assert_allclose(frequencies(problem, 4), exact, rtol=1e-9)


@pytest.mark.parametrize("order", [1, 2])
def test_a_beam_that_comes_to_a_point_has_the_frequencies_of_its_bessel_functions(order):
    """Wedge (mass ~ x, EI ~ x^3) and cone (x^2, x^4): y = x^(-n/2) [A J_n + B I_n](2 sqrt(w x))."""

    def determinant(omega):
        z = 2.0 * np.sqrt(omega)
        # Clamped at x = 1: value and derivative vanish; that of x^(-n/2) drops out.
        return jv(order, z) * ivp(order, z) - jvp(order, z) * iv(order, z)

    exact = roots(determinant, 2.0, 60.0)[:3]
    problem = BeamProblem(
        [0.0, 1.0], lambda xi: (1.0 - xi) ** (order + 2), lambda xi: (1.0 - xi) ** order
    )
    assert_allclose(frequencies(problem, 3), exact, rtol=1e-9)
    assert exact[0] == pytest.approx({1: 5.315, 2: 8.719}[order], abs=1e-3)  # as published


def test_bodies_along_a_beam_have_their_closed_forms():
    light = 1e-9
    a, mass = 0.6, 2.0
    problem = BeamProblem(
        [0.0, a, 1.0], ones, lambda xi: light * ones(xi), [Body(a, mass, 0.0, 0.0)]
    )
    assert frequencies(problem, 1)[0] == pytest.approx(np.sqrt(3.0 / (mass * a**3)), rel=1e-7)
    wheel = BeamProblem([0.0, a, 1.0], ones, lambda xi: light * ones(xi), [Body(a, 0.0, 0.0, 0.7)])
    assert frequencies(wheel, 1)[0] == pytest.approx(np.sqrt(1.0 / (0.7 * a)), rel=1e-7)


# --- from the arm file -------------------------------------------------------------------------

TUBE = {
    "shape": "tube", "density": 2700.0, "youngs_modulus": 7e10, "shear_modulus": 2.6e10,
    "outer_diameter": [0.05, 0.03], "wall": [0.002, 0.001],
}  # fmt: skip


def arm_of(link, units="si", gauges=()):
    """An arm of one link."""
    data = {
        "name": "varied", "units": units, "joints": [{"name": "joint", "hub_inertia": 1.0}],
        "links": [{"name": "boom", "length": 2.0, **link}], "gauges": list(gauges),
    }  # fmt: skip
    return arm_file.parse(yaml.safe_dump(data))


BENT = {"flexible": {d: {"modes": 2, "shape": "loaded"} for d in ("y", "z", "twist")}}


def test_a_tapered_tube_is_what_its_sizes_make_of_it():
    link = arm_of({"section": TUBE, **BENT}).links[0]
    x = np.linspace(0.0, 2.0, 7)
    outer, wall = 0.05 - 0.01 * x, 0.002 - 0.0005 * x
    inner = outer - 2.0 * wall
    second = np.pi / 64.0 * (outer**4 - inner**4)
    area = np.pi / 4.0 * (outer**2 - inner**2)
    assert_allclose([link.rigidity("y", v) for v in x], 7e10 * second, rtol=1e-9)
    assert_allclose([link.rigidity("twist", v) for v in x], 2.6e10 * 2.0 * second, rtol=1e-9)
    assert_allclose(link.mass_per_length * link.factor("mass", x / 2.0), 2700.0 * area, rtol=1e-9)
    fine = (np.arange(20000) + 0.5) / 10000.0
    m = link.mass_per_length * link.factor("mass", fine / 2.0) * 1e-4
    for part, (low, high) in (((0.0, 2.0), (0.0, 2.0)), ((0.3, 1.1), (0.3, 1.1))):
        here = (fine > low) & (fine < high)
        expected = [m[here].sum(), m[here] @ fine[here], m[here] @ fine[here] ** 2]
        assert_allclose(link.moments(*part)[:3], expected, rtol=1e-6)


def test_parts_have_the_material_and_shape_of_the_part_before_them():
    parts = [
        {"to": 0.8, **TUBE, "outer_diameter": 0.05, "wall": 0.002},
        {"outer_diameter": [0.05, 0.03], "wall": [0.002, 0.001]},
    ]
    link = arm_of({"sections": parts, **BENT}).links[0]
    assert link.breaks == (0.0, 0.4, 1.0)
    assert link.rigidity("y", 0.5) == link.rigidity("y", 0.1) == link.stiffness["y"]
    assert link.rigidity("y", 2.0) == pytest.approx(
        7e10 * np.pi / 64.0 * (0.03**4 - 0.028**4), rel=1e-9
    )


def test_parts_given_by_numbers_and_uniform_sections():
    parts = [
        {"to": 1.0, "mass_per_length": [1.0, 0.5], "EI_y": [20.0, 10.0]},
        {"mass_per_length": 0.5, "EI_y": 5.0},
    ]
    link = arm_of({"sections": parts, "flexible": {"y": {"modes": 1}}}).links[0]
    assert link.mass == pytest.approx(0.75 + 0.5)
    assert [link.rigidity("y", v) for v in (0.0, 0.5, 1.0, 1.5)] == pytest.approx([20, 15, 10, 5])
    uniform = {**TUBE, "outer_diameter": [0.05, 0.05], "wall": 0.002}
    assert arm_of({"section": uniform}).links == arm_of({"sections": [uniform]}).links
    assert arm_of({"section": uniform}).links[0].pieces == ()


def test_imperial_sections_are_those_in_si():
    stress = POUND_FORCE / FOOT**2
    imperial = {
        **TUBE, "density": 2700.0 * FOOT**4 / POUND_FORCE, "youngs_modulus": 7e10 / stress,
        "shear_modulus": 2.6e10 / stress,
        **{k: [v / FOOT for v in TUBE[k]] for k in ("outer_diameter", "wall")},
    }  # fmt: skip
    one = arm_of({"sections": [{"to": 0.5, **TUBE}, TUBE], **BENT}).links[0]
    parts = [{"to": 0.5 / FOOT, **imperial}, imperial]
    other = arm_of({"length": 2.0 / FOOT, "sections": parts, **BENT}, "imperial").links[0]
    assert other.mass == pytest.approx(one.mass, rel=1e-12)
    for x in (0.0, 0.4, 1.3, 2.0):
        for d in ("y", "z", "twist"):
            assert other.rigidity(d, x) == pytest.approx(one.rigidity(d, x), rel=1e-9)


@pytest.mark.parametrize(
    "link, field, words",
    [
        ({"section": {**TUBE, "wall": [0.002, 0.02]}}, "section.wall", "radius"),
        ({"section": {**TUBE, "wall": [0.002, 0.0]}}, "section.wall", "greater than 0"),
        ({"section": {**TUBE, "wall": [0.002]}}, "section.wall", "2 numbers"),
        ({"section": TUBE, "sections": [TUBE]}, "sections", "one of them"),
        ({"sections": [TUBE], "EI_y": 3.0}, "EI_y", "beside a section"),
        ({"sections": []}, "sections", "out of range"),
        ({"sections": [TUBE, TUBE]}, "sections[0].to", "missing"),
        ({"sections": [{"to": 2.5, **TUBE}, TUBE]}, "sections[0].to", "out of place"),
        ({"sections": [{"to": 1.5, **TUBE}]}, "sections[0].to", "2 m, the link's length"),
        (
            {"sections": [{"to": 1.0, "mass_per_length": 1.0, "EI_y": 1.0}, {"mass_per_length": 1.0}]},
            "sections[1]",
            "other stiffnesses",
        ),
        ({"sections": [{"mass_per_length": [1.0, -1.0]}]}, "sections[0].mass_per_length", "greater"),
        ({"sections": [{**TUBE, "colour": 3}]}, "sections[0].colour", "no such field"),
        (
            {"section": TUBE, "flexible": {"y": {"modes": 1, "shape": "from_frequencies", "frequencies": [3.0]}}},
            "flexible.y.shape",
            "uniform",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_with_sections_is_named(link, field, words):
    with pytest.raises(ArmFileError, match=r"links\[0\]") as error:
        arm_of(link)
    assert error.value.field == f"links[0].{field}" and words in str(error.value)


def test_gauges_see_the_curvature_of_their_place_and_no_jump():
    step = {"sections": [{"to": 1.0, **TUBE, "outer_diameter": 0.06, "wall": 0.002}, TUBE], **BENT}
    gauge = {"name": "g", "link": "boom", "direction": "y", "surface_distance": 0.02}
    with pytest.raises(ArmFileError, match="jumps"):
        arm_of(step, gauges=[{**gauge, "position": 1.0}] * 1)
    places = (0.999, 1.001)
    gauges = [{**gauge, "name": f"g{x}", "position": x} for x in places]
    built = model.build(arm_of({**step, "flexible": {"y": {"modes": 2}}}, gauges=gauges))
    rows = gauge_rows(built, built.arm.gauges)
    # The bending moment EI y'' does not jump.
    EI = [built.arm.links[0].rigidity("y", x) for x in places]
    assert_allclose(EI[0] * rows[0], EI[1] * rows[1], rtol=0.02)


def test_the_closed_forms_are_for_uniform_links():
    arm = arm_of({"section": TUBE, "flexible": {"y": {"modes": 1}}})
    for name in ("one_link",):
        with pytest.raises(ModelError, match="sections of boom"):
            model.build(arm_file.replace(arm, model=name))


def test_the_urdf_has_the_mass_of_each_piece():
    built = model.build(arm_of({"section": TUBE, **BENT}))
    text = PieceChain(built, 5).urdf()
    masses = [float(part.split('"')[0]) for part in text.split('<mass value="')[1:]]
    link = built.arm.links[0]
    beams = [m for m in masses if m > 0.0]
    expected = [link.moments(0.4 * k, 0.4 * (k + 1))[0] for k in range(5)]
    assert_allclose(beams[-5:], expected, rtol=1e-9)


# --- bodies, roots, fixed joints ---------------------------------------------------------------

BAR = {
    "mass_per_length": 0.8,
    "polar_inertia_per_length": 1e-3,
    "EI_y": 40.0,
    "EI_z": 70.0,
    "GJ": 30.0,
}
BODY = {"mass": 0.7, "inertia": [0.01, 0.02, 0.03, 0.001, 0.002, 0.003], "offset": [0.05, 0.0, 0.0]}


def test_a_body_at_the_tip_is_a_payload():
    bending = {"flexible": {"y": {"modes": 3, "shape": "loaded"}}}
    data = {
        "name": "arm",
        "joints": [{"name": "joint", "hub_inertia": 0.2}],
        "gravity": [1.0, -9.0, 2.0],
    }
    link = {"name": "boom", "length": 2.0, **BAR, **bending}
    with_body = {**data, "links": [{**link, "bodies": [{"position": 2.0, **BODY}]}]}
    with_payload = {**data, "links": [link], "payload": BODY}
    one, other = (model.build(arm_file.parse(yaml.safe_dump(d))) for d in (with_body, with_payload))
    q, delta = np.array([0.4]), np.array([0.02, -0.01, 0.004])
    assert_allclose(one.mass_matrix(q, delta), other.mass_matrix(q, delta), rtol=1e-9, atol=1e-12)
    qd, rates = np.array([0.8]), np.array([0.3, 0.2, -0.1])
    ours, theirs = (m.forces(q, qd, delta, rates) for m in (one, other))
    assert_allclose(ours, theirs, rtol=1e-8, atol=1e-9 * np.abs(theirs).max())
    assert_allclose(one.frequencies(q), other.frequencies(q), rtol=1e-9)


def chain_of(layout):
    """An arm of joints and links, (joint, link) each."""
    joints = [{"name": f"joint{i}", **joint} for i, (joint, _) in enumerate(layout)]
    links = [{"name": f"link{i}", **link} for i, (_, link) in enumerate(layout)]
    payload = {"mass": 0.4, "inertia": [0.01, 0.02, 0.02, 0, 0, 0], "offset": [0.1, 0.02, 0.0]}
    data = {"name": "chain", "joints": joints, "links": links, "payload": payload}
    return arm_file.parse(yaml.safe_dump({**data, "gravity": [2.0, -3.0, -8.0]}))


ORIGIN = {"xyz": [0.1, 0.05, -0.1], "rpy": [0.4, -0.3, 0.9]}
TURNS = {"axis": [0.3, -0.4, 0.8], "hub_inertia": 0.05, "motor_mass": 0.3, "origin": ORIGIN,
         "housing_inertia": [0.02, 0.03, 0.04, 0.001, 0.002, 0.003]}  # fmt: skip
BENDS = {"length": 1.1, **BAR, "flexible": {d: {"modes": 1} for d in ("y", "z", "twist")}}
RIGID = {"length": 0.4, "mass_per_length": 2.0, "polar_inertia_per_length": 1e-3,
         "root": [0.02, 0.03, -0.01], "bodies": [{"position": 0.1, **BODY}]}  # fmt: skip
LAYOUTS = {
    "rigid before": ([TURNS, None, TURNS], [RIGID, BENDS, BENDS], 1),
    "rigid behind": ([TURNS, None, TURNS], [BENDS, RIGID, BENDS], 1),
    "two in a row": ([TURNS, None, None, TURNS], [BENDS, RIGID, RIGID, BENDS], 1),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("level", ["first order", "finite slope"])
def test_a_fixed_joint_is_one_that_does_not_turn(layout, level):
    joints, links, _ = LAYOUTS[layout]
    free = {"axis": [0.0, 0.6, 0.8], "origin": ORIGIN}
    fixed = {"type": "fixed", "origin": ORIGIN}
    still = [i for i, joint in enumerate(joints) if joint is None]
    arms = [
        arm_file.replace(
            chain_of([(joint or other, link) for joint, link in zip(joints, links, strict=True)]),
            finite_slope=level == "finite slope",
        )
        for other in (free, fixed)
    ]
    whole = Chain(arms[0], compiled=False)
    held = Chain(arms[1], compiled=False, shapes=whole._shapes)
    n, m, size = whole.n_joints, whole.n_modes, held.n_joints + held.n_modes
    rng = np.random.default_rng(3)
    moves = np.setdiff1d(np.arange(n + m), still)
    z, v = rng.uniform(-0.05, 0.05, n + m), rng.standard_normal(n + m)
    z[:n] = rng.uniform(-2.0, 2.0, n)
    z[still] = v[still] = 0.0
    q, qd = z[moves][: n - len(still)], v[moves][: n - len(still)]
    M = whole.mass_matrix(z[:n], z[n:])[np.ix_(moves, moves)]
    assert held.mass_matrix(q, z[n:]).shape == (size, size)
    assert_allclose(held.mass_matrix(q, z[n:]), M, rtol=1e-9, atol=1e-11)
    force = whole.forces(z[:n], v[:n], z[n:], v[n:])[moves]
    assert_allclose(held.forces(q, qd, z[n:], v[n:]), force, rtol=1e-9, atol=1e-9)
    assert_allclose(held.tip_position(q, z[n:]), whole.tip_position(z[:n], z[n:]), atol=1e-12)


@pytest.mark.parametrize(
    "joints, links, words",
    [
        ([None, TURNS], [BENDS, BENDS], "the first joint is fixed"),
        ([TURNS, None], [BENDS, BENDS], "both link0 and link1 bend"),
        ([TURNS, None], [BENDS, RIGID], "ends the arm"),
    ],
)
def test_fixed_joints_that_can_not_be_merged_are_refused(joints, links, words):
    fixed = {"type": "fixed"}
    with pytest.raises(ArmFileError, match=words):
        chain_of([(joint or fixed, link) for joint, link in zip(joints, links, strict=True)])


@pytest.mark.parametrize(
    "link, field, words",
    [
        ({"bodies": [{"position": 2.1, "mass": 1.0}]}, "bodies[0].position", "0 to 2 m"),
        ({"bodies": [{"position": 1.0}]}, "bodies[0].mass", "a mass, an inertia, or both"),
        ({"bodies": [{"position": 1.0, "inertia": [1, 1, -1, 0, 0, 0]}]}, "bodies[0].inertia", "semi-definite"),
        ({"root": [1.0, 2.0]}, "root", "3 numbers"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_bodies_is_named(link, field, words):
    with pytest.raises(ArmFileError) as error:
        arm_of({**BAR, **link})
    assert error.value.field == f"links[0].{field}" and words in str(error.value)


def test_the_urdf_has_all_bodies_where_they_are():
    arm = chain_of(
        [(TURNS, {**BENDS, "root": [0.1, 0.2, 0.0], "bodies": [{"position": 0.5, **BODY}]})]
    )
    text = PieceChain(Chain(arm, compiled=False), 4).urdf()
    assert '<link name="link0_body1">' in text and '<link name="link0_root"' in text
    masses = [float(part.split('"')[0]) for part in text.split('<mass value="')[1:]]
    assert sum(masses) == pytest.approx(0.8 * 1.1 + 0.7 + 0.4)
