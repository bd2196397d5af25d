# SPDX-License-Identifier: Apache-2.0
r"""Equations of motion of a serial chain of flexible links, recursively, in O(number of links).

The same functions run in three ways: as they are (for reading and debugging), compiled by numba (`kernels.load`), and
on symbols, which gives straight-line code for one arm's structure (`kernels.generated`). So they calculate with
scalars, write into arrays of the caller, and never branch on a value that depends on the state.

The frames are floating: link i's frame is at its base, with x along the undeformed axis. A point of the axis is at

.. math:: r(x, \delta) = (x - s,\ \sum\phi_j\delta_j,\ \sum\phi_k\delta_k), \qquad
   s = \int_0^x f\,dx', \quad f = 0,\ \tfrac12 u,\ 1 - \sqrt{1 - u}, \quad u = y'^2 + z'^2,

for the levels FIRST_ORDER, FORESHORTENING and FINITE_SLOPE. Let w be the frame's angular velocity, al its angular
acceleration and a0 the acceleration of its origin, all in link coordinates. The principle of virtual power with the
partial velocities (1, -r x, r_j = dr/d delta_j) then gives each link's equations

.. math::
    n &= J\,al + c\times a_0 + l\,\ddot\delta + N, \\
    f &= m\,a_0 + al\times c + p\,\ddot\delta + F, \\
    Q_j &= l_j\cdot al + p_j\cdot a_0 + M_{jk}\ddot\delta_k + q_j,

where c, J, p, l, M are the integrals of r, -r x r x, r_j, r x r_j, r_j r_k over the mass and (N, F, q) those of
w x (w x r) + 2 w x r' + r_jk delta_j' delta_k'. Three angles turn the base's frame into the tip's,
R = Rz(a) Ry(-b) Rx(t); at first order a = y', b = z', t = twist.

Recursive assembly: Book (1984), Int. J. Robotics Research 3(3); articulated-body form: Featherstone (2008),
Rigid Body Dynamics Algorithms, ch. 7, extended by eliminating the modal coordinates link by link.
"""

from collections import namedtuple

import numpy as np

#: Whether joints have transmissions, housings or friction beyond Coulomb's: compiled apart for arms without, which then
#: cost nothing more.
JOINT_PARTS = True
#: Deflection beyond the play, in parts of half of it, at which a transmission has half of its damping.
ENGAGEMENT = 0.1
TWIST, Y, Z, REDUCED = 0, 1, 2, 3
FIRST_ORDER, FORESHORTENING, FINITE_SLOPE = 0, 1, 2
#: Columns of `of_link`: integrals of s, its second derivative along delta_d and X^2 - x^2 over the mass; at the tip.
SHORT, SHORT_DD, XX, SHORT_TIP, SHORT_TIP_DD = 0, 1, 2, 3, 4
#: Columns of `of_mode`: of P_j, X P_j, y P_j, z P_j, y' P_j, z' P_j, s'' P_j, s phi_j, s' phi_j, s'' phi_j.
P, XP, YP, ZP, YDP, ZDP, SDDP, SPHI, SDPHI, SDDPHI = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9

#: Constants of an arm: N links, at most K modes each, G quadrature nodes. SI.
DATA = {
    "links": (),  # N; arrays may be longer than that
    "level": (),  # FIRST_ORDER, FORESHORTENING or FINITE_SLOPE
    "nodes": (),  # G
    "count": ("N",),  # modes of each link
    "first": ("N",),  # where they start in delta
    "direction": ("N", "K"),  # TWIST, Y or Z
    "axis": ("N", 3),  # of the joint, in the joint's frame
    "xyz": ("N", 3),  # joint's origin in the previous tip's frame
    "turn": ("N", 3, 3),  # and its orientation
    "gear": ("N",),
    "rotor": ("N",),  # rotor inertia, motor side
    # place in delta of the deflection of each joint's transmission; -1: it has none
    "spring": ("N",),
    # stiffness, damping, half the play, damping per transmitted torque, rounding, damping within the play
    "transmission": ("N", 6),
    # friction beyond Coulomb's: breakaway level's excess, Stribeck speed, part of the transmitted torque, smoothing
    "slip": ("N", 4),
    "housed": ("N",),  # whether the joint's motor has a housing that turns
    "housing": ("N", 3, 3),  # its inertia about the joint, before the joint's turn
    "length": ("N",),
    "mass": ("N",),  # beam, and the motor at its base
    "moment": ("N",),  # int x dm
    "inertia": ("N", 3, 3),  # of the straight link about its frame's origin, hub included
    "s": ("N", "K"),  # int phi dm; twist: int theta rho I_p dx
    "e": ("N", "K"),  # int x phi dm
    # int phi_j phi_k dm, across directions too; twist: int theta theta rho I_p dx
    "gram": ("N", "K", "K"),
    "stiffness": ("N", "K", "K"),
    "damping": ("N", "K", "K"),
    "tip": ("N", "K"),  # phi(L)
    "slope": ("N", "K"),  # phi'(L); twist: theta(L)
    "node_x": ("N", "G"),
    "node_mass": ("N", "G"),  # quadrature weight times rho A
    "node_phi": ("N", "G", "K"),
    "node_slope": ("N", "G", "K"),
    "node_bend": ("N", "G", "K"),  # phi''
    "node_ei": ("N", "G", 2),  # quadrature weight times EI along y and z
    "cumulate": (
        "N",
        "G",
        "G+1",
    ),  # of a function at the nodes: integrals from the base to each node and to the tip
    "bishop": ("N", "K", "K"),  # int phi_y'' phi_z' dx
    "root": ("N", 3),  # where the link's axis begins, from its joint
    "rooted": ("N",),  # whether that is off the joint
    "root_mass": ("N",),  # mass of the beam, which begins there
    "bodies": (),  # B rigid bodies on sections of links
    "host": ("B",),  # the link of each
    "body_node": ("B",),  # the quadrature node at its section
    "body_x": ("B",),
    "body_tip": ("B", "K"),  # of its section, as tip, slope and bishop of a link's tip
    "body_slope": ("B", "K"),
    "body_bishop": ("B", "K", "K"),
    "body_mass": ("B",),
    "body_moment": ("B", 3),  # in the section's frame, about the section
    "body_inertia": ("B", 3, 3),
    # R links given by reduced matrices: see `arm.reduced`, whose symbols these are.
    "reduced": ("N",),  # which of them each link is; -1: a beam
    "red_first": ("R", 3),  # c0
    "red_tip": ("R", 3),
    "red_C": ("R", "K", 3),
    "red_l": ("R", "K", 3),
    "red_H": ("R", "K", 3, 3),
    "red_G": ("R", "K", "K", 3, 3),
    "red_C2": ("R", "K", "K", 3),
    "red_H2": ("R", "K", "K", 3, 3),
    "red_T": ("R", "K", 3),  # translation of the tip
    "red_R": ("R", "K", 3),  # its rotation
    "red_T2": ("R", "K", "K", 3),  # and second order
    "red_R2": ("R", "K", "K"),  # about x
    "payload_mass": (1,),
    "payload_moment": (3,),  # in the tip's frame, about the tip
    "payload_inertia": (3, 3),
    "gravity": (3,),  # in the base frame
}

