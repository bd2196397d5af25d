# SPDX-License-Identifier: Apache-2.0
"""Arms whose joints have transmissions, in closed loops with controllers that know their links fixed to the motors."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.robust.design import design
from flexarm_control.robust.limit_cycle import describing_function
from flexarm_control.robust.settings import Settings
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


def geared(data, encoder, play=0.012, stiffness=850.0, weight=9.81):
    data["model"], data["gravity"] = "chain", [0.0, -weight, 0.0]
    gear = {"stiffness": stiffness, "damping": 3.0, "play": play}
    data["joints"][0] |= {
        "rotor_inertia": 1e-4,
        "gear_ratio": 50.0,
        "transmission": gear,
        "encoder": encoder,
    }


@pytest.mark.long
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


@pytest.mark.long
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


# --- limit cycles ------------------------------------------------------------------------------


@pytest.mark.parametrize("amplitude, fraction", [(0.5, 0.0), (1.0, 0.0), (1e6, 1.0)])
def test_a_dead_zone_passes_nothing_within_it_and_all_far_beyond(amplitude, fraction):
    assert describing_function(amplitude, 1.0) == pytest.approx(fraction, abs=1e-5)


@pytest.mark.parametrize("amplitude", [1.01, 1.7, 5.0])
def test_the_describing_function_is_the_first_harmonic(amplitude):
    angle = 2.0 * np.pi * (np.arange(20_000) + 0.5) / 20_000
    x = amplitude * np.sin(angle)
    force = x - np.clip(x, -1.0, 1.0)
    assert describing_function(amplitude, 1.0) == pytest.approx(
        2.0 * np.mean(force * np.sin(angle)) / amplitude, abs=1e-6
    )


def motion_of(changed_arm, encoder, **changed):
    """A scenario of the arm in a horizontal plane, and its judge."""
    path = changed_arm("one_link", partial(geared, encoder=encoder, weight=0.0, **changed))
    values = CONTROL | GAINS[encoder] | {"observer.plausibility": False}
    motion = {"trajectory": "quintic:to=0.4,duration=1", "window": 7.0, "delay": 0.002}
    scenario = Scenario(path, values, **motion)
    return scenario, judge_of(loop_of(scenario), [np.array([0.4])], 0.002)


def test_a_loop_oscillates_in_its_play_as_its_harmonic_balance_says(changed_arm):
    scenario, judge = motion_of(changed_arm, "link")
    assert judge.stable()  # with closed play
    (cycle,) = judge.bears().limit_cycles
    record, *_ = run_loop(scenario)
    late = record.time > 4.0
    deflection, times = record.plant_amplitude[late, -1], record.time[late]
    rises = np.flatnonzero((deflection[:-1] < 0.0) & (deflection[1:] >= 0.0))
    frequency = (len(rises) - 1) / (times[rises[-1]] - times[rises[0]])
    assert cycle.frequency == pytest.approx(frequency, rel=0.03)
    assert cycle.amplitude == pytest.approx(0.5 * np.ptp(deflection), rel=0.1)
    assert cycle.joint == "joint1" and cycle.load == pytest.approx(0.0, abs=1e-9)
    assert "likely to oscillate at 6.8" in cycle.text


def test_a_loop_about_the_motor_s_angle_does_not_oscillate(changed_arm):
    scenario, judge = motion_of(changed_arm, "motor")
    assert judge.bears().limit_cycles == ()
    record, *_ = run_loop(scenario)
    assert np.ptp(record.plant_amplitude[record.time > 7.0, -1]) < 0.012


def test_without_play_there_is_no_limit_cycle(changed_arm):
    assert motion_of(changed_arm, "link", play=0.0)[1].bears().limit_cycles == ()


def test_simulate_warns_of_a_likely_limit_cycle(changed_arm, flexarm, result):
    path = changed_arm("one_link", partial(geared, encoder="link"))
    words = [
        "simulate",
        path,
        "--trajectory",
        "quintic:to=0.1,duration=0.2",
        "--delay",
        "0.002",
        "--set",
    ]
    words += [
        f"{name}={flat(value)}" for name, value in (CONTROL | GAINS["link"]).items()
    ]  # fmt: skip
    _, out, _ = flexarm(*words)
    assert "warning: play of joint1: the loop is likely to oscillate at 6.8" in out
    assert "the load of 2.33 N m keeps the flanks together" in out
    (cycle,) = result(*words)["bears"]["limit_cycles"]
    assert cycle["joint"] == "joint1"


def flat(value):
    """As typed."""
    if isinstance(value, list):
        return "[" + ",".join(map(str, value)) + "]"
    return str(value)


def test_show_has_the_transmission_and_warns_of_its_play(changed_arm, flexarm, result):
    path = changed_arm("one_link", partial(geared, encoder="link"))
    _, out, _ = flexarm("show", path)
    assert (
        "transmission of joint1: 850 N m/rad, 3 N m s/rad, play 12 mrad, 0 s/rad; encoder at" in out
    )
    assert "warning: joint1 has play" in out
    (joint,) = result("show", path)["joints"]
    assert joint["transmission"]["play"] == 0.012
