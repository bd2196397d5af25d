# SPDX-License-Identifier: Apache-2.0
r"""Evaluates recorded operations one after the other: close to compiled straight-line code, and nothing to compile.

Each operation is one of the same kind, :math:`v_i = s\,v_a v_b + t\,v_c`, so that there is no branch to be
mispredicted. See `straight_arm`, which records them; `fill_slow_torque` is that of `rigid`.
"""

import numpy as np


def run(v, first, places, signs):
    """Evaluate operations; their results follow one another in `v` from `first` on.

    Parameters
    ----------
    v : ndarray
        Operands and results.
    first : int
    places : ndarray of int, shape (k, 3)
        a, b and c.
    signs : ndarray, shape (k, 2)
        s and t.
    """
    for i in range(places.shape[0]):
        a, b, c = places[i, 0], places[i, 1], places[i, 2]
        v[first + i] = signs[i, 0] * (v[a] * v[b]) + signs[i, 1] * v[c]


def evaluate(v, inputs, counts, places, signs, functions, outputs, friction, q, qd, out):
    """Fill `out` with what the tape gives at joint positions and velocities, and add the joints' friction.

    Parameters
    ----------
    v : ndarray
        Work space with the constants, and whatever depends on them alone, in place.
    inputs : int
        Where q and qd are in `v`.
    counts : ndarray of int, shape (3,)
        Operations that depend on constants alone, those that angles of `functions` need, and where the first is in
        `v`.
    places, signs : ndarray, shape (k, 3), (k, 2)
        See `run`.
    functions : ndarray of int, shape (f, 3)
        Angle and result; 1: sine, 0: cosine.
    outputs : ndarray of int
        Where in `v` each value of `out` is.
    friction : ndarray, shape (n, 3)
        Viscous, Coulomb, smoothing: of the first n values of `out`.
    q, qd : ndarray, shape (n,)
    out : ndarray
    """
    n = q.size
    for i in range(n):
        v[inputs + i] = q[i]
        v[inputs + n + i] = qd[i]
    known, early, first = counts[0], counts[1], counts[2]
    run(v, first + known, places[known:early], signs[known:early])
    for i in range(functions.shape[0]):
        angle = v[functions[i, 0]]
        v[functions[i, 1]] = np.sin(angle) if functions[i, 2] == 1 else np.cos(angle)
    run(v, first + early, places[early:], signs[early:])
    for i in range(outputs.size):
        out[i] = v[outputs[i]]
    for i in range(n):
        out[i] += friction[i, 0] * qd[i]
        if friction[i, 1] != 0.0:
            out[i] += friction[i, 1] * np.tanh(qd[i] / friction[i, 2])


def evaluate_along(v, inputs, counts, places, signs, functions, outputs, friction, motions, out):
    """As `evaluate`, at k states: `motions` (k, 3, n) has positions, velocities and more; `out` is (k, …)."""
    for i in range(motions.shape[0]):
        evaluate(
            v,
            inputs,
            counts,
            places,
            signs,
            functions,
            outputs,
            friction,
            motions[i, 0],
            motions[i, 1],
            out[i],
        )


def slow_torque_at(
    v,
    inputs,
    counts,
    places,
    signs,
    functions,
    outputs,
    friction,
    q,
    qd,
    acceleration,
    modes,
    values,
):
    """Torque that gives the slow subsystem an acceleration at joint positions and velocities, (n,).

    Parameters
    ----------
    v, inputs, counts, places, signs, functions, outputs, friction, q, qd
        As of `evaluate`.
    acceleration : ndarray, shape (n,)
    modes : int
        m.
    values : ndarray, shape ((n + m) (1 + m + n),)
        Overwritten by what the tape gives: forces, K, and the first n columns of M.
    """
    evaluate(v, inputs, counts, places, signs, functions, outputs, friction, q, qd, values)
    n = q.size
    size = n + modes
    K = values[size : size * (1 + modes)].reshape(size, modes)
    M = values[size * (1 + modes) :].reshape(size, n)
    torque = np.empty(n)
    fill_slow_torque(M, values[:n], values[n:size], K[:n], K[n:], acceleration, torque)  # noqa: F821
    return torque
