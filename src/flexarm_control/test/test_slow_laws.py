# SPDX-License-Identifier: Apache-2.0
"""Slow laws: (17) by hand, (13)-(14) as perfect model following, and what defines each of the others."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

from flexarm_control.component import at_rest
from flexarm_control.composite.design import SLOW, design, design_law
from flexarm_control.motions import profiles
from flexarm_control.slow.joint_pid import JointPid
from flexarm_control.slow.payload_model import PayloadModel
from flexarm_control.slow.rigid_arm import Tip, rigid_arm
from flexarm_dynamics import registry
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.arm.units import POUND_FORCE_FOOT
from flexarm_dynamics.errors import DesignError, ParameterError
from flexarm_dynamics.linear import jacobian
from flexarm_dynamics.models import model
from flexarm_dynamics.models.fixed_step import METHODS
from flexarm_dynamics.models.model import Terms
from flexarm_dynamics.singular_perturbation import slow_subsystem

#: Laws that ask for the reference's acceleration on it, whatever the arm.
LAWS = (
    "model_following",
    "computed_torque",
    "resolved_acceleration",
    "sliding_mode",
    "adaptive_model_following",
)
# (A2) of arms R and P3: J0 + M L^2 + I0 = 0.109 + 3.1e-3 * 16 + 1 [lbf ft s^2]
M11 = 1.1586 * POUND_FORCE_FOOT  # [kg m^2]


@pytest.fixture(scope="session")
def every_size(arm_r, heavy_arm, rigid, two_link, long_reach):
    """Both classes of model, one to four joints, with and without modes."""
    return (arm_r, heavy_arm, rigid, two_link, long_reach)


def law_of(name, arm, **parameters):
    return design_law(SLOW, name, arm, parameters)


def reference(position, velocity=0.0, acceleration=0.0):
    n = np.size(position)
    values = (np.broadcast_to(x, n).astype(float) for x in (position, velocity, acceleration))
    return SimpleNamespace(
        **dict(zip(("position", "velocity", "acceleration"), values, strict=True))
    )


def torque_at(law, q, qd, ref):
    q, qd = (np.atleast_1d(np.asarray(x, float)) for x in (q, qd))
    return law.torque(q, qd, ref, law.model.terms(q, qd))


def some_state(n, seed=1):
    """Joint position, velocity and a reference near them, away from singularities."""
    random = np.random.default_rng(seed)
    q, qd = 0.5 + 0.3 * random.uniform(-1, 1, n), random.uniform(-1, 1, n)
    near = 0.05 * random.uniform(-1, 1, (2, n))
    return q, qd, reference(q + near[0], qd + near[1], random.uniform(-2, 2, n))


def acceleration_of(plant, u, q, qd):
    a, B = slow_subsystem(plant.terms(q, qd))
    return a + B @ u


def motion(profile, t):
    """A profile as the reference at a time."""

    def near(offset):
        at = t + offset
        return np.array([profile.position(at), profile.velocity(at), profile.acceleration(at)])

    made = reference(*near(0.0))
    made.near = near
    return made


def tracked(law, plant, profile, start, times, method="DOP853", rtol=1e-9, atol=1e-10):
    """States (q, qd) at the times of the slow subsystem (10) of a plant, from a start, under a law."""
    n = plant.n_joints

    def derivative(t, x):
        u = torque_at(law, x[:n], x[n:], motion(profile, t))
        return np.concatenate([x[n:], acceleration_of(plant, u, x[:n], x[n:])])

    return solve_ivp(derivative, (0, times[-1]), start, method, times, rtol=rtol, atol=atol).y.T


# --------------------------------------------------------------------------- all of them


@pytest.mark.parametrize("name", (*LAWS, "linear_model_following", "none"))
def test_a_law_gives_one_torque_per_joint_on_every_arm_and_leaves_its_inputs_alone(
    name, every_size
):
    for arm in every_size:
        law = law_of(name, arm)
        q, qd, ref = some_state(arm.n_joints)
        inputs = (q, qd, ref.position, ref.velocity, ref.acceleration)
        kept = [x.copy() for x in inputs]
        u = torque_at(law, q, qd, ref)
        assert u.shape == (arm.n_joints,) and np.isfinite(u).all()
        for x, was in zip(inputs, kept, strict=True):
            assert_array_equal(x, was)
        law.advance(1e-3)
        law.reset()
        assert_array_equal(torque_at(law, q, qd, ref), u)


@pytest.mark.parametrize("name", LAWS)
def test_on_its_reference_every_law_asks_for_the_references_acceleration(name, every_size):
    for arm in every_size:
        q, qd, ref = some_state(arm.n_joints)
        law = law_of(name, arm)
        u = torque_at(law, q, qd, reference(q, qd, ref.acceleration))
        assert_allclose(acceleration_of(arm, u, q, qd), ref.acceleration, atol=1e-8)
        assert_allclose(u, law.nominal(arm.terms(q, qd), ref.acceleration), atol=1e-7)


@pytest.mark.parametrize("name", LAWS)
def test_a_law_gives_the_same_torque_with_and_without_given_terms(name, every_size):
    for arm in every_size:
        q, qd, ref = some_state(arm.n_joints)
        law, terms = law_of(name, arm), arm.terms(q, qd)
        wanted, size = np.array(law.torque(q, qd, ref, terms)), 1e-12 * arm.terms(q, qd).M.max()
        assert_allclose(law_of(name, arm).torque_at(q, qd, ref), wanted, rtol=1e-12, atol=size)
        nominal = np.array(law.nominal(terms, ref.acceleration))
        assert_allclose(law.nominal_at(q, qd, ref.acceleration), nominal, rtol=1e-12, atol=size)


def test_a_parameter_of_one_name_is_declared_alike_in_all_slow_laws():
    seen = {}
    for law in registry.importable(SLOW).values():
        for p in law.PARAMETERS:
            assert seen.setdefault(p.name, p) == p


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("computed_torque", {"ki": [-1.0]}, r"slow\.ki\[0\]: -1\.0 .*is below"),
        ("computed_torque", {"feedforward_at": "rest"}, r"slow\.feedforward_at: 'rest'"),
        ("resolved_acceleration", {"singularity": 0.0}, r"slow\.singularity: 0\.0 .*is below"),
        ("resolved_acceleration", {"tip_kp": [6.25]}, r"slow\.tip_kp: .* is not a number"),
        ("sliding_mode", {"boundary_layer": [0.0]}, r"slow\.boundary_layer\[0\]: 0\.0 .*is below"),
        ("sliding_mode", {"inertia_error": 1.0}, r"slow\.inertia_error: 1\.0 is above"),
        ("sliding_mode", {"lambda": [1.0, 2.0]}, r"slow\.lambda: 2 values where 1"),
        ("adaptive_model_following", {"payload_scale_max": 0.5}, r"payload_scale_max: 0\.5 is below"),
        ("adaptive_model_following", {"adaptation_gain": np.nan}, r"adaptation_gain: nan"),
    ],
)  # fmt: skip
def test_parameters_out_of_range_are_refused(arm_r, name, values, message):
    with pytest.raises(ParameterError, match=message):
        law_of(name, arm_r, **values)


# --------------------------------------------------------------------------- (17)


def test_linear_model_following_is_17_by_hand_for_two_joints():
    M, modal, zero = np.eye(3), np.zeros((1, 1)), np.zeros((2, 1))
    M[:2, :2] = [[2, 1], [1, 4]]
    terms = Terms(M, np.zeros(2), np.zeros(1), zero, modal, zero, np.eye(1))
    arm = SimpleNamespace(n_joints=2, n_modes=1, arm=SimpleNamespace(gauges=()))
    law = law_of("linear_model_following", arm, kp=[4.0, 9.0], kv=[2.0, 3.0])
    ref = reference([0.5, -0.25], [0.125, 0.5], [1.0, -2.0])
    torque = law.torque(np.array([0.25, 0.0]), np.array([0.0, 0.25]), ref, terms)
    # v = acceleration + kv (velocity error) + kp (position error) = (2.25, -3.5)
    assert_allclose(torque, [2 * 2.25 - 3.5, 2.25 - 4 * 3.5], rtol=1e-14)


def test_on_the_papers_arm_17_multiplies_by_m11_and_each_term_has_its_gain(arm_r):
    law = law_of("linear_model_following", arm_r)
    torque = torque_at(law, 0.2, 0.4, reference(0.5, 1.0, 0.25))
    assert_allclose(torque, [M11 * (0.25 + 5.0 * 0.6 + 6.25 * 0.3)], rtol=1e-14)
    law = law_of("linear_model_following", arm_r, kp=[7.0], kv=[3.0])
    for ref, gain in ((reference(1.0), 7.0), (reference(0, 1.0), 3.0), (reference(0, 0, 1.0), 1.0)):
        assert_allclose(torque_at(law, 0.0, 0.0, ref), [M11 * gain], rtol=1e-14)


def test_h11_reproduces_the_slow_poles_of_the_published_17(arm_p3):
    ref = reference(0.5, 1.0, 0.25)
    right = torque_at(law_of("linear_model_following", arm_p3), 0, 0, ref)[0]
    published = torque_at(law_of("linear_model_following", arm_p3, gain="h11"), 0, 0, ref)[0]
    assert_allclose(published / right, 1.0 / (1.1586 * 1.010133), rtol=1e-6)
    poles = np.roots([1.0, 5.0 * published / right, 6.25 * published / right])
    assert_allclose(sorted(poles.imag), [-0.88, 0.88], atol=0.005)
    assert_allclose(poles.real, [-2.14, -2.14], atol=0.005)


def test_under_gravity_17_does_not_depend_on_where_the_arm_was_before(heavy_arm):
    travelled, fresh = (law_of("linear_model_following", heavy_arm) for _ in range(2))
    torque_at(travelled, -1.5, 0.0, reference(1.0))
    torques = [torque_at(law, 0.3, 0.0, reference(1.0)) for law in (travelled, fresh)]
    assert_array_equal(*torques)


# --------------------------------------------------------------------------- (13)-(14)


def test_13_cancels_gravity_and_friction_on_the_slow_subsystem(heavy_arm):
    law = law_of("model_following", heavy_arm, kp=[9.0], kv=[4.0])
    for q, qd in ((0.3, -0.7), (-2.0, 3.0), (1.5, 0.01)):
        u = torque_at(law, q, qd, reference(0.9, -0.4, 2.0))
        q, qd = np.array([q]), np.array([qd])
        wanted = 2.0 + 4.0 * (-0.4 - qd) + 9.0 * (0.9 - q)
        assert_allclose(acceleration_of(heavy_arm, u, q, qd), wanted, rtol=1e-12)
        # There was something to cancel.
        assert np.abs(acceleration_of(heavy_arm, 0.0 * u, q, qd)) > 0.1


def test_13_follows_the_reference_model_perfectly_from_any_initial_error(heavy_arm):
    profile, e0, ed0 = profiles.paper_profile(), 0.3, -0.8
    times = np.linspace(0.0, 2.0, 41)
    law, start = law_of("model_following", heavy_arm), [profile.start[0] - e0, -ed0]
    x = tracked(law, heavy_arm, profile, start, times, rtol=1e-11, atol=1e-12)
    # e'' + 5 e' + 6.25 e = 0: a double pole at -2.5
    error = (e0 + (ed0 + 2.5 * e0) * times) * np.exp(-2.5 * times)
    assert_allclose(profile.position(times)[:, 0] - x[:, 0], error, atol=1e-10)


def test_13_is_17_where_there_is_nothing_to_compensate_and_holds_the_weight(arm_r, heavy_arm):
    laws = ("model_following", "linear_model_following")
    for qd in (0.0, 0.1, 1.5):
        ref = reference(0.5, 1.0, 0.25)
        general, linear = (torque_at(law_of(name, arm_r), 0.2, qd, ref) for name in laws)
        assert_allclose(general, linear, rtol=1e-12)
    general, linear = (torque_at(law_of(n, heavy_arm), 0.2, 0.0, reference(0.2)) for n in laws)
    assert_allclose(linear, 0.0, atol=1e-14)
    assert general[0] > 1.0


def test_no_slow_law_gives_no_torque(arm_r):
    assert_array_equal(torque_at(law_of("none", arm_r), 0.5, 1.0, reference(2.0, 1.0, 1.0)), [0.0])


# --------------------------------------------------------------------------- computed torque


def test_computed_torque_without_its_extras_is_model_following(every_size):
    for arm in every_size:
        q, qd, ref = some_state(arm.n_joints)
        laws = (law_of(name, arm) for name in ("computed_torque", "model_following"))
        assert_allclose(*(torque_at(law, q, qd, ref) for law in laws), rtol=1e-9)


def test_computed_torque_makes_the_error_linear_on_a_rigid_arm(rigid):
    law = law_of("computed_torque", rigid, kp=[9.0, 16.0], kv=[6.0, 8.0])
    profile, e0 = profiles.quintic([0.2, -0.4], [1.0, 1.1], 1.0), np.array([0.3, -0.2])
    times = np.linspace(0.0, 1.0, 5)
    x = tracked(law, rigid, profile, [*(profile.start - e0), 0, 0], times)
    rate, t = np.array([3.0, 4.0]), times[:, None]  # double poles
    wanted = e0 * (1.0 + rate * t) * np.exp(-rate * t)
    assert_allclose(profile.position(times) - x[:, :2], wanted, atol=1e-7)
    assert_array_equal(law.error_gains(), [[9.0, 16.0], [6.0, 8.0]])


def settled(law, plant, seconds, q, dt=0.01):
    """Where a law holds a rigid plant that it knows wrongly, from rest at q."""
    q, qd, ref = q.copy(), np.zeros_like(q), reference(q)
    for i in range(round(seconds / dt)):
        if i:
            law.advance(dt)
        qd += dt * acceleration_of(plant, torque_at(law, q, qd, ref), q, qd)
        q += dt * qd
    return ref.position - q


def test_the_integral_takes_away_the_sag_that_model_following_keeps(rigid):
    plant, q = rigid.with_payload(1.5), np.array([0.3, 0.2])
    gains = {"kp": [16.0], "kv": [8.0]}
    sagged = settled(law_of("model_following", rigid, **gains), plant, 4.0, q)
    integral = {"ki": [20.0], "integral_limit": [20.0]}
    level = settled(law_of("computed_torque", rigid, **gains, **integral), plant, 4.0, q)
    assert np.abs(sagged).min() > 0.02
    assert np.abs(level).max() < 1e-3


def test_the_integral_stops_at_its_clamp(rigid):
    law = law_of("computed_torque", rigid, ki=[8.0], integral_limit=[0.5, 0.25])
    q = np.array([0.3, 0.2])
    for _ in range(100):
        torque_at(law, q, np.zeros(2), reference(q + 0.1))
        law.advance(0.1)
    assert_array_equal(law.integral, [0.5, 0.25])


def test_the_integral_does_not_grow_into_a_torque_limit(arm_r):
    law = law_of("computed_torque", arm_r, ki=[8.0], integral_limit=[1e3])
    rest = np.zeros(1)
    for distance, grows in ((5.0, False), (-5.0, False), (0.1, True)):  # limit 13.6 N m
        law.reset()
        torque_at(law, rest, rest, reference([distance]))
        law.advance(0.5)
        assert_allclose(law.integral, [0.5 * 8.0 * distance if grows else 0.0])


def test_feedforward_at_the_reference_does_not_feed_back_measured_speed_through_friction(heavy_arm):
    law = law_of("computed_torque", heavy_arm, feedforward_at="reference")
    q, ref = np.array([0.3]), reference([0.4], [0.02], [0.5])
    slow, fast = (torque_at(law, q, np.array([v]), ref) for v in (-0.02, 0.06))
    B = slow_subsystem(heavy_arm.terms(ref.position, ref.velocity))[1]
    assert_allclose(slow - fast, np.linalg.solve(B, [5.0 * 0.08]), rtol=1e-9)
    assert law.error_gains() is None
    state = law_of("computed_torque", heavy_arm)
    of_state = [torque_at(state, q, np.array([v]), ref) for v in (-0.02, 0.06)]
    assert np.abs(of_state[0] - of_state[1] - (slow - fast)).max() > 0.05  # Coulomb friction


def test_an_integral_that_would_be_unstable_is_refused(rigid):
    with pytest.raises(DesignError, match="joint2") as refused:
        law_of("computed_torque", rigid, ki=[1.0, 31.25])
    error = refused.value
    assert (error.field, error.value, error.limit) == ("slow.ki[1]", 31.25, "31.25 1/s^3")
    law = law_of("computed_torque", rigid, ki=[31.0])
    assert law.error_gains() is None
    poles = np.roots([1.0, 5.0, 6.25, 31.0])
    assert -0.1 < poles.real.max() < 0.0  # just below the limit


def test_a_redesign_goes_on_with_the_integral(rigid):
    old = law_of("computed_torque", rigid, ki=[8.0])
    old.integral[:] = [1.0, -1.5]
    new = law_of("computed_torque", rigid, ki=[4.0], integral_limit=[1.25])
    new.resume(old)
    assert_array_equal(new.integral, [1.0, -1.25])
    without = law_of("computed_torque", rigid)
    without.resume(old)
    assert_array_equal(without.integral, [0.0, 0.0])


# --------------------------------------------------------------------------- resolved acceleration


def test_the_tips_kinematics_are_the_derivatives_of_its_position(every_size):
    for arm in every_size:
        q, qd, _ = some_state(arm.n_joints)
        tip = Tip(arm.arm)
        x, J, bias = tip.at(q, qd)
        assert_allclose(x, arm.tip_position(q, np.zeros(arm.n_modes)), atol=1e-12)

        assert_allclose(J, jacobian(lambda a, tip=tip, qd=qd: tip.at(a, qd)[0], q, 1e-5), atol=1e-8)
        # dJ/dt qd: J depends on the angles alone.
        velocity = jacobian(lambda a, tip=tip, qd=qd: tip.at(a, qd)[1] @ qd, q, 1e-5)
        assert_allclose(bias, velocity @ qd, atol=1e-7)


def resolved(arm, **gains):
    """Tip's acceleration under the law, and what its gains ask for."""
    q, qd, ref = some_state(arm.n_joints)
    law = law_of("resolved_acceleration", arm, tip_kp=30.0, tip_kv=7.0, **gains)
    qdd = acceleration_of(arm, torque_at(law, q, qd, ref), q, qd)
    tip, step = Tip(arm.arm), 1e-4
    x, J, bias = tip.at(q, qd)

    def wanted_at(t):
        return tip.at(ref.position + t * (ref.velocity + 0.5 * t * ref.acceleration), qd)[0]

    before, now, after = (wanted_at(t) for t in (-step, 0.0, step))
    asked = (after - 2 * now + before) / step**2
    asked += 7.0 * ((after - before) / (2 * step) - J @ qd) + 30.0 * (now - x)
    return J, J @ qdd + bias, asked, qdd, (q, qd, ref)


