# SPDX-License-Identifier: Apache-2.0
"""Composite control (12), and laws found by name with checked parameters."""

import copy
import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_control.component import at_rest
from flexarm_control.composite.design import FAST, SLOW, design, design_law
from flexarm_control.composite.seen import SeenMotion, shown
from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import design_observer, observe
from flexarm_control.trajectory import ReferenceGenerator, validate
from flexarm_dynamics.arm.strain_map import StrainMap, gauge_rows
from flexarm_dynamics.errors import (
    NOT_GIVEN,
    DesignError,
    ParameterError,
    UnknownComponentError,
)
from flexarm_dynamics.models.model import build

MS = 10**6  # [ns]
SLOW_LAW = {"type": "linear_model_following"}
FAST_LAW = {"type": "lqr", "q": [20.0, 20.0, 1000.0, 6e5], "configuration": [np.pi / 2]}
REFERENCE = SimpleNamespace(
    position=np.array([0.6]), velocity=np.array([0.9]), acceleration=np.array([-0.5])
)
Q, QD = np.array([0.4]), np.array([1.3])
DELTA, DELTA_D = np.array([0.02, -0.003]), np.array([0.1, 0.05])
NONE = {"type": "none"}


def stepped(model, slow=SLOW_LAW, fast=FAST_LAW, delta=DELTA, delta_d=DELTA_D):
    law = design(model, slow, fast)
    law.step(Q, QD, delta, delta_d, REFERENCE)
    return law


# --------------------------------------------------------------------------- (12)


def test_12_the_torque_is_the_sum_of_slow_and_fast(arm_r):
    law = stepped(arm_r)
    assert_array_equal(law.torque, law.slow_torque + law.fast_torque)
    assert_array_equal(law.slow_torque, stepped(arm_r, fast=NONE).torque)
    z_f = np.concatenate([DELTA - law.quasi_steady, DELTA_D])
    assert_array_equal(law.deviation, z_f)
    assert_allclose(law.fast_torque, law.fast.K_f @ z_f, rtol=1e-14)
    assert abs(law.fast_torque[0]) > 0.1


def test_on_the_manifold_9_the_fast_control_is_exactly_zero(arm_r, heavy_arm):
    for model in (arm_r, heavy_arm):
        manifold = stepped(model).quasi_steady.copy()
        law = stepped(model, delta=manifold, delta_d=np.zeros(2))
        assert_array_equal(law.quasi_steady, manifold)  # it does not depend on the deflections
        assert_array_equal(law.deviation, np.zeros(4))
        assert_array_equal(law.fast_torque, [0.0])
        assert_array_equal(law.torque, law.slow_torque)


def test_slow_alone_ignores_the_deflections_and_fast_alone_damps_about_the_undriven_manifold(arm_r):
    bent, straight = (stepped(arm_r, fast=NONE, delta=d) for d in (DELTA, np.zeros(2)))
    assert_array_equal(bent.torque, straight.torque)
    assert_array_equal(bent.fast_torque, [0.0])
    fast = stepped(arm_r, slow=NONE)
    assert_array_equal(fast.slow_torque, [0.0])
    assert_array_equal(fast.quasi_steady, [0.0, 0.0])
    assert_allclose(fast.torque, fast.fast.K_f @ [*DELTA, *DELTA_D], rtol=1e-14)
    assert_array_equal(stepped(arm_r, NONE, NONE).torque, [0.0])


def test_the_quasi_steady_state_has_the_centrifugal_stiffness_of_the_present_speed(arm_r):
    law = stepped(arm_r)
    c = arm_r.coefficients
    # second row of (2) at rest on the manifold: h u / m11 + (K_e - qd^2 G) delta_bar = 0
    K2 = c.K - QD[0] ** 2 * c.G
    wanted = -np.linalg.solve(K2, c.h) * law.slow_torque[0] / c.rigid
    assert_allclose(law.quasi_steady, wanted, rtol=1e-11)
    assert not np.allclose(
        wanted, -np.linalg.solve(c.K, c.h) * law.slow_torque / c.rigid, rtol=1e-4
    )


