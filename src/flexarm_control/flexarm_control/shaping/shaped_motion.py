# SPDX-License-Identifier: Apache-2.0
r"""Convolves a motion with a shaper exactly, also if the frequencies change along the motion.

With constant frequencies the shaped motion is :math:`\sum_i A_i r(t - t_i)`. On every interval between the delayed
knots it is a polynomial of the same degree. So points at these knots give exactly this motion in any controller that
joins points as a joint_trajectory_controller does.

If a frequency f changes slowly, the mode has a constant frequency in its own phase
:math:`\theta(t) = \int f\,dt` (the first order of the method of Wentzel, Kramers and Brillouin). The impulses are then
at constant phases :math:`\varphi_i`, and

.. math:: y(t) = \sum_i A_i r(\tau_i), \qquad \theta(\tau_i) = \theta(t) - \varphi_i, \qquad
    \dot\tau_i = \frac{f(t)}{f(\tau_i)}, \qquad
    \ddot\tau_i = \frac{\dot f(t) - \dot\tau_i^2 \dot f(\tau_i)}{f(\tau_i)}.

A motion r that leaves no vibration by itself (see `time_law`) may be changed to w on the way, for example by a stop. It
then becomes :math:`r + S(w - r)`: only the change is shaped, and nothing jumps. Where it is not changed, it stays as it
is.

Several modes are shaped one after the other. All A_i are at least 0 and add up to 1. So every position lies between
positions of the motion, start and end do not change, and with constant frequencies speed and acceleration are never
larger than the motion's. The frequency at a time is that at the shaped position of that time. So the part that is
shaped already never depends on later commands. The less a frequency changes within a period, the less vibration is
left.
"""

import numpy as np
from scipy.interpolate import CubicSpline

#: Number of places per period of the lowest mode. Changing frequencies are evaluated at these places. A motion that
#: points at its knots alone do not reproduce gets points at them, too.
PER_PERIOD = 32
#: Knots closer to each other than this count as one [s].
SAME = 2e-6
#: Number of Newton steps for the time that belongs to a phase.
STEPS = 3
#: Number of iterations for the frequencies along the shaped motion; they begin with the delayed motion.
ITERATIONS = 3


class Warp:
    """The phase of a mode whose frequency changes, and delays by a constant phase.

    Parameters
    ----------
    times : (k,) ndarray
        [s]
    frequency : (k,) ndarray
        Above 0; constant before and after [Hz].
    """

    def __init__(self, times, frequency):
        spline = CubicSpline(times, frequency, bc_type="clamped")
        self._f, self._rate, self._phase = spline, spline.derivative(), spline.antiderivative()
        self._times, self._phases = times, self._phase(times)
        self._ends = frequency[0], frequency[-1]

    def at(self, t):
        """Phase [-], frequency [Hz] and its rate [Hz/s] at times (k,)."""
        low, high = self._times[0], self._times[-1]
        inside = np.clip(t, low, high)
        outside = (inside != t) * 1.0
        before, after = np.minimum(t - low, 0.0), np.maximum(t - high, 0.0)
        phase = self._phase(inside) + before * self._ends[0] + after * self._ends[1]
        return phase, self._f(inside), self._rate(inside) * (1.0 - outside)

    def time(self, phase):
        """Times (k,) of phases (k,)."""
        t = np.interp(phase, self._phases, self._times)
        below, above = phase < self._phases[0], phase > self._phases[-1]
        t = np.where(below, self._times[0] + (phase - self._phases[0]) / self._ends[0], t)
        t = np.where(above, self._times[-1] + (phase - self._phases[-1]) / self._ends[1], t)
        for _ in range(STEPS):
            found, f, _ = self.at(t)
            t = t + (phase - found) / f
        return t

    def delayed(self, t, cycles):
        """tau (k,) [s] and its first two derivatives, a phase `cycles` before times t (k,)."""
        phase, f, rate = self.at(t)
        tau = self.time(phase - cycles)
        _, own, own_rate = self.at(tau)
        slope = f / own
        return tau, slope, (rate - slope**2 * own_rate) / own

    def advanced(self, t, cycles):
        """Times (k,) a phase `cycles` after times t (k,)."""
        return self.time(self.at(t)[0] + cycles)


