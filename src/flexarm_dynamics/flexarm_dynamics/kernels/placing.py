# SPDX-License-Identifier: Apache-2.0
"""Places all links, joints and the payload, and what inertia they have; see `kernels.chain`.

Throughout, d is the arm's `chain_data.Data`, w its `chain_data.Work`, and i the number of a link.
"""

from .bodies import at_nodes, body_first_order, body_foreshortened, body_reduced, elastic_force
from .chain_data import FIRST_ORDER, JOINT_PARTS
from .sections import attach, from_root, tip
from .vectors import about_axis, apply, apply_transposed, cross, product, skew, symmetric_congruence


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
