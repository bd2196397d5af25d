# SPDX-License-Identifier: Apache-2.0
"""Linear steps of several states at once: see `robust.settling` for what they are for."""


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