#: Work space, filled by `prepare` (kinematics and inertia) and by the recursions. Row N is the tip's.
WORK = {
    "frame": ("N+1", 3, 3),  # link to previous link's coordinates
    "rate": ("N",),  # at which each link turns about its joint
    "housing": ("N", 3, 3),  # inertia of the joint's housing, link coordinates
    "al_carrier": ("N+1", 3),  # angular acceleration of what carries the joint, link coordinates
    "omega": ("N+1", 3),  # angular velocity of each link's frame, in its coordinates
    # angular velocity of what carries the joint, link coordinates; N: of the tip, link N - 1's
    "carrier": ("N+1", 3),
    "arm": ("N+1", 3),  # from link i - 1's base to joint i, its coordinates
    "partial": ("N+1", "K", 3),  # d arm / d delta of link i - 1
    "turning": ("N+1", "K", 3),  # angular partial velocity of its tip
    # acceleration of joint i that its parent's al, a0, delta_dd do not explain
    "bias_a": ("N+1", 3),
    "bias_al": ("N+1", 3),  # angular likewise
    "c": ("N", 3),
    "J": ("N", 3, 3),
    "p": ("N", "K", 3),
    "l": ("N", "K", 3),
    "M": ("N", "K", "K"),
    "N": ("N", 3),
    "F": ("N", 3),
    "q": ("N", "K"),  # velocity terms of the modes; the elastic force is apart
    "elastic": ("N", "K"),
    "al": ("N+1", 3),
    "a0": ("N+1", 3),
    "X": ("N+1", 3, 3),  # articulated inertia: n = X al + Y a0 + zn, f = Y' al + Z a0 + zf
    "Y": ("N+1", 3, 3),
    "Z": ("N+1", 3, 3),
    "zn": ("N+1", 3),
    "zf": ("N+1", 3),
    # L of the articulated modal mass L D L', on its diagonal the inverse of D
    "B": ("N", "K", "K"),
    "Bd": ("N", "K", "K"),  # L D
    "Ca": ("N", "K", 3),  # rows of its coupling to al
    "Cf": ("N", "K", 3),  # and to a0
    "rhs": ("N", "K"),
    "Ua": ("N", 3),
    "Uf": ("N", 3),
    "D": ("N",),
    "u": ("N",),
    # of a link behind a transmission: what Ua, Uf are before the motor; inverse of D, u, D without `extra`
    "Sa": ("N", 3),
    "Sf": ("N", 3),
    "S": ("N", 3),
    "t": (12, 3),  # scratch
    "tm": (6, 3, 3),  # scratch
    "of_link": ("N", 5),  # see `integrals`: SHORT, SHORT_DD ...
    "of_mode": ("N", "K", 10),  # P, XP ...
    "draws": ("N", "K"),  # P_j at the tip
    "of_body": ("B", 2),  # of bodies' sections, as SHORT_TIP, SHORT_TIP_DD of a tip
    "body_draws": ("B", "K"),
    "of_modes": ("N", "K", "K"),  # int P_j P_k dm for k <= j
    "bent": ("N", "K"),  # elastic force of bending at finite slopes
    "node": (4, "G+1"),  # integrands at the nodes and what they integrate to
    "node_partial": (2, "K", "G+1"),
}

Data = namedtuple("Data", DATA)
Work = namedtuple("Work", WORK)


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


def turn_joint(d, w, i, q, qd):
    """Turn link i by its joint; `frame` and `carrier` of row i are those before the joint."""
    about_axis(d.axis[i], q, w.tm[0])
    product(w.frame[i], w.tm[0], w.tm[1])
    apply_transposed(w.tm[0], w.carrier[i], w.t[0])
    for k in range(3):
        w.carrier[i, k] = w.t[0, k]
        w.omega[i, k] = w.t[0, k] + d.axis[i, k] * qd
        for m in range(3):
            w.frame[i, k, m] = w.tm[1, k, m]


def turn_housing(d, w, i):
    """Inertia of joint i's housing in link coordinates, after `turn_joint`, whose turn is in tm[0]."""
    product(d.housing[i], w.tm[0], w.tm[2])
    for j in range(3):
        for k in range(3):
            acc = 0.0
            for m in range(3):
                acc += w.tm[0, m, j] * w.tm[2, m, k]
            w.housing[i, j, k] = acc


def add_housing_spin(w, i, zn):
    """Add the gyroscopic moment of joint i's housing, which its carrier feels, to zn."""
    apply(w.housing[i], w.carrier[i], w.t[5])
    cross(w.carrier[i], w.t[5], w.t[7])
    for k in range(3):
        zn[k] += w.t[7, k]


