"""Compiled hot loops; set NUMBA_DISABLE_JIT=1 to run the very same code as plain Python."""
