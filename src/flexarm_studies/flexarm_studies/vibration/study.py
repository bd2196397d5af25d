# SPDX-License-Identifier: Apache-2.0
"""Measures residual vibration of arms behind a position loop, for shaped motions and for those of planners.

The shapers know only what a user can measure: frequencies and damping of the ringing after a small, short motion of the
same simulated arm, behind the same drives. The arm files are not used.
"""

from dataclasses import dataclass
from functools import partial
from itertools import combinations_with_replacement

import numpy as np

from flexarm_control.motions.profiles import Motion
from flexarm_control.shaping import limited, time_law
from flexarm_control.shaping import modes as modes_module
from flexarm_control.shaping.modes import Modes
from flexarm_control.shaping.shaped_motion import ShapedMotion
from flexarm_control.shaping.trials import Ringing, Trials
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import check_all

from ..resonance.fit import fit
from . import limit
from .position_arm import PositionArm
from .time_laws import jerk_limited, resampled, trapezoid

#: The kick after which ringing is measured: fraction of the way [-], and duration and recorded time in locked periods.
KICK, KICK_PERIODS, LISTEN = 0.05, 0.8, 14.0
#: Window of the residual, in locked periods.
WINDOW = 1.5
#: Of the shaped modes: min. amplitude over the largest one [-], max. damping ratio [-], and max. number.
AUDIBLE, MAX_DAMPING, MAX_MODES = 0.03, 0.3, 3
#: Modes closer than this fraction count as one.
SAME = 0.12
#: If modes of the two ends of a motion are closer than this fraction, only one of them is used.
ALIKE = 0.02
#: Largest factor by which a mode changes from one configuration on the way to the next.
CHANGE = 2.0
#: The tip is recorded for this much longer than it is evaluated [s].
LATE = 0.02
#: Period of MoveIt's resampling [s], a usual rise time of the acceleration [s], and the tested frequency error [-].
RESAMPLE, RISE, OFF = 0.1, 0.05, 0.15
#: Methods by TOPP-RA and by Ruckig.
QUICKEST = ("toppra", "ruckig, one period")
#: Factors of the frequencies for the methods by a new time law [-].
OFFS = {"retimed": 1.0, "retimed -15 %": 1.0 - OFF, "retimed +15 %": 1.0 + OFF}
#: A path bends aside by this fraction of its largest way [-]. `BENT`: methods for it, the unshaped motion first.
ASIDE = 0.25
BENT = ("trapezoid", "robust, both ends", "robust, both ends -15 %", "robust, both ends +15 %")
METHODS = (
    "trapezoid",
    "TOTG 0.1 s",
    "jerk limit",
    "jerk limit, one period",
    "toppra",
    "ruckig, one period",
    "zvd",
    "robust",
    "robust -15 %",
    "robust +15 %",
    "robust, both ends",
    "robust, both ends -15 %",
    "robust, both ends +15 %",
    "retimed",
    "retimed -15 %",
    "retimed +15 %",
)


@dataclass(frozen=True, eq=False)
class Measured:
    """Modes found in ringing: frequencies [Hz], damping ratios [-]; the mode that rings most comes first."""

    frequencies: np.ndarray
    dampings: np.ndarray


class Shaped(Motion):
    """A `ShapedMotion` as a `Motion`."""

    def __init__(self, shaped):
        self._shaped = shaped
        self.start, self.duration = shaped.motion.start, shaped.end
        self.angle = shaped.motion.angle

    def derivative(self, order, t):
        return self._shaped.states(np.atleast_1d(t))[order]


