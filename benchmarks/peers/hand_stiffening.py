# SPDX-License-Identifier: Apache-2.0
r"""One planar link that stiffens, two modes, written out by hand: loops in numba, scalars throughout.

A point of the axis is at (x - s, y) with :math:`y = \sum\varphi_j\delta_j` and :math:`s = \delta^Ta\delta`,
:math:`a_{jk} = \frac12\int_0^x\varphi_j'\varphi_k'`. With :math:`P_j = \partial s/\partial\delta_j` its accelerations
across and along,

.. math::
    \ddot y + \ddot q(x-s) - 2\dot q\dot s - \dot q^2y, \qquad -\ddot s - \ddot qy - 2\dot q\dot y - \dot q^2(x-s),

are multiplied by :math:`\varphi_j` and :math:`-P_j`, by x - s and -y, and integrated over the mass, payload included.
All integrals are polynomials whose coefficients are constants.
"""

import numpy as np
from numba import njit

from .hand_loops import one_link_runner

#: Pairs of modes.
PAIRS = ((0, 0), (0, 1), (1, 1))


def constants(data, parameters):
    """Constants of `one_stiff_link`, a tuple of floats, from a chain's `Data` of one link and a case's parameters."""
    G = data.nodes
    x = np.append(data.node_x[0, :G], parameters["L"])
    mass = np.append(data.node_mass[0, :G], parameters["Mp"])
    phi = np.vstack([data.node_phi[0, :G, :2], data.tip[0, :2]])
    tip = data.slope[0, :2]
    slope = data.node_slope[0, :G, :2]
    a = np.array([0.5 * (slope[:, j] * slope[:, k]) @ data.cumulate[0] for j, k in PAIRS])
    still = parameters["Jh"] + mass @ x**2 + parameters["Jp"]
    gram = (phi.T * mass) @ phi
    lever = (mass * x) @ phi + parameters["Jp"] * tip
    M = gram + parameters["Jp"] * np.outer(tip, tip)
    D = 4.0 * (a * mass) @ a.T
    C = 2.0 * (a * mass) @ phi
    pairs = [(m[0, 0], m[0, 1], m[1, 1]) for m in (M, gram, data.stiffness[0, :2, :2])]
    xa = 2.0 * a @ (mass * x)
    values = [still, *lever, *np.ravel(pairs), *xa, *C.ravel(), *D[np.triu_indices(3)]]
    return tuple(float(v) for v in values)


@njit(inline="always", cache=True)
def one_stiff_link(k, x1, x2, r, v1, v2, torque):
    """Accelerations of (q, delta1, delta2) at amplitudes x, hub rate r and amplitude rates v."""
    (
        still, e1, e2, m11, m12, m22, g11, g12, g22, w11, w12, w22, b11, b12, b22,
        c111, c112, c121, c122, c221, c222, d00, d01, d02, d11, d12, d22,
    ) = k  # fmt: skip
    vv11, vv12, vv22, rr = v1 * v1, 2.0 * v1 * v2, v2 * v2, r * r
    # 2 int P_j a_p dm for the three pairs p
    t10, t11, t12 = d00 * x1 + d01 * x2, d01 * x1 + d11 * x2, d02 * x1 + d12 * x2
    t20, t21, t22 = d01 * x1 + d02 * x2, d11 * x1 + d12 * x2, d12 * x1 + d22 * x2
    p11, p12, p22 = t10 * x1 + t11 * x2, t11 * x1 + t12 * x2, t21 * x1 + t22 * x2
    sp1, sp2 = 0.5 * (p11 * x1 + p12 * x2), 0.5 * (p12 * x1 + p22 * x2)
    xp1, xp2 = b11 * x1 + b12 * x2, b12 * x1 + b22 * x2
    xx = 0.5 * ((sp1 - 2.0 * xp1) * x1 + (sp2 - 2.0 * xp2) * x2)
    xp1, xp2 = xp1 - sp1, xp2 - sp2
    # int P_j phi_l dm
    f11, f12 = c111 * x1 + c121 * x2, c112 * x1 + c122 * x2
    f21, f22 = c121 * x1 + c221 * x2, c122 * x1 + c222 * x2
    bent1, bent2 = g11 * x1 + g12 * x2, g12 * x1 + g22 * x2
    l1 = e1 + f11 * x1 + f12 * x2 - 0.5 * (f11 * x1 + f21 * x2)
    l2 = e2 + f21 * x1 + f22 * x2 - 0.5 * (f12 * x1 + f22 * x2)
    h1 = rr * (bent1 - xp1) + 2.0 * r * (f11 * v1 + f21 * v2 - f11 * v1 - f12 * v2)
    h2 = rr * (bent2 - xp2) + 2.0 * r * (f12 * v1 + f22 * v2 - f21 * v1 - f22 * v2)
    h1 -= t10 * vv11 + t11 * vv12 + t12 * vv22 + w11 * x1 + w12 * x2
    h2 -= t20 * vv11 + t21 * vv12 + t22 * vv22 + w12 * x1 + w22 * x2
    h0 = torque + 2.0 * r * ((xp1 - bent1) * v1 + (xp2 - bent2) * v2)
    h0 -= x1 * (c111 * vv11 + c121 * vv12 + c221 * vv22)
    h0 -= x2 * (c112 * vv11 + c122 * vv12 + c222 * vv22)
    a11, a12, a22 = m11 + p11, m12 + p12, m22 + p22
    over = 1.0 / (a11 * a22 - a12 * a12)
    by1, by2 = (a22 * l1 - a12 * l2) * over, (a11 * l2 - a12 * l1) * over
    acc = (h0 - by1 * h1 - by2 * h2) / (still + xx + x1 * bent1 + x2 * bent2 - by1 * l1 - by2 * l2)
    h1, h2 = h1 - l1 * acc, h2 - l2 * acc
    return acc, (a22 * h1 - a12 * h2) * over, (a11 * h2 - a12 * h1) * over


run = one_link_runner(one_stiff_link)
