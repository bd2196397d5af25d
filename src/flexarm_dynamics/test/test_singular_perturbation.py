# SPDX-License-Identifier: Apache-2.0
"""Slow and fast subsystems: equations (6) to (11), stabilisability, full order poles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from flexarm_dynamics import singular_perturbation as sp
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.arm.units import POUND_FORCE
from flexarm_dynamics.linear import jacobian
from flexarm_dynamics.models.model import Terms, build
from flexarm_dynamics.models.one_link import OneLink

REST = np.zeros(1)
STATES = [(0.0, 0.0), (0.7, 0.0), (-2.1, 3.0), (1.2, -0.4)]


@pytest.fixture(scope="module")
def heavy():
    """A fully derived arm with gravity, friction, damping and four modes."""
    arm = arm_file.load("one_link").with_modes(4)
    joint = replace(arm.joints[0], friction=Friction(0.2, 0.3, 0.5))
    return OneLink(replace(arm, gravity=(1.0, -9.81, 0.5), joints=(joint,)))


def random_terms(rng, n=2, m=3, gravity=True):
    """Terms of an arm with n joints and m modes that no model of ours makes."""
    A = rng.standard_normal((n + m, n + m))
    stiff = rng.standard_normal((m, m))
    return Terms(
        M=A @ A.T + (n + m) * np.eye(n + m),
        f1=rng.standard_normal(n),
        f2=rng.standard_normal(m),
        C1=rng.standard_normal((n, m)),
        C2=rng.standard_normal((m, m)),
        K1=rng.standard_normal((n, m)) if gravity else np.zeros((n, m)),
        K2=stiff @ stiff.T + 30.0 * np.eye(m),
    )


def cases(heavy):
    """Terms with K1 not zero: of a real arm and of random ones."""
    rng = np.random.default_rng(1)
    yield from (heavy.terms(np.array([q]), np.array([qd])) for q, qd in STATES)
    yield from (random_terms(rng) for _ in range(5))


def test_quasi_steady_state_and_slow_subsystem_solve_the_equations_of_motion(heavy):
    """(9) and (10) together: no acceleration of the modes, the joints' as (10) has it, exactly (2)."""
    rng = np.random.default_rng(2)
    for t in cases(heavy):
        n, m = t.n, t.f2.size
        torque = rng.standard_normal(n)
        delta = sp.quasi_steady_state(t, torque)
        a, B = sp.slow_subsystem(t)
        acceleration = np.concatenate([a + B @ torque, np.zeros(m)])
        forces = np.concatenate([torque - t.f1 - t.K1 @ delta, -t.f2 - t.K2 @ delta])
        assert np.any(t.K1 != 0.0) and np.any(delta != 0.0)
        np.testing.assert_allclose(
            t.M @ acceleration, forces, atol=1e-11 * max(1.0, np.abs(forces).max())
        )


def test_quasi_steady_state_is_an_equilibrium_of_the_boundary_layer(heavy):
    """(8): the fast rows of (6) vanish at (9)."""
    for t in cases(heavy):
        torque = np.ones(t.n)
        s = sp.state_space(t)
        z = np.concatenate([sp.quasi_steady_state(t, torque), np.zeros(t.f2.size)])
        rate = s.A2 @ z + s.g2 + s.B2 @ torque
        np.testing.assert_allclose(rate, 0.0, atol=1e-13 * np.abs(s.A2).max())


def test_without_gravity_on_the_modes_the_slow_subsystem_is_the_rigid_arm(shipped):
    rng = np.random.default_rng(3)
    terms = [shipped("R").terms(REST, np.array([1.3])), random_terms(rng, gravity=False)]
    terms += [shipped("one_link").terms(np.array([0.4]), REST)]
    for t in terms:
        a, B = sp.slow_subsystem(t)
        rigid = np.linalg.inv(t.M[: t.n, : t.n])
        np.testing.assert_allclose(B, rigid, rtol=1e-11)
        np.testing.assert_allclose(a, -rigid @ t.f1, rtol=1e-11, atol=1e-13)


def test_rigid_inertia_is_the_schur_complement_that_print_takes_for_h11(shipped, errata):
    t = shipped("R").terms(REST, REST)
    H11, H12, H21, H22 = t.partition()
    m11 = 1.0 / (H11 - H12 @ np.linalg.solve(H22, H21))
    assert m11[0, 0] == pytest.approx(t.M[0, 0], rel=1e-12)
    assert 1.0 / H11[0, 0] < 0.87 * t.M[0, 0]


