# SPDX-License-Identifier: Apache-2.0
"""A process that cannot leave the graph of nodes is ended, and what leaves in time goes on as before."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from flexarm_ros import ending

# C code that holds Python's lock and never returns, as FastDDS does.
BEGIN = """
import ctypes
from types import SimpleNamespace
from flexarm_ros import ending
from flexarm_ros.node import run
from flexarm_ros.session import Session
ending.MAX_LEAVE = 1
stuck = ctypes.PyDLL(None).pause
"""
CASES = {
    "anything": "with ending.bounded():\n    stuck()",
    "a node's process": """
node = SimpleNamespace(autostart=lambda: False, active=False, destroy_node=stuck)
run(lambda: node, [])
""",
    "a session": """
session = Session("stuck")
session.node.destroy_node = stuck
session.close()
""",
}


@pytest.mark.parametrize("case", CASES)
def test_a_process_that_is_stuck_in_c_is_ended(case, domain):
    process = subprocess.run(
        [sys.executable, "-c", BEGIN + CASES[case]],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        timeout=60,
        check=False,
    )
    assert process.returncode == -signal.SIGALRM


def test_what_ends_in_time_leaves_no_alarm_and_the_handler_of_before():
    def handler(*_):
        raise AssertionError("an alarm")

    before = signal.signal(signal.SIGALRM, handler)
    try:
        with ending.bounded():
            assert signal.getsignal(signal.SIGALRM) == signal.SIG_DFL
        assert signal.getsignal(signal.SIGALRM) is handler
        assert signal.alarm(0) == 0
    finally:
        signal.signal(signal.SIGALRM, before)


def test_another_thread_than_the_main_one_may_leave_too():
    left = []

    def leave():
        with ending.bounded():
            left.append(signal.getsignal(signal.SIGALRM))

    thread = threading.Thread(target=leave)
    thread.start()
    thread.join()
    assert left == [signal.getsignal(signal.SIGALRM)]