def measured(arm, at, way, period) -> Measured:
    """Modes of an arm that rings after a kick.

    Parameters
    ----------
    arm : PositionArm
    at, way : (n,) ndarrays
        End of the kick, and the way; the kick is the last part of it, the fraction `KICK` [rad].
    period : float
        Approximate period of the lowest mode [s].
    """
    kick = trapezoid(at - KICK * way, at, KICK_PERIODS * period)
    swing = arm.follow(kick, LISTEN * period)
    ringing = swing.ringing()
    found = fit(ringing / np.abs(ringing).max(), float(swing.time[1] - swing.time[0]))
    sizes = [(np.linalg.norm(m.amplitude), m.frequency, m.damping) for m in found.modes]
    sizes = sorted((s for s in sizes if s[2] <= MAX_DAMPING), reverse=True)
    kept = []
    for size, frequency, damping in sizes:
        apart = all(abs(frequency / f - 1.0) > SAME for f, _ in kept)
        if apart and size >= AUDIBLE * sizes[0][0] and len(kept) < MAX_MODES:
            kept.append((frequency, damping))
    return Measured(*np.array(kept).reshape(-1, 2).T)


def shaped(motion, kind, found, off=1.0):
    """A motion shaped for measured modes.

    Parameters
    ----------
    motion : PiecewiseMotion
    kind : str
        Shaper.
    found : Measured
    off : float
        Factor of the frequencies, that is, their assumed error [-].
    """
    frequencies, dampings = found.frequencies * off, found.dampings
    if kind != modes_module.ROBUST:
        frequencies, dampings = frequencies[:1], dampings[:1]
    settings = {"type": kind, "frequencies": frequencies.tolist(), "dampings": dampings.tolist()}
    modes = Modes(check_all(modes_module.PARAMETERS, settings), motion.start.size)
    return Shaped(ShapedMotion(motion, modes))


def together(found, other) -> Measured:
    """All modes of both ends of a motion; those of `other` that are also in `found` are left out.

    Parameters
    ----------
    found, other : Measured
    """
    new = [
        k
        for k, f in enumerate(other.frequencies)
        if (np.abs(found.frequencies / f - 1.0) > ALIKE).all()
    ]
    return Measured(
        np.append(found.frequencies, other.frequencies[new]),
        np.append(found.dampings, other.dampings[new]),
    )


def rows(found, others, count=None):
    """Modes at several places of a motion as rows, each mode in its own column; by default the max. number at a place.

    Modes keep their order of frequency along the way. If fewer modes are found at a place, two of them are close to
    each other, or one does not ring there; then one mode counts for both. A mode that would change by more than the
    factor `CHANGE` from row to row keeps its values.

    Parameters
    ----------
    found : Measured
        At the end of the motion.
    others : sequence of Measured
        Modes at earlier places, from the end to the start.
    count : int, optional
        Number of modes; the ones with the largest amplitudes are used.

    Returns
    -------
    frequencies, dampings : (c, m) ndarrays
        From the start to the end [Hz], [-].
    """
    places = [*reversed(others), found]
    counts = [place.frequencies.size for place in places]
    count = count or max(counts)
    # Of places with the same number, use the last one: the ringing at the end counts.
    known = max(range(len(places)), key=lambda k: (min(counts[k], count), k))
    made = {known: _ascending(places[known], count)}
    for k in (*range(known - 1, -1, -1), *range(known + 1, len(places))):
        made[k] = _continued(places[k], made[k + 1 if k < known else k - 1], count)
    return tuple(np.stack([made[k] for k in range(len(places))]).transpose(1, 0, 2))


def _continued(place, after, count):
    """The modes of a place that continue those of a row `after` (2, count), (2, count)."""
    if not place.frequencies.size:
        return after
    mode = _ascending(place, count)
    chosen = min(
        (list(c) for c in combinations_with_replacement(range(mode.shape[1]), count)),
        key=lambda c: (-len(set(c)), np.abs(np.log(mode[0, c] / after[0])).sum()),
    )
    far = np.abs(np.log(mode[0, chosen] / after[0])) > np.log(CHANGE)
    return np.where(far, after, mode[:, chosen])


def _ascending(found, count):
    """The `count` modes with the largest amplitudes, by frequency, (2, k)."""
    modes = np.stack([found.frequencies, found.dampings])[:, :count]
    return modes[:, np.argsort(modes[0])]


