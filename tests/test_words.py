# SPDX-License-Identifier: Apache-2.0
"""Words that puzzle readers stay out of the repository's prose and names; each comes with what to write instead."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: A pattern that is out, and what to write instead. Letters match in either case unless a pattern says (?-i:…). A
#: space matches the end of a line, too, with the mark of a comment on the next one. `_` separates words.
OUT = (
    (r"mend(s|ed|ing)?", "fix, fixed, corrected"),
    (r"print's|in print|print (has|is|does|got|gives|says|leaves)", "the published paper"),
    (r"(of|by|from|as|than|beside|because|reproduces?) print", "the published paper, the published numbers"),
    (r"rivals?", "baseline"),
    (r"contenders?", "controller, baseline"),
    (r"told|untold", "reported, published, given, set"),
    (r"said", "reported, stated; or the present tense"),
    (r"heard|hears?|hearing|unheard", "received, receives"),
    (r"nobody|nobody's", "no one who acts: name the process, the user or the message"),
    (r"anybody|anybody's", "untrusted, third-party, any user"),
    (r"whoever", "the one that; if you"),
    (r"for want of", "without, because there is no"),
    (r"save for", "except for"),
    (r"therein|thereof|whence|thereby", "in it, so, from which"),
    (r"rehears(e|es|ed|al|als|ing)", "warm up"),
    (r"as ever", "as before, unchanged"),
    (r"by half as much( again)?", "1.5 times"),
    (r"without help", "automatically"),
    (r"waited for to", "wait until"),
    (r"the one in force|laws? in force|in force", "active"),
    (r"does not say", "unknown, unmodelled"),
    (r"ends? that go(es)? together", "compatible endpoints"),
    (r"so (large|small) a (part|share)", "more than this fraction"),
    (r"put right", "corrected, fixed"),
    (r"on the line|the line's|of the line and|line (of messages|from sensor)", "control path"),
    (r"(a|the|this|what|which|whose|as|its|largest|greatest|wanted) share|shares? of", "fraction, ratio"),
    (r"subjects?", "case; loop under analysis"),
    (r"(state's|states') slopes?|slopes? of (a|the) states?|slope by the state", "derivative, right-hand side"),
    (r"(?-i:(MOST|LEAST|LONGEST|SHORTEST|LARGEST|SMALLEST|GREATEST)_[A-Z0-9_]+)", "MAX_…, MIN_…"),
)  # fmt: skip

#: What may stay, as it stands in a line, and why.
ALLOWED = (
    (r"saturation_share", "a key of the report's JSON"),
    (r"drop share=", "the syntax of a fault, which users write"),
)

SUFFIXES = {".md", ".msg", ".py", ".rst", ".sh", ".toml", ".yaml", ".yml"}
FOLDERS = (
    "config", "docs", "benchmarks", "examples", "fuzz", "soak", "tests", "tools",
    *sorted(f"src/{path.name}" for path in (ROOT / "src").iterdir() if path.is_dir()),
)  # fmt: skip
#: Plain text beside the folders.
LOOSE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.rst", "Makefile", "flexarm", "pyproject.toml")


def _compiled(pattern):
    spaced = pattern.replace(" ", r"\s+(?:(?:#:?|//|\*)\s+)?")
    return re.compile(rf"(?<![^\W_])(?:{spaced})(?![^\W_])", re.IGNORECASE)


PATTERNS = [(_compiled(pattern), instead) for pattern, instead in OUT]
EXCEPTIONS = [re.compile(pattern) for pattern, _ in ALLOWED]


def _blank(match):
    return " " * len(match.group())


def words_out(text):
    """Yield line number, word and substitute of each word of a text that is out."""
    for exception in EXCEPTIONS:
        text = exception.sub(_blank, text)
    for pattern, instead in PATTERNS:
        for match in pattern.finditer(text):
            yield text.count("\n", 0, match.start()) + 1, " ".join(match.group().split()), instead


def listed(paths):
    """Return a line of text for each word that is out in some files."""
    return [
        f"{path.relative_to(ROOT)}:{line}: {word!r}; write: {instead}"
        for path in paths
        for line, word, instead in sorted(words_out(path.read_text(encoding="utf-8")))
    ]


def files(folder):
    """Return the files of a folder that are held to this, without this one."""
    found = (p for p in sorted((ROOT / folder).rglob("*")) if p.suffix in SUFFIXES)
    return [p for p in found if p != Path(__file__).resolve() and ".egg-info" not in str(p)]


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_has_no_word_that_is_out(folder):
    wrong = listed(files(folder))
    assert not wrong, "\n".join(wrong)


def test_texts_at_the_root_have_no_word_that_is_out():
    wrong = listed(ROOT / name for name in LOOSE)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("# It was\n    # for want\n    # of a torque", "for want # of"),
        ("LARGEST_FRICTION = 1e6", "LARGEST_FRICTION"),
        ("the_rivals = []", "rivals"),
        ("as print has it", "print has"),
        ("a share of the samples", "a share"),
    ],
)
def test_the_search_finds(text, word):
    assert word in [found for _, found, _ in words_out(text)]


@pytest.mark.parametrize(
    "text",
    [
        "we recommend print(x)",
        "nodes share memory",
        "flexarm compare --controllers none",
        "least_squares, the largest_value",
        "finite slope of the beam",
    ],
)
def test_the_search_leaves(text):
    assert not list(words_out(text))
