# SPDX-License-Identifier: Apache-2.0
"""Inverse and forward dynamics, from link to link; see `kernels.chain`.

Throughout, d is the arm's `chain_data.Data`, w its `chain_data.Work`, and i the number of a link.
"""

from .chain_data import JOINT_PARTS
from .placing import add_housing_spin, payload
from .transmissions import spring_torque
from .vectors import (
    apply,
    apply_transposed,
    congruence,
    cross,
    dot,
    product,
    skew,
    symmetric_congruence,
)


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