def test_the_tip_gets_the_acceleration_asked_for_where_it_can_move(every_size, long_reach):
    for arm in every_size:
        J, got, asked, _, _ = resolved(arm, singularity=1e-3)
        # All directions of the plane or of space; of one link, along its circle.
        able = np.linalg.svd(J)[0][:, : np.linalg.matrix_rank(J, 1e-6)]
        assert able.shape[1] == min(arm.n_joints, 3 if arm is long_reach else 2)
        assert_allclose(able.T @ got, able.T @ asked, atol=2e-6)


def test_what_does_not_move_the_tip_follows_the_joints_own_law(long_reach):
    J, _, _, qdd, (q, qd, ref) = resolved(
        long_reach, singularity=1e-3, kp=[3.0, 5.0, 7.0, 9.0], kv=[2.0]
    )
    own = ref.acceleration + 2.0 * (ref.velocity - qd)
    own += np.array([3.0, 5.0, 7.0, 9.0]) * (ref.position - q)
    null = np.linalg.svd(J)[2][3]  # four joints, three directions
    assert_allclose(J @ null, 0.0, atol=1e-12)
    assert_allclose(null @ qdd, null @ own, atol=1e-8)
    assert np.abs(qdd - own).max() > 0.05


def test_the_tips_error_decays_by_its_gains_on_a_rigid_arm(rigid):
    law = law_of("resolved_acceleration", rigid, tip_kp=25.0, tip_kv=10.0, kp=[1.0], kv=[1.0])
    profile, tip, rest = profiles.quintic([0.3, 0.8], [1.2, 1.5], 1.0), Tip(rigid.arm), np.zeros(2)
    times = np.linspace(0.0, 1.0, 5)
    x = tracked(law, rigid, profile, [0.25, 0.9, 0, 0], times)
    reached = np.array([tip.at(row[:2], rest)[0] for row in x])
    error = np.array([tip.at(profile.position(t), rest)[0] for t in times]) - reached
    decay = ((1.0 + 5.0 * times) * np.exp(-5.0 * times))[:, None]
    assert np.abs(error[0]).max() > 0.01
    assert_allclose(error, error[0] * decay, atol=1e-8)


