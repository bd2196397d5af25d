# SPDX-License-Identifier: Apache-2.0
"""Writes Markdown: tables, and text between two markers of a document."""

from pathlib import Path

from flexarm_dynamics.errors import FlexarmError


def table(columns, rows):
    """Lines of a Markdown table with `columns` and `rows`; floats get three digits, and None is a dash."""
    lines = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
    return lines + ["| " + " | ".join(map(_cell, row)) + " |" for row in rows]


def _cell(value):
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}"
    return "-" if value is None else str(value)


def write_between(file, begin, end, text):
    """Replace the text between the markers `begin` and `end`, which stay, of a Markdown `file`.

    A file without markers is refused and left unchanged.
    """
    path = Path(file)
    whole = path.read_text(encoding="utf-8")
    if begin not in whole or end not in whole:
        raise FlexarmError(f"has no lines {begin} and {end}", field=str(file))
    head, rest = whole.split(begin, 1)
    tail = rest.split(end, 1)[1]
    path.write_text(f"{head}{begin}\n{text}\n{end}{tail}", encoding="utf-8")
