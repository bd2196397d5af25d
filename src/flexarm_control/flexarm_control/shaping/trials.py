# SPDX-License-Identifier: Apache-2.0
r"""Corrects the time law of a motion that is repeated, by the ringing that it leaves.

A time law of `time_law` is as good as the modes that it knows. A sensor that measures the ringing after the motion (a
gauge, an accelerometer at the tip) shows what it has missed. In T seconds after the end its channels c read

.. math:: y_c(t) = \mathrm{Re} \sum_m a_{mc}\, e^{p_m t} + d_c, \qquad a_{mc} = h_{mc}\, z_m,

with the poles p measured where the motion ends, and the response h of the sensor to each mode. It is
:math:`a_{mc}/z_m` after a small motion there, whose z is known. Least squares give the z that the motion has left. With
:math:`Z = \partial z/\partial x` from `time_law`, the next motion has the accelerations :math:`x + \delta`,

.. math:: \min_\delta \max_k |\delta_k| \quad\text{with}\quad z + Z\delta = 0,\;
    |\ddot\sigma| \le a,\; 0 \le \dot\sigma \le v,\; \dot\sigma(T) = 0,\; \sigma(T) = 1,

a linear programme for the least change, since Z is only about right. Each trial corrects Z by the effect of the change
(Broyden 1965, *A class of methods for solving nonlinear simultaneous equations*),

.. math:: Z \leftarrow Z + \frac{(\Delta z - Z\delta)\,\delta^T}{\delta^T\delta}.

A trial that swings more than the best one is not followed: the next one starts at the best, with half the change. The
trials are iterative learning control of the few unknowns that ring.
"""

import numpy as np
from scipy.optimize import linprog

from flexarm_dynamics.errors import DesignError, MessageError

from . import time_law
from .modes import Modes
from .time_law import DIRECTIONS, FACTORS, ITERATIONS, SLACK

#: Number of periods of the lowest mode after the end that are evaluated.
PERIODS = 2.0
#: Largest change of an acceleration in one trial, over the largest acceleration [-].
CHANGE = 0.3
#: Weight of the remaining ringing relative to the change; and factor on the changes after a trial that is worse.
LEFT, LESS = 100.0, 0.5
#: Number of cells in which a motion's z is integrated.
CELLS = 2000


class Ringing:
    """Modes as they ring where a motion ends.

    Parameters
    ----------
    frequencies, dampings : (m,) array_like
        Measured [Hz], [-].
    """

    def __init__(self, frequencies, dampings):
        w, damping = 2.0 * np.pi * np.asarray(frequencies, float), np.asarray(dampings, float)
        self.frequencies = w / (2.0 * np.pi)
        self.poles = w * (-damping + 1j * np.sqrt(1.0 - damping**2))
        #: How long after the end readings are used [s].
        self.window = float(PERIODS / self.frequencies.min())

    def amplitudes(self, times, readings):
        """Amplitude of each mode in each channel at the end of the motion, (m, c) complex.

        Parameters
        ----------
        times : (k,) array_like
            Times from the end of the motion on; later ones than `window` are not used [s].
        readings : (k, c) array_like

        Raises
        ------
        MessageError
            If there are too few, or one is not finite.
        """
        times, readings = np.asarray(times, float), np.asarray(readings, float)
        used = (times >= 0.0) & (times <= self.window)
        times, readings, count = times[used], readings[used], self.poles.size
        if times.size < 4 * count + 1 or np.ptp(times) < 0.5 * self.window:
            hint = f"record {self.window:.3g} s after the end of the motion"
            raise MessageError("are too few", field="readings", value=times.size, hint=hint)
        if not np.isfinite(readings).all():
            raise MessageError("are not finite", field="readings")
        turning = np.exp(self.poles * times[:, None])
        known = np.hstack([turning.real, -turning.imag, np.ones((times.size, 1))])
        found = np.linalg.lstsq(known, readings, rcond=None)[0]
        return found[:count] + 1j * found[count : 2 * count]

    def answer(self, small, motion, times, readings):
        """Response of the sensor to each mode, per unit of z, (m, c) complex.

        Parameters
        ----------
        small, motion : PiecewiseMotion
            The small motion after which the readings were taken, and the one to be learned; same end, same direction.
        times, readings
            As for `amplitudes`, after the small motion.
        """
        first, last = small.knots[[0, -1]]
        step = (last - first) / CELLS
        at = first + step * (np.arange(CELLS) + 0.5)
        bend = small.derivative(2, at) @ motion.angle / float(motion.angle @ motion.angle)
        z = step * np.exp(self.poles[:, None] * (last - at)) @ bend
        return self.amplitudes(times, readings) / z[:, None]


