# SPDX-License-Identifier: Apache-2.0
"""What a bent link is as a body: integrals over its mass, and its elastic forces; see `kernels.chain`.

Throughout, d is the arm's `chain_data.Data`, w its `chain_data.Work`, and i the number of a link.
"""

import numpy as np

from .chain_data import (
    FINITE_SLOPE,
    SDDP,
    SDDPHI,
    SDPHI,
    SHORT,
    SHORT_DD,
    SHORT_TIP,
    SHORT_TIP_DD,
    SPHI,
    TWIST,
    XP,
    XX,
    YDP,
    YP,
    ZDP,
    ZP,
    P,
    Y,
    Z,
)
from .sections import slopes_and_bends
from .vectors import apply, cross, dot


def shorten(d, w, i, delta, delta_d):
    """Foreshortening s of link i at its nodes and tip, its partials, and its second derivative along delta_d."""
    K, G, first = d.count[i], d.nodes, d.first[i]
    for h in range(G + 1):
        w.node[2, h], w.node[3, h] = 0.0, 0.0
        for j in range(K):
            w.node_partial[1, j, h] = 0.0
    for g in range(G):
        sy, sz, syd, szd = 0.0, 0.0, 0.0, 0.0
        for j in range(K):
            slope = d.node_slope[i, g, j]
            if d.direction[i, j] == Y:
                sy += slope * delta[first + j]
                syd += slope * delta_d[first + j]
            elif d.direction[i, j] == Z:
                sz += slope * delta[first + j]
                szd += slope * delta_d[first + j]
        u, half, dd = sy * sy + sz * sz, sy * syd + sz * szd, syd * syd + szd * szd
        if d.level == FINITE_SLOPE:
            root = np.sqrt(1.0 - u)
            w.node[0, g] = u / (1.0 + root)  # 1 - root, without cancellation
            gain = 1.0 / root
            dd = (dd + half * half / (1.0 - u)) / root
        else:
            w.node[0, g] = 0.5 * u
            gain = 1.0
        w.node[1, g] = dd
        sy, sz = gain * sy, gain * sz
        for j in range(K):
            if d.direction[i, j] == Y:
                w.node_partial[0, j, g] = sy * d.node_slope[i, g, j]
            elif d.direction[i, j] == Z:
                w.node_partial[0, j, g] = sz * d.node_slope[i, g, j]
    for g in range(G):
        s, sdd = w.node[0, g], w.node[1, g]
        for h in range(G + 1):
            w.node[2, h] += d.cumulate[i, g, h] * s
            w.node[3, h] += d.cumulate[i, g, h] * sdd
    for j in range(K):
        if d.direction[i, j] == TWIST:
            continue
        for g in range(G):
            part = w.node_partial[0, j, g]
            for h in range(G + 1):
                w.node_partial[1, j, h] += d.cumulate[i, g, h] * part


def integrals(d, w, i, delta, delta_d):
    """Integrals over link i's mass that hold its foreshortening: functions of its deflections and their rates alone.

    With P_j = ds/d delta_j and X = x - s, into `WORK`'s `of_link`, `of_mode` and `of_modes`.
    """
    K, G, first = d.count[i], d.nodes, d.first[i]
    shorten(d, w, i, delta, delta_d)
    link, mode, modes = w.of_link[i], w.of_mode[i], w.of_modes[i]
    for n in range(3):
        link[n] = 0.0
    link[SHORT_TIP], link[SHORT_TIP_DD] = w.node[2, G], w.node[3, G]
    for j in range(K):
        for n in range(10):
            mode[j, n] = 0.0
        w.draws[i, j] = w.node_partial[1, j, G]
        for k in range(K):
            modes[j, k] = 0.0
    for b in range(d.bodies):
        if d.host[b] == i:
            g = d.body_node[b]
            w.of_body[b, 0], w.of_body[b, 1] = w.node[2, g], w.node[3, g]
            for j in range(K):
                w.body_draws[b, j] = w.node_partial[1, j, g]
    for g in range(G):
        mass, x, s, sdd = d.node_mass[i, g], d.node_x[i, g], w.node[2, g], w.node[3, g]
        y, z, yd, zd, sd = 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(K):
            phi, v = d.node_phi[i, g, j], delta_d[first + j]
            sd += w.node_partial[1, j, g] * v
            if d.direction[i, j] == Y:
                y += phi * delta[first + j]
                yd += phi * v
            elif d.direction[i, j] == Z:
                z += phi * delta[first + j]
                zd += phi * v
        link[SHORT] += mass * s
        link[SHORT_DD] += mass * sdd
        link[XX] += mass * s * (s - 2.0 * x)
        for j in range(K):
            if d.direction[i, j] == TWIST:
                continue
            part, phi = mass * w.node_partial[1, j, g], mass * d.node_phi[i, g, j]
            mode[j, P] += part
            mode[j, XP] += (x - s) * part
            mode[j, YP] += y * part
            mode[j, ZP] += z * part
            mode[j, YDP] += yd * part
            mode[j, ZDP] += zd * part
            mode[j, SDDP] += sdd * part
            mode[j, SPHI] += s * phi
            mode[j, SDPHI] += sd * phi
            mode[j, SDDPHI] += sdd * phi
            for k in range(j + 1):
                if d.direction[i, k] != TWIST:
                    modes[j, k] += part * w.node_partial[1, k, g]


