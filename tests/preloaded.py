# SPDX-License-Identifier: Apache-2.0
"""Node processes that begin as copies of one that has imported the mathematics: a second of processor time less each.

What runs is the installed executable's entry point, in a process, a session of processes and an environment of its own,
with its own command line. Executables as they are installed are started by the tests of the README, the tutorial and
the launch files.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
from importlib.metadata import entry_points

from flexarm_ros.start import PARENT
from flexarm_tools.running.processes import popen

#: Imported before the first copy. Nothing of ROS: the middleware starts threads, which a copy would lack.
MODULES = [
    "flexarm_sim.simulator",
    "flexarm_control.composite.designer",
    "flexarm_control.loop.arm_controller",
]


#: Where modules are looked for, by the process that is copied.
PYTHONPATH = os.environ.get("PYTHONPATH")


def start(command, log, env):
    """Start an installed executable as `popen` does: a copy, or the executable itself for other modules' sake."""
    return (Preloaded if env.get("PYTHONPATH") == PYTHONPATH else popen)(command, log, env)


class Preloaded:
    """A running copy; the part of `subprocess.Popen` that a bench uses.

    Parameters
    ----------
    command : sequence of str
        Path of an installed executable, and its arguments.
    log : path
        What it prints goes there.
    env : mapping
        The environment.
    """

    _context = multiprocessing.get_context("forkserver")
    _context.set_forkserver_preload(MODULES)

    def __init__(self, command, log, env):
        self._process = self._context.Process(target=_run, args=(command, str(log), dict(env)))
        self._process.start()
        self.pid = self._process.pid

    @property
    def returncode(self):
        """The exit code; None while it runs."""
        return self._process.exitcode

    poll = returncode.fget

    def wait(self, timeout=None):
        """Wait for its end, and return the exit code.

        Raises
        ------
        subprocess.TimeoutExpired
        """
        self._process.join(timeout)
        if self.poll() is None:
            raise subprocess.TimeoutExpired(self._process.name, timeout)
        return self.returncode

    def send_signal(self, number):
        """Signal it, if it runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        """End it at once."""
        self.send_signal(signal.SIGKILL)


def _run(command, log, env):
    """Become the process that the command would be."""
    os.setsid()
    for file, mode, numbers in (
        (os.devnull, os.O_RDONLY, (0,)),
        (log, os.O_WRONLY | os.O_APPEND, (1, 2)),
    ):
        opened = os.open(file, mode)
        for number in numbers:
            os.dup2(opened, number)
        os.close(opened)
    os.environ.clear()
    os.environ.update(env, **{PARENT: str(os.getppid())})
    sys.argv = list(command)
    (entry,) = entry_points(group="console_scripts", name=os.path.basename(command[0]))
    sys.exit(entry.load()())
