# SPDX-License-Identifier: Apache-2.0
r"""Fast control by pole placement, with prescribed frequency and damping of every mode of (11).

The boundary layer (11), :math:`\dot z_f = A_2 z_f + B_2 u_f`, taken at one joint configuration, has m modes with poles
:math:`s_i` (a conjugate pair, or two real ones). :math:`u_f = K_f z_f` moves those of mode i to

.. math:: p_i = \omega_i\,(-\zeta_i \pm j\sqrt{1-\zeta_i^2}), \qquad \omega_i = c_i\,|s_i|,

with the damping ratio :math:`\zeta_i` and the factor :math:`c_i` of the open frequency. Modes are numbered by ascending
open frequency of the boundary layer with the joints free to move; these are not the links' own frequencies.
:math:`\zeta_i = 0` leaves the poles of a mode exactly as they are: K_f then feeds back only the modal coordinates of
the other modes (left eigenvectors of A2). So a mode that no torque reaches can be left out.

With one torque, K_f is unique. With several, modes are moved one after the other, each by the combination of torques
that reaches it best (modal control, Simon & Mitter 1968). Feedback of a mode's own coordinates does not move the poles
of other modes. A design with a pole that misses its prescribed place is refused.
"""

import numpy as np
from scipy.linalg import matrix_balance
from scipy.optimize import linear_sum_assignment

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import fast_subsystem

from .base import FastLaw
from .lqr import CONFIGURATION, dominant_mode


class PolePlacement(FastLaw):
    """Constant gain that places the fast poles; see the module.

    Attributes
    ----------
    frequencies : ndarray, shape (m,)
        Open natural frequencies of (11), ascending [rad/s].
    poles : ndarray of complex, shape (2m,)
        Prescribed poles, mode by mode [1/s].
    """

    PARAMETERS = (
        parameter("damping", [0.5], "-", 0.0, 0.99, length="modes").described(
            "Closed-loop damping ratio of each fast mode, by ascending open-loop frequency; 0.0 leaves a mode as it is."
        ),
        parameter("frequency_scale", [1.0], "-", 0.1, 10.0, length="modes").described(
            "Ratio of closed-loop to open-loop natural frequency of each fast mode."
        ),
        CONFIGURATION,
    )

    #: Largest relative distance of a closed-loop pole from its prescribed place.
    TOLERANCE = 1e-6
    #: Normalised singular value below which no torque reaches a mode.
    UNREACHED = 1e-9

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        q = self.configuration
        self.A2, self.B2 = fast_subsystem(model.terms(q, np.zeros(model.n_joints)))
        self.K_f = np.zeros((model.n_joints, 2 * model.n_modes))
        self.frequencies, self.poles = np.zeros(0), np.zeros(0, complex)
        if model.n_modes:
            self._design(q)

    def _design(self, q):
        pairs, vectors = modes_of(self.A2)
        self.frequencies = np.sqrt(np.abs(pairs).prod(axis=1))
        damping = np.array(self.parameters["damping"])
        omega = self.frequencies * np.array(self.parameters["frequency_scale"])
        imaginary = 1j * omega * np.sqrt(1.0 - damping**2)
        wanted = np.stack([-damping * omega + imaginary, -damping * omega - imaginary], axis=1)
        moved = damping > 0.0
        wanted[~moved] = pairs[~moved]
        self.poles = wanted.ravel()
        self._refuse_unreached(pairs[moved, 0], vectors[:, moved], q)
        for open_pair, closed_pair in zip(pairs[moved], wanted[moved], strict=True):
            closed = self.A2 + self.B2 @ self.K_f
            self.K_f += moving_gain(closed, self.B2, open_pair, np.poly(closed_pair).real)
        self._refuse_missed(q)

    def _refuse_unreached(self, poles, vectors, q):
        for pole, vector, reach in zip(
            poles, vectors.T, reaches(self.A2, self.B2, poles), strict=True
        ):
            if reach < self.UNREACHED:
                raise DesignError(
                    f"at joint configuration {q.tolist()} the torques can't reach"
                    f" {dominant_mode(self.model, vector)}, at {abs(pole):.4g} rad/s (singular value {reach:.2g})",
                    field="fast.damping",
                    hint="give it the damping 0.0, which leaves it as it is",
                )

    def _refuse_missed(self, q):
        closed = np.linalg.eigvals(self.A2 + self.B2 @ self.K_f)
        distance = np.abs(self.poles[:, None] - closed) / np.abs(self.poles)[:, None]
        place = linear_sum_assignment(distance)
        i = int(np.argmax(distance[place]))
        if distance[place][i] > self.TOLERANCE:
            raise DesignError(
                f"at joint configuration {q.tolist()} the pole {self.poles[i]:.5g} 1/s came out at"
                f" {closed[place[1][i]]:.5g} 1/s: mode {i // 2 + 1} is next to out of reach",
                field="fast",
                hint="give it the damping 0.0, which leaves it as it is, or a damping and frequency_scale nearer to its"
                " own",
            )


