# SPDX-License-Identifier: Apache-2.0
"""Arms whose joints have transmissions, in closed loops with controllers that know their links fixed to the motors."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.robust.design import Settings, design
from flexarm_control.robust.uncertain import Uncertainty, uncertain_loops
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models.model import build
from flexarm_studies.loop.judged import judge_of
from flexarm_studies.loop.scenario import Scenario, loop_of, run_loop

#: Of designs for the arms below: joints by their motors, and by their links.
CONTROL = {
    "rate": 500.0,
    "trajectory_torque_margin": 0.0,
    "slow.type": "joint_pid",
    "fast.type": "fixed_gain",
    "observer.type": "filtered_derivative",
    "observer.bandwidth": 260.0,
    "observer.joint_velocity_bandwidth": 260.0,
    "manifold.type": "reference",
    "feedforward": "model",
    "stability_margin": -1000.0,
}
GAINS = {
    "motor": {
        "slow.stiffness": [92.6],
        "slow.damping": [21.2],
        "slow.integral": [178.0],
        "fast.gain": [112.0, -8850.0, 10.7, -81.7],
    },
    "link": {
        "slow.stiffness": [128.0],
        "slow.damping": [9.19],
        "slow.integral": [175.0],
        "fast.gain": [19.2, -76.5, 0.5, -18.4],
    },
}


def geared(data, encoder, play=0.012, stiffness=850.0):
    data["model"], data["gravity"] = "chain", [0.0, -9.81, 0.0]
    gear = {"stiffness": stiffness, "damping": 3.0, "play": play}
    data["joints"][0] |= {
        "rotor_inertia": 1e-4,
        "gear_ratio": 50.0,
        "transmission": gear,
        "encoder": encoder,
    }


@pytest.mark.parametrize("encoder", ["motor", "link"])
def test_a_controller_that_knows_rigid_joints_holds_an_arm_with_play(changed_arm, encoder):
    path = changed_arm("one_link", partial(geared, encoder=encoder))
    motion = {"trajectory": "quintic:to=0.4,duration=1", "window": 3.0, "delay": 0.002}
    record, metrics, loop = run_loop(Scenario(path, CONTROL | GAINS[encoder], **motion))
    assert loop.model.mode_names == ("link1_y_mode1", "link1_y_mode2")
    assert loop.simulator.plant_model.mode_names[-1] == "joint1_transmission"
    assert not loop.lost and metrics["peak_joint_error_rad"][0] < 0.02
    # The link hangs on its flank at first: the arm is not the one with rigid joints.
    assert -0.03 < record.plant_amplitude[0, -1] < -0.006
    at_encoder = record.plant_position[0, 0]
    if encoder == "link":
        at_encoder += record.plant_amplitude[0, -1]
    assert at_encoder == pytest.approx(0.0, abs=1e-3)
    if encoder == "motor":
        assert metrics["final_tip_error_mm"] < 0.5


def test_a_design_is_for_loops_with_the_transmission_in_them(changed_arm):
    arm = arm_file.load(changed_arm("one_link", partial(geared, encoder="motor", play=0.0)))
    short = design(arm, Settings(rate=500.0, delay=0.002, effort=1e-3))
    nominal = build(arm.known)
    loops = uncertain_loops(nominal, short.configurations, short.sampling, Uncertainty())
    rigid = uncertain_loops(
        build(arm_file.load("one_link")), short.configurations, short.sampling, Uncertainty()
    )
    assert loops[0].F.shape[0] == rigid[0].F.shape[0] + 2  # the deflection and its rate


@pytest.mark.parametrize("encoder", ["motor", "link"])
def test_what_a_loop_bears_is_judged_on_the_arm_with_its_transmission(changed_arm, encoder):
    path = changed_arm("one_link", partial(geared, encoder=encoder))
    motion = {"trajectory": "quintic:to=0.1,duration=0.5", "window": 0.1, "delay": 0.002}
    judge = judge_of(
        loop_of(Scenario(path, CONTROL | GAINS[encoder], **motion)), [np.array([0.1])], 0.002
    )
    assert judge.stable()
    plant = build(judge.arm)
    turned = judge.loops[0].plant(plant)[3]
    assert_allclose(turned[0], [1.0, 0.0, 0.0, float(encoder == "link")])
    known = judge.loops[0].matrix()
    assert judge.loops[0].matrix(plant=judge.loops[0].plant(plant)).shape[0] == len(known) + 2
