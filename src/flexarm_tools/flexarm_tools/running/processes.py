# SPDX-License-Identifier: Apache-2.0
"""Runs the installed executables as processes, on a DDS domain of their own."""

import argparse
import contextlib
import fcntl
import os
import random
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.processes import ONE_THREAD
from flexarm_ros.start import PARENT

#: Package of each node's executable.
NODES = {
    "simulator": "flexarm_sim",
    "observer": "flexarm_control",
    "controller": "flexarm_control",
    "observer_controller": "flexarm_control",
    "goals": "flexarm_control",
    "shaper": "flexarm_control",
}


class ProcessError(FlexarmError):
    """A process that did not start, died, or did not do what it was started for."""


def installed(*parts):
    """Path of an installed file; every sourced prefix is searched.

    The `parts` make up its path below the prefix.

    Raises
    ------
    ProcessError
        If it is not installed.
    """
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, *parts)
        if prefix and path.is_file():
            return path
    hint = "run `make build`, then source install/setup.bash"
    raise ProcessError("is not installed", field="/".join(parts), hint=hint)


def executable(package, name):
    """Path of an executable as ``ros2 run`` finds it."""
    return str(installed("lib", package, name))


@contextlib.contextmanager
def own_domain():
    """A ROS_DOMAIN_ID that no other flexarm run on this machine has, as a context.

    A file lock holds the domain, so the domain is free again however the process ends.
    """
    numbers = list(range(1, 101))
    random.Random(os.getpid()).shuffle(numbers)
    folder = Path(tempfile.gettempdir()) / f"flexarm-domains-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for number in numbers:
        with open(folder / str(number), "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield number
            return
    problem = "all are taken by other flexarm runs"
    raise ProcessError(problem, field="ROS_DOMAIN_ID", limit="1 to 100")


def environment(domain):
    """Environment of a process on `domain`, this machine only."""
    env = dict(os.environ, ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    env.setdefault("RCUTILS_LOGGING_USE_STDOUT", "0")
    # One thread each: small matrices, and the other processes need the other cores.
    env.update(dict.fromkeys(ONE_THREAD, "1"))
    env[PARENT] = str(os.getpid())  # no process is left behind, even after kill -9
    return env


def arguments(parameters=None, file=None, remaps=()):
    """The ``--ros-args`` part of a command line.

    Parameters
    ----------
    parameters : mapping, optional
        Name to value.
    file : path, optional
        Parameter file, before the single parameters.
    remaps : sequence of str
        ``from:=to``.
    """
    words = ["--ros-args"]
    if file is not None:
        words += ["--params-file", str(file)]
    for name, value in (parameters or {}).items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        # Quoted; otherwise YAML would read a name such as "1e3" or "none" as something else.
        words += ["-p", f'{name}:="{text}"' if isinstance(value, str) else f"{name}:={text}"]
    for remap in remaps:
        words += ["-r", remap]
    return words


def popen(command, log, env):
    """Start a command in a session of its own; its output is appended to the file `log`."""
    with open(log, "ab") as stream:
        return subprocess.Popen(
            command,
            stdout=stream,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=env,
            start_new_session=True,
        )


class Processes:
    """Child processes that end with the context manager, however it ends, and with this process.

    Parameters
    ----------
    domain : int
        ROS_DOMAIN_ID of all of them.
    log_directory : Path
        Folder of one log file for each.
    """

    #: After SIGINT a process has this long before it is killed [s].
    PATIENCE = 10.0

    def __init__(self, domain, log_directory):
        self.domain = domain
        self.logs = Path(log_directory)
        self.logs.mkdir(parents=True, exist_ok=True)
        self.running, self._ending = {}, set()

    def start(self, name, command, by=popen):
        """Start a command; its output goes to ``<log_directory>/<name>.log``.

        ``by(command, log=, env=)`` starts it: `popen`, or another function that returns the same parts of a
        `subprocess.Popen`.
        """
        self._ending.discard(name)
        log = self.logs / f"{name}.log"
        log.write_bytes(b"")
        process = by(command, log=log, env=environment(self.domain))
        self.running[name] = process
        return process

    def start_node(self, name, parameters=None, file=None):
        """Start one of `NODES` by its installed executable, with `parameters` beyond those of a `file`."""
        return self.start(name, [executable(NODES[name], name), *arguments(parameters, file)])

    def start_module(self, name, module, *words):
        """Start a module of this environment."""
        return self.start(name, [sys.executable, "-m", module, *words])

    def log(self, name):
        """What a process has printed so far."""
        return (self.logs / f"{name}.log").read_text(errors="replace")

    def tails(self):
        """The last lines of each log."""
        logs = sorted(self.logs.glob("*.log"))
        return "\n".join(f"--- {path.stem}\n{_tail(path, 8)}" for path in logs)

    def expect_end(self, name):
        """Let `check` accept from now on that this process ends; return the process."""
        self._ending.add(name)
        return self.running[name]

    def check(self):
        """Raise with the end of its log if a process has ended unexpectedly."""
        for name, process in self.running.items():
            if name not in self._ending and process.poll() is not None:
                tail = _tail(self.logs / f"{name}.log", 15)
                raise ProcessError(f"ended with code {process.returncode}:\n{tail}", field=name)

    def stop(self, number=signal.SIGINT):
        """Signal all, wait, and kill those that do not end; return exit codes by name."""
        for process in self.running.values():
            if process.poll() is None:
                process.send_signal(number)
        codes = {}
        for name, process in self.running.items():
            try:
                codes[name] = process.wait(self.PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                codes[name] = process.wait()
        self.running, self._ending = {}, set()
        return codes

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()


def _tail(path, lines):
    return "\n".join(path.read_text(errors="replace").splitlines()[-lines:])


def add_arguments(parser):
    """Arguments of ``flexarm run``."""
    parser.description = (
        "Starts an installed executable of the workspace; what follows it is passed on."
    )
    parser.epilog = "example: flexarm run flexarm_sim simulator --ros-args -p arm:=R"
    parser.add_argument("package")
    parser.add_argument("executable")
    parser.add_argument("arguments", nargs=argparse.REMAINDER)


def run(options):
    """``flexarm run``: start one installed executable in this process's place."""
    path = executable(options.package, options.executable)
    os.execv(path, [path, *options.arguments])
