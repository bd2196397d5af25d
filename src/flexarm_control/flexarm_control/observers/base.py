# SPDX-License-Identifier: Apache-2.0
"""Base class of observers."""

from abc import ABC, abstractmethod

import numpy as np

from flexarm_dynamics.errors import MessageError

from ..arrays import finite
from ..component import Component


class Observer(Component, ABC):
    """Reconstructs modal rates (and may smooth amplitudes) from samples of modal amplitudes.

    An observer is registered by name in the entry-point group ``flexarm.observers``. The constructor does all design
    work; `update` runs on the control path.

    Parameters
    ----------
    model : ArmModel
        The observer's model of the arm.
    parameters : dict
        Checked values of `PARAMETERS`, arrays at full length.

    Attributes
    ----------
    amplitude, rate : ndarray, shape (m,)
        The estimate.
    innovation : ndarray, shape (m,) or (0,)
        Measured minus predicted amplitude, if the observer predicts one.
    covariance_diagonal : ndarray, shape (2m,) or (0,)
        Variances of amplitudes and rates, if the observer has them.
    converged : bool
        Whether the estimate may be used for control.
    joint_position, joint_velocity : ndarray, shape (n,), or None
        The estimate of the joints [rad], [rad/s], if the observer makes one.
    innovation_squared : float
        Normalised innovation squared of the last sample [-]. Its mean is the number of measurements if the noise is as
        assumed. NaN if the observer has none.
    consistent : bool
        False while the innovations are larger than the assumed noise explains.
    gauges_lost : tuple of int
        Gauges that are left out of the amplitudes, see `leave_out`; indices, ascending.
    parameters_estimated : dict of str to float
        Estimated parameters of the arm itself; each name contains the unit.
    """

    joint_position = joint_velocity = None
    innovation_squared = float("nan")
    consistent = True

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        m = model.n_modes
        self.amplitude, self.rate = np.zeros(m), np.zeros(m)
        self.innovation = np.zeros(0)
        self.covariance_diagonal = np.zeros(0)
        self.parameters_estimated = {}
        self.gauges_lost = ()
        self.converged = False
        self._elapsed = -1.0  # [s] since the first sample; negative before it

    def reset(self):
        """Forget the past; the next sample is the first."""
        self.converged, self._elapsed = False, -1.0

    def resume(self, other):
        """Continue from another observer's estimate, so that a redesign does not start over."""
        self.amplitude[:], self.rate[:] = other.amplitude, other.rate
        self.converged, self._elapsed = other.converged, other._elapsed

    def leave_out(self, lost):
        """Expect noisier amplitudes from the next sample on, computed without the gauges in `lost`."""
        self.gauges_lost = lost

    def rest_at(self, amplitude):
        """Continue at rest with these amplitudes (m,): the gauges' bias has just been calibrated."""
        self.amplitude[:] = amplitude

    def look_ahead(self):
        """Do work for the next sample in advance, between two samples; changes no result."""

    @abstractmethod
    def update(self, sample, dt):
        """Take one sample.

        Parameters
        ----------
        sample : ArmSample
            Finite amplitudes, joint positions and velocities; torque may be NaN, rate may be None.
        dt : float
            True time since the last sample [s]; 0.0 for the first one.
        """


def need_torque(torque, what, hint):
    """Refuse a sample whose `torque` (n,) is unknown, because `what` predicts with it."""
    if not finite(torque):
        raise MessageError(
            f"is unknown (NaN), and {what} predicts with it",
            field="joint_torque",
            hint=f"have the driver report the applied torque, or {hint}",
        )
