# SPDX-License-Identifier: Apache-2.0
"""An arm in a few lines of Python, over ROS: started, joined, moved, stopped, recorded."""

import re
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from harness import Arm as Topics
from harness import Bench

from flexarm_ros.session import WaitError
from flexarm_studies.loop.arm import MotionError
from flexarm_tools.arm import Arm
from flexarm_tools.running.processes import environment, own_domain

ROOT = Path(__file__).resolve().parents[1]

FAST = {"rate": 500.0}


def test_an_arm_is_started_moved_recorded_and_stopped():
    seen = []
    with Arm("R", join=False, parameters=FAST, progress=seen.append) as arm:
        with arm.recording() as run:
            arrival = arm.move(0.3, 1.0)
        assert arrival.tip_swing <= 1e-3 * 1.2192 and arrival.seconds > 0.9
        assert seen == sorted(seen) and len(seen) >= 1
        record = run.record
        np.testing.assert_allclose(record.reference[-1], 0.3, atol=1e-9)
        assert len(record.time) >= 0.9 * 500.0 * 1.0
        assert np.diff(record.time).min() > 0.0
        with pytest.raises(MotionError, match="more than the torque limit"):
            arm.move(3.0, 0.5)
        arm.stop()
        assert arm.state.supervisor in ("READY", "HOLDING") and not arm.recover()


@pytest.mark.long
def test_a_running_loop_is_joined_and_goes_on_afterwards(tmp_path, monkeypatch):
    with Bench(tmp_path) as bench:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(bench.domain))
        bench.start_loop(arm="R", pause_at=-1.0, design_process=False, lockstep=True, **FAST)
        bench.start("goals", {"arm": "R"})
        Topics(bench).wait_ready()
        with Arm(join=True) as arm:
            assert arm.arm.name == "R"
            arm.move(0.1, 1.0)
            np.testing.assert_allclose(arm.state.reference, [0.1], atol=1e-9)
        bench.check()


@pytest.mark.long
def test_the_example_moves_an_arm_and_draws_it(tmp_path):
    with own_domain() as domain:  # nothing runs there
        done = subprocess.run(
            [sys.executable, ROOT / "examples" / "move.py"],
            cwd=tmp_path,
            env=environment(domain),
            capture_output=True,
            text=True,
            timeout=300,
        )
    assert done.returncode == 0, done.stderr
    assert re.search(r"at rest after \d+\.\d+ s: the tip swings by .* mm\nmove.png\n", done.stdout)
    assert (tmp_path / "move.png").stat().st_size > 10_000


def test_the_guides_lines_are_those_of_the_modules():
    text = (ROOT / "docs" / "guide.md").read_text()
    (block,) = re.findall(r"```python\n(from flexarm_tools\.arm .*?)```", text, re.DOTALL)
    assert textwrap.indent(block.strip(), "    ") in sys.modules["flexarm_tools.arm"].__doc__


def test_where_nothing_runs_there_is_nothing_to_join(tmp_path, monkeypatch):
    monkeypatch.setattr("flexarm_tools.arm.MUST_JOIN", 2.0)
    with Bench(tmp_path) as bench:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(bench.domain))
        with pytest.raises(WaitError, match="there is no controller/state to join"):
            Arm("R", join=True)
        with pytest.raises(WaitError, match="there is no arm to join"):
            Arm()
