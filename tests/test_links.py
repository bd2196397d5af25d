# SPDX-License-Identifier: Apache-2.0
"""Links inside the documentation lead somewhere; the checker finds those that do not."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def load(path):
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


links = load(ROOT / "docs" / "links.py")


def test_every_link_of_the_pages_and_the_readme_leads_somewhere():
    pages = links.pages()
    assert {ROOT / "README.md", ROOT / "docs" / "index.md"} <= set(pages)
    found = [target for page in pages for _, target in links.links(page.read_text("utf-8"))]
    assert len(found) > 60, "the checker no longer sees the links"
    wrong = [line for page in pages for line in links.broken(page)]
    assert not wrong, "\n".join(wrong)


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A repository of two pages."""
    monkeypatch.setattr(links, "ROOT", tmp_path)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "other.md").write_text("# A title, of `code`\n\n## Twice\n\n## Twice\n")
    return tmp_path


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("[a](docs/other.md)", ""),
        ("[a](docs/other.md#a-title-of-code)", ""),
        ("[a](docs/other.md#twice-1)", ""),
        ("# Here\n[a](#here)", ""),
        ("[a](https://example.org/none.md)", ""),
        ("`[a](none.md)` and\n```sh\n[a](none.md)\n```", ""),
        ("[a](docs)", ""),
        ("[a](none.md)", "no such file"),
        ("![a](docs/none.png)", "no such file"),
        ("[a](docs/Other.md)", "no such file"),
        ('<img src="none.png">', "no such file"),
        ("[a](docs/other.md#twice-2)", "no such heading"),
        ("[a](#none)", "no such heading"),
        ("[a](docs#here)", "only a Markdown page"),
        ("[a](../outside.md)", "leads out"),
    ],
)
def test_what_is_a_broken_link(tree, text, wrong):
    page = tree / "README.md"
    page.write_text(text)
    found = list(links.broken(page, tree))
    assert len(found) == bool(wrong)
    assert all(wrong in line and line.startswith("README.md:") for line in found)