def prepare(d, w, q, delta, qd, delta_d):
    """Kinematics and inertia of all links at one state: what both recursions start from."""
    N = d.links
    for k in range(3):
        w.arm[0, k] = d.xyz[0, k]
        w.carrier[0, k] = 0.0
        for m in range(3):
            w.frame[0, k, m] = d.turn[0, k, m]
    if d.level != FIRST_ORDER and d.nodes > 0:  # without nodes their sums are given
        at_nodes(d, w, delta, delta_d)
    for i in range(N):
        angle, rate = q[i], qd[i]
        if JOINT_PARTS:
            if d.spring[i] >= 0:
                angle += delta[d.spring[i]]
                rate += delta_d[d.spring[i]]
            w.rate[i] = rate
        turn_joint(d, w, i, angle, rate)
        if JOINT_PARTS and d.housed[i]:
            turn_housing(d, w, i)
        if d.reduced[i] >= 0:
            body_reduced(d, w, i, delta, delta_d, w.omega[i])
        elif d.level == FIRST_ORDER or d.count[i] == 0:
            body_first_order(d, w, i, delta, delta_d, w.omega[i])
        else:
            body_foreshortened(d, w, i, delta, delta_d, w.omega[i])
        if d.rooted[i]:
            from_root(d, w, i, w.omega[i])
        attach(d, w, i, delta, delta_d, w.omega[i])
        elastic_force(d, w, i, delta)
        tip(d, w, i, delta, delta_d, w.omega[i])


def payload(d, w):
    """Inertia and bias of the payload into row N, in the last link's coordinates, about its tip."""
    N = d.links
    X, Y, Z, zn, zf, s = w.X[N], w.Y[N], w.Z[N], w.zn[N], w.zf[N], w.t[6]
    om, m = w.carrier[N], d.payload_mass[0]
    symmetric_congruence(w.frame[N], d.payload_inertia, w.tm[0], X)
    apply(w.frame[N], d.payload_moment, s)
    for k in range(3):
        for n in range(3):
            Z[k, n] = 0.0
        Z[k, k] = m
    skew(s, Y)
    cross(om, s, w.t[0])
    cross(om, w.t[0], zf)
    apply(X, om, w.t[0])
    cross(om, w.t[0], zn)


def skew(a, out):
    """Out = a x as a matrix."""
    out[0, 0], out[1, 1], out[2, 2] = 0.0, 0.0, 0.0
    out[0, 1], out[0, 2], out[1, 2] = -a[2], a[1], -a[0]
    out[1, 0], out[2, 0], out[2, 1] = a[2], -a[1], a[0]


def start(w, gravity):
    """Acceleration of the base: gravity is an upward acceleration of everything."""
    apply_transposed(w.frame[0], gravity, w.a0[0])
    for k in range(3):
        w.a0[0, k] = -w.a0[0, k]


def inverse_dynamics(d, w, qd, qdd, delta_dd, gravity, torque, modal):
    """Generalised forces that give the accelerations asked for (recursive Newton-Euler), after `prepare`.

    Joint friction, modal stiffness and modal damping are not in them.

    `gravity` is (3,) [m/s^2]; `torque` (N,) and `modal` (N, K) are written.
    """
    N = d.links
    start(w, gravity)
    turning = qdd[0]
    if JOINT_PARTS and d.spring[0] >= 0:
        turning += delta_dd[d.spring[0]]
    for k in range(3):
        w.al[0, k] = d.axis[0, k] * turning
    for i in range(N):
        n = i + 1
        K, first = d.count[i], d.first[i]
        al, a0 = w.t[0], w.t[1]
        tip_acceleration(d, w, i, delta_dd, al, a0)
        if n == N:
            for k in range(3):
                w.al[n, k], w.a0[n, k] = al[k], a0[k]
        else:
            apply_transposed(w.frame[n], al, w.al[n])
            apply_transposed(w.frame[n], a0, w.a0[n])
            cross(w.carrier[n], d.axis[n], w.t[2])
            # Spin of the rotor as seen from the base: its rate needs the carrier's acceleration.
            w.u[n] = d.rotor[n] * (dot(d.axis[n], w.al[n]) + d.gear[n] * qdd[n])
            turning, rate = qdd[n], qd[n]
            if JOINT_PARTS:
                rate = w.rate[n]
                for k in range(3):
                    w.al_carrier[n, k] = w.al[n, k]
            if JOINT_PARTS and d.spring[n] >= 0:
                turning += delta_dd[d.spring[n]]
            for k in range(3):
                w.al[n, k] += w.t[2, k] * rate + d.axis[n, k] * turning
    w.u[0] = d.rotor[0] * d.gear[0] * qdd[0]
    # Wrench on the payload, then link by link inwards; zn, zf hold it in link coordinates at the link's base.
    payload(d, w)
    add_inertial(w.X[N], w.Y[N], w.Z[N], w.al[N], w.a0[N], w.zn[N], w.zf[N])
    for i in range(N - 1, -1, -1):
        n = i + 1
        K, first = d.count[i], d.first[i]
        nj, fj = w.t[0], w.t[1]
        if n == N:
            for k in range(3):
                nj[k], fj[k] = w.zn[n, k], w.zf[n, k]
        else:
            apply(w.frame[n], w.zn[n], nj)
            apply(w.frame[n], w.zf[n], fj)
        zn, zf, c, al, a0 = w.zn[i], w.zf[i], w.c[i], w.al[i], w.a0[i]
        apply(w.J[i], al, zn)
        cross(c, a0, w.t[2])
        cross(al, c, w.t[3])
        cross(w.arm[n], fj, w.t[4])
        for k in range(3):
            zn[k] += w.t[2, k] + w.N[i, k] + nj[k] + w.t[4, k]
            zf[k] = d.mass[i] * a0[k] + w.t[3, k] + w.F[i, k] + fj[k]
        for j in range(K):
            acc = w.q[i, j] + dot(w.l[i, j], al) + dot(w.p[i, j], a0)
            acc += dot(w.turning[n, j], nj) + dot(w.partial[n, j], fj)
            x = delta_dd[first + j]
            for k in range(K):
                acc += w.M[i, j, k] * delta_dd[first + k]
            for k in range(3):
                zn[k] += w.l[i, j, k] * x
                zf[k] += w.p[i, j, k] * x
            modal[first + j] = acc
        torque[i] = dot(d.axis[i], zn) + d.gear[i] * w.u[i]
        if JOINT_PARTS and d.spring[i] >= 0:
            modal[d.spring[i]] = dot(d.axis[i], zn)
        add_rotor(d, w, i, qd[i], zn)
        if JOINT_PARTS and d.housed[i]:
            apply(w.housing[i], w.al_carrier[i], w.t[5])
            for k in range(3):
                zn[k] += w.t[5, k]
            add_housing_spin(w, i, zn)


