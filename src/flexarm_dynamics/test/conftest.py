# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by the tests of this package: reference data and shipped arms."""

import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model


def data_directory():
    """``tests/data`` of the repository, looked for upwards from here."""
    for parent in Path(__file__).resolve().parents:
        candidate = parent / "tests" / "data"
        if (candidate / "errata.json").is_file():
            return candidate
    raise FileNotFoundError(f"no tests/data above {__file__}")


@pytest.fixture(scope="session")
def data():
    """Directory of the reference data."""
    return data_directory()


@pytest.fixture(scope="session")
def errata(data):
    """``errata.json`` with its numbers as `Decimal`, which remember how many digits are printed."""
    return json.loads((data / "errata.json").read_text(), parse_float=Decimal)


@pytest.fixture(scope="session")
def frequencies(data):
    """Exact natural frequencies, ``frequencies.json``."""
    return json.loads((data / "frequencies.json").read_text())


@pytest.fixture(scope="session")
def parameters(data):
    """Arms and torques of the trajectories, ``parameters.json``."""
    return json.loads((data / "parameters.json").read_text())


@pytest.fixture(scope="session")
def shipped():
    """Function: the model of a shipped arm, with as many modes as asked for."""

    def build(name, modes=None):
        arm = arm_file.load(name)
        return model.build(arm if modes is None else arm.with_modes(modes))

    return build


@pytest.fixture(scope="session")
def agrees():
    """Function: asserts that numbers round to the digits that are printed."""

    def check(values, printed, units=0.5):
        values, printed = np.ravel(values), np.ravel(np.array(printed, dtype=object))
        assert values.shape == printed.shape
        for value, digits in zip(values, printed, strict=True):
            last = 10.0 ** Decimal(digits).as_tuple().exponent
            assert abs(value - float(digits)) <= (units + 1e-9) * last, f"{value} is not {digits}"

    return check
