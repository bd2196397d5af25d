# SPDX-License-Identifier: Apache-2.0
"""Base class of slow manifolds."""

from abc import ABC, abstractmethod
from copy import copy

import numpy as np

from flexarm_dynamics.linear import jacobian

from ..component import Component, at_rest
from .expansion import expand, reach, step

#: Step of the finite differences that give the response to a tracking error [rad], [rad/s].
SMALL = 1e-5


def around(reference, step, out):
    """Fill `out`, (p, 3, n), with a reference's states at p offsets, `step` [s] apart; the middle one is 0."""
    if hasattr(reference, "around"):
        reference.around(step, out)
        return
    centre = len(out) // 2
    for i, state in enumerate(out):
        state[:] = reference.near((i - centre) * step)


class Manifold(Component, ABC):
    """Deflections z_bar that belong to the slow motion, and the torque that they need beyond the slow law's.

    A manifold is registered by name in the entry-point group ``flexarm.manifolds``. The fast control acts on
    z_f = z - z_bar, so that it does nothing on the manifold: the constraint of (12).

    Parameters
    ----------
    model : ArmModel
        The arm; its terms come from the slow law's model, which may have learnt.
    slow : SlowLaw
        Law whose motion the deflections belong to.
    parameters : dict
        Checked values of `PARAMETERS`.

    Attributes
    ----------
    amplitude, rate : ndarray, shape (m,)
        z_bar of the last call of `update` [m, rad], [m/s, rad/s].
    feedforward : ndarray, shape (n,)
        Torque beyond the slow law's [N m].
    """

    #: Order in mu up to which the deflections follow the motion.
    order = 0

    def __init__(self, model, slow, parameters):
        super().__init__(slow.model, parameters)
        self.slow = slow
        m, n = model.n_modes, model.n_joints
        self.amplitude, self.rate = np.zeros(m), np.zeros(m)
        self.feedforward = np.zeros(n)

    def of(self, model):
        """The same manifold for another `model` of the arm, with more modes; use it for `along` only."""
        if model is self.model:
            return self
        other = copy(self)
        other.model = model
        return other

    @abstractmethod
    def update(self, q, qd, reference, terms, slow_torque):
        """Fill `amplitude`, `rate` and `feedforward`; runs on the control path.

        Parameters
        ----------
        q, qd : ndarray, shape (n,)
            Joint position [rad] and velocity [rad/s].
        reference : object
            With `position`, `velocity`, `acceleration`, each (n,), and ``near(offset)``, which gives the three, (3, n),
            at an offset [s] from now.
        terms : Terms
            Terms of (2) at (q, qd), without deflections.
        slow_torque : ndarray, shape (n,)
            Torque of the slow law [N m].
        """

    def along(self, reference):
        """The manifold of the `reference` itself, without tracking error: amplitude, rate and torque.

        They are (m,) [m, rad], (m,) [m/s, rad/s] and (n,) [N m]. The torque is that of the whole motion, from the joint
        rows of (2).
        """
        found = self._of_reference(reference)
        return found.delta, found.rate, found.torque

    def _of_reference(self, reference):
        """The `Expansion` of the reference at the present time."""
        motions = np.empty((2 * reach(self.order) + 1, 3, self.model.n_joints))
        around(reference, step(self.order), motions)
        return expand(self.model.terms_along(motions), motions[:, 2], self.order)

    def error_response(self, q):
        """How a tracking error moves the manifold and its feed-forward, linearised at rest in q.

        Returns L, (2m, 2n), and U, (n, 2n), the derivatives of z_bar and of the feed-forward with respect to (q, qd).
        """
        n, m = self.model.n_joints, self.model.n_modes
        reference = at_rest(q)

        def response(x):
            terms = self.model.terms(x[:n], x[n:])
            torque = self.slow.torque(x[:n], x[n:], reference, terms)
            self.update(x[:n], x[n:], reference, terms, torque)
            return np.concatenate([self.amplitude, self.rate, self.feedforward])

        both = jacobian(response, np.concatenate([q, np.zeros(n)]), SMALL)
        return both[: 2 * m], both[2 * m :]