class Trials:
    """A motion that is corrected from trial to trial.

    Parameters
    ----------
    motion : PiecewiseMotion
        A straight motion from rest to rest, whose points give velocities.
    modes : Modes
        As for `time_law.retimed`.
    ringing : Ringing
        As many modes as `modes` has, in the same ascending order. Their frequencies correct those of `modes` on the
        whole path, as factors; the time law's duration stays.
    answer : (m, c) array_like
        Response of the sensor, see `Ringing.answer`.
    velocity, acceleration : (n,) array_like
        Limits, as for `time_law.retimed`.

    Attributes
    ----------
    motion : PiecewiseMotion
        The motion to make next.
    best : PiecewiseMotion
        The motion that has left the least vibration; at first that of `time_law.solved` for the modes alone. The trials
        show what that leaves out.
    least : float
        Swing of the best motion; inf at first.

    Raises
    ------
    DesignError
        If there is no such time law.
    """

    def __init__(self, motion, modes: Modes, ringing, answer, velocity=np.inf, acceleration=np.inf):
        if modes.frequencies.shape[1] != ringing.poles.size:
            raise DesignError(
                f"modes ring at the end, {modes.frequencies.shape[1]} are known on the way",
                field="ringing",
                value=ringing.poles.size,
            )
        found = time_law.solved(motion, modes, velocity, acceleration, plain=True)
        if found is None:
            hint = "give a straight motion from rest to rest, with velocities"
            raise DesignError("has no time law for its modes", field="motion", hint=hint)
        self._law, norms, self._x = found
        self._norms = np.array([norm[FACTORS // 2] for norm in norms])
        self._ringing, self._answer = ringing, np.asarray(answer, complex)
        corrected = modes.scaled(ringing.frequencies / modes.along(motion.end[None])[0][0])
        line = time_law.Line(motion, corrected, time_law.along(motion))
        self._slope = self._law.left(self._x, line)
        self._kept, self._gain, self.least = None, 1.0, np.inf
        self.motion = self.best = self._law.motion(self._x)

    def took(self, times, readings, swing):
        """Take the ringing after `motion`, and find the next one.

        Parameters
        ----------
        times, readings
            As for `Ringing.amplitudes`.
        swing : float
            Vibration that the motion has left, in any unit that stays the same; the least is the best.

        Raises
        ------
        MessageError
            For readings that can't be used; then nothing changes.
        """
        seen = self._ringing.amplitudes(times, readings)
        x, h = self._x, self._answer
        z = (h.conj() * seen).sum(axis=1) / (np.abs(h) ** 2).sum(axis=1)
        if self._kept is not None:
            self._learn(x - self._kept[0], z - self._kept[1])
        if swing < self.least:
            self.least, self.best, self._kept = swing, self.motion, (x, z)
        else:
            self._gain *= LESS
        x, z = self._kept
        change = self._change(x, z)
        self._x = x if change is None else x + self._gain * change
        self.motion = self._law.motion(self._x)

    def _learn(self, change, effect):
        size = float(change @ change)
        if size > 0.0:
            wrong = effect - self._slope @ change
            self._slope = self._slope + np.outer(wrong, change) / size

    def _change(self, x, z):
        """The least change of x that removes z, as far as `CHANGE` allows; None if there is none."""
        law, count = self._law, x.size
        velocity, acceleration = law.limits
        around = np.exp(-2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)
        slope, now = self._slope / self._norms[:, None], law.inner @ x
        rows = np.real(around[:, None, None] * slope).reshape(-1, count)
        each, none = np.eye(count), np.zeros((len(now), 2))
        upper = np.vstack([
            np.column_stack([rows, -np.ones(len(rows)), np.zeros(len(rows))]),
            np.hstack([law.inner, none]),
            np.hstack([-law.inner, none]),
            np.column_stack([each, np.zeros(count), -np.ones(count)]),
            np.column_stack([-each, np.zeros(count), -np.ones(count)]),
        ])  # fmt: skip
        limits = [
            -np.real(around[:, None] * (z / self._norms)).ravel(),
            velocity * (1.0 + SLACK) - now,
            now + SLACK * velocity,
            np.zeros(2 * count),
        ]
        cost = np.concatenate([np.zeros(count), [LEFT, 1.0 / acceleration]])
        own = [(-acceleration - value, acceleration - value) for value in x]
        found = linprog(
            cost, upper, np.concatenate(limits), np.hstack([law.ends, np.zeros((2, 2))]), [0.0, 0.0],
            bounds=[*own, (0.0, None), (0.0, CHANGE * acceleration)],
            method="highs", options={"maxiter": ITERATIONS},
        )  # fmt: skip
        return found.x[:count] if found.success else None
