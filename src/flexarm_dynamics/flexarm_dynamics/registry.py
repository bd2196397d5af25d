# SPDX-License-Identifier: Apache-2.0
"""Finds components by name through Python entry points, so a user's package can add one."""

import difflib
import warnings
from functools import cache
from importlib.metadata import entry_points

from .errors import UnknownComponentError


@cache
def names(group):
    """Sorted names that installed packages provide in an entry-point group."""
    return tuple(sorted({e.name for e in entry_points(group=group)}))


def importable(group):
    """Classes by name of the components that can be imported; a broken package does not affect the others.

    A component that can't be imported is an error only when `find` asks for it.

    `group` is an entry-point group, for example ``flexarm.slow_laws``.
    """
    found = {}
    for name in names(group):
        try:
            found[name] = find(group, name)
        except UnknownComponentError as error:
            warnings.warn(str(error), stacklevel=2)
    return found


@cache
def find(group, name):
    """The class registered as `name` in `group`, for example ``flexarm.slow_laws``.

    Raises
    ------
    UnknownComponentError
        With a list of the available names, or with the reason why a registered class can't be imported.
    """
    found = [e for e in entry_points(group=group) if e.name == name]
    if not found:
        close = difflib.get_close_matches(name, names(group), 1)
        known = ", ".join(names(group)) or "none; is the workspace built and sourced?"
        raise UnknownComponentError(
            "is provided by no installed package",
            field=group,
            value=name,
            limit=f"there are: {known}",
            hint=f"did you mean {close[0]!r}?" if close else "",
        )
    try:
        return found[0].load()
    except Exception as error:
        problem = f"({found[0].value}) can't be imported: {type(error).__name__}: {error}"
        raise UnknownComponentError(problem, field=group, value=name) from error
