# SPDX-License-Identifier: Apache-2.0
"""Joins source files of kernels into one module, compiled by numba or left as plain Python.

A compiled module is a file of its own in the cache directory, named by a hash of its source: numba's cache
beside it can't be stale, and right-hand side and integrator are one unit for its optimiser.

numba names the compiled code of a function by the types of its arguments, but a record by a number that it counts up
in each process, and a nested array without its shape. Code that two processes have put into the cache, for two arms,
then has one name for two layouts of memory; a third process that loads both runs one for the other, and reads and
writes beside the arrays. So `named_by_layout` gives both types a name that is made from their whole layout.
"""

import hashlib
import importlib.util
import inspect
import os
import re
import sys
import tempfile
import types
from pathlib import Path

#: a*b + c in one rounding where the machine has it; nothing that would hide a NaN.
OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}}


#: Imports from modules beside one.
BESIDE = re.compile(r"^from \.\w+ import (\([^)]*\)|.*)\n", re.MULTILINE)
#: Part of each module's name: what numba made under other symbols is not read again.
SYMBOLS = "by layout"


def named_by_layout():
    """Let the symbols of compiled code tell all layouts of records and nested arrays apart, in every process.

    It overrides `mangling_args`, which numba has its types override for this; it can go when numba's own are unique.

    Returns
    -------
    module
        numba's `types`.
    """
    from numba import types

    for kind in (types.Record, types.NestedArray):
        kind.mangling_args = property(_layout)
    return types


def _layout(kind):
    return type(kind).__name__, (hashlib.sha256(kind.name.encode()).hexdigest()[:16],)


def cache_directory():
    """Where joined and generated sources and what numba made of them are kept.

    ``FLEXARM_CACHE``, else the user's cache directory, else a temporary one.
    """
    given = os.environ.get("FLEXARM_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    for place in (given, Path(base) / "flexarm") if given else (Path(base) / "flexarm",):
        try:
            Path(place).mkdir(parents=True, exist_ok=True)
            if os.access(place, os.W_OK):
                return Path(place)
        except OSError:
            continue
    return Path(tempfile.mkdtemp(prefix="flexarm-"))


def joined(name, sources, compiled=True, inline=(), given=None):
    """A module made of several sources.

    Parameters
    ----------
    name : str
        Start of the module's name.
    sources : sequence of str
        Python source; a later one may use the functions of an earlier one.
    compiled : bool
        Compile every function with numba, on first call.
    inline : sequence of str
        Functions to be written out where they are called.
    given : module, optional
        A module made before, whose function `sums_at_nodes` the sources call.

    Returns
    -------
    module
    """
    text = "\n\n".join(sources)
    # How it is compiled is part of what numba's cache must not mix up.
    text += f"\n\n# inline: {', '.join(inline)}\n# symbols: {SYMBOLS}\n"
    if given is not None:
        text += f"# with: {given.__name__}\n"
    full = f"flexarm_{name}_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    key = full if compiled else f"{full}_plain"
    if key in sys.modules:
        return sys.modules[key]
    path = cache_directory() / f"{full}.py"
    if not path.is_file():
        # Whole or not at all, also when two processes start at once.
        with tempfile.NamedTemporaryFile(
            "w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8"
        ) as file:
            file.write(text)
        os.replace(file.name, path)
    spec = importlib.util.spec_from_file_location(key, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[key] = module
    spec.loader.exec_module(module)
    if given is not None:
        module.sums_at_nodes = given.sums_at_nodes
    if compiled:
        from numba import njit

        named_by_layout()
        for attribute, value in list(vars(module).items()):
            if isinstance(value, types.FunctionType) and value.__module__ == key:
                always = "always" if attribute in inline else "never"
                setattr(module, attribute, njit(inline=always, **OPTIONS)(value))
    return module


def source(module):
    """Source text of a module, without imports from modules beside it: in a joined one their sources come before it."""
    return BESIDE.sub("", inspect.getsource(module))
