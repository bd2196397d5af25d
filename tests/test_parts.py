# SPDX-License-Identifier: Apache-2.0
"""Which of the long tests run: all of them, in as many landings as there are parts."""

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


def test_ci_runs_as_many_parts_as_it_counts():
    text = (ROOT / ".ci" / "run").read_text()
    assert "parts=6" in text and "% parts + 1" in text and 'LONG="$part/$parts"' in text