def add_rotor(d, w, i, qd, zn):
    """Add to zn the moment that the rotor of joint i, driven by the torque u, exerts on its carrier."""
    spin = d.rotor[i] * (dot(d.axis[i], w.carrier[i]) + d.gear[i] * qd)
    cross(w.carrier[i], d.axis[i], w.t[5])
    for k in range(3):
        zn[k] += d.axis[i, k] * w.u[i] + spin * w.t[5, k]


def tip_acceleration(d, w, i, delta_dd, al, a0):
    """Acceleration (al, a0) of what hangs on link i, in link i's coordinates."""
    n, K, first = i + 1, d.count[i], d.first[i]
    cross(w.al[i], w.arm[n], w.t[3])
    for k in range(3):
        al[k] = w.al[i, k] + w.bias_al[n, k]
        a0[k] = w.a0[i, k] + w.t[3, k] + w.bias_a[n, k]
    for j in range(K):
        x = delta_dd[first + j]
        for k in range(3):
            al[k] += w.turning[n, j, k] * x
            a0[k] += w.partial[n, j, k] * x


def add_inertial(X, Y, Z, al, a0, zn, zf):
    """Add [X Y; Y' Z] (al, a0) to (zn, zf)."""
    for i in range(3):
        zn[i] += dot(X[i], al) + dot(Y[i], a0)
        zf[i] += Y[0, i] * al[0] + Y[1, i] * al[1] + Y[2, i] * al[2] + dot(Z[i], a0)


def articulate_tip(d, w, i):
    """Fold what hangs on link i (row i + 1) into link i's inertia, in link i's coordinates."""
    n, K = i + 1, d.count[i]
    tm, t = w.tm, w.t
    C = w.frame[n]
    X, Y, Z = tm[1], tm[2], tm[3]
    zn, zf = t[0], t[1]
    if n == d.links:
        for k in range(3):
            zn[k], zf[k] = w.zn[n, k], w.zf[n, k]
            for m in range(3):
                X[k, m], Y[k, m], Z[k, m] = w.X[n, k, m], w.Y[n, k, m], w.Z[n, k, m]
    else:
        symmetric_congruence(C, w.X[n], tm[0], X)
        congruence(C, w.Y[n], tm[0], Y)
        symmetric_congruence(C, w.Z[n], tm[0], Z)
        apply(C, w.zn[n], zn)
        apply(C, w.zf[n], zf)
    add_inertial(X, Y, Z, w.bias_al[n], w.bias_a[n], zn, zf)
    arm = w.arm[n]
    # To the link's base: a_joint = a0 - arm x al.
    S = tm[4]
    skew(arm, S)
    product(S, Z, tm[5])
    Xi, Yi, Zi = w.X[i], w.Y[i], w.Z[i]
    J, c = w.J[i], w.c[i]
    skew(c, Yi)
    for a in range(3):
        for b in range(3):
            Zi[a, b] = Z[a, b]
            Yi[a, b] += Y[a, b] + tm[5, a, b]
        for b in range(a + 1):
            # [arm] Y' - Y [arm] - [arm] Z [arm]
            acc = J[a, b] + X[a, b]
            for k in range(3):
                acc += S[a, k] * Y[b, k] - Y[a, k] * S[k, b] - tm[5, a, k] * S[k, b]
            Xi[a, b] = acc
            Xi[b, a] = acc
        Zi[a, a] += d.mass[i]
    for j in range(K):
        W, P = w.turning[n, j], w.partial[n, j]
        nk, fk = t[2], t[3]
        for k in range(3):
            nk[k], fk[k] = 0.0, 0.0
        add_inertial(X, Y, Z, W, P, nk, fk)
        for k in range(j + 1):
            w.B[i, j, k] = w.M[i, j, k] + dot(w.turning[n, k], nk) + dot(w.partial[n, k], fk)
        cross(arm, fk, t[4])
        for k in range(3):
            w.Ca[i, j, k] = w.l[i, j, k] + nk[k] + t[4, k]
            w.Cf[i, j, k] = w.p[i, j, k] + fk[k]
        w.rhs[i, j] = -(w.q[i, j] + dot(W, zn) + dot(P, zf))
    cross(arm, zf, t[4])
    for k in range(3):
        w.zn[i, k] = w.N[i, k] + zn[k] + t[4, k]
        w.zf[i, k] = w.F[i, k] + zf[k]


def eliminate_modes(d, w, i, force, extra):
    """Factorise link i's modal mass, its modal coordinates eliminated from X, Y, Z, zn, zf."""
    K, first = d.count[i], d.first[i]
    B = w.B[i]
    # L D L', unit lower L; the diagonal holds the inverse of D.
    for j in range(K):
        for k in range(j + 1):
            acc = B[j, k] + extra[i, j, k]
            for m in range(k):
                acc -= w.Bd[i, j, m] * B[k, m]
            if k < j:
                w.Bd[i, j, k] = acc
                B[j, k] = acc * B[k, k]
            else:
                B[j, j] = 1.0 / acc
        # Rows of L^-1 (rhs, Ca, Cf).
        w.rhs[i, j] += force[first + j]
        for m in range(j):
            b = B[j, m]
            w.rhs[i, j] -= b * w.rhs[i, m]
            for k in range(3):
                w.Ca[i, j, k] -= b * w.Ca[i, m, k]
                w.Cf[i, j, k] -= b * w.Cf[i, m, k]
    for j in range(K):
        Ca, Cf, r, inverse = w.Ca[i, j], w.Cf[i, j], w.rhs[i, j], B[j, j]
        for a in range(3):
            ga, gf = Ca[a] * inverse, Cf[a] * inverse
            for b in range(3):
                w.Y[i, a, b] -= ga * Cf[b]
            for b in range(a + 1):
                w.X[i, a, b] -= ga * Ca[b]
                w.Z[i, a, b] -= gf * Cf[b]
                w.X[i, b, a] = w.X[i, a, b]
                w.Z[i, b, a] = w.Z[i, a, b]
            w.zn[i, a] += ga * r
            w.zf[i, a] += gf * r


