# SPDX-License-Identifier: Apache-2.0
"""Lockstep: the same inputs give the same samples, to the last bit, whatever else the machine does."""

import contextlib
import os
import subprocess
import sys

import pytest
from in_process import InProcess
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

from flexarm_control.motions import profiles
from flexarm_dynamics.arm import arm_file
from flexarm_msgs.msg import CompositeState
from flexarm_studies.case_study import runs as case_study
from flexarm_studies.loop import closed_loop
from flexarm_tools.case_study import nodes
from flexarm_tools.recording import recorder
from flexarm_tools.running import lockstep, relay
from flexarm_tools.running.processes import Processes, own_domain

RUN = case_study.Run("R", "m11", "composite", "observer")


def record(directory, duration, run=RUN, repeats=1):
    """Samples and timing of lockstep runs of three new processes, which the simulator's reset begins anew."""
    found = []
    with own_domain() as domain, Processes(domain, directory) as processes:
        nodes.start_nodes(processes, run)
        joints = arm_file.load(run.arm).joint_names
        message = lockstep.trajectory_message(
            joints, profiles.paper_profile(), 101, closed_loop.TRAJECTORY_START_NS
        )
        for repeat in range(repeats):
            with lockstep.LockstepRun(processes) as line:
                if repeat:
                    restart(line)
                found.append(line.run(message, duration))
    return found


def restart(line):
    """Reset the simulator, and recover: an arm that is elsewhere all at once is a fault."""
    assert line.call(Trigger, "simulator/reset").success
    line.wait_for(
        "the fault", lambda: line.controller_state().supervisor_state == CompositeState.FAULT
    )
    assert line.call(Trigger, "controller/recover").success


def in_this_process(duration, run=RUN):
    """Samples of the same nodes on a queue in place of DDS, see `in_process`."""
    joints, start = arm_file.load(run.arm).joint_names, closed_loop.TRAJECTORY_START_NS
    with InProcess() as bench:
        nodes.start_nodes(bench, run)
        message = lockstep.trajectory_message(joints, profiles.paper_profile(), 101, start)
        return bench.record(message, duration)


#: What tells one run from another, or depends on the wall clock: how long it took, and whether a state was sent again.
IDENTITY = {"session", "controller_id", "accepted_trajectory_id", "compute_time", "clock_stopped"}


def without_identity(samples):
    """Every field of every sample, floats as bytes; serialised messages differ in their padding."""
    return {
        topic: [
            fields(deserialize_message(raw, recorder.TOPICS[topic])) for raw in messages.values()
        ]
        for topic, messages in samples.items()
    }


def fields(message):
    """Name to value, arrays and floats as bytes: -0.0 is not 0.0, NaN equals the same NaN."""
    out = {}
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        if name in IDENTITY:
            continue
        if hasattr(value, "get_fields_and_field_types"):
            value = fields(value)
        elif hasattr(value, "tobytes"):
            value = value.tobytes()
        out[name] = value
    return out


@contextlib.contextmanager
def loaded_cpu():
    """One processor kept busy."""
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        with contextlib.suppress(AttributeError, OSError):
            os.sched_setaffinity(busy.pid, {min(os.sched_getaffinity(0))})
        yield
    finally:
        busy.kill()
        busy.wait()


@pytest.mark.long
def test_five_runs_give_the_same_samples_bit_for_bit_with_and_without_one_cpu_loaded(tmp_path):
    runs = record(tmp_path / "0", 0.2, repeats=2)
    with loaded_cpu():
        runs += record(tmp_path / "1", 0.2, repeats=2)
    runs.append((in_this_process(0.2), None))
    first, *others = (without_identity(samples) for samples, _ in runs)
    assert len(others) == 4 and all(len(messages) == 301 for messages in first.values())
    for i, again in enumerate(others, 1):
        for topic, messages in first.items():
            assert again[topic] == messages, f"run {i}, {topic}"


@pytest.mark.real_time
def test_lockstep_costs_at_most_2_2_of_a_bare_relay(tmp_path):
    # It was 1.6 before the observer checked its readings, which costs as much as an update of `kalman`.
    # Interleaved, medians; a noisy machine gets three chances, a slow product none.
    ratios = []
    for _ in range(3):
        bare = [relay.measure("R", tmp_path / "relay", 1000, lockstep.LockstepRun)]
        loop = record(tmp_path / "loop", 1.0)[0][1].seconds_per_sample
        bare.append(relay.measure("R", tmp_path / "relay", 1000, lockstep.LockstepRun))
        ratios.append(loop / (sum(bare) / 2.0))
        if ratios[-1] <= 2.2:
            return
    pytest.fail(f"lockstep wall time is {ratios} of a bare relay's")
