# SPDX-License-Identifier: Apache-2.0
r"""Linear systems: computes Jacobians by central differences, linearises the arm, and samples exactly.

A system :math:`\dot s = As + Bu` whose input is held over a period T (zero-order hold) moves exactly by

.. math::
    s_{k+1} = \Phi s_k + \Gamma u_k, \qquad
    \begin{bmatrix}\Phi & \Gamma\\ 0 & I\end{bmatrix}
    = \exp\Bigl(\begin{bmatrix}A & B\\ 0 & 0\end{bmatrix}T\Bigr),

and white noise of spectral density S on :math:`\dot s` adds the covariance (Van Loan 1978)

.. math:: Q = \int_0^T e^{At}\,S\,e^{A^Tt}dt .
"""

import numpy as np
from scipy.linalg import expm

#: Step of the central differences by joint angles, deflections and their rates [rad, m, rad/s, m/s].
STEP = 1e-6


def jacobian(function, x, step=STEP):
    """Derivative of a vector by a vector, by central differences; exact for polynomials of second degree.

    Parameters
    ----------
    function : callable
        Takes an array like `x`, returns an array of shape (N,).
    x : array_like, shape (k,)
    step : float
        Half the distance between the two points of a difference, the same for every entry of `x`.

    Returns
    -------
    ndarray, shape (N, k)
    """
    x = np.asarray(x, float)
    columns = []
    for i in range(x.size):
        move = np.zeros(x.size)
        move[i] = step
        ahead = np.array(function(x + move))  # a copy: the function may reuse its array
        columns.append((ahead - function(x - move)) / (2.0 * step))
    return np.stack(columns, axis=1) if columns else np.zeros((np.size(function(x)), 0))


def state_matrix(model, state, torque=0.0, coulomb=True, step=STEP):
    """A of the arm (2), linearised at a state (q, delta, qd, delta_d) under a torque.

    Parameters
    ----------
    model : ArmModel
    state : ndarray, shape (2 (n + m),)
    torque : ndarray, shape (n,), or 0.0
        [N m]
    coulomb : bool
        True: Coulomb friction has the derivative of its smoothed form, largest at rest; a law that compensates friction
        assumes the same. False: viscous friction only, as when the arm moves.
    step : float
        Step of the differences.

    Returns
    -------
    ndarray, shape (2 (n + m), 2 (n + m))
    """
    n, half = model.n_joints, state.size // 2
    viscous = model.friction_table()[:, 0]

    def derivative(s):
        u = torque
        if not coulomb:  # remove the model's friction, and add its viscous part again
            delta, qd, delta_d = s[n:half], s[half : half + n], s[half + n :]
            u = u + model.friction(qd, delta, delta_d) - viscous * qd
        return model.derivative(s, u)

    A = jacobian(derivative, state, step)
    A[:half] = np.hstack([np.zeros((half, half)), np.eye(half)])  # known exactly
    return A


def linear_plant(model, q, coulomb=True):
    """The arm (2), linearised at rest, with the torque that holds it against gravity and all play closed.

    Parameters
    ----------
    model : ArmModel
    q : ndarray, shape (n,)
        [rad]
    coulomb : bool
        As in `state_matrix`.

    Returns
    -------
    A, B : ndarray, shape (2 (n + m), 2 (n + m)), (2 (n + m), n)
        For the state (q, delta, qd, delta_d) and the joint torque.
    """
    model = model.without_play()
    n, rest, hold = model.n_joints, state_at_rest(model, q), static_torque(model, q)
    A = state_matrix(model, rest, hold, coulomb)
    # The arm is exactly linear in the torque, so a step of one is exact.
    B = jacobian(lambda u: model.derivative(rest, hold + u), np.zeros(n), step=1.0)
    return A, B


