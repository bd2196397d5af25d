# SPDX-License-Identifier: Apache-2.0
"""Every command of the README and the guide: what it starts exists, what it publishes moves the arm."""

import contextlib
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from builtin_interfaces.msg import Duration
from harness import Arm
from in_process import InProcess
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import get_parameter_value
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.serialization import deserialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_bringup import cli, launching
from flexarm_msgs.msg import CompositeState
from flexarm_tools import parameter_tables
from flexarm_tools.running.lockstep import LockstepRun
from flexarm_tools.running.processes import Processes, executable, installed, own_domain

ROOT = Path(__file__).resolve().parents[1]
README = "".join(
    (ROOT / page).read_text(encoding="utf-8") for page in ("README.md", "docs/guide.md")
)
PARAMETERS = ROOT / "docs" / "parameters.md"
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README, re.DOTALL)
LINES = [line.strip() for kind, text in BLOCKS if kind == "sh" for line in text.splitlines()]
COMMANDS = [line for line in LINES if line]


def words_of(command):
    return shlex.split(command)


def starting(*prefix):
    """Commands of README and guide that begin with these words."""
    return [c for c in COMMANDS if words_of(c)[: len(prefix)] == list(prefix)]


def check_files(words):
    for i, word in enumerate(words):
        if word == "--params-file":
            assert (ROOT / words[i + 1]).is_file(), words[i + 1]
        if word.startswith("arm:=") and "/" in word:
            assert (ROOT / word[5:]).is_file(), word


@pytest.mark.parametrize("command", COMMANDS)
def test_what_a_command_names_exists(command):
    words = words_of(command)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif words[0] == ".":
        assert (ROOT / words[1]).is_file()
    elif words[0] == "./flexarm":
        assert os.access(ROOT / "flexarm", os.X_OK)
        options = cli.parser().parse_args(words[1:])
        if options.command == "run":
            executable(options.package, options.executable)
            check_files(options.arguments)
    elif words[:3] == ["ros2", "launch", "flexarm_bringup"]:
        text = installed("share", *words[2:3], "launch", words[3]).read_text()
        arguments = getattr(launching, re.search(r"launching\.([A-Z_]+)", text).group(1))
        given = dict(word.split(":=") for word in words[4:])
        starts = getattr(launching, re.search(r"launching\.([a-z_]+)\)", text).group(1))
        assert set(given) <= set(arguments)
        assert starts({name: a.default for name, a in arguments.items()} | given)
    elif words[:2] == ["ros2", "topic"]:
        assert words[2] == "pub"
    elif words[:3] == ["ros2", "param", "set"]:
        assert len(words) == 6
    else:
        pytest.fail(f"no test knows this command: {command}")


def test_executables_and_launch_files_named_in_the_text_are_installed():
    for package, name in re.findall(r"ros2 run (\w+) (\w+)", README):
        executable(package, name)
    for package, name in re.findall(r"ros2 launch (\w+) ([\w.]+)", README):
        path = installed("share", package, "launch", name)
        compile(path.read_text(), str(path), "exec")


def test_paths_named_in_the_text_exist():
    for path in re.findall(r"`((?:src|config|tools|docs)/[\w/.]+)`", README):
        assert (ROOT / path).exists(), path


def test_parameter_tables_are_those_of_the_declarations():
    text = PARAMETERS.read_text(encoding="utf-8")
    between = text.split(parameter_tables.BEGIN)[1].split(parameter_tables.END)[0]
    assert between.strip() == parameter_tables.tables(), (
        "run: ./flexarm parameters --write docs/parameters.md"
    )


#: So that what a busy machine does to the time has no part in these tests.
PATIENT = {
    "controller": ["-p", "state_timeout:=60.0", "-p", "max_gap:=60.0"],
    "simulator": ["-p", "lockstep:=true", "-p", "pause_at:=-1.0"],
}


@contextlib.contextmanager
def started(commands, directory):
    """The three nodes as processes, by the guide's own commands, in lockstep."""
    with own_domain() as domain, Processes(domain, directory) as processes:
        for command in commands:
            _, _, package, name, *rest = words_of(command)
            rest = [w.replace("config/", f"{ROOT}/config/") for w in rest]
            rest = [*rest, *([] if "--ros-args" in rest else ["--ros-args"])]
            rest += PATIENT.get(name, [])
            processes.start(name, [executable(package, name), *rest])
        assert set(processes.running) == {"simulator", "observer", "controller"}
        with LockstepRun(processes) as line:
            line.wait_for("the nodes", lambda: line.recorder.complete() and line.ready())
            yield line


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """The paper's arm."""
    commands = [c for c in starting("./flexarm", "run") if "paper_composite" in c]
    with started(commands, tmp_path_factory.mktemp("log")) as line:
        yield line


def reference(line):
    line.poll()
    raw = line.recorder.raw["controller/state"][-1]
    return deserialize_message(raw, CompositeState)


def message_from_yaml(text):
    data = yaml.safe_load(text)
    points = [
        JointTrajectoryPoint(**{**p, "time_from_start": Duration(**p["time_from_start"])})
        for p in data["points"]
    ]
    return JointTrajectory(joint_names=data["joint_names"], points=points)


