# SPDX-License-Identifier: Apache-2.0
"""What is computed very often: plain Python on arrays, which `load.joined` compiles with numba.

The equations are in the modules whose arrays these functions work on.
"""

from functools import cache

from flexarm_dynamics.kernels import load, rigid

from . import (
    eigenvectors,
    lapack,
    law,
    limits,
    manifold,
    poles,
    readings,
    responses,
    steps,
    strains,
)


@cache
def compiled():
    """The compiled functions of all modules here."""
    sources = [
        load.source(module)
        for module in (
            rigid,
            eigenvectors,
            law,
            limits,
            manifold,
            poles,
            readings,
            responses,
            steps,
            strains,
        )
    ]
    module = load.joined("control", sources, inline=("larger", "unit", "solve"))
    vars(module).update(lapack.routines())
    return module
