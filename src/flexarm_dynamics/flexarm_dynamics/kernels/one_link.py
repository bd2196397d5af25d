# SPDX-License-Identifier: Apache-2.0
r"""Right-hand side of one flexible link.

The equations of motion (2) of one link with m modes, every term of which is in `one_link.Coefficients`:

.. math::
    \begin{bmatrix} J + \delta^T G\delta & h^T \\ h & M_{22}\end{bmatrix}
    \begin{bmatrix}\ddot q\\ \ddot\delta\end{bmatrix}
    + \begin{bmatrix} 2\dot q\,\delta^T G\dot\delta + f_1 + k_1^T\delta \\
                      D\dot\delta + (K_e - \dot q^2 G)\delta + f_2\end{bmatrix}
    = \begin{bmatrix}\tau\\0\end{bmatrix}.

`M22` and `h` are constant: the inverse of `M22` is part of the data, and an evaluation factorises nothing.
"""

import numpy as np


def terms_along(motions, data, friction, f1, f2, K1, K2):
    """Fill terms of (2) that are not constant, without deflections, at k states of the joint.

    Parameters
    ----------
    motions : ndarray, shape (k, 3, 1)
        Position [rad], velocity [rad/s]; and acceleration, which is not taken.
    data : tuple of ndarray
        As of `derivative`.
    friction : ndarray, shape (3,)
        Viscous, Coulomb, smoothing speed.
    f1, f2, K1, K2 : ndarray, shape (k, 1), (k, m), (k, 1, m), (k, m, m)
    """
    scalars, _, _, _, g, k, _, s = data
    moment, gx, gy = scalars[1], scalars[2], scalars[3]
    for p in range(motions.shape[0]):
        q, qd = motions[p, 0, 0], motions[p, 1, 0]
        cos, sin = np.cos(q), np.sin(q)
        along, across = gx * cos + gy * sin, -gx * sin + gy * cos
        f1[p, 0] = friction[0] * qd - moment * across
        if friction[1] != 0.0:
            f1[p, 0] += friction[1] * np.tanh(qd / friction[2])
        for i in range(s.size):
            f2[p, i], K1[p, 0, i] = -s[i] * across, s[i] * along
            for j in range(s.size):
                K2[p, i, j] = k[i, j] - qd * qd * g[i, j]


def derivative(state, torque, data, out):
    """Fill `out` with the time derivative of `state`.

    Parameters
    ----------
    state : ndarray, shape (2 + 2 m,)
        (q, delta, qd, delta_d) [rad, m, rad/s, m/s].
    torque : ndarray, shape (1,)
        Joint torque, friction taken off [N m].
    data : tuple of ndarray
        scalars (4,): J, first moment of mass, gravity along x and y of the joint's frame; then h, a, ah, g, k,
        d, s: coupling (m,), inverse of M22 (m, m), their product (m,), centrifugal (m, m), stiffness (m, m),
        damping (m, m), gravity on the modes (m,).
    out : ndarray, shape (2 + 2 m,)
        Written.
    """
    scalars, h, a, ah, g, k, d, s = data
    m = h.size
    q, qd = state[0], state[1 + m]
    rigid, moment, gx, gy = scalars[0], scalars[1], scalars[2], scalars[3]
    cos, sin = np.cos(q), np.sin(q)
    along, across = gx * cos + gy * sin, -gx * sin + gy * cos

    inertia = rigid
    r1 = torque[0] + moment * across
    coupling = 0.0
    for i in range(m):
        gi = 0.0
        ri = s[i] * across
        for j in range(m):
            gi += g[i, j] * state[1 + j]
            ri -= k[i, j] * state[1 + j] + d[i, j] * state[2 + m + j]
        inertia += state[1 + i] * gi
        r1 -= 2.0 * qd * gi * state[2 + m + i] + s[i] * along * state[1 + i]
        r2 = ri + qd * qd * gi
        coupling += ah[i] * r2
        inertia -= h[i] * ah[i]
        out[2 + m + i] = r2
    qdd = (r1 - coupling) / inertia
    # M22^-1 r2 in place of r2, by way of a copy.
    for i in range(m):
        out[1 + i] = out[2 + m + i]
    for i in range(m):
        acc = -ah[i] * qdd
        for j in range(m):
            acc += a[i, j] * out[1 + j]
        out[2 + m + i] = acc
    out[0] = qd
    out[1 + m] = qdd
    for i in range(m):
        out[1 + i] = state[2 + m + i]
