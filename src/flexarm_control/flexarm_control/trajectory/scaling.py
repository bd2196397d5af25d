# SPDX-License-Identifier: Apache-2.0
r"""Speed scaling: a factor on the time of a trajectory, which changes smoothly.

The reference is :math:`q_r(s(t))`, as in a stop (module `path`), with

.. math:: \dot s = f_0 + \sum_i \Delta f_i\, S\!\left(\frac{t - t_i}{T_i}\right)

for changes of the factor by :math:`\Delta f_i`, each with its own ramp S. Velocity and acceleration are
:math:`q_r'\dot s` and :math:`q_r''\dot s^2 + q_r'\ddot s`. So a torque that is computed from them belongs to the
scaled motion. With f = 0 the arm rests where it is on its way.
"""

from dataclasses import dataclass, replace

import numpy as np

from .path import at_rate, slowing
from .values import SECOND


@dataclass(frozen=True)
class TimeLaw:
    """Time s of a path as a function of the arm's time, with its rate, from an origin on.

    Attributes
    ----------
    origin_ns : int
        Stamp [ns].
    covered : float
        s there [s].
    level : float
        Rate without the ramps [-].
    ramps : tuple of (int, float, float)
        Stamp at which each begins [ns], its duration [s] and the change of the rate [-].
    """

    origin_ns: int
    covered: float = 0.0
    level: float = 1.0
    ramps: tuple = ()

    def at(self, stamp_ns, offset=0.0):
        """s [s], its rate [-] and the rate's change [1/s], an offset [s] from a stamp."""
        t = (stamp_ns - self.origin_ns) / SECOND + offset
        s, rate, change = self.covered + self.level * t, self.level, 0.0
        for begin_ns, duration, step in self.ramps:
            begin = (begin_ns - self.origin_ns) / SECOND
            risen, slope, bend = _ramp(t - begin, duration)
            s += step * (risen - _ramp(-begin, duration)[0])
            rate, change = rate + step * slope, change + step * bend
        return s, rate, change

    @property
    def factor(self):
        """Rate after all ramps [-]."""
        return self.level + sum(step for *_, step in self.ramps)

    def changed(self, stamp_ns, factor, duration):
        """Return a law that changes to a factor [-] from a stamp [ns] on, within a duration [s]."""
        law = self.since(stamp_ns, self.at(stamp_ns)[0])
        return replace(law, ramps=(*law.ramps, (stamp_ns, duration, factor - self.factor)))

    def since(self, stamp_ns, covered=0.0):
        """Return a law with the same rate, from another origin on."""
        over = [r for r in self.ramps if r[0] + r[1] * SECOND <= stamp_ns]
        left = tuple(r for r in self.ramps if r not in over)
        return TimeLaw(stamp_ns, covered, self.level + sum(step for *_, step in over), left)


def _ramp(elapsed, duration):
    """Integral of S over time [s], S and its derivative [1/s], at a time since its begin [s]."""
    x = elapsed / duration
    if x <= 0.0:
        return 0.0, 0.0, 0.0
    if x >= 1.0:
        return elapsed - 0.5 * duration, 1.0, 0.0
    left, fallen, change, _ = slowing(x)
    return elapsed - left * duration, 1.0 - fallen, -change / duration


class ScaledPath:
    """A path whose time goes at another rate; see the module.

    Parameters
    ----------
    path : Path
        A path that has begun and is not changed any more.
    law : TimeLaw
    kept : float
        Largest fraction of a plan's bending that may still be there: the lowest rate at which a change of the
        speed began; 0: the path was scaled from its start on [-].
    """

    #: Whether the path's time differs from the arm's.
    scaled = True

    def __init__(self, path, law, kept=0.0):
        self.followed, self.law, self.kept = path, law, kept
        self.trajectory_id, self.start_ns = path.trajectory_id, path.start_ns
        self.duration_ns, self.begin_state = path.duration_ns, path.begin_state
        self._own = np.zeros_like(path.begin_state)

    @property
    def pushes(self):
        """Whether there is an effort on the way."""
        return self.followed.pushes

    def peaks(self):
        """Of the path: see `Path.peaks`."""
        return self.followed.peaks()

    def derivatives(self, elapsed):
        """Of the path: see `Path.derivatives`."""
        return self.followed.derivatives(elapsed)

    def elapsed(self, stamp_ns):
        """Time of the path at a stamp, from the path's start [s]."""
        return self.law.at(stamp_ns)[0]

    def pace(self, stamp_ns, offset=0.0):
        """How fast the time of the path that is followed goes, `offset` [s] from a stamp [-]."""
        return self.law.at(stamp_ns, offset)[1]

    def rate(self, stamp_ns):
        """Largest rate from a stamp on [-]."""
        law = self.law.since(stamp_ns)
        steps = [max(step, 0.0) for *_, step in law.ramps]
        return max(self.law.at(stamp_ns)[1], law.level + sum(steps))

    def _place(self, s):
        """Stamp of the path, and remainder [s], at a time s of the path [s]."""
        whole = int(s * SECOND)
        return self.start_ns + whole, s - whole / SECOND

    def piece(self, stamp_ns):
        """Number of the path's polynomial at a stamp; `Path.END` at the end and after it."""
        return self.followed.piece(self._place(self.law.at(stamp_ns)[0])[0])

    def own(self, stamp_ns):
        """State (3, n) at a stamp, with derivatives by the path's own time; overwritten by the next call."""
        self.followed.near(*self._place(self.law.at(stamp_ns)[0]), self._own)
        return self._own

    def effort(self, stamp_ns, out):
        """Fill `out` (n,) with the effort at a stamp [N m]."""
        self.followed.effort(self._place(self.law.at(stamp_ns)[0])[0], out)

    def evaluate(self, stamp_ns, out):
        """Fill `out` (3, n) with the state at a stamp; return whether it is before the end."""
        return self.near(stamp_ns, 0.0, out)

    def near(self, stamp_ns, offset, out):
        """Fill `out` (3, n) with the state `offset` [s] from `stamp_ns`, on the path's polynomial at that stamp.

        Returns whether the stamp is before the end. After it the state is that of the end, at any offset.
        """
        s, rate, change = self.law.at(stamp_ns)
        place, rest = self._place(s)
        if offset:
            later, rate, change = self.law.at(stamp_ns, offset)
            rest += later - s
        moving = self.followed.near(place, rest, out)
        at_rate(out, rate, change)
        return moving