def retimed(motion, along, off=1.0, periods=1.0):
    """A motion with a new time law for the modes at its start, middle and end.

    Parameters
    ----------
    motion : PiecewiseMotion
    along : tuple of (3, m) ndarrays
        As from `rows`.
    off : float
        Factor of the frequencies, that is, their assumed error [-].
    periods : float
        Time by which the motion may get longer, in periods of the lowest mode.
    """
    modes = _modes(motion, along, off, periods)
    return time_law.retimed(motion, modes) or Shaped(ShapedMotion(motion, modes))


def _modes(motion, along, off, periods=1.0):
    """The `Modes` of `retimed`."""
    frequencies, dampings = along
    where = motion.start + np.linspace(0.0, 1.0, len(frequencies))[:, None] * motion.angle
    settings = {
        "type": modes_module.RETIMED,
        "periods": periods,
        "frequencies": (off * frequencies).ravel().tolist(),
        "dampings": dampings.ravel().tolist(),
        "configurations": where.ravel().tolist(),
    }
    return Modes(check_all(modes_module.PARAMETERS, settings), motion.start.size)


def quickest(motion, rise):
    """The motion's straight path, timed by TOPP-RA and by Ruckig within the motion's speed and acceleration, a dict.

    Parameters
    ----------
    motion : PiecewiseMotion
        A trapezoid of speed.
    rise : float
        Ratio of acceleration to jerk, for Ruckig [s].
    """
    speed, bend = (
        np.abs(motion.derivative(k, motion.knots[1:] - 1e-9)).max(axis=0) for k in (1, 2)
    )
    # A joint that stands still may move a little.
    speed, bend = (np.maximum(values, 1e-6 * values.max()) for values in (speed, bend))
    begin = np.stack([motion.start, 0.0 * motion.start, 0.0 * motion.start])
    found = (
        limited.time_optimal([motion.start, motion.end], speed, bend),
        limited.jerk_limited(begin, motion.end, speed, bend, bend / rise),
    )
    return dict(zip(QUICKEST, found, strict=True))


def candidates(motion, found, middle, other, methods=METHODS):
    """The motion made by each of some `METHODS`, a dict.

    Parameters
    ----------
    motion : PiecewiseMotion
    found, middle, other : Measured
        Modes at its end, half-way, and at its start.
    methods : sequence of str
    """
    lowest, both = 1.0 / found.frequencies.min(), together(found, other)
    along = rows(found, (middle, other))
    makers = {
        "trapezoid": lambda: motion,
        "TOTG 0.1 s": lambda: resampled(motion, RESAMPLE),
        "jerk limit": lambda: jerk_limited(motion, RISE),
        "jerk limit, one period": lambda: jerk_limited(motion, lowest),
        **{name: partial(_quickest, motion, lowest, name) for name in QUICKEST},
        "zvd": lambda: shaped(motion, "zvd", found),
        "robust": lambda: shaped(motion, "robust", found),
        "robust -15 %": lambda: shaped(motion, "robust", found, 1.0 - OFF),
        "robust +15 %": lambda: shaped(motion, "robust", found, 1.0 + OFF),
        "robust, both ends": lambda: shaped(motion, "robust", both),
        "robust, both ends -15 %": lambda: shaped(motion, "robust", both, 1.0 - OFF),
        "robust, both ends +15 %": lambda: shaped(motion, "robust", both, 1.0 + OFF),
        **{name: partial(retimed, motion, along, off) for name, off in OFFS.items()},
    }
    return {name: makers[name]() for name in METHODS if name in methods}


def _quickest(motion, rise, name):
    return quickest(motion, rise)[name]


