# SPDX-License-Identifier: Apache-2.0
"""How processes that are not on the control path keep out of its way."""

import contextlib
import os


def step_back(niceness, cpus=()):
    """Make this process an ordinary one of lower priority.

    Priority and CPUs are inherited: what a node starts, or what is started beside it, would otherwise compete with
    it on equal terms.

    Parameters
    ----------
    niceness : int
        Added to the present one.
    cpus : collection of int
        To run on, where the system allows it; empty: those inherited.
    """
    if hasattr(os, "SCHED_BATCH"):  # Linux
        # Not SCHED_IDLE: on a machine that is always busy nothing would ever be done.
        with contextlib.suppress(OSError):  # some containers allow none of it
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        if cpus:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(0, cpus)
    os.nice(niceness)