def test_towards_a_stretched_arm_the_joints_law_takes_over_without_a_jump(two_link):
    law = law_of("resolved_acceleration", two_link, tip_kp=50.0)
    ref, qd = reference([0.02, 0.03], 0.1, [1.0, -3.0]), np.array([0.1, -0.2])
    stretched = law.acceleration(np.zeros(2), qd, ref)
    J = law.tip.at(np.zeros(2), qd)[1]
    null = np.linalg.svd(J)[2][1]
    own = ref.acceleration + 5.0 * (ref.velocity - qd) + 6.25 * ref.position
    assert_allclose(null @ stretched, null @ own, atol=1e-9)  # the direction that it can't move
    assert abs(J[0, 0]) < 1e-12
    angles = np.linspace(-0.3, 0.3, 301)
    path = np.array([law.acceleration(np.array([0.0, a]), qd, ref) for a in angles])
    assert np.abs(path).max() < 60.0
    assert np.abs(np.diff(path, axis=0)).max() < 2.0


def test_the_damped_inverse_is_the_inverse_away_from_singularities(two_link):
    law = law_of("resolved_acceleration", two_link, singularity=0.1)
    J = law.tip.at(np.array([0.2, 1.2]), np.zeros(2))[1]
    assert_allclose(law.damped_inverse(J), np.linalg.pinv(J), atol=1e-12)
    J = law.tip.at(np.array([0.2, 0.1]), np.zeros(2))[1]
    sigma = np.linalg.svd(J, compute_uv=False)
    assert sigma[1] < 0.1 * law.tip.reach < sigma[0]
    share = np.linalg.eigvals(law.damped_inverse(J) @ J)
    assert_allclose(np.sort(share.real), [(sigma[1] / (0.1 * law.tip.reach)) ** 2, 1.0], rtol=1e-9)


