# SPDX-License-Identifier: Apache-2.0
"""The lies of `flexarm attack` before the real nodes: the simulator's node tells them, and the instrument is right."""

import re
from dataclasses import replace

import numpy as np
import pytest
from harness import PATIENT, Arm, Bench, trajectory
from in_process import InProcess

from flexarm_msgs.msg import CompositeState, JointTorque
from flexarm_studies.attack import lies, run
from flexarm_studies.attack.cases import MOTION, START, Case, arm_of

FAULT = CompositeState.FAULT
#: The motion is at its fastest [s].
AT = START + 0.5 * MOTION
#: Sample at which the loop stands until the trajectory is there; the observer has converged.
STANDS = 150
CASE = Case("R", "kalman", False, noise=False)


@pytest.fixture(scope="module")
def arm():
    """The loop on the queue, paused at `STANDS`."""
    with InProcess() as bench:
        own = {
            "lockstep": True,
            "pause_at": 1e-3 * STANDS,
            "resend_period": 0.02,
            "allow_faults": True,
        }
        sent = {"publish_joint_velocity": False, "publish_modal_amplitude": False}
        observer = {"observer.type": "kalman"}
        # The queue's time is no arm's time: a state that is waited for is no silence.
        bench.start_loop(
            {**own, **sent}, observer=observer, controller=PATIENT | {"max_gap": 0.5}, arm="R"
        )
        loop = Arm(bench, pauses_at=STANDS)
        loop.wait_standing()
        yield loop


def moved(arm, lie, until):
    """The nodes' torques, by sequence, of a motion with a lie, up to a time [s]."""
    bench = arm.bench
    assert bench.set("simulator", faults=[])[0].successful
    arm.reset()
    lines = list(lie.lines(arm_of("R", False), AT, 1e-3))
    (result,) = bench.set("simulator", faults=lines)
    assert result.successful, result.reason
    start = 1_000_000_000 + round(1e9 * START)
    arm.offer(trajectory(["joint1"], (MOTION, [1.0], [0.0], [0.0]), stamp=start))
    for topic in (arm.torques, arm.states, arm.measured):
        topic.messages.clear()
    arm.pause(False)
    last = round(1e3 * until)
    bench.wait_for(
        "the end", lambda: arm.measured.newest and arm.measured.newest.sequence >= last, 600.0
    )
    arm.pause(True)
    return arm.torques.messages


@pytest.mark.parametrize(
    "name",
    [
        "message repeated for ever",
        "two drivers in turn",
        "new session, zero off by 0.5 rad",
        "clock back by 1 s",
    ],
)
def test_the_nodes_name_a_lie_about_messages_and_take_the_torque_away(arm, name):
    lie = lies.LIES[name]
    bench = arm.bench
    torques = moved(arm, lie, AT - 0.1)
    torques.clear()
    arm.pause(False)
    bench.wait_for("a fault", lambda: arm.state.supervisor_state == FAULT)
    assert re.search(lie.says, arm.state.rejected_reason.lower()), arm.state.rejected_reason
    first = next(k for k, m in enumerate(torques) if m.mode == JointTorque.DISABLED)
    assert {m.mode for m in torques[:first]} == {JointTorque.ENABLED}
    assert {m.mode for m in torques[first:]} == {JointTorque.DISABLED}
    bench.wait_for("samples after it", lambda: len(torques) > first + 20)


@pytest.mark.parametrize(
    "name", ["strains of the wrong sign", "encoder jumps by 0.2 rad", "stall of 40 ms"]
)
def test_the_nodes_send_the_torques_that_flexarm_attack_computes(arm, name):
    lie, until = lies.LIES[name], AT + 0.2
    found = moved(arm, lie, until)
    motion = {
        "times": [MOTION],
        "positions": [[1.0]],
        "velocities": [[0.0]],
        "accelerations": [[0.0]],
    }
    scenario = replace(CASE.scenario(), trajectory=motion)
    driver = run.driver_of(scenario, lie.lines(arm_of("R", False), AT, 1e-3), AT)
    trace = run.drive(driver, until=until)
    # Of a lost sample there is no answer; after a fault there is no torque in either.
    answers = {m.sequence: m for m in found if STANDS < m.sequence < trace.time.size}
    assert len(answers) > 900 and max(answers) > 1e3 * AT + 100
    for sequence, message in answers.items():
        torque = trace.torque[sequence, 0]
        assert np.isnan(torque) == (message.mode == JointTorque.DISABLED), sequence
        assert message.mode == JointTorque.DISABLED or message.torque[0] == torque, sequence
    assert sum(m.mode == JointTorque.ENABLED for m in answers.values()) > 900


@pytest.fixture
def real_time(tmp_path):
    """The three nodes as processes, in real time, the arm at its fastest in a motion of 1 rad."""
    with Bench(tmp_path) as bench:
        bench.start_loop(
            {"rate": 200.0, "allow_faults": True, "torque_timeout": 1.0},
            # A busy machine holds torques up; that is not what is tested.
            controller={"fast.type": "none", "resume_gap": 1.0, "torque_mismatch": 0.0},
            arm="R",
        )
        arm = Arm(bench)
        arm.wait_ready()
        arm.offer(trajectory(["joint1"], (MOTION, [1.0], [0.0], [0.0])))
        bench.wait_for("half of the motion", lambda: arm.measured.newest.joint_position[0] > 0.4)
        yield arm


@pytest.mark.real_time
def test_in_real_time_a_message_repeated_for_ever_ends_the_torque_and_the_arm_rests_on_its_path(
    real_time,
):
    bench = real_time.bench
    # From now on: a time that has passed.
    assert bench.set("simulator", faults=["state repeat"])[0].successful
    bench.wait_for("a fault", lambda: real_time.state.supervisor_state == FAULT)
    says = lies.LIES["message repeated for ever"].says
    assert re.search(says, real_time.state.rejected_reason.lower()), real_time.state.rejected_reason
    assert real_time.torques.newest.mode == JointTorque.DISABLED
    assert bench.set("simulator", faults=[])[0].successful
    old = real_time.measured.newest.sequence
    bench.wait_for("new samples", lambda: real_time.measured.newest.sequence > old + 200)
    assert 0.0 < real_time.measured.newest.joint_position[0] < 1.0
    assert abs(real_time.measured.newest.joint_velocity[0]) < 0.05
    assert {m.mode for m in real_time.torques.messages[-50:]} == {JointTorque.DISABLED}
