# SPDX-License-Identifier: Apache-2.0
"""Observer and controller in one process; processes that end with the one that started them."""

import os
import re
import signal
import subprocess
import sys
from collections import ChainMap

import pytest
from harness import Bench
from in_process import InProcess
from test_lockstep import without_identity

from flexarm_control.motions import profiles
from flexarm_studies.loop import closed_loop
from flexarm_tools.recording import recorder
from flexarm_tools.running import lockstep
from flexarm_tools.running.processes import Processes, own_domain

GIVEN = {"arm": "R", "lockstep": True, "state_timeout": 60.0, "observer.type": "kalman"}


def test_one_process_gives_every_sample_of_three_nodes_to_the_last_bit(tmp_path):
    """The default control on R over 0.3 s of the paper's motion, in lockstep; `test_lockstep` has three processes."""
    start = closed_loop.TRAJECTORY_START_NS
    message = lockstep.trajectory_message(("joint1",), profiles.paper_profile(), 101, start)
    with InProcess() as bench:
        bench.start_loop(**GIVEN)
        three = without_identity(bench.record(message, 0.3))
    with own_domain() as domain, Processes(domain, tmp_path) as processes:
        for name, of in (
            ("simulator", ("simulator",)),
            ("observer_controller", ("observer", "controller")),
        ):
            keep = (recorder.keep_for_recording(node) for node in of)
            processes.start_node(name, dict(ChainMap(GIVEN, *keep)))
        with lockstep.LockstepRun(processes) as line:
            two = without_identity(line.run(message, 0.3)[0])
        assert processes.stop() == {"simulator": 0, "observer_controller": 0}
    assert len(three["joint_torque"]) == 401
    assert len({sample["torque"] for sample in three["joint_torque"]}) > 200  # it moves
    for topic, messages in three.items():
        assert two[topic] == messages, topic


def test_both_nodes_of_one_process_keep_names_parameters_and_life_cycle(tmp_path):
    with Bench(tmp_path) as bench:
        cpu = max(os.sched_getaffinity(0))
        given = {"arm": "R", "cpu_affinity": [cpu], "observer.type": "luenberger"}
        process = bench.start("observer_controller", given)
        assert bench.get("observer", "observer.type") == "luenberger"
        assert bench.get("controller", "slow.kp") == [6.25]
        assert bench.set("controller", slow__kp=[9.0])[0].successful
        assert bench.get("controller", "slow.kp") == [9.0]
        assert bench.get("observer", "slow.kp") is None
        refusal = bench.set("observer", cpu_affinity=[0])[0]
        assert not refusal.successful
        for thread in os.listdir(f"/proc/{process.pid}/task"):
            assert os.sched_getaffinity(int(thread)) == {cpu}
        for node in ("observer", "controller"):
            assert bench.lifecycle(node) == "active"
        assert bench.change("controller", "deactivate")
        assert bench.lifecycle("observer") == "active"


PARENT = """
import os, signal, sys
from flexarm_tools.running.processes import Processes, own_domain
with own_domain() as domain, Processes(domain, sys.argv[1]) as processes:
    for key in ("first", "second"):
        print(processes.start_node("observer", {"arm": "R"}).pid, flush=True)
        if key == "first":
            sys.stdin.readline()  # written when the first one runs
    os.kill(os.getpid(), signal.SIGKILL)
"""


def alive(pid):
    """Whether a process runs: not gone, and not a zombie."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return not re.search(r"\) [ZX]", file.read())
    except OSError:
        return False


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="PR_SET_PDEATHSIG is Linux's")
def test_a_killed_parent_leaves_no_nodes_behind_running_or_just_started(tmp_path):
    with Bench(tmp_path / "bench") as bench:
        command = [sys.executable, "-c", PARENT, str(tmp_path)]
        parent = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        first = int(parent.stdout.readline())
        log = tmp_path / "observer.log"
        bench.wait_for("the first node to run", lambda: "observer" in log.read_text())
        assert alive(first)
        second = int(parent.communicate("go\n")[0])
        assert parent.wait() == -signal.SIGKILL
        for pid in (first, second):
            bench.wait_for(f"process {pid} to end", lambda pid=pid: not alive(pid))
