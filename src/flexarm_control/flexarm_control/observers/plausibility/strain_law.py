# SPDX-License-Identifier: Apache-2.0
r"""Compares the strains with the motion of the joints, which bends the links, to find wrong signs and exchanged gauges.

The second row of (2), multiplied by :math:`R K_2^{-1}`,

.. math:: z + p = 0, \qquad z = R\left(\delta + K_2^{-1}(M_{22}\ddot\delta + C_2\dot\delta)\right), \quad
          p = R K_2^{-1}\left(M_{21}\ddot q + f_2\right),

gives the strains and their derivatives for a motion of the joints, whatever torque, friction or brake causes it, with
:math:`\delta = W(\varepsilon - b)`. :math:`C_2` has the damping, and the Coriolis forces on links that bend while the
arm turns. Strains, joint positions and :math:`f_2` pass the same `low_pass`, which gives their derivatives. z and p
pass the same high-pass filter, so that neither the bias of a gauge nor an unknown payload's weight counts.
(`zero_drift` judges z and p without this filter.) The misfit of the readings

.. math:: r = \frac{\overline{|z + p|^2}}{\overline{|z|^2} + \overline{|p|^2}}

is 0 if they fit, 1 if they have nothing in common, 2 if the sign is wrong; a payload that is 30 % off causes 0.03.
If r of a link's gauges in one direction is above `MISFIT` for `PERSISTENT` comparisons, the same samples are judged
under each hypothesis: the other sign for one gauge, for all of a link's gauges in one direction, or for all gauges; or
two gauges exchanged. The hypothesis whose r falls by the largest factor is named if this factor is above `RATIO` and r
is below `FIT`. Strains that are small compared with their noise, stated or seen, are not judged.

A wrong wiring T may have begun only a moment ago, at :math:`t_0`. The low pass F is linear. So F also filters the
strains since that moment, :math:`F[\varepsilon 1_{t\ge t_0}]`, and its output with the right wiring would have been
:math:`F[\varepsilon] + (T - 1)F[\varepsilon 1_{t\ge t_0}]`. Each hypothesis is judged from the beginning, and from
`ONSETS` moments, `EVERY` apart, that move on with time. Thus the filter's memory of right strains does not delay the
result. If an offset of a single gauge explains the misfit as well, it is left to `zero_drift`. If a positive factor on
all strains explains it as well, the wiring is right: play and a wrong payload cause such a factor. Exchanged gauges of
a link with one mode cause one, too. So the misfit of a hypothesis also contains the square of the strains that no modes
of the link explain, :math:`\varepsilon - RW\varepsilon`: gauges that agree with each other are not exchanged.

A hypothesis is not accepted if the arm mainly oscillates freely, so that z and p are small compared with the strains
and the inertia in z. The readings of exchanged gauges do not show this, so it is judged with the strains of the
hypothesis. Arms with light joints (`Channels.heavy` is false) are not judged: there large inertias cancel in z and p,
and a payload that is 30 % off can reverse their signs.
"""

from itertools import combinations
from math import exp

import numpy as np

from ... import kernels
from ...kernels import strains
from .low_pass import LowPass
from .zero_drift import TOLERANCE, ZeroDrift, law_matrices