@pytest.mark.parametrize("command", starting("ros2", "topic", "pub"))
def test_topic_pub_example_moves_the_arm_with_stamp_0(arm, command):
    topic, kind, text = [w for w in words_of(command)[3:] if not w.startswith("--")]
    assert kind == "trajectory_msgs/msg/JointTrajectory"
    # What `ros2 topic pub` offers by default.
    qos = QoSProfile(
        depth=10,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=QoSDurabilityPolicy.VOLATILE,
    )
    publisher = arm.node.create_publisher(JointTrajectory, topic, qos)
    arm.wait_for("the controller", lambda: publisher.get_subscription_count() > 0)
    message = message_from_yaml(text)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (0, 0)
    goal = message.points[-1].positions[0]
    before = arm.accepted()
    publisher.publish(message)
    arm.wait_for("acceptance", lambda: arm.accepted() > before)
    arm.wait_for("the end", lambda: abs(reference(arm).reference_position[0] - goal) < 1e-9)

    def there():
        state = reference(arm)
        return abs(state.position_error[0]) < 0.01 and abs(state.velocity_error[0]) < 0.01

    arm.wait_for("the joint to get there", there)
    publisher.publish(message)
    arm.wait_for("a repeat to be seen", lambda: reference(arm).rejected_reason == "")
    assert arm.accepted() == before + 1


@pytest.mark.parametrize("command", starting("ros2", "param", "set"))
def test_param_set_example_is_taken(arm, command):
    node, name, value = words_of(command)[3:]
    client = arm.node.create_client(SetParameters, f"{node}/set_parameters")
    arm.wait_for(f"{node}/set_parameters", client.service_is_ready)
    parameter = ParameterMessage(name=name, value=get_parameter_value(value))
    future = client.call_async(SetParameters.Request(parameters=[parameter]))
    arm.wait_for("the answer", future.done)
    (result,) = future.result().results
    assert result.successful, result.reason
    assert reference(arm).supervisor_state != CompositeState.INACTIVE


def publish(line, command):
    """Run a publish command of the guide beside a running controller."""
    before = line.accepted()
    done = subprocess.run(
        [sys.executable, "-m", "flexarm_bringup.cli", *words_of(command)[1:]],
        cwd=ROOT,
        env={**os.environ, "ROS_DOMAIN_ID": str(line.processes.domain)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    line.wait_for("acceptance", lambda: line.accepted() > before)


def test_publish_command_reaches_the_controller_even_while_the_arm_moves(arm):
    command = starting("./flexarm", "publish")[0]
    publish(arm, command)
    publish(arm, command.replace("1.57", "0.3"))


@contextlib.contextmanager
def in_lockstep(commands, monkeypatch):
    """The nodes of the guide's commands on a queue in this process; `publish` finds them, too."""
    with InProcess() as bench:
        for command in commands:
            _, _, _, name, *rest = words_of(command)
            rest = [w.replace("config/", f"{ROOT}/config/") for w in rest]
            bench.start_with([*rest, *PATIENT.get(name, [])], name)
        found = contextlib.nullcontext(bench)
        monkeypatch.setattr("flexarm_ros.session.Session", lambda *_, **__: found)
        yield Arm(bench)


def call(command):
    """Run a command of the guide in this process."""
    options = cli.parser().parse_args(words_of(command)[1:])
    options.function(options)


@pytest.mark.long
def test_commands_of_the_two_link_arm_move_it(monkeypatch):
    commands = [c for c in starting("./flexarm", "run") if "two_link" in c]
    with in_lockstep(commands, monkeypatch) as arm:
        call(starting("./flexarm", "publish")[2])

        def there():
            errors = [abs(e) for e in arm.state.position_error]
            return abs(arm.state.reference_position[1] - 0.8) < 1e-9 and max(errors) < 0.03

        arm.bench.wait_for("both joints to get there", there)


@pytest.mark.parametrize(
    "command",
    [c for what in ("show", "frequencies", "simulate") for c in starting("./flexarm", what)],
)
def test_commands_without_ros_do_what_they_say(tmp_path, monkeypatch, capsys, command):
    words = words_of(command)[1:]
    monkeypatch.chdir(tmp_path)
    call(command)
    assert any(capsys.readouterr())
    for word in words:
        if word.startswith("results/"):
            assert (tmp_path / word).stat().st_size > 1000


def test_commands_of_your_own_arm_move_it(monkeypatch):
    commands = [c for c in starting("./flexarm", "run") if "--params-file" not in c]
    monkeypatch.chdir(ROOT)
    with in_lockstep(commands, monkeypatch) as arm:
        call(starting("./flexarm", "publish")[1])
        end = lambda: abs(arm.state.reference_position[0] - 1.0) < 1e-9  # noqa: E731
        arm.bench.wait_for("the end", end)
        arm.bench.wait_for("the joint", lambda: abs(arm.state.position_error[0]) < 0.02)


def test_own_law_example_is_found_by_name_and_runs(tmp_path):
    (law,) = [text for kind, text in BLOCKS if kind == "python" and "class " in text]
    point = re.search(r'\["(pd = [\w.:]+)"\]', README).group(1)
    module = point.split("= ")[1].split(":")[0]
    (tmp_path / f"{module}.py").write_text(law)
    info = tmp_path / f"{module}-0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Name: {module}\nVersion: 0\n")
    (info / "entry_points.txt").write_text(f"[flexarm.slow_laws]\n{point}\n")
    script = (
        "from flexarm_studies.case_study import runs as case_study\n"
        "from flexarm_studies.loop import closed_loop\n"
        "loop = closed_loop.ClosedLoop('R', {'type': 'pd', 'kp': [40.0], 'kv': [12.0]},"
        " {'type': 'none'}, {'type': 'filtered_derivative'})\n"
        "record = loop.run(case_study.paper_trajectory(['joint1']), 4.0)\n"
        "print(record.position[-1, 0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(1.5708, abs=0.05)
