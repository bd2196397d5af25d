# SPDX-License-Identifier: Apache-2.0
"""The fault matrix: what is wrong, what the arm comes to, how soon, and how it goes on; the table of docs/safety.md.

The rows of sensors and network run in lockstep, the faults injected by the simulator: reaction times are counted in
samples, the same in every run. ``FLEXARM_WRITE_DOCS=1`` writes the table.
"""

import os
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest
from harness import PATIENT, Arm, trajectory
from in_process import InProcess
from std_srvs.srv import SetBool, Trigger

from flexarm_msgs.msg import CompositeState, JointTorque

J = ["joint1"]
#: Faults begin here, in simulated time since the session's start [s].
BEGIN = 0.15
DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "safety.md"
#: Field and problem of a reason: what a colon explains, a limit and a hint are left out of the table.
PROBLEM = re.compile(r"(?:[\w.]+: )?.+?(?=: (?!-?(?:nan|inf|\d))| \(|; |$)")
MARKS = "<!-- fault matrix: begin -->", "<!-- fault matrix: end -->"
STATES = {
    getattr(CompositeState, n): n
    for n in ("INACTIVE", "READY", "TRACKING", "HOLDING", "STOPPING", "FAULT")
}
FAULT, HOLDING = CompositeState.FAULT, CompositeState.HOLDING


@dataclass(frozen=True)
class Row:
    """A fault, and what is to come of it.

    Attributes
    ----------
    fault : str
        Of the simulator's parameter `faults`, without its time.
    end : int
        State at the end of the motion: HOLDING where the loop goes on.
    reason : str
        Regular expression, of `rejected_reason`.
    lasting : str
        How long the fault lasts.
    within : int
        Longest reaction [samples].
    """

    fault: str
    end: int = FAULT
    reason: str = ""
    lasting: str = "for=0.05"
    within: int = 0


ROWS = {
    "joint position NaN": Row("joint_position.joint1 nan", reason="joint_position of joint1: nan"),
    "joint position infinite": Row("joint_position inf", reason="joint_position of joint1: inf"),
    "joint position huge": Row(
        "joint_position huge", reason="joint_position of joint1: .*beyond what an arm measures"
    ),
    "joint position missing": Row("joint_position drop", reason="joint_position: is empty"),
    "joint velocity NaN": Row("joint_velocity nan", reason="joint_velocity of joint1: nan"),
    "modal amplitude NaN": Row(
        "modal_amplitude.link1_y_mode1 nan", reason="modal_amplitude of link1_y_mode1: nan is not"
    ),
    "modal amplitude huge": Row(
        "modal_amplitude huge", reason="modal_amplitude of .*: .* is beyond"
    ),
    "wrong joint names": Row("names wrong", reason="joint_names"),
    "names in another order": Row("names reorder", end=HOLDING, lasting=""),
    "one value too few": Row("joint_position short", reason="joint_position"),
    "a fifth of the states lost": Row("state drop share=0.2 seed=3", end=HOLDING, lasting=""),
    "20 states lost in a row": Row("state drop", end=HOLDING, lasting="for=0.02"),
    "states sent twice": Row("state duplicate", end=HOLDING, lasting=""),
    "states in the wrong order": Row("state swap", end=HOLDING, lasting="for=0.05"),
    "stamps 1 s in the future": Row("state future by=1.0", reason=r"1\.0 s after the last state"),
    "clock back by 1 s": Row(
        "clock jump by=-1.0", reason="0.999 s before the last state", lasting=""
    ),
    "clock ahead by 10 s": Row(
        "clock jump by=10.0", reason=r"10\.0 s after the last state", lasting=""
    ),
    "joint encoder stuck": Row(
        "joint_position stick",
        reason="joint_position of joint1 stands still",
        lasting="",
        within=50,
    ),
}


@pytest.fixture(scope="module")
def measured():
    """What the rows have measured: row to columns of the table."""
    return {}


