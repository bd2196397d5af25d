# SPDX-License-Identifier: Apache-2.0
"""A synthetic record for the tests of metrics and figures."""

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_studies.loop.metrics import Record


@pytest.fixture(scope="session")
def arm_r():
    """Model of the paper's arm."""
    return model.build(arm_file.load("R"))


@pytest.fixture
def make_record():
    """Makes a record of rest, 100 samples a second from -0.1 to 4 s; what is given replaces zeros."""

    def make(**changed):
        time = np.arange(-10, 401) * 0.01
        columns = dict.fromkeys(Record.__dataclass_fields__, 1)
        columns |= dict.fromkeys(("amplitude", "rate", "quasi_steady"), 2)
        arrays = {name: np.zeros((time.size, n)) for name, n in columns.items()}
        arrays["time"] = time
        for name, function in changed.items():
            arrays[name] = np.array([np.atleast_1d(function(t)) for t in time], float)
        return Record(**arrays)

    return make
