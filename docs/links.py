# SPDX-License-Identifier: Apache-2.0
"""Checks the links inside the repository's Markdown: ``python docs/links.py``.

It checks every page in ``docs/`` and ``examples/``, the README and CONTRIBUTING. Each link that is not a web address
must name a file or folder of the repository, with the case of its letters. Each ``#anchor`` must be a heading of its
page, in GitHub's spelling of anchors. Standard library only.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FENCE = re.compile(r"^( *)(`{3,}|~{3,}).*?^\1\2[ \t]*$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(`+)(?!`).+?(?<!`)\1(?!`)", re.DOTALL)
LINK = re.compile(r"(?<!\\)\]\(<?([^()\s>]+(?:\([^()\s]*\))?)>?(?:\s+\"[^\"]*\")?\)")
IMAGE = re.compile(r"<(?:img|a)\b[^>]*?(?:src|href)=\"([^\"]+)\"")
DEFINITION = re.compile(r"^ {0,3}\[[^\]]+\]:\s+<?(\S+?)>?\s*$", re.MULTILINE)
HEADING = re.compile(r"^(#{1,6})\s+(.+?)\s*#*\s*$", re.MULTILINE)
TARGET = re.compile(r"^\(([\w.:-]+)\)=\s*$|<a (?:id|name)=\"([^\"]+)\"", re.MULTILINE)


def pages(root=ROOT):
    """Markdown files whose links are checked."""
    found = [
        root / "README.md",
        root / "CONTRIBUTING.md",
        *(root / "docs").rglob("*.md"),
        *(root / "examples").rglob("*.md"),
    ]
    return sorted(path for path in found if path.is_file())


def _blank(match):
    return re.sub(r"[^\n]", " ", match.group())


def anchors(text):
    """Anchors of a page: lower case, no punctuation, hyphens for spaces, ``-1`` after the second of the same name."""
    seen, found = {}, set()
    for _, title in HEADING.findall(FENCE.sub(_blank, text)):
        plain = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", title)
        slug = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        count = seen.get(slug, 0)
        seen[slug] = count + 1
        found.add(f"{slug}-{count}" if count else slug)
    return found | {name for pair in TARGET.findall(text) for name in pair if name}


def links(text):
    """Targets of the links of a page with their line numbers, code excluded."""
    prose = CODE.sub(_blank, FENCE.sub(_blank, text))
    for pattern in (LINK, IMAGE, DEFINITION):
        for match in pattern.finditer(prose):
            yield prose.count("\n", 0, match.start()) + 1, match.group(1)


def as_spelled(path):
    """Whether a path exists with the same case; some file systems ignore case, web servers do not."""
    here = path.resolve()
    if not here.exists():
        return False
    return all(
        part.name in {p.name for p in part.parent.iterdir()}
        for part in (here, *here.parents)
        if ROOT in part.parents
    )


def broken(page, root=ROOT):
    """Broken links of one page, a line of text each."""
    text = page.read_text(encoding="utf-8")
    for line, target in links(text):
        if re.match(r"[a-z][a-z+.-]*:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path) if path else page
        where = f"{page.relative_to(root)}:{line}: {target}"
        if path.startswith("/") or root not in (file.resolve(), *file.resolve().parents):
            yield f"{where}: leads out of the repository"
        elif not as_spelled(file):
            yield f"{where}: no such file"
        elif anchor and (file.suffix != ".md" or not file.is_file()):
            yield f"{where}: only a Markdown page has anchors"
        elif anchor and anchor not in anchors(file.read_text(encoding="utf-8")):
            yield f"{where}: no such heading"


def main():
    """Print every broken link; exit code 1 when there is one."""
    wrong = [line for page in pages() for line in broken(page)]
    print(*wrong, sep="\n", end="\n" if wrong else "")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
