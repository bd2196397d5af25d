# SPDX-License-Identifier: Apache-2.0
"""What several test files need: commands as typed, changed arm files, synthetic records."""

import json

import numpy as np
import pytest
import yaml

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_studies.loop.metrics import SimulatedRecord


@pytest.fixture
def result(flexarm):
    """Runs a command that must succeed, with ``--json``: what it prints."""

    def run(*words):
        code, out, err = flexarm(*words, "--json")
        assert code == 0, err
        return json.loads(out)

    return run


@pytest.fixture
def changed_arm(tmp_path):
    """Writes a shipped arm file with something changed; its path."""

    def write(name, change):
        data = yaml.safe_load(arm_file.find(name).read_text())
        change(data)
        path = tmp_path / f"changed_{name}.yaml"
        path.write_text(yaml.safe_dump(data))
        return str(path)

    return write


@pytest.fixture(scope="session")
def arm_r():
    """Model of the paper's arm."""
    return model.build(arm_file.load("R"))


#: Of the synthetic records: every 10 ms from -0.1 to 4 s.
TIME = np.arange(-10, 401) * 0.01


@pytest.fixture(scope="session")
def make_record():
    """Makes a record of an arm at rest; numbers or functions of time replace zeros."""

    def make(arm_model, time=TIME, **given):
        n, m = arm_model.n_joints, arm_model.n_modes
        widths = dict.fromkeys(SimulatedRecord.__dataclass_fields__, n)
        widths |= dict.fromkeys(("amplitude", "rate", "quasi_steady", "plant_amplitude"), m)
        columns = {}
        for name, width in widths.items():
            value = given.get(name, 0.0)
            rows = [np.ravel(value(t) if callable(value) else value) for t in time]
            columns[name] = np.broadcast_to(np.array(rows, float), (time.size, width))
        columns["time"] = time
        for name in ("saturated", "state"):
            columns[name] = columns[name][:, 0].astype(int)
        return SimulatedRecord(**columns)

    return make
