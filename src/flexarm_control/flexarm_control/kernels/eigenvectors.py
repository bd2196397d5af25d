# SPDX-License-Identifier: Apache-2.0
"""Eigenvectors of a Hessenberg matrix by inverse iteration: see `robust.decay` for what they are for."""

import numpy as np

#: Shift from the eigenvalue, relative and absolute: the matrix is not singular to the last bit.
RELATIVE, ABSOLUTE = 1e-10, 1e-14
#: Steps of inverse iteration.
STEPS = 2


def unit(vector):
    """The vector over its length."""
    return vector / np.sqrt((vector.real**2 + vector.imag**2).sum())


def eigenvectors(H, z):
    r"""Right and left eigenvector of an eigenvalue z, of length 1.

    With one row exchange P_k and one elimination E_k for each column, :math:`E_{N-2}P_{N-2}\dots E_0P_0(H-zI) = U`;
    both systems with this matrix and its conjugate transpose take O(N^2) steps.

    Parameters
    ----------
    H : ndarray, shape (N, N)
        What is below its first subdiagonal counts as zero.
    z : complex

    Returns
    -------
    x, y : ndarray, shape (N,)
        H x = z x, y^H H = z y^H; not finite where the shifted matrix is singular to the last bit.
    """
    size = H.shape[0]
    U = H.astype(np.complex128)
    for k in range(size):
        U[k, k] -= z * (1.0 + RELATIVE) + ABSOLUTE
    factor, exchanged = np.zeros(size, np.complex128), np.zeros(size, np.bool_)
    for k in range(size - 1):
        if abs(U[k + 1, k]) > abs(U[k, k]):
            exchanged[k] = True
            for j in range(k, size):
                U[k, j], U[k + 1, j] = U[k + 1, j], U[k, j]
        factor[k] = f = U[k + 1, k] / U[k, k]
        for j in range(k + 1, size):
            U[k + 1, j] -= f * U[k, j]
    x = np.cos(1.0 + np.arange(size)).astype(np.complex128)
    y = x.copy()
    for _ in range(STEPS):
        for k in range(size - 1):
            if exchanged[k]:
                x[k], x[k + 1] = x[k + 1], x[k]
            x[k + 1] -= factor[k] * x[k]
        for i in range(size - 1, -1, -1):
            total = x[i]
            for j in range(i + 1, size):
                total -= U[i, j] * x[j]
            x[i] = total / U[i, i]
        x = unit(x)
        for i in range(size):
            y[i] /= np.conj(U[i, i])
            for j in range(i + 1, size):
                y[j] -= np.conj(U[i, j]) * y[i]
        for k in range(size - 2, -1, -1):
            y[k] -= np.conj(factor[k]) * y[k + 1]
            if exchanged[k]:
                y[k], y[k + 1] = y[k + 1], y[k]
        y = unit(y)
    return x, y
