# SPDX-License-Identifier: Apache-2.0
r"""Compares the strains with the motion of the joints that bends the links: wrong signs, exchanged gauges.

The second row of (2), without damping, multiplied by :math:`R K_2^{-1}`,

.. math:: z + p = 0, \qquad z = R\left(\delta + K_2^{-1}M_{22}\ddot\delta\right), \quad
          p = R K_2^{-1}\left(M_{21}\ddot q + f_2\right),

says what the strains and their acceleration must be for a motion of the joints, whatever torque, friction or brake
makes it; :math:`\delta = W(\varepsilon - b)`. Strains, joint positions and :math:`f_2` go through the same low
pass :math:`(\omega_f/(s+\omega_f))^3`, whose states have the filtered derivatives, and z and p through the same high
pass, so that neither the bias of a gauge nor an unknown payload's weight counts. The misfit of the readings

.. math:: r = \frac{\overline{|z + p|^2}}{\overline{|z|^2} + \overline{|p|^2}}

is 0 where they fit, 1 where they have nothing in common, 2 where the sign is wrong; a payload that is 30 % off
makes 0.03. When r of the gauges on a link is above `MISFIT` for `PERSISTENT` comparisons, the same samples are
judged under each hypothesis: one gauge or all of a link with the other sign, two gauges exchanged. The one with the
smallest r is named if its r is `RATIO` times smaller and below `FIT`. Strains that are small beside their own
noise, or beside what a free oscillation moves, are not judged. Nor are arms with light joints (`Channels.heavy`):
there large inertias cancel in z and p, and a payload that is 30 % off can turn their signs.
"""

from itertools import combinations

import numpy as np

#: Corner of the low pass as a multiple of the lowest frequency with free joints, and its limits [rad/s].
CORNER, MIN_CORNER, MAX_CORNER = 2.0, 15.0, 60.0
#: Corner of the high pass as a fraction of that of the low pass [-].
WASHOUT = 0.5
#: Time constants of the low pass after which its start is forgotten [-].
SETTLED = 7.0
#: Time between two comparisons, over which they are averaged, and between new mass matrices [s].
INTERVAL, MEMORY, RENEWAL = 0.004, 0.12, 0.02
#: Misfit that raises the question [-], and for how many comparisons.
MISFIT, PERSISTENT = 0.12, 5
#: The hypothesis that wins has a misfit below the first, and smaller by the second [-].
FIT, RATIO = 0.2, 5.0
#: Strains are judged when z and p are this many times larger than their noise, and this fraction of |z - epsilon|.
CLEAR, DRIVEN = 8.0, 0.5
#: And the strains are at least this fraction of z and p: else inertias cancel, and the model is not exact enough.
STRAINED = 0.2


