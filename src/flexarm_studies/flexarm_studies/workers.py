# SPDX-License-Identifier: Apache-2.0
"""Computes many runs in this process, in worker processes, or on a Dask cluster."""

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.processes import ONE_THREAD

#: Value of ``--scheduler`` for processes on this machine.
PROCESSES = "processes"


def add_arguments(add, what=""):
    """Add ``--workers`` and ``--scheduler`` by a parser's `add_argument`; `what` is added to the help of both."""
    add("--workers", type=int, metavar="N", help=f"processes{what} (one per core)")
    add(
        "--scheduler",
        metavar=f"ADDRESS|{PROCESSES}",
        help=f"a Dask cluster{what}, tcp://host:8786, or {PROCESSES} of this machine ({PROCESSES})",
    )


def results(function, calls, workers=None, scheduler=None):
    """Yield (i, ``function(*calls[i])``), as the results come.

    Parameters
    ----------
    function : callable
        A function of a module, so other processes find it.
    calls : sequence of tuple
    workers : int, optional
        Number of processes; one per core if not given. 1: all in this process.
    scheduler : str, optional
        Address of a Dask scheduler to use instead; its workers need flexarm. `PROCESSES`: none.

    Raises
    ------
    FlexarmError
        For fewer than one worker, and if Dask is not installed or its scheduler can't be reached.
    """
    if workers is not None and workers < 1:
        raise FlexarmError("is too small", field="--workers", value=workers, limit="1 or more")
    if not calls:
        return
    count = min(workers or os.cpu_count() or 1, len(calls))
    remote = scheduler not in (None, PROCESSES)
    if not remote and count == 1:
        yield from ((i, function(*call)) for i, call in enumerate(calls))
        return
    with dask(scheduler) if remote else processes(count) as executor:
        yield from through(executor, function, calls)


def through(executor, function, calls):
    """As `results`, by any `concurrent.futures` executor."""
    waiting = {executor.submit(function, *call): i for i, call in enumerate(calls)}
    try:
        for future in as_completed(waiting):
            yield waiting[future], future.result()
    finally:
        for future in waiting:
            future.cancel()


@contextmanager
def processes(count):
    """An executor with `count` processes, which end with the context; calls that have not started are dropped."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    # Never fork: this process may have threads.
    executor = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"))
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def dask(address):
    """An executor on the Dask cluster whose scheduler is at an `address`."""
    try:
        from distributed import Client
    except ImportError:
        raise FlexarmError(
            "needs Dask, which is not installed",
            field="--scheduler",
            hint="pip install distributed (and flexarm on its workers)",
        ) from None
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError, TimeoutError) as error:
        raise FlexarmError(
            f"is no Dask scheduler that can be reached: {error}", field="--scheduler", value=address
        ) from None
    with client, client.get_executor(pure=False) as executor:
        yield executor