def test_under_gravity_the_quasi_steady_state_is_the_arms_sag(heavy_arm):
    law = design(heavy_arm, {"type": "model_following"}, FAST_LAW)
    law.step(np.zeros(1), np.zeros(1), np.zeros(2), np.zeros(2), at_rest([0.0]))
    sag = law.quasi_steady
    state = np.concatenate([[0.0], sag, np.zeros(3)])
    assert_allclose(heavy_arm.derivative(state, law.slow_torque), 0.0, atol=1e-9)
    assert heavy_arm.tip_deflection(sag)[0] < -1e-3


# --------------------------------------------------------------------------- by name


def test_an_unknown_law_is_refused_with_what_there_is_and_a_guess(arm_r):
    with pytest.raises(UnknownComponentError, match=r"lqr, none.*did you mean 'lqr'"):
        design_law(FAST, "lqrr", arm_r, {})
    with pytest.raises(
        UnknownComponentError, match="linear_model_following, model_following, none"
    ):
        design_law(SLOW, "pid", arm_r, {})
    with pytest.raises(UnknownComponentError, match="filtered_derivative, kalman, luenberger"):
        design_observer("kalmann", arm_r, {})


@pytest.mark.parametrize(
    ("slow", "fast", "field", "value"),
    [
        ({"kq": [1.0]}, {}, "slow.kq", NOT_GIVEN),
        ({"kp": [1.0, 2.0]}, {}, "slow.kp", NOT_GIVEN),
        ({"kp": [-1.0]}, {}, "slow.kp[0]", -1.0),
        ({"gain": "h22"}, {}, "slow.gain", "h22"),
        ({}, {"alpha": 5}, "fast.alpha", 5),
        ({}, {"q": [1.0, 2.0]}, "fast.q", NOT_GIVEN),
        ({}, {"beta": 1.0}, "fast.beta", NOT_GIVEN),
        ({"type": 5}, {}, "slow.type", 5),
        ({"type": None}, {}, "slow.type", NOT_GIVEN),
    ],
)
def test_an_unusable_parameter_is_refused_naming_it_and_the_value(arm_r, slow, fast, field, value):
    with pytest.raises(ParameterError) as refused:
        design(arm_r, SLOW_LAW | slow, FAST_LAW | fast)
    assert (refused.value.field, refused.value.value) == (field, value)


@pytest.mark.parametrize(
    ("name", "values"), [("luenberger", {"pole": 0.0}), ("filtered_derivative", {"pole": 9.0})]
)
def test_an_unusable_observer_parameter_is_refused(arm_r, name, values):
    with pytest.raises(ParameterError) as refused:
        design_observer(name, arm_r, values)
    assert refused.value.field == "observer.pole"


def test_one_value_stands_for_all_and_defaults_fill_in(arm_r):
    law = design_law(FAST, "lqr", arm_r, {"q": [2.0]})
    assert law.parameters["q"] == [2.0] * 4
    assert law.parameters["alpha"] == 5.0


# --------------------------------------------------------------------------- refused while it runs


class Turning:
    """A reference that turns on at a steady speed."""

    def __init__(self, t):
        self.t = t
        self.position, self.velocity, self.acceleration = self.near(0.0)

    def near(self, offset):
        return np.array([[0.9 * (self.t + offset)], [0.9], [0.0]])


