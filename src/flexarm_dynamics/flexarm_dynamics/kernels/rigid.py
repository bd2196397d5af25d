# SPDX-License-Identifier: Apache-2.0
"""The torque of the slow subsystem (10); `singular_perturbation.slow_torque` has its equation."""

import numpy as np


def solve(A, b):
    """Solve A x = b by Gaussian elimination with partial pivoting; A and b are overwritten, b by x.

    A, (k, k), is taken for regular: a pivot of zero gives infinite or NaN values.
    """
    k = b.size
    for i in range(k):
        pivot = i
        for r in range(i + 1, k):
            if abs(A[r, i]) > abs(A[pivot, i]):
                pivot = r
        if pivot != i:
            for c in range(i, k):
                A[i, c], A[pivot, c] = A[pivot, c], A[i, c]
            b[i], b[pivot] = b[pivot], b[i]
        for r in range(i + 1, k):
            factor = A[r, i] / A[i, i]
            if factor != 0.0:
                for c in range(i + 1, k):
                    A[r, c] -= factor * A[i, c]
                b[r] -= factor * b[i]
    for i in range(k - 1, -1, -1):
        value = b[i]
        for c in range(i + 1, k):
            value -= A[i, c] * b[c]
        b[i] = value / A[i, i]


def slow_torque(M, f1, f2, K1, K2, acceleration):
    """Torque that gives the slow subsystem an acceleration, (n,), from the terms of (2)."""
    torque = np.empty(f1.size)
    fill_slow_torque(M, f1, f2, K1, K2.copy(), acceleration, torque)
    return torque


def fill_slow_torque(M, f1, f2, K1, K2, acceleration, torque):
    """As `slow_torque`, into `torque`, (n,); K2 is overwritten, and of M the first n columns are taken."""
    n, m = f1.size, f2.size
    for i in range(n):
        value = f1[i]
        for j in range(n):
            value += M[i, j] * acceleration[j]
        torque[i] = value
    if not K1.any():
        return
    bent = np.empty(m)
    for i in range(m):
        value = f2[i]
        for j in range(n):
            value += M[n + i, j] * acceleration[j]
        bent[i] = value
    solve(K2, bent)
    for i in range(n):
        for j in range(m):
            torque[i] -= K1[i, j] * bent[j]
