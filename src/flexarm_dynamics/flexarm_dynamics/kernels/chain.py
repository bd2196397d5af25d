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

`vectors`, `sections` (frames along a link), `bodies` (its integrals), `placing` (links on each other), `transmissions`,
`recursions` and `implicit_steps` do it; here is what a model asks for.
"""

import numpy as np

from .chain_data import FINITE_SLOPE, JOINT_PARTS, TWIST
from .placing import prepare
from .recursions import forward_dynamics, inverse_dynamics, modal_force
from .sections import slopes_and_bends
from .transmissions import dead_zone_energy, take_off_slip
from .vectors import apply, apply_transposed, cross, dot, product


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


def generalised_forces(data, work, q, delta, qd, delta_d, qdd, delta_dd, out):
    """All generalised forces of (2) in a motion but joint friction and the transmissions' torque."""
    d, w = data[0], work[0]
    n = q.size
    prepare(d, w, q, delta, qd, delta_d)
    inverse_dynamics(d, w, qd, qdd, delta_dd, d.gravity, out[:n], out[n:])
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


def linearise(data, work, q, delta, qd, delta_d, step, zero, modal_zero, out, K, C):
    """Derivatives of `generalised_forces` by delta (K) and delta_d (C), by imaginary steps: all arrays complex."""
    for variable in range(2):
        for j in range(delta.size):
            if variable == 0:
                delta[j] += 1j * step
            else:
                delta_d[j] += 1j * step
            generalised_forces(data, work, q, delta, qd, delta_d, zero, modal_zero, out)
            for i in range(out.size):
                if variable == 0:
                    K[i, j] = out[i].imag / step
                else:
                    C[i, j] = out[i].imag / step
            if variable == 0:
                delta[j] -= 1j * step
            else:
                delta_d[j] -= 1j * step
