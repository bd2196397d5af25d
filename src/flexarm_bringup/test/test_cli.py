# SPDX-License-Identifier: Apache-2.0
"""What holds for every command alike: help with examples that parse, exit codes, JSON, plain text in pipes."""

import json
import os
import shlex
import subprocess
import sys

import pytest

from flexarm_bringup import cli
from flexarm_tools.recording.record import Taken

COMMANDS = sorted(next(a for a in cli.parser()._actions if getattr(a, "choices", None)).choices)
#: They go on until they are stopped: what they have to say is in the log, or on a page.
WITHOUT_JSON = {"arms", "run", "vibration", "view"}  # arms and vibration write JSON lines: --out


@pytest.fixture
def printed(flexarm):
    """Runs a command that must succeed: its standard output."""

    def run(*words):
        code, out, err = flexarm(*words)
        assert code == 0, err
        return out

    return run


@pytest.fixture(params=COMMANDS)
def command(request):
    return request.param


def test_help_ends_with_examples_and_exit_codes(command, printed):
    text = printed(command, "--help")
    tail = text[text.rindex("example") :]
    assert "exit code: 0 done, 1 an error" in " ".join(tail.split())
    examples = [line.split("flexarm ", 1)[1] for line in tail.splitlines() if "flexarm " in line]
    assert examples
    for example in examples:  # one line each, as it is typed
        options = cli.parser().parse_args(cli.bind_angles(shlex.split(example)))
        assert options.command == command


def test_commands_that_end_can_say_it_as_json(command, printed):
    assert ("--json" in printed(command, "--help")) == (command not in WITHOUT_JSON)


def test_every_command_is_listed_with_a_line_of_its_own(printed):
    text = printed("--help")
    for name in COMMANDS:
        assert any(line.split()[:1] == [name] for line in text.splitlines())


@pytest.mark.parametrize(
    "words, key",
    [
        (["urdf", "R", "--pieces", "2"], "joints"),
        (["publish", "quintic", "--duration", "0.2", "--dry-run"], "vibration_energy_J"),
        (["publish", "paper", "--out", "{tmp}/paper.csv"], "points"),
        (["parameters"], "controller"),
        (["show", "R"], "modes"),
        (["frequencies", "R"], "arm"),
    ],
)
def test_json_is_all_that_standard_output_gets(words, key, tmp_path, printed):
    words = [word.format(tmp=tmp_path) for word in words]
    assert key in json.loads(printed(*words, "--json"))


def test_a_dry_run_says_the_same_in_both_ways(printed):
    words = ["publish", "quintic", "--to", "0.1", "--duration", "0.2", "--dry-run"]
    people, machines = printed(*words), json.loads(printed(*words, "--json"))
    (joint,) = machines["joints"]
    assert f"slow torque {joint['peak_slow_torque_Nm']:.4g} N m" in people
    assert f"{machines['vibration_energy_J']['left_at_the_end']:.3g} J left" in people


def test_a_recording_is_described_as_json(capsys):
    class Bag:
        def write(self, *message):
            pass

    taken = Taken(Bag(), "R")
    taken.take({"arm_state": [b"a", b"b"]}, 1_000_000_000)
    taken.take({"joint_torque": [b"c"]}, 3_500_000_000)
    taken.report("there", as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert (printed["out"], printed["arm"], printed["seconds"]) == ("there", "R", 2.5)
    assert (printed["messages"]["arm_state"], printed["messages"]["joint_torque"]) == (2, 1)


def test_a_reader_that_has_enough_is_no_error():
    code = "from flexarm_bringup import cli; cli.main(['parameters'])"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=dict(os.environ),
    )
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 141
    process.stderr.close()


def test_a_command_that_there_is_not_is_named_with_the_one_that_may_be_meant(flexarm):
    code, _, err = flexarm("simulat", "R")
    assert code == 2
    assert "'simulat' is no command; did you mean simulate?" in err
    assert "flexarm --help lists the commands" in flexarm("xyzzy")[2]
