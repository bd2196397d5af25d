# SPDX-License-Identifier: Apache-2.0
"""Fast laws: the Riccati equation (20), the paper's gains, and what defines each of the other laws."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm, solve_continuous_are, solve_continuous_lyapunov
from scipy.signal import place_poles

from flexarm_control.component import at_rest
from flexarm_control.composite import full_order
from flexarm_control.composite.design import FAST, design, design_law
from flexarm_control.fast.scheduled_lqr import GainTable
from flexarm_dynamics import registry
from flexarm_dynamics.arm.units import POUND_FORCE
from flexarm_dynamics.errors import DesignError, ParameterError
from flexarm_dynamics.models.model import Terms
from flexarm_dynamics.singular_perturbation import fast_subsystem, frequencies_and_damping

ARMS = ("R", "one_link", "two_link", "long_reach")
#: A working range of long_reach: shoulder, elbow and wrist away from their stops.
WORKING = {"low": [0.0, -0.9, 0.4, -1.0], "high": [0.0, 0.3, 1.8, 1.0]}


# Q = diag(1, 1, 50, 30000), r = 1 in ft and lbf ft
PAPER = {
    "q": (POUND_FORCE**2 * np.array([1.0, 1.0, 50.0, 30000.0])).tolist(),
    "r": [1.0],
    "alpha": 5.0,
    "configuration": [np.pi / 2],
}


@pytest.fixture(scope="module")
def two_link_scheduled(two_link):
    return law_of("scheduled_lqr", two_link, alpha=1.0, r=[1.0, 3.0])


@pytest.fixture(scope="module")
def long_reach_scheduled(long_reach):
    return law_of("scheduled_lqr", long_reach, alpha=1.0, **WORKING)


def law_of(name, model, **values):
    return design_law(FAST, name, model, values)


def lqr(model, **changed):
    return law_of("lqr", model, **PAPER | changed)


def closed_loop(law):
    return np.linalg.eigvals(law.A2 + law.B2 @ law.K_f)


def boundary_layer(arm, q):
    return fast_subsystem(arm.terms(np.asarray(q, float), np.zeros(arm.n_joints)))


def made_up_model(couplings, damping):
    """Joints and two modes of 3 and 7 rad/s; `couplings` (n, 2) in the mass matrix."""
    couplings = np.atleast_2d(couplings)
    n = couplings.shape[0]
    M = np.eye(n + 2)
    M[:n, n:], M[n:, :n] = couplings, couplings.T
    terms = Terms(
        M, np.zeros(n), np.zeros(2), np.zeros((n, 2)), np.diag(damping), np.zeros((n, 2)),
        np.diag([9.0, 49.0]),
    )  # fmt: skip
    return SimpleNamespace(
        n_joints=n, n_modes=2, mode_names=("slender_mode", "stiff_mode"), terms=lambda q, qd: terms,
        arm=SimpleNamespace(position_limits=np.array([[-1.0, 1.0]] * n), gauges=()),
    )  # fmt: skip


def test_a_parameter_of_several_fast_laws_is_one_declaration():
    declared = {}
    for law in registry.importable(FAST).values():
        for parameter in law.PARAMETERS:
            assert declared.setdefault(parameter.name, parameter) == parameter
    assert {"q", "r", "alpha", "configuration"} <= set(declared)


@pytest.mark.parametrize("name", ["lqr", "scheduled_lqr", "pole_placement", "output_feedback"])
def test_a_rigid_arm_has_nothing_to_damp(arms, name):
    law = law_of(name, arms["rigid"])
    law.reset()
    law.torque(np.zeros(0), np.zeros(2))
    law.advance(1e-3)
    assert_array_equal(law.torque(np.zeros(0), np.zeros(2)), [0.0, 0.0])
    assert law.K_f.shape == (2, 0)


def test_a_riccati_solver_that_gives_up_refuses_the_design(arms, monkeypatch):
    import control

    def fails(*_):
        raise np.linalg.LinAlgError("no finite solution found")

    monkeypatch.setattr(control, "lqr", fails)
    with pytest.raises(
        DesignError, match=r"configuration \[0.0\].*\(20\).*alpha = 5.0: no finite solution found"
    ):
        law_of("lqr", arms["R"])


@pytest.mark.parametrize(
    ("name", "coupling", "damping", "lost"),
    [
        ("lqr", [0.2, 0.0], [0.0, 0.0], "stiff_mode"),
        ("lqr", [0.0, 0.2], [0.0, 0.0], "slender_mode"),
        # The other one is out of reach too, but decays fast enough by itself.
        ("lqr", [0.0, 0.0], [0.1, 12.0], "slender_mode"),
        ("lqr", [0.0, 0.0], [5.0, 0.1], "stiff_mode"),
        ("scheduled_lqr", [0.2, 0.0], [0.1, 0.1], "stiff_mode"),
        ("output_feedback", [0.2, 0.0], [0.1, 0.1], "stiff_mode"),
    ],
)
def test_a_mode_that_no_torque_reaches_and_has_to_be_faster_is_named(name, coupling, damping, lost):
    message = rf"fast\.alpha: .*can't reach {lost}, which must decay faster.*lower fast\.alpha"
    with pytest.raises(DesignError, match=message) as error:
        design_law(FAST, name, made_up_model(coupling, damping), {"alpha": 1.0})
    (kept,) = {"stiff_mode", "slender_mode"} - {lost}
    assert kept not in str(error.value)


# --------------------------------------------------------------------------- lqr: (20)


@pytest.mark.parametrize("alpha", [0.0, 5.0, 20.0])
def test_the_gain_solves_the_riccati_equation_20(arm_r, alpha):
    law = lqr(arm_r, alpha=alpha)
    A2, B2 = boundary_layer(arm_r, [np.pi / 2])
    A, V, Q = A2 + alpha * np.eye(4), law.V, np.diag(PAPER["q"])
    terms = [V @ A, A.T @ V, -V @ B2 @ B2.T @ V, Q]
    assert np.linalg.norm(sum(terms)) < 1e-9 * max(map(np.linalg.norm, terms))
    assert np.linalg.eigvalsh(0.5 * (V + V.T)).min() > 0.0
    assert_allclose(law.K_f, -B2.T @ V, rtol=1e-12)


def test_the_gain_is_that_of_an_independent_riccati_solver_in_its_configuration(arm_p3, heavy_arm):
    for arm, angle, r in ((arm_p3, np.pi / 2, 3.0), (heavy_arm, 0.0, 1.0), (heavy_arm, 1.2, 1.0)):
        A2, B2 = boundary_layer(arm, [angle])
        V = solve_continuous_are(A2 + 5.0 * np.eye(4), B2, np.diag(PAPER["q"]), [[r]])
        assert_allclose(lqr(arm, r=[r], configuration=[angle]).K_f, -B2.T @ V / r, rtol=1e-8)
    low, high = (lqr(heavy_arm, configuration=[a]).K_f for a in (-np.pi / 2, np.pi / 2))
    assert not np.allclose(low, high, rtol=1e-4)


def test_p3_has_the_published_gains_frequencies_and_damping_ratios(arm_p3):
    law = lqr(arm_p3)
    omega, zeta = frequencies_and_damping(closed_loop(law))
    magnitudes = np.abs(law.K_f[0]) / POUND_FORCE
    # Ours, and the published ones.
    for gains in ([75.505, 6376.58, 17.072, 173.098], [75.50, 6375.64, 17.07, 173.10]):
        assert_allclose(magnitudes, gains, rtol=2e-4)
    for frequencies, ratios in (
        ([18.592, 94.098], [0.7659, 0.7529]),
        ([18.59, 94.10], [0.766, 0.753]),
    ):
        assert_allclose(omega, frequencies, rtol=3e-4)
        assert_allclose(zeta, ratios, rtol=3e-4)


def test_r_has_the_gains_frequencies_and_damping_ratios_of_the_errata(arm_r):
    law = lqr(arm_r)
    # u_f = -k z_f with k all negative for tip shapes (+, -)
    wanted = np.array([127.04, 7283.8, 16.998, 183.31])  # [lbf], [lbf s]
    assert_allclose(law.K_f[0] / POUND_FORCE, wanted, rtol=1e-4)
    omega, zeta = frequencies_and_damping(closed_loop(law))
    assert_allclose(omega, [18.578, 90.402], rtol=3e-5)
    assert_allclose(zeta, [0.7755, 0.4052], rtol=1.3e-4)


@pytest.mark.parametrize("alpha", [0.0, 1.0, 5.0, 30.0])
def test_every_closed_pole_lies_left_of_minus_alpha(arm_r, arm_p3, heavy_arm, alpha):
    for model in (arm_r, arm_p3, heavy_arm, made_up_model([0.2, 0.2], [0.0, 0.0])):
        assert closed_loop(lqr(model, alpha=alpha)).real.max() < -alpha


def test_the_gain_depends_on_the_ratio_of_q_and_r(arm_r):
    gain = lqr(arm_r).K_f
    scaled = lqr(arm_r, q=(1e3 * np.array(PAPER["q"])).tolist(), r=[1e3])
    assert_allclose(scaled.K_f, gain, rtol=1e-8)
    assert np.abs(lqr(arm_r, r=[100.0]).K_f[0, 2:]).max() < np.abs(gain[0, 2:]).max()


def test_u_f_is_exactly_zero_on_the_manifold_and_linear_beside_it(arm_r):
    law, q, z_f = lqr(arm_r), np.zeros(1), np.array([1e-3, -2e-4, 0.02, 0.01])
    assert_array_equal(law.torque(np.zeros(4), q), [0.0])
    assert_allclose(law.torque(z_f, q), [law.K_f[0] @ z_f], rtol=1e-14)
    assert_allclose(law.torque(-2.0 * z_f, q), -2.0 * law.torque(z_f, q), rtol=1e-14)


def test_no_fast_law_gives_no_torque_and_a_zero_gain(arm_r):
    law = law_of("none", arm_r)
    assert_array_equal(law.torque(np.ones(4), np.zeros(1)), [0.0])
    assert_array_equal(law.K_f, np.zeros((1, 4)))


def test_nothing_to_minimise_and_no_prescribed_decay_has_no_design(arm_r):
    with pytest.raises(DesignError, match=r"slowest pole.*not left of -alpha.*raise fast\.q"):
        lqr(arm_r, q=[0.0], alpha=0.0)


# --------------------------------------------------------------------------- scheduled_lqr


def test_the_joints_that_change_the_boundary_layer_are_found(
    two_link_scheduled, long_reach_scheduled
):
    assert_array_equal(two_link_scheduled.scheduled, [1])
    assert_array_equal(long_reach_scheduled.scheduled, [1, 2, 3])  # not the yaw
    assert two_link_scheduled.gains.shape == (5, 2, 8)
    assert long_reach_scheduled.gains.shape == (125, 4, 20)


def test_gravity_schedules_the_gain_and_where_no_joint_matters_it_is_that_of_lqr(heavy_arm, arm_r):
    law = law_of("scheduled_lqr", heavy_arm)
    assert_array_equal(law.scheduled, [0])
    assert not np.allclose(law.gain([0.0]), law.gain([1.5]), rtol=1e-5)
    law, fixed = (law_of(name, arm_r) for name in ("scheduled_lqr", "lqr"))
    assert law.scheduled.size == 0
    assert_allclose(law.gain([1.2]), fixed.K_f, rtol=1e-12)


def test_every_node_solves_the_riccati_equation_20(arms, two_link_scheduled):
    law, alpha = two_link_scheduled, 1.0
    R = np.diag(law.parameters["r"])
    assert_allclose(law.nodes[:, 1], np.linspace(-np.pi, np.pi, 5), atol=1e-15)
    for q, K in zip(law.nodes, law.gains, strict=True):
        A2, B2 = boundary_layer(arms["two_link"], q)
        closed = A2 + alpha * np.eye(8) + B2 @ K
        assert np.linalg.eigvals(closed).real.max() < 0.0
        # (20) is this Lyapunov equation of the closed loop, with K = -R^-1 B2' V
        V = solve_continuous_lyapunov(closed.T, -(np.eye(8) + K.T @ R @ K))
        assert_allclose(K, -np.linalg.solve(R, B2.T @ V), atol=1e-6 * np.abs(K).max())


def test_the_gain_at_a_node_is_the_design_there_and_continuous(
    two_link_scheduled, long_reach_scheduled
):
    for law in (two_link_scheduled, long_reach_scheduled):
        for q, K in zip(law.nodes, law.gains, strict=True):
            assert_allclose(law.gain(q), K, atol=1e-12 * np.abs(K).max())
            for near in (q - 1e-9, q + 1e-9):  # beyond a turn, too
                assert_allclose(law.gain(near), K, atol=1e-6 * np.abs(K).max())


def test_interpolation_reproduces_what_is_linear_in_each_joint():
    draw = np.random.default_rng(3)
    low, high = np.array([-1.0, 0.5, 2.0]), np.array([1.0, 0.7, 6.0])
    c = draw.normal(size=(2, 2, 2, 2, 3))  # of the products of the powers 0 and 1, matrices (2, 3)

    def matrix(x):
        return np.einsum("i,j,k,ijkab->ab", *[[1.0, v] for v in x], c)

    axes = [np.linspace(a, b, 4) for a, b in zip(low, high, strict=True)]
    nodes = [(x, y, z) for x in axes[0] for y in axes[1] for z in axes[2]]
    table = GainTable([0, 2, 3], low, high, 4, [False] * 3, np.array([matrix(x) for x in nodes]))
    for x in draw.uniform(low - 0.5, high + 0.5, (200, 3)):  # held at its ends beyond them
        q = np.array([x[0], 99.0, x[1], x[2]])
        assert_allclose(table(q), matrix(np.clip(x, low, high)), rtol=1e-11, atol=1e-11)


def test_a_joint_with_limits_is_held_at_its_ends_and_one_without_turns_through(
    two_link_scheduled, long_reach_scheduled
):
    gain = long_reach_scheduled.gain
    assert_array_equal(gain([0, 0.3, 1, 0]), gain([0, 9, 1, 0]))
    law = two_link_scheduled
    K = law.gain([0.0, 0.3])
    assert_allclose(law.gain([0.0, 0.3 + 4 * np.pi]), K, atol=1e-10 * np.abs(K).max())
    assert not np.allclose(law.gain([0.0, 2.0]), K, rtol=1e-2)


@pytest.mark.parametrize("name", ["two_link", "long_reach"])
def test_the_boundary_layer_is_stable_between_the_nodes(
    arms, two_link_scheduled, long_reach_scheduled, name
):
    law = {"two_link": two_link_scheduled, "long_reach": long_reach_scheduled}[name]
    for q in np.random.default_rng(17).uniform(law.low, law.high, (60, law.low.size)):
        A2, B2 = boundary_layer(arms[name], q)
        assert np.linalg.eigvals(A2 + B2 @ law.gain(q)).real.max() < -0.5


def test_the_torque_uses_the_gain_of_the_present_configuration(long_reach_scheduled):
    law, z_f = long_reach_scheduled, np.linspace(-1.0, 1.0, 20)
    q = np.array([1.0, -0.2, 0.9, 0.1])
    assert_allclose(law.torque(z_f, q), law.gain(q) @ z_f, rtol=1e-14)
    assert_allclose(law.K_f, law.gain([0.0, -0.3, 1.1, 0.0]), atol=1e-10)


@pytest.mark.parametrize(
    ("name", "values", "field", "value", "limit", "message"),
    [
        ("long_reach", {"alpha": 1.0, "grid": 2, "r": [0.01]}, "fast.grid", 2, None,
         r"a pole.* at .* 1/s.*configuration \["),
        ("long_reach", {"grid": 41}, "fast.grid", 41, "at most 20000",
         r"each of 3 joints \(shoulder_pitch, elbow_pitch, wrist_pitch\) make 68921 designs.*lower fast\.grid to 27"),
        ("two_link", {"low": [0.0, 1.0], "high": [0.0, -1.0]}, "fast.low[1]", 1.0, "-1 rad", "give both"),
    ],
)  # fmt: skip
def test_a_range_or_grid_that_can_not_be_scheduled_is_refused(
    arms, name, values, field, value, limit, message
):
    with pytest.raises(DesignError, match=message) as refused:
        law_of("scheduled_lqr", arms[name], **values)
    error = refused.value
    assert (error.field, error.value, error.limit) == (field, value, limit)


def test_a_joint_may_be_held_out_of_the_grid(arms):
    held = {"low": [0.0, -0.3, 0.4, 0.2], "high": [0.0, -0.3, 1.8, 0.2], "alpha": 1.0}
    law = law_of("scheduled_lqr", arms["long_reach"], **(held | {"grid": 3}))
    assert_array_equal(law.scheduled, [2])
    fixed = {"configuration": [0.0, -0.3, 0.4, 0.2], "alpha": 1.0}
    lqr = law_of("lqr", arms["long_reach"], **fixed)
    assert_allclose(law.gain([3.0, 1.0, 0.4, 1.0]), lqr.K_f, atol=1e-6 * np.abs(lqr.K_f).max())


def test_the_whole_loop_is_checked_in_the_middle_of_the_range(arms, monkeypatch):
    checked = []
    monkeypatch.setattr(full_order, "check", lambda control, q, *more: checked.append(q.tolist()))
    slow, settings = {"type": "model_following"}, {"feedforward": "none", "rate": 500.0}
    fast = {"type": "scheduled_lqr", "grid": 3, "low": [0.2, 0.5], "high": [0.6, 0.7]}
    design(arms["two_link"], slow, fast, settings=settings)
    design(arms["two_link"], slow, {"type": "lqr", "configuration": [0.3, 0.4]}, settings=settings)
    assert_allclose(checked, [[0.4, 0.6], [0.3, 0.4]], rtol=1e-15)


# --------------------------------------------------------------------------- pole_placement


def same_poles(found, wanted, tolerance):
    """Whether two sets of poles agree, each to a relative tolerance."""
    found = list(found)
    for pole in wanted:
        i = int(np.argmin(np.abs(np.array(found) - pole)))
        if abs(found.pop(i) - pole) > tolerance * abs(pole):
            return False
    return not found


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("damping", [0.05, 0.5])
def test_every_mode_gets_the_damping_ratio_and_keeps_its_frequency(arms, name, damping):
    arm = arms[name]
    law = law_of("pole_placement", arm, damping=[damping], configuration=[0.4])
    A2, B2 = boundary_layer(arm, np.full(arm.n_joints, 0.4))
    open_omega, open_zeta = frequencies_and_damping(np.linalg.eigvals(A2))
    assert np.abs(open_zeta - damping).min() > 1e-3
    assert_allclose(law.frequencies, open_omega, rtol=1e-12)
    omega, zeta = frequencies_and_damping(np.linalg.eigvals(A2 + B2 @ law.K_f))
    assert_allclose(omega, open_omega, rtol=1e-8)
    assert_allclose(zeta, damping, rtol=1e-8)
    z_f = np.linspace(1.0, 2.0, 2 * arm.n_modes)
    assert_array_equal(law.torque(z_f, np.zeros(arm.n_joints)), law.K_f @ z_f)


def test_each_mode_has_its_own_damping_and_frequency(arms):
    values = {"damping": [0.3, 0.7, 0.1, 0.2], "frequency_scale": [1.5, 0.8, 1.0, 1.1]}
    law = law_of("pole_placement", arms["two_link"], **values)
    A2, B2 = boundary_layer(arms["two_link"], [0.0, 0.0])
    open_omega, _ = frequencies_and_damping(np.linalg.eigvals(A2))
    omega = open_omega * values["frequency_scale"]
    zeta = np.array(values["damping"])
    wanted = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    wanted = np.concatenate([wanted, wanted.conj()])
    assert same_poles(np.linalg.eigvals(A2 + B2 @ law.K_f), wanted, 1e-8)
    assert same_poles(law.poles, wanted, 1e-12)


def test_for_one_torque_the_gain_is_that_of_an_independent_placement(arms):
    law = law_of("pole_placement", arms["R"], damping=[0.3, 0.6])
    A2, B2 = boundary_layer(arms["R"], [0.0])
    assert_allclose(law.K_f, -place_poles(A2, B2, law.poles).gain_matrix, rtol=1e-8)


def test_damping_zero_leaves_a_mode_as_it_is(arms):
    arm = arms["long_reach"]
    law = law_of("pole_placement", arm, damping=[0.3, 0.2] + [0.0] * 8)
    A2, B2 = boundary_layer(arm, np.zeros(4))
    poles = np.linalg.eigvals(A2)
    poles = poles[np.argsort(np.abs(poles))]
    closed = np.linalg.eigvals(A2 + B2 @ law.K_f)
    wanted = np.concatenate([law.poles[:4], poles[4:]])
    assert same_poles(closed, wanted, 1e-8)
    assert not same_poles(closed, poles, 1e-2)
    untouched = law_of("pole_placement", arm, damping=[0.0])
    assert_array_equal(untouched.K_f, np.zeros((4, 20)))


@pytest.mark.parametrize(
    ("reached", "lost"), [((0.2, 0.0), "stiff_mode"), ((0.0, 0.2), "slender_mode")]
)
def test_a_mode_that_no_torque_reaches_is_named_unless_it_is_left(reached, lost):
    arm = made_up_model([reached], damping=[0.1, 0.1])
    with pytest.raises(DesignError, match=rf"fast\.damping.*can't reach {lost}.*damping 0\.0"):
        law_of("pole_placement", arm)
    left = [0.5, 0.0] if lost == "stiff_mode" else [0.0, 0.5]
    law = law_of("pole_placement", arm, damping=left)
    _, zeta = frequencies_and_damping(np.linalg.eigvals(law.A2 + law.B2 @ law.K_f))
    assert_allclose(zeta.max(), 0.5, rtol=1e-9)


@pytest.mark.parametrize(
    "couplings", [[[0.3, 0.2]], [[0.3, 0.0], [0.0, 0.3]], np.eye(2) * 0.2 + 0.1]
)
def test_real_poles_are_paired_and_placed(couplings):
    arm = made_up_model(couplings, damping=[9.0, 30.0])
    law = law_of("pole_placement", arm, damping=[0.4])
    A2, B2 = boundary_layer(arm, np.zeros(arm.n_joints))
    assert np.isreal(np.linalg.eigvals(A2)).all()
    omega, zeta = frequencies_and_damping(np.linalg.eigvals(A2 + B2 @ law.K_f))
    assert_allclose(zeta, 0.4, rtol=1e-8)
    assert_allclose(omega, frequencies_and_damping(np.linalg.eigvals(A2))[0], rtol=1e-8)


@pytest.mark.parametrize(
    ("damping", "message"),
    [([1.2], r"\[0\]: 1.2 is above"), ([0.1] * 3, r": 3 values where 2 \(modes\)")],
)
def test_a_damping_ratio_out_of_range_or_of_wrong_length_is_refused(arm_r, damping, message):
    with pytest.raises(ParameterError, match=rf"fast\.damping{message}"):
        law_of("pole_placement", arm_r, damping=damping)


# --------------------------------------------------------------------------- output_feedback


def held(arm, q, dt):
    """Phi and Gamma of (11) under a torque held over dt, from first principles."""
    A2, B2 = boundary_layer(arm, q)
    size, n = B2.shape
    flow = expm(np.block([[A2, B2], [np.zeros((n, size + n))]]) * dt)
    return flow[:size, :size], flow[:size, size:]


def amplitudes(z):
    """What the law is given: NaN in the place of the rates."""
    return np.where(np.arange(z.size) < z.size // 2, z, np.nan)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize(("dt", "pole"), [(1e-3, 100.0), (5e-4, 700.0)])
def test_the_closed_poles_are_those_of_regulator_and_observer(arms, name, dt, pole):
    arm = arms[name]
    law = law_of("output_feedback", arm, alpha=2.0, observer_pole=pole)
    Phi, Gamma = held(arm, np.zeros(arm.n_joints), dt)
    A, B, C, D = law.state_space(dt)
    closed = np.linalg.eigvals(np.block([[Phi + Gamma @ D, Gamma @ C], [B, A]]))
    regulator = np.linalg.eigvals(Phi + Gamma @ law.K_f)
    observer = np.exp(-pole * dt) * np.linalg.eigvals(Phi)
    assert same_poles(closed, np.concatenate([regulator, observer]), 1e-8)
    assert np.abs(closed).max() < 1.0


@pytest.mark.parametrize("name", ARMS)
def test_amplitudes_alone_damp_the_boundary_layer(arms, name):
    arm, draw = arms[name], np.random.default_rng(5)
    law = law_of("output_feedback", arm, alpha=2.0)
    # late samples now and then; 1.2 ms still tells the rate of the fastest mode of long_reach
    steps = draw.choice([1e-3, 0.9e-3, 1.2e-3, 3e-3], p=[0.9, 0.04, 0.04, 0.02], size=3000)
    flows = {dt: held(arm, np.zeros(arm.n_joints), dt) for dt in np.unique(steps)}
    m = arm.n_modes
    stiff = np.abs(np.linalg.eigvals(law.A2)).max()
    z = np.concatenate([np.zeros(m), draw.normal(size=m)])  # rates that no amplitude shows yet
    free, start = z.copy(), np.linalg.norm(z)
    u = law.torque(amplitudes(z), np.zeros(arm.n_joints))
    for dt in steps:
        Phi, Gamma = flows[dt]
        z, free = Phi @ z + Gamma @ u, Phi @ free
        law.advance(dt)
        u = law.torque(amplitudes(z), np.zeros(arm.n_joints))
    assert np.isfinite(u).all()
    size = np.linalg.norm(z[m:]) + np.linalg.norm(z[:m]) * min(stiff, 10.0)
    assert size < 0.02 * start
    assert size < 0.1 * np.linalg.norm(free)


def test_the_law_is_its_state_space_sample_by_sample(arms):
    arm, draw = arms["two_link"], np.random.default_rng(6)
    law = law_of("output_feedback", arm, alpha=0.5, configuration=[0.8])
    A, B, C, D = law.state_space(2e-3)
    assert_array_equal(B[:, 4:], 0.0)
    assert_array_equal(D[:, 4:], 0.0)
    z = draw.normal(size=(50, 8))
    w = np.concatenate([z[0, :4], np.zeros(4)])
    for k in range(50):
        if k:
            law.advance(2e-3)
        assert_allclose(law.predicted if k else w, w, rtol=1e-9, atol=1e-12)
        u = law.torque(amplitudes(z[k]), np.zeros(2))
        assert_allclose(u, C @ w + D @ z[k], rtol=1e-9, atol=1e-12)
        w = A @ w + B @ z[k]


def test_a_right_estimate_stays_right_whatever_the_time_steps(arms):
    arm, draw = arms["one_link"], np.random.default_rng(7)
    law = law_of("output_feedback", arm)
    z = np.array([0.01, -0.002, 0.0, 0.0])  # at rest, as the law assumes at first
    u = law.torque(amplitudes(z), np.zeros(1))
    for dt in draw.uniform(5e-4, 5e-3, 100):
        Phi, Gamma = held(arm, [0.0], dt)
        z = Phi @ z + Gamma @ u
        law.advance(dt)
        assert_allclose(law.predicted, z, rtol=1e-8, atol=1e-12)
        u = law.torque(amplitudes(z), np.zeros(1))
        assert_allclose(u, law.K_f @ z, rtol=1e-8, atol=1e-10)


def test_a_repeated_sample_changes_nothing(arms):
    laws = [law_of("output_feedback", arms["R"]) for _ in range(2)]
    z = amplitudes(np.array([0.01, -0.002, 0.0, 0.0]))
    for k in range(5):
        once = laws[0].torque(z * np.cos(k), np.zeros(1))
        laws[1].torque(z, np.zeros(1))  # even another one, of which nothing may stay
        again = [laws[1].torque(z * np.cos(k), np.zeros(1)) for _ in range(3)]
        assert_array_equal(again, [once] * 3)
        for law in laws:
            law.advance(1e-3)


def test_reset_forgets(arm_r):
    law = law_of("output_feedback", arm_r)
    z, runs = amplitudes(np.array([0.01, -0.002, 0.0, 0.0])), []
    for _ in range(2):
        law.reset()
        runs.append([law.torque(z, np.zeros(1))])
        for k in range(4):
            law.advance(1e-3)
            runs[-1].append(law.torque(z / (k + 1), np.zeros(1)))
    assert_array_equal(*runs)
    assert np.ptp(runs) > 0.0


def test_it_has_states_instead_of_a_gain_and_runs_in_the_composite_without_rates(arms):
    control = design(arms["R"], {"type": "none"}, {"type": "output_feedback"})
    assert not control.needs_rates
    assert control.fast.gain([0.0]) is None
    reference, delta = at_rest(np.zeros(1)), np.array([0.01, 0.001])
    for dt in (0.0, 1e-3, 1e-3):
        u = control.step(np.zeros(1), np.zeros(1), delta, None, reference, dt)
        assert np.isfinite(u).all()
        assert u[0] != 0.0
    assert_array_equal(control.step(np.zeros(1), np.zeros(1), delta, None, reference, 0.0), u)


@pytest.mark.parametrize(
    ("name", "kp", "kv", "alpha"), [("R", 6.25, 5.0, 5.0), ("two_link", 1.0, 2.0, 1.0)]
)
def test_the_default_observer_is_stable_in_the_whole_loop_a_much_faster_one_need_not_be(
    arms, name, kp, kv, alpha
):
    arm = arms[name]
    q = np.full(arm.n_joints, 0.8)
    slow = {"type": "linear_model_following", "kp": [kp], "kv": [kv]}
    fast = {"type": "output_feedback", "alpha": alpha, "configuration": [0.8]}
    slowest = full_order.poles(design(arm, slow, fast), q, 1e-3)[0].real
    alone = full_order.poles(design(arm, slow, {"type": "none"}), q, 1e-3)[0].real
    assert slowest < 2.0 * alone < 0.0
    if name == "two_link":
        law = design(arm, slow, fast | {"observer_pole": 200.0})
        assert full_order.poles(law, q, 1e-3)[0].real > 0.0


def test_a_period_that_is_too_long_is_refused(arms):
    arm = arms["R"]  # 87.41 rad/s: half a period is 36 ms
    with pytest.raises(DesignError, match=r"link1_y_mode2.*sample faster") as refused:
        law_of("output_feedback", arm, period=0.035)
    error = refused.value
    assert (error.field, error.value, error.limit) == ("fast.period", 0.035, "0.03235 s")
    with pytest.raises(DesignError, match=r"0\.035 s between samples"):
        law_of("output_feedback", arm).state_space(0.035)
    with pytest.raises(DesignError, match=r"poles of up to 5\d\d.* rad/s.*sampled every 0\.006 s"):
        law_of("output_feedback", arms["two_link"], period=0.006)


def test_over_a_gap_too_long_to_tell_the_rates_it_predicts_and_gives_up_when_all_are(arms):
    law = law_of("output_feedback", arms["R"])
    z = amplitudes(np.array([0.01, -0.002, 0.0, 0.0]))
    for _ in range(3):
        law.torque(z, np.zeros(1))
        law.advance(0.035)
        law.torque(z, np.zeros(1))
        assert_array_equal(law.estimate, law.predicted)
        law.advance(1e-3)
        law.torque(z, np.zeros(1))
        assert np.abs(law.estimate - law.predicted).max() > 0.0
    with pytest.raises(DesignError, match=r"0\.035 s between samples.*link1_y_mode2"):
        for _ in range(law.BLIND):
            law.advance(0.035)


def test_a_gain_that_is_given_is_read_row_by_row(two_link):
    numbers = np.arange(16.0)
    law = design_law(FAST, "fixed_gain", two_link, {"gain": numbers.tolist()})
    z = np.linspace(-1.0, 1.0, 8)
    assert_allclose(law.torque(z, np.zeros(2)), [numbers[:8] @ z, numbers[8:] @ z], rtol=1e-13)
