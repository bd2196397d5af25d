# SPDX-License-Identifier: Apache-2.0
"""Does ridge regression, with a strength that cross-validation in blocks of consecutive samples chooses."""

import numpy as np
from scipy.linalg import eigh

#: Blocks of the cross-validation.
BLOCKS = 5
#: Strengths of the ridge, relative to the mean square of all regressors [-].
RIDGES = 10.0 ** np.arange(-4.0, 3.1, 0.5)
#: Smallest mean square.
LEAST = 1e-300


def chosen(X, Y, weight):
    """Regression of all columns of `Y` on the same combination of the columns of `X`.

    Parameters
    ----------
    X : ndarray, shape (s, p)
        Regressors.
    Y : ndarray, shape (s, g)
    weight : ndarray, shape (g,)
        Weight of each column's squares.

    Returns
    -------
    coefficients : ndarray, shape (p,)
    left : float
        Remaining fraction of the weighted sum of squares of `Y`, in blocks to which the regression was not fitted [-].
    """
    strengths = len(X) * max(float(np.mean(X**2)), LEAST) * RIDGES
    left = np.zeros(len(strengths))
    for block in np.array_split(np.arange(len(X)), BLOCKS):
        others = np.ones(len(X), bool)
        others[block] = False
        made = X[block] @ _solved(X[others], Y[others], weight, strengths)
        left += [np.sum((Y[block] - column[:, None]) ** 2 @ weight) for column in made.T]
    best = int(np.argmin(left))
    whole = _solved(X, Y, weight, strengths[best : best + 1])[:, 0]
    return whole, float(left[best] / max(float(np.sum(Y**2 @ weight)), LEAST))


def _solved(X, Y, weight, strengths):
    """Coefficients for each of the strengths, shape (p, r)."""
    values, directions = eigh(X.T @ X)
    target = directions.T @ (X.T @ (Y @ weight)) / np.sum(weight)
    return directions @ (target[:, None] / (np.maximum(values, 0.0)[:, None] + strengths))


def lagged(columns, first, last):
    """The `columns` (s, c), delayed by `first` to `last` samples (negative: from the future), side by side.

    Values from beyond the ends are zero.
    """
    made = []
    for k in range(first, last + 1):
        late = np.roll(columns, k, axis=0)
        if k > 0:
            late[:k] = 0.0
        elif k < 0:
            late[k:] = 0.0
        made.append(late)
    return np.hstack(made)
