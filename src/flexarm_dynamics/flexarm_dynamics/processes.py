# SPDX-License-Identifier: Apache-2.0
"""Makes processes beside the control path give way to it, and end with the process that started them."""

import contextlib
import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # <linux/prctl.h>
#: Environment variables that linear algebra libraries read when they are loaded. With several threads, processes that
#: work on small matrices slow each other down: a regulator took six times as long.
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def step_back(niceness, cpus=()):
    """Make this process an ordinary one of lower priority.

    Priority and CPUs are inherited: without this, a process that a node starts competes with the node on equal terms.

    Parameters
    ----------
    niceness : int
        Added to the current niceness.
    cpus : collection of int
        CPUs to run on, if the system allows it; empty: the inherited ones.
    """
    if hasattr(os, "SCHED_BATCH"):  # Linux
        # Not SCHED_IDLE: on a machine that is always busy such a process would never run.
        with contextlib.suppress(OSError):  # some containers refuse it
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        if cpus:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(0, cpus)
    os.nice(niceness)


def end_with(parent):
    """End this process as soon as its parent has ended, for any reason. On systems other than Linux, do nothing.

    Parameters
    ----------
    parent : int
        Process id of the parent.
    """
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # it ended before the call
            os._exit(0)