def eliminate_joint(d, w, i, qd, force, modal_force, extra, driven, qdd):
    """Eliminate joint i from row i; what is left is the inertia that its carrier feels, in link i's coordinates."""
    a, t, rate = d.axis[i], w.t, qd
    if JOINT_PARTS:
        rate = w.rate[i]
    X, Y, Z, zn, zf = w.X[i], w.Y[i], w.Z[i], w.zn[i], w.zf[i]
    bias = t[0]
    cross(w.carrier[i], a, bias)
    spin = d.rotor[i] * (dot(a, w.carrier[i]) + d.gear[i] * qd)
    Ua, Uf = w.Ua[i], w.Uf[i]
    for k in range(3):
        Ua[k] = dot(X[k], a)
        Uf[k] = Y[0, k] * a[0] + Y[1, k] * a[1] + Y[2, k] * a[2]
    D = dot(a, Ua) + d.gear[i] * d.gear[i] * d.rotor[i] + extra[0]
    u = force - dot(a, zn) - rate * dot(Ua, bias)
    for k in range(3):
        zf[k] += rate * (Y[0, k] * bias[0] + Y[1, k] * bias[1] + Y[2, k] * bias[2])
        t[1, k] = rate * dot(X[k], bias)
    if JOINT_PARTS and d.spring[i] >= 0:
        D, u = eliminate_spring(d, w, i, force, u - force, modal_force[d.spring[i]], extra)
    for k in range(3):
        zn[k] += t[1, k] + spin * bias[k]
        Ua[k] += d.gear[i] * d.rotor[i] * a[k]
        for m in range(3):
            X[k, m] += d.rotor[i] * a[k] * a[m]
    if JOINT_PARTS and d.housed[i]:
        for k in range(3):
            for m in range(3):
                X[k, m] += w.housing[i, k, m]
        add_housing_spin(w, i, zn)
    if driven:
        for k in range(3):
            zn[k] += Ua[k] * qdd
            zf[k] += Uf[k] * qdd
        w.u[i] = qdd
        return
    inverse = 1.0 / D
    w.D[i], w.u[i] = inverse, u
    for k in range(3):
        ga, gf = Ua[k] * inverse, Uf[k] * inverse
        zn[k] += ga * u
        zf[k] += gf * u
        for m in range(3):
            Y[k, m] -= ga * Uf[m]
        for m in range(k + 1):
            X[k, m] -= ga * Ua[m]
            Z[k, m] -= gf * Uf[m]
            X[m, k] = X[k, m]
            Z[m, k] = Z[k, m]


def eliminate_spring(d, w, i, force, u, spring_force, extra):
    r"""Eliminate the deflection gamma of joint i's transmission; return D and u of the motor, and put its Ua and Uf.

    With the link's inertia D about the joint and the motor's acceleration qdd:

    .. math:: \ddot\gamma = (u + f_\gamma - D\ddot q - U_a\cdot al - U_f\cdot a_0) / (D + extra).

    `force` acts on the motor, `spring_force` between motor and link, `u` is what the link's motion adds. Without
    `extra` (explicit methods) the motor feels the spring's torque alone.
    """
    Ua, Uf, X, Y, Z, zn, zf = w.Ua[i], w.Uf[i], w.X[i], w.Y[i], w.Z[i], w.zn[i], w.zf[i]
    D = dot(d.axis[i], Ua)
    inverse = 1.0 / (D + extra[1])
    left = extra[1] * inverse
    w.S[i, 0], w.S[i, 1], w.S[i, 2] = inverse, u + spring_force, D
    for k in range(3):
        ga, gf = Ua[k] * inverse, Uf[k] * inverse
        zn[k] += ga * w.S[i, 1]
        zf[k] += gf * w.S[i, 1]
        for m in range(3):
            Y[k, m] -= ga * Uf[m]
        for m in range(k + 1):
            X[k, m] -= ga * Ua[m]
            Z[k, m] -= gf * Uf[m]
            X[m, k] = X[k, m]
            Z[m, k] = Z[k, m]
    for k in range(3):
        w.Sa[i, k], w.Sf[i, k] = Ua[k], Uf[k]
        Ua[k] *= left
        Uf[k] *= left
    D = left * D + d.gear[i] * d.gear[i] * d.rotor[i] + extra[0]
    return D, force + left * u - (1.0 - left) * spring_force


def forward_dynamics(
    d, w, qd, joint_force, modal_force, joint_extra, modal_extra, driven, qdd, delta_dd
):
    """Accelerations under generalised forces (articulated-body recursion), after `prepare`.

    Joints with `driven` move with the given qdd; for the others, qdd is written. `joint_extra` (N, 2), of motor and
    transmission, and `modal_extra` (N, K, K) are added to the diagonal blocks of the mass matrix; the implicit
    integrator uses them.

    `joint_force` is (N,) [N m], `modal_force` (m,) [N, N m].
    """
    N = d.links
    payload(d, w)
    for i in range(N - 1, -1, -1):
        articulate_tip(d, w, i)
        eliminate_modes(d, w, i, modal_force, modal_extra)
        eliminate_joint(
            d, w, i, qd[i], joint_force[i], modal_force, joint_extra[i], driven[i], qdd[i]
        )
    start(w, d.gravity)
    for k in range(3):
        w.al[0, k] = 0.0
    for i in range(N):
        n = i + 1
        K, first = d.count[i], d.first[i]
        al, a0 = w.al[i], w.a0[i]
        if not driven[i]:
            qdd[i] = w.D[i] * (w.u[i] - dot(w.Ua[i], al) - dot(w.Uf[i], a0))
        turning, rate = qdd[i], qd[i]
        if JOINT_PARTS:
            rate = w.rate[i]
        if JOINT_PARTS and d.spring[i] >= 0:
            acc = w.S[i, 1] - w.S[i, 2] * qdd[i] - dot(w.Sa[i], al) - dot(w.Sf[i], a0)
            delta_dd[d.spring[i]] = w.S[i, 0] * acc
            turning += delta_dd[d.spring[i]]
        cross(w.carrier[i], d.axis[i], w.t[0])
        for k in range(3):
            al[k] += d.axis[i, k] * turning + w.t[0, k] * rate
        for j in range(K - 1, -1, -1):
            acc = w.rhs[i, j] - dot(w.Ca[i, j], al) - dot(w.Cf[i, j], a0)
            acc *= w.B[i, j, j]
            for k in range(j + 1, K):
                acc -= w.B[i, k, j] * delta_dd[first + k]
            delta_dd[first + j] = acc
        if n < N:
            tip_acceleration(d, w, i, delta_dd, w.t[1], w.t[2])
            apply_transposed(w.frame[n], w.t[1], w.al[n])
            apply_transposed(w.frame[n], w.t[2], w.a0[n])


