# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests that run the nodes as processes."""

import os
import sys
from pathlib import Path

import pytest

# Before any message is imported, here and in the nodes: a wrong type in a field is an error, not garbage.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
sys.path.insert(0, str(Path(__file__).parent))  # --import-mode=importlib does not


@pytest.fixture
def bench(tmp_path):
    """A `harness.Bench` of this test alone."""
    from harness import Bench

    with Bench(tmp_path / "log") as bench:
        yield bench


@pytest.fixture(scope="module")
def shared_bench(tmp_path_factory):
    """A `harness.Bench` for all tests of a module."""
    from harness import Bench

    with Bench(tmp_path_factory.mktemp("log")) as bench:
        yield bench