def standing_loop(bench):
    """The three nodes in lockstep, faults allowed, paused at 10 ms."""
    bench.start_loop(
        {"lockstep": True, "pause_at": 0.01, "resend_period": 0.02, "allow_faults": True},
        controller={**PATIENT, "max_gap": 0.5, "tracking_error_limit": 0.05, "limit_patience": 0.1},
        arm="R",
    )
    loop = Arm(bench, pauses_at=10)
    loop.wait_standing()
    return loop


@pytest.fixture(scope="module")
def arm():
    """The loop in this process."""
    with InProcess() as bench:
        yield standing_loop(bench)


def inject(arm, *faults):
    """Set the simulator's faults."""
    (result,) = arm.bench.set("simulator", faults=list(faults))
    assert result.successful, result.reason


def check_move(arm, goal, seconds=0.2):
    """Check that the arm, standing, moves to a goal and holds it."""
    arm.offer(trajectory(J, (seconds, [goal], [0.0], [0.0])))
    start = arm.now
    samples = arm.run(seconds + 0.1)
    state = arm.state
    assert state.supervisor_state == HOLDING, (
        f"{STATES[state.supervisor_state]}: {state.rejected_reason}"
    )
    assert list(state.reference_position) == [goal]
    # The run goes on until the pause arrives; the error is judged at the same sample every time.
    sample = samples[min(s for s in samples if s >= start + 1e9 * (seconds + 0.1))]
    assert abs(sample.position_error[0]) < 0.01


def begins(row):
    """The line for the simulator: the fault with its time."""
    time = f"at={BEGIN}" if row.fault.startswith("clock") else f"from={BEGIN} {row.lasting}"
    return f"{row.fault} {time}".strip()


@pytest.mark.parametrize("name", ROWS)
def test_a_fault_of_the_senses_ends_in_its_state_with_its_reason_and_recovers(arm, name, measured):
    measured[name] = check_row(arm, name)


def test_over_dds_a_fault_of_the_senses_ends_in_its_state_with_its_reason_and_recovers(bench):
    check_row(standing_loop(bench), "joint position NaN")


def check_row(arm, name):
    """Check one row, and return its line of the table."""
    row = ROWS[name]
    inject(arm)
    session = arm.reset()
    arm.offer(trajectory(J, (0.4, [0.1], [0.0], [0.0])))
    inject(arm, begins(row))
    arm.pause(False)
    arm.bench.wait_for(
        "the end of the motion",
        lambda: arm.measured.newest.session == session and arm.measured.newest.sequence >= 600,
    )
    # Until sample 10 it stood, and was still in the fault of before.
    reported = [m for m in arm.states.messages if m.session == session and m.sequence > 10]
    torques = [m for m in arm.torques.messages if m.session == session and m.sequence > 10]
    off = next((m for m in reported if m.supervisor_state == FAULT), None)
    since = None
    if row.end == FAULT:
        assert off is not None, STATES[arm.state.supervisor_state]
        assert re.search(row.reason, off.rejected_reason), off.rejected_reason
        assert arm.state.supervisor_state == FAULT, "latched"
        since = off.sequence - round(1000 * BEGIN)
        assert 0 <= since <= row.within
        later = [m for m in torques if m.sequence >= off.sequence]
        assert {m.mode for m in later} == {JointTorque.DISABLED}
        assert {tuple(m.torque) for m in later} == {(0.0,)}
    else:
        assert off is None, off.rejected_reason
        assert arm.state.supervisor_state == HOLDING, STATES[arm.state.supervisor_state]
        assert abs(arm.state.position_error[0]) < 0.03
        assert {m.mode for m in torques} == {JointTorque.ENABLED}
    inject(arm)
    assert arm.recover() == (row.end == FAULT)
    arm.reset()
    check_move(arm, 0.03, 0.3)
    reaction = "-" if since is None else f"{since} ms"
    does = "goes on" if since is None else "hard stop, `FAULT`"
    reason = (
        ""
        if since is None
        else re.sub(r"(?<!\w)-?\d[\d.e+]*", "#", PROBLEM.match(off.rejected_reason)[0])
    )
    return f"| {name} | `{begins(row)}` | {does} | {reaction} | {reason} |"


