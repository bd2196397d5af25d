# SPDX-License-Identifier: Apache-2.0
r"""Recommends the shaper, or the smoothing, that leaves at most the wanted vibration with the smallest delay.

Every candidate is a kernel with which a motion is convolved. The motion then ends later by L and leaves the fraction

.. math:: V(p) = \left|\int_0^L k(\tau)\,e^{p(L-\tau)}\,d\tau\right|

of the vibration of a mode with the pole p. The shapers of `flexarm_control.motions.shapers` are kernels of impulses. A
jerk limit is the kernel 1/W on [0, W], with :math:`V = |(e^{pW} - 1)/(pW)|`: steps of the acceleration become ramps of
the length W. A snap limit consists of two such kernels. None of them increases speeds or accelerations.

For several modes the residual is :math:`\sqrt{\sum_k s_k V_k^2}`. Here :math:`s_k` is the fraction of the vibration's
energy that mode k had in the recording, and :math:`V_k` is the largest V over its spread of frequency and damping.
"""

from dataclasses import dataclass

import numpy as np

from flexarm_control.motions import robust_shapers, shapers
from flexarm_dynamics.errors import FlexarmError

from .time_law import least_exciting_duration

TURN = 2.0 * np.pi
#: Number of points over the spread of the frequency.
POINTS = 41
#: Number of widths of a smoothing that are tried, and the largest in periods of the slowest mode.
WIDTHS, PERIODS = 400, 5.0
#: Name of the shaper by a linear programme, its min. and max. length in periods of the lowest mode, and number of
#: bisection steps to find the length.
ROBUST, SHORTEST, LONGEST, HALVINGS = "robust", 0.25, 3.0, 6
#: Frequencies may be off by this fraction at most, as in the node [-].
WIDEST = 0.5
#: Names of the smoothings, and their numbers of boxes.
SMOOTH = {"jerk_limited": 1, "snap_limited": 2}
BY_PROGRAMME = "least_exciting"


@dataclass(frozen=True)
class Spread:
    """What is known about a mode.

    Attributes
    ----------
    low, high : float
        Frequencies [Hz].
    dampings : tuple of float
        Lowest, middle and highest ratio [-].
    part : float
        Fraction of the vibration's energy [-].
    """

    low: float
    high: float
    dampings: tuple
    part: float

    @property
    def frequency(self):
        """Middle of the frequencies [Hz]."""
        return 0.5 * (self.low + self.high)

    @property
    def damping(self):
        """Middle damping ratio [-]."""
        return self.dampings[1]

    def poles(self):
        """Poles over the spread, shape (k,) [1/s]."""
        omega = TURN * np.linspace(self.low, self.high, POINTS)[:, None]
        zeta = np.array(self.dampings)
        return (omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))).ravel()


@dataclass(frozen=True, eq=False)
class Candidate:
    """A shaper or a smoothing, and its effect.

    Attributes
    ----------
    kind : str
        Of `shapers.SHAPERS`, ``none``, of `SMOOTH`, or ``least_exciting``.
    modes : tuple of int
        Modes for which it is designed; empty for a smoothing.
    delay : float
        Time by which a motion gets longer [s].
    residual : float
        Largest residual over the spread [-].
    nominal : float
        Residual in the middle of the spread [-].
    width : float
        Width of a smoothing's box [s]; 0 for other kinds.
    spread, periods : float
        For ``robust``: fraction by which the frequencies may be off, and length in periods of the lowest mode [-].
    """

    kind: str
    modes: tuple
    delay: float
    residual: float
    nominal: float
    width: float = 0.0
    spread: float = 0.0
    periods: float = 0.0


@dataclass(frozen=True, eq=False)
class Recommendation:
    """The recommendation.

    Attributes
    ----------
    wanted : float
        Wanted residual [-].
    candidates : tuple of Candidate
        Of each kind the quickest that meets the residual, or the best one if none does.
    chosen : Candidate
        The quickest shaper that meets the residual, or the best one if none does.
    """

    wanted: float
    candidates: tuple
    chosen: Candidate

    @property
    def met(self):
        """Whether the chosen one meets the residual."""
        return self.chosen.residual <= self.wanted


def widened(spreads, margin):
    """The `spreads` with frequencies that may be off by a further fraction `margin`."""
    return [
        Spread(s.low * (1.0 - margin), s.high * (1.0 + margin), s.dampings, s.part) for s in spreads
    ]


def recommend(spreads, residual=0.05, move=None) -> Recommendation:
    """The candidates, and the shaper among them that meets the residual with the least delay.

    Parameters
    ----------
    spreads : sequence of Spread
        At least one.
    residual : float
        Wanted residual, above 0, below 1 [-].
    move : Move, optional
        Motion for which the least exciting time law is found; None: it is left out.

    Raises
    ------
    FlexarmError
        If there is no mode, or the residual is out of range.
    """
    if not 0.0 < residual < 1.0:
        raise FlexarmError(
            "is out of range", field="residual", value=residual, limit="above 0, below 1"
        )
    if not spreads:
        raise FlexarmError(
            "nothing rings", field="modes", hint="record the arm after a quick motion"
        )
    spreads = list(spreads)
    found = [_quickest(_shapers(kind, spreads), residual) for kind in shapers.SHAPERS]
    found.append(_robust(spreads, residual))
    chosen = _quickest(found, residual)
    smooth = [_smoothing(kind, spreads, residual) for kind in SMOOTH]
    none = _shaped(shapers.NONE, spreads, ())
    law = [] if move is None else [_least_exciting(spreads, residual, move)]
    return Recommendation(residual, (none, *found, *smooth, *law), chosen)