def body_first_order(d, w, i, delta, delta_d, om):
    """Integrals of link i over its mass for r linear in delta, from constants."""
    K, first = d.count[i], d.first[i]
    yy, zz, yz, xy, xz = 0.0, 0.0, 0.0, 0.0, 0.0
    ryy, rzz, ryz, rzy, rxy, rxz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    cy, cz, cyd, czd, spin = 0.0, 0.0, 0.0, 0.0, 0.0
    wx, wy, wz = om[0], om[1], om[2]
    w2 = wx * wx + wy * wy + wz * wz
    for j in range(K):
        dj, vj = delta[first + j], delta_d[first + j]
        kind = d.direction[i, j]
        # Sums over the modes of each direction: G Y, G Z and their rates.
        gy, gz, gyd, gzd = 0.0, 0.0, 0.0, 0.0
        for k in range(K):
            g = d.gram[i, j, k]
            if d.direction[i, k] == Y:
                gy += g * delta[first + k]
                gyd += g * delta_d[first + k]
            elif d.direction[i, k] == Z:
                gz += g * delta[first + k]
                gzd += g * delta_d[first + k]
            w.M[i, j, k] = g if kind == d.direction[i, k] else 0.0
        for k in range(3):
            w.p[i, j, k] = 0.0
            w.l[i, j, k] = 0.0
        s, e = d.s[i, j], d.e[i, j]
        if kind == TWIST:
            w.l[i, j, 0] = s
            spin += s * vj
            w.q[i, j] = 0.0
            continue
        along = wx * e + wy * gy + wz * gz
        if kind == Y:
            cy += s * dj
            cyd += s * vj
            xy += e * dj
            rxy += e * vj
            yy += dj * gy
            yz += dj * gz
            ryy += dj * gyd
            ryz += dj * gzd
            w.p[i, j, 1] = s
            w.l[i, j, 0] = -gz
            w.l[i, j, 2] = e
            w.q[i, j] = wy * along - w2 * gy - 2.0 * wx * gzd
        else:
            cz += s * dj
            czd += s * vj
            xz += e * dj
            rxz += e * vj
            zz += dj * gz
            rzz += dj * gzd
            rzy += dj * gyd
            w.p[i, j, 2] = s
            w.l[i, j, 0] = gy
            w.l[i, j, 1] = -e
            w.q[i, j] = wz * along - w2 * gz + 2.0 * wx * gyd
    c, J, N, F, t = w.c[i], w.J[i], w.N[i], w.F[i], w.t
    c[0], c[1], c[2] = d.moment[i], cy, cz
    for k in range(3):
        for n in range(3):
            J[k, n] = d.inertia[i, k, n]
    J[0, 0] += yy + zz
    J[1, 1] += zz
    J[2, 2] += yy
    J[0, 1] -= xy
    J[1, 0] -= xy
    J[0, 2] -= xz
    J[2, 0] -= xz
    J[1, 2] -= yz
    J[2, 1] -= yz
    # F = w x (w x c) + 2 w x c'
    t[1, 0], t[1, 1], t[1, 2] = 0.0, 2.0 * cyd, 2.0 * czd
    cross(om, c, t[0])
    for k in range(3):
        t[0, k] += t[1, k]
    cross(om, t[0], F)
    # N = w x (J w + x spin) + 2 int r x (w x r'); the rest of F's 2 w x c' is in the latter.
    apply(J, om, t[0])
    t[0, 0] += spin
    cross(om, t[0], N)
    rr = ryy + rzz
    N[0] += 2.0 * wx * rr
    N[1] += 2.0 * (wy * rr - (rxy * wx + ryy * wy + rzy * wz))
    N[2] += 2.0 * (wz * rr - (rxz * wx + ryz * wy + rzz * wz))