RUNNING = {
    "slow": {"type": "adaptive_model_following"},
    "fast": {"type": "output_feedback"},
    "manifold": {"type": "corrected", "order": 2},
    "settings": {"feedforward": "model", "rate": 1000.0},
}
#: What is set in the running design; the refusal, and its field or a word of it.
REFUSED = [
    ("slow", {"type": "slidingmode"}, UnknownComponentError, "did you mean 'sliding_mode'"),
    ("slow", {"type": "sliding_mode", "lambda": [-1.0]}, ParameterError, "slow.lambda[0]"),
    ("slow", {"adaptation_gain": -1.0}, ParameterError, "slow.adaptation_gain"),
    ("slow", {"type": "model_following", "kp": [1e4], "kv": [1.0]}, DesignError, "1/s"),
    ("fast", {"type": "scheduledlqr"}, UnknownComponentError, "did you mean 'scheduled_lqr'"),
    ("fast", {"type": "scheduled_lqr", "grid": 1}, ParameterError, "fast.grid"),
    ("fast", {"type": "scheduled_lqr", "grid": 5.0}, ParameterError, "fast.grid"),
    ("fast", {"type": "scheduled_lqr", "low": [1.0], "high": [-1.0]}, DesignError, "fast.low"),
    ("fast", {"type": "pole_placement", "damping": [1.0]}, ParameterError, "fast.damping[0]"),
    ("fast", {"observer_pole": 0.0}, ParameterError, "fast.observer_pole"),
    ("fast", {"type": "lqr", "alpha": 900.0}, DesignError, "1/s"),
    ("manifold", {"order": 7}, ParameterError, "manifold.order"),
    ("manifold", {"type": "corected"}, UnknownComponentError, "did you mean 'corrected'"),
    ("settings", {"feedforward": "previw"}, UnknownComponentError, "did you mean 'preview'"),
    ("settings", {"rate": 0.0}, ParameterError, "rate"),
    ("settings", {"stability_margin": 50.0}, DesignError, "50"),
]  # fmt: skip


def torques(model, between):
    """Torques of the running design, `between` called between its samples."""
    law, out = design(model, **RUNNING), []
    for k in range(12):
        reference = Turning(1e-3 * k)
        q = reference.position - 1e-3 * k
        out.append(law.step(q, 0.8 * reference.velocity, DELTA, None, reference, 1e-3 * (k > 0)))
        out[-1] = out[-1].copy()
        between(k)
    return np.array(out)


def test_what_is_refused_leaves_the_running_loop_as_it_was_to_the_last_bit(arm_r):
    def refuse(k):
        for part, change, error, words in REFUSED if k == 5 else ():
            given = {name: dict(values) for name, values in RUNNING.items()}
            given[part] = change if "type" in change else given[part] | change
            with pytest.raises(error) as caught:
                design(arm_r, **given)
            if error is ParameterError:
                assert caught.value.field == words
            assert words in str(caught.value)

    undisturbed = torques(arm_r, lambda k: None)
    assert_array_equal(torques(arm_r, refuse), undisturbed)
    assert np.ptp(undisturbed) > 1e-6


@pytest.mark.parametrize("far", [1e5, 1e9])
def test_a_motion_beyond_all_bounds_has_no_preview_and_says_why(arm_r, far):
    control = design(
        arm_r,
        {"type": "linear_model_following", "kp": [6.25], "kv": [5.0]},
        {"type": "none"},
        settings={"feedforward": "preview", "rate": 1000.0, "stability_margin": 0.0},
    )
    names = arm_r.joint_names
    motion = validate(names, names, 0, [(10**9, [far], [0.0], [0.0], [])])
    prepared = control.feedforward.prepare(motion, np.zeros((3, 1)))
    assert prepared.plan is None
    assert prepared.note.startswith("preview: the arm does not stand this motion")


# --------------------------------------------------------------------------- the motion as the observer sees it


class Swinging:
    """A motion of one joint and two modes, by the time."""

    placed = False

    def __init__(self):
        self.position, self.velocity, self.acceleration = np.zeros((3, 1))
        self.amplitude, self.rate = np.zeros((2, 2))

    def at(self, t):
        whole, rates = np.sin([3.0 * t, 20.0 * t, 31.0 * t]), [3.0, 20.0, 31.0]
        self.position[:], self.amplitude[:] = whole[:1], whole[1:]
        both = rates * np.cos([3.0 * t, 20.0 * t, 31.0 * t])
        self.velocity[:], self.rate[:] = both[:1], both[1:]


