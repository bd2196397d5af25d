"""Starts a node's process: a signal ends it cleanly from the first moment, while it still imports."""

import importlib
import os
import signal


def start(module):
    """Import a node's module and call its `main`."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    importlib.import_module(module).main()
