# SPDX-License-Identifier: Apache-2.0
r"""Shows the feed-forward's motion as an observer would see it.

An observer whose rates are filtered derivatives is late by 1 / omega_c. A control that compares them with the motion's
own rates takes the lag for an error, and pushes against a motion that the model explains. So the motion's joints and
deflections pass the same filter, sample by sample (module `observers.filtered_derivative`). If the arm follows the
motion, both are equal, and no error is left.

As in the observer, the filter acts on the positions at the samples, not on the speeds. A torque that is held over a
sample makes light hubs and fast modes swing within the sample. So the mean of the speeds at both ends of the sample is
not the mean speed. With the mean of both ends, the control pushed an arm off its motion by 5 degrees.

The torque acts some time after the sample that it answers, and the whole arm follows the feed-forward's motion this
late. A control that compares the arm with the present motion takes speed times delay for an error. So the control sees
the motion as it was then. The feed-forward is ahead of the reference by as much, and the arm is on time (`law`).

A feed-forward may know more modes than the observer (`feedforward_modes`). The gauges, with their rows R (module
`flexarm_dynamics.arm.strain_map`), would then show its amplitudes :math:`\delta'` as

.. math:: \delta = R_o^+\,R'\delta' .
"""

import numpy as np

from flexarm_dynamics.arm.strain_map import StrainMap, reading_rows

from .. import kernels

#: Number of samples of the motion that are remembered: more than the longest delay that is measured.
REMEMBERED = 40


def shown(model, fuller):
    """Matrix, (m, k), of what the gauges of a `model`'s arm show of the modes of a `fuller` model of that arm.

    Without gauges, or if they do not give all modes of the model, it selects the modes of the same names.
    """
    arm = model.arm
    if len(arm.gauges) < model.n_modes or arm.observed_modes != model.mode_names:
        names = np.array(fuller.mode_names, object)
        return (np.array(model.mode_names, object)[:, None] == names).astype(float)
    return StrainMap(model).inverse @ reading_rows(fuller, arm.gauges)


class SeenMotion:
    """A `Feedforward` as the observer would show it; see the module.

    Parameters
    ----------
    motion : Feedforward
    joint_corner, rate_corner : float
        Corners of the observer's filters of joint speeds and of rates of deflections [rad/s]; 0.0: not filtered.
    longest : float
        The motion is seen at most this late [s].
    shown : ndarray, shape (m, k), optional
        What the gauges show of the motion's own k modes; if not given, all modes as they are.

    Attributes
    ----------
    velocity : ndarray, shape (n,)
        [rad/s]
    amplitude, rate : ndarray, shape (m,)
        [m, rad], [m/s, rad/s]
    position : ndarray, shape (n,)
        [rad]
    late : float
        How late the motion is seen [s].
    """

    def __init__(self, motion, joint_corner=0.0, rate_corner=0.0, longest=0.0, shown=None):
        self._motion, self._corners, self._longest = motion, (joint_corner, rate_corner), longest
        n, k = motion.position.size, motion.rate.size
        self._shown = np.eye(k) if shown is None else shown
        self.velocity, self.amplitude = motion.velocity.copy(), self._shown @ motion.amplitude
        self.rate = np.zeros_like(self.amplitude)
        self._own_rate = self.rate.copy()
        self._last = motion.position.copy(), self.amplitude.copy()
        self.late = 0.0
        # States of the motion, and the time from the one before; whether the next one follows on the newest.
        self._states, self._intervals = np.zeros((REMEMBERED, 2 * (n + k))), np.zeros(REMEMBERED)
        self._newest, self._goes_on = 0, False
        self._state = np.zeros(2 * (n + k))  # that is seen
        self._fresh = True  # no sample so far
        self._name_parts()

    def _name_parts(self):
        n, k = self._motion.position.size, self._motion.rate.size
        self._parts = np.split(self._state, [n, n + k, 2 * n + k])

    def __getstate__(self):
        """Without the views of the seen state: for another process."""
        return {name: value for name, value in self.__dict__.items() if name != "_parts"}

    def __setstate__(self, state):
        self.__dict__.update(state)
        self._name_parts()

    @property
    def _remembers(self):
        return self._longest > 0.0 or self.late > 0.0

    @property
    def position(self):
        """Joints of the motion as they are seen, (n,) [rad]."""
        return self._parts[0] if self._remembers else self._motion.position

    def be_late(self, delay):
        """See the motion so late from now on [s], but at most `longest`; NaN: as late as before.

        Call it while the motion rests: otherwise what is seen jumps.
        """
        self.late = min(delay if delay >= 0.0 else self.late, self._longest)

    def take(self, other):
        """Go on from the state of another `SeenMotion` of the same motion, as late as that one."""
        mine = (*self._last, self.velocity, self.rate)
        for values, its in zip(mine, (*other._last, other.velocity, other.rate), strict=True):
            values[:] = its
        self.late, self._fresh = other.late, other._fresh
        if other._goes_on and self._states.shape == other._states.shape:
            self._newest, self._goes_on = other._newest, True
            self._states[:], self._intervals[:] = other._states, other._intervals
            self._state[:] = other._state

    def update(self, dt):
        """Move on to the motion's present sample, `dt` [s] after the last one; 0: the first sample."""
        motion, own_rate = self._motion, self._own_rate
        if self._remembers:
            position, amplitude, velocity, rate = self._before(dt)
        else:
            position, amplitude = motion.position, motion.amplitude
            velocity, rate = motion.velocity, motion.rate
            self._goes_on = False
        np.dot(self._shown, amplitude, out=self.amplitude)
        np.dot(self._shown, rate, out=own_rate)
        places, rates = (position, self.amplitude), (self.velocity, self.rate)
        parts = zip(places, (velocity, own_rate), rates, self._last, self._corners, strict=True)
        for place, own, rate, last, corner in parts:
            if corner == 0.0 or dt <= 0.0:
                rate[:], last[:] = own, place
                continue
            if motion.placed or self._fresh:  # a jump of the position is no speed
                last[:] = place - dt * own
            kernels.compiled().filtered_derivative(place, dt, corner, last, rate)
        self._fresh = False

    def _before(self, dt):
        """Note the motion's present state; return its parts (q, delta, qd, delta_d) of `late` ago."""
        motion = self._motion
        row = self._newest = (self._newest + 1) % REMEMBERED
        np.concatenate(
            [motion.position, motion.amplitude, motion.velocity, motion.rate],
            out=self._states[row],
        )
        follows = self._goes_on and dt > 0.0 and not motion.placed
        self._intervals[row], self._goes_on = dt if follows else np.inf, True
        kernels.compiled().state_before(self.late, row, self._intervals, self._states, self._state)
        return self._parts