def run(case, methods=METHODS):
    """Residuals of all motions of a case.

    Parameters
    ----------
    case : cases.Case
    methods : sequence of str
        Some of `METHODS`, the first among them.

    Returns
    -------
    list of dict
        A row for each motion and method.
    """
    arm, out = _arm(case), []
    for number, motion in enumerate(case.motions):
        found = measured(arm, motion.end, motion.angle, case.period)
        if not found.frequencies.size:
            out += _left(arm, case, number, found, {})
            continue
        other = measured(arm, motion.start, -motion.angle, case.period)
        middle = measured(arm, 0.5 * (motion.start + motion.end), motion.angle, case.period)
        made = candidates(motion, found, middle, other, methods)
        out += _left(arm, case, number, found, made)
    return out


def run_bent(case):
    """Residuals of the quickest motions by TOPP-RA along paths that bend, between the ends of a case's motions.

    Parameters
    ----------
    case : cases.Case

    Returns
    -------
    list of dict
        As from `run`, for the methods `BENT`; none for an arm with one joint.
    """
    arm, out = _arm(case), []
    for number, motion in enumerate(case.motions):
        if motion.start.size == 1:
            continue
        given = bent(motion)
        # The kicks' ways are as long as the motion's way: forwards to the path's end, and backwards to its start.
        first, last = (given.position(t * given.duration) for t in np.array([[0.1], [0.9]]))
        size = np.linalg.norm(motion.angle)
        ways = [
            w / np.linalg.norm(w) * size for w in (motion.end - last[0], motion.start - first[0])
        ]
        found, other = (
            measured(arm, at, way, case.period)
            for at, way in zip((motion.end, motion.start), ways, strict=True)
        )
        both = together(found, other)
        offs = zip(BENT[1:], (1.0, 1.0 - OFF, 1.0 + OFF), strict=True)
        made = {BENT[0]: given, **{name: shaped(given, "robust", both, off) for name, off in offs}}
        out += _left(arm, case, number, found, made if found.frequencies.size else {})
    return out


def bent(motion):
    """The quickest motion by TOPP-RA from start to end on a path that bends aside by `ASIDE` of the largest way.

    All joints stay within the largest speed and acceleration of any of them in the given motion.

    Parameters
    ----------
    motion : PiecewiseMotion
        A trapezoid of speed of two joints at least.
    """
    way = motion.angle
    aside = np.where(np.arange(way.size) % 2, -1.0, 1.0)
    aside -= (aside @ way) / (way @ way) * way
    aside *= ASIDE * np.abs(way).max() / np.abs(aside).max()
    points = [motion.start, 0.5 * (motion.start + motion.end) + aside, motion.end]
    speed, bend = (
        np.full(way.size, np.abs(motion.derivative(k, motion.knots[1:] - 1e-9)).max())
        for k in (1, 2)
    )
    return limited.time_optimal(points, speed, bend)


def _arm(case):
    """The arm of a case behind its drives."""
    known, plant = model.build(case.known), model.build(case.plant)
    return PositionArm(known, plant, 2.0 * np.pi / case.period)


def _left(arm, case, number, found, made):
    """Rows of `run` for one motion: one for each method of `made`; a row without a method if there is none."""
    common = {
        "arm": case.name,
        "motion": number,
        "frequencies": found.frequencies.tolist(),
        "dampings": found.dampings.tolist(),
    }
    if not made:
        return [{**common, "method": ""}]
    out, duration = [], next(iter(made.values())).duration
    for method, given in made.items():
        swing = arm.follow(given, WINDOW * case.period)
        out.append(
            {
                **common,
                "method": method,
                "residual": swing.residual(WINDOW * case.period),
                "added": float((given.duration - duration) * found.frequencies.min()),
                "saturated": swing.saturated,
            }
        )
    return out


def in_more_time(case, number, times):
    """What `retimed` leaves of a motion of a case if it may get longer by more than a period.

    Parameters
    ----------
    case : cases.Case
    number : int
        Of the motion.
    times : sequence of float
        Periods of the lowest mode that are added, each at most 3.

    Returns
    -------
    list of float
        Residual over that of the trapezoid for each of `times` [-].
    """
    arm, motion, _, along, unshaped = _prepared(case, number)
    window = WINDOW * case.period
    given = (retimed(motion, along, periods=periods) for periods in times)
    return [arm.follow(each, window).residual(window) / unshaped for each in given]