#: Corner of the low pass as a multiple of the lowest frequency with free joints, and its limits [rad/s].
CORNER, MIN_CORNER, MAX_CORNER = 3.0, 15.0, 60.0
#: Corner of the high pass as a fraction of that of the low pass [-].
WASHOUT = 0.4
#: Time constants of the low pass after which its start is forgotten, and over which readings are interpolated [-].
SETTLED, GAP = 12.0, 0.7
#: Times between two comparisons, over which they are averaged, and between new mass matrices [s].
INTERVAL, MEMORY, RENEWAL = 0.008, 0.064, 0.04
#: Misfit above which hypotheses are judged [-], and for how many comparisons.
MISFIT, PERSISTENT = 0.12, 3
#: The misfit of the hypothesis that wins is below the first value, and the second value times smaller than the nominal
#: misfit [-].
FIT, RATIO = 0.05, 5.0
#: It is also smaller than that of every other hypothesis by this factor [-], and wins this many comparisons in a row.
DISTINCT, CONFIRMED = 3.0, 3
#: No wiring wins if all strains of a link, larger or smaller by a factor up to this [-], have a misfit below `FIT`: a
#: payload, play or stiffness that differs from the arm file's causes that.
SCALE = 2.0
#: Strains are judged if z and p are this many times larger than their noise, and at least this fraction of epsilon and
#: z - R W epsilon together [-].
CLEAR, DRIVEN = 8.0, 0.5
#: The strains must also be at least this fraction of z and p [-]: else inertias cancel, and the model is too inexact.
STRAINED = 0.2
#: A low pass reduces the rms of white noise by this times the root of corner times sampling interval [-].
WHITE = np.sqrt(3.0 / 16.0)
#: Moments at which a wrong wiring may have begun, and the time between them [s].
ONSETS, EVERY = 8, 0.03
#: Rounding of times [s], and smallest square to divide by.
ROUNDING, TINY = 1e-9, 1e-300
#: Encoder counts are not white noise: this is the largest second derivative of a low-passed step, divided by the step's
#: size and corner^2 [-].
STEP = 0.3