def body_foreshortened(d, w, i, delta, delta_d, om):
    """Integrals of link i over its mass with its foreshortening, from those of `integrals`."""
    K, first = d.count[i], d.first[i]
    link, mode, modes = w.of_link[i], w.of_mode[i], w.of_modes[i]
    body_first_order(d, w, i, delta, delta_d, om)
    # What X = x - s adds to r = (x, y, z), to r', and r'' along delta_d. Xy is the integral of X y, and so on.
    c, J, N, F, t = w.c[i], w.J[i], w.N[i], w.F[i], w.t
    wx, wy, wz = om[0], om[1], om[2]
    short_d, xsd, sy, sz, ysd, zsd, ysdd, zsdd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    syd, szd = 0.0, 0.0
    for j in range(K):
        dj, vj = delta[first + j], delta_d[first + j]
        kind = d.direction[i, j]
        if kind == TWIST:
            continue
        short_d += mode[j, P] * vj
        xsd += mode[j, XP] * vj
        w.p[i, j, 0] = -mode[j, P]
        w.l[i, j, 1] -= mode[j, ZP]
        w.l[i, j, 2] += mode[j, YP]
        # -P_j times the x component of w x (w x r) + 2 w x r' + r''; r'' is -s''.
        w.q[i, j] += (
            (wy * wy + wz * wz) * mode[j, XP]
            - wx * (wy * mode[j, YP] + wz * mode[j, ZP])
            - 2.0 * (wy * mode[j, ZDP] - wz * mode[j, YDP])
            + mode[j, SDDP]
        )
        if kind == Y:
            sy += mode[j, SPHI] * dj
            syd += mode[j, SPHI] * vj
            ysd += mode[j, SDPHI] * dj
            ysdd += mode[j, SDDPHI] * dj
            w.l[i, j, 2] -= mode[j, SPHI]
            w.q[i, j] -= wx * wy * mode[j, SPHI] + 2.0 * wz * mode[j, SDPHI]
        else:
            sz += mode[j, SPHI] * dj
            szd += mode[j, SPHI] * vj
            zsd += mode[j, SDPHI] * dj
            zsdd += mode[j, SDDPHI] * dj
            w.l[i, j, 1] += mode[j, SPHI]
            w.q[i, j] -= wx * wz * mode[j, SPHI] - 2.0 * wy * mode[j, SDPHI]
        for k in range(K):
            if d.direction[i, k] != TWIST:
                w.M[i, j, k] += modes[j, k] if k <= j else modes[k, j]
    # F = w x (w x c) + 2 w x c' + c''
    short = link[SHORT]
    c[0] -= short
    F[0] += (wy * wy + wz * wz) * short - link[SHORT_DD]
    F[1] -= wx * wy * short + 2.0 * wz * short_d
    F[2] -= wx * wz * short - 2.0 * wy * short_d
    # N = w x (J w) + 2 int r x (w x r') + int r x r''
    xx = link[XX]
    J[1, 1] += xx
    J[2, 2] += xx
    J[0, 1] += sy
    J[1, 0] += sy
    J[0, 2] += sz
    J[2, 0] += sz
    t[1, 0], t[1, 1], t[1, 2] = sy * wy + sz * wz, sy * wx + xx * wy, sz * wx + xx * wz
    cross(om, t[1], t[0])
    for k in range(3):
        N[k] += t[0, k]
    # int r.r' without its first-order part is -xsd; int (w.r) r' is (-xsd wx - ysd wy - zsd wz, -syd wx, -szd wx).
    N[0] += 2.0 * (ysd * wy + zsd * wz)
    N[1] += 2.0 * (syd * wx - xsd * wy) - zsdd
    N[2] += 2.0 * (szd * wx - xsd * wz) + ysdd