def test_the_motion_is_seen_as_the_observer_sees_an_arm_that_follows_it(arm_r):
    """By the observer's own filters, with samples that get lost; fast beside the samples as the motion may be."""
    corners = {"joint_velocity_bandwidth": 150.0, "bandwidth": 220.0}
    motion, period = Swinging(), 40 * MS
    seen = SeenMotion(motion, *corners.values())
    core = observe(arm_r, "filtered_derivative", corners | {"measured_velocity": False})
    arm, last = ArmSample(1, 2, 2), None
    for k in range(400):
        if k in (100, 101, 250):
            continue
        motion.at(1e-9 * k * period)
        arm.stamp_ns, arm.session, arm.sequence = 1 + k * period, 1, k
        arm.position[:], arm.amplitude, arm.strain = motion.position, motion.amplitude.copy(), None
        arm.velocity[:], arm.torque[:] = motion.velocity, 0.0
        core.step(arm)
        seen.update(0.0 if last is None else 1e-9 * (arm.stamp_ns - last))
        last = arm.stamp_ns
        if k > 10:  # the observer begins with an arm that rests
            assert_allclose(core.velocity, seen.velocity, atol=1e-9)
            assert_allclose(core.rate, seen.rate, atol=1e-9)
    assert np.abs(motion.rate - seen.rate).max() > 1.0  # its lag is no small thing


def swung(*corners, step, count):
    """A motion after some samples, and as it is seen."""
    motion = Swinging()
    seen = SeenMotion(motion, *corners)
    for k in range(count):
        motion.at(step * k)
        seen.update(step * (k > 0))
    return motion, seen


def test_a_motion_that_is_put_elsewhere_makes_no_speed():
    motion, seen = swung(150.0, 220.0, step=1e-3, count=20)
    before = seen.velocity.copy()
    motion.position += 1.0
    motion.placed = True
    seen.update(1e-3)
    assert np.abs(seen.velocity - before).max() < 0.01
    motion.placed = False
    motion.position += 1e-3 * motion.velocity
    seen.update(1e-3)
    assert np.abs(seen.velocity - before).max() < 0.01


def seen_late(late, corners=(0.0, 0.0), count=100, step=1e-2, gone=()):
    """Rows (time, position, amplitude, velocity, rate) of a motion that is seen so late; samples `gone` are lost."""
    motion, rows, last = Swinging(), [], None
    seen = SeenMotion(motion, *corners, 0.1)
    seen.be_late(late)
    for k in range(count):
        if k in gone:
            continue
        motion.at(step * k)
        seen.update(0.0 if last is None else step * (k - last))
        last = k
        parts = seen.position, seen.amplitude, seen.velocity, seen.rate
        rows.append(np.concatenate([[step * k], *parts]))
    return np.array(rows)


def test_the_motion_is_seen_as_late_as_the_torque_acts():
    for corners in (0.0, 0.0), (150.0, 220.0):
        there, late = (seen_late(d, corners) for d in (0.0, 0.03))
        assert_allclose(late[-1, 1:], there[-4, 1:], atol=1e-8)
    there, between, motion = seen_late(0.0), seen_late(0.034), Swinging()
    motion.at(0.99 - 0.034)  # between samples by a cubic
    assert_allclose(between[-1, 1:4], [*motion.position, *motion.amplitude], atol=1e-4)
    assert_allclose(between[-1, 4:], [*motion.velocity, *motion.rate], atol=0.02)
    gaps = seen_late(0.03, gone=(93, 94, 97))
    assert_allclose(gaps[-1, 1:4], there[-4, 1:4], atol=1e-8)