def test_fast_subsystem_is_the_linearisation_of_the_equations_of_motion(heavy):
    """A2 and B2 by central differences of `derivative`, at speed and in gravity, without deflection."""
    m = heavy.n_modes
    fast = np.r_[1 : 1 + m, 2 + m : 2 + 2 * m]
    for q, qd in STATES:
        state = np.zeros(2 + 2 * m)
        state[0], state[1 + m] = q, qd
        A2, B2 = sp.fast_subsystem(heavy.terms(np.array([q]), np.array([qd])))
        torque = np.array([0.3])
        A = jacobian(lambda s, u=torque: heavy.derivative(s, u), state, 1e-4)[np.ix_(fast, fast)]
        np.testing.assert_allclose(A, A2, atol=3e-8 * np.abs(A2).max())
        B = jacobian(lambda u, s=state: heavy.derivative(s, u), torque, 1.0)[fast]  # linear in it
        np.testing.assert_allclose(B, B2, atol=1e-11 * np.abs(B2).max())


def test_state_space_is_the_derivative_without_products_of_deflections(heavy):
    """(6): exact without deflection, and with deflections up to their second order."""
    rng = np.random.default_rng(4)
    m = heavy.n_modes
    for q, qd in STATES:
        terms = heavy.terms(np.array([q]), np.array([qd]))
        s = sp.state_space(terms)
        torque, rate = rng.standard_normal(1), rng.standard_normal(m)
        shape = rng.standard_normal(m) / np.arange(1, m + 1) ** 3
        x = np.array([q, qd])

        def difference(size, s=s, x=x, torque=torque, rate=rate, shape=shape):
            z = np.concatenate([size * shape, size * rate])
            xd = s.F @ x + s.g1 + s.A1 @ z + s.B1 @ torque
            zd = s.A2 @ z + s.g2 + s.B2 @ torque
            state = np.concatenate([x[:1], z[:m], x[1:], z[m:]])
            ours = np.concatenate([xd[:1], zd[:m], xd[1:], zd[m:]])
            return np.abs(heavy.derivative(state, torque) - ours).max(), np.abs(zd).max()

        error, scale = difference(0.0)
        assert error < 1e-12 * scale
        coarse, fine = difference(1e-3), difference(1e-4)
        assert coarse[0] < 1e-3 * coarse[1]
        assert fine[0] < coarse[0] / 50.0 + 1e-12 * fine[1]


def test_state_space_of_several_joints_is_the_solution_of_the_equations_of_motion():
    rng = np.random.default_rng(5)
    t = random_terms(rng, 2, 3)
    s = sp.state_space(t)
    qd, delta, delta_d, u = (rng.standard_normal(k) for k in (2, 3, 3, 2))
    force = np.concatenate(
        [u - t.f1 - t.C1 @ delta_d - t.K1 @ delta, -t.f2 - t.C2 @ delta_d - t.K2 @ delta]
    )
    acceleration = np.linalg.solve(t.M, force)
    x, z = np.concatenate([rng.standard_normal(2), qd]), np.concatenate([delta, delta_d])
    np.testing.assert_allclose(
        s.F @ x + s.g1 + s.A1 @ z + s.B1 @ u, np.concatenate([qd, acceleration[:2]]), atol=1e-13
    )
    np.testing.assert_allclose(
        s.A2 @ z + s.g2 + s.B2 @ u, np.concatenate([delta_d, acceleration[2:]]), atol=1e-13
    )


def test_turning_softens_the_modes(shipped):
    """K2 = K - qd^2 G: the model has no foreshortening."""
    arm_model = shipped("one_link", 3)
    c = OneLink(replace(arm_model.arm, model="one_link")).coefficients
    for speed in (0.0, 2.0, -5.0):
        t = arm_model.terms(REST, np.array([speed]))
        wanted = c.K - speed**2 * c.G
        np.testing.assert_allclose(t.K2, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())
    still, turning = (
        np.abs(np.linalg.eigvals(sp.fast_subsystem(arm_model.terms(REST, np.array([w])))[0])).min()
        for w in (0.0, 5.0)
    )
    assert turning < still - 0.5
    assert np.all(np.linalg.eigvalsh(c.G) > 0.0)


# --- stabilisability ---------------------------------------------------------------------------