# --------------------------------------------------------------------------- sliding mode


@pytest.mark.parametrize("rho", [0.0, 0.3])
def test_the_sliding_condition_holds_for_every_error_within_the_bounds(rigid, long_reach, rho):
    bounds = {"disturbance_bound": [1.5], "eta": [0.7], "boundary_layer": [0.1]}
    random = np.random.default_rng(3)
    tightest = np.inf
    for arm in (rigid, long_reach):
        law, n = law_of("sliding_mode", arm, inertia_error=rho, **bounds), arm.n_joints
        for _ in range(100):
            q, qd, ref = some_state(n, random.integers(1 << 30))
            ref.velocity = qd + random.uniform(-2, 2, n)
            a, B = slow_subsystem(arm.terms(q, qd))
            error = random.choice([-1.0, 1.0], (n, n)) * rho / n  # largest row sums
            true_a = a + random.choice([-1.0, 1.0], n) * 1.5
            qdd = true_a + (np.eye(n) + error) @ B @ torque_at(law, q, qd, ref)
            rate = ref.velocity - qd
            s = rate + 2.5 * (ref.position - q)
            sd = ref.acceleration - qdd + 2.5 * rate
            outside = np.abs(s) >= 0.1
            margin = -0.7 * np.abs(s) - s * sd
            assert (margin[outside] >= -1e-9).all()
            tightest = min(tightest, (margin / np.abs(s))[outside].min())
    assert tightest < 0.35 if rho else tightest < 1e-9  # no more than is needed