def at_more_places(case, number, counts, off=1.0):
    """What `retimed` leaves of a motion of a case whose modes are measured at more places of the way.

    Parameters
    ----------
    case : cases.Case
    number : int
        Of the motion.
    counts : sequence of int
        Numbers of places from start to end, including both.
    off : float
        Factor of the frequencies, that is, their assumed error [-].

    Returns
    -------
    list of float
        Residual over that of the trapezoid for each of `counts` [-].
    """
    arm, motion, window = _arm(case), case.motions[number], WINDOW * case.period
    unshaped, left = arm.follow(motion, window).residual(window), []
    for count in counts:
        found = [
            measured(
                arm,
                motion.end - part * motion.angle,
                (1.0 if part < 1.0 else -1.0) * motion.angle,
                case.period,
            )
            for part in np.linspace(0.0, 1.0, count)
        ]
        given = retimed(motion, rows(found[0], found[1:]), off)
        left.append(arm.follow(given, window).residual(window) / unshaped)
    return left


def at_least(case, number):
    """What `retimed` leaves of a motion of a case, and the least that was found for a time law of the same length.

    Parameters
    ----------
    case : cases.Case
    number : int
        Of the motion.

    Returns
    -------
    unshaped, left, least : float
        [m]

    Raises
    ------
    DesignError
        If there is no new time law for the motion.
    """
    arm, motion, _, along, unshaped = _prepared(case, number)
    found = time_law.solved(motion, _modes(motion, along, 1.0))
    if found is None:
        raise DesignError("has no time law for its modes", field=f"{case.name}, motion {number}")
    law, _, x = found
    left, least, _ = limit.least(arm, law, x, WINDOW * case.period)
    return unshaped, left, least


def _prepared(case, number, at_end=False):
    """The arm of a case, a motion by its number, the modes at its end and along it, and what it leaves [m].

    With `at_end`, only as many modes are used along the motion as ring at its end, because the ringing after a trial
    shows only these.
    """
    arm, motion = _arm(case), case.motions[number]
    end = measured(arm, motion.end, motion.angle, case.period)
    start = measured(arm, motion.start, -motion.angle, case.period)
    middle = measured(arm, 0.5 * (motion.start + motion.end), motion.angle, case.period)
    unshaped = arm.follow(motion, WINDOW * case.period).residual(WINDOW * case.period)
    count = end.frequencies.size if at_end else None
    return arm, motion, end, rows(end, (middle, start), count), unshaped


def in_trials(case, number, count, off=1.0):
    """What `retimed` leaves of a motion of a case that is repeated and corrected by its own ringing.

    Parameters
    ----------
    case : cases.Case
    number : int
        Of the motion.
    count : int
        Number of trials with a correction.
    off : float
        Factor of the frequencies, that is, their assumed error [-].

    Returns
    -------
    list of float
        The least residual over that of the trapezoid, before the first correction and after each [-].
    """
    arm, motion, end, along, unshaped = _prepared(case, number, at_end=True)
    order = np.argsort(end.frequencies)
    ringing = Ringing(end.frequencies[order], end.dampings[order])
    look = max(WINDOW * case.period, ringing.window) + LATE
    kick = trapezoid(motion.end - KICK * motion.angle, motion.end, KICK_PERIODS * case.period)
    answer = ringing.answer(kick, motion, *_after(arm.follow(kick, look)))
    trials = Trials(motion, _modes(motion, along, off), ringing, answer)
    least = []
    for _ in range(count + 1):
        swing = arm.follow(trials.motion, look)
        trials.took(*_after(swing), swing.residual(WINDOW * case.period) / unshaped)
        least.append(trials.least)
    return least


def _after(swing):
    """Times from the end of a motion [s], and the tip then [m]."""
    after = swing.time >= swing.end
    return swing.time[after] - swing.end, swing.tip[after]