def moving_plant(model, q, velocity, acceleration):
    r"""The arm (2) linearised about a motion, "frozen" at one time of it.

    The links are bent as in a slow motion, :math:`K_2\delta = -f_2(q, \dot q) - M_{21}\ddot q`. The torque gives the
    joints their acceleration. Coulomb friction is constant, as in a joint that keeps moving. At rest the result is
    `linear_plant` without Coulomb friction, except for products of deflections and weight.

    Parameters
    ----------
    model : ArmModel
    q, velocity, acceleration : ndarray, shape (n,)
        [rad], [rad/s], [rad/s^2]

    Returns
    -------
    A, B : ndarray, shape (2 (n + m), 2 (n + m)), (2 (n + m), n)
        As of `linear_plant`.
    """
    model = model.without_play()
    n, m = model.n_joints, model.n_modes
    terms = model.terms(q, velocity)
    state = np.zeros(2 * (n + m))
    state[:n], state[n + m : 2 * n + m] = q, velocity
    state[n : n + m] = np.linalg.solve(terms.K2, -terms.f2 - terms.M[n:, :n] @ acceleration)
    joints = slice(n + m, 2 * n + m)
    free = np.array(model.derivative(state, np.zeros(n)))
    B = jacobian(lambda u: model.derivative(state, u), np.zeros(n), step=1.0)
    torque = np.linalg.solve(B[joints], acceleration - free[joints])
    # `state_matrix` has only viscous friction. All other friction takes a constant torque, its value at this speed.
    taken = model.friction(velocity, state[n : n + m], np.zeros(m))
    torque -= taken - model.friction_table()[:, 0] * velocity
    return state_matrix(model, state, torque, coulomb=False), B


def softened(model, q, A, place, transmission, fraction):
    """A of `linear_plant` with only a fraction of a transmission's stiffness and damping.

    Parameters
    ----------
    model : ArmModel
    q : ndarray, shape (n,)
        [rad]
    A : ndarray, shape (2 (n + m), 2 (n + m))
    place : int
        Index of the transmission's deflection in (q, delta).
    transmission : Transmission
    fraction : float
        Fraction that remains [-].

    Returns
    -------
    ndarray, shape (2 (n + m), 2 (n + m))
    """
    half = A.shape[0] // 2
    delta = state_at_rest(model.without_play(), q)[model.n_joints : half]
    push = np.linalg.inv(model.mass_matrix(np.asarray(q, float), delta))[:, place]
    out = A.copy()
    out[half:, place] += (1.0 - fraction) * transmission.stiffness * push
    out[half:, half + place] += (1.0 - fraction) * transmission.damping * push
    return out


def state_at_rest(model, q):
    """State (q, delta, qd, delta_d) of the arm at rest, bent by its weight, shape (2 (n + m),)."""
    n, m = model.n_joints, model.n_modes
    rest = np.zeros(2 * (n + m))
    rest[:n], rest[n : n + m] = q, model.static_deflection(q)
    return rest


def static_torque(model, q):
    """Joint torque that holds the arm at rest against its weight, shape (n,) [N m]."""
    n, m = model.n_joints, model.n_modes
    delta = model.static_deflection(q)
    t = model.terms(q, np.zeros(n), delta, np.zeros(m))
    return t.f1 + t.K1 @ delta


def sampled(A, B, period):
    r"""Phi = :math:`e^{AT}` and Gamma = :math:`\int_0^T e^{At}B\,dt`: the exact transition under constant input.

    Parameters
    ----------
    A : ndarray, shape (..., N, N)
        One system, or a stack of them.
    B : ndarray, shape (..., N, k) or (N, k)
    period : float
        T [s].

    Returns
    -------
    Phi : ndarray, shape (..., N, N)
    Gamma : ndarray, shape (..., N, k)
    """
    N, k = B.shape[-2:]
    big = np.zeros((*A.shape[:-2], N + k, N + k))
    big[..., :N, :N], big[..., :N, N:] = A, B
    flow = expm(big * period)
    return flow[..., :N, :N], flow[..., :N, N:]


def sampled_noise(A, density, period):
    r"""Covariance :math:`\int_0^T e^{At}\,S\,e^{A^Tt}dt` that white noise on the state's derivative adds.

    Parameters
    ----------
    A : ndarray, shape (N, N)
    density : ndarray, shape (N, N)
        Spectral density S.
    period : float
        T [s].

    Returns
    -------
    ndarray, shape (N, N)
        Symmetric.
    """
    # Van Loan's exponential contains e^(-At), which grows. So compute it over a step in which no mode decays much, and
    # double the step until it has the length of the period.
    N = A.shape[0]
    fastest = np.abs(np.linalg.eigvals(A)).max()
    doublings = max(0, int(np.ceil(np.log2(max(fastest * period, 1.0)))))
    big = np.zeros((2 * N, 2 * N))
    big[:N, :N], big[:N, N:], big[N:, N:] = -A, density, A.T
    flow = expm(big * period / 2**doublings)
    Phi = flow[N:, N:].T
    Q = Phi @ flow[:N, N:]
    for _ in range(doublings):
        Q = Q + Phi @ Q @ Phi.T
        Phi = Phi @ Phi
    return 0.5 * (Q + Q.T)
