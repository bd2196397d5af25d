# SPDX-License-Identifier: Apache-2.0
r"""Computes the slow and the fast subsystem of an arm (Siciliano & Book 1986, section 3).

Everything is computed from the `Terms` of (2) taken without deflections: the paper's assumptions a) and b).
Names follow the paper: x = (q, qd), z = (delta, delta_d), a bar for the slow subsystem.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import matrix_balance

from .kernels import load, rigid


@dataclass(frozen=True)
class StateSpace:
    """F, g1, A1, B1 of (6a) and A2, g2, B2 of (6b)."""

    F: np.ndarray
    g1: np.ndarray
    A1: np.ndarray
    B1: np.ndarray
    A2: np.ndarray
    g2: np.ndarray
    B2: np.ndarray


def state_space(terms):
    """The form (6) at one state.

    Parameters
    ----------
    terms : Terms

    Returns
    -------
    StateSpace
        With n joints and m modes: F (2n, 2n), g1 (2n,), A1 (2n, 2m), B1 (2n, n), A2 (2m, 2m), g2 (2m,),
        B2 (2m, n).
    """
    n, m = terms.f1.size, terms.f2.size
    H11, H12, H21, H22 = terms.partition()
    t = terms
    F = np.block([[np.zeros((n, n)), np.eye(n)], [np.zeros((n, 2 * n))]])
    A1 = np.block(
        [[np.zeros((n, 2 * m))], [-(H11 @ t.K1 + H12 @ t.K2), -(H11 @ t.C1 + H12 @ t.C2)]]
    )
    A2 = np.block(
        [[np.zeros((m, m)), np.eye(m)], [-(H21 @ t.K1 + H22 @ t.K2), -(H21 @ t.C1 + H22 @ t.C2)]]
    )
    return StateSpace(
        F=F,
        g1=np.concatenate([np.zeros(n), -(H11 @ t.f1 + H12 @ t.f2)]),
        A1=A1,
        B1=np.vstack([np.zeros((n, n)), H11]),
        A2=A2,
        g2=np.concatenate([np.zeros(m), -(H21 @ t.f1 + H22 @ t.f2)]),
        B2=np.vstack([np.zeros((m, n)), H21]),
    )


def quasi_steady_state(terms, torque):
    r"""Deflection part of (9), the quasi-steady state.

    .. math:: \bar\delta = (H_{21}K_1 + H_{22}K_2)^{-1}(-H_{21}f_1 - H_{22}f_2 + H_{21}\bar u)

    Parameters
    ----------
    terms : Terms
        Without deflections.
    torque : ndarray, shape (n,)
        Slow control [N m].

    Returns
    -------
    ndarray, shape (m,)
        The rates of the quasi-steady state are zero.
    """
    _, _, H21, H22 = terms.partition()
    return np.linalg.solve(
        H21 @ terms.K1 + H22 @ terms.K2, H21 @ (torque - terms.f1) - H22 @ terms.f2
    )


def slow_subsystem(terms):
    r"""a and B of (10), the acceleration part: :math:`\ddot{\bar q} = a + B\bar u`.

    Returns
    -------
    a : ndarray, shape (n,)
        [rad/s^2]
    B : ndarray, shape (n, n)
        [1/(kg m^2)]; with K1 = 0 the inverse of M11: the rigid arm.
    """
    H11, H12, H21, H22 = terms.partition()
    lift = np.linalg.solve(
        (H21 @ terms.K1 + H22 @ terms.K2).T, (H11 @ terms.K1 + H12 @ terms.K2).T
    ).T
    a = -(H11 @ terms.f1 + H12 @ terms.f2) + lift @ (H21 @ terms.f1 + H22 @ terms.f2)
    return a, H11 - lift @ H21


def slow_torque(terms, acceleration):
    r"""Torque that gives the slow subsystem (10) an acceleration: :math:`\bar u = B^{-1}(\ddot q - a)`.

    The joint rows of (2) give it, with the deflections at which the modal rows are in balance. M is not inverted:

    .. math:: \bar u = M_{11}\ddot q + f_1 - K_1 K_2^{-1}(M_{21}\ddot q + f_2)

    Parameters
    ----------
    terms : Terms
        Without deflections.
    acceleration : ndarray, shape (n,)
        [rad/s^2]

    Returns
    -------
    ndarray, shape (n,)
        [N m]
    """
    t = terms
    return _compiled().slow_torque(t.M, t.f1, t.f2, t.K1, t.K2, np.asarray(acceleration, float))


@cache
def _compiled():
    """The compiled functions of `kernels.rigid`."""
    return load.joined("rigid", (load.source(rigid),), inline=("solve",))


def fast_subsystem(terms):
    """A2 (2m, 2m) and B2 (2m, n) of the boundary layer (11), in the time t (mu is included in A2)."""
    s = state_space(terms)
    return s.A2, s.B2


def is_stabilisable(A, B, margin=0.0):
    """Whether every eigenvalue of A with real part >= -margin can be moved by B (Hautus' test).

    Parameters
    ----------
    A, B : ndarray
    margin : float
        Prescribed degree of stability [1/s].

    Returns
    -------
    stabilisable : bool
    worst : float
        Smallest normalised singular value of [A - s I, B] over those eigenvalues; infinite if there is none.
    """
    worst = np.inf
    size = A.shape[0]
    norm = np.linalg.norm(A)
    # Balance the matrix, and scale for each eigenvalue: otherwise stiff modes hide the input's effect on soft ones.
    balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
    B = B / units[:, None]
    gain = np.linalg.norm(B) or 1.0
    for s in np.linalg.eigvals(A):
        if s.real >= -margin - 1e-9 * norm:
            scale = max(abs(s), 1e-12 * norm, 1e-300)
            pencil = np.hstack([(balanced - s * np.eye(size)) / scale, B / gain])
            worst = min(worst, np.linalg.svd(pencil, compute_uv=False)[-1])
    return bool(worst > 1e-9), float(worst)


@dataclass(frozen=True)
class TimeScales:
    """Speeds of the slow and of the fast subsystem, and their ratio.

    Attributes
    ----------
    slow, fast : ndarray
        Eigenvalues [rad/s].
    mu : float
        The paper's estimate of the perturbation parameter: highest slow frequency over lowest fast frequency.
    separation : float
        1/mu.
    """

    slow: np.ndarray
    fast: np.ndarray

    @property
    def mu(self):
        """The paper's estimate of the perturbation parameter [-]."""
        return float(np.max(np.abs(self.slow)) / np.min(np.abs(self.fast)))

    @property
    def separation(self):
        """1/mu [-]; infinite if all eigenvalues of the slow subsystem are zero."""
        return float("inf") if self.mu == 0.0 else 1.0 / self.mu


def time_scales(terms, kp=None, kv=None, K_f=None):
    """Eigenvalues of the slow and of the fast subsystem, in open or closed loop.

    Parameters
    ----------
    terms : Terms
        Without deflections.
    kp, kv : ndarray, shape (n,), optional
        Gains of the decoupled slow loop, s^2 + kv s + kp = 0; not given: the open loop's double integrators.
    K_f : ndarray, shape (n, 2m), optional
        Gain of (15), u_f = K_f z_f; not given: open loop.

    Returns
    -------
    TimeScales
    """
    n = terms.n
    kp = np.zeros(n) if kp is None else np.broadcast_to(kp, n)
    kv = np.zeros(n) if kv is None else np.broadcast_to(kv, n)
    slow = np.concatenate([np.roots([1.0, v, p]) for p, v in zip(kp, kv, strict=True)])
    A2, B2 = fast_subsystem(terms)
    if K_f is not None:
        A2 = A2 + B2 @ K_f
    return TimeScales(slow, np.linalg.eigvals(A2))


def full_order_matrix(terms, kp, kv, B_inverse, K_f):
    r"""Closed-loop matrix of the full-order system (2) at rest under the composite control (12).

    The control is :math:`\bar u = B^\dagger(-k_p q - k_v\dot q)` and :math:`u_f = K_f(z - \bar z)`, with
    :math:`\bar z` by (9). The state is (q, delta, qd, delta_d).

    Parameters
    ----------
    terms : Terms
        At rest, without deflections; gravity and friction are assumed to be compensated.
    kp, kv : array_like, shape (n,)
        Slow gains [1/s^2], [1/s].
    B_inverse : ndarray, shape (n, n)
        Factor in the slow law: the inverse of B, or 1/h11 as published [kg m^2].
    K_f : ndarray, shape (n, 2m)
        Gain of (15), u_f = K_f z_f; zero for slow control alone.

    Returns
    -------
    ndarray, shape (2 (n + m), 2 (n + m))
    """
    n, m = terms.n, terms.f2.size
    H = terms.H
    _, _, H21, H22 = terms.partition()
    steady = np.linalg.solve(H21 @ terms.K1 + H22 @ terms.K2, H21)  # delta_bar = steady @ u_slow
    slow = np.hstack(
        [-B_inverse @ np.diag(np.broadcast_to(kp, n)), np.zeros((n, m)),
         -B_inverse @ np.diag(np.broadcast_to(kv, n)), np.zeros((n, m))]
    )  # fmt: skip
    K_delta, K_rate = K_f[:, :m], K_f[:, m:]
    zero = np.zeros((n, n))
    fast = np.hstack([zero, K_delta, zero, K_rate]) - K_delta @ steady @ slow
    force = np.vstack([slow + fast, np.zeros((m, 2 * (n + m)))])
    force[:, n : n + m] -= np.vstack([terms.K1, terms.K2])
    force[:, 2 * n + m :] -= np.vstack([terms.C1, terms.C2])
    size = n + m
    return np.vstack([np.hstack([np.zeros((size, size)), np.eye(size)]), H @ force])


def frequencies_and_damping(eigenvalues):
    """Natural frequency [rad/s] and damping ratio of each conjugate pair or pair of real poles, ascending.

    Real poles are paired by ascending magnitude; a single one that remains counts as a pair of equal poles. Unstable
    pairs have a negative damping ratio.

    The `eigenvalues` are of a real matrix, in any order [rad/s].
    """
    eigenvalues = np.asarray(eigenvalues)
    pairs = eigenvalues[eigenvalues.imag > 0.0]
    omega = np.abs(pairs)
    zeta = -pairs.real / omega
    real = eigenvalues[eigenvalues.imag == 0.0].real
    real = real[np.argsort(np.abs(real))]
    if real.size % 2:
        real = np.append(real, real[-1])
    for slow, fast in real.reshape(-1, 2):
        product = np.sqrt(abs(fast * slow))
        omega = np.append(omega, product)
        at_zero = 1.0 if fast + slow <= 0.0 else -1.0
        zeta = np.append(zeta, -0.5 * (fast + slow) / product if product > 0.0 else at_zero)
    order = np.argsort(omega)
    return omega[order], zeta[order]