def elastic_force(d, w, i, delta):
    """Gradient of link i's elastic energy with respect to its modal amplitudes."""
    K, first = d.count[i], d.first[i]
    for j in range(K):
        if d.level == FINITE_SLOPE and d.direction[i, j] != TWIST and d.reduced[i] < 0:
            w.elastic[i, j] = w.bent[i, j]
            continue
        acc = 0.0
        for k in range(K):
            acc += d.stiffness[i, j, k] * delta[first + k]
        w.elastic[i, j] = acc


def bend(d, w, i, delta):
    """Elastic force of link i's bending at finite slopes, into `WORK`'s `bent`."""
    K = d.count[i]
    for j in range(K):
        w.bent[i, j] = 0.0
    for g in range(d.nodes):
        sy, sz, by, bz = slopes_and_bends(d, i, g, delta)
        # EI_y k_y^2 / 2 + EI_z k_z^2 / 2 with k_z = z''/sqrt(1 - z'^2), k_y = (y'' + y' z' z''/c)/root.
        c = 1.0 - sz * sz
        u = c - sy * sy
        root = np.sqrt(u / c)
        top = by + sy * sz * bz / c
        ky = top / root
        kz2 = bz / c  # k_z times its derivative with respect to z''
        wy, wz = d.node_ei[i, g, 0], d.node_ei[i, g, 1]
        # d root/d y' = -y'/(c root); d root/d z' = -y'^2 z'/(c^2 root)
        ky_sy = sz * bz / (c * root) + ky * sy / (c * root * root)
        ky_sz = sy * bz * (1.0 + sz * sz) / (c * c * root) + ky * sy * sy * sz / (
            c * c * root * root
        )
        ky_by = 1.0 / root
        ky_bz = sy * sz / (c * root)
        for j in range(K):
            phi1, phi2 = d.node_slope[i, g, j], d.node_bend[i, g, j]
            if d.direction[i, j] == Y:
                w.bent[i, j] += wy * ky * (ky_sy * phi1 + ky_by * phi2)
            elif d.direction[i, j] == Z:
                w.bent[i, j] += wy * ky * (ky_sz * phi1 + ky_bz * phi2) + wz * (
                    kz2 * phi2 + kz2 * kz2 * sz * phi1
                )


def at_nodes(d, w, delta, delta_d):
    """What is summed at the nodes of the links: functions of deflections and their rates alone."""
    for i in range(d.links):
        if d.count[i] > 0 and d.reduced[i] < 0:
            integrals(d, w, i, delta, delta_d)
            if d.level == FINITE_SLOPE:
                bend(d, w, i, delta)


def sums_at_nodes(data, work, state, out):
    """`at_nodes` of a state, link by link into the vector `out`: for generated code, which `given_sums` describes."""
    d, w = data[0], work[0]
    half, place = state.size // 2, 0
    at_nodes(d, w, state[d.links : half], state[half + d.links :])
    for i in range(d.links):
        if d.count[i] == 0 or d.reduced[i] >= 0:
            continue
        for c in range(5):
            out[place] = w.of_link[i, c]
            place += 1
        for j in range(d.count[i]):
            for c in range(10):
                out[place] = w.of_mode[i, j, c]
                place += 1
            for k in range(j + 1):
                out[place] = w.of_modes[i, j, k]
                place += 1
            out[place], out[place + 1] = w.draws[i, j], w.bent[i, j]
            place += 2
        for b in range(d.bodies):
            if d.host[b] == i:
                out[place], out[place + 1] = w.of_body[b, 0], w.of_body[b, 1]
                place += 2
                for j in range(d.count[i]):
                    out[place] = w.body_draws[b, j]
                    place += 1


