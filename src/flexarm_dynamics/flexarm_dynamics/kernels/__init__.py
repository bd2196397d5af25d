"""Hot loops: plain Python on arrays, which `kernels.load` compiles with numba."""
