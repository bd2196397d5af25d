# SPDX-License-Identifier: Apache-2.0
"""Starts and ends a node's process: from the first moment, even during imports, a signal ends it cleanly."""

import contextlib
import ctypes
import faulthandler
import gc
import importlib
import os
import signal
import sys

from flexarm_dynamics.processes import ONE_THREAD

#: Environment variable that names the process with which this one is to end; see `end_with_parent`.
PARENT = "FLEXARM_PARENT"
_PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


def end_with_parent():
    """Let the system send SIGTERM when the process that started this one has ended for any reason (Linux).

    This is done only if the environment names that process, so a process started by hand survives its shell. The child
    makes the request, and not the parent between fork and exec: Python may not run there beside the middleware's
    threads.
    """
    parent = os.environ.pop(PARENT, "")  # not for children of this process
    if not parent.isdigit() or not sys.platform.startswith("linux"):
        return
    if os.getppid() == int(parent):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    # The parent is gone already, and another process has adopted this one: the signal would never come.
    if os.getppid() != int(parent) and not os.path.exists(f"/proc/{parent}"):
        os._exit(0)


def start(module):
    """Import a node's module and call its `main`; linear algebra has one thread, here and in processes it starts."""
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
    faulthandler.enable()  # shows where the middleware crashes
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    end_with_parent()
    importlib.import_module(module).main()


def leave(code):
    """End this process, whose nodes are destroyed and whose contexts are shut down, with an exit code.

    The destructors of the middleware's libraries are not run. Under load, in some three exits in a thousand,
    Fast DDS corrupted its heap or hung in them after the interpreter had finished.
    """
    # Delete what still refers to a context: this also deletes the participant and its shared memory.
    gc.unfreeze()
    gc.collect()
    if "rclpy" in sys.modules:
        from rclpy.utilities import get_default_context

        get_default_context().destroy()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):  # a closed pipe
            stream.flush()
    os._exit(code)


def leave_after(main):
    """Run a `main` of a process that may use the middleware, then `leave` with the code it exits with."""
    code = 0
    end_with_parent()
    try:
        main()
    except SystemExit as error:
        code = error.code
        if isinstance(code, str):
            print(code, file=sys.stderr)
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    leave(1 if isinstance(code, str) else code or 0)