def test_the_layer_is_reached_in_time_and_kept_with_the_wrong_payload(rigid):
    plant = rigid.with_payload(1.4)
    q, phi, eta = np.array([0.3, 0.4]), 0.2, 1.0
    law = law_of(
        "sliding_mode", rigid, **{"lambda": [4.0]}, eta=[eta], boundary_layer=[phi],
        disturbance_bound=[12.0], inertia_error=0.5,
    )  # fmt: skip
    profile = profiles.quintic(q + 0.4, q + 0.8, 2.0)
    times = np.linspace(0.0, 3.0, 61)
    x = tracked(law, plant, profile, [*q, 0, 0], times, "LSODA", rtol=1e-7, atol=1e-8)
    error, rate = profile.position(times) - x[:, :2], profile.velocity(times) - x[:, 2:]
    s = np.abs(rate + 4.0 * error)
    assert s[0].min() > 1.0
    assert (s[times >= (s[0].max() - phi) / eta] <= phi).all()
    assert np.abs(error[-1]).max() < phi / 4.0
    # The bounds that it was given are those of this payload, and it needs them.
    for t, row in zip(times, x, strict=True):
        (a, B), (a1, B1) = (slow_subsystem(m.terms(row[:2], row[2:])) for m in (rigid, plant))
        assert np.abs(a - a1).max() <= 12.0
        assert np.abs(B1 @ np.linalg.inv(B) - np.eye(2)).sum(axis=1).max() <= 0.5, t


def test_within_the_layer_sliding_mode_is_linear(heavy_arm):
    law = law_of("sliding_mode", heavy_arm, **{"lambda": [3.0]}, boundary_layer=[0.5])
    q, qd = np.array([0.4]), np.array([0.3])
    for e, ed in ((0.02, 0.1), (-0.05, 0.05)):
        u = torque_at(law, q, qd, reference(q + e, qd + ed, 0.7))
        wanted = 0.7 + 3.0 * ed + (0.5 + 0.5) / 0.5 * (ed + 3.0 * e)
        assert_allclose(acceleration_of(heavy_arm, u, q, qd), [wanted], rtol=1e-9)


def test_a_layer_too_thin_for_the_bending_is_warned_of(arm_r, rigid):
    (warning,) = law_of("sliding_mode", arm_r, boundary_layer=[0.01]).warnings()
    assert warning.startswith("slow.boundary_layer[0]: 0.01 rad/s gives")
    least = float(warning.rsplit(" ", 1)[1])
    assert law_of("sliding_mode", arm_r, boundary_layer=[1.05 * least]).warnings() == ()
    assert law_of("sliding_mode", arm_r, boundary_layer=[0.9 * least]).warnings() != ()
    assert law_of("sliding_mode", rigid, boundary_layer=[0.001]).warnings() == ()


# --------------------------------------------------------------------------- adaptive model following


def adaptive(arm, **parameters):
    return law_of("adaptive_model_following", arm, **parameters)


def test_a_model_between_two_payloads_is_the_model_of_that_payload(every_size):
    for arm in every_size:
        q, qd, ref = some_state(arm.n_joints)
        believed = PayloadModel(arm)
        assert believed.n_modes == arm.n_modes and believed.arm is arm.arm
        for scale in (1.0, 0.0, 3.5):
            believed.scale = scale
            other = arm.with_payload(scale)
            assert_allclose(other.arm.payload.mass, scale * arm.arm.payload.mass, rtol=1e-14)
            mine, its = believed.terms(q, qd), other.terms(q, qd)
            for name in ("M", "f1", "f2", "C1", "K1", "K2"):
                a, b = getattr(mine, name), getattr(its, name)
                assert_allclose(a, b, rtol=1e-9, atol=1e-9 * max(np.abs(b).max(initial=0.0), 1e-3))
            u, wanted = (m.slow_torque(q, qd, ref.acceleration) for m in (believed, other))
            assert_allclose(u, wanted, rtol=1e-8, atol=1e-9 * max(np.abs(wanted).max(), 1e-3))


def test_the_regressor_is_the_torque_of_one_payload_more(rigid, long_reach):
    for arm in (rigid, long_reach):
        q, qd, ref = some_state(arm.n_joints)
        law, stiff = adaptive(arm), rigid_arm(arm.arm)
        Y = law.regressor(q, qd, qd, ref.acceleration)
        one, four = (
            m.inverse_dynamics(q, qd, ref.acceleration) for m in (stiff, stiff.with_payload(4.0))
        )
        assert_allclose(3.0 * Y, four - one, rtol=1e-10)


def test_coriolis_terms_are_christoffels(rigid, long_reach):
    for arm in (rigid, long_reach):
        law, stiff, n = adaptive(arm), rigid_arm(arm.arm), arm.n_joints
        q, qd, _ = some_state(n)
        C = np.column_stack([law._coriolis(stiff.forces, q, qd, e) for e in np.eye(n)])
        still = stiff.forces(q, np.zeros(n))
        assert_allclose(C @ qd, stiff.forces(q, qd) - still, rtol=1e-9, atol=1e-10)
        h = 1e-5
        Md = (stiff.mass_matrix(q + h * qd) - stiff.mass_matrix(q - h * qd)) / (2 * h)
        skew = Md - 2.0 * C
        assert_allclose(skew, -skew.T, atol=1e-7 * np.abs(C).max())


def adapted(arm, true_scale, profile, law, times):
    """State (q, qd, estimate) of a rigid arm with another payload under the law in continuous time."""
    plant, n = arm.with_payload(true_scale), arm.n_joints

    def derivative(t, x):
        law.model.scale = x[-1]
        u = torque_at(law, x[:n], x[n:-1], motion(profile, t))
        return np.concatenate([x[n:-1], acceleration_of(plant, u, x[:n], x[n:-1]), [law.learning]])

    start = np.concatenate([profile.position(0.0), np.zeros(n), [law.payload_scale]])
    return solve_ivp(derivative, (0, times[-1]), start, "RK45", times, rtol=1e-7, atol=1e-8).y.T


