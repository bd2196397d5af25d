# SPDX-License-Identifier: Apache-2.0
"""Kalman filters: consistent with the noise they assume, exact without noise, and what they find out of an arm."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import block_diag, expm, solve_discrete_are
from scipy.stats import chi2

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import design_observer, observe
from flexarm_control.observers.motion import Motion
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models import model
from flexarm_dynamics.sampling import discretise
from flexarm_sim.integrators import integrate

MS = 10**6  # [ns]
H = 2e-3  # [s]
NOISE = {
    "strain_noise": 2e-6,
    "position_noise": 4e-4,
    "torque_noise": [0.05],
    "modal_force_noise": 0.02,
}


class Linear:
    """(2) of an arm at rest, written out here; and its motion under white forces."""

    def __init__(self, arm):
        n, m = arm.n_joints, arm.n_modes
        t, size = arm.terms(np.zeros(n), np.zeros(n)), n + m
        inverse = np.linalg.inv(t.M)
        K = np.hstack([np.zeros((size, n)), np.vstack([t.K1, t.K2])])
        C = np.hstack([np.zeros((size, n)), np.vstack([t.C1, t.C2])])
        self.A = np.zeros((2 * size, 2 * size))
        self.A[:size, size:] = np.eye(size)
        self.A[size:] = -inverse @ np.hstack([K, C])
        self.G = np.vstack([np.zeros((size, size)), inverse])
        self.B = self.G[:, :n]
        self.model = copy.copy(arm)
        self.model.derivative = lambda x, u: self.A @ x + self.B @ u

    def transition(self, h):
        """Phi and Gamma of a torque that is constant."""
        N, n = self.B.shape
        flow = expm(np.block([[self.A, self.B], [np.zeros((n, N + n))]]) * h)
        return flow[:N, :N], flow[:N, N:]

    def noise(self, h, density, points=200):
        """Covariance that the forces add over h, by the midpoint rule."""
        s = (np.arange(points) + 0.5) * h / points
        F = expm(self.A * s[:, None, None]) @ self.G
        return h * np.mean(F * density @ F.swapaxes(1, 2), axis=0)


@pytest.fixture(scope="module")
def linear(arm_r):
    return Linear(arm_r)


def density(n=1, m=2):
    values = NOISE["torque_noise"] * n + [NOISE["modal_force_noise"]] * m
    return np.square(values)


def sample(x, torque=0.0, k=0, n=1, m=2):
    """Sample k of a state, without noise."""
    s = ArmSample(n, m)
    s.stamp_ns, s.session, s.sequence = 10**9 + k * 2 * MS, 1, k
    s.position[:], s.amplitude[:] = x[:n], x[n : n + m]
    s.velocity[:] = x[n + m : 2 * n + m]
    s.torque[:] = torque
    return s


def numbered(k):
    """Sample k of some motion."""
    bending = 1e-3 * np.sin(0.3 * k)
    return sample(np.array([0.01 * k, bending, bending, 5.0]), 0.5, k)


# --------------------------------------------------------------------------- consistency

RUNS, SAMPLES = 200, 80


@pytest.fixture(scope="module")
def monte_carlo(linear):
    """Errors, innovations, and their normalised squares of runs with just the noise that is assumed."""
    rng = np.random.default_rng(7)
    observer = design_observer("kalman", linear.model, NOISE)
    strain_map = StrainMap(linear.model)
    Phi, Gamma = linear.transition(H)
    L = np.linalg.cholesky(linear.noise(H, density()))
    nees, nis = np.zeros((2, RUNS, SAMPLES))
    innovations = np.zeros((RUNS, SAMPLES, 2))
    for run in range(RUNS):
        x = np.concatenate([[0.2, 0.01, -0.002], rng.standard_normal(3)])
        observer.reset()
        u = np.zeros(1)
        for k in range(SAMPLES):
            s = sample(x, u)
            s.position += NOISE["position_noise"] * rng.standard_normal(1)
            strain = strain_map.rows @ x[1:3]
            strain += NOISE["strain_noise"] * rng.standard_normal(strain.size)
            s.amplitude[:] = strain_map.amplitudes(strain)
            s.velocity[:] = 0.0
            observer.update(s, H if k else 0.0)
            error = observer.state - x
            nees[run, k] = error @ np.linalg.solve(observer.covariance, error)
            nis[run, k] = observer.innovation_squared
            innovations[run, k] = observer.innovation
            u = rng.normal(0.0, 2.0, 1)
            x = Phi @ x + Gamma @ u + L @ rng.standard_normal(6)
    return nees, nis, innovations


def fraction_inside(values, freedom):
    """Fraction of the samples whose mean over the runs is inside its 95 % interval."""
    low, high = chi2.ppf([0.025, 0.975], RUNS * freedom) / RUNS
    mean = values.mean(axis=0)
    return np.mean((low < mean) & (mean < high))


def test_errors_are_as_large_as_the_covariance_says(monte_carlo):
    nees = monte_carlo[0]
    assert fraction_inside(nees, 6) > 0.85
    assert nees.mean() == pytest.approx(6.0, rel=0.05)


def test_innovations_are_as_large_as_their_covariance_says_and_white(monte_carlo):
    nis = monte_carlo[1][:, 1:]
    assert fraction_inside(nis, 3) > 0.9
    low, high = chi2.ppf([0.025, 0.975], 3 * nis.size) / nis.size
    assert low < nis.mean() < high
    v = monte_carlo[2][:, 30:]  # settled, so that they are of one size
    for lag in range(1, 11):
        product = (v[:, lag:] * v[:, :-lag]).mean(axis=(0, 1))
        correlation = product / (v**2).mean(axis=(0, 1))
        count = RUNS * (v.shape[1] - lag)
        assert np.all(np.abs(correlation) < 3.0 / np.sqrt(count)), lag


def test_noise_as_assumed_is_consistent_and_more_of_it_is_not(linear):
    rng = np.random.default_rng(3)
    for factor, wanted in ((1.0, True), (4.0, False)):
        observer = design_observer("kalman", linear.model, NOISE)
        seen = []
        for k in range(400):
            s = sample(np.zeros(6))
            s.position += factor * NOISE["position_noise"] * rng.standard_normal(1)
            observer.update(s, H if k else 0.0)
            seen.append(observer.consistent)
        assert all(seen) is wanted
        assert seen[-1] is wanted
    observer.reset()
    assert observer.consistent


def test_settled_covariance_solves_the_riccati_equation(linear):
    observer = design_observer("kalman", linear.model, NOISE)
    for k in range(3000):
        observer.update(sample(np.zeros(6)), H if k else 0.0)
    Phi, _ = linear.transition(H)
    Q, C = linear.noise(H, density(), 2000), np.eye(3, 6)
    W = StrainMap(linear.model).inverse
    R = block_diag(NOISE["position_noise"] ** 2, NOISE["strain_noise"] ** 2 * W @ W.T)
    assert_allclose(observer.measurement_covariance, R, rtol=1e-12)
    prior = solve_discrete_are(Phi.T, C.T, Q, R)
    K = prior @ C.T @ np.linalg.inv(C @ prior @ C.T + R)
    wanted = (np.eye(6) - K @ C) @ prior
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert_allclose(observer.covariance / scale, wanted / scale, atol=2e-6)
    variance = np.diag(wanted)
    assert_allclose(observer.covariance_diagonal, variance[[1, 2, 4, 5]], rtol=2e-6)


def test_a_gain_that_is_kept_is_the_recursions(linear):
    """With the short cut for a settled covariance, and without."""
    kept, full = (design_observer("kalman", linear.model, NOISE) for _ in range(2))
    full.STEADY = -1.0
    rng = np.random.default_rng(5)
    for k in range(2500):
        h = 3e-3 if k % 1000 == 900 else H
        s = sample(1e-3 * rng.standard_normal(6))
        for observer in (kept, full):
            observer.update(s, h if k else 0.0)
    assert_allclose(kept.state, full.state, rtol=1e-6, atol=1e-9)
    assert_allclose(kept.covariance_diagonal, full.covariance_diagonal, rtol=1e-6)


@pytest.mark.parametrize("event", ["nothing", "a longer step", "a lost gauge", "a new session"])
def test_a_filter_that_computes_ahead_gives_the_same_to_the_last_bit(linear, event):
    ahead, other = (design_observer("kalman", linear.model, NOISE) for _ in range(2))
    computed, rng = [], np.random.default_rng(5)
    corrected = ahead._corrected
    ahead._corrected = lambda step: computed.append(step) or corrected(step)
    for k in range(120):
        h = 3e-3 if event == "a longer step" and k == 80 else H
        s = sample(1e-3 * rng.standard_normal(6))
        for observer in (ahead, other):
            if event == "a lost gauge" and k == 80:
                observer.measurement_covariance = 2.0 * observer.measurement_covariance
            if event == "a new session" and k == 80:
                observer.reset()
            observer.update(s, 0.0 if k == 0 or (event == "a new session" and k == 80) else h)
            assert_array_equal(observer.state, ahead.state)
        assert_array_equal(ahead.covariance, other.covariance)
        before = len(computed)
        ahead.look_ahead()
        assert len(computed) == before + (ahead.converged and not ahead._steady)
    # Each sample's recursion was run once, but for those that came otherwise than foreseen.
    assert len(computed) <= 123


@pytest.mark.parametrize("period", [H, H + 3e-6])
@pytest.mark.parametrize("name", ["R", "two_link", "long_reach"])
def test_a_step_whose_torque_was_foreseen_otherwise_is_the_step_under_its_torque(
    arms, name, period
):
    arm, rng = arms[name], np.random.default_rng(3)
    n, size = arm.n_joints, arm.n_joints + arm.n_modes
    motion, x = Motion(arm), 1e-2 * rng.standard_normal(2 * size)
    expected, torque = rng.uniform(-50.0, 50.0, (2, n))
    foreseen = motion.foresee(x, expected, H)
    after = motion.go_on(foreseen, torque, period)
    wanted = motion.advance(x, torque, period, motion.step_for(H, x[:n]))
    assert_allclose(after, wanted, rtol=0.0, atol=1e-12 * np.abs(wanted - x).max())
    assert not np.allclose(after, motion.go_on(foreseen, expected, period), rtol=1e-3)


# --------------------------------------------------------------------------- noise levels


def test_an_encoders_variance_is_that_of_rounding(arm_r):
    joint = replace(arm_r.arm.joints[0], encoder_counts=4096)
    arm = model.build(replace(arm_r.arm, joints=(joint,)))
    R = design_observer("kalman", arm, {}).measurement_covariance
    assert R[0, 0] == pytest.approx((2.0 * np.pi / 4096) ** 2 / 12.0)
    angles = np.random.default_rng(0).uniform(-1.0, 1.0, 20000)
    step = 2.0 * np.pi / 4096
    assert np.var(step * np.round(angles / step) - angles) == pytest.approx(R[0, 0], rel=0.03)


def test_the_noise_of_every_gauge_counts_where_the_file_states_it(arm_r):
    gauges = [replace(g, noise=s) for g, s in zip(arm_r.arm.gauges, (1e-6, 5e-6), strict=True)]
    arm = model.build(replace(arm_r.arm, gauges=tuple(gauges)))
    R = design_observer("kalman", arm, {}).measurement_covariance[1:, 1:]
    strains = np.random.default_rng(0).standard_normal((40000, 2)) * (1e-6, 5e-6)
    found = np.cov((strains @ StrainMap(arm).inverse.T).T)
    assert_allclose(R, found, rtol=0.04)


def test_noise_over_a_long_step_is_that_of_its_parts(linear):
    motion = Motion(linear.model, density())
    one, five = motion.design(H, np.zeros(1)), motion.design(5 * H, np.zeros(1))
    Phi, Q = np.eye(6), np.zeros((6, 6))
    for _ in range(5):
        Phi, Q = one.Phi @ Phi, one.Phi @ Q @ one.Phi.T + one.Q
    assert_allclose(five.Phi, Phi, atol=1e-7 * np.abs(Phi).max())
    scale = np.sqrt(np.outer(np.diag(Q), np.diag(Q)))
    assert_allclose(five.Q / scale, Q / scale, atol=1e-7)
    assert_allclose(Q / scale, linear.noise(5 * H, density(), 1000) / scale, atol=1e-4)


def test_strongly_damped_motion_over_a_long_gap_stays_finite():
    A = np.array([[0.0, 1.0], [0.0, -300.0]])
    step = discretise(A, 2.0, np.diag([0.0, 1.0]))
    assert step.Q[1, 1] == pytest.approx(1.0 / 600.0)  # Ornstein-Uhlenbeck
    assert_allclose(step.Gamma[:, 1], [2.0 / 300.0 - 1.0 / 300.0**2, 1.0 / 300.0], rtol=1e-9)


# --------------------------------------------------------------------------- time


def test_without_noise_the_estimate_is_exact_whatever_the_steps_and_gaps(linear):
    rng = np.random.default_rng(11)
    observer = design_observer("kalman", linear.model, NOISE)
    x, u = np.array([0.3, 0.01, -0.001, 0.5, 0.0, 0.0]), 0.0
    observer.update(sample(x), 0.0)
    for k in range(60):
        h = 1e-9 * int(rng.integers(300_000, 2_500_000)) * (20 if k % 10 == 9 else 1)
        Phi, Gamma = linear.transition(h)
        u = rng.normal(0.0, 2.0, 1)
        x = Phi @ x + Gamma @ u
        observer.update(sample(x, u), h)
        assert_allclose(observer.state, x, atol=1e-6 * max(np.abs(x).max(), 1.0))


def test_a_redesigned_filter_goes_on_from_the_old_ones_state(arm_r):
    old, new = (design_observer("kalman", arm_r, {"torque_noise": [v]}) for v in (0.01, 0.02))
    for k in range(40):
        old.update(numbered(k), H if k else 0.0)
    new.resume(old)
    assert new.converged
    assert_array_equal(new.state, old.state)
    assert_array_equal(new.covariance, old.covariance)
    assert_array_equal(new.rate, old.rate)
    other = design_observer("filtered_derivative", arm_r, {})
    new.resume(other)
    assert not new.converged


def test_a_rigid_arm_has_a_filter_too(rigid):
    observer, n = design_observer("kalman", rigid, {}), rigid.n_joints
    s = ArmSample(n)
    s.amplitude, s.torque[:] = np.zeros(0), 0.0
    for k in range(300):
        observer.update(s, 1e-3 if k else 0.0)
    assert observer.converged
    assert observer.joint_velocity.shape == (n,)


# --------------------------------------------------------------------------- joints


def test_joint_velocity_and_position_are_the_filters_where_the_source_has_counts_alone(linear):
    x, u = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0]), np.zeros(1)
    cores = {
        smooth: observe(linear.model, "kalman", {**NOISE, "smooth_position": smooth})
        for smooth in (True, False)
    }
    plain = observe(linear.model, "filtered_derivative", {})
    Phi, _ = linear.transition(H)
    step, errors = 2.0 * np.pi / 4096, []
    for k in range(500):
        s = sample(x, u, k)
        s.velocity_known = False
        counts = step * np.round(x[0] / step)
        for core in (*cores.values(), plain):
            s.position[:] = counts
            core.step(s)
        if k > 100:
            smooth, raw = cores[True], cores[False]
            assert raw.position[0] == counts
            assert_array_equal(smooth.velocity, smooth.observer.joint_velocity)
            errors.append(
                [smooth.position[0] - x[0], counts - x[0],
                 smooth.velocity[0] - x[3], plain.velocity[0] - x[3]]
            )  # fmt: skip
        x = Phi @ x
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms[0] < 0.5 * rms[1]
    assert rms[2] < 0.05 * rms[3]


# --------------------------------------------------------------------------- delay


@pytest.mark.parametrize("name", ["true_rates", "kalman", "extended_kalman"])
def test_prediction_across_a_delay_is_exact_on_the_linear_model(linear, name):
    delay = 0.033
    values = {"delay": delay} | ({"estimate_payload": False} if name == "extended_kalman" else {})
    core, x = observe(linear.model, name, values), np.array([0.3, 0.01, -0.001, 0.5, 0.0, 0.0])
    u = np.array([1.5])
    Phi, Gamma = linear.transition(H)
    ahead, ahead_torque = linear.transition(delay)
    for k in range(80):
        s = sample(x, u, k)
        s.rate = x[4:].copy()
        if core.step(s):
            found = np.concatenate([core.position, core.amplitude, core.velocity, core.rate])
            wanted = ahead @ x + ahead_torque @ u
            assert_allclose(found, wanted, atol=1e-6)
            assert np.abs(wanted - x).max() > 0.02
        x = Phi @ x + Gamma @ u
    assert core.observer.converged


def test_prediction_of_a_two_link_arm_is_close_to_its_integration(two_link):
    n, m = two_link.n_joints, two_link.n_modes
    core = observe(two_link, "true_rates", {"delay": 0.02})
    rest = np.concatenate([[0.4, -0.7], np.zeros(m), [1.0, -2.0], np.zeros(m)])
    u = np.array([0.5, -0.2])
    states = integrate(two_link, rest, lambda t, s: u, np.array([0.0, 0.1, 0.12]))
    x, wanted = states[1], states[2]
    s = sample(x, u, 0, n, m)
    s.rate = x[2 * n + m :].copy()
    assert core.step(s)
    assert_allclose(core.position, wanted[:n], atol=2e-4)
    assert_allclose(core.amplitude, wanted[n : n + m], atol=0.02 * np.abs(wanted[n : n + m]).max())
    assert np.abs(x[:n] - wanted[:n]).min() > 5e-3


@pytest.mark.parametrize("name", ["luenberger", "kalman"])
def test_without_a_delay_the_observers_estimate_is_passed_on(arm_r, name):
    core = observe(arm_r, name, {})
    for k in range(30):
        core.step(numbered(k))
    assert_array_equal(core.amplitude, core.observer.amplitude)
    assert_array_equal(core.rate, core.observer.rate)
    position = core.observer.joint_position
    assert_array_equal(core.position, [0.29] if position is None else position)
    assert_array_equal(core.velocity, [5.0])  # a given one comes before the filter's


# --------------------------------------------------------------------------- extended


@pytest.fixture(scope="module")
def loaded():
    """An arm with a payload that matters, and a little friction."""
    arm = arm_file.load("one_link")
    # Shapes and damping that do not depend on the load.
    bends = replace(arm.links[0].flexible["y"], shape="clamped_free", damping=())
    link = replace(arm.links[0], flexible={"y": bends})
    joint = replace(arm.joints[0], friction=Friction(viscous=0.1, coulomb=0.05, smoothing=0.05))
    payload = replace(arm.payload, mass=0.1)
    return model.build(replace(arm, links=(link,), joints=(joint,), payload=payload))


def changed(arm, scale, viscous, coulomb):
    """The same arm with another payload and friction, built anew: its shapes do not depend on its load."""
    payload = arm.arm.payload
    inertia = tuple(tuple(scale * v for v in row) for row in payload.inertia)
    payload = replace(payload, mass=scale * payload.mass, inertia=inertia)
    friction = replace(arm.arm.joints[0].friction, viscous=viscous, coulomb=coulomb)
    joint = replace(arm.arm.joints[0], friction=friction)
    return model.build(replace(arm.arm, payload=payload, joints=(joint,)))


STATE = np.array([0.3, 0.02, -0.004, 0.8, 0.3, -0.5])


def test_the_extended_model_is_the_arm_with_these_parameters(loaded):
    values = {"estimate_coulomb": True}
    observer = design_observer("extended_kalman", loaded, values)
    for scale, viscous, coulomb in ((1.0, 0.1, 0.05), (2.0, 0.4, 0.2), (3.7, 0.0, 0.3)):
        arm = changed(loaded, scale, viscous, coulomb)
        found = observer.derivative(np.append(STATE, [scale, viscous, coulomb]), np.array([0.7]))
        assert_allclose(found[:6], arm.derivative(STATE, [0.7]), rtol=1e-8)
        assert_array_equal(found[6:], 0.0)


def moved(arm, seconds, rate, amplitude=3.0):
    """States and torques of an arm that is shaken by steps of torque."""
    rng = np.random.default_rng(4)
    x, h, states, torques = np.zeros(6), 1.0 / rate, [], []
    step = arm.stepper(None)
    u = np.zeros(1)
    for k in range(int(seconds * rate)):
        if k % 20 == 0:
            u = amplitude * rng.uniform(-1.0, 1.0, 1)
        step(x, u, h / 8, 8)
        states.append(x.copy())
        torques.append(u.copy())
    return np.array(states), np.array(torques)


#: Of an arm that moves as `moved` has it.
QUIET = NOISE | {"torque_noise": [0.01], "modal_force_noise": 0.001, "position_noise": 1e-4}


def identified(loaded, arm, values):
    """The observer, designed on `loaded`, after it has seen `arm` move with noise; and the arm's last state."""
    states, torques = moved(arm, 3.0, 200.0)
    observer = design_observer("extended_kalman", loaded, QUIET | values)
    rng = np.random.default_rng(8)
    W = StrainMap(loaded).inverse
    for k, (x, u) in enumerate(zip(states, torques, strict=True)):
        s = sample(x, u)
        s.position += 1e-4 * rng.standard_normal(1)
        s.amplitude += W @ (2e-6 * rng.standard_normal(2))
        observer.update(s, 5e-3 if k else 0.0)
    return observer, states[-1]


