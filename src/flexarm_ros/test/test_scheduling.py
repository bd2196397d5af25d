# SPDX-License-Identifier: Apache-2.0
"""CPU affinity and real-time priority: what is taken, what is refused and how that is reported."""

import os
import subprocess
import sys
import threading

import pytest

from flexarm_dynamics.errors import ParameterError
from flexarm_ros import scheduling

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")


def never(text):
    raise AssertionError(text)


@pytest.fixture
def restored():
    """The affinity of every thread of this process comes back."""
    before = {thread: os.sched_getaffinity(thread) for thread in scheduling.threads()}
    yield
    scheduling._spare.clear()
    for thread, cpus in before.items():
        if thread in scheduling.threads():
            os.sched_setaffinity(thread, cpus)


def test_affinity_binds_every_thread(restored):
    before = os.sched_getaffinity(0)
    cpu = max(before)
    assert not scheduling.spare()
    over, begun, found = threading.Event(), threading.Event(), []

    def wait():
        begun.set()
        over.wait()
        found.append(os.sched_getaffinity(0))

    other = threading.Thread(target=wait)
    other.start()
    begun.wait()
    scheduling.apply([cpu], 0, never)
    over.set()
    other.join()
    assert os.sched_getaffinity(0) == {cpu}
    assert found == [{cpu}]
    assert scheduling.spare() == before - {cpu}
    scheduling.apply([cpu], 0, never)  # a second node of the process
    assert scheduling.spare() == before - {cpu}


def test_a_cpu_that_is_not_there_is_refused_by_its_number():
    before = os.sched_getaffinity(0)
    with pytest.raises(ParameterError) as error:
        scheduling.apply([0, os.cpu_count()], 0, never)
    assert (error.value.field, error.value.value) == ("cpu_affinity", os.cpu_count())
    assert os.sched_getaffinity(0) == before


def test_a_cpu_that_the_cpuset_leaves_out_is_refused(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    monkeypatch.setattr(os, "sched_setaffinity", lambda thread, cpus: None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda thread: {1})
    with pytest.raises(ParameterError, match="may not run on") as error:
        scheduling.apply([1, 3], 0, never)
    assert error.value.value == [3]


def test_nothing_is_changed_by_default(monkeypatch):
    monkeypatch.setattr(os, "sched_setaffinity", never)
    monkeypatch.setattr(os, "sched_setscheduler", never)
    scheduling.apply(*(p.default for p in scheduling.PARAMETERS), never)


def test_a_refused_priority_is_a_warning_that_says_what_to_do(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    messages = []
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    scheduling.apply([], 20, messages.append)
    assert len(messages) == 1
    for word in ("realtime_priority 20", "Operation not permitted", "rtprio", "cap_sys_nice"):
        assert word in messages[0]


HURRIED = """
import os, threading
from flexarm_ros import scheduling
scheduling.apply([], 7, lambda text: print("refused"))
mine = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(0).sched_priority
later = []
thread = threading.Thread(target=lambda: later.append(os.sched_getscheduler(0)))
thread.start(), thread.join()
print(mine == (os.SCHED_FIFO, 7), later[0] == os.SCHED_OTHER)
"""


def test_the_priority_is_taken_where_allowed_and_later_threads_have_none():
    command = [sys.executable, "-c", HURRIED]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() in (["True", "True"], ["refused", "False", "True"])
