# SPDX-License-Identifier: Apache-2.0
"""Frames along a link, of its tip and of what sits on it, at finite slopes as well; see `kernels.chain`.

Throughout, d is the arm's `chain_data.Data`, w its `chain_data.Work`, and i the number of a link.
"""

import numpy as np

from .chain_data import FINITE_SLOPE, FIRST_ORDER, SHORT_TIP, SHORT_TIP_DD, TWIST, Y, Z
from .vectors import apply, apply_transposed, cross, dot, product, symmetric_congruence


def slopes_and_bends(d, i, g, delta):
    """Slopes y', z' and second derivatives y'', z'' of link i at node g."""
    sy, sz, by, bz = 0.0, 0.0, 0.0, 0.0
    for j in range(d.count[i]):
        x = delta[d.first[i] + j]
        if d.direction[i, j] == Y:
            sy += d.node_slope[i, g, j] * x
            by += d.node_bend[i, g, j] * x
        elif d.direction[i, j] == Z:
            sz += d.node_slope[i, g, j] * x
            bz += d.node_bend[i, g, j] * x
    return sy, sz, by, bz


def orient(w, n, a, b, twist, ad, bd, twist_d, add, bdd, twist_dd, om, carried):
    """Frame Rz(a) Ry(-b) Rx(twist) of row n, its angular bias and, into `carried`, its angular velocity.

    Of the angles, their rates ad, bd, twist_d, what their second derivatives have along delta_d (add, bdd, twist_dd),
    and the link's angular velocity om. t[1] and t[2] become the axes about which b and the twist turn.
    """
    t, frame = w.t, w.frame[n]
    sa, ca, sb, cb = np.sin(a), np.cos(a), np.sin(b), np.cos(b)
    st, ct = np.sin(twist), np.cos(twist)
    # The tangent, and the section's axes.
    across, along = t[1], t[2]
    across[0], across[1], across[2] = sa, -ca, 0.0  # -y axis after Rz(a)
    along[0], along[1], along[2] = ca * cb, sa * cb, sb
    frame[0, 0], frame[1, 0], frame[2, 0] = along[0], along[1], along[2]
    frame[0, 1], frame[1, 1], frame[2, 1] = (
        -sa * ct - ca * sb * st,
        ca * ct - sa * sb * st,
        cb * st,
    )
    frame[0, 2], frame[1, 2], frame[2, 2] = (
        sa * st - ca * sb * ct,
        -ca * st - sa * sb * ct,
        cb * ct,
    )
    turn, spin = t[3], t[4]
    for k in range(3):
        turn[k] = bd * across[k]
    turn[2] += ad
    for k in range(3):
        spin[k] = turn[k] + twist_d * along[k]
    # al_bias = w x spin + (a'' z + b'' across + t'' along) + a' z x b' across + turn x t' along
    bias_al = w.bias_al[n]
    cross(om, spin, bias_al)
    cross(turn, along, t[5])
    for k in range(3):
        bias_al[k] += bdd * across[k] + twist_dd * along[k] + twist_d * t[5, k]
    bias_al[2] += add
    bias_al[0] += ad * bd * ca
    bias_al[1] += ad * bd * sa
    for k in range(3):
        carried[k] = om[k] + spin[k]


def swing(w, n, om, rate):
    """Acceleration w x (w x arm) + 2 w x rate of row n's section, its link turning with om, into its bias."""
    t = w.t
    cross(om, w.arm[n], t[5])
    for k in range(3):
        t[5, k] += 2.0 * rate[k]
    cross(om, t[5], w.bias_a[n])