def two_modes(coupling_2, damping_2=0.0):
    """Joint and two modes, the second coupled to the joint as asked for."""
    M = np.array([[1.0, 0.3, coupling_2], [0.3, 1.0, 0.0], [coupling_2, 0.0, 1.0]])
    return Terms(
        M, REST, np.zeros(2), np.zeros((1, 2)), np.diag([0.0, damping_2]), np.zeros((1, 2)),
        np.diag([100.0, 900.0]),
    )  # fmt: skip


@pytest.mark.parametrize("name", ["R", "P3"])
def test_case_study_is_stabilisable(name, shipped):
    ok, worst = sp.is_stabilisable(*sp.fast_subsystem(shipped(name).terms(REST, REST)))
    assert ok is True
    assert 1e-2 < worst < 1.0


def test_a_mode_that_the_torque_does_not_reach_is_not_stabilisable():
    A2, B2 = sp.fast_subsystem(two_modes(0.2))
    assert sp.is_stabilisable(A2, B2)[0]
    assert not sp.is_stabilisable(A2, 0.0 * B2)[0]
    ok, worst = sp.is_stabilisable(*sp.fast_subsystem(two_modes(0.0)))
    assert ok is False
    assert worst < 1e-14


def test_a_mode_that_decays_by_itself_matters_only_within_the_margin():
    """The second mode decays with 1/s."""
    A2, B2 = sp.fast_subsystem(two_modes(0.0, damping_2=2.0))
    assert sp.is_stabilisable(A2, B2)[0]
    assert sp.is_stabilisable(A2, B2, margin=0.9)[0]
    assert not sp.is_stabilisable(A2, B2, margin=1.1)[0]


def test_a_stable_fast_subsystem_has_nothing_to_stabilise(shipped):
    assert sp.is_stabilisable(*sp.fast_subsystem(shipped("one_link").terms(REST, REST))) == (
        True,
        np.inf,
    )


@pytest.mark.parametrize("modes", [5, 10, 20])
def test_many_undamped_modes_of_one_link_are_stabilisable(shipped, modes):
    """Stiff modes do not hide in rounding what the torque does to soft ones."""
    A2, B2 = sp.fast_subsystem(shipped("R", modes).terms(REST, REST))
    ok, worst = sp.is_stabilisable(A2, B2)
    assert ok
    assert worst > 1e-4


@pytest.mark.parametrize("mode", [0, 4, 9])
def test_one_unreachable_mode_among_ten_is_found(shipped, mode):
    A2, B2 = sp.fast_subsystem(shipped("R", 10).terms(REST, REST))
    _, vectors = np.linalg.eig(A2[10:, :10])
    reach = np.linalg.solve(vectors, B2[10:])
    reach[mode] = 0.0
    B2 = np.vstack([np.zeros((10, 1)), vectors @ reach])
    assert not sp.is_stabilisable(A2, B2)[0]


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_stabilisability_does_not_depend_on_units(shipped, unit):
    A2, B2 = sp.fast_subsystem(shipped("R", 3).terms(REST, REST))
    T = np.diag([1.0, unit, 1.0, 1.0, unit, 1.0])
    scaled = sp.is_stabilisable(np.linalg.inv(T) @ A2 @ T, np.linalg.inv(T) @ B2)[1]
    assert scaled == pytest.approx(sp.is_stabilisable(A2, B2)[1], rel=10.0)


# --- time scales -------------------------------------------------------------------------------


def test_time_scales_of_the_case_study(shipped, errata):
    t = shipped("R").terms(REST, REST)
    scales = sp.time_scales(t, kp=6.25, kv=5.0)
    np.testing.assert_allclose(scales.slow, [-2.5, -2.5], atol=1e-7)
    slowest = float(errata["R"]["open_omega_rad_per_s"][0])
    assert scales.mu == pytest.approx(2.5 / slowest, rel=1e-4)
    assert scales.separation == pytest.approx(1.0 / scales.mu, rel=1e-14)
    opened = sp.time_scales(t)
    np.testing.assert_array_equal(opened.slow, [0.0, 0.0])
    assert (opened.mu, opened.separation) == (0.0, np.inf)