def test_the_table_of_the_document_is_what_was_measured(measured):
    if set(measured) != set(ROWS):
        pytest.skip("only some of the rows were run")
    head = "| fault at 1 kHz | injected | what follows | reaction | `rejected_reason` |\n|---|---|---|---|---|"
    table = "\n".join([head, *(measured[name] for name in ROWS)])
    text = DOCUMENT.read_text()
    before, rest = text.split(MARKS[0])
    inside, after = rest.split(MARKS[1])
    if os.environ.get("FLEXARM_WRITE_DOCS"):
        DOCUMENT.write_text(f"{before}{MARKS[0]}\n{table}\n{MARKS[1]}{after}")
        return
    # Reactions that depend on the arm's motion are listed, but not compared to the last digit.
    inside, table = (re.sub(r"\b\d\d+ ms", "# ms", t.strip()) for t in (inside, table))
    assert inside == table, "run it again with FLEXARM_WRITE_DOCS=1"


# What a user tells the controller ----------------------------------------------------------------


@pytest.fixture
def moving(arm):
    """The arm in the middle of a long move, without faults."""
    inject(arm)
    arm.reset()
    arm.offer(trajectory(J, (2.0, [0.5], [0.0], [0.0])))
    arm.run(0.6)
    assert arm.state.supervisor_state == CompositeState.TRACKING
    return arm


def test_stop_brings_the_reference_to_rest_and_the_next_move_goes_on_from_there(moving):
    arm, session = moving, moving.state.session
    speed = arm.state.reference_velocity[0]
    answer = arm.bench.call(Trigger, "controller/stop")
    assert answer.success and "STOPPING" in answer.message
    arm.run(1.5)
    reported = [m for m in arm.samples(session).values() if m.sequence > 610]
    states = list(dict.fromkeys(m.supervisor_state for m in reported))
    assert states == [CompositeState.TRACKING, CompositeState.STOPPING, HOLDING] or states == [
        CompositeState.STOPPING,
        HOLDING,
    ]
    speeds = [m.reference_velocity[0] for m in reported]
    assert speed > 0.2 and speeds[-1] == 0.0
    assert max(abs(b - a) for a, b in pairwise(speeds)) < 0.01  # no jump
    assert {m.mode for m in arm.torques.messages if m.session == session and m.sequence > 10} == {
        JointTorque.ENABLED
    }
    assert arm.state.rejected_reason == "~/stop was called"
    check_move(arm, arm.state.reference_position[0] + 0.03, 0.3)


def test_the_fast_control_can_be_taken_out_and_put_back(moving):
    arm = moving
    for wanted in (False, True):
        assert arm.bench.call(SetBool, "controller/enable_fast", data=wanted).success
        arm.run(0.2)
        fast = [m.fast_torque[0] for m in arm.states.messages[-50:]]
        assert any(fast) == wanted
    assert arm.state.supervisor_state == CompositeState.TRACKING


def test_recover_without_a_fault_and_stop_without_torque_change_nothing(moving):
    arm, stands = moving, moving.state.sequence
    assert not arm.recover()
    assert (arm.state.sequence, arm.state.supervisor_state) == (stands, CompositeState.TRACKING)
    arm.bench.set("controller", strain_limit=1e-9)
    arm.pause(False)
    arm.bench.wait_for("a fault", lambda: arm.state.supervisor_state == FAULT)
    assert "strain of root is" in arm.state.rejected_reason
    answer = arm.bench.call(Trigger, "controller/stop")
    assert answer.success and "there is no torque" in answer.message
    arm.publish_trajectory(trajectory(J, (1.0, [0.2])))
    arm.bench.wait_for(
        "the refusal", lambda: "in fault, call ~/recover first" in arm.bench.log("controller")
    )
    arm.bench.set("controller", strain_limit=0.0)
    assert arm.recover()