def test_a_motion_is_seen_no_later_than_it_is_remembered_and_as_before_where_nothing_is_known():
    seen = SeenMotion(Swinging(), 0.0, 0.0, 0.02)
    for delay, late in ((np.nan, 0.0), (0.01, 0.01), (np.nan, 0.01), (0.5, 0.02), (0.0, 0.0)):
        seen.be_late(delay)
        assert seen.late == late


@pytest.mark.parametrize("corners", [(0.0, 0.0), (150.0, 220.0)])
def test_a_motion_that_begins_or_is_put_elsewhere_has_had_the_same_speed_before(corners):
    motion = Swinging()
    seen = SeenMotion(motion, *corners, 0.1)
    seen.be_late(0.02)
    for k in range(60):
        motion.at(1e-2 * k)
        motion.position += 1.0 * (k >= 40)
        motion.placed = k == 40
        seen.update(0.0 if k == 0 else 1e-2)
        if k == 50:
            seen.update(0.0)  # a new session
        assert abs(seen.position - 1.0 * (k >= 40) - np.sin(3e-2 * (k - 2))) < 2e-3
        assert abs(seen.velocity - 3.0 * np.cos(3e-2 * (k - 2))) < 0.2


def test_a_motion_of_nan_is_forgotten_once_it_begins_again():
    motion = Swinging()
    seen = SeenMotion(motion, 0.0, 0.0, 0.1)
    seen.be_late(0.02)
    motion.position[:] = np.nan
    seen.update(1e-2)
    motion.at(0.3)
    seen.update(0.0)
    assert np.isfinite(seen.position).all() and np.isfinite(seen.rate).all()


@pytest.mark.parametrize("way", [copy.deepcopy, lambda seen: pickle.loads(pickle.dumps(seen))])
def test_a_copy_of_what_is_seen_goes_on_by_itself(way):
    one = SeenMotion(Swinging(), 150.0, 220.0, 0.1)
    one.be_late(0.02)
    for k in range(10):
        one._motion.at(1e-2 * k)
        one.update(1e-2 * (k > 0))
    other = way(one)
    for part in one, other:
        part._motion.at(0.1)
        part.update(1e-2)
    assert_array_equal(one.position, other.position)
    assert_array_equal(one.velocity, other.velocity)


def test_what_is_remembered_of_a_motion_goes_over_to_another_control():
    one, other = (SeenMotion(Swinging(), 150.0, 220.0, 0.1) for _ in range(2))
    one.be_late(0.02)
    for k in range(60):
        one._motion.at(1e-2 * k)
        one.update(1e-2 * (k > 0))
    other.take(one)
    for part in one, other:
        part._motion.at(0.6)
        part.update(1e-2)
    for name in ("position", "amplitude", "velocity", "rate", "late"):
        assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.late == 0.02


def test_without_corners_the_motion_is_seen_as_it_is():
    motion, seen = swung(0.0, 100.0, step=1e-2, count=5)
    assert_array_equal(seen.velocity, motion.velocity)
    assert (seen.rate != motion.rate).all()
    assert seen.position is motion.position
    assert_array_equal(seen.amplitude, motion.amplitude)


def test_of_more_modes_the_control_gets_what_the_gauges_show(two_link):
    fuller, m = two_link.fuller(3, finite_slope=True), two_link.n_modes
    assert two_link.fuller(3, finite_slope=True) is fuller and two_link.fuller(2) is two_link
    assert fuller.with_payload(0.5).fuller(3) is not fuller
    T = shown(two_link, fuller)
    amplitude = np.random.default_rng(0).normal(size=fuller.n_modes)
    gauges = two_link.arm.gauges
    strain = [g.gain for g in gauges] * (gauge_rows(fuller, gauges) @ amplitude)
    assert_allclose(T @ amplitude, StrainMap(two_link).inverse @ strain, rtol=1e-12)
    own = [fuller.mode_names.index(name) for name in two_link.mode_names]
    assert_allclose(T[:, own], np.eye(m), atol=1e-12)
    assert np.abs(T).sum() > m + 0.1  # the others show, too
    bare = build(replace(two_link.arm, gauges=()))
    assert_array_equal(shown(bare, bare.fuller(3))[:, own], np.eye(m))
    assert shown(bare, bare.fuller(3)).sum() == m