def section(
    d, w, i, x, deflection, slopes, bishop, short, short_dd, draws, delta, delta_d, om, carried
):
    """A section of link i: frame, partial velocities and biases, into row i + 1 of the work space.

    It is at x along the link; `deflection`, `slopes` and `bishop` are what the modes give there. `short`, `short_dd`
    and `draws` are the foreshortening, its second derivative along delta_d, and its partials; `om` is the link's
    angular velocity, and `carried` becomes the section's, in link coordinates.
    """
    K, first, n = d.count[i], d.first[i], i + 1
    arm, t = w.arm[n], w.t
    short_d = 0.0
    if d.level != FIRST_ORDER:
        for j in range(K):
            if d.direction[i, j] != TWIST:
                short_d += draws[j] * delta_d[first + j]
    for k in range(3):
        arm[k] = d.root[i, k]
    arm[0] += x - short
    rate = t[0]
    rate[0], rate[1], rate[2] = -short_d, 0.0, 0.0
    sy, sz, syd, szd, twist, twist_d, twist_dd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(K):
        kind = d.direction[i, j]
        z, v = delta[first + j], delta_d[first + j]
        for k in range(3):
            w.partial[n, j, k] = 0.0
        if kind == TWIST:
            twist += slopes[j] * z
            twist_d += slopes[j] * v
            continue
        arm[kind] += deflection[j] * z
        rate[kind] += deflection[j] * v
        w.partial[n, j, kind] = deflection[j]
        if d.level != FIRST_ORDER:
            w.partial[n, j, 0] = -draws[j]
        if kind == Y:
            sy += slopes[j] * z
            syd += slopes[j] * v
        else:
            sz += slopes[j] * z
            szd += slopes[j] * v
    # Angles a about z, b about -y, with derivatives by the slopes (y', z').
    a, b, ay, az, bz = sy, sz, 1.0, 0.0, 1.0
    add, bdd = 0.0, 0.0
    if d.level == FINITE_SLOPE:
        cc = 1.0 - sz * sz
        c = np.sqrt(cc)
        rr = cc - sy * sy
        r = np.sqrt(rr)
        a, b = np.arcsin(sy / c), np.arcsin(sz)
        ay, az, bz = 1.0 / r, sy * sz / (cc * r), 1.0 / c
        ayy = sy / (rr * r)
        ayz = sz / (rr * r)
        azz = sy / (cc * r) * (1.0 + sz * sz / rr + 2.0 * sz * sz / cc)
        add = ayy * syd * syd + 2.0 * ayz * syd * szd + azz * szd * szd
        bdd = sz / (cc * c) * szd * szd
    if d.level != FIRST_ORDER:
        # A beam that does not twist turns about its axis by -int a' sin b dx, at second order -int y'' z'.
        for j in range(K):
            for k in range(K):
                g = bishop[j, k]
                twist -= g * delta[first + j] * delta[first + k]
                twist_d -= g * (
                    delta_d[first + j] * delta[first + k] + delta[first + j] * delta_d[first + k]
                )
                twist_dd -= 2.0 * g * delta_d[first + j] * delta_d[first + k]
    ad, bd = ay * syd + az * szd, bz * szd
    orient(w, n, a, b, twist, ad, bd, twist_d, add, bdd, twist_dd, om, carried)
    across, along = t[1], t[2]
    for j in range(K):
        kind, slope = d.direction[i, j], slopes[j]
        ga, gb, gt = 0.0, 0.0, 0.0
        if kind == Y:
            ga = ay * slope
        elif kind == Z:
            ga, gb = az * slope, bz * slope
        else:
            gt = slope
        if d.level != FIRST_ORDER:
            for k in range(K):
                gt -= (bishop[j, k] + bishop[k, j]) * delta[first + k]
        for k in range(3):
            w.turning[n, j, k] = gb * across[k] + gt * along[k]
        w.turning[n, j, 2] += ga
    swing(w, n, om, rate)
    w.bias_a[n, 0] -= short_dd


