# SPDX-License-Identifier: Apache-2.0
"""Hot loops: plain Python on arrays, which `kernels.load` compiles with numba."""
