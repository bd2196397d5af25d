# SPDX-License-Identifier: Apache-2.0
"""The tutorial's lessons, typed as they stand: files written, commands run in order, in a directory of their own.

In a lesson, a block whose first line is ``# file: NAME`` is that file; in a ``console`` block, ``$`` is a command and
``1$``, ``2$``, … one that goes on running in a shell of its own (here a node, in lockstep), the lines below a command
what it must print, in this order, each somewhere in a line. A command that prints ``flexarm NAME: …`` as its first line
must be refused, with this line. A block marked ``real-time`` is only looked at:
`test_driver_template.py` runs the like of it.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from flexarm_bringup import cli
from flexarm_tools.running.lockstep import LockstepRun
from flexarm_tools.running.processes import Processes, executable, own_domain

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
LESSONS = ROOT / "docs" / "tutorial"
BLOCK = re.compile(r"^```(\w+)( real-time)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PROMPT = re.compile(r"(\d*)\$ (.*)")
#: On a machine that may hold it up for seconds.
PATIENCE = ["-p", "state_timeout:=60.0", "-p", "max_gap:=60.0"]


def blocks(lesson):
    """Blocks of a lesson: kind, whether in real time, text."""
    text = (LESSONS / f"{lesson}.md").read_text("utf-8")
    return [(kind, bool(real_time), body) for kind, real_time, body in BLOCK.findall(text)]


def commands(body):
    """Commands of a console block: shell, command, what it must print."""
    found = []
    for line in body.splitlines():
        match = PROMPT.fullmatch(line)
        if match:
            found.append((match[1], match[2], []))
        else:
            found[-1][2].append(line)
    return found


class Desk:
    """A directory that looks like the repository, and the shells of one who types a lesson there."""

    def __init__(self, directory, processes):
        self.directory, self.processes = directory, processes
        self.environment = {**os.environ, "ROS_DOMAIN_ID": str(processes.domain)}
        self.environment["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        for name in ("config", "examples", "src"):
            (directory / name).symlink_to(ROOT / name)
        # The workspace is built and its environment set: `flexarm` and `env.sh` have nothing else to do.
        flexarm = directory / "flexarm"
        flexarm.write_text(f'#!/bin/sh\nexec {sys.executable} -m flexarm_bringup.cli "$@"\n')
        flexarm.chmod(0o755)
        (directory / "tools").mkdir()
        (directory / "tools" / "env.sh").write_text("")

    def write(self, body):
        """Write the file of a block."""
        first, _, text = body.partition("\n")
        name = re.fullmatch(r"# file: (results/tutorial/[\w./]+)", first)[1]
        (self.directory / name).parent.mkdir(parents=True, exist_ok=True)
        (self.directory / name).write_text(text)

    def start(self, command):
        """Start a node in a shell of its own."""
        run, _, package, name, *rest = shlex.split(command)
        assert run == "./flexarm"
        rest = [*rest, *(PATIENCE if name == "controller" else [])]
        self.processes.start(name, [executable(package, name), *rest])
        if set(self.processes.running) == {"simulator", "observer", "controller"}:
            with LockstepRun(self.processes) as line:
                line.wait_for("the nodes", lambda: line.recorder.complete() and line.ready())

    def type(self, command, printed):
        """Run a command in the shell of the lesson, which keeps what it exports."""
        script = f"set -e\n{command}\nenv -0 > .environment"
        done = subprocess.run(
            ["bash", "-c", script],
            cwd=self.directory,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=300,
        )
        refused = bool(printed) and re.match(r"flexarm \w+: ", printed[0]) is not None
        assert (done.returncode != 0) == refused, f"{command}\n{done.stdout}"
        at = 0
        for line in printed:
            at = done.stdout.find(line, at)
            assert at >= 0, f"{command}\nprinted no {line!r}, or too early:\n{done.stdout}"
            at += len(line)
        if refused:
            return
        pairs = (self.directory / ".environment").read_text().split("\0")
        self.environment = dict(pair.split("=", 1) for pair in pairs if "=" in pair)


@pytest.mark.parametrize(
    "lesson", ["first_move", "own_arm", "two_links", "own_law", "own_driver", "tuning"]
)
def test_a_lesson_works_as_it_is_typed(lesson, tmp_path):
    log = tmp_path / "log"
    typed = 0
    with own_domain() as domain, Processes(domain, log) as processes:
        (tmp_path / "desk").mkdir()
        desk = Desk(tmp_path / "desk", processes)
        for kind, real_time, body in blocks(lesson):
            if body.startswith("# file:"):
                desk.write(body)
            elif kind == "console" and not real_time:
                for shell, command, printed in commands(body):
                    typed += 1
                    if shell:
                        desk.start(command)
                    else:
                        desk.type(command, printed)
            else:
                assert kind in ("sh", "console"), f"{lesson}: a block of {kind} that is no file"
    assert typed >= 3


def test_commands_that_are_not_run_are_at_least_commands():
    checked = 0
    for lesson in sorted(path.stem for path in LESSONS.glob("*.md")):
        for kind, real_time, body in blocks(lesson):
            for _, command, _ in commands(body) if kind == "console" and real_time else ():
                words = shlex.split(command)
                checked += 1
                if words[0] == "./flexarm":
                    options = cli.parser().parse_args(words[1:])
                    if options.command == "run":
                        executable(options.package, options.executable)
                else:
                    module = words[2].replace(".", "/") + ".py"
                    assert words[:2] == ["python", "-m"]
                    assert (ROOT / "examples" / "flexarm_driver_template" / module).is_file()
    assert checked >= 5


def test_every_lesson_is_listed():
    index = (LESSONS / "index.md").read_text("utf-8")
    lessons = {path.stem for path in LESSONS.glob("*.md")} - {"index"}
    assert set(re.findall(r"\]\((\w+)\.md\)", index)) == lessons
