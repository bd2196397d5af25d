# SPDX-License-Identifier: Apache-2.0
"""Base class of slow laws."""

from abc import ABC, abstractmethod
from contextlib import nullcontext

import numpy as np

from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_torque

from ..component import Law

KP = parameter("kp", [6.25], "1/s^2", 0.0, 1e6, length="joints").described(
    "Position gain of the reference model: -Lambda_0 of (14), k_p of (17)."
)
KV = parameter("kv", [5.0], "1/s", 0.0, 1e4, length="joints").described(
    "Velocity gain of the reference model: -Lambda_1 of (14), k_v of (17)."
)


class SlowLaw(Law, ABC):
    """Slow control u_slow of (12), designed on the slow subsystem (10).

    A slow law is registered by name in the entry-point group ``flexarm.slow_laws``. Its parameters are
    ``slow.<name>`` in the controller node. `torque` runs on the control path.

    Parameters
    ----------
    model : ArmModel
        The arm. The law's attribute `model` is the arm as the law estimates it: `torque` and the slow manifold receive
        the terms of that model.
    parameters : dict
        Checked values of `PARAMETERS`, arrays at full length.
    """

    #: True for a law that leaves the joints free.
    drifts = False
    #: True for a law whose `model` changes as it learns. The slow manifold follows this change, but a feed-forward,
    #: which simulates the arm of the arm file, would not. So such a law has no feed-forward.
    learns = False

    #: True for a law whose torque is its `nominal` torque plus a `feedback` of the error that needs no terms.
    separate = False

    def error_gains(self):
        """Gains (kp, kv) of the tracking error's dynamics, e'' = -kv e' - kp e, each (n,); None for another law.

        The slow manifold uses them for states off the reference.
        """
        return None

    def nominal(self, terms, acceleration):
        """Torque of this law on its reference, without learnt states: the rigid arm's torque, shape (n,) [N m].

        `terms` are those of (2) on the reference; `acceleration` is the reference's, (n,) [rad/s^2].
        """
        return slow_torque(terms, acceleration)

    def nominal_at(self, q, qd, acceleration):
        """As `nominal`, for joint positions and velocities, (n,) [rad], [rad/s], instead of terms."""
        return self.nominal(self.model.terms(q, qd), acceleration)

    def torque_at(self, q, qd, reference):
        """As `torque`, without given terms, which takes less time for a law that needs few of them."""
        return self.torque(q, qd, reference, self.model.terms(q, qd))

    def feedback(self, q, qd, motion):
        """Torque of a `separate` law beyond its `nominal` torque on a `motion`, shape (n,) [N m]."""
        raise NotImplementedError

    def without_friction(self):
        """Context in which the law cancels no friction beyond its `nominal` torque, as for a joint that slides fast."""
        return nullcontext()

    def saw(self, torque):
        """Take note of the whole torque (n,) [N m] that this sample asks for, before any limit."""

    def absorb(self, torque):
        """Take a torque (n,) [N m] into the law's own integral, if it has one; return what was taken, (n,)."""
        return np.zeros_like(torque)

    @abstractmethod
    def torque(self, q, qd, reference, terms):
        """Slow torque.

        Parameters
        ----------
        q, qd : ndarray, shape (n,)
            Joint position [rad] and velocity [rad/s].
        reference : object
            With `position`, `velocity`, `acceleration`, each (n,) [rad, rad/s, rad/s^2].
        terms : Terms
            Terms of (2) at (q, qd), without deflections.

        Returns
        -------
        ndarray, shape (n,)
            [N m]
        """
