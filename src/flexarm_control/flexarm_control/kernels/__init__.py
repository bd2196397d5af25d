# SPDX-License-Identifier: Apache-2.0
"""What is computed of every sample: plain Python on arrays, which `load.joined` compiles with numba.

The equations are in the modules whose arrays these functions work on.
"""

from functools import cache

from flexarm_dynamics.kernels import load

from . import readings


@cache
def compiled():
    """The compiled functions of `readings`."""
    return load.joined("readings", (load.source(readings),), inline=("larger",))
