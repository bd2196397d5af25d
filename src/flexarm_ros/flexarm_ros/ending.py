# SPDX-License-Identifier: Apache-2.0
"""Bounds the time in which a process leaves the graph of nodes."""

import contextlib
import signal
import threading

#: Max. duration of leaving the graph [s]; it takes milliseconds.
MAX_LEAVE = 10


@contextlib.contextmanager
def bounded():
    """End this process by SIGALRM if the context takes longer than `MAX_LEAVE`.

    FastDDS 2.14 can wait for ever in ``destroy_node`` if another process of the domain starts or ends just then. It
    waits in C++ with Python's lock held, so no thread and no signal handler of Python can end it: only a signal's
    default action does. An alarm that was set before is cancelled. In another thread than the main one this context
    does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(MAX_LEAVE)
    try:
        yield
    finally:
        signal.alarm(0)
        if before is not None:  # a handler of Python
            signal.signal(signal.SIGALRM, before)
