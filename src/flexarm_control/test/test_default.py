# SPDX-License-Identifier: Apache-2.0
"""The default control: when an arm gets a design, what is kept of designs, and that hand-given values stay."""

import ast
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest

from flexarm_control.robust import cache, default
from flexarm_control.robust.design import design
from flexarm_control.robust.settings import Settings
from flexarm_control.robust.uncertain import Uncertainty
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import DesignError, ParameterError
from flexarm_dynamics.models.model import build

# Designs that are equal are made once in a process.
pytestmark = pytest.mark.xdist_group("test_default")

#: A rigid arm's design takes a fraction of a second.
ARM = arm_file.load("rigid")
TASK = Settings(rate=500.0, effort=0.1), Uncertainty()
VALUES = {p.name: p.default for p in default.PARAMETERS} | {"rate": 500.0, "design.effort": 0.1}


@pytest.fixture(autouse=True)
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "cache_directory", lambda: tmp_path)
    return tmp_path / "designs"


once = lru_cache(lambda _, settings, uncertainty: design(ARM, settings, uncertainty))


@pytest.fixture(autouse=True)
def made(monkeypatch):
    """Counts the designs that are made; equal ones are made once for all tests."""
    count = []

    def counted(arm, *task):
        count.append(arm)
        return once(arm.payload, *task)

    monkeypatch.setattr(default, "design", counted)
    return count


def path():
    return cache.path_of(cache.key(ARM, *TASK))


@pytest.mark.parametrize(
    ("name", "given", "kind", "wanted"),
    [
        ("my_arm.yaml", (), "auto", True),
        ("config/arms/R.yaml", (), "auto", True),
        ("two_link", (), "auto", True),
        ("R", (), "auto", False),
        ("", (), "auto", False),
        ("", (), "robust", True),
        ("my_arm.yaml", ("slow.type",), "auto", False),
        ("my_arm.yaml", ("fast.type",), "auto", False),
        ("my_arm.yaml", ("slow.stiffness", "observer.type", "feedforward"), "auto", True),
        ("R", ("slow.type",), "robust", True),
        ("my_arm.yaml", (), "none", False),
    ],
)
def test_an_arm_without_laws_of_its_own_gets_a_design(name, given, kind, wanted):
    assert default.is_wanted(name, given, kind) is wanted


def test_a_design_is_made_once_and_is_what_flexarm_design_makes(made):
    first = default.default(ARM, *TASK)
    assert first.parameters == design(ARM, *TASK).parameters()
    assert first.delay == 0.003 and first.bears_delay > first.delay
    assert first.speed == 1.0 and not first.slowed and first.comes_back and not first.hunts
    assert default.default(ARM, *TASK) == first and len(made) == 1


def test_an_arm_that_differs_in_words_alone_shares_its_design(made):
    default.default(ARM, *TASK)
    default.default(replace(ARM, name="copy", description="Another", source=""), *TASK)
    assert len(made) == 1


@pytest.mark.parametrize(
    "other",
    [
        (replace(ARM, payload=replace(ARM.payload, mass=ARM.payload.mass + 1e-9)), *TASK),
        (ARM, replace(TASK[0], rate=501.0), TASK[1]),
        (ARM, replace(TASK[0], delay=0.0031), TASK[1]),
        (ARM, TASK[0], replace(TASK[1], payload=(0.7, 1.31))),
    ],
)
def test_another_arm_rate_delay_or_uncertainty_is_another_design(other):
    assert cache.key(*other) != cache.key(ARM, *TASK)


def test_other_code_is_another_design(monkeypatch):
    before = cache.key(ARM, *TASK)
    monkeypatch.setattr(cache, "version", lambda: "later")
    assert cache.key(ARM, *TASK) != before


def test_the_code_that_names_a_design_has_all_that_gains_follow_from():
    """A module of another package that the design imports is in `TAKEN`, but for verdicts and declarations."""
    imported = {
        node.module
        for path in Path(cache.__file__).parent.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.level == 2
    }
    other = {
        "kernels",
        "kernels.poles",
        "composite.design",
        "feedforward.model",
        "loop.samples",
        "trajectory",
    }
    taken = {f"{name.replace('.', '/')}.py" for name in imported - other}
    assert taken == set(cache.TAKEN)


