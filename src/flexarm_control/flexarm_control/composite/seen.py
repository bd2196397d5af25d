# SPDX-License-Identifier: Apache-2.0
r"""The feed-forward's motion as an observer would see it.

An observer that has rates as filtered derivatives is late by 1 / omega_c, and a control that compares them with the
motion's own rates takes the lag for an error: on a motion that the model explains it would push against it. So the
motion's joints and deflections pass the same filter, sample by sample (module `observers.filtered_derivative`). Where
the arm follows the motion both are equal, and no error is left.

The positions of the samples are what is filtered, as in the observer, and not the speeds between them: a torque that is
held over a sample makes light hubs and fast modes swing within it, and the mean of the speeds at its ends is another.
With it an arm on its motion was pushed off by 5 degrees.
"""

from .. import kernels


class SeenMotion:
    """A `Feedforward` with filtered `velocity` and `rate`; see the module.

    Parameters
    ----------
    motion : Feedforward
    joint_corner, rate_corner : float
        Of the observer's filters of joint speeds and of rates of deflections [rad/s]; 0.0: not filtered.

    Attributes
    ----------
    velocity : ndarray, shape (n,)
        [rad/s]
    rate : ndarray, shape (m,)
        [m/s, rad/s]
    """

    def __init__(self, motion, joint_corner, rate_corner):
        self._motion, self._corners = motion, (joint_corner, rate_corner)
        self.velocity, self.rate = motion.velocity.copy(), motion.rate.copy()
        self._last = motion.position.copy(), motion.amplitude.copy()

    @property
    def position(self):
        """Joints of the motion, (n,) [rad]."""
        return self._motion.position

    @property
    def amplitude(self):
        """Its deflections, (m,) [m, rad]."""
        return self._motion.amplitude

    def take(self, other):
        """Go on as another one, of the same motion, would."""
        pairs = zip(
            (*self._last, self.velocity, self.rate),
            (*other._last, other.velocity, other.rate),
            strict=True,
        )
        for mine, its in pairs:
            mine[:] = its

    def update(self, dt):
        """Move on to the motion's present sample, `dt` [s] after the last one; 0: the first one."""
        motion = self._motion
        parts = (motion.position, motion.velocity), (motion.amplitude, motion.rate)
        for (place, own), corner, last, rate in zip(
            parts, self._corners, self._last, (self.velocity, self.rate), strict=True
        ):
            if corner == 0.0 or dt <= 0.0:
                rate[:], last[:] = own, place
                continue
            if motion.placed:  # that makes no speed
                last[:] = place - dt * own
            kernels.compiled().filtered_derivative(place, dt, corner, last, rate)
