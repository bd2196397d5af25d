# SPDX-License-Identifier: Apache-2.0
"""The search for the gains whose slowest pole is the fastest."""

import numpy as np
from scipy.linalg import solve_continuous_are

from flexarm_dynamics.linear import linear_plant

from .nonsmooth import minimise

#: Starts: natural frequency of the joints over omega_1.
STARTS = (0.4, 0.2, 0.8, 0.1)
#: Starts from optimal regulators: their prescribed degree of stability over omega_1.
DECAYS = (0.1, 0.3)
#: Weight of the gains' size against the slowest pole.
SMALL_GAINS = 1e-6
#: Widths of the smooth maximum, one after the other; and rounds in which a search takes up the worst loop.
WIDTHS, ROUNDS = (0.3, 0.1, 0.03, 0.01), 2
#: Starts that are drawn about the best ones: their distance in scaled gains.
DRAWN = (0.03, 0.1, 0.3)
#: So many of the points that the starts lead to are followed; widths begin again so often, as long as that gains.
KEPT, CYCLES = 2, 3
#: Most evaluations of a search.
MOST = 4000.0
#: Evaluations of all loops, times their states to the power of 2.2, in a whole search.
EFFORT = 1e8


class Search:
    """Minimises the slowest pole of a set of loops, its noise penalised.

    Each search is on few loops, to which the worst of the others is added until none is worse.

    Parameters
    ----------
    slowest : Slowest
    noise : Noise
    enough : float
        Decay at which a search ends [-].
    effort : float
        Of the search; 1.0 is the usual one.
    seed : int
        Of the start that is drawn.

    Attributes
    ----------
    evaluations : float
        So many times all loops were looked at.
    """

    def __init__(self, slowest, noise, enough, effort=1.0, seed=0):
        self.slowest, self.noise, self.enough = slowest, noise, enough
        size = max(slowest.loops[0].F.shape[0], 20)
        self._budget = int(max(200.0, effort * min(EFFORT / size**2.2, MOST)))
        self._draw = np.random.default_rng(seed)
        n = slowest.scale.shape[0]
        positive = np.zeros(slowest.scale.shape, bool)
        positive[:, :n] = positive[:, 2 * n : 3 * n] = True  # stiffness and integral
        self._positive = positive[slowest.free]
        self._chosen = list(slowest.loops[:2])
        self.evaluations = 0.0

    def best(self, starts, progress=None):
        """The scaled gains with the smallest value found, from several `starts`."""
        found = sorted(((self.value(x), k, x) for k, x in enumerate(starts)), key=lambda f: f[:2])
        drawn = [x + s * self._draw.standard_normal(x.size) for _, _, x in found[:2] for s in DRAWN]
        tried = []
        for x in [x for _, _, x in found] + drawn:
            tried.append(self._refined(len(tried), x, self._budget // 16, WIDTHS[:2]))
            self._say(progress, 0.5 * len(tried) / (len(found) + len(drawn)), min(tried))
            if tried[-1][0] < -self.enough:
                break
        tried.sort(key=lambda f: f[:2])
        best = tried[0]
        for k, (_, _, x) in enumerate(tried[:KEPT]):
            for _ in range(CYCLES):
                last, found = best[0], self._refined(k, x, self._budget // 8, WIDTHS)
                x, best = found[2], min(best, found, key=lambda f: f[:2])
                if best[0] < -self.enough or last - best[0] < 0.03 * abs(best[0]):
                    break
            self._say(progress, 0.5 + 0.5 * (k + 1) / KEPT, best)
        return best[2]

    @staticmethod
    def _say(progress, fraction, best):
        if progress is not None:
            progress(fraction, -best[0])

    def value(self, x):
        """The slowest pole of all loops, with the penalties."""
        worst = self.slowest.worst(self.slowest.values(x))[0]
        return worst + self._penalty(x)[0]

    def _penalty(self, x):
        value, gradient = self.noise(x)
        below = np.where(self._positive, np.minimum(x, 0.0), 0.0)
        value += SMALL_GAINS * (x @ x) + 10.0 * below @ below
        return value, gradient + 2.0 * SMALL_GAINS * x + 20.0 * below

    def _smooth(self, width):
        """What is minimised, for the loops that are chosen by now."""
        part = self.slowest.smooth(list(self._chosen), width)

        def function(x):
            value, gradient = part(x)
            extra, slope = self._penalty(x)
            return value + extra, gradient + slope

        return function

    def _refined(self, k, x, evaluations, widths):
        """(value, k, x) after a search from x."""
        each = evaluations // (len(widths) * ROUNDS)
        for width in widths:
            for _ in range(ROUNDS):
                x, _, used = minimise(
                    self._smooth(width), x, each, lambda value: value < -self.enough
                )
                self.evaluations += used * len(self._chosen) / len(self.slowest.loops)
                if not self._grows(x):
                    break
        return self.value(x), k, x

    def _grows(self, x):
        """Choose the worst loop at x, too; whether it was not chosen before."""
        _, _, loop, *_ = self.slowest.worst(self.slowest.values(x))
        if loop is None or any(loop is one for one in self._chosen):
            return False
        self._chosen.append(loop)
        return True


def start(model, at, scale, a, late):
    """Gains of joints alone with a natural frequency of a omega_1, as far as a torque that is `late` [s] allows.

    What a torque moves at first is not the arm but the inertia that is left when the links bend, 1 / H_ii with H the
    inverse of the mass matrix: K_qd H_ii late is kept below a third.

    Parameters
    ----------
    model : ArmModel
    at : ndarray, shape (k, n)
        Configurations [rad].
    scale : ndarray, shape (n, 3n + 2m)
        Unit of each gain.
    a : float
        [-]
    late : float
        [s]

    Returns
    -------
    ndarray, shape (n, 3n + 2m)
    """
    K, n = np.zeros_like(scale), scale.shape[0]
    H = np.max([np.diag(np.linalg.inv(model.terms(q, np.zeros(n)).M))[:n] for q in at], axis=0)
    for i in range(n):
        damping = scale[i, n + i] * 2.0 * a
        fraction = min(1.0, 1.0 / (3.0 * H[i] * late) / damping)
        K[i, n + i] = fraction * damping
        K[i, i] = fraction * scale[i, i] * a**2 * 2.0
        K[i, 2 * n + i] = fraction * scale[i, 2 * n + i] * 0.3 * a**3
    return K


def optimal(model, q, omega_1, decay):
    r"""Gains of the optimal regulator of the whole arm at rest in q, without what the structure has no place for.

    It minimises :math:`\int e^{2\alpha t}(e^T Q e + u^T u)\,dt` of the joint errors e with
    :math:`Q^{1/2} = \mathrm{diag}(M_{11})\,\omega_1^2` and alpha = `decay` omega_1.
    """
    n, m = model.n_joints, model.n_modes
    A, B = linear_plant(model, q, coulomb=False)
    inertia = np.diag(model.terms(q, np.zeros(n)).M)[:n]
    Q = np.zeros(A.shape)
    Q[:n, :n] = np.diag((decay * inertia * omega_1**2) ** 2)
    try:
        P = solve_continuous_are(A + decay * omega_1 * np.eye(len(A)), B, Q, np.eye(n))
    except (np.linalg.LinAlgError, ValueError):
        return np.zeros((n, 3 * n + 2 * m))
    joint, amplitude, speed, rate = np.split(B.T @ P, [n, n + m, 2 * n + m], axis=1)
    joint, speed = np.abs(np.diag(joint)), np.diag(speed)
    diagonal = (np.diag(k) for k in (joint, speed, 0.2 * decay * omega_1 * joint))
    return np.hstack([*diagonal, amplitude, rate])