class StrainLaw:
    """Finds the hypothesis under which the strains fit the motion.

    Parameters
    ----------
    channels : Channels
    strain_map : StrainMap
    payload : float
        Fraction by which the payload may differ from the arm file's [-].

    Attributes
    ----------
    drift : ZeroDrift
    drive : ndarray, shape (g, n)
        Strain per joint acceleration at the present configuration.
    misfits : float, float
        Misfits for the hypothesis that won: with the arm file's wiring, and with the hypothesis.
    """

    def __init__(self, channels, strain_map, payload=TOLERANCE):
        c, self._map = channels, strain_map
        self.channels, self.model = c, c.model
        self.corner = corner_of(self.model)
        gauges = self.model.arm.gauges
        places = [(a.link, a.direction) for a in gauges]
        self._groups = np.array([[a == b for b in places] for a in places])
        self.hypotheses = list(_hypotheses(gauges, places))
        self._hypothesis = np.stack([h[2] for h in self.hypotheses])
        self._concerned = np.stack([self._groups[list(h[1])].any(axis=0) for h in self.hypotheses])
        self._of_counts, self._of_position = (STEP * c.count) ** 2 / 12.0, c.noise[c.position] ** 2
        self._project = strain_map.rows @ strain_map.inverse
        self._kept = round(MEMORY / INTERVAL)
        self.drift = ZeroDrift(c, strain_map, payload)
        # Strains, positions and forces; then the strains since each moment.
        size = c.g + c.n + c.m
        self._young = slice(size, size + ONSETS * c.g)
        size += ONSETS * c.g * c.heavy
        self._now, self._low = np.zeros(size), LowPass(size, self.corner)
        self._moved, self._residual = np.zeros(c.g + c.n), np.zeros((2, c.g))
        self._fast = np.zeros((strains.SINCE + 3 * ONSETS, c.g))
        self._moments, self._kernels = ONSETS * c.heavy, kernels.compiled()
        self.reset()

    def reset(self):
        """Forget the past."""
        self._slow = np.zeros_like(self._fast)
        self._history = np.zeros((self._kept, *self._fast.shape))
        self._interval = INTERVAL
        self._inertia = None
        self.drift.reset()

    def _begin(self, position, velocity):
        """Begin with this sample, since samples before a gap do not show the motion in the gap; the drift is kept."""
        g = self.channels.g
        self._sums, self._run = np.zeros((2, g)), np.zeros(g, int)
        self._number = self._samples = self._oldest = self._same = 0
        self._best = None
        self._since = self._until = 0.0
        self._renew(position, velocity)
        self._low.start(self._now)  # to the filter, a moving arm looks as if it had been hit
        self._settling = SETTLED / self.corner

    def update(self, position, strain, velocity, dt, noise):
        """Take the readings of a new sample.

        Parameters
        ----------
        position, velocity : ndarray, shape (n,)
        strain : ndarray, shape (g,)
        dt : float
            Time since the last sample [s].
        noise : ndarray, shape (g,)
            Rms noise of the gauges' readings so far; counts where it is above the stated one.

        Returns
        -------
        compared : bool
            Whether this sample ended an interval, so that `drift` is new. If a gauge is at an end of its range, this
            is false, and the past is forgotten.
        wiring : int or None
            Index of the hypothesis that wins against the arm file's wiring.
        """
        now, self._noise = self._now, noise
        if not self._kernels.pick_up(strain, position, *self.channels.range, self._moments, now):
            self.reset()  # a reading that is cut off follows no law
            return False, None
        if self._inertia is None or dt > GAP / self.corner:
            self._begin(position, velocity)
            return False, None
        self._low.update(now, dt)
        self._since += dt
        self._samples += 1
        if self._since < INTERVAL - ROUNDING:
            return False, None
        since, samples = self._since, self._samples
        self._since, self._samples = 0.0, 0
        self._age += since
        if self._age >= RENEWAL - ROUNDING:
            self._renew(position, velocity)
        self._interval += 0.1 * (since / samples - self._interval)
        self._settling -= since
        if self._settling > 0.0:
            return False, None
        return True, self._compare(since)

    def _renew(self, position, velocity):
        """Set mass matrix and forces of the present configuration."""
        terms = self.model.terms(position, velocity)
        if self._inertia is None or self.channels.n > 1:  # of a single joint they stay the same
            self.drive, self._load, self._turn, self._bend = law_matrices(
                self.model, self._map, terms
            )
        self._inertia, self._age = terms.M, 0.0
        first = self.channels.g + self.channels.n
        self._now[first : first + self.channels.m] = terms.f2

    def _compare(self, dt):
        g, n, low, moved = self.channels.g, self.channels.n, self._low, self._moved
        residual, fast = self._residual, self._fast
        self._kernels.not_explained(
            low.rows, low.corner, self.drive, self._load, self._turn, self._bend, moved, residual
        )
        self.drift.update(residual[0], moved, low.signal[g : g + n], dt)
        if not self.channels.heavy:
            return None
        k = 1.0 - exp(-WASHOUT * low.corner * dt)
        self._kernels.high_passed(
            low.rows, low.corner, residual[1], self._slow, fast, k, self._number == 0
        )
        self._until -= dt
        if self._until <= 0.0:
            self._begin_anew(fast)
        self._history[self._number % self._kept] = fast
        self._number += 1
        long = self._kernels.follow_misfit(
            fast, self._project, self._load, self._turn, self._groups, self._sums, exp(-dt / MEMORY), self._run,
            self._noise_of_law(), (CLEAR, MISFIT, PERSISTENT),
        )  # fmt: skip
        if self._number < self._kept or not long:
            return None
        return self._decide()

    def _begin_anew(self, fast):
        """Set the oldest of the moments to now."""
        i, self._until = self._oldest, EVERY
        self._oldest = (i + 1) % ONSETS
        g, first = self.channels.g, self._young.start
        self._low.clear(slice(first + i * g, first + (i + 1) * g))
        rows = strains.SINCE + i + ONSETS * np.arange(3)
        self._slow[rows] = fast[rows] = 0.0
        self._history[:, rows] = 0.0

    def _noise_of_law(self):
        """Effect of noise on z and p, summed over a link's gauges, by gauge."""
        c, w = self.channels, self.corner
        left = WHITE**2 * w * self._interval  # fraction of a white noise's variance
        gauge = left * np.maximum(c.noise[c.strain], self._noise) ** 2
        encoder = self._of_counts + left * self._of_position
        return self._kernels.noise_of_law(
            gauge, encoder, w * w, self.drive, self._load, self._turn, self._groups
        )

    def _decide(self):
        """The hypothesis that fits much better, if there is one."""
        rows = np.moveaxis(self._history, 1, 0)  # each (kept, g)
        read, p, since = rows[: strains.FORCE], rows[strains.FORCE], rows[strains.SINCE :]
        z = self._explained(read).sum(axis=0)
        misfit, total = ((z + p) ** 2).mean(axis=0), (z * z + p * p).mean(axis=0)
        clear = total @ self._groups > CLEAR**2 * self._noise_of_law()
        misfit, total = misfit * clear, total * clear + ~clear
        nominal = self._concerned @ misfit / (self._concerned @ total)
        doubtful = self._concerned[:, clear & (self._run >= PERSISTENT)].any(axis=1)
        asked = doubtful & (nominal > MISFIT)
        if not asked.any():
            return None
        # From the beginning, and from each moment.
        T = self._hypothesis.transpose(0, 2, 1)
        change = T - np.eye(p.shape[1])
        rest = self._fit(read[:, None] @ T, p)
        for i in range(ONSETS):
            rest = np.minimum(rest, self._fit(read[:, None] + since[i::ONSETS, None] @ change, p))
        gain = np.where(asked & (rest < FIT), nominal / rest, 0.0)
        best = int(np.argmax(gain))
        self.misfits = float(nominal[best]), float(rest[best])
        # An offset of one gauge explains as much as the gauge's mean residual; a drifting zero is no wrong wiring.
        residual, concerned = z + p, self._concerned[best]
        offset = concerned * residual.mean(axis=0) ** 2
        left = concerned @ (residual**2).mean(axis=0) - offset.max()
        other = np.delete(rest, best).min(initial=left / (concerned @ total))
        distinct = DISTINCT * rest[best] < other and _scaled(z * concerned, p * concerned) > FIT
        if not (gain[best] > RATIO and distinct):
            best = None
        self._same = self._same + 1 if best == self._best and best is not None else 1
        self._best = best
        return best if self._same >= CONFIRMED else None

    def _explained(self, read):
        """Parts of z from the strains, their first and their second derivatives, (3, ..., g)."""
        return np.stack([read[0] @ self._project.T, read[1] @ self._turn.T, read[2] @ self._load.T])

    def _fit(self, read, p):
        """Misfit of each hypothesis' strains and derivatives, (3, h, kept, g); infinite where inertias cancel."""
        parts = self._explained(read)
        z, moved = parts.sum(axis=0), parts[1:].sum(axis=0)
        # The part of a link's strains that none of its modes explain.
        alone = read[0] - parts[0]
        parts = (z + p) ** 2 + alone**2, z * z + p * p, read[0] ** 2, moved**2
        misfit, total, still, swing = (
            (self._concerned * part.mean(axis=1)).sum(axis=1) for part in parts
        )
        known = (total > DRIVEN**2 * (still + swing)) & (still > STRAINED**2 * total)
        return np.where(known, misfit / np.where(known, total, 1.0), np.inf)


