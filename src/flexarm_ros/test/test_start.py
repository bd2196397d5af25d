# SPDX-License-Identifier: Apache-2.0
"""What a node's process is before its module is imported."""

import importlib
import os
import signal
from types import SimpleNamespace

from flexarm_dynamics.processes import ONE_THREAD
from flexarm_ros import start


def test_linear_algebra_has_one_thread_before_anything_is_imported(monkeypatch):
    found = {}
    node = SimpleNamespace(main=lambda: found.update(ran=True))

    def imported(name):
        found.update(name=name, threads=[os.environ.get(one) for one in ONE_THREAD])
        return node

    monkeypatch.setattr(os, "environ", {ONE_THREAD[0]: "3"})  # somebody's own choice stays
    monkeypatch.setattr(importlib, "import_module", imported)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    start.start("a.node")
    assert found == {"name": "a.node", "threads": ["3", "1", "1"], "ran": True}