def body_reduced(d, w, i, delta, delta_d, om):
    r"""Integrals of a link given by reduced matrices, polynomials of its amplitudes; om is its angular velocity.

    The velocity terms are those of the kinetic energy that these polynomials make: with

    .. math:: A_j = H_j + (G_{kj} + H2_{jk})\delta_k, \qquad J = J_0 + \mathrm{tr}(S) 1 - S, \quad
       S = (H_j + H_j^T)\delta_j + (G_{jk} + H2_{jk})\delta_j\delta_k

    (symmetric part), :math:`q_j = w^TA_jw - w^2\,\mathrm{tr}A_j + 2w\cdot\mathrm{vee}(G_{kj})\dot\delta_k`.
    """
    r, K, first, t, tm = d.reduced[i], d.count[i], d.first[i], w.t, w.tm
    c, J, N, F = w.c[i], w.J[i], w.N[i], w.F[i]
    S, rate, A = tm[1], tm[2], tm[3]  # S and its rate, not yet made symmetric
    cd, pd, ld, spin = t[1], t[2], t[3], t[4]
    for k in range(3):
        c[k] = d.red_first[r, k]
        cd[k], pd[k], ld[k], spin[k] = 0.0, 0.0, 0.0, 0.0
        for n in range(3):
            S[k, n], rate[k, n] = 0.0, 0.0
    w2 = dot(om, om)
    for j in range(K):
        x, v = delta[first + j], delta_d[first + j]
        p, moment = w.p[i, j], w.l[i, j]
        whirl = 0.0
        for a in range(3):
            p[a] = d.red_C[r, j, a]
            c[a] += d.red_C[r, j, a] * x
            for b in range(3):
                A[a, b] = d.red_H[r, j, a, b]
                S[a, b] += d.red_H[r, j, a, b] * x
        vee_d, own = t[5], t[7]
        for a in range(3):
            vee_d[a], own[a] = 0.0, 0.0
        for k in range(K):
            y, u = delta[first + k], delta_d[first + k]
            G, H2 = d.red_G[r, k, j], d.red_H2[r, j, k]
            w.M[i, j, k] = d.gram[i, j, k]
            for a in range(3):
                C2 = d.red_C2[r, j, k, a]
                p[a] += C2 * y
                c[a] += 0.5 * C2 * x * y
                pd[a] += C2 * u * v
                e, f = (a + 1) % 3, (a + 2) % 3
                turned = G[e, f] - G[f, e]
                drawn = H2[e, f] - H2[f, e]
                own[a] += (turned + drawn) * y
                vee_d[a] += (turned + drawn) * u
                whirl += om[a] * turned * u
                for b in range(3):
                    A[a, b] += (G[a, b] + H2[a, b]) * y
                    S[a, b] += 0.5 * (G[a, b] + H2[a, b]) * x * y
        trace, square = A[0, 0] + A[1, 1] + A[2, 2], 0.0
        for a in range(3):
            moment[a] = d.red_l[r, j, a] + own[a]
            cd[a] += p[a] * v
            ld[a] += vee_d[a] * v
            spin[a] += moment[a] * v
            for b in range(3):
                square += om[a] * A[a, b] * om[b]
                rate[a, b] += A[a, b] * v
        w.q[i, j] = square - w2 * trace + 2.0 * whirl
    whole, change = (
        2.0 * (S[0, 0] + S[1, 1] + S[2, 2]),
        2.0 * (rate[0, 0] + rate[1, 1] + rate[2, 2]),
    )
    for a in range(3):
        for b in range(3):
            J[a, b] = d.inertia[i, a, b] - S[a, b] - S[b, a]
        J[a, a] += whole
    # N = J' w + l' delta' + w x (J w + l delta'); F = w x (w x c + 2 c') + p' delta'
    apply(J, om, t[0])
    for k in range(3):
        t[0, k] += spin[k]
    cross(om, t[0], N)
    for a in range(3):
        N[a] += change * om[a] + ld[a]
        for b in range(3):
            N[a] -= (rate[a, b] + rate[b, a]) * om[b]
    cross(om, c, t[0])
    for k in range(3):
        t[0, k] += 2.0 * cd[k]
    cross(om, t[0], F)
    for k in range(3):
        F[k] += pd[k]