def test_time_scales_of_the_closed_fast_loop(shipped):
    t = shipped("R").terms(REST, REST)
    K = POUND_FORCE * np.array([[127.04, 7283.8, 16.998, 183.31]])
    closed = sp.time_scales(t, kp=[6.25], kv=[5.0], K_f=K)
    omega, zeta = sp.frequencies_and_damping(closed.fast)
    np.testing.assert_allclose(omega, [18.578, 90.402], rtol=1e-4)
    np.testing.assert_allclose(zeta, [0.7755, 0.4052], rtol=1e-3)


# --- full order closed loop --------------------------------------------------------------------


def gains(arm_model, errata):
    """K_f in SI by scipy's Riccati solver, and (kp, kv)."""
    A2, B2 = sp.fast_subsystem(arm_model.terms(REST, REST))
    design = errata["design"]
    Q = np.diag([float(q) for q in design["q_diagonal"]])
    shifted = A2 + float(design["alpha_1_per_s"]) * np.eye(4)
    B2 = B2 * POUND_FORCE
    K = -B2.T @ solve_continuous_are(shifted, B2, Q, np.eye(1) * float(design["r"]))
    return K * POUND_FORCE, float(design["kp_1_per_s2"]), float(design["kv_1_per_s"])


def poles_agree(matrix, expected, agrees):
    """Poles with positive or no imaginary part against [real, imaginary] as printed."""
    poles = np.linalg.eigvals(matrix)
    poles = sorted(poles[poles.imag >= 0.0], key=lambda p: (round(abs(p), 3), p.imag))
    expected = sorted(expected, key=lambda p: np.hypot(float(p[0]), float(p[1])))
    assert len(poles) == len(expected)
    for pole, (real, imaginary) in zip(poles, expected, strict=True):
        agrees(pole.real, real)
        agrees(pole.imag, imaginary)


def test_full_order_poles_of_R_under_composite_control(shipped, errata, agrees):
    arm_model = shipped("R")
    t = arm_model.terms(REST, REST)
    K, kp, kv = gains(arm_model, errata)
    A = sp.full_order_matrix(t, kp, kv, t.M[:1, :1], K)
    poles_agree(A, errata["R"]["full_order_poles_m11_composite_1_per_s"], agrees)


def test_full_order_poles_of_P3_under_slow_control_alone(shipped, errata, agrees):
    arm_model = shipped("P3")
    t = arm_model.terms(REST, REST)
    _, kp, kv = gains(arm_model, errata)
    A = sp.full_order_matrix(t, [kp], [kv], t.M[:1, :1], np.zeros((1, 4)))
    poles_agree(A, errata["P3"]["full_order_poles_m11_slow_only_1_per_s"], agrees)


def test_printed_slow_gain_misses_the_designed_double_pole(shipped, errata, agrees):
    """With 1/h11 for m11 the slow poles are a lightly damped pair; with m11 they are where designed."""
    t = shipped("P3").terms(REST, REST)
    _, B = sp.slow_subsystem(t)
    kp, kv = 6.25, 5.0
    for inverse, expected in (
        (1.0 / t.H[0, 0], errata["P3"]["slow_poles_1_per_h11_1_per_s"]),
        (t.M[0, 0], None),
    ):
        loop = B[0, 0] * inverse
        pole = np.roots([1.0, loop * kv, loop * kp])[0]
        if expected is None:
            assert pole == pytest.approx(-2.5, abs=1e-6)
        else:
            agrees([pole.real, abs(pole.imag)], expected)


@pytest.mark.parametrize("modes", [2, 4])
@pytest.mark.parametrize("name", ["one_link", "R"])
def test_full_order_matrix_is_the_linearisation_of_the_nonlinear_closed_loop(name, shipped, modes):
    arm_model = shipped(name, modes)
    m = arm_model.n_modes
    kp, kv = np.array([6.25]), np.array([5.0])
    rng = np.random.default_rng(6)
    K = 20.0 * rng.standard_normal((1, 2 * m))
    t0 = arm_model.terms(REST, REST)
    B_inverse = 0.9 * t0.M[:1, :1]

    def closed_loop(state):
        q, delta, qd, delta_d = np.split(state, [1, 1 + m, 2 + m])
        slow = B_inverse @ (-kp * q - kv * qd)  # no gravity, no friction
        bar = sp.quasi_steady_state(arm_model.terms(q, qd), slow)
        fast = K @ np.concatenate([delta - bar, delta_d])
        return arm_model.derivative(state, slow + fast)

    numeric = jacobian(closed_loop, np.zeros(2 + 2 * m), 1e-5)
    A = sp.full_order_matrix(t0, kp, kv, B_inverse, K)
    np.testing.assert_allclose(A, numeric, atol=1e-8 * np.abs(A).max())


