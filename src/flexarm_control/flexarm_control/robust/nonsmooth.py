# SPDX-License-Identifier: Apache-2.0
"""Minimisation of a function that has kinks, by BFGS with a weak Wolfe line search.

This is the method of Lewis and Overton (2013), Nonsmooth optimization via quasi-Newton methods, Mathematical
Programming 141. On functions such as the slowest pole of a set of loops, gradient descent and trust regions stop at
kinks. BFGS goes on beyond them, provided that the line search requires only the weak Wolfe conditions.
"""

import numpy as np

#: Constants of the weak Wolfe conditions.
DECREASE, CURVATURE = 1e-4, 0.5
#: Maximum number of points in one line search, and the shortest step.
BISECTIONS, SHORTEST = 40, 1e-9
#: A search ends when this many steps have improved the value by less than this fraction.
STALE, LITTLE = 30, 1e-3


def minimise(function, x, evaluations, enough=None):
    """Local minimum of a function of one vector.

    Parameters
    ----------
    function : callable
        Takes x, returns the value and the gradient; where the value is infinite, x is out of bounds.
    x : ndarray
        Where to begin; the value there must be finite.
    evaluations : int
        Approximate maximum number of evaluations.
    enough : callable, optional
        Takes the value; True ends the search.

    Returns
    -------
    x, value, evaluations
    """
    value, gradient = function(x)
    H, fresh, used = np.eye(x.size) / max(1.0, np.linalg.norm(gradient)), True, 1
    history = []
    while used < evaluations and not (enough is not None and enough(value)):
        direction = -H @ gradient
        slope = gradient @ direction
        if not slope < 0.0:
            if fresh:
                break
            H, fresh = np.eye(x.size) / max(1.0, np.linalg.norm(gradient)), True
            continue
        step, tried = _line_search(function, x, value, direction, slope)
        used += tried
        if step is None:
            if fresh:
                break
            H, fresh = np.eye(x.size) / max(1.0, np.linalg.norm(gradient)), True
            continue
        new, value, new_gradient = step
        s, y = new - x, new_gradient - gradient
        curvature = s @ y
        if curvature > 1e-14:
            if fresh:
                H, fresh = np.eye(x.size) * (curvature / (y @ y)), False
            left = np.eye(x.size) - np.outer(s, y) / curvature
            H = left @ H @ left.T + np.outer(s, s) / curvature
        x, gradient = new, new_gradient
        history.append(value)
        if len(history) > STALE and history[-STALE] - value < LITTLE * max(abs(value), 0.01):
            break
    return x, value, used


def _line_search(function, x, value, direction, slope):
    """A point that satisfies the weak Wolfe conditions, with value and gradient; and the evaluations used.

    If no such point is found, it is the last one that satisfies the first condition, or None.
    """
    low, high, t, best, used = 0.0, np.inf, 1.0, None, 0
    length = np.linalg.norm(direction)
    for _ in range(BISECTIONS):
        point = x + t * direction
        new, gradient = function(point)
        used += 1
        if not new <= value + DECREASE * t * slope:
            high = t
        else:
            best = point, new, gradient
            if gradient @ direction >= CURVATURE * slope:
                break
            low = t
        t = 2.0 * low if np.isinf(high) else 0.5 * (low + high)
        if t * length < SHORTEST:
            break
    return best, used