def section_reduced(d, w, i, delta, delta_d, om, carried):
    """As `section`, the tip of a link given by reduced matrices."""
    r, K, first, n, t = d.reduced[i], d.count[i], d.first[i], i + 1, w.t
    arm, rate = w.arm[n], t[0]
    r_dd = t[7]
    for k in range(3):
        arm[k] = d.root[i, k] + d.red_tip[r, k]
        rate[k], r_dd[k] = 0.0, 0.0
    turn = t[8]  # rotation vector, to second order about x
    turn_d, twist_dd = t[9], 0.0
    for k in range(3):
        turn[k], turn_d[k] = 0.0, 0.0
    for j in range(K):
        x, v = delta[first + j], delta_d[first + j]
        for a in range(3):
            part = d.red_T[r, j, a]
            arm[a] += part * x
            for k in range(K):
                T2 = d.red_T2[r, j, k, a]
                part += T2 * delta[first + k]
                arm[a] += 0.5 * T2 * x * delta[first + k]
                r_dd[a] += T2 * v * delta_d[first + k]
            w.partial[n, j, a] = part
            rate[a] += part * v
            turn[a] += d.red_R[r, j, a] * x
            turn_d[a] += d.red_R[r, j, a] * v
        for k in range(K):
            R2, y, u = d.red_R2[r, j, k], delta[first + k], delta_d[first + k]
            turn[0] += 0.5 * R2 * x * y
            turn_d[0] += R2 * v * y
            twist_dd += R2 * v * u
    orient(
        w, n, turn[2], -turn[1], turn[0], turn_d[2], -turn_d[1], turn_d[0], 0.0, 0.0, twist_dd, om, carried
    )  # fmt: skip
    across, along = t[1], t[2]
    for j in range(K):
        gt = d.red_R[r, j, 0]
        for k in range(K):
            gt += d.red_R2[r, j, k] * delta[first + k]
        for k in range(3):
            w.turning[n, j, k] = gt * along[k] - d.red_R[r, j, 1] * across[k]
        w.turning[n, j, 2] += d.red_R[r, j, 2]
    swing(w, n, om, rate)
    for k in range(3):
        w.bias_a[n, k] += r_dd[k]


def attach(d, w, i, delta, delta_d, om):
    r"""Add the rigid bodies on link i's sections to its integrals; om is the link's angular velocity.

    With a section's place rho, partial velocities P_j, W_j and biases, and a body's m, s, X about it, virtual power is

    .. math:: n = n_s + \rho\times f_s, \quad f = f_s, \quad Q_j = W_j\cdot n_s + P_j\cdot f_s

    with :math:`n_s = X\,al_s + s\times a_s + N_s`, :math:`f_s = m\,a_s + al_s\times s + F_s`.
    """
    n = i + 1
    for b in range(d.bodies):
        if d.host[b] != i:
            continue
        carried, s, t = w.t[6], w.t[10], w.t
        section(
            d, w, i, d.body_x[b], d.body_tip[b], d.body_slope[b], d.body_bishop[b],
            w.of_body[b, 0], w.of_body[b, 1], w.body_draws[b], delta, delta_d, om, carried,
        )  # fmt: skip
        X, mass = w.tm[1], d.body_mass[b]
        symmetric_congruence(w.frame[n], d.body_inertia[b], w.tm[0], X)
        apply(w.frame[n], d.body_moment[b], s)
        # Biases: of its own spin, and of the section's.
        cross(carried, s, t[0])
        cross(carried, t[0], t[1])
        cross(w.bias_al[n], s, t[0])
        apply(X, carried, t[2])
        cross(carried, t[2], t[3])
        apply(X, w.bias_al[n], t[2])
        cross(s, w.bias_a[n], t[4])
        for k in range(3):
            t[1, k] += mass * w.bias_a[n, k] + t[0, k]
            t[3, k] += t[2, k] + t[4, k]
        for j in range(d.count[i]):
            W, P = w.turning[n, j], w.partial[n, j]
            # Force and moment at the section of a unit acceleration of mode j.
            cross(W, s, t[7])
            apply(X, W, t[8])
            cross(s, P, t[9])
            for k in range(3):
                t[7, k] += mass * P[k]
                t[8, k] += t[9, k]
            for m in range(d.count[i]):
                w.M[i, j, m] += dot(w.turning[n, m], t[8]) + dot(w.partial[n, m], t[7])
            cross(w.arm[n], t[7], t[9])
            for k in range(3):
                w.p[i, j, k] += t[7, k]
                w.l[i, j, k] += t[8, k] + t[9, k]
            w.q[i, j] += dot(W, t[3]) + dot(P, t[1])
        cross(w.arm[n], t[1], t[9])
        for k in range(3):
            w.F[i, k] += t[1, k]
            w.N[i, k] += t[3, k] + t[9, k]
        carry(w.arm[n], s, mass, w.J[i])
        for j in range(3):
            w.c[i, j] += s[j] + mass * w.arm[n, j]
            for k in range(3):
                w.J[i, j, k] += X[j, k]