def test_a_motion_with_more_modes_is_shown_as_the_gauges_show_it(two_link):
    laws = {"type": "joint_pid", "stiffness": [0.01], "damping": [0.01]}, {"type": "none"}
    settings = {"feedforward": "model", "stability_margin": -1000.0, "feedforward_modes": 3}
    control = design(two_link, *laws, {"type": "reference"}, settings)
    motion, seen = control.feedforward, control._seen
    assert motion.model.n_modes == 6 and seen.amplitude.shape == (4,)
    motion.amplitude[:], motion.rate[:] = np.random.default_rng(1).normal(size=(2, 6))
    seen.update(0.0)
    T = shown(two_link, motion.model)
    assert_allclose(seen.amplitude, T @ motion.amplitude, rtol=1e-12)
    assert_allclose(seen.rate, T @ motion.rate, rtol=1e-12)


# --------------------------------------------------------------------------- the torque limit


def saturated(two_link, saturation, limit=np.inf):
    """A control with stiff joints that hold the arm's weight, off by 0.1 and -0.02 rad, and its torque."""
    model = build(replace(two_link.arm, gravity=(0.0, -0.1, 0.0)))
    laws = {"type": "joint_pid", "stiffness": [5.0, 4.0], "damping": [0.1], "integral": [1.0]}
    settings = {"feedforward": "model", "stability_margin": -1000.0, "saturation": saturation}
    control = design(model, laws, {"type": "none"}, {"type": "reference"}, settings)
    control.limit = np.full(2, limit)
    reference, m = ReferenceGenerator(model.joint_names), model.n_modes
    reference.start(np.array([0.3, 0.2]), 0)
    reference.sample(MS)
    q, still = reference.position - [0.1, -0.02], np.zeros(2)
    torque = control.step(q, still, np.zeros(m), np.zeros(m), reference).copy()
    motion = control.feedforward.torque.copy()
    control.step(q, still, np.zeros(m), np.zeros(m), reference, 1e-3)
    return control, torque, motion


def test_one_joint_at_its_limit_scales_what_is_fed_back_to_all(two_link):
    _, free, motion = saturated(two_link, "together")
    limit = 0.6 * np.abs(free).max()
    assert 0.05 * limit < np.abs(motion).max() < 0.8 * limit
    control, torque, _ = saturated(two_link, "together", limit)
    assert np.abs(torque).max() == pytest.approx(limit, rel=1e-12)
    fed_back = (torque - motion) / (free - motion)
    assert_allclose(fed_back, fed_back[0], rtol=1e-12)
    assert 0.3 < fed_back[0] < 0.9
    assert_allclose(control.slow_torque + control.fast_torque, control.torque, rtol=1e-12)
    assert not control.slow.integral.any()  # all of them wait
    each, torque, _ = saturated(two_link, "each", limit)
    assert_array_equal(torque, free)  # clipped later, by itself
    assert (each.slow.integral != 0.0).any()
    unlimited, torque, _ = saturated(two_link, "together", 1.01 * np.abs(free).max())
    assert_array_equal(torque, free)
    assert (unlimited.slow.integral != 0.0).all()


# --------------------------------------------------------------------------- exchanges without a step


class Reference(SimpleNamespace):
    """A reference of constant acceleration."""

    def near(self, offset):
        v, a = self.velocity, self.acceleration
        return np.array(
            [self.position + offset * v + 0.5 * offset**2 * a, v + offset * a, a + 0.0 * v]
        )


MOVING = Reference(**vars(REFERENCE))


PAPERS = {"type": "quasi_steady"}


