# SPDX-License-Identifier: Apache-2.0
"""Components found by name through Python entry points, so that a user's package adds one."""

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
    """Name to class of what can be imported; one broken package does not take the others with it.

    What can't be imported is an error when it is asked for, by `find`.

    `group` is an entry-point group, ``flexarm.slow_laws`` say.
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
        Listing what there is; or saying why a registered one can't be imported.
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
