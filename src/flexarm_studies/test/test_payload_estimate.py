# SPDX-License-Identifier: Apache-2.0
"""The payload, estimated and taken over, in the closed loop: softer links, a mode more, friction, noise, delay."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_control.payload import estimator
from flexarm_control.trajectory import specs
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import DesignError
from flexarm_studies.loop import scenario
from flexarm_studies.random_arms import generator

#: What `flexarm design` gives for the arm below, at 500 Hz.
DESIGN = {
    "slow.type": "joint_pid",
    "slow.stiffness": [4.0564],
    "slow.damping": [0.21794],
    "slow.integral": [13.598],
    "fast.type": "fixed_gain",
    "fast.gain": [9.3275, -14.495, -0.10081, -0.084306],
    "fast.configuration": [0.0],
    "manifold.type": "reference",
    "stability_margin": -1000.0,
    "integrator": "implicit",
    "publish_joint_velocity": False,
    "observer.bandwidth": 500.0,
    "observer.joint_velocity_bandwidth": 500.0,
}
PAPER = {"slow.type": "model_following", "fast.type": "lqr"}


def heavy_arm():
    """A random arm of one link under gravity whose payload is a good part of its weight."""
    return generator.arm(48).read()


def peaks(arm, ways, given, payload, mode, wrong=None):
    """Peak joint error [deg] of each of several motions, and the loop; `wrong` changes the strains."""
    plant = scaled(arm, payload, 0.9)
    plant = plant.with_modes(1 + max(f.modes for k in plant.links for f in k.flexible.values()))
    joints = tuple(
        replace(
            j, friction=replace(j.friction, coulomb=j.friction.coulomb + 0.005 * j.limits.torque)
        )
        for j in plant.joints
    )
    loop = scenario.loop_of(
        scenario.Scenario(
            arm,
            {**given, "payload_estimate": mode},
            plant_arm=replace(plant, joints=joints),
            noise=True,
            seed=1,
            rate=500.0,
            delay=0.002,
        )
    )
    if wrong is not None:
        honest = loop.measure

        def measure():
            sample = honest()
            sample.strain, sample.amplitude = wrong(sample.strain.copy()), None
            return sample

        loop.measure = measure
    found = []
    for way in ways:
        path = specs.from_spec(way, loop.model)
        if not found:
            loop.simulator.reset(path.positions[0])
        else:
            now = loop.simulator.stamp_ns + loop.simulator.period_ns
            path = replace(path, stamp_ns=now)
        record = loop.follow(path, 1e-9 * int(path.times_ns[-1]) + 2.0)
        if loop.lost:
            break
        found.append(np.rad2deg(np.abs(record.plant_position - record.reference).max()))
    return found, loop


UP, DOWN = "quintic:from=-0.7,to=0.6,duration=0.9", "quintic:from=0.6,to=-0.7,duration=0.9"


@pytest.mark.parametrize(("payload", "interval"), [(0.6, 0.1), (1.4, 0.12)])
def test_at_rest_under_gravity_the_payload_is_found_and_taken_over(payload, interval):
    _, loop = peaks(heavy_arm(), (UP, DOWN), DESIGN, payload, "rest")
    found = loop.controller.payload
    assert not loop.lost
    assert found.value == pytest.approx(payload, abs=interval)
    assert found.low < payload < found.high
    assert loop.controller.payload_scale == pytest.approx(payload, abs=interval)


def test_the_payload_of_the_file_is_kept():
    _, loop = peaks(heavy_arm(), (UP, DOWN), DESIGN, 1.0, "rest")
    assert loop.controller.payload.low < 1.0 < loop.controller.payload.high
    assert loop.controller.payload_scale == 1.0


def test_the_torque_does_not_step_when_the_payload_is_taken_over():
    _, loop = peaks(heavy_arm(), (UP,), DESIGN, 1.4, "rest")
    controller = loop.controller
    controller.carry(loop._law_for(1.0))
    steps, taken = [], []
    for _ in range(500):
        before, carried = controller.torque.copy(), controller.payload_scale
        loop.step()
        steps.append(np.abs(controller.torque - before).max())
        taken.append(controller.payload_scale != carried)
    assert sum(taken) == 1
    # A step would be the weight of 0.4 payloads, 0.03 N m; noise makes half of the bound.
    assert max(steps) < 0.01


def test_in_motion_without_gravity_the_next_motion_is_better():
    ways = ("quintic:to=1.5708,duration=2", "quintic:from=1.5708,to=0,duration=2")
    arm = "R"
    without, _ = peaks(arm_file.load(arm), ways, PAPER, 2.0, "off")
    with_, loop = peaks(arm_file.load(arm), ways, PAPER, 2.0, "online")
    found = loop.controller.payload
    assert found.low < 2.0 < found.high
    assert with_[0] == without[0]  # taken over at rest only
    assert with_[1] < 0.5 * without[1]


def _gain(factor):
    return lambda strain: strain * np.array([factor, 1.0])


@pytest.mark.long
@pytest.mark.parametrize("payload", [1.0, 1.3])
@pytest.mark.parametrize(
    "factor", [0.0, -1.0, 0.8, 1.2], ids=["dead", "wrong sign", "-20 %", "+20 %"]
)
def test_a_wrong_gauge_makes_no_motion_worse_than_without_the_estimate(payload, factor):
    given = {**DESIGN, "observer.plausibility": False}
    without, _ = peaks(heavy_arm(), (UP, DOWN, UP), given, payload, "off", _gain(factor))
    with_, loop = peaks(heavy_arm(), (UP, DOWN, UP), given, payload, "rest", _gain(factor))
    assert len(with_) == len(without)
    assert (np.array(with_) <= 1.05 * np.array(without)).all()
    if factor <= 0.0:
        assert loop.controller.payload_scale == 1.0
        assert loop.controller.payload.reason


def test_a_law_that_learns_and_an_estimate_are_refused_together():
    given = {"slow.type": "adaptive_model_following", "fast.type": "lqr"}
    with pytest.raises(DesignError, match="payload_estimate"):
        scenario.loop_of(
            scenario.Scenario("R", {**given, "payload_estimate": estimator.ONLINE}, rate=500.0)
        )
