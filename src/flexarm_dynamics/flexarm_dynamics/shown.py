# SPDX-License-Identifier: Apache-2.0
"""Formats any value for a message to people, cut short."""

import reprlib

_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 80
#: Number of a list's entries that are shown.
_REPR.maxlist = _REPR.maxtuple = _REPR.maxset = _REPR.maxdict = _REPR.maxarray = 12
_REPR.maxlevel = 3
#: Max. length of a value in a message [characters].
MAX_LENGTH = 400


def show(value):
    """Any value as text, cut short: a list in a message may have any length, a log line may not."""
    try:
        text = _REPR.repr(value)
    except Exception:  # a value's repr may raise; that of a very long int does
        return f"a {type(value).__name__}"
    return text if len(text) <= MAX_LENGTH else f"{text[:MAX_LENGTH]}…"


def number(value):
    """A number as text, without its type; cut short, as an integer may have a thousand digits."""
    try:
        text = str(value)
    except ValueError:  # Python refuses to write very long integers in decimals
        return show(value)
    return text if len(text) <= 80 else f"{text[:80]}…"


def listed(names):
    """Names with commas between them; of many, the first twelve and the number of the others."""
    names = [name if len(name) <= 80 else f"{name[:80]}…" for name in names]
    text = ", ".join(names[:12])
    return text if len(names) <= 12 else f"{text} and {len(names) - 12} more"
