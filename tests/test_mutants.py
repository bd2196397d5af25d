# SPDX-License-Identifier: Apache-2.0
"""The list of `make mutants` fits the sources: each error can still be put in, and its tests are there."""

from pathlib import Path

import pytest

from tools.mutants import MUTANTS, dynamics
from tools.mutants.__main__ import places

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda m: f"{m.file}: {m.name}")
def test_a_mutant_changes_one_place_and_its_tests_exist(mutant):
    assert places(mutant) == 1
    assert mutant.new != mutant.old
    for word in mutant.tests.split():
        if word.startswith("flexarm_"):
            file, _, name = word.partition("::")
            assert not name or f"def {name}(" in (ROOT / "src" / file).read_text()
            assert (ROOT / "src" / file).is_file()


def test_there_are_32_of_the_kernels_and_one_of_each_law():
    assert len(dynamics.KERNELS) == 32
    files = {mutant.file for mutant in MUTANTS}
    for folder in ("slow", "fast", "manifold", "feedforward", "observers"):
        source = ROOT / "src" / "flexarm_control" / "flexarm_control" / folder
        laws = {p.stem for p in source.glob("*.py")} - {"__init__", "base", "none", "arm_observer"}
        covered = {Path(f).stem for f in files if f"/{folder}/" in f}
        helpers = {"payload_model", "rigid_arm"}
        assert laws - covered <= helpers, laws - covered