def dead_zone(x, half, rounding):
    """What a deflection x has left beyond a play of +-half, with corners rounded over a width."""
    if rounding == 0.0:
        return x - 0.5 * (abs(x + half) - abs(x - half))
    w2, a, b = rounding * rounding, x + half, x - half
    return x - 0.5 * (np.sqrt(a * a + w2) - np.sqrt(b * b + w2))


def dead_zone_slope(x, half, rounding):
    """Derivative of `dead_zone`."""
    if rounding == 0.0:
        return 1.0 if abs(x) >= half else 0.0
    a, b = x + half, x - half
    return 1.0 - 0.5 * (a / np.hypot(a, rounding) - b / np.hypot(b, rounding))


def dead_zone_energy(x, half, rounding):
    """Integral of `dead_zone` from the middle of the play to x."""
    if rounding == 0.0:
        s = dead_zone(x, half, rounding)
        return 0.5 * s * s
    w2, a, b = rounding * rounding, x + half, x - half
    left = a * np.sqrt(a * a + w2) + w2 * np.arcsinh(a / rounding)
    right = b * np.sqrt(b * b + w2) + w2 * np.arcsinh(b / rounding)
    middle = half * np.sqrt(half * half + w2) + w2 * np.arcsinh(half / rounding)
    return 0.5 * x * x - 0.25 * (left - right) + 0.5 * middle


def spring_damping(c, s):
    """Damping of a transmission with the constants c, whose spring is deflected by s.

    Within the play it is c[5]. It goes over to c[1] with s^2/(s^2 + w^2), w a tenth of half the play and the
    rounding, so that the torque has no jump where the flanks meet.
    """
    value = c[1]
    if c[2] != 0.0 and c[1] != c[5]:
        width = ENGAGEMENT * c[2] + c[4]
        value = c[5] + (c[1] - c[5]) * (s * s / (s * s + width * width))
    return value + c[3] * c[0] * abs(s)


def spring_torque(c, x, rate):
    """Torque that a transmission with the constants c transmits from link to motor, deflected by x."""
    s = dead_zone(x, c[2], c[4])
    return c[0] * s + spring_damping(c, s) * rate


def slip_level(d, i, delta, delta_d, rate):
    """Level of joint i's friction beyond Coulomb's, its motor turning with this rate."""
    c, level = d.slip[i], 0.0
    if c[0] != 0.0:
        x = rate / c[1]
        level += c[0] * np.exp(-x * x)
    if c[2] != 0.0:
        row = d.spring[i]
        level += c[2] * abs(spring_torque(d.transmission[i], delta[row], delta_d[row]))
    return level


def take_off_slip(d, delta, delta_d, qd, driven, torque):
    """Take the joints' friction beyond Coulomb's off the net torque, in place."""
    for i in range(d.links):
        c = d.slip[i]
        if not driven[i] and (c[0] != 0.0 or c[2] != 0.0):
            torque[i] -= slip_level(d, i, delta, delta_d, qd[i]) * np.tanh(qd[i] / c[3])


def modal_force(d, w, delta, delta_d, force):
    """Elastic and damping force of all modes and transmissions, after `prepare`."""
    for i in range(d.links):
        row = d.spring[i]
        if JOINT_PARTS and row >= 0:
            force[row] = -spring_torque(d.transmission[i], delta[row], delta_d[row])
        for j in range(d.count[i]):
            acc = -w.elastic[i, j]
            for k in range(d.count[i]):
                acc -= d.damping[i, j, k] * delta_d[d.first[i] + k]
            force[d.first[i] + j] = acc


def derivative(state, torque, data, out):
    """Time derivative of the state (q, delta, qd, delta_d) into `out`, under net joint torque; that may be overwritten.

    `data` is as `Chain` packs it.
    """
    constants, work, joint_extra, modal_extra, driven, force = data
    d, w = constants[0], work[0]
    n, m = torque.size, force.size
    for i in range(n + m):
        out[i] = state[n + m + i]
    for i in range(n):
        if driven[i]:  # what is called torque is then its acceleration
            out[n + m + i] = torque[i]
    q, delta = state[:n], state[n : n + m]
    qd, delta_d = state[n + m : 2 * n + m], state[2 * n + m :]
    prepare(d, w, q, delta, qd, delta_d)
    modal_force(d, w, delta, delta_d, force)
    if JOINT_PARTS:
        take_off_slip(d, delta, delta_d, qd, driven, torque)
    forward_dynamics(
        d, w, qd, torque, force, joint_extra, modal_extra, driven,
        out[n + m : 2 * n + m], out[2 * n + m :],
    )  # fmt: skip


def bias_forces(data, work, q, delta, qd, delta_d, zero, modal_zero, out):
    """All generalised forces of (2) but the inertial ones, joint friction and the transmissions' torque."""
    d, w = data[0], work[0]
    n = q.size
    prepare(d, w, q, delta, qd, delta_d)
    inverse_dynamics(d, w, qd, zero, modal_zero, d.gravity, out[:n], out[n:])
    for i in range(n):
        for j in range(d.count[i]):
            row = d.first[i] + j
            acc = out[n + row] + w.elastic[i, j]
            for k in range(d.count[i]):
                acc += d.damping[i, j, k] * delta_d[d.first[i] + k]
            out[n + row] = acc


def mass_matrix(data, work, q, delta, zero, modal_zero, no_gravity, M):
    """Mass matrix, one column per unit acceleration."""
    d, w = data[0], work[0]
    n, m = q.size, delta.size
    prepare(d, w, q, delta, zero, modal_zero)
    unit = np.zeros(n + m)
    for j in range(n + m):
        unit[j] = 1.0
        inverse_dynamics(d, w, zero, unit[:n], unit[n:], no_gravity, M[j, :n], M[j, n:])
        unit[j] = 0.0


def frames(data, work, q, delta, zero, modal_zero, R, p):
    """Orientation and origin of each link's base frame, and last of the tip's, in the base frame."""
    d, w = data[0], work[0]
    prepare(d, w, q, delta, zero, modal_zero)
    place_frames(d, w, R, p)