@pytest.fixture(scope="module")
def swing(rigid):
    """A rigid arm with twice its payload that moves up and down, over and over."""
    start, angle, rate = np.array([0.1, 0.6]), np.array([0.8, -0.9]), 2.0 * np.pi / 1.5
    profile = SimpleNamespace(
        position=lambda t: start + 0.5 * angle * (1.0 - np.cos(rate * np.asarray(t)[..., None])),
        velocity=lambda t: 0.5 * angle * rate * np.sin(rate * t),
        acceleration=lambda t: 0.5 * angle * rate**2 * np.cos(rate * t),
    )
    law = adaptive(rigid, dead_zone=0.0, kp=[16.0], kv=[8.0])
    times = np.linspace(0.0, 4.5, 181)
    return law, profile, times, adapted(rigid, 2.0, profile, law, times)


def test_the_estimate_finds_the_payload_and_the_error_falls(swing):
    _, profile, times, x = swing
    assert_allclose(x[-1, -1], 2.0, rtol=0.01)
    error = np.abs(profile.position(times) - x[:, :2]).max(axis=1)
    first, third = error[times <= 1.5].max(), error[times >= 3.0].max()
    assert first > 0.01
    assert third < 0.1 * first


def test_lyapunovs_function_falls_as_the_combined_error_alone_makes_it(rigid, long_reach):
    for arm in (rigid, rigid_arm(long_reach.arm)):
        law = adaptive(arm, dead_zone=0.0, kp=[6.0], kv=[5.0])
        law._limit[:] = np.inf
        law.model.scale, p = 1.7, 2.6
        plant, believed = arm.with_payload(p), arm.with_payload(1.7)
        for seed in range(5):
            q, qd, ref = some_state(arm.n_joints, seed)
            ref.velocity = qd + np.random.default_rng(seed).uniform(-2, 2, arm.n_joints)
            qdd = acceleration_of(plant, torque_at(law, q, qd, ref), q, qd)
            rate = ref.velocity - qd
            s, sd = rate + 2.0 * (ref.position - q), ref.acceleration - qdd + 2.0 * rate
            h = 1e-6
            Md = (plant.mass_matrix(q + h * qd) - plant.mass_matrix(q - h * qd)) / (2 * h)
            Vd = s @ plant.mass_matrix(q) @ sd + 0.5 * s @ Md @ s
            Vd += (1.7 - p) * law.learning / law.gamma
            assert_allclose(Vd, -3.0 * s @ believed.mass_matrix(q) @ s, rtol=1e-6)


def test_lyapunovs_function_never_grows(swing, rigid):
    law, profile, times, x = swing
    stiff, V = rigid_arm(rigid.arm).with_payload(2.0), []
    for t, row in zip(times, x, strict=True):
        ref = motion(profile, t)
        s = ref.velocity - row[2:4] + 4.0 * (ref.position - row[:2])
        V.append(0.5 * s @ stiff.mass_matrix(row[:2]) @ s + (row[-1] - 2.0) ** 2 / (2 * law.gamma))
    assert np.diff(V).max() <= 1e-6 * V[0]
    assert V[-1] < 0.01 * V[0]


def test_under_steady_acceleration_the_estimate_has_the_dynamics_of_its_gain(arm_r):
    arm, A = rigid_arm(arm_r.arm), 2.0
    law = adaptive(arm, adaptation_gain=1.5, dead_zone=0.0)
    steady = SimpleNamespace(
        position=lambda t: np.array([0.5 * A * t * t]),
        velocity=lambda t: np.array([A * t]),
        acceleration=lambda t: np.array([A]),
    )
    times = np.linspace(0.0, 2.0, 9)
    x = adapted(arm, 1.05, steady, law, times)  # small: the law is linear in it
    wanted = solve_ivp(
        lambda t, y: [y[1], -2.5 * y[1] - 1.5 * A**2 * y[0]], (0, 2), [-0.05, 0.0], t_eval=times
    ).y[0]
    assert_allclose(x[:, -1] - 1.05, wanted, atol=0.05 * 0.05)


def test_with_the_payload_known_one_joint_is_model_following(heavy_arm):
    q, qd, ref = some_state(1)
    law = adaptive(heavy_arm, kp=[6.0], kv=[5.0])
    wanted = torque_at(law_of("model_following", heavy_arm, kp=[6.0], kv=[5.0]), q, qd, ref)
    assert_allclose(torque_at(law, q, qd, ref), wanted, rtol=1e-10)
    assert_allclose([law.surface[0], law.approach[0]], [2.0, 3.0])
    assert_array_equal(law.error_gains(), [[6.0], [5.0]])


def learnt(arm, seconds=0.1, error=0.5, **parameters):
    law = adaptive(arm, **parameters)
    rest = np.zeros(arm.n_joints)
    torque_at(law, rest, rest, reference(rest + 0.01, error, 2.0))
    law.advance(seconds)
    return law


def test_the_estimate_is_projected_into_its_bounds(arm_r):
    assert learnt(arm_r, 0.01).payload_scale > 1.0
    assert learnt(arm_r, 1e4, payload_scale_max=2.5).payload_scale == 2.5
    assert learnt(arm_r, 1e4, -0.5).payload_scale == 0.0


def test_nothing_is_learnt_at_rest_in_the_dead_zone_or_beyond_the_torque_limit(arm_r):
    law, rest = adaptive(arm_r), np.zeros(1)
    torque_at(law, rest, rest, reference([0.2]))  # a standing error, no gravity
    assert law.learning == 0.0
    assert learnt(arm_r, dead_zone=0.53).payload_scale == 1.0  # s = 0.525 rad/s
    assert learnt(arm_r, dead_zone=0.52).payload_scale > 1.0
    assert learnt(arm_r, error=5.0).payload_scale == 1.0  # 43 N m
    assert learnt(arm_r, adaptation_gain=0.0).payload_scale == 1.0


def test_the_estimate_is_kept_until_a_session_begins_and_over_a_redesign(arm_r):
    law = learnt(arm_r)
    kept = law.payload_scale
    rest = np.zeros(1)
    for _ in range(100):
        torque_at(law, rest, rest, reference(rest))
        law.advance(0.1)
    assert law.payload_scale == kept > 1.0
    new = adaptive(arm_r, adaptation_gain=1.0)
    new.resume(law)
    assert new.payload_scale == kept
    law.reset()
    assert law.payload_scale == 1.0


