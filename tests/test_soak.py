# SPDX-License-Identifier: Apache-2.0
"""A short soak and a few malformed messages to running nodes; `make soak` and `make fuzz` do it at length."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

# The folders are no packages of the workspace.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_ros.messages import set_stamp
from soak.invariants import Invariants
from soak.walk import walk

ROOT = Path(__file__).resolve().parents[1]


def run(module, *options):
    """Lines that a command prints, in a process of its own; it must end well.

    What is left here of other tests' nodes must not end it, and a crash there must not end this process.
    """
    words = [sys.executable, "-W", "ignore", "-X", "faulthandler", "-m", module, *options]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.splitlines()


@pytest.mark.long
def test_a_short_life_with_faults_breaks_no_invariant():
    # This seed's first round has three faults, a new gain, a refused one and a stop.
    lines = run("soak", "--rounds", "1", "--minutes", "60", "--seed", "103")
    count = {line[:36].strip(): line[36:] for line in lines}
    for name in ("rounds", "healthy motions", "parameters refused"):
        assert count[name] == "1"
    assert int(count["enabled"]) > 1000


@pytest.mark.long
def test_a_random_walk_through_transitions_services_and_parameters_ends_in_a_motion():
    lines, good = walk(3, 200, lambda text: None)
    assert good, "\n".join(lines)
    count = dict(line.rsplit(maxsplit=1) for line in lines)
    assert int(count["transition"]) > 20 and int(count["wrong transition"]) > 10
    assert int(count["enabled"]) > 200 and int(count["parameters refused"]) > 3


def estimate(sequence, rate=0.0):
    """An estimate of arm R."""
    msg = ArmState(session=1, sequence=sequence)
    msg.joint_position, msg.joint_velocity = [0.0], [0.0]
    msg.modal_amplitude, msg.modal_rate = [0.0, 0.0], [rate, 0.0]
    return msg


def torque(sequence, value, mode=JointTorque.ENABLED):
    """The torque that answers it."""
    msg = JointTorque(session=1, sequence=sequence, mode=mode, torque=[value])
    set_stamp(msg.header.stamp, 10**9 + 10**6 * sequence)
    return msg


@pytest.mark.parametrize(
    "wrong, what",
    [
        (torque(2, np.nan), "torque finite"),
        (torque(2, 30.0), "torque within its limit"),
        (torque(2, 6.5), "torque within its rate"),
        (torque(2, 1.0, JointTorque.DISABLED), "disabled is zero"),
        (torque(0, 1.0), "answers in order"),
        (torque(3, 1.0), "enabled with a valid state alone"),
    ],
)
def test_every_broken_invariant_is_seen(wrong, what):
    judge = Invariants([20.0], [5000.0])
    for k in range(3):
        judge.estimate(estimate(k))
    judge.estimate(estimate(3, np.nan))
    judge.torque(torque(1, 1.0))
    judge.torque(torque(1, 1.0))  # sent again
    assert not judge.broken
    judge.torque(wrong)
    assert judge.broken[what] == 1 and what in judge.first


def test_a_fault_with_a_torque_is_seen():
    judge = Invariants([20.0], [5000.0])
    judge.state(CompositeState(supervisor_state=CompositeState.FAULT, torque=[1.0]))
    assert judge.broken == {"no torque in fault": 1}


def test_running_nodes_survive_malformed_messages():
    lines = run("fuzz", "--inputs", "0", "--dds", "60")
    sent = [int(line.split()[2]) for line in lines if line.startswith("DDS ")]
    assert len(sent) == 6 and sum(sent) >= 50, lines