class Constant:
    """As `Warp`, for a constant `frequency` [Hz]."""

    def __init__(self, frequency):
        self._frequency = frequency

    def delayed(self, t, cycles):
        """tau (k,) [s] and its first two derivatives, a phase `cycles` before times t (k,)."""
        return t - cycles / self._frequency, 1.0, 0.0

    def advanced(self, t, cycles):
        """Times (k,) a phase `cycles` after times t (k,)."""
        return t + cycles / self._frequency


class ShapedMotion:
    """A motion after a shaper; see the module.

    Parameters
    ----------
    motion : PiecewiseMotion
    modes : Modes
        Their frequencies are constant if there is a `quiet` motion.
    quiet : PiecewiseMotion, optional
        Motion that leaves no vibration, and from which `motion` departs.
    """

    def __init__(self, motion, modes, quiet=None):
        self.motion, self._quiet = motion, quiet
        first, last = motion.knots[0], motion.knots[-1]
        if modes.varies:
            step = self._fine(modes)
            times = np.arange(first, last + modes.max_duration + 4.0 * step, step)
            where = motion.position(times - modes.delay)
            for _ in range(ITERATIONS):
                found = modes.at(where)
                self._stages = [
                    (s.cycles, s.amplitudes, Warp(times, found[:, s.mode])) for s in modes.stages
                ]
                where = self.states(times)[0]
        elif modes.stages and quiet is not motion:  # as one stage: constant delays add up
            train = modes.constant()
            self._stages = [(train.times, train.amplitudes, Constant(1.0))]
        else:
            self._stages = []
        fine = modes.varies or motion.mixed
        self._grid = self._fine(modes) if fine else None
        #: When the shaped motion begins and ends [s].
        self.begin, self.end = float(first), float(last)
        if quiet is not None:
            self.end = float(max(last, quiet.knots[-1]))
        for cycles, _, law in self._stages:
            self.end = float(law.advanced(np.array([self.end]), cycles[-1])[0])

    @staticmethod
    def _fine(modes):
        """Spacing of places where the motion is no polynomial [s]."""
        return 1.0 / (PER_PERIOD * modes.frequencies.min(axis=1).max())

    def knots(self):
        """Times between which the shaped motion is a polynomial, or close to one, (k,) [s]."""
        knots = self.motion.knots
        if self._quiet is not None:
            knots = np.concatenate([knots, self._quiet.knots])
        for cycles, _, law in self._stages:
            knots = np.concatenate([law.advanced(knots, c) for c in cycles])
        if self._quiet is not None:
            knots = np.concatenate([knots, self._quiet.knots])
        if self._grid is not None:
            count = int((self.end - self.begin) / self._grid) + 2
            knots = np.concatenate([knots, np.linspace(self.begin, self.end, count)])
        knots = np.sort(knots)
        knots = knots[np.concatenate([[True], np.diff(knots) > SAME])]
        knots[-1] = self.end
        return knots

    def states(self, times):
        """Position, velocity and acceleration, (3, k, n), at times (k,) [s]."""
        times = np.asarray(times, float)
        found = self._states(len(self._stages), times)
        return found if self._quiet is None else found + _states(self._quiet, times)

    def _states(self, level, t):
        if level == 0:
            own = _states(self.motion, t)
            return own if self._quiet is None else own - _states(self._quiet, t)
        cycles, amplitudes, law = self._stages[level - 1]
        out = 0.0
        for cycle, amplitude in zip(cycles, amplitudes, strict=True):
            tau, slope, bend = law.delayed(t, cycle)
            own = self._states(level - 1, tau)
            slope = np.reshape(slope, (-1, 1))
            own[2] = own[2] * slope**2 + own[1] * np.reshape(bend, (-1, 1))
            own[1] *= slope
            out = out + amplitude * own
        return out


def _states(motion, times):
    """Position, velocity and acceleration, (3, k, n), of a motion at times (k,)."""
    return np.stack([motion.derivative(order, times) for order in range(3)])
