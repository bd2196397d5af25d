# SPDX-License-Identifier: Apache-2.0
"""The sampled loop with its observer, and the verdict on it in words."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.composite import full_order
from flexarm_control.composite.design import design
from flexarm_control.observers.arm_observer import observe
from flexarm_control.robust.loop import Sampling, sampled_loop
from flexarm_control.robust.verdict import FRAGILE, UNSTABLE, WITH_MARGIN, Judge
from flexarm_control.robust.whole import Source, WholeLoop, linear_controller
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models.model import build

T = 1e-3
TRUE = {"velocity": True, "rate": True}
NO_CHECK = {"stability_margin": -1e6, "feedforward": "none"}


def controller(model, slow, fast, observer, q, period=T, **source):
    name = observer.get("type", "filtered_derivative")
    settings = {k: v for k, v in observer.items() if k != "type"}
    law = design(model, slow, fast, {"type": "corrected"}, NO_CHECK | {"rate": 1.0 / period})
    return linear_controller(law, observe(model, name, settings), q, period, Source(**source)), law


@pytest.mark.parametrize("fast", [{"type": "lqr"}, {"type": "output_feedback"}])
@pytest.mark.parametrize("delay", [0.0, 0.0007, 0.002])
def test_with_true_rates_it_is_the_full_order_loop(arm_r, fast, delay):
    q = np.array([0.4])
    made, law = controller(
        arm_r, {"type": "model_following"}, fast, {"type": "true_rates"}, q, **TRUE
    )
    expected = full_order.poles(law, q, T, delay)
    found = WholeLoop(made, delay).poles()
    for pole in expected[expected.real > -300.0]:
        assert np.abs(found - pole).min() < 1e-3 * max(abs(pole), 1.0)


def rubbing(arm):
    """The arm with Coulomb friction in its joints."""
    friction = [replace(j.friction, coulomb=0.2) for j in arm.joints]
    joints = zip(arm.joints, friction, strict=True)
    return replace(arm, joints=tuple(replace(j, friction=f) for j, f in joints))


@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize("bandwidth", [0.0, 60.0])
def test_with_filters_and_integral_it_is_the_loop_of_a_design(two_link, velocity, bandwidth):
    n, m, q = 2, 4, np.array([0.3, 0.5])
    K = np.zeros((n, 3 * n + 2 * m))
    gains = {"stiffness": [20.0, 5.0], "damping": [6.0, 1.5], "integral": [8.0, 2.0]}
    for k, values in enumerate(gains.values()):
        K[:, k * n : (k + 1) * n] = np.diag(values)
    F = np.arange(16).reshape(n, 2 * m) * 1e-2
    K[:, 3 * n :] = -F
    observer = {"bandwidth": 300.0, "joint_velocity_bandwidth": 200.0}
    law = design(
        two_link, {"type": "joint_pid", **gains, "bandwidth": bandwidth},
        {"type": "fixed_gain", "gain": F.ravel().tolist(), "bandwidth": bandwidth},
        {"type": "reference"}, NO_CHECK,
    )  # fmt: skip
    made = linear_controller(
        law, observe(two_link, "filtered_derivative", observer), q, T, Source(velocity)
    )
    corners = np.inf if velocity else 200.0, 300.0, bandwidth or np.inf
    loop = sampled_loop(two_link, two_link, q, Sampling(T, 0.0015, *corners))
    z = np.linalg.eigvals(loop.F - loop.G @ (K @ loop.N))
    found = np.linalg.eigvals(WholeLoop(made, 0.0015).matrix())
    for pole in z[np.abs(z) > 0.5]:
        assert np.abs(found - pole).min() < 1e-5


def test_friction_and_what_cancels_it_are_left_out(two_link):
    """A joint that slides has a friction that does not change; one that rests would be negatively damped."""

    def made(friction):
        law = design(
            build(rubbing(two_link.arm)),
            {"type": "joint_pid", "stiffness": [20.0, 5.0], "friction": friction},
            {"type": "none"}, {"type": "reference"}, NO_CHECK,
        )  # fmt: skip
        observer = observe(two_link, "filtered_derivative", {"bandwidth": 300.0})
        return linear_controller(law, observer, np.array([0.3, 0.5]), T)

    assert_allclose(made(0.8).D, made(0.0).D, atol=1e-9)


def test_an_observer_that_jumps_at_a_tenth_of_a_radian_is_asked_beside_it(arm_r):
    law = design(arm_r, {"type": "model_following"}, {"type": "lqr"}, None, NO_CHECK)
    q = np.array([0.25])

    def made(jump):
        observer = observe(arm_r, "filtered_derivative", {})
        plain = observer.observer.update

        def update(sample, dt):
            plain(sample, dt)
            observer.observer.rate += jump * np.round(10.0 * sample.position[0])

        observer.observer.update = update
        return linear_controller(law, observer, q, T)

    smooth, jumps = made(0.0), made(1e-4)
    assert smooth.q == q and 0.0 < abs(jumps.q[0] - q[0]) < 0.01
    assert_allclose(WholeLoop(jumps).poles()[:4], WholeLoop(smooth).poles()[:4], rtol=0.01)


@pytest.mark.parametrize("torque", [50.0, np.inf])
def test_a_limit_that_the_arm_file_leaves_open_is_no_state_and_hides_no_jump(arm_r, torque):
    limits = replace(arm_r.arm.joints[0].limits, torque=torque)
    joint = replace(arm_r.arm.joints[0], limits=limits)
    model = build(replace(arm_r.arm, joints=(joint,)))
    slow = {"type": "joint_pid", "stiffness": [20.0], "damping": [6.0], "integral": [8.0]}
    law = design(model, slow, {"type": "lqr"}, {"type": "reference"}, NO_CHECK)
    observer = observe(model, "filtered_derivative", {})
    plain = observer.observer.update

    def jumping(sample, dt):
        plain(sample, dt)
        observer.observer.rate += 1e-4 * np.round(10.0 * sample.position[0])

    with np.errstate(all="raise"):
        made = linear_controller(law, observer, np.array([0.25]), T)
        assert np.isfinite(WholeLoop(made).poles()).all() and made.q == 0.25
        observer.observer.update = jumping
        assert 0.0 < abs(linear_controller(law, observer, np.array([0.25]), T).q[0] - 0.25) < 0.01


def test_a_good_loop_is_stable_with_margin_and_bears_more_than_was_tried(arm_r):
    made, _ = controller(
        arm_r, {"type": "model_following"}, {"type": "lqr"}, {"type": "kalman"}, np.zeros(1)
    )
    verdict = Judge([made]).verdict()
    assert verdict.word == verdict.text == WITH_MARGIN
    assert all(ok for _, ok in verdict.tried) and len(verdict.tried) == 9
    assert verdict.bears.payload[0] < 0.7 and verdict.bears.delay > 2 * T
    late = WholeLoop(made).stable
    assert late(delay=0.98 * verdict.bears.delay) and not late(delay=1.05 * verdict.bears.delay)


def test_a_fragile_loop_names_to_what(arm_r):
    made, _ = controller(
        arm_r, {"type": "model_following"}, {"type": "lqr"}, {"type": "kalman"}, np.zeros(1)
    )
    longest = Judge([made]).bears().delay
    verdict = Judge([made], longest - 0.5 * T).verdict()
    assert verdict.word == FRAGILE
    assert "to a delay 1 ms longer" in verdict.text and "to a phase lag" in verdict.text
    assert "a stiffness x 0.9" not in verdict.text
    assert verdict.bears.delay == pytest.approx(longest, rel=0.01)


def test_an_unstable_loop_gets_the_word_and_what_moves(arm_r):
    fast = {"type": "fixed_gain", "gain": [0.0, 0.0, 0.0, -60.0]}
    made, _ = controller(
        arm_r, {"type": "model_following"}, fast, {"type": "true_rates"}, np.zeros(1), **TRUE
    )
    verdict = Judge([made]).verdict()
    assert verdict.word == UNSTABLE and verdict.text.startswith("unstable: ")
    assert "doubling in" in verdict.text and "Hz" in verdict.text
    assert verdict.bears.reason == "the loop is unstable as it is"


def test_a_payload_under_which_the_arm_folds_is_not_borne(heavy_arm):
    made, _ = controller(
        heavy_arm, {"type": "model_following"}, {"type": "lqr"}, {"type": "kalman"}, np.zeros(1)
    )
    judge = Judge([made])
    assert judge.stable() and not judge.stable(stiffness=0.01)


def test_a_law_that_leaves_the_joints_free_has_no_loop(arm_r):
    with pytest.raises(DesignError, match="leaves the joints free"):
        controller(arm_r, {"type": "none"}, {"type": "lqr"}, {"type": "kalman"}, np.zeros(1))


def test_phase_and_gain_act_on_the_torque(arm_r):
    made, _ = controller(
        arm_r,
        {"type": "model_following"},
        {"type": "none"},
        {"type": "true_rates"},
        np.zeros(1),
        **TRUE,
    )
    loop = WholeLoop(made)
    assert_allclose(loop.matrix(gain=1.0 + 0.0j), loop.matrix(), atol=1e-12)
    doubled = WholeLoop(replace(made, C=2.0 * made.C, D=2.0 * made.D))
    assert_allclose(np.sort(loop.poles(gain=2.0).real), np.sort(doubled.poles().real), rtol=1e-6)
    assert not loop.stable(gain=np.exp(-1j * np.radians(179.0)))