def place_frames(d, w, R, p):
    """As `frames`, after `prepare`."""
    for k in range(3):
        p[0, k] = w.arm[0, k]
        for m in range(3):
            R[0, k, m] = w.frame[0, k, m]
    for n in range(1, d.links + 1):
        product(R[n - 1], w.frame[n], R[n])
        apply(R[n - 1], w.arm[n], w.t[0])
        for k in range(3):
            p[n, k] = p[n - 1, k] + w.t[0, k]


def potential_energy(data, work, q, delta, zero, modal_zero):
    """Elastic and gravitational energy."""
    d, w = data[0], work[0]
    N = d.links
    R, p = np.zeros((N + 1, 3, 3)), np.zeros((N + 1, 3))
    frames(data, work, q, delta, zero, modal_zero, R, p)
    energy = 0.0
    for i in range(N):
        apply(R[i], w.c[i], w.t[0])
        energy -= d.mass[i] * dot(d.gravity, p[i]) + dot(d.gravity, w.t[0])
        for j in range(d.count[i]):
            if d.level != FINITE_SLOPE or d.direction[i, j] == TWIST or d.reduced[i] >= 0:
                energy += 0.5 * w.elastic[i, j] * delta[d.first[i] + j]
        if d.level == FINITE_SLOPE:
            for g in range(d.nodes):
                sy, sz, by, bz = slopes_and_bends(d, i, g, delta)
                c = 1.0 - sz * sz
                ky2 = (by + sy * sz * bz / c) ** 2 * c / (c - sy * sy)
                energy += 0.5 * (d.node_ei[i, g, 0] * ky2 + d.node_ei[i, g, 1] * bz * bz / c)
        if JOINT_PARTS and d.spring[i] >= 0:
            c = d.transmission[i]
            energy += c[0] * dead_zone_energy(delta[d.spring[i]], c[2], c[4])
    apply(R[N], d.payload_moment, w.t[0])
    return energy - d.payload_mass[0] * dot(d.gravity, p[N]) - dot(d.gravity, w.t[0])


def momentum(data, work, q, delta, qd, delta_d, out):
    """Linear momentum and angular momentum about the base's origin, in the base frame, rows of `out`."""
    d, w = data[0], work[0]
    N = d.links
    R, p = np.zeros((N + 1, 3, 3)), np.zeros((N + 1, 3))
    prepare(d, w, q, delta, qd, delta_d)
    place_frames(d, w, R, p)
    v, t = np.zeros((N + 1, 3)), w.t
    out[:] = 0.0
    for i in range(N + 1):
        om, P, L = w.omega[i], t[0], t[1]
        if i < N:
            # In link coordinates, about the link's base: P = m v + w x c + p delta_d, L = c x v + J w + l delta_d.
            cross(om, w.c[i], P)
            cross(w.c[i], v[i], L)
            apply(w.J[i], om, t[2])
            for k in range(3):
                P[k] += d.mass[i] * v[i, k]
                L[k] += t[2, k]
                for j in range(d.count[i]):
                    P[k] += w.p[i, j, k] * delta_d[d.first[i] + j]
                    L[k] += w.l[i, j, k] * delta_d[d.first[i] + j]
            spin = d.rotor[i] * (dot(d.axis[i], w.carrier[i]) + d.gear[i] * qd[i])
            for k in range(3):
                L[k] += spin * d.axis[i, k]
            if JOINT_PARTS and d.housed[i]:
                apply(w.housing[i], w.carrier[i], t[2])
                for k in range(3):
                    L[k] += t[2, k]
        else:
            cross(om, d.payload_moment, P)
            cross(d.payload_moment, v[i], L)
            apply(d.payload_inertia, om, t[2])
            for k in range(3):
                P[k] += d.payload_mass[0] * v[i, k]
                L[k] += t[2, k]
        apply(R[i], P, t[3])
        apply(R[i], L, t[4])
        cross(p[i], t[3], t[5])
        for k in range(3):
            out[0, k] += t[3, k]
            out[1, k] += t[4, k] + t[5, k]
        if i < N:
            # Velocity of the next frame's origin.
            cross(om, w.arm[i + 1], t[6])
            for k in range(3):
                t[6, k] += v[i, k]
                for j in range(d.count[i]):
                    t[6, k] += w.partial[i + 1, j, k] * delta_d[d.first[i] + j]
            apply_transposed(w.frame[i + 1], t[6], v[i + 1])


def point(data, work, index, q, delta, zero, modal_zero, offset, place, jacobian):
    """Position and Jacobian (linear, angular; base frame) of a point off the tip of link `index`, the last of `d`."""
    d, w = data[0], work[0]
    N, n = d.links, q.size
    R, p = np.zeros((N + 1, 3, 3)), np.zeros((N + 1, 3))
    prepare(d, w, q, delta, zero, modal_zero)
    place_frames(d, w, R, p)
    apply(R[index + 1], offset, w.t[0])
    for k in range(3):
        place[k] = p[index + 1, k] + w.t[0, k]
    t = w.t
    for i in range(index + 1):
        apply(R[i], d.axis[i], t[1])
        put_column(jacobian, i, t[1], place, p[i], t)
        if JOINT_PARTS and d.spring[i] >= 0:
            put_column(jacobian, n + d.spring[i], t[1], place, p[i], t)
        for j in range(d.count[i]):
            column = n + d.first[i] + j
            apply(R[i], w.turning[i + 1, j], t[1])
            put_column(jacobian, column, t[1], place, p[i + 1], t)
            apply(R[i], w.partial[i + 1, j], t[2])
            for k in range(3):
                jacobian[k, column] += t[2, k]


def put_column(jacobian, column, axis, place, origin, t):
    """Rotation about `axis` through `origin`."""
    for k in range(3):
        t[8, k] = place[k] - origin[k]
    cross(axis, t[8], t[9])
    for k in range(3):
        jacobian[k, column] = t[9, k]
        jacobian[3 + k, column] = axis[k]


