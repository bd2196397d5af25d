# SPDX-License-Identifier: Apache-2.0
"""Odd values and mutations, drawn from one seeded generator: the same number gives the same input."""

import math
from array import array

#: Values that have broken readers before: ends of ranges, NaN and infinities, negative zero, subnormal numbers.
FLOATS = (
    math.nan,
    math.inf,
    -math.inf,
    0.0,
    -0.0,
    5e-324,
    -5e-324,
    1e-30,
    1.0,
    -1.0,
    1e6,
    -1e6,
    999999.9,
    1e9,
    -1e9,
    1e15,
    -1e15,
    1e154,
    1e300,
    1.7976931348623157e308,
    -1.7976931348623157e308,
)
INTS = (0, 1, -1, 2, 7, 255, 2**15, 2**31 - 1, 2**31, -(2**31), 2**32 - 1, 2**53 + 1, 2**63 - 1)
#: Integers that a file can hold, but no field of a message.
HUGE_INTS = (2**63, -(2**63) - 1, 2**64, 10**30, 10**400, 16**5000, -(16**5000))
TEXTS = (
    "",
    " ",
    "joint1",
    "Joint1",
    "joint1 ",
    "nan",
    "inf",
    "1e400",
    "1e-3",
    "none",
    "null",
    "~",
    "true",
    "0x10",
    "\N{GREEK SMALL LETTER DELTA}",
    "\0",
    "a\nb",
    "%s{}[]:,&*!|>'\"",
    "../../etc",
    "x" * 300,
    "\U0001f9be",
)


def floating(rng, near=1.0):
    """A float: often an odd one, otherwise one of the order of `near`."""
    if rng.random() < 0.6:
        return rng.choice(FLOATS)
    return near * rng.uniform(-3.0, 3.0) * 10.0 ** rng.randint(-3, 3)


def unsigned(rng):
    """A uint32 of a message."""
    if rng.random() < 0.5:
        return rng.choice(INTS) % 2**32
    return rng.getrandbits(32)


def text(rng, known=()):
    """A text: an odd one, a known one, or one similar to a known one."""
    if known and rng.random() < 0.6:
        word = rng.choice(known)
        at = rng.randint(0, len(word))
        return rng.choice(
            (word, word[:at], word.upper(), word[:at] + rng.choice("1_ x") + word[at:])
        )
    return rng.choice(TEXTS)


def scalar(rng, near=1.0, known=()):
    """Any scalar that a file, a message or a caller may give."""
    kind = rng.randrange(9)
    if kind < 3:
        return floating(rng, near)
    if kind == 3:
        return rng.choice(INTS)
    if kind == 4:
        return rng.choice(HUGE_INTS)
    if kind == 5:
        return rng.choice((True, False))
    if kind == 6:
        return None
    return text(rng, known)


def anything(rng, near=1.0, known=(), depth=2):
    """A scalar, or lists and mappings of them."""
    kind = rng.randrange(8)
    if depth == 0 or kind < 4:
        return scalar(rng, near, known)
    if kind < 7:
        return [anything(rng, near, known, depth - 1) for _ in range(rng.randint(0, 4))]
    return {
        text(rng, known): anything(rng, near, known, depth - 1) for _ in range(rng.randint(0, 3))
    }


def names(rng, given):
    """The `given` names in another order, or with missing, repeated, unknown or too many names."""
    out, kind = list(given), rng.randrange(8)
    if kind < 2:
        rng.shuffle(out)
    elif kind == 2 and out:
        out.pop(rng.randrange(len(out)))
    elif kind == 3 and out:
        out[rng.randrange(len(out))] = rng.choice(out)
    elif kind == 4 and out:
        out[rng.randrange(len(out))] = text(rng, given)
    elif kind == 5:
        out.insert(rng.randint(0, len(out)), text(rng, given))
    elif kind == 6:
        out = []
    else:
        out = [text(rng, given) for _ in range(rng.choice((1, 2, 50, 1000)))]
    return out


def floats(rng, values):
    """An array of a message, with odd values or another length."""
    try:
        out, kind = array("d", values), rng.randrange(6)
    except (TypeError, OverflowError):  # spoilt already
        return values
    if kind < 3:
        for _ in range(rng.randint(1, 2) if out else 0):
            out[rng.randrange(len(out))] = floating(rng)
    elif kind == 3:
        return array("d")
    elif kind == 4 and out:
        out.pop()
    else:
        out.extend(floating(rng) for _ in range(rng.choice((1, 1, 2, 500))))
    return out


def mangled(rng, data):
    """Bytes of which a few are changed, doubled, removed or inserted."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at, kind = rng.randint(0, len(data)), rng.randrange(6)
        if kind == 0 and at < len(data):
            data[at] = rng.randrange(256)
        elif kind == 1:
            data[at:at] = rng.choice(
                (b"-", b":", b"[", b"]", b"{", b"!!int ", b"\n", b"&a ", b"*a", b"\t")
            )
        elif kind == 2:
            del data[at : at + rng.randint(1, 12)]
        elif kind == 3:
            piece = data[at : at + rng.randint(1, 40)]
            data[at:at] = piece
        elif kind == 4:
            data[at:at] = rng.choice(
                (b"9" * 30, b"1e999", b".nan", b"-.inf", b"0x" + b"f" * 4500, b"\xff")
            )
        elif rng.random() < 0.2:
            del data[at:]
    return bytes(data)


def places(tree, path=()):
    """Paths of everything in lists and mappings, including the containers."""
    found = []
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        found.append((*path, key))
        if isinstance(value, (dict, list)):
            found += places(value, (*path, key))
    return found


def altered(rng, tree, known=()):
    """Change a few places of a tree of lists and mappings, in place: other, removed, repeated or new values or keys."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        there = places(tree)
        if not there:
            break
        *path, key = rng.choice(there)
        holder = tree
        for step in path:
            holder = holder[step]
        kind = rng.randrange(7)
        if kind < 3:
            value = holder[key]
            close = isinstance(value, float) and rng.random() < 0.5
            holder[key] = value * rng.uniform(-2.0, 3.0) if close else anything(rng, known=known)
        elif kind == 3:
            del holder[key]
        elif kind == 4 and isinstance(holder, list):
            holder.insert(key, holder[key])
        elif kind == 5 and isinstance(holder, dict):
            holder[text(rng, tuple(k for k in holder if isinstance(k, str)) or known)] = holder.pop(
                key
            )
        elif isinstance(holder, dict):
            holder[text(rng, known)] = anything(rng, known=known)
    return tree