def _cut(text):
    return text[: len(text) // 2]


def _changed(text):
    data = json.loads(text)
    data["entry"]["parameters"]["slow.damping"][0] *= 2.0
    return json.dumps(data)


def _renamed(text):
    return json.dumps(json.loads(text) | {"key": "0" * 64})


@pytest.mark.parametrize("spoil", [_cut, _changed, _renamed, lambda text: "[]", lambda text: ""])
def test_a_file_that_is_not_what_was_written_is_ignored_and_written_anew(spoil, made):
    first = default.default(ARM, *TASK)
    whole = path().read_text()
    path().write_text(spoil(whole))
    assert not default.is_cached(ARM, *TASK)
    assert default.default(ARM, *TASK) == first and len(made) == 2
    assert path().read_text() == whole


def test_bytes_that_are_no_text_are_ignored(made):
    default.default(ARM, *TASK)
    path().write_bytes(b"\xff\xfe\x00")
    default.default(ARM, *TASK)
    assert len(made) == 2


def test_nothing_is_left_beside_the_design_and_a_full_disk_does_no_harm(empty_cache, monkeypatch):
    default.default(ARM, *TASK)
    assert [p.name for p in empty_cache.iterdir()] == [path().name]
    path().unlink()
    empty_cache.rmdir()
    empty_cache.write_text("")  # no directory can be made here
    assert default.default(ARM, *TASK).parameters


def test_what_no_gains_hold_is_refused_from_the_cache_too(made):
    task = replace(TASK[0], effort=0.01, configurations=((0.5, 0.5), (1.0, -1.0)))
    wide, texts = replace(TASK[1], gain=(0.001, 1000.0)), []
    for _ in range(2):
        with pytest.raises(
            DesignError, match="controller of rigid: no gains hold all of it"
        ) as error:
            default.default(ARM, task, wide)
        texts.append(str(error.value))
    assert len(made) == 1 and texts[0] == texts[1]


def test_given_parameters_stay_and_the_rest_is_designed():
    given = {k: v for k, v in VALUES.items() if k != "design.type"}
    values, made = default.complete("mine", ARM, given | {"slow.damping": [7.0, 8.0]})
    assert made.parameters["slow.damping"] != [7.0, 8.0] == values["slow.damping"]
    assert values["slow.stiffness"] == made.parameters["slow.stiffness"]
    assert not default.NAMES & set(values)
    assert default.complete("R", ARM, {"slow.kp": [9.0]}) == ({"slow.kp": [9.0]}, None)


def test_the_observer_of_a_design_is_known_without_a_search(made):
    settings, _ = default.task(ARM, VALUES)
    whole = default.default(ARM, settings, Uncertainty()).parameters
    found = default.for_observer(build(ARM), settings)
    assert found == {k: v for k, v in whole.items() if k.startswith("observer.")}
    assert len(found) == 4 and len(made) == 1


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("design.payload", [1.1, 2.0], r"design.payload: \[1.1, 2.0\] is no range of factors"),
        ("design.gain", [0.5, 0.9], "with 1.0 between them"),
        ("design.configurations", [0.1, 0.2, 0.3], "write 2 joint angles for each"),
    ],
)
def test_what_makes_no_task_is_refused(name, value, text):
    with pytest.raises(ParameterError, match=text):
        default.task(ARM, VALUES | {name: value})


def test_the_task_of_a_design_is_what_its_parameters_say():
    given = {"design.configurations": [0.1, 0.2, 0.3, 0.4], "design.delay": 0.004}
    settings, uncertainty = default.task(ARM, VALUES | given)
    assert settings.configurations == ((0.1, 0.2), (0.3, 0.4)) and settings.delay == 0.004
    assert uncertainty == Uncertainty()
    assert default.task(ARM, VALUES)[0].delay == 0.003
