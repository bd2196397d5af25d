# SPDX-License-Identifier: Apache-2.0
"""Sets where and how urgently a node's process runs: CPU affinity and real-time priority (Linux).

Both are off by default. They apply to every thread that the process has when its node is made, also to those of the
middleware: a message waits for the slowest of them. Threads made later, in which laws are designed, stay on those CPUs
but have ordinary priority, so a design never delays a sample.
"""

import os

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import parameter

CPU_AFFINITY = parameter(
    "cpu_affinity", [], "-", 0, 1023, kind="int_array", read_only=True
).described(
    "CPUs that the node's process runs on; empty: all. Nodes that share a process share it."
)
REALTIME_PRIORITY = parameter("realtime_priority", 0, "-", 0, 99, read_only=True).described(
    "Priority of the node's process among real-time processes (SCHED_FIFO); 0: an ordinary process."
)
PARAMETERS = (CPU_AFFINITY, REALTIME_PRIORITY)


#: See `spare`.
_spare = set()


def spare():
    """The allowed CPUs that `apply` has left out when it bound this process to others; empty before."""
    return frozenset(_spare)


def threads():
    """Thread ids of this process."""
    return [int(name) for name in os.listdir("/proc/self/task")]


def apply(cpus, priority, warn):
    """Apply the values of `PARAMETERS`.

    Parameters
    ----------
    cpus : sequence of int
        Empty: those with which the process was started.
    priority : int
        0: the priority with which the process was started.
    warn : callable
        Called with a sentence if the system refuses the priority; the node then runs without it.

    Raises
    ------
    ParameterError
        For a CPU that this machine does not have, or that this process may not run on.
    """
    if cpus:
        _pin(cpus)
    if priority:
        _hurry(priority, warn)


def _pin(cpus):
    if not hasattr(os, "sched_setaffinity"):
        problem = "this system can't bind a process to CPUs"
        raise ParameterError(problem, field="cpu_affinity", hint="leave it out")
    last = (os.cpu_count() or 1) - 1
    for cpu in cpus:
        if cpu > last:
            problem = "is not a CPU of this machine"
            raise ParameterError(problem, field="cpu_affinity", value=cpu, limit=f"0 to {last}")
    try:
        before = os.sched_getaffinity(0) | _spare
        _each(lambda thread: os.sched_setaffinity(thread, cpus))
        refused = set(cpus) - os.sched_getaffinity(0)
    except OSError:
        refused = set(cpus)
    if refused:
        raise ParameterError(
            "are CPUs that this process may not run on",
            field="cpu_affinity",
            value=sorted(refused),
            hint="its container or cpuset leaves them out",
        )
    _spare.clear()
    _spare.update(before - set(cpus))


def _hurry(priority, warn):
    if not hasattr(os, "sched_setscheduler"):
        warn(f"realtime_priority {priority} is not taken: this system has no SCHED_FIFO")
        return
    # Threads that these make later begin with ordinary priority.
    policy, how = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority)
    try:
        _each(lambda thread: os.sched_setscheduler(thread, policy, how))
    except OSError as error:
        warn(
            f"realtime_priority {priority} is refused by the system ({error.strerror}), the node goes on at ordinary"
            " priority: allow it by a line `@realtime - rtprio 99` in /etc/security/limits.conf (log in anew, `ulimit"
            " -r` shows it), by `setcap cap_sys_nice+ep` on the Python interpreter or --cap-add=SYS_NICE"
            " --ulimit rtprio=99 for a container, or leave realtime_priority at 0"
        )


def _each(change):
    for thread in threads():
        try:
            change(thread)
        except ProcessLookupError:  # it has ended meanwhile
            continue
