# SPDX-License-Identifier: Apache-2.0
"""The nodes on a recording, as on the arm: `replay` in the place of the driver, in lockstep."""

import json
import subprocess
from functools import partial

import numpy as np
import pytest
from in_process import InProcess

from flexarm_msgs.msg import ArmState
from flexarm_studies.loop import scenario
from flexarm_tools.recording import bag
from flexarm_tools.recording.loop_bag import LoopBag
from flexarm_tools.running.processes import Processes, environment, executable, own_domain

OBSERVER = {"arm": "R", "observer.type": "luenberger", "rate": 500.0}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A bag of a short motion under control, with the observer's estimates."""
    folder = tmp_path_factory.mktemp("replay") / "bag"
    settings = ("observer.type=luenberger",)
    run = scenario.Scenario(
        "R", scenario.parameters("composite", settings), "quintic:to=0.3,duration=0.6", rate=500.0, duration=0.8
    )  # fmt: skip
    scenario.run_loop(run, partial(LoopBag, folder))
    return folder


def played(bench):
    return bench.nodes["replay"].playback


def test_the_observer_estimates_from_a_recording_what_it_did_on_the_arm(recorded):
    (contents,) = bag.read(recorded)
    wanted = contents.tables["arm_state_estimate"]
    with InProcess() as bench:
        bench.start("observer", OBSERVER)
        estimates = bench.tap(ArmState, "arm_state_estimate")
        bench.start("replay", {"arm": "R", "recording": str(recorded), "lockstep": "observer"})
        bench.wait_for("the end", lambda: played(bench).over)
        bench.wait_for("the last estimate", lambda: len(estimates.messages) >= len(played(bench)))
        got = np.array([m.modal_rate for m in estimates.messages[-200:]])
        amplitude = np.array([m.modal_amplitude for m in estimates.messages[-200:]])
        position = played(bench).position[-1]
    last = np.flatnonzero(
        (contents.tables["arm_state"].columns["joint_position"] == position).all(axis=1)
    )[-1]
    at = slice(last - 199, last + 1)
    np.testing.assert_array_equal(amplitude, wanted.columns["modal_amplitude"][at])
    scale = np.nanmax(np.abs(wanted.columns["modal_rate"]))
    np.testing.assert_allclose(got, wanted.columns["modal_rate"][at], atol=1e-9 * scale)


def test_a_controller_answers_and_moves_nothing(recorded):
    with InProcess() as bench:
        bench.start("observer", OBSERVER)
        bench.start("controller", {"arm": "R", "rate": 500.0, "torque_mismatch": 0.0})
        states = bench.tap(ArmState, "arm_state")
        bench.start("replay", {"arm": "R", "recording": str(recorded), "lockstep": "controller"})
        last = len(played(bench)) - 1
        bench.wait_for("the end", lambda: states.newest and states.newest.sequence == last)
        found, measured = played(bench).summary(), played(bench).position
        assert {m.controller_id for m in states.messages} == {0}
    assert (
        found["answered"] > 0.5 * found["samples"] and found["sent_less_measured_rms_Nm"][0] > 0.0
    )
    first = {m.sequence: m.joint_position[0] for m in states.messages}
    np.testing.assert_array_equal([first[k] for k in range(len(measured))], measured[:, 0])


def test_the_command_plays_to_the_end_over_dds(recorded, tmp_path):
    with own_domain() as domain, Processes(domain, tmp_path / "logs") as processes:
        processes.start_node("observer", OBSERVER)
        words = [executable("flexarm_bringup", "flexarm"), "replay", str(recorded), "R"]
        done = subprocess.run(
            [*words, "--lockstep", "observer", "--duration", "0.2", "--json"],
            env=environment(domain), capture_output=True, text=True, timeout=90, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["played"] == 101