class StrainLaw:
    """Finds the hypothesis under which the strains fit the motion.

    Parameters
    ----------
    channels : Channels
    strain_map : StrainMap
    """

    def __init__(self, channels, strain_map):
        c, self._map = channels, strain_map
        self.channels, self.model = c, c.model
        lowest = self.model.frequencies().min(initial=np.inf)
        self.corner = float(np.clip(CORNER * lowest, MIN_CORNER, MAX_CORNER))
        gauges = self.model.arm.gauges
        places = [(a.link, a.direction) for a in gauges]
        self._groups = np.array([[a == b for b in places] for a in places])
        self.hypotheses = list(_hypotheses(gauges, places))
        self._hypothesis = np.stack([h[2] for h in self.hypotheses])
        self._concerned = np.stack([self._groups[list(h[1])].any(axis=0) for h in self.hypotheses])
        self._project = strain_map.rows @ strain_map.inverse
        self._kept = round(MEMORY / INTERVAL)
        self.reset()

    def reset(self):
        """Forget the past."""
        c = self.channels
        self._low = None
        self._slow = np.zeros((3, c.g))
        self._sums = np.zeros((4, c.g))
        self._run = np.zeros(c.g, int)
        self._history = np.zeros((self._kept, 3, c.g))
        self._number = 0
        self._since = self._age = 0.0
        self._inertia = None

    def update(self, position, strain, velocity, dt):
        """Take the readings of a new sample.

        Parameters
        ----------
        position, velocity : ndarray, shape (n,)
        strain : ndarray, shape (g,)
        dt : float
            Since the last sample [s].

        Returns
        -------
        int or None
            Index of the hypothesis that wins against the arm file's wiring.
        """
        if self._inertia is None or self._age >= RENEWAL:
            self._renew(position, velocity)
        now = np.concatenate([strain, position, self._force])
        if self._low is None:
            # As if it had stood still until now: an arm that moves looks as if it had been hit.
            self._low, self._settling = np.tile(now, (3, 1)), SETTLED / self.corner
            return None
        self._age += dt
        self._settling -= dt
        self._since += dt
        y, k = self._low, 1.0 - np.exp(-self.corner * dt)
        y[0] += k * (now - y[0])
        y[1] += k * (y[0] - y[1])
        y[2] += k * (y[1] - y[2])
        if self._since < INTERVAL:
            return None
        since, self._since = self._since, 0.0
        if self._settling > 0.0:
            return None
        return self._compare(since)

    def _renew(self, position, velocity):
        """Mass matrix and forces of the present configuration."""
        n, age = self.channels.n, self._age
        terms = self.model.terms(position, velocity)
        self._age = 0.0
        if self._inertia is None or age:
            to_strain = self._map.rows @ np.linalg.inv(terms.K2)
            self._load = to_strain @ terms.M[n:, n:] @ self._map.inverse
            self._drive, self._bend = to_strain @ terms.M[n:, :n], to_strain
        self._inertia = terms.M
        self._force = terms.f2

    def _compare(self, dt):
        g, n = self.channels.g, self.channels.n
        y, w = self._low, self.corner
        second = (w * w) * (y[0] - 2.0 * y[1] + y[2])
        filtered = y[2]
        raw = np.stack(
            [
                filtered[:g],
                second[:g],
                self._drive @ second[g : g + n] + self._bend @ filtered[g + n :],
            ]
        )
        k = 1.0 - np.exp(-WASHOUT * w * dt)
        if self._number == 0:
            self._slow[:] = raw
        self._slow += k * (raw - self._slow)
        fast = raw - self._slow
        self._history[self._number % self._kept] = fast
        self._number += 1
        strain, acceleration, p = fast
        moved = self._load @ acceleration
        z = self._project @ strain + moved
        keep = np.exp(-dt / MEMORY)
        self._sums *= keep
        self._sums += (1.0 - keep) * np.stack([(z + p) ** 2, z * z + p * p, strain**2, moved**2])
        # Sums over the gauges of one link and direction.
        misfit, total, still, swing = self._sums @ self._groups
        doubtful = self._judged(total, still, swing) & (misfit > MISFIT * total)
        self._run[~doubtful] = 0
        self._run[doubtful] += 1
        if self._number < self._kept or not (self._run >= PERSISTENT).any():
            return None
        return self._decide()

    def _judged(self, total, still, swing):
        """Whether z and p are larger than noise and wrong frequencies make them, by gauge."""
        c, w = self.channels, self.corner
        gauge = c.noise[c.strain]
        encoder = np.maximum(c.count / np.sqrt(12.0), c.noise[c.position])
        # A low pass of the third order leaves about a third of white noise at a tenth of the sampling rate.
        noise = gauge**2 + (0.3 * w * w) ** 2 * (
            self._load**2 @ gauge**2 + self._drive**2 @ encoder**2
        )
        driven = (total > DRIVEN**2 * (still + swing)) & (still > STRAINED**2 * total)
        return driven & (total > CLEAR**2 * (noise @ self._groups))

    def _decide(self):
        """The hypothesis that fits much better, if there is one."""
        strain, acceleration, p = np.moveaxis(self._history, 1, 0)  # each (kept, g)
        moved = acceleration @ self._load.T
        z = strain @ self._project.T + moved
        misfit, total = ((z + p) ** 2).mean(axis=0), (z * z + p * p).mean(axis=0)
        still, swing = (strain**2).mean(axis=0), (moved**2).mean(axis=0)
        judged = self._judged(*(sums @ self._groups for sums in (total, still, swing)))
        misfit, total = misfit * judged, total * judged + ~judged
        T = self._hypothesis
        z = np.einsum("ij,hjk,tk->hti", self._project, T, strain, optimize=True)
        z += np.einsum("ij,hjk,tk->hti", self._load, T, acceleration, optimize=True)
        others, totals = ((z + p) ** 2).mean(axis=1), (z * z).mean(axis=1) + (p * p).mean(axis=0)
        nominal = self._concerned @ misfit / (self._concerned @ total)
        other = (self._concerned * others).sum(axis=1) / (self._concerned * totals).sum(axis=1)
        doubtful = self._concerned[:, judged & (self._run >= PERSISTENT)].any(axis=1)
        gain = np.where(doubtful & (other < FIT) & (nominal > MISFIT), nominal / other, 0.0)
        best = int(np.argmax(gain))
        self.misfits = float(nominal[best]), float(other[best])
        return best if gain[best] > RATIO else None


def _hypotheses(gauges, places):
    """Words, gauges and map (g, g) from readings to strains of each wrong wiring."""
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
