"""What a slow manifold is."""

from abc import ABC, abstractmethod

import numpy as np


class Manifold(ABC):
    """Deflections z_bar that go with the slow motion, and the torque that goes with them beyond the slow law's.

    A manifold is registered by name in the entry-point group ``flexarm.manifolds``. The fast control acts on
    z_f = z - z_bar, so that it does nothing on the manifold: the constraint of (12).

    Parameters
    ----------
    model : ArmModel
        The arm.
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

    #: Declared parameters, named ``manifold.<name>`` in the controller node.
    PARAMETERS = ()

    def __init__(self, model, slow, parameters):
        self.model, self.slow = model, slow
        self.parameters = dict(parameters)
        m, n = model.n_modes, model.n_joints
        self.amplitude, self.rate = np.zeros(m), np.zeros(m)
        self.feedforward = np.zeros(n)

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
