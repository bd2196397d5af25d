# SPDX-License-Identifier: Apache-2.0
"""Arms of several links as a user runs them: the simulator node, the composite controller."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from harness import Drive
from in_process import InProcess

from flexarm_control import trajectory
from flexarm_control.composite.assembly import under
from flexarm_control.motions import profiles
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_msgs.msg import JointTorque
from flexarm_studies.loop import closed_loop, parameter_files
from flexarm_tools.recording import recorder
from flexarm_tools.running import lockstep

ROOT = Path(__file__).parents[1]
FILE, GOAL, DURATION = "two_link_composite", (0.8, 0.8), 6.0
#: The nodes do what the loop without ROS does: the motion's first second shows it.
SHORT = 1.0


@pytest.mark.parametrize("name", ["two_link", "long_reach", "rigid"])
def test_the_simulator_runs_each_shipped_arm(name):
    arm = arm_file.load(name)
    with InProcess() as bench:
        bench.start("simulator", {"arm": name, "lockstep": True, "pause_at": -1.0})
        drive = Drive(bench)
        for _ in range(100):
            state = drive.step(0.0, mode=JointTorque.DISABLED)
    assert tuple(state.joint_names) == arm.joint_names
    assert tuple(state.mode_names) == (arm.observed_modes if arm.gauges else ())
    assert tuple(state.gauge_names) == arm.gauge_names
    assert np.isfinite(state.joint_position).all() and np.isfinite(state.strain).all()
    # There is no controller: the brakes hold what has them, at rest under its own weight.
    if arm.gravity != (0.0, 0.0, 0.0):
        assert np.abs(state.joint_position).max() < 1e-9
    if arm.gauges:
        sag = model.build(arm).static_deflection(np.zeros(len(arm.joints)))
        assert np.abs(np.array(state.modal_amplitude) - sag).max() < 2e-2


@pytest.mark.long
def test_friction_that_makes_a_light_joint_hunt_in_the_simulator_is_reported(tmp_path, flexarm):
    tree = yaml.safe_load((ROOT / "config" / "arms" / "two_link.yaml").read_text())
    tree["joints"][1]["hub_inertia"] = 1e-5
    tree["joints"][1]["friction"] = {"coulomb": 10.0}
    path = tmp_path / "rubbing.yaml"
    path.write_text(yaml.safe_dump(tree))
    words = "simulate", path, "--duration", "0.01", "--json", "--out", tmp_path / "out.csv"
    code, printed, err = flexarm(*words)
    (warning,) = json.loads(printed)["warnings"]
    assert code == 0 and "may hunt" in err and warning in err
    with InProcess() as bench:
        bench.start("simulator", {"arm": str(path), "lockstep": True, "pause_at": -1.0})
        assert "may hunt" in bench.log("simulator")


def quintic():
    """The motion of both joints."""
    return profiles.quintic([0.0, 0.0], GOAL, 4.0)


def without_ros():
    """The same run in one process."""
    values = parameter_files.load(FILE)
    loop = closed_loop.ClosedLoop(
        "two_link",
        under(values["controller"], "slow"),
        under(values["controller"], "fast"),
        under(values["observer"], "observer"),
        {"initial_position": [0.0, 0.0]},
    )
    s = profiles.sample(quintic(), 41)
    rows = zip(s.times, s.positions, s.velocities, s.accelerations, strict=True)
    joints = loop.model.joint_names
    return loop.run(
        trajectory.validate(
            joints,
            joints,
            closed_loop.TRAJECTORY_START_NS,
            [(round(t * 1e9), p, v, a, ()) for t, p, v, a in rows],
        ),
        DURATION,
    )


def test_the_composite_controller_moves_the_two_link_arm_and_damps_it():
    with InProcess() as nodes:
        for name, own in (("simulator", {"lockstep": True}), ("observer", {}), ("controller", {})):
            nodes.start(
                name,
                {**own, "arm": "two_link", "state_timeout": 60.0},
                file=parameter_files.find(FILE),
            )
        start = closed_loop.TRAJECTORY_START_NS
        message = lockstep.trajectory_message(("joint1", "joint2"), quintic(), 41, start)
        samples = nodes.record(message, SHORT)
    nodes = recorder.to_record(samples, start, "two_link")
    alone = without_ros()
    assert nodes.time[-1] + 2e-3 > SHORT and nodes.time.size < alone.time.size
    for name in ("time", "position", "amplitude", "torque", "fast_torque"):
        ours, theirs = getattr(nodes, name), getattr(alone, name)[: nodes.time.size]
        np.testing.assert_allclose(ours, theirs, atol=1e-9, err_msg=name)
    error = np.abs(alone.reference - alone.position)
    assert error.max() < 0.06  # [rad] on a motion of 0.8 rad; untuned
    assert error[-1].max() < 0.02
    assert np.abs(nodes.fast_torque).max() > 1e-3  # the fast control takes part
    late = alone.time > 5.5
    assert np.abs(alone.amplitude[late]).max() < 0.1 * np.abs(alone.amplitude).max()