def test_payload_and_friction_are_found(loaded):
    observer, state = identified(loaded, changed(loaded, 2.0, 0.4, 0.05), {})
    found = observer.parameters_estimated
    assert found["payload scale [-]"] == pytest.approx(2.0, rel=0.03)
    assert found["viscous friction of joint1 [N m s/rad]"] == pytest.approx(0.4, abs=0.03)
    # and it knows how well
    assert abs(found["payload scale [-]"] - 2.0) < 4.0 * found["payload scale [-], deviation"]
    assert found["payload scale [-], deviation"] < 0.05
    assert_allclose(observer.rate, state[4:], atol=0.02)


def test_coulomb_friction_is_found_where_it_is_asked_for(loaded):
    wanted = {"estimate_payload": False, "estimate_viscous": False, "estimate_coulomb": True}
    observer, _ = identified(loaded, changed(loaded, 1.0, 0.1, 0.25), wanted)
    assert next(iter(observer.parameters_estimated)) == "coulomb friction of joint1 [N m]"
    found = observer.parameters_estimated["coulomb friction of joint1 [N m]"]
    assert found == pytest.approx(0.25, abs=0.02)


def test_an_arm_without_payload_has_no_scale_to_estimate(loaded):
    arm = model.build(replace(loaded.arm, payload=replace(loaded.arm.payload, mass=0.0)))
    with pytest.raises(DesignError, match="estimate_payload to false") as error:
        design_observer("extended_kalman", arm, {})
    assert (error.value.field, error.value.value) == ("payload.mass", 0.0)
    design_observer("extended_kalman", arm, {"estimate_payload": False})