def carry(r, c, mass, J):
    """Add to an inertia what it gains about a point from which its body is by r; first moment c about its own."""
    both, square = 2.0 * dot(r, c), dot(r, r)
    for j in range(3):
        J[j, j] += both + mass * square
        for k in range(3):
            J[j, k] -= r[j] * c[k] + c[j] * r[k] + mass * r[j] * r[k]


def from_root(d, w, i, om):
    """Refer the integrals of link i, whose axis begins at its root, to its joint."""
    r, mass, c, t = d.root[i], d.root_mass[i], w.c[i], w.t
    # a = a0 + al x r + w x (w x r) at the root, n = n_r + r x f.
    cross(om, r, t[0])
    cross(om, t[0], t[1])
    for j in range(d.count[i]):
        cross(r, w.p[i, j], t[0])
        for k in range(3):
            w.l[i, j, k] += t[0, k]
        w.q[i, j] += dot(w.p[i, j], t[1])
    cross(c, t[1], t[0])
    for k in range(3):
        w.F[i, k] += mass * t[1, k]
        w.N[i, k] += t[0, k]
    cross(r, w.F[i], t[0])
    for k in range(3):
        w.N[i, k] += t[0, k]
    carry(r, c, mass, w.J[i])
    for k in range(3):
        c[k] += mass * r[k]


def tip(d, w, i, delta, delta_d, om):
    """Link i's tip and what hangs on it: frame, partial velocities and biases, into row i + 1 of the work space."""
    K, n = d.count[i], i + 1
    arm, frame, t, tm = w.arm[n], w.frame[n], w.t, w.tm
    short, short_dd = 0.0, 0.0
    if d.level != FIRST_ORDER and K > 0:
        short, short_dd = w.of_link[i, SHORT_TIP], w.of_link[i, SHORT_TIP_DD]
    carried = t[6]
    if d.reduced[i] >= 0:
        section_reduced(d, w, i, delta, delta_d, om, carried)
    else:
        section(
            d, w, i, d.length[i], d.tip[i], d.slope[i], d.bishop[i], short, short_dd, w.draws[i],
            delta, delta_d, om, carried,
        )  # fmt: skip
    bias_al, bias_a = w.bias_al[n], w.bias_a[n]
    if n == d.links:
        apply_transposed(frame, carried, w.omega[n])
        for k in range(3):
            w.carrier[n, k] = carried[k]
        return
    # The joint sits off the tip by xyz and turns with it.
    off = t[7]
    apply(frame, d.xyz[n], off)
    for j in range(K):
        cross(w.turning[n, j], off, t[5])
        for k in range(3):
            w.partial[n, j, k] += t[5, k]
    cross(bias_al, off, t[5])
    cross(carried, off, t[8])
    cross(carried, t[8], t[9])
    for k in range(3):
        arm[k] += off[k]
        bias_a[k] += t[5, k] + t[9, k]
    product(frame, d.turn[n], tm[0])
    for k in range(3):
        for m in range(3):
            frame[k, m] = tm[0, k, m]
    apply_transposed(frame, carried, w.carrier[n])