def modes_of(A2):
    """Poles of A2 in (11), mode by mode, by ascending natural frequency.

    Returns
    -------
    pairs : ndarray of complex, shape (m, 2)
        A conjugate pair, or two real poles that are neighbours in magnitude.
    vectors : ndarray of complex, shape (2m, m)
        Eigenvector of the first pole of each pair.
    """
    poles, vectors = np.linalg.eig(A2)
    up = np.flatnonzero(poles.imag > 0.0)
    real = np.flatnonzero(poles.imag == 0.0)
    real = real[np.argsort(np.abs(poles[real]))].reshape(-1, 2)
    pairs = np.vstack([np.stack([poles[up], poles[up].conj()], axis=1), poles[real]])
    first = np.concatenate([up, real[:, 0]])
    order = np.argsort(np.abs(pairs).prod(axis=1))
    return pairs[order], vectors[:, first[order]]


def moving_gain(A, B, pair, polynomial):
    """Gain that moves two poles of A to the roots of a polynomial and leaves the other poles.

    Parameters
    ----------
    A, B : ndarray, shape (2m, 2m), (2m, n)
    pair : ndarray of complex, shape (2,)
        Poles of A, conjugate or both real.
    polynomial : ndarray, shape (3,)
        Monic, highest power first.

    Returns
    -------
    ndarray, shape (n, 2m)
        K of u = K z.
    """
    poles, vectors = np.linalg.eig(A)
    left = np.linalg.inv(vectors)
    if pair[0].imag:
        w = left[np.argmin(np.abs(poles - pair[0]))]
        rows = np.stack([w.real, w.imag]) / np.linalg.norm(w @ B)  # modal coordinates are rows @ z
        direction = np.linalg.svd(rows @ B)[2][0]
    else:
        real = np.flatnonzero(poles.imag == 0.0)
        rows = left[[real[np.argmin(np.abs(poles[real] - p))] for p in pair]].real
        rows /= np.linalg.norm(rows @ B, axis=1)[:, None]
        first, second = rows @ B
        # A direction between the two reaches both. If they are orthogonal, a singular vector may miss one of them.
        direction = first + (second if first @ second >= 0.0 else -second)
        direction /= np.linalg.norm(direction)
    block = rows @ A @ np.linalg.pinv(rows)
    b = rows @ B @ direction
    # Ackermann's formula for two states and one input.
    target = polynomial[0] * block @ block + polynomial[1] * block + polynomial[2] * np.eye(2)
    k = np.linalg.solve(np.stack([b, block @ b]), [0.0, 1.0]) @ target
    return -np.outer(direction, k @ rows)


def reaches(A, B, poles):
    """How well the torques reach each pole: smallest normalised singular value of [A - s I, B], Hautus' test."""
    # A is balanced and scaled for each pole. Otherwise stiff modes hide the input's effect on soft ones.
    balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
    B = B / units[:, None]
    B = B / (np.linalg.norm(B) or 1.0)
    eye = np.eye(A.shape[0])
    return np.array(
        [
            np.linalg.svd(np.hstack([(balanced - s * eye) / abs(s), B]), compute_uv=False)[-1]
            for s in poles
        ]
    )
