# SPDX-License-Identifier: Apache-2.0
"""Faults of the simulator: who may set them, and that they are on arm_state."""

import numpy as np
import pytest
from harness import Drive
from in_process import InProcess

from flexarm_ros.messages import stamp_ns

OWN = {"lockstep": True, "pause_at": -1.0, "resend_period": 0.02}


@pytest.fixture(scope="module")
def simulated():
    """A simulator that takes faults, answered by this process, and beside it one that takes none."""
    with InProcess() as bench:
        bench.start("simulator", {"arm": "R", **OWN}, key="plain", remaps=["__ns:=/plain"])
        own = {"allow_faults": True, "publish_modal_amplitude": False}
        bench.start("simulator", {"arm": "R", **OWN, **own})
        yield Drive(bench)


@pytest.fixture
def drive(simulated):
    """The simulator without faults, after a reset."""
    faults(simulated, [])
    simulated.reset()
    return simulated


def faults(drive, lines):
    result = drive.bench.set("simulator", faults=lines)[0]
    assert result.successful, result.reason


def answer(drive, torque=0.1):
    """Answer the newest state, and return the one after it, whatever its number is."""
    state = drive.state
    drive.send(
        session=state.session,
        sequence=state.sequence,
        mode=1,
        joint_names=["joint1"],
        torque=[torque],
    )
    drive.bench.wait_for("another state", lambda: drive.states.newest.sequence != state.sequence)
    drive.state = drive.states.newest
    return drive.state


def test_faults_are_refused_unless_allowed(drive):
    result = drive.bench.set("plain/simulator", faults=["strain nan"])[0]
    assert not result.successful and "allow_faults:=true" in result.reason
    assert drive.bench.set("plain/simulator", faults=[])[0].successful


def test_a_bad_fault_is_refused_and_nothing_of_the_set_is_taken(drive):
    result = drive.bench.set("simulator", faults=["strain nan", "strain.root break"])[0]
    assert not result.successful and "'break'" in result.reason
    # Found by fuzzing: a number ended the node.
    assert not drive.bench.set("simulator", faults=3.5)[0].successful
    state = answer(drive)
    assert np.isfinite(state.strain).all() and list(state.modal_amplitude) == []
    assert list(drive.bench.get("simulator", "faults")) == []


def test_faults_of_values_names_and_stamps_reach_arm_state_and_end(drive):
    lines = ["joint_position.joint1 nan", "strain.root bias by=1.0", "names reorder"]
    faults(drive, [f"{line} from=0.002 for=0.002" for line in [*lines, "state future by=0.5"]])
    states = [drive.state, *(answer(drive) for _ in range(5))]
    assert [s.sequence for s in states] == list(range(6))
    for k, state in enumerate(states):
        faulty = k in (2, 3)
        assert np.isnan(state.joint_position[0]) == faulty
        assert list(state.gauge_names) == (["middle", "root"] if faulty else ["root", "middle"])
        assert (state.strain[1 if faulty else 0] > 0.5) == faulty
        assert stamp_ns(state.header.stamp) == 1_000_000_000 + k * 1_000_000 + faulty * 500_000_000


def test_a_lost_state_is_a_gap_over_which_the_last_torque_acts(drive):
    faults(drive, ["state drop from=0.002 for=0.003"])
    answer(drive, 1.0)
    state = answer(drive, 2.0)
    assert state.sequence == 5
    assert list(state.joint_torque) == [2.0]
    # ... which gets too old in the end: then the safe action
    faults(drive, ["state drop from=0.006 for=0.1"])
    state = answer(drive, 2.0)
    assert state.sequence == 106
    assert list(state.joint_torque) == [0.0]
    faults(drive, ["state delay by=0.003 from=0.107"])
    assert answer(drive).sequence == 107