def _quickest(candidates, residual):
    enough = [c for c in candidates if c.residual <= residual]
    if enough:
        return min(enough, key=lambda c: (c.delay, c.residual))
    return min(candidates, key=lambda c: c.residual)


def _shapers(kind, spreads):
    """One kind of shaper for the most important mode, for the two most important modes, and so on."""
    order = sorted(range(len(spreads)), key=lambda k: -spreads[k].part)
    return [_shaped(kind, spreads, tuple(sorted(order[: k + 1]))) for k in range(len(order))]


def _shaped(kind, spreads, modes):
    train = train_of(kind, [spreads[k] for k in modes])
    return Candidate(kind, modes, train.duration, *_residuals(impulses(train), spreads))


def impulses(train):
    """Response of a `Shaper`'s impulses: a function of poles (k,)."""
    left = lambda poles: np.multiply.outer(poles, train.duration - train.times)  # noqa: E731
    return lambda poles: np.exp(left(poles)) @ train.amplitudes


def _robust(spreads, residual):
    """The shortest robust shaper that meets the residual, designed for the most important mode or for more modes."""
    order = sorted(range(len(spreads)), key=lambda k: -spreads[k].part)
    return _quickest(
        [_robust_for(tuple(sorted(order[: k + 1])), spreads, residual) for k in range(len(order))],
        residual,
    )


def _robust_for(modes, spreads, residual):
    shaped = [spreads[k] for k in modes]
    spread = min(max((s.high - s.low) / (s.high + s.low) for s in shaped), WIDEST)

    def made(periods):
        train = train_of(ROBUST, shaped, spread, periods)
        left = _residuals(impulses(train), spreads)
        return Candidate(ROBUST, modes, train.duration, *left, spread=spread, periods=periods)

    low, high = SHORTEST, LONGEST
    best = made(high)
    if best.residual > residual:
        return best
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        now = made(middle)
        if now.residual <= residual:
            high, best = middle, now
        else:
            low = middle
    return best


def train_of(kind, modes, spread=0.0, periods=1.0):
    """The `Shaper` of a kind for some modes, at the middle of their spreads; a single impulse for no modes.

    Parameters
    ----------
    kind : str
    modes : sequence of Spread
    spread, periods : float
        For ``robust``, as in `Candidate`.
    """
    if kind == ROBUST:
        frequencies, dampings = [m.frequency for m in modes], [m.damping for m in modes]
        return robust_shapers.robust(frequencies, dampings, spread, periods)
    trains = [shapers.impulses(kind, mode.frequency, mode.damping) for mode in modes]
    return shapers.convolve(trains or [shapers.impulses(shapers.NONE, 1.0, 0.0)])


def _residuals(response, spreads):
    """Largest and middle residual of a kernel, given as a function of poles."""
    part = np.array([s.part for s in spreads])
    part = part / part.sum()
    worst = np.array([np.abs(response(s.poles())).max() for s in spreads])
    middle = [
        TURN * s.frequency * complex(-s.damping, np.sqrt(1.0 - s.damping**2)) for s in spreads
    ]
    nominal = np.abs(response(np.array(middle)))
    return tuple(float(np.sqrt(part @ values**2)) for values in (worst, nominal))


def box(width, count=1):
    """Response of `count` boxes of a `width` [s], one after the other: a function of poles (k,)."""
    return lambda poles: (np.expm1(poles * width) / (poles * width)) ** count


def _smoothing(kind, spreads, residual):
    """The narrowest box that meets the residual, or the best."""
    count, slowest = SMOOTH[kind], min(s.low for s in spreads)
    widths = np.linspace(0.0, PERIODS / slowest, WIDTHS + 1)[1:] / count
    made = [Candidate(kind, (), count * w, *_residuals(box(w, count), spreads), w) for w in widths]
    return _quickest(made, residual)


def _least_exciting(spreads, residual, move):
    part = np.array([s.part for s in spreads])
    part = part / part.sum()
    # At poles of modes that hardly contribute, the residual may be larger.
    wanted = residual / np.sqrt(np.maximum(part * len(part), 1e-6))
    poles = [s.poles() for s in spreads]
    longer = PERIODS / min(s.low for s in spreads)
    duration, worst = least_exciting_duration(move, poles, wanted, longer)
    left = float(np.sqrt(part @ np.asarray(worst) ** 2))
    return Candidate(BY_PROGRAMME, (), duration - move.duration, left, left)