def test_what_can_not_be_learnt_is_refused(arm_r):
    empty = arm_r.with_payload(0.0)
    with pytest.raises(DesignError, match=r"payload\.mass: 0 in arm R"):
        adaptive(empty)
    with pytest.raises(DesignError) as refused:
        adaptive(arm_r, kv=[4.0])
    assert (refused.value.field, refused.value.limit) == ("slow.kv[0]", "at least 5")


def peak_errors(plant, law, moves, dt=1e-3):
    """Largest joint error [deg] of each move of the paper's, there and back, on a flexible arm of one joint."""
    m = plant.n_modes
    state, step, peaks = np.zeros(2 * (1 + m)), plant.stepper(METHODS["rk4"]), []
    for move in range(moves):
        start, angle = (np.pi / 2, -np.pi / 2) if move % 2 else (0.0, np.pi / 2)
        profile, worst = profiles.paper_profile(2.0, angle, start), 0.0
        for i in range(round(2.2 / dt)):
            ref = motion(profile, i * dt)
            q, delta, qd, delta_d = np.split(state, [1, 1 + m, 2 + m])
            u = law.step(q, qd, delta, delta_d, ref, dt if move or i else 0.0)
            worst = max(worst, abs(ref.position[0] - state[0]))
            step(state, u.copy(), dt / 2, 2)
        peaks.append(np.degrees(worst))
    return peaks


@pytest.mark.slow
def test_on_the_flexible_arm_a_repetition_is_tracked_better_than_with_the_wrong_payload(arm_r):
    fast, manifold = {"type": "lqr"}, {"type": "corrected"}
    law = design(arm_r, {"type": "adaptive_model_following"}, fast, manifold)
    first, back = peak_errors(arm_r.with_payload(2.0), law, 2)
    assert first > 1.5
    assert back < 0.4 * first
    assert_allclose(law.slow.payload_scale, 2.0, atol=0.1)


def test_friction_is_no_payload(rigid):
    joints = tuple(replace(j, friction=Friction(0.4, 0.3, 0.05)) for j in rigid.arm.joints)
    rough = model.build(replace(rigid.arm, joints=joints))
    q, qd, ref = some_state(2)
    assert_array_equal(
        adaptive(rough).regressor(q, qd, qd, ref.acceleration),
        adaptive(rigid).regressor(q, qd, qd, ref.acceleration),
    )


def test_joint_pid_adds_stiffness_damping_and_integral_to_the_rigid_arms_torque(two_link):
    q, qd = np.array([0.3, 0.8]), np.array([0.1, -0.2])
    ref = reference([0.4, 0.7], [0.5, 0.1], [1.0, -2.0])
    bare = law_of("joint_pid", two_link)
    own = law_of("model_following", two_link, kp=[0.0], kv=[0.0])
    assert_allclose(
        torque_at(bare, q, qd, ref), torque_at(own, ref.position, ref.velocity, ref), rtol=1e-12
    )
    law = law_of(
        "joint_pid", two_link, stiffness=[3.0, 2.0], damping=[0.5, 0.25], integral=[4.0, 1.0]
    )
    error, rate = ref.position - q, ref.velocity - qd
    wanted = torque_at(bare, q, qd, ref) + [3.0, 2.0] * error + [0.5, 0.25] * rate
    assert_allclose(torque_at(law, q, qd, ref), wanted, rtol=1e-12)
    law.advance(0.1)
    assert_allclose(law.integral, 0.1 * np.array([4.0, 1.0]) * error, rtol=1e-12)
    assert_allclose(torque_at(law, q, qd, ref), wanted + law.integral, rtol=1e-12)


def test_joint_pids_integral_ends_at_its_limit_and_waits_while_the_torque_is_beyond_the_joints(
    two_link,
):
    law = law_of("joint_pid", two_link, integral=[10.0], integral_torque=[0.3])
    at = np.zeros(2), np.zeros(2), reference([0.5, -0.5])
    torque_at(law, *at)
    for _ in range(10):
        law.advance(0.1)
    assert_array_equal(law.integral, [0.3, -0.3])
    law.reset()
    torque_at(law, *at)
    law.saw(np.array([6.0, -1.0]))  # the limits are 5 and 2 N m
    law.advance(0.01)
    assert_allclose(law.integral, [0.0, -0.05], rtol=1e-12)
    law.saw(np.array([-6.0, -3.0]))  # the error leads back inside, and farther out
    law.advance(0.01)
    assert_allclose(law.integral, [0.05, -0.05], rtol=1e-12)


def rough(plant, viscous=0.1, coulomb=0.5):
    """The same arm with friction in each joint."""
    friction = Friction(viscous=viscous, coulomb=coulomb, smoothing=0.02)
    joints = tuple(replace(j, friction=friction) for j in plant.arm.joints)
    return model.build(replace(plant.arm, joints=joints))


def test_joint_pid_cancels_a_part_of_the_friction_that_its_motion_does_not_have(two_link):
    law = law_of("joint_pid", rough(two_link), friction=[0.8, 0.4], bandwidth=50.0)
    still, ref = np.zeros(2), reference([0.0, 0.0], [0.3, -0.01])
    law.feedback(still, still, at_rest(still))
    law.advance(1e-3)  # the low pass is not on its way
    qd = np.array([0.01, -0.01])
    wanted = [0.4, 0.2] * (np.tanh(qd / 0.02) - np.tanh(ref.velocity / 0.02))
    assert_allclose(law.feedback(still, qd, ref), wanted, rtol=1e-12)
    assert_array_equal(law.feedback(still, ref.velocity, ref), [0.0, 0.0])
    with law.without_friction():
        assert_array_equal(law.feedback(still, qd, ref), [0.0, 0.0])
    assert_allclose(law.feedback(still, qd, ref), wanted, rtol=1e-12)


def test_joint_pid_pushes_a_joint_that_sticks_beside_its_place_back(two_link):
    law = law_of("joint_pid", rough(two_link), friction=[0.8], return_rate=5.0)
    q, still, ref = np.array([0.002, -10.0]), np.zeros(2), reference([0.0, 0.0], [0.0, 0.0])
    wanted = 0.8 * 0.5 * np.array([np.tanh(-0.01 / 0.02), 1.0])  # never more than is cancelled
    assert_allclose(law.feedback(q, still, ref), wanted, rtol=1e-12)
    moving = reference([0.0, 0.0], [0.5, 0.5])
    assert_allclose(law.feedback(q, moving.velocity, moving), [0.0, 0.0], atol=1e-9)