def _scaled(z, p):
    """Misfit that is left if the strains are multiplied by the best factor within `SCALE`."""
    zz, pp, zp = (float(np.sum(part)) for part in (z * z, p * p, z * p))
    factor = min(max(-zp / zz, 1.0 / SCALE), SCALE) if zz > 0.0 else 1.0
    return (factor**2 * zz + 2.0 * factor * zp + pp) / max(factor**2 * zz + pp, TINY)


def corner_of(model):
    """Corner of the low pass of readings that are compared with the motion of a model's arm [rad/s]."""
    return float(np.clip(CORNER * model.frequencies().min(initial=np.inf), MIN_CORNER, MAX_CORNER))


def _hypotheses(gauges, places):
    """Text, gauges and map (g, g) from readings to strains, for each wrong wiring."""
    names, count = [g.name for g in gauges], len(gauges)
    for i in range(count):
        T = np.eye(count)
        T[i, i] = -1.0
        yield f"strain of {names[i]} has the wrong sign", (i,), T
    for place in dict.fromkeys(places):
        members = tuple(i for i in range(count) if places[i] == place)
        if len(members) > 1:
            T = np.eye(count)
            T[members, members] = -1.0
            yield f"strain of {_listed(names, members)} has the wrong sign", members, T
    if len(set(places)) > 1:
        members = tuple(range(count))
        yield "strain of all gauges has the wrong sign", members, -np.eye(count)
    for i, j in combinations(range(count), 2):
        T = np.eye(count)
        T[[i, j]] = T[[j, i]]
        yield f"strain of {names[i]} and {names[j]}: the gauges are exchanged", (i, j), T


def _listed(names, members):
    return " and ".join([", ".join(names[i] for i in members[:-1]), names[members[-1]]])