def controls(model, limit=100.0):
    """A control that has had a sample, and one with another manifold that is to take its place."""
    old, new = (design(model, SLOW_LAW, FAST_LAW, m) for m in ({"type": "corrected"}, PAPERS))
    old.step(Q, QD, DELTA, DELTA_D, MOVING)
    new.limit = old.limit = np.array([limit])
    return old, new


@pytest.mark.parametrize("limit", [100.0, 13.0])
def test_a_control_that_takes_anothers_place_begins_with_its_torque_and_soon_gives_its_own(
    arm_r, limit
):
    old, new = controls(arm_r, limit)
    alone = design(arm_r, SLOW_LAW, FAST_LAW, PAPERS)
    new.resume(old)
    sample, given = (Q, QD, DELTA, DELTA_D, MOVING, 1e-3), []
    for _ in range(200):
        given.append(float(new.step(*sample)[0] - alone.step(*sample)[0]))
        assert_array_equal(new.torque, new.slow_torque + new.fast_torque)
    wanted = np.clip(old.step(*sample), -limit, limit) - alone.torque
    assert abs(given[0]) > 0.1 and given[0] == pytest.approx(float(wanted[0]), rel=1e-9)
    assert np.abs(np.diff(given)).max() < 0.05 * abs(given[0])  # lambda is 155 1/s
    assert abs(given[100]) < 1e-3 * abs(given[0])  # a fifth of the lowest mode's period


def test_controls_that_are_exchanged_between_two_samples_go_on_from_the_last_that_had_one(arm_r):
    old, new = controls(arm_r)
    between = design(arm_r, SLOW_LAW, NONE)
    between.resume(old)
    new.resume(between)
    assert new._before is old
    wanted = old.step(Q, QD, DELTA, DELTA_D, MOVING, 1e-3).copy()
    assert_allclose(new.step(Q, QD, DELTA, DELTA_D, MOVING, 1e-3), wanted, rtol=1e-12)
    assert abs(new._exchanged.left) > 0.1
    assert new._before is None  # nothing keeps the old ones


def test_a_new_session_begins_without_what_was_to_fade(arm_r):
    old, new = controls(arm_r)
    alone = design(arm_r, SLOW_LAW, FAST_LAW, PAPERS)
    for exchange_first in (True, False):
        new.resume(old)
        if exchange_first:
            new.step(Q, QD, DELTA, DELTA_D, MOVING, 1e-3)
        new.reset()
        assert new._before is None
        wanted = alone.step(Q, QD, DELTA, DELTA_D, MOVING)
        assert_array_equal(new.step(Q, QD, DELTA, DELTA_D, MOVING), wanted)
        assert_array_equal(new.step(Q, QD, DELTA, DELTA_D, MOVING, 1e-3), wanted)


def test_without_a_feedforward_a_motion_begins_ends_and_stops_without_a_step(arm_r):
    """The corrected manifold jumps with the jerk at the ends of a quintic: 1.4 N m of torque."""
    names, steps = arm_r.joint_names, {}
    for stop in (None, 0.7):
        law = design(arm_r, SLOW_LAW, {"type": "lqr"}, {"type": "corrected"})
        reference, torque = ReferenceGenerator(names, period=0.5), []
        reference.start(np.zeros(1), 0)
        for k in range(1, 2600):
            if k == 100:
                point = (2_000_000_000, [1.0], [0.0], [0.0], [])
                assert reference.offer(validate(names, names, 0, [point])).accepted
            if stop is not None and k == 100 + round(1000 * stop):
                reference.stop(k * 1_000_000, 10.0, given=False)
            reference.sample(k * 1_000_000)
            q, qd = reference.position.copy(), reference.velocity.copy()
            torque.append(law.step(q, qd, np.zeros(2), np.zeros(2), reference, 1e-3).copy())
        steps[stop] = np.abs(np.diff(torque, axis=0)).max()
        assert np.abs(torque[-1]).max() < 1e-6
    assert max(steps.values()) < 0.08
