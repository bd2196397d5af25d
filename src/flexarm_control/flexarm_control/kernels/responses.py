# SPDX-License-Identifier: Apache-2.0
"""Linear responses along a motion, which `feedforward.preview` plans with."""

import numpy as np


def responses(spring, damper, by_joints, basis, h, rows, out):
    r"""Fill `out` with what each coefficient of a shift does to the bending.

    Column j of joint i answers to :math:`\ddot\delta = A_\delta\delta + A_{\dot\delta}\dot\delta + \sum_d A_{q^{(d)}}
    e_i\,N_j^{(d)}(t)` from rest, by Runge-Kutta's method.

    Parameters
    ----------
    spring, damper : ndarray, shape (2 s + 1, m, m)
        By deflections and rates, at both ends of each of s steps and in its middle.
    by_joints : ndarray, shape (2 s + 1, m, 3, n)
        By the joints' positions, velocities and accelerations.
    basis : ndarray, shape (3, 2 s + 1, count)
        N_j and its derivatives.
    h : float
        Length of a step [s].
    rows : ndarray of int, shape (k,)
        Whole steps that are kept, ascending; the last one is s.
    out : ndarray, shape (k, 3, m, n count)
        Deflections, rates and accelerations.
    """
    m, columns, steps = spring.shape[1], out.shape[3], (spring.shape[0] - 1) // 2
    x, v = np.zeros((m, columns)), np.zeros((m, columns))
    a1, a2, a3, a4 = np.zeros((4, m, columns))
    there, rate, row = np.zeros((m, columns)), np.zeros((m, columns)), 0
    for step in range(steps + 1):
        k = 2 * step
        answer(spring[k], damper[k], by_joints[k], basis[:, k], x, v, a1)
        if rows[row] == step:
            out[row, 0], out[row, 1], out[row, 2] = x, v, a1
            row += 1
        if step == steps:
            break
        advanced(x, v, 0.5 * h, there)
        advanced(v, a1, 0.5 * h, rate)
        answer(spring[k + 1], damper[k + 1], by_joints[k + 1], basis[:, k + 1], there, rate, a2)
        advanced(x, rate, 0.5 * h, there)
        advanced(v, a2, 0.5 * h, rate)
        answer(spring[k + 1], damper[k + 1], by_joints[k + 1], basis[:, k + 1], there, rate, a3)
        advanced(x, rate, h, there)
        advanced(v, a3, h, rate)
        answer(spring[k + 2], damper[k + 2], by_joints[k + 2], basis[:, k + 2], there, rate, a4)
        # v and the rates of the stages are v, v + h a1 / 2, v + h a2 / 2, v + h a3.
        for i in range(m):
            for c in range(columns):
                x[i, c] += h * v[i, c] + h * h / 6.0 * (a1[i, c] + a2[i, c] + a3[i, c])
                v[i, c] += h / 6.0 * (a1[i, c] + 2.0 * a2[i, c] + 2.0 * a3[i, c] + a4[i, c])


def advanced(x, v, h, out):
    """Fill `out` with x + h v, all (m, k)."""
    for i in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[i, c] = x[i, c] + h * v[i, c]


def answer(spring, damper, by_joints, basis, x, v, out):
    """Fill `out`, (m, n count), with the acceleration of each column; see `responses`."""
    m, n, count = spring.shape[0], by_joints.shape[2], basis.shape[1]
    for i in range(m):
        for j in range(n):
            by = by_joints[i, :, j]
            for c in range(count):
                force = by[0] * basis[0, c] + by[1] * basis[1, c] + by[2] * basis[2, c]
                out[i, j * count + c] = force
        for j in range(m):
            for c in range(n * count):
                out[i, c] += spring[i, j] * x[j, c] + damper[i, j] * v[j, c]
