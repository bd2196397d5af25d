# SPDX-License-Identifier: Apache-2.0
"""What the default control makes of the paper's arm, and of softer ones: the loop without ROS."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.units import POUND_FORCE_FOOT
from flexarm_studies.case_study import runs as case_study
from flexarm_studies.loop import metrics
from flexarm_studies.loop.closed_loop import ClosedLoop
from flexarm_studies.loop.scenario import Scenario, parameters, run

pytestmark = pytest.mark.slow

#: The defaults of the controller node.
SLOW, FAST = {"type": "linear_model_following"}, {"type": "lqr"}
MANIFOLD = {"type": "corrected"}
LIMIT = [3.2 * POUND_FORCE_FOOT]


def default_loop(controller, observer=None, simulator=None, arm="R"):
    """The loop under the default control, with true rates unless there is another observer."""
    observer, simulator = (
        observer or {"type": "true_rates"},
        {"publish_rates": True} | (simulator or {}),
    )
    return ClosedLoop(arm, SLOW, FAST, observer, simulator, controller, MANIFOLD)


def case(feedforward, *others):
    """Metrics of the case study under the default control; `others` are those of `default_loop`."""
    loop = default_loop({"feedforward": feedforward, "torque_limit": LIMIT}, *others)
    record = loop.run(case_study.paper_trajectory(loop.model.joint_names), 8.0)
    assert not loop.unprepared
    return metrics.case_study_metrics(record, loop.model, until=8.0)


@pytest.mark.parametrize(
    ("feedforward", "error", "residual"), [("model", 0.2, 1e-5), ("preview", 0.03, 2e-6)]
)
def test_tracks_like_a_rigid_arm_and_does_not_ring(feedforward, error, residual):
    """The paper's law: 3.46 deg and 2.6e-4 ft, with 3.5 lbf ft."""
    found = case(feedforward)
    assert found["peak_joint_error_deg"] <= error
    assert found["residual_tip_rms_ft"] <= residual
    assert found["peak_torque_lbf_ft"]["total"] <= 3.2


@pytest.mark.parametrize("feedforward", ["model", "preview"])
@pytest.mark.parametrize("scale", [2.0 / 3.0, 4.0 / 3.0])
def test_with_a_payload_a_third_off(scale, feedforward):
    """The README's worst case beside its nominal figures."""
    values = {"observer.type": "true_rates", "feedforward": feedforward}
    _, found = run(Scenario("R", values, "paper", payload_scale=scale, window=6.0))
    assert np.degrees(found["peak_joint_error_rad"][0]) <= 0.7
    assert found["residual_tip_rms_mm"] / 304.8 <= 5e-5


@pytest.mark.long
def test_with_an_encoder_and_an_observer():
    """4096 counts, joint velocities from them, modal rates from the gauges."""
    arm = arm_file.load("R")
    arm = replace(arm, joints=(replace(arm.joints[0], encoder_counts=4096),))
    without = {"publish_joint_velocity": False, "publish_rates": False}
    found = case("model", {"type": "kalman"}, without, arm)
    assert found["peak_joint_error_deg"] <= 0.25
    assert found["residual_tip_rms_ft"] <= 3e-5


TWO_LINK = {
    "observer.type": "true_rates",
    "slow.type": "model_following",
    "slow.kp": [2.25, 2.25],
    "slow.kv": [3.0, 3.0],
    "manifold.order": 1,
    "fast.alpha": 2.0,
    "fast.q": [0.0] * 4 + [0.001] * 4,
    "fast.configuration": [0.8, 0.8],
}


@pytest.mark.parametrize(("level", "residual"), [("first_order", 0.1), ("auto", 2.0)])
def test_two_soft_links_come_to_rest_with_the_trajectory(level, residual):
    """60 deg in 2 s, a period of the lowest mode with the joints locked.

    The controller's model is of first order: an arm with finite slopes goes on swinging by a millimetre.
    """
    values = TWO_LINK | {"feedforward": "preview", "level": level}
    motion = "quintic:to=1.0472;1.0472,duration=2"
    _, found = run(Scenario("two_link", values, motion, window=1.5))
    assert not found["lost"]
    assert found["residual_tip_rms_mm"] < residual
    if level == "first_order":
        assert found["settling_time_s"] == pytest.approx(0.05)


@pytest.mark.parametrize("payload", [0.0, 2.0, 3.0])
def test_an_unknown_payload(payload):
    """Stays stable and settles, on the paper's arm."""
    values = {"observer.type": "true_rates"}
    _, found = run(Scenario("R", values, "paper", rate=500.0, payload_scale=payload, window=4.5))
    assert not found["lost"]
    assert found["final_tip_error_mm"] < 1.0
    assert np.isfinite(found["settling_time_s"])


def test_a_plan_that_the_torque_does_not_allow_is_reported_and_skipped():
    settings = {"feedforward": "preview", "torque_limit": [2.0], "trajectory_torque_margin": 0.0}
    loop = default_loop(settings)
    loop.follow(case_study.paper_trajectory(loop.model.joint_names), 0.2)
    assert (
        "no motion within the torque limits" in loop.unprepared and "([2.0] N m)" in loop.unprepared
    )


def test_a_gap_in_the_samples_does_not_shake_the_simulated_arm():
    """The model runs over the true time step: three samples lost on the way change next to nothing."""
    loop = default_loop({"feedforward": "model"})
    motion = case_study.paper_trajectory(loop.model.joint_names)
    loop._answer()
    assert loop.controller.offer(motion).accepted
    errors = []
    for k in range(2500):
        if 800 <= k < 803:
            loop.simulator.advance(loop.controller.torque)
            continue
        loop.step()
        errors.append(abs(loop.controller.position_error[0]))
    assert np.degrees(max(errors)) < 0.25
    assert np.degrees(errors[-1]) < 1e-2


@pytest.mark.long
@pytest.mark.parametrize("payload", [0.0, 3.0])
def test_an_unknown_payload_is_learnt_by_the_second_time(payload):
    """Peak joint error below 0.5 deg the second time, of 0.8 to 1.9 deg the first."""
    values = parameters("adaptive") | {"observer.type": "true_rates"}
    motion = Scenario("R", values, "paper", rate=500.0, payload_scale=payload, repeat=2, window=1.5)
    _, found = run(motion)
    first, second = (np.degrees(p["peak_joint_error_rad"][0]) for p in found["passes"])
    assert second < 0.5 < first
