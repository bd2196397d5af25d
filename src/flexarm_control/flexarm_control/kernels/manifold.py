# SPDX-License-Identifier: Apache-2.0
"""What `manifold.expansion` computes of every sample; `solve` is that of `flexarm_dynamics.kernels.rigid`."""

import numpy as np


def expanded(step, order, M, f2, C2, K2, acceleration, f1, C1, K1, out, torque):
    """Deflections of the slow motion at the centre of a stencil of p points, and the torque that goes with them.

    Parameters
    ----------
    step : float
        From one point to the next [s].
    order : int
        In mu.
    M, f2, C2, K2 : ndarray, shapes (p, n + m, n + m), (p, m), (p, m, m), (p, m, m)
        Of (2) at each point, without deflections.
    acceleration : ndarray, shape (p, n)
        Of the joints [rad/s^2].
    f1, C1, K1 : ndarray, shapes (n,), (n, m), (n, m)
        Of (2) at the centre.
    out : ndarray, shape (3, m)
        Filled with deflection, rate and second derivative.
    torque : ndarray, shape (2, n)
        Filled with the torque of the whole motion, and with the bending's beyond order 0 [N m].
    """
    points, n, m = M.shape[0], f1.size, out.shape[1]
    centre = points // 2
    zero, higher = np.zeros((points, m)), np.zeros((points, m))
    speed, bend = np.zeros(m), np.zeros(m)
    for i in range(points):
        for a in range(m):
            zero[i, a] = f2[i, a]
            for j in range(n):
                zero[i, a] += M[i, n + a, j] * acceleration[i, j]
        solve(K2[i].copy(), zero[i])  # noqa: F821
        for a in range(m):
            zero[i, a] = -zero[i, a]
    level, wide = zero.copy(), centre
    for a in range(m):
        out[1, a] = out[2, a] = 0.0
    for k in range(1, order + 1):
        if k % 2 == 1:  # the rates of the level before
            for a in range(m):
                out[1, a] = (level[centre + 1, a] - level[centre - 1, a]) / (2.0 * step)
            continue
        for i in range(centre - wide + 1, centre + wide):
            for a in range(m):
                speed[a] = (level[i + 1, a] - level[i - 1, a]) / (2.0 * step)
                bend[a] = (level[i + 1, a] - 2.0 * level[i, a] + level[i - 1, a]) / step**2
            for a in range(m):
                higher[i, a] = 0.0
                for b in range(m):
                    higher[i, a] += M[i, n + a, n + b] * bend[b] + C2[i, a, b] * speed[b]
            solve(K2[i].copy(), higher[i])  # noqa: F821
            for a in range(m):
                higher[i, a] = zero[i, a] - higher[i, a]
                if i == centre:
                    out[2, a] = bend[a]
        level[:] = higher
        wide -= 1
    for a in range(m):
        out[0, a] = level[centre, a]
    for j in range(n):
        whole, beyond = f1[j], 0.0
        for i in range(n):
            whole += M[centre, j, i] * acceleration[centre, i]
        for a in range(m):
            inertia = M[centre, j, n + a] * out[2, a] + C1[j, a] * out[1, a]
            whole += inertia + K1[j, a] * out[0, a]
            beyond += inertia + K1[j, a] * (out[0, a] - zero[centre, a])
        torque[0, j], torque[1, j] = whole, beyond
