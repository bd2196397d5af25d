# SPDX-License-Identifier: Apache-2.0
"""Base class of slow manifolds."""

from abc import ABC, abstractmethod
from copy import copy

import numpy as np

from flexarm_dynamics.linear import jacobian

from ..component import Component, at_rest
from .expansion import expand, reach, step

#: Step of the differences by which the response to a tracking error is found [rad], [rad/s].
SMALL = 1e-5


def around(reference, step, out):
    """Fill `out`, (p, 3, n), with a reference's states at p offsets, `step` [s] apart; that of the middle one is 0."""
    if hasattr(reference, "around"):
        reference.around(step, out)
        return
    centre = len(out) // 2
    for i, state in enumerate(out):
        state[:] = reference.near((i - centre) * step)


class Manifold(Component, ABC):
    """Deflections z_bar that go with the slow motion, and the torque that goes with them beyond the slow law's.

    A manifold is registered by name in the entry-point group ``flexarm.manifolds``. The fast control acts on
    z_f = z - z_bar, so that it does nothing on the manifold: the constraint of (12).

    Parameters
    ----------
    model : ArmModel
        The arm; its terms are taken from the slow law's, which may have learnt.
    slow : SlowLaw
        Whose motion the deflections go with.
    parameters : dict
        Checked values of `PARAMETERS`.

    Attributes
    ----------
    amplitude, rate : ndarray, shape (m,)
        z_bar of the last call of `update` [m, rad], [m/s, rad/s].
    feedforward : ndarray, shape (n,)
        Torque beyond the slow law's [N m].
    """

    #: Order in mu to which the deflections follow the motion.
    order = 0

    def __init__(self, model, slow, parameters):
        super().__init__(slow.model, parameters)
        self.slow = slow
        m, n = model.n_modes, model.n_joints
        self.amplitude, self.rate = np.zeros(m), np.zeros(m)
        self.feedforward = np.zeros(n)

    def of(self, model):
        """The same manifold of another model of the arm, with more modes; for `along` alone."""
        if model is self.model:
            return self
        other = copy(self)
        other.model = model
        return other

    @abstractmethod
    def update(self, q, qd, reference, terms, slow_torque):
        """Fill `amplitude`, `rate` and `feedforward`; the control path.

        Parameters
        ----------
        q, qd : ndarray, shape (n,)
            Joint position [rad] and velocity [rad/s].
        reference : object
            With `position`, `velocity`, `acceleration`, each (n,), and ``near(offset)``: the three, (3, n), at an
            offset [s] from now.
        terms : Terms
            Of (2) at (q, qd), without deflections.
        slow_torque : ndarray, shape (n,)
            The slow law's [N m].
        """

    def along(self, reference):
        """The manifold of the `reference` itself, without tracking error: amplitude, rate and torque.

        (m,) [m, rad], (m,) [m/s, rad/s], and of the whole motion, from the joint rows of (2), (n,) [N m].
        """
        found = self._of_reference(reference)
        return found.delta, found.rate, found.torque

    def _of_reference(self, reference):
        """The `Expansion` of the reference at present."""
        motions = np.empty((2 * reach(self.order) + 1, 3, self.model.n_joints))
        around(reference, step(self.order), motions)
        return expand(self.model.terms_along(motions), motions[:, 2], self.order)

    def error_response(self, q):
        """How a tracking error moves the manifold and its feed-forward, linearised at rest in q.

        L, the derivative of z_bar by (q, qd), (2m, 2n), and U, that of the feed-forward, (n, 2n).
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