def test_full_order_matrix_takes_the_couplings_of_many_joints():
    """Against the same loop written out for random terms."""
    rng = np.random.default_rng(7)
    t = random_terms(rng, 2, 3)
    kp, kv, B_inverse = np.array([3.0, 5.0]), np.array([2.0, 1.0]), rng.standard_normal((2, 2))
    K = rng.standard_normal((2, 6))
    still = t._replace(f1=np.zeros(2), f2=np.zeros(3))

    def rate(state):
        q, delta, qd, delta_d = np.split(state, [2, 5, 7])
        slow = B_inverse @ (-kp * q - kv * qd)
        bar = sp.quasi_steady_state(still, slow)
        u = slow + K @ np.concatenate([delta - bar, delta_d])
        force = np.concatenate([u - t.C1 @ delta_d - t.K1 @ delta, -t.C2 @ delta_d - t.K2 @ delta])
        return np.concatenate([qd, delta_d, np.linalg.solve(t.M, force)])

    expected = np.stack([rate(e) for e in np.eye(10)], axis=1)  # linear
    A = sp.full_order_matrix(t, kp, kv, B_inverse, K)
    np.testing.assert_allclose(A, expected, atol=1e-12 * np.abs(expected).max())


# --- frequencies and damping -------------------------------------------------------------------


def pair(omega, zeta):
    return np.roots([1.0, 2.0 * zeta * omega, omega**2])


@pytest.mark.parametrize(
    ("poles", "omega", "zeta"),
    [
        ([*pair(90.0, 0.4), *pair(3.0, 0.05), *pair(20.0, 0.75)], [3.0, 20.0, 90.0], [0.05, 0.75, 0.4]),
        ([*pair(5.0, 1.7), *pair(2.0, 0.3)], [2.0, 5.0], [0.3, 1.7]),  # two real ones are a pair
        ([7j, -7j], [7.0], [0.0]),
        (pair(4.0, -0.2), [4.0], [-0.2]),
        ([2.0, 8.0], [4.0], [-1.25]),
        ([-2.0, 8.0], [4.0], [-0.75]),
        ([*pair(4.0, 0.2), -9.0], [4.0, 9.0], [0.2, 1.0]),  # a single one is not lost
        ([0.0, 0.0], [0.0], [1.0]),  # integrators
    ],
)  # fmt: skip
def test_frequencies_and_damping_of_known_poles(poles, omega, zeta):
    found = sp.frequencies_and_damping(np.array(poles))
    np.testing.assert_allclose(found, [omega, zeta], rtol=1e-12)


@pytest.mark.parametrize("gravity", [True, False])
def test_slow_torque_gives_the_slow_subsystem_its_acceleration(gravity):
    rng = np.random.default_rng(5)
    for n, m in ((1, 2), (2, 3), (4, 1)):
        terms = random_terms(rng, n, m, gravity)
        wanted = rng.standard_normal(n)
        a, B = sp.slow_subsystem(terms)
        np.testing.assert_allclose(a + B @ sp.slow_torque(terms, wanted), wanted, atol=1e-12)


def test_terms_of_the_straight_arm_hold_the_forces_and_their_derivatives():
    model = build(arm_file.load("long_reach"))
    for sign in (1.0, -1.0):  # the room that is used again carries nothing over
        q, qd = np.array([0.3, sign, 1.1, -0.4]), sign * np.array([0.2, -0.5, 0.1, 0.7])
        terms = model.terms(q, qd)
        forces, (K, C) = model.forces(q, qd), model.linearisation(q, qd)
        forces[: model.n_joints] += model.friction(qd)
        found = np.concatenate([terms.f1, terms.f2])
        np.testing.assert_allclose(found, forces, rtol=1e-13, atol=1e-12)
        # Not to the last bit: K and C are of complex steps there, of recorded derivatives here.
        scale = np.abs(K).max(), np.abs(C).max()
        np.testing.assert_allclose(
            np.vstack([terms.K1, terms.K2]), K, rtol=0, atol=1e-14 * scale[0]
        )
        np.testing.assert_allclose(
            np.vstack([terms.C1, terms.C2]), C, rtol=0, atol=1e-14 * scale[1]
        )
