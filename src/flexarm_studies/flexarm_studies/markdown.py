# SPDX-License-Identifier: Apache-2.0
"""Text that a run writes into a document, between two lines that mark its place."""

from pathlib import Path

from flexarm_dynamics.errors import FlexarmError


def write_between(file, begin, end, text):
    """Put text between the markers of a Markdown file.

    Parameters
    ----------
    file : str or Path
    begin, end : str
        The markers, which stay.
    text : str

    Raises
    ------
    FlexarmError
        When the file has no markers; it is left as it was.
    """
    path = Path(file)
    whole = path.read_text(encoding="utf-8")
    if begin not in whole or end not in whole:
        raise FlexarmError(f"{file}: no lines {begin} and {end} to write between")
    head, rest = whole.split(begin, 1)
    tail = rest.split(end, 1)[1]
    path.write_text(f"{head}{begin}\n{text}\n{end}{tail}", encoding="utf-8")