def listening(arm, **options):
    """A Kalman filter behind its gauges, and a function that gives it the next sample of strains."""
    core = observe(arm, "kalman", options)

    def receive(strain):
        s = ArmSample(1, 2, 4)
        s.stamp_ns, s.session, s.sequence = (500 + receive.count) * 2 * MS, 1, receive.count
        s.torque[:], s.strain, s.amplitude = 0.0, np.array(strain), None
        receive.count += 1
        core.step(s)

    receive.count = 0
    return core, receive


def test_without_a_gauge_the_filter_knows_that_the_others_tell_less(lab):
    core, receive = listening(lab, stuck_samples=5)
    random = np.random.default_rng(0)
    noise = np.array([g.uncertainty for g in lab.arm.gauges])
    for _ in range(60):
        receive(noise * random.standard_normal(4))
    whole = core.observer.covariance_diagonal.copy()
    for _ in range(60):
        receive([np.nan, *(noise[1:] * random.standard_normal(3))])
    assert core.observer.gauges_lost == (0,)
    # R is what the amplitudes of the three gauges left scatter.
    strains = noise * random.standard_normal((20000, 4))
    left = np.linalg.lstsq(
        core.strain_map.rows[1:] / noise[1:, None], (strains[:, 1:] / noise[1:]).T, rcond=None
    )[0]
    assert_allclose(core.observer.measurement_covariance[1:, 1:], np.cov(left), rtol=0.05)
    assert (core.observer.covariance_diagonal > 1.05 * whole).all()
    # It comes back with the gauge.
    for _ in range(120):
        receive(noise * random.standard_normal(4))
    assert core.observer.gauges_lost == ()
    assert_allclose(core.observer.covariance_diagonal, whole, rtol=0.02)


def test_a_calibration_is_no_innovation(lab):
    core, receive = listening(lab, calibration_samples=20)
    bias = np.array([20e-6, -35e-6, 5e-6, 3e-6])
    for _ in range(60):
        receive(bias)
    wrong = np.abs(core.observer.amplitude).max()
    assert wrong > 1e-4
    core.calibrate()
    for _ in range(5):
        receive(bias)
        assert np.abs(core.observer.innovation).max() < 1e-3 * wrong
        assert np.abs(core.observer.amplitude).max() < 1e-3 * wrong
        assert np.abs(core.observer.rate).max() < 1e-5
