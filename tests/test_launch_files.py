# SPDX-License-Identifier: Apache-2.0
"""The launch files with the real `ros2 launch`, where there is one: the wheels have none."""

import os
import re
import signal
import subprocess
import sys

import pytest

from flexarm_msgs.msg import CompositeState

pytest.importorskip("ros2launch", reason="needs `ros2 launch`, of a ROS installation")
ROS2 = [sys.executable, "-c", "import sys; from ros2cli.cli import main; sys.exit(main())"]
FILES = ("arm", "two_arms", "driver", "case_study")


def command(name, *words):
    """A command line of ros2 launch."""
    return [*ROS2, "launch", "flexarm_bringup", f"{name}.launch.py", *words]


@pytest.mark.parametrize("name", FILES)
def test_show_args_describes_every_argument(name):
    done = subprocess.run(command(name, "--show-args"), capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    arguments = re.split(r"\n    '", done.stdout)[1:]
    assert len(arguments) >= 5
    for text in arguments:
        title, described, *_ = text.splitlines()
        assert len(described.strip()) > 15 and "(default" not in described, title


def test_arm_launch_starts_a_loop_that_answers_and_ends_whole_with_sigint(bench):
    words = ("lockstep:=true", "namespace:=left", "controller:=paper_slow")
    launched = bench.processes.start("launch", command("arm", *words))
    states = bench.tap(CompositeState, "left/controller/state")
    bench.wait_for("a controller that is ready", lambda: states.newest and states.newest.sequence)
    children = descendants(launched.pid)
    assert len(children) == 3
    # To the whole group, as Ctrl-C in a terminal does.
    bench.processes.expect_end("launch")
    os.killpg(launched.pid, signal.SIGINT)
    assert bench.end_of("launch") == 0
    assert not [pid for pid in children if os.path.exists(f"/proc/{pid}")]
    log = bench.log("launch")
    assert log.count("process has finished cleanly") == 3, log
    assert "Traceback" not in log


def descendants(pid):
    """Processes that a process started, and those that they did."""
    with open(f"/proc/{pid}/task/{pid}/children") as file:
        children = [int(word) for word in file.read().split()]
    return children + [below for child in children for below in descendants(child)]
