# SPDX-License-Identifier: Apache-2.0
"""Observers side by side, and the paper's motion under the control of what a Kalman filter makes of counts."""

import numpy as np
from numpy.testing import assert_allclose

from flexarm_control.observers.arm_observer import observe
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_studies.case_study.runs import paper_trajectory
from flexarm_studies.commands import observer_table
from flexarm_studies.loop.closed_loop import TRAJECTORY_START_NS, ClosedLoop

SLOW, FAST = {"type": "linear_model_following"}, {"type": "lqr"}


def paper_motion(arm, observer, seconds=8.0):
    """Estimated and true rates of the modes, and both for the joint, from the trajectory's start on."""
    settings = {"rate": 500.0, "noise": True, "publish_joint_velocity": False}
    loop = ClosedLoop(arm, SLOW, FAST, observer, settings)
    loop.step()
    verdict = loop.controller.offer(paper_trajectory(loop.model.joint_names))
    assert verdict.accepted, verdict.reason
    plant, simulator, found, true = loop.simulator.plant, loop.simulator, [], []
    while simulator.stamp_ns <= TRAJECTORY_START_NS + seconds * 1e9:
        started = simulator.stamp_ns >= TRAJECTORY_START_NS
        state = np.concatenate([plant.delta_d, plant.qd])
        loop.step()
        if started:
            found.append(np.concatenate([loop.observer.rate, loop.observer.velocity]))
            true.append(state)
    assert loop.controller.reference.finished
    return np.array(found), np.array(true), loop


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


def test_the_papers_motion_with_counts_and_noisy_gauges_alone(changed_arm):
    def sensed(data):
        data["joints"][0]["encoder_counts"] = 4096
        for gauge in data["gauges"]:
            gauge["noise"] = 0.5e-6

    found, true, loop = paper_motion(changed_arm("R", sensed), {"type": "kalman"})
    error, size = rms(found - true), rms(true)
    assert error[0] < 0.05 * size[0]
    assert error[2] < 0.01 * size[2]
    assert loop.observer.observer.consistent
    assert np.abs(loop.simulator.plant.q[0] - np.pi / 2) < 2e-3


def test_the_table_ranks_observers_as_they_should_be():
    names = ["filtered_derivative", "luenberger", "kalman"]
    noises = {"none": (0.0, 0), "given": (5e-7, 4096)}
    rows = observer_table.table("R", [500.0], noises, [0.0, 0.01], names, 0.6)
    assert len(rows) == 2 * 3 * 3
    error = {
        (r["observer"], r["noise"], r["delay [ms]"], r["predicted"]): r["all modes [%]"]
        for r in rows
    }
    derivative, luenberger, kalman = (error[name, "given", 0.0, False] for name in names)
    assert kalman < 0.2 * luenberger < 0.2 * derivative
    assert error["kalman", "none", 0.0, False] < 0.01
    for name in names:
        assert error[name, "none", 10.0, True] < 0.3 * error[name, "none", 10.0, False]


def test_an_observer_receives_the_motion_through_the_sensors():
    arm = model.build(arm_file.load("R"))
    states, torques = observer_table.motion(arm, 500.0, 0.4)
    core = observe(arm, "true_rates", {})
    core.observer.update = lambda sample, dt: core.observer.amplitude.__setitem__(
        slice(None), sample.amplitude
    )
    found = observer_table.estimates(arm, core, states, torques, 500.0)
    assert_allclose(found[:, :3], states[:, :3], atol=1e-12)
    assert np.abs(states[:, 4:]).max() > 0.01


def test_the_command_prints_a_row_per_case(flexarm):
    words = "two_link --rates 250 --delays 0,0.004 --observers luenberger --duration 0.3"
    code, out, _ = flexarm("observers", *words.split())
    lines = out.splitlines()
    assert code == 0 and len(lines) == 2 + 2 * 3
    assert lines[0] == "| " + " | ".join(observer_table.COLUMNS) + " |"
    assert [line.split("|")[5].strip() for line in lines[2:5]] == ["no", "no", "yes"]
