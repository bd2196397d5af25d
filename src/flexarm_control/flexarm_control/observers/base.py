# SPDX-License-Identifier: Apache-2.0
"""What an observer is."""

from abc import ABC, abstractmethod

import numpy as np

from ..component import Component


class Observer(Component, ABC):
    """Reconstructs modal rates (and may smooth amplitudes) from samples of modal amplitudes.

    Registered by name in the entry-point group ``flexarm.observers``. Design work is done in the
    constructor; `update` runs on the control path.

    Parameters
    ----------
    model : ArmModel
        The arm as the observer believes it to be.
    parameters : dict
        Checked values of `PARAMETERS`, arrays at full length.

    Attributes
    ----------
    amplitude, rate : ndarray, shape (m,)
        The estimate.
    innovation : ndarray, shape (m,) or (0,)
        Measured minus predicted amplitude, where the observer predicts one.
    covariance_diagonal : ndarray, shape (2m,) or (0,)
        Where the observer has one.
    converged : bool
        Whether the estimate may be used for control.
    joint_position, joint_velocity : ndarray, shape (n,), or None
        The estimate of the joints [rad], [rad/s], where the observer makes one.
    innovation_squared : float
        Normalised innovation squared of the last sample [-], whose mean is the number of measurements if the
        noise is as assumed; NaN where the observer has none.
    consistent : bool
        False while the innovations are larger than the assumed noise explains.
    gauges_lost : tuple of int
        Gauges that the amplitudes are made without, as `leave_out` was told; indices, ascending.
    parameters_estimated : dict of str to float
        What the observer estimates of the arm itself; the name has the unit.
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
        """Go on from another observer's estimate: a redesign does not begin anew."""
        self.amplitude[:], self.rate[:] = other.amplitude, other.rate
        self.converged, self._elapsed = other.converged, other._elapsed

    def leave_out(self, lost):
        """From the next sample on the amplitudes are made without these gauges: they are noisier."""
        self.gauges_lost = lost

    def rest_at(self, amplitude):
        """The arm is at rest, bent by these amplitudes (m,): the gauges' bias has just been found."""
        self.amplitude[:] = amplitude

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
