# SPDX-License-Identifier: Apache-2.0
"""Whether the links inside the repository's Markdown lead anywhere: ``python docs/links.py``.

Of every page in ``docs/``, the README and the examples, each link that is no web address must be a file or a folder
of the repository, with the case of its letters, and each ``#anchor`` a heading of the page it names, spelled as GitHub
makes anchors of headings.
Standard library alone.
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
    """Anchors of a page: small letters, no punctuation, hyphens for spaces, -1 at the second of a name."""
    seen, found = {}, set()
    for _, title in HEADING.findall(FENCE.sub(_blank, text)):
        plain = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", title)
        slug = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        count = seen.get(slug, 0)
        seen[slug] = count + 1
        found.add(f"{slug}-{count}" if count else slug)
    return found | {name for pair in TARGET.findall(text) for name in pair if name}


def links(text):
    """Targets of the links of a page with their line numbers; those in code are none."""
    prose = CODE.sub(_blank, FENCE.sub(_blank, text))
    for pattern in (LINK, IMAGE, DEFINITION):
        for match in pattern.finditer(prose):
            yield prose.count("\n", 0, match.start()) + 1, match.group(1)


def as_spelled(path):
    """Whether a path exists with the very letters it is written in: a disk may forgive what a web server does not."""
    here = path.resolve()
    if not here.exists():
        return False
    return all(
        part.name in {p.name for p in part.parent.iterdir()}
        for part in (here, *here.parents)
        if ROOT in part.parents
    )


def broken(page, root=ROOT):
    """What is wrong with the links of one page, a line of text each."""
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
