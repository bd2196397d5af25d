# SPDX-License-Identifier: Apache-2.0
r"""The feed-forward's motion as an observer would see it.

An observer that has rates as filtered derivatives is late by 1 / omega_c, and a control that compares them with the
motion's own rates takes the lag for an error: on a motion that the model explains it would push against it. So the
motion's joints and deflections pass the same filter, sample by sample (module `observers.filtered_derivative`). Where
the arm follows the motion both are equal, and no error is left.

The positions of the samples are what is filtered, as in the observer, and not the speeds between them: a torque that is
held over a sample makes light hubs and fast modes swing within it, and the mean of the speeds at its ends is another.
With it an arm on its motion was pushed off by 5 degrees.

A feed-forward may know more modes than the observer does (`feedforward_modes`). What the gauges would show of its
amplitudes :math:`\delta'` is then, with their rows R (module `flexarm_dynamics.arm.strain_map`),

.. math:: \delta = R_o^+\,R'\delta' .
"""

import numpy as np

from flexarm_dynamics.arm.strain_map import StrainMap, gauge_rows

from .. import kernels


def shown(model, fuller):
    """What the gauges of a `model`'s arm show of the modes of a `fuller` model of it, (m, k).

    Without gauges, or where they do not give all modes of the model: its own modes of the same names.
    """
    arm = model.arm
    if len(arm.gauges) < model.n_modes or arm.observed_modes != model.mode_names:
        names = np.array(fuller.mode_names, object)
        return (np.array(model.mode_names, object)[:, None] == names).astype(float)
    gains = np.array([gauge.gain for gauge in arm.gauges])
    return StrainMap(model).inverse @ (gains[:, None] * gauge_rows(fuller, arm.gauges))


class SeenMotion:
    """A `Feedforward` as the observer shows it; see the module.

    Parameters
    ----------
    motion : Feedforward
    joint_corner, rate_corner : float
        Of the observer's filters of joint speeds and of rates of deflections [rad/s]; 0.0: not filtered.
    shown : ndarray, shape (m, k), optional
        What the gauges show of the motion's own k modes; all of them as they are if not given.

    Attributes
    ----------
    velocity : ndarray, shape (n,)
        [rad/s]
    amplitude, rate : ndarray, shape (m,)
        [m, rad], [m/s, rad/s]
    """

    def __init__(self, motion, joint_corner, rate_corner, shown=None):
        self._motion, self._corners = motion, (joint_corner, rate_corner)
        self._shown = np.eye(motion.rate.size) if shown is None else shown
        self.velocity, self.amplitude = motion.velocity.copy(), self._shown @ motion.amplitude
        self.rate = np.zeros_like(self.amplitude)
        self._own_rate = self.rate.copy()
        self._last = motion.position.copy(), self.amplitude.copy()

    @property
    def position(self):
        """Joints of the motion, (n,) [rad]."""
        return self._motion.position

    def take(self, other):
        """Go on as another one, of the same motion, would."""
        mine = (*self._last, self.velocity, self.rate)
        for values, its in zip(mine, (*other._last, other.velocity, other.rate), strict=True):
            values[:] = its

    def update(self, dt):
        """Move on to the motion's present sample, `dt` [s] after the last one; 0: the first one."""
        motion, own_rate = self._motion, self._own_rate
        np.dot(self._shown, motion.amplitude, out=self.amplitude)
        np.dot(self._shown, motion.rate, out=own_rate)
        places, rates = (motion.position, self.amplitude), (self.velocity, self.rate)
        parts = zip(
            places, (motion.velocity, own_rate), rates, self._last, self._corners, strict=True
        )
        for place, own, rate, last, corner in parts:
            if corner == 0.0 or dt <= 0.0:
                rate[:], last[:] = own, place
                continue
            if motion.placed:  # that makes no speed
                last[:] = place - dt * own
            kernels.compiled().filtered_derivative(place, dt, corner, last, rate)
