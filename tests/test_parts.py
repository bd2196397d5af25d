# SPDX-License-Identifier: Apache-2.0
"""Which of the long tests run: all of them, in as many landings as there are parts."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def parts(request):
    """The root's conftest."""
    plugins = request.config.pluginmanager.get_plugins()
    return next(p for p in plugins if getattr(p, "__file__", "") == str(ROOT / "conftest.py"))


def test_each_name_is_in_one_part(parts):
    names = [f"tests/test_{number}.py::test_it[{number}]" for number in range(600)]
    found = [[parts.in_part(name, part, 6) for name in names] for part in range(1, 7)]
    assert [sum(column) for column in zip(*found, strict=True)] == [1] * len(names)
    assert min(map(sum, found)) > 60
    assert not any(parts.in_part(name, 0, 6) for name in names)


@pytest.mark.parametrize(
    ("text", "wanted"), [("all", (1, 1)), ("none", (0, 1)), ("2/6", (2, 6)), ("6/6", (6, 6))]
)
def test_a_part_is_written_as_a_fraction(parts, text, wanted):
    assert parts.part_of(text) == wanted


@pytest.mark.parametrize("text", ["some", "", "0/6", "7/6", "1/0", "0/0", "1/6/2", "-1/6"])
def test_what_is_no_part_is_refused(parts, text):
    with pytest.raises(pytest.UsageError, match="write all, none, or a part such as 2/6"):
        parts.part_of(text)


MODULES = {
    "test_alone.py": """
import pytest

@pytest.mark.long
@pytest.mark.parametrize("number", range(12))
def test_long(number):
    pass

def test_short():
    pass
""",
    "test_together.py": """
import pytest

@pytest.fixture(scope="module")
def nodes():
    pass

@pytest.mark.long
@pytest.mark.parametrize("number", range(6))
def test_shared(nodes, number):
    pass
""",
}


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """What is collected of `MODULES` with each ``--long``: its answer to the names of the tests."""
    folder = tmp_path_factory.mktemp("parts")
    for name, text in {**MODULES, "conftest.py": (ROOT / "conftest.py").read_text()}.items():
        (folder / name).write_text(text)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers =\n    long\n    real_time\n")

    def names(*words):
        command = [sys.executable, "-m", "pytest", "--collect-only", "-q", *words, "."]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        return {line for line in done.stdout.splitlines() if "::" in line}

    return {text: names("--long", text) for text in ("all", "none", "1/2", "2/2")} | {"": names()}


def test_each_long_test_runs_in_one_part_and_short_ones_in_each(collected):
    short = {"test_alone.py::test_short"}
    first, second = collected["1/2"], collected["2/2"]
    assert collected["none"] == short
    assert first & second == short and first | second == collected["all"] == collected[""]
    assert len(collected["all"]) == 19
    assert min(len(first), len(second)) > 2


def test_tests_that_share_a_fixture_are_in_one_part(collected):
    counts = [sum("test_shared" in name for name in collected[part]) for part in ("1/2", "2/2")]
    assert sorted(counts) == [0, 6]


def test_ci_runs_each_part_by_its_number():
    text = (ROOT / ".ci" / "run").read_text()
    lines = [line for line in text.splitlines() if line.startswith("part")]
    script = "git() { echo $count; }; " + "; ".join(lines) + '; echo "$part/$parts"'
    found = set()
    for count in range(100, 124):
        run = ["bash", "-c", f"count={count}; {script}"]
        found.add(subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip())
    assert found == {f"{part}/12" for part in range(1, 13)}
    assert 'LONG="$part/$parts"' in text
