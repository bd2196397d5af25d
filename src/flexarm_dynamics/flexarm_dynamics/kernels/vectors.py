# SPDX-License-Identifier: Apache-2.0
"""Products of vectors and matrices with three rows, written out for `kernels.chain`."""

import numpy as np


def cross(a, b, out):
    """Out = a x b."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


def dot(a, b):
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def apply(R, a, out):
    """Out = R a."""
    for i in range(3):
        out[i] = R[i, 0] * a[0] + R[i, 1] * a[1] + R[i, 2] * a[2]


def apply_transposed(R, a, out):
    """Out = R' a."""
    for i in range(3):
        out[i] = R[0, i] * a[0] + R[1, i] * a[1] + R[2, i] * a[2]


def product(A, B, out):
    """Out = A B."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


def congruence(R, A, scratch, out):
    """Out = R A R'."""
    product(R, A, scratch)
    for i in range(3):
        for j in range(3):
            out[i, j] = scratch[i, 0] * R[j, 0] + scratch[i, 1] * R[j, 1] + scratch[i, 2] * R[j, 2]


def symmetric_congruence(R, A, scratch, out):
    """Out = R A R' for a symmetric A."""
    product(R, A, scratch)
    for i in range(3):
        for j in range(i + 1):
            out[i, j] = scratch[i, 0] * R[j, 0] + scratch[i, 1] * R[j, 1] + scratch[i, 2] * R[j, 2]
            out[j, i] = out[i, j]


def about_axis(a, angle, out):
    """Out = rotation by an angle about the unit vector a: a a' + (1 - a a') cos + [a] sin."""
    s, c = np.sin(angle), np.cos(angle)
    for i in range(3):
        out[i, i] = a[i] * a[i] + (1.0 - a[i] * a[i]) * c
        for j in range(i):
            out[i, j] = a[i] * a[j] - a[i] * a[j] * c
            out[j, i] = out[i, j]
    out[0, 1] -= a[2] * s
    out[1, 0] += a[2] * s
    out[0, 2] += a[1] * s
    out[2, 0] -= a[1] * s
    out[1, 2] -= a[0] * s
    out[2, 1] += a[0] * s


def skew(a, out):
    """Out = a x as a matrix."""
    out[0, 0], out[1, 1], out[2, 2] = 0.0, 0.0, 0.0
    out[0, 1], out[0, 2], out[1, 2] = -a[2], a[1], -a[0]
    out[1, 0], out[2, 0], out[2, 1] = a[2], -a[1], a[0]
