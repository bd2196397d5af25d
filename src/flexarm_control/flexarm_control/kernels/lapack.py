# SPDX-License-Identifier: Apache-2.0
"""LAPACK's routines for compiled functions.

They are scipy's, without the checks of `scipy.linalg`, which cost more than the work on small matrices.
Each takes what Fortran takes, as pointers (``array.ctypes``): matrices by columns, numbers as arrays of one.
"""

import ctypes

#: By name, with the number of their arguments: reduction to Hessenberg form, and the eigenvalues of such a matrix.
ROUTINES = {"dgehrd": 9, "dhseqr": 14}


def routines():
    """The `ROUTINES` by name, as numba calls them.

    What is compiled refers to them by a symbol, not by an address: numba may keep it for later processes. With
    ``NUMBA_DISABLE_JIT=1`` they are functions that Python calls.

    Raises
    ------
    ImportError
        Where scipy's integers do not have 32 bits.
    """
    import llvmlite.binding
    from numba import config, types
    from numba.extending import get_cython_function_address
    from scipy.linalg import cython_lapack

    found = {}
    for name, count in ROUTINES.items():
        address = get_cython_function_address("scipy.linalg.cython_lapack", name)
        if "int *" not in str(cython_lapack.__pyx_capi__[name]):
            raise ImportError(f"scipy's {name} takes no integers of 32 bits: install another scipy")
        if config.DISABLE_JIT:
            found[name] = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * count)(address)
            continue
        llvmlite.binding.add_symbol(f"flexarm_{name}", address)
        found[name] = types.ExternalFunction(
            f"flexarm_{name}", types.void(*[types.voidptr] * count)
        )
    return found