def test_joint_pid_overcomes_the_rest_of_the_friction_by_the_error_alone(two_link):
    parts = {"friction": [0.8, 0.1], "breakaway": [0.95, 0.95], "breakaway_rate": 5.0}
    law = law_of("joint_pid", rough(two_link), **parts)
    plain = law_of("joint_pid", rough(two_link), friction=[0.8, 0.1])
    q, ref = np.array([0.002, -10.0]), reference([0.0, 0.0], [0.0, 0.0])
    wanted = 0.5 * np.array([0.15 * np.tanh(-0.01 / 0.02), 0.85])
    for speed in (0.0, 0.3):  # whatever the joint's own speed is
        qd = np.full(2, speed)
        more = law.feedback(q, qd, ref) - plain.feedback(q, qd, ref)
        assert_allclose(more, wanted, rtol=1e-12)
    there = reference([0.002, -10.0], [0.4, -0.4])
    assert_allclose(law.feedback(q, there.velocity, there), [0.0, 0.0], atol=1e-12)
    with law.without_friction(), plain.without_friction():
        assert_allclose(law.feedback(q, qd, ref), plain.feedback(q, qd, ref), rtol=0.0)


@pytest.mark.parametrize("friction", [0.8, 0.0])
def test_joint_pids_integral_shrinks_where_friction_torque_on_a_joint_that_stands_opposes_it(
    two_link, friction
):
    gains = {"stiffness": [5.0, 8.0], "integral": [2.0, 3.0]}
    parts = {"friction": [friction], "return_rate": 5.0, "breakaway": [0.95], "breakaway_rate": 7.0}
    law = law_of("joint_pid", rough(two_link), **gains, **parts)
    error, qd, dt = np.array([0.002, -0.003]), np.array([0.004, -0.009]), 1e-3
    pushed = 0.5 * friction * np.tanh((qd + 5.0 * error) / 0.02)
    pushed += 0.5 * (0.95 - friction) * np.tanh(7.0 * error / 0.02)
    pushed *= 1.0 - np.tanh(qd / 0.02) ** 2
    for signs in ([-1, 1], [1, -1], [-1, -1]):
        law.reset()
        start = law.absorb(np.array(signs) * [0.3, 0.4]).copy()
        law.feedback(-error, qd, reference([0.0, 0.0]))
        law.advance(dt)
        mean = (1.0 - np.exp(-7.0 * dt)) * pushed
        effective = error + np.where(start * mean < 0.0, mean / [5.0, 8.0], 0.0)
        assert_allclose(law.integral, start + dt * np.array([2.0, 3.0]) * effective, rtol=1e-12)
    sliding = np.array([0.4, -0.4])
    law.reset()
    law.absorb(np.array([-0.3, -0.4]))
    law.feedback(np.zeros(2), sliding, reference([0.0, 0.0], sliding))
    law.advance(dt)
    assert_allclose(law.integral, [-0.3, -0.4], rtol=1e-12)


def test_friction_torque_takes_joint_pids_integral_no_further_than_to_zero(two_link):
    gains, parts = (
        {"stiffness": [5.0], "integral": [2.0]},
        {"breakaway": [0.95], "breakaway_rate": 7.0},
    )
    law, still, error = law_of("joint_pid", rough(two_link), **gains, **parts), np.zeros(2), 0.002
    law.absorb(np.array([-1e-6, -0.4]))
    law.feedback(still - error, still, reference([0.0, 0.0]))
    law.advance(0.1)
    assert_allclose(law.integral[0], 0.1 * 2.0 * error, rtol=1e-12)
    assert -0.4 + 0.1 * 2.0 * error < law.integral[1] < 0.0


@pytest.mark.parametrize("true", [0.7, 1.0, 1.3])
def test_a_joint_that_sticks_beside_its_place_gets_there_sooner_as_the_integral_shrinks(
    rigid, monkeypatch, true
):
    gains = {"stiffness": [20.0], "damping": [8.0], "integral": [20.0]}
    parts = {"friction": [0.8], "return_rate": 10.0, "breakaway": [0.95], "breakaway_rate": 10.0}

    def after_a_motion():
        law = law_of("joint_pid", rough(rigid), **gains, **parts)
        law.absorb(np.array([-0.4, -0.4]))  # what the motion has left
        plant = rough(rigid, coulomb=0.5 * true)
        return np.abs(settled(law, plant, 2.0, np.array([0.3, 0.2]), 1e-3)).max()

    error = after_a_motion()
    monkeypatch.setattr(JointPid, "_shrink", lambda law, dt: None)
    assert error < 0.2 * after_a_motion()


@pytest.mark.parametrize("bandwidth", [0.0, 50.0])
def test_a_torque_that_the_integral_takes_over_does_not_go_through_the_low_pass(arm_r, bandwidth):
    gains = {"stiffness": [9.0], "damping": [1.0], "integral": [2.0], "bandwidth": bandwidth}
    law, still = law_of("joint_pid", arm_r, **gains), np.zeros(1)
    for _ in range(20):
        law.advance(1e-3)
        before = law.feedback(np.array([0.01]), still, at_rest(still)).copy()
    taken = law.absorb(np.array([0.4]))
    assert_allclose(taken, 0.4)
    law.advance(1e-3)
    after = law.feedback(np.array([0.01]), still, at_rest(still))
    assert_allclose(after, before + 0.4, atol=1e-3)


def test_a_low_pass_that_takes_over_from_none_begins_with_what_it_gets(arm_r):
    gains, still = {"stiffness": [9.0], "damping": [1.0], "integral": [2.0]}, np.zeros(1)
    old = law_of("joint_pid", arm_r, **gains)
    new = law_of("joint_pid", arm_r, **gains, bandwidth=50.0)
    old.advance(1e-3)
    before = old.feedback(np.array([0.01]), still, at_rest(still)).copy()
    new.resume(old)
    new.advance(1e-3)
    assert_allclose(new.feedback(np.array([0.01]), still, at_rest(still)), before)
