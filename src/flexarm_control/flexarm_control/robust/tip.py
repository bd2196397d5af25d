# SPDX-License-Identifier: Apache-2.0
r"""Effect of a design's gains at the tip: how stiff it is against a static force, and how soon it settles.

At rest a small force f at the tip moves the arm by x, where :math:`J = [J_q\;J_\delta]` is the tip's Jacobian and

.. math:: K x = J^T f + \begin{bmatrix}I\\0\end{bmatrix} u, \qquad u = -K_c x .

K is the stiffness due to links and weight, and :math:`K_c` are the gains of joint angles and deflections. The integral
adds torque until :math:`q` is back in its place. Then only the links bend. The tip's displacement is :math:`C f` with
the compliance :math:`C = J\,\partial x/\partial f`. Its stiffness is the one in the softest direction.
"""

import numpy as np

from flexarm_dynamics.linear import jacobian, linear_plant, sampled, state_at_rest

#: A tip has settled within this fraction of its largest displacement [-].
SETTLED = 0.02
#: A loop is simulated for this many time constants of its slowest pole, in at most about this many steps.
HORIZON, MAX_STEPS = 10.0, 20_000


class Tip:
    """The tip of an arm, linearised at rest.

    Parameters
    ----------
    model : ArmModel
    q : ndarray, shape (n,)
        [rad]

    Attributes
    ----------
    J : ndarray, shape (3, n + m)
        Its Jacobian by joint angles and deflections.
    force : ndarray, shape (2 (n + m), 3)
        Derivative of the state (q, delta, qd, delta_d) by a unit force at the tip.
    """

    def __init__(self, model, q):
        n = self._n = model.n_joints
        rest = state_at_rest(model, q)
        half = rest.size // 2
        self.J = jacobian(lambda x: model.tip_position(x[:n], x[n:]), rest[:half])
        self._A, self._B = linear_plant(model, q, coulomb=False)
        terms = model.terms(q, np.zeros(n), rest[n:half], np.zeros(half - n))
        self.force = np.vstack([np.zeros((half, 3)), np.linalg.solve(terms.M, self.J.T)])

    def compliance(self, K=None):
        """C of the tip, (3, 3) [m/N], with the gains K (n, n + m) [N m/rad, N]; without K the joints are locked."""
        n, half = self._n, self.J.shape[1]
        A, B, pushed = self._A[half:, :half], self._B[half:], self.force[half:]
        if K is not None:
            return -self.J @ np.linalg.solve(A - B @ K, pushed)
        # The unknowns are the torques that hold the joints, and the deflections.
        found = -np.linalg.solve(np.hstack([B, A[:, n:]]), pushed)
        return self.J[:, n:] @ found[n:]

    def settling(self, loop, K, direction):
        """Settling time of the tip after a constant force is removed, until `SETTLED` of the displacement is left [s].

        Parameters
        ----------
        loop : Loop
            Of the same arm in the same configuration; it must be stable with the gains K.
        K : ndarray, shape (n, 3n + 2m)
        direction : ndarray, shape (3,)
            Of the force.
        """
        size, half = len(self._A), self.J.shape[1]
        closed = loop.F - loop.G @ (K @ loop.N)
        pushed = np.zeros(len(closed))
        pushed[:size] = sampled(self._A, self.force @ direction[:, None], loop.period)[1][:, 0]
        X = np.linalg.solve(np.eye(len(closed)) - closed, pushed)
        slowest = -np.log(np.abs(np.linalg.eigvals(closed)).max())
        every = 1 + int(HORIZON / slowest / MAX_STEPS)
        step, moved = np.linalg.matrix_power(closed, every), []
        for _ in range(int(HORIZON / slowest / every) + 1):
            moved.append(np.linalg.norm(self.J @ X[:half]))
            X = step @ X
        late = np.flatnonzero(np.array(moved) > SETTLED * max(moved))
        return float((late[-1] + 1) * every * loop.period)


def softest(C):
    """Stiffness in the softest direction of a compliance [N/m], infinite if nothing gives way; and that direction."""
    _, largest, directions = np.linalg.svd(C)
    return (float(1.0 / largest[0]) if largest[0] > 1e-15 else np.inf), directions[0]
