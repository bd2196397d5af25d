# SPDX-License-Identifier: Apache-2.0
"""Linear steps, of several states at once or under torque limits: see `robust.settling` and `robust.recovery`."""

import numpy as np

from .law import together


def steps(A, pushes, X):
    r"""Fill X with the states :math:`X_{k+1} = X_kA + P_k` that follow its first one; after the last P there is none.

    Parameters
    ----------
    A : ndarray, shape (N, N)
        Of states as rows: the usual one transposed.
    pushes : ndarray, shape (p, n, N)
        P.
    X : ndarray, shape (s, n, N)
    """
    for k in range(X.shape[0] - 1):
        for c in range(X.shape[1]):
            if k < pushes.shape[0]:
                X[k + 1, c] = pushes[k, c]
            else:
                X[k + 1, c] = 0.0
            for j in range(X.shape[2]):
                x = X[k, c, j]
                for i in range(X.shape[2]):
                    X[k + 1, c, i] += x * A[j, i]


def limited_steps(A, sent, effect, integral, held, pushes, motion, limit, X):
    r"""Fill X with the states that follow its first one under torque limits, see `robust.recovery`.

    From the first state that is larger than 1e12 on, they are NaN.

    Parameters
    ----------
    A : ndarray, shape (N, N)
    sent : ndarray, shape (n, N)
        Matrix of the torque that is fed back from a state, without `held`.
    effect : ndarray, shape (N, n)
        Effect of a change of that torque on the next state.
    integral : ndarray of int, shape (n,)
        Which states are the joints' :math:`-w`.
    held : ndarray, shape (n,)
        Torque that is fed back at rest.
    pushes : ndarray, shape (s, N)
        What is added to the next state.
    motion : ndarray, shape (s, n)
        Torque that is not fed back.
    limit : ndarray, shape (n,)
    X : ndarray, shape (s + 1, N)
    """
    n, N = sent.shape
    slow, fast, torque, wanted = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    asked = np.zeros(n)
    for k in range(pushes.shape[0]):
        for i in range(n):
            asked[i] = held[i]
            for j in range(N):
                asked[i] += sent[i, j] * X[k, j]
            slow[i] = torque[i] = motion[k, i] + asked[i]
            fast[i] = 0.0
        beyond = together(motion[k], limit, slow, fast, torque, wanted)
        largest = 0.0
        for i in range(N):
            value = pushes[k, i]
            for j in range(N):
                value += A[i, j] * X[k, j]
            X[k + 1, i] = value
            largest = max(largest, abs(value))
        if not largest < 1e12:
            X[k + 1 :] = np.nan
            return
        if not beyond:
            continue
        for i in range(n):
            given = min(max(torque[i], -limit[i]), limit[i])
            change = given - motion[k, i] - asked[i]
            for j in range(N):
                X[k + 1, j] += effect[j, i] * change
        for i in range(n):
            at = integral[i]
            if (X[k + 1, at] - X[k, at]) * wanted[i] < 0.0:  # the error pushes further
                X[k + 1, at] = X[k, at]