def spring_terms(c, state, row, step):
    """Stiffness and damping of a transmission that `implicit_step` takes implicitly: where it is or gets in contact."""
    x, rate = state[row], state[state.size // 2 + row]
    touches = c[4] > 0.0 or abs(x) >= c[2] or abs(x + step * rate) >= c[2]
    return c[0] if touches else 0.0, spring_damping(c, dead_zone(x, c[2], c[4]))


def implicit_step(state, torque, change, step, substeps, stages, net, extra, friction, data):
    r"""Advance `state` in place by a linearly implicit method that damps stiff modes: stable at any step.

    A W-method of order two (Verwer et al. 1999, SIAM J. Sci. Comput. 20(4), ROS2, gamma = 1 - 1/sqrt 2,
    L-stable in the terms taken implicitly: modal stiffness, modal damping and joint friction):

    .. math::
        (I - \gamma hA)k_1 = F(y_0), \quad (I - \gamma hA)k_2 = F(y_0 + hk_1) - 2k_1, \quad
        y = y_0 + \tfrac32hk_1 + \tfrac12hk_2 .

    For the velocities, each stage is one articulated-body recursion with gamma h D + (gamma h)^2 K added to the modal
    mass. The torque is that in the middle of each step.

    Parameters
    ----------
    state, torque, change, step, substeps, friction
        As for `runge_kutta`.
    stages : ndarray, shape (4, 2 (n + m))
        Work space.
    net : ndarray, shape (n,)
        Work space.
    extra : tuple of ndarray, shapes (N, 2) and (N, K, K)
        Work space: what is added to the mass matrix.
    data : tuple
        As for `derivative`.
    """
    constants, work, _, _, driven, force = data
    d, w = constants[0], work[0]
    n, m = torque.size, force.size
    size = n + m
    gamma = 1.0 - np.sqrt(0.5)
    g = gamma * step
    joint_extra, modal_extra = extra
    for i in range(n):
        for j in range(d.count[i]):
            for k in range(d.count[i]):
                modal_extra[i, j, k] = g * d.damping[i, j, k] + g * g * d.stiffness[i, j, k]
    k1, k2, point = stages[0], stages[1], stages[2]
    for number in range(substeps):
        for v in range(2 * size):
            point[v] = state[v]
        for stage in range(2):
            out = stages[stage]
            q, delta = point[:n], point[n:size]
            qd, delta_d = point[size : size + n], point[size + n :]
            fraction = (number + 0.5) / substeps
            net_torque(torque, change, fraction, friction, point, net)  # noqa: F821 - of kernels.integrators
            prepare(d, w, q, delta, qd, delta_d)
            modal_force(d, w, delta, delta_d, force)
            if JOINT_PARTS:
                take_off_slip(d, delta, delta_d, qd, driven, net)
            for i in range(n):
                s = d.spring[i]
                if JOINT_PARTS and s >= 0:
                    stiff, damp = spring_terms(d.transmission[i], state, n + s, step)
                    if stage == 0:
                        joint_extra[i, 1] = g * damp + g * g * stiff
                        force[s] -= g * stiff * state[size + n + s]
                    else:
                        force[s] += 2.0 * joint_extra[i, 1] * k1[size + n + s]
                        force[s] -= g * stiff * (point[size + n + s] - 2.0 * k1[n + s])
                if driven[i]:  # what is called torque is then its acceleration
                    out[size + i] = net[i]
                elif stage == 0:
                    slip = friction[i, 0]
                    if friction[i, 1] != 0.0:
                        # The secant, not the tangent: a joint that slips now may stick within the step.
                        x = max(abs(qd[i]) / friction[i, 2], 1e-6)
                        slip += friction[i, 1] / friction[i, 2] * np.tanh(x) / x
                    if JOINT_PARTS and d.slip[i, 3] != 0.0:
                        x = max(abs(qd[i]) / d.slip[i, 3], 1e-6)
                        level = slip_level(d, i, delta, delta_d, qd[i])
                        slip += level / d.slip[i, 3] * np.tanh(x) / x
                    joint_extra[i, 0] = g * slip
                else:
                    net[i] += 2.0 * joint_extra[i, 0] * k1[size + i]
                first = d.first[i]
                for j in range(d.count[i]):
                    acc = 0.0
                    for k in range(d.count[i]):
                        row = n + first + k
                        if stage == 0:
                            acc -= g * d.stiffness[i, j, k] * state[size + row]
                        else:
                            acc += 2.0 * modal_extra[i, j, k] * k1[size + row]
                            acc -= g * d.stiffness[i, j, k] * (point[size + row] - 2.0 * k1[row])
                    force[first + j] += acc
            forward_dynamics(
                d, w, qd, net, force, joint_extra, modal_extra, driven,
                out[size : size + n], out[size + n :],
            )  # fmt: skip
            for v in range(size):
                if stage == 0:
                    k1[v] = state[size + v] + g * k1[size + v]
                else:
                    k2[size + v] -= 2.0 * k1[size + v]
                    k2[v] = point[size + v] - 2.0 * k1[v] + g * k2[size + v]
            if stage == 0:
                for v in range(2 * size):
                    point[v] = state[v] + step * k1[v]
        for v in range(2 * size):
            state[v] += step * (1.5 * k1[v] + 0.5 * k2[v])


def implicit_trajectory(states, starts, ends, step, substeps, stages, net, extra, friction, data):
    """As `runge_kutta_trajectory`, by `implicit_step`."""
    change = np.empty(net.size)
    for k in range(starts.shape[0]):
        begin_row(states, starts, ends, k, change)  # noqa: F821 - of kernels.integrators
        implicit_step(
            states[k + 1], starts[k], change, step, substeps, stages, net, extra, friction, data
        )


def linearise(data, work, q, delta, qd, delta_d, step, zero, modal_zero, out, K, C):
    """Derivatives of `bias_forces` by delta (K) and delta_d (C), by imaginary steps: all arrays complex."""
    for variable in range(2):
        for j in range(delta.size):
            if variable == 0:
                delta[j] += 1j * step
            else:
                delta_d[j] += 1j * step
            bias_forces(data, work, q, delta, qd, delta_d, zero, modal_zero, out)
            for i in range(out.size):
                if variable == 0:
                    K[i, j] = out[i].imag / step
                else:
                    C[i, j] = out[i].imag / step
            if variable == 0:
                delta[j] -= 1j * step
            else:
                delta_d[j] -= 1j * step
