"""What a fast control law is."""

from abc import ABC, abstractmethod


class FastLaw(ABC):
    """Fast control u_fast of (12) and (15), designed on the boundary layer (11).

    A law is registered by name in the entry-point group ``flexarm.fast_laws``. Riccati equations are solved
    in the constructor; `torque` runs on the control path. u_fast is zero where z_f is: the constraint of (12).

    Parameters
    ----------
    model : ArmModel
        The arm.
    parameters : dict
        Checked values of `PARAMETERS`, arrays at full length.
    """

    #: Declared parameters, named ``fast.<name>`` in the controller node.
    PARAMETERS = ()

    def __init__(self, model, parameters):
        self.model = model
        self.parameters = dict(parameters)

    def warnings(self):
        """What a person should know of this law on this arm; each a sentence."""
        return ()

    @abstractmethod
    def torque(self, z_f):
        """Fast torque, shape (n,) [N m], for z_f = z - z_bar, shape (2m,) [m, m/s]."""

    @property
    @abstractmethod
    def K_f(self):
        """Feedback gain, u_fast = K_f z_f, shape (n, 2m): for analysis and reports."""
