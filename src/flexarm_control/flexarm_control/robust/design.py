# SPDX-License-Identifier: Apache-2.0
r"""Gains for an arm that is not quite what its file says.

The control is of fixed structure: stiffness, damping and integral of each joint (`slow.type: joint_pid`) and a
constant feedback of modal amplitudes and rates (`fast.type: fixed_gain`), both about the motion of the feed-forward.
Its gains are found for a set of sampled loops at once (multi-model design): payload, stiffness, damping, loop gain,
delay and configuration vary, the arm has one mode more per direction than the file, and filters and delay are part of
each loop (`loop`). What is made as fast as possible is the slowest pole of them all (`decay`), found by BFGS on the
nonsmooth function (`nonsmooth`) from several starts. The noise that the gains pass on to the torque is bounded.

The literature knows this as static output feedback by minimisation of the spectral abscissa (Burke, Henrion, Lewis &
Overton 2006, HIFOO; Ackermann 1980 for the multi-model idea).
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models import levels
from flexarm_dynamics.models.fixed_step import substeps
from flexarm_dynamics.models.model import build

from ..fading import lowest
from ..feedforward.model import METHOD
from ..low_pass import POLES
from ..schedule import matters
from .decay import Slowest, SlowestScheduled, Wanted
from .further import LEAST, later, leaving_less
from .held import held_loops
from .loop import ARM, STICKS, Sampling
from .noise import Noise
from .recovery import Recovery, recovery
from .search import ROUNDS, STARTS, TOGETHER, Search, follow, nearby, race, start
from .uncertain import (
    Uncertainty,
    configurations,
    own_damping,
    reach,
    resting,
    uncertain_loops,
)

#: Corner of the filtered derivatives over omega_c, at most one radian per sample; of a fast arm, for which the lag of
#: such a filter counts, at least so many times omega_1, at most two radians per sample.
FILTER, FAST_ARM, PER_SAMPLE = 2.0, 15.0, 2.0
#: Corners of the torque's low pass that are tried, over omega_1; infinite: none.
LOW_PASS = (np.inf, 20.0, 8.0, 4.0)
#: A low pass costs margins of gain and phase, and is taken where it makes the decay larger by more than this factor.
SLUGGISH = 1.25
#: The controller's own check has neither filters nor delay, which the design has.
UNCHECKED = -1000.0
#: Beside a period a torque is under way for so long between processes [s].
TRANSPORT = 1e-3
#: A pole is hardly in reach of the torque where one unit of all gains changes its value by less than this [-], and fast
#: for the loop where the torque's delay turns it by more than this [rad].
HARDLY, FAST = 1.0, 0.5
#: Why a design has a lower speed than was asked.
FROM_LIMITS = "an arm with faster gains would not come back from them in time"
#: Where scheduled gains reach less of the decay than this, low passes are tried that end the torque's reach: of faster
#: modes only their own damping is asked. Taken where the decay is so many times larger [-].
POOR, WORTH = 0.25, 1.2
#: Where those reach less than this, one set for all is tried, too; the same without them, where that is below
#: `further.LEAST`, or below this if there are no such low passes [-].
LITTLE = 0.08
#: Where the decay that is reached is less than this, the search goes on from gains nearby, at most so many times, and
#: looks at arms of which payload or stiffness alone differs, too. Then it does so for the loops that do not limit the
#: others, which keep this decay [-].
SLOW, TRIES, KEPT = 0.2, 6, 0.055
#: Finite slopes take long to compute: the feed-forward has them where its steps per sample, times modes, are no more.
QUICK = 12
#: It has one mode more than the file where the fastest frequency is then at most so many times the lowest one, with the
#: joints locked: a plan is integrated in steps of the fastest one [-].
SPREAD = 2000.0
#: Where a loop does not come back from its torque limits (`recovery`), designs of these parts of the speed are made.
SLOWER = (0.7, 0.5, 0.35)
#: A lower speed counts as this one.
SLOWEST = 0.05
#: Of the progress, the end of the first design, which slower ones may follow. Of each design, the end of the usual
#: search, of what is tried where that reaches little, and of what is nearby.
FIRST, USUAL, OTHERWISE, NEARBY = 0.7, 0.6, 0.8, 0.9
#: Part of the file's Coulomb friction that is cancelled: friction may be less by a fifth. Less where, until the torque
#: can answer, friction would move a joint farther than this [rad]: cancelled, it would make such a joint hunt.
CANCELLED, KICK = 0.8, np.radians(0.1)
#: Decay over omega_1, and noise over the torque limit, that the fastest design looks for.
FASTEST, NOISIEST = 0.6, 0.03
#: `slow.return_rate` over omega_1. A joint that sticks goes back by gamma / (1 - gamma) of that, with the part gamma of
#: its friction cancelled: as fast as the fastest decay. More would hold it so stiffly that it damps no link any more.
RETURN = FASTEST * (1.0 - CANCELLED) / CANCELLED
#: Part of the friction that is overcome where a joint sticks, and `slow.breakaway_rate` over omega_1: at twice that a
#: light hub hunted.
BREAKAWAY, BREAKAWAY_RATE = 0.95, 0.5


@dataclass(frozen=True)
class Settings:
    """How the loop runs, and how long a design may take.

    Attributes
    ----------
    rate : float
        Samples per second [Hz].
    delay : float
        From a measurement until its torque acts [s]; not given: one period and `TRANSPORT`.
    speed : float
        From 0 to 1: how much decay is looked for, and how much noise the torque may have for it. 1: `FASTEST` and
        `NOISIEST`, the rms torque of the sensors' noise over the torque limit.
    configurations : tuple of tuple of float
        Where the arm moves [rad]; none: drawn from its position limits.
    effort : float
        Of the search; 1.0 is the default.
    seed : int
        Of the starts.
    feedforward : str
        Name of the feed-forward that the controller file takes; the gains do not depend on it.
    """

    rate: float = 1000.0
    delay: float | None = None
    speed: float = 1.0
    configurations: tuple = ()
    effort: float = 1.0
    seed: int = 0
    feedforward: str = "preview"

    def __post_init__(self):
        if self.delay is None:
            object.__setattr__(self, "delay", 1.0 / self.rate + TRANSPORT)


class SlowPole(NamedTuple):
    """The slowest pole of a loop, relative to what is asked of it."""

    name: str  # of the loop
    pole: complex  # [1/s]
    value: float  # minus its decay over what is asked of it [-]
    kind: str = ARM  # of the loop


@dataclass(frozen=True)
class Design:
    """Gains, and what they were found to do.

    Attributes
    ----------
    K : ndarray, shape (n, 3n + 2m)
        u = -K (q, qd, -w, delta, delta_d); where they are scheduled, those of the first configuration.
    decay : float
        Slowest decay of all poles that gains move, over what is wanted of them [-]; negative: unstable.
    omega_1 : float
        Lowest bending frequency with the joints locked [rad/s].
    omega_c : float
        Frequency up to which torque reaches a mode [rad/s].
    configurations : ndarray, shape (k, n)
        [rad]
    slowest : tuple of SlowPole
        Of each loop.
    left : tuple of float
        Frequencies of modes that no gain moves, at the first configuration [rad/s].
    noise : tuple of float
        Of each joint: rms torque of the sensors' noise over the torque limit [-].
    slope : float
        By how much one unit of all gains changes the value of the slowest pole [-].
    sets : ndarray, shape (k, n, 3n + 2m)
        One set of gains for all configurations, or one for each; see `flexarm_control.schedule`.
    recovery : Recovery or None
        From motions that take nearly all torque; None: not looked at.
    slowed : bool
        Whether its speed is lower than asked, because faster gains would not come back from the torque limits.
    """

    arm: object
    settings: Settings
    uncertainty: Uncertainty
    sampling: Sampling
    K: np.ndarray
    decay: float
    omega_1: float
    omega_c: float
    configurations: np.ndarray
    slowest: tuple = ()
    left: tuple = ()
    evaluations: int = 0
    noise: tuple = field(default=())
    slope: float = np.inf
    sets: np.ndarray | None = None
    recovery: Recovery | None = None
    slowed: bool = False

    def __post_init__(self):
        if self.sets is None:
            object.__setattr__(self, "sets", self.K[None])

    @property
    def reached(self):
        """The least decay over what is asked, of the arms with other payloads and stiffnesses alone [-]."""
        return -max(row.value for row in self.slowest if row.kind == ARM)

    @property
    def worst(self):
        """The `SlowPole` of the loop that is the slowest of all, relative to what is asked of it."""
        return max(self.slowest, key=lambda row: row.value)

    @property
    def scheduled(self):
        """Whether there is a set of gains for each configuration."""
        return len(self.sets) > 1

    def gains_at(self, number):
        """K of a configuration, by its number from 0, (n, 3n + 2m)."""
        return self.sets[number if self.scheduled else 0]

    def loops(self):
        """The loops that the design is for, each with its gains: pairs of `Loop` and K."""
        loops, weights = held_loops(
            build(self.arm.known),
            self.configurations,
            self.sampling,
            self.uncertainty,
            len(self.sets),
        )
        return [
            (loop, np.tensordot(w, self.sets, 1)) for loop, w in zip(loops, weights, strict=True)
        ]

    @property
    def holds(self):
        """Whether all loops are stable."""
        return self.decay > 0.0

    @property
    def comes_back(self):
        """Whether it comes back from the torque limits, as far as that was looked at."""
        return self.recovery is None or self.recovery.comes_back

    def check(self):
        """Refuse a design that does not hold.

        Raises
        ------
        DesignError
            With the loop and the pole that are in the way, and what would help.
        """
        if not self.holds:
            problem = in_the_way(self)
            raise DesignError(
                problem, field=f"controller of {self.arm.name}", hint=what_helps(self)
            )

    def parameters(self):
        """Flat parameters of the three nodes."""
        n = len(self.arm.joints)
        K = self.sets
        finite = np.isfinite(self.sampling.torque_corner)
        corner = numbers([self.sampling.torque_corner])[0] if finite else 0.0
        at = {"schedule": numbers(self.configurations)} if self.scheduled else {}
        friction = {}
        if any(self.sampling.friction):
            friction["slow.friction"] = numbers(self.sampling.friction)
            friction["slow.return_rate"] = numbers([self.sampling.return_rate])[0]
            friction["slow.breakaway"] = numbers(self.sampling.breakaway)
            friction["slow.breakaway_rate"] = numbers([self.sampling.breakaway_rate])[0]
        out = {
            "rate": self.settings.rate,
            "stability_margin": UNCHECKED,
            "feedforward": self.settings.feedforward,
            **of_feedforward(self.arm.known, self.settings.rate),
            "saturation": "together",
            "motion_velocity_bandwidth": numbers([self.sampling.joint_corner])[0],
            "motion_rate_bandwidth": numbers([self.sampling.modal_corner])[0],
            "slow.type": "joint_pid",
            "slow.stiffness": numbers([np.diag(one[:, :n]) for one in K]),
            "slow.damping": numbers([np.diag(one[:, n : 2 * n]) for one in K]),
            "slow.integral": numbers([np.diag(one[:, 2 * n : 3 * n]) for one in K]),
            **{f"slow.{name}": values for name, values in at.items()},
            "slow.bandwidth": corner,
            **friction,
            "fast.type": "none",
        }
        if K.shape[2] > 3 * n:
            out["fast.type"] = "fixed_gain"
            out["fast.gain"] = numbers(-K[:, :, 3 * n :])
            out |= {f"fast.{name}": values for name, values in at.items()}
            out["fast.configuration"] = numbers(self.configurations[0])
            out["fast.bandwidth"] = corner
        return out | {"manifold.type": "reference"} | observer_parameters(self.sampling)


def numbers(values):
    """A list of numbers as parameters have them: six digits."""
    return [float(f"{v:.6g}") for v in np.ravel(values)]


def of_feedforward(arm, rate):
    """What the feed-forward is to know of an arm beyond its file, flat parameters.

    One mode more per direction, for what the file's modes leave out of the links' compliance: of several links with one
    mode each, the next frequencies are 10 to 20 % too high. Not where that mode is too fast, `SPREAD`. And as much of
    the kinematics of bending as the arm's loads need, within `levels.TOLERANCE` of its reach.
    """
    if not arm.most_modes:
        return {"feedforward_modes": 0, "feedforward_level": "file"}
    modes = arm.most_modes + 1
    model = build(arm.fuller(modes, False, False))
    omega = model.frequencies(np.zeros(model.n_joints), locked=True)
    if omega[-1] > SPREAD * omega[0]:
        modes = 0
    level = levels.level_of(levels.simulated(arm, negligible=levels.TOLERANCE * arm.reach))
    if level == levels.FINITE_SLOPE:
        model = build(arm.fuller(modes, True, True))
        if model.n_modes * substeps(model, 1.0 / rate, METHOD) > QUICK:
            level = levels.STIFFENING
    if level == levels.level_of(arm):
        level = "file"
    return {"feedforward_modes": modes, "feedforward_level": level}


def observer_parameters(sampling):
    """Flat parameters of the observer that belongs to a `Sampling`."""
    modal, joint = numbers([sampling.modal_corner, sampling.joint_corner])
    return {
        "observer.type": "filtered_derivative",
        "observer.bandwidth": modal,
        "observer.joint_velocity_bandwidth": joint,
        "observer.measured_velocity": False,
    }


def in_the_way(found):
    """Which loop no gains were found for, and by which pole, in words."""
    name, pole, *_ = found.worst
    return (
        f"no gains hold all of it: the best found lets a pole at {abs(pole) / (2.0 * np.pi):.3g} Hz grow at"
        f" {pole.real:.3g} 1/s with {name}"
    )


def what_limits(found):
    """Why the slowest pole of a design that holds is no faster, in words."""
    pole = found.worst.pole
    hertz, lag = abs(pole) / (2.0 * np.pi), _lag(found, pole)
    if found.worst.kind == STICKS and abs(pole) < found.omega_1:
        return "friction: a joint that sticks creeps to its place, and only the integral moves it"
    if lag > FAST:
        return (
            f"delay: the torque for this mode of {hertz:.3g} Hz is {np.degrees(lag):.0f} degrees late; a higher rate"
            " or a shorter delay helps"
        )
    if found.slope < HARDLY:
        return f"reach: torque hardly moves this mode of {hertz:.3g} Hz"
    speed = max(found.settings.speed, SLOWEST)
    noisy = max(found.noise, default=0.0) > 0.9 * speed * NOISIEST
    enough = found.decay > 0.95 * speed * FASTEST
    if found.slowed and (noisy or enough):  # a lower speed also allows less noise
        return f"torque limits: {FROM_LIMITS}"
    if noisy:
        return "noise: faster joints would pass more of it on to the torque"
    if enough:
        return "nothing: a higher speed asks more"
    return "several loops at once: what makes one of them faster makes another one slower"


def _lag(found, pole):
    """By how much the delay turns the torque for a mode [rad]."""
    return abs(pole) * (found.sampling.delay + 0.5 * found.sampling.period)


def what_helps(found):
    """What to try, for the slowest pole of a design that does not hold."""
    pole = found.worst.pole
    if _lag(found, pole) > FAST:
        return (
            "sample faster or shorten the delay: this pole is too fast for the loop; a rotor_inertia in the arm file"
            " slows it"
        )
    if any(found.arm.gravity) and abs(pole) < found.omega_1:
        return (
            "narrow the payload or the configurations (of a node design.payload and design.configurations, of the"
            " command --payload and --at): gravity turns the arm over faster than its bending lets the joints hold"
        )
    return (
        "narrow payload and stiffness, give the configurations that the arm moves in, or a larger effort"
        " (of a node design.payload and so on, of the command --payload, --stiffness, --at, --effort)"
    )


def places(nominal, settings):
    """Configurations that a design is for, those of the `settings` or drawn, (k, n) [rad]."""
    given = settings.configurations or configurations(nominal.arm, settings.seed)
    return resting(nominal, given)


def sampling_for(nominal, at, settings):
    """How the loop samples, with the corners of its filters; and omega_c [rad/s]. It takes no search."""
    h = 1.0 / settings.rate
    omega_c = reach(nominal, at, settings.delay + 0.5 * h)
    corner = min(settings.rate, FILTER * omega_c)
    omega_1 = lowest(nominal)
    corner = max(corner, min(PER_SAMPLE * settings.rate, FAST_ARM * omega_1))
    friction = cancelled(nominal, at, h + settings.delay)
    rates = {"return_rate": RETURN * omega_1, "breakaway_rate": BREAKAWAY_RATE * omega_1}
    overcome = tuple(BREAKAWAY if part else 0.0 for part in friction)
    samples = Sampling(
        h, settings.delay, corner, corner, np.inf, friction, breakaway=overcome, **rates
    )
    return samples, omega_c


def cancelled(model, at, late):
    r"""Part of each joint's Coulomb friction that a control may cancel, as a tuple; 0.0 where it has none.

    .. math:: \gamma_i = 0.8\min\Bigl(1, \frac{0.1^\circ}{f_{c,i}\,H_{ii}\,\tau^2}\Bigr)

    with H the inverse of the mass matrix: when a joint breaks loose only its hub moves at first, and the torque that
    cancels turns around after :math:`\tau`.

    Parameters
    ----------
    model : ArmModel
    at : ndarray, shape (k, n)
        Configurations [rad].
    late : float
        From a joint's turning around until the torque's [s].
    """
    n, coulomb = model.n_joints, model.friction_table()[:, 1]
    H = np.max([np.diag(np.linalg.inv(model.terms(q, np.zeros(n)).M))[:n] for q in at], axis=0)
    kick = np.maximum(coulomb * H * late**2, KICK)
    return tuple((np.where(coulomb > 0.0, CANCELLED, 0.0) * KICK / kick).tolist())


def design(arm, settings=None, uncertainty=None, progress=None, gains=None):
    """Gains for an arm file's arm.

    If the arm would not come back from its torque limits (`recovery`), slower gains are looked for: `SLOWER`.

    Parameters
    ----------
    arm : Arm
    settings : Settings, optional
    uncertainty : Uncertainty, optional
    progress : callable, optional
        Called with a fraction of the work and the decay that is reached.
    gains : ndarray, shape (n, 3n + 2m), optional
        To start from as well.

    Returns
    -------
    Design
        The best that was found, also where it is not stable: see its `decay`. Its `settings` have the speed that was
        taken.

    Raises
    ------
    DesignError
        Where the arm rests in no configuration, or has nothing to measure its bending by.
    """
    settings, uncertainty = settings or Settings(), uncertainty or Uncertainty()
    say = _Progress(progress)
    found = design_at(arm, settings, uncertainty, say.part(0.0, FIRST), gains)
    for k, part in enumerate(SLOWER):
        slower = replace(settings, speed=part * settings.speed)
        if found.comes_back or slower.speed < SLOWEST:
            break
        begin = FIRST + (1.0 - FIRST) * k / len(SLOWER)
        now = say.part(begin, begin + (1.0 - FIRST) / len(SLOWER))
        # From starts of its own: gains that ask for much torque would stay so.
        other = design_at(arm, slower, uncertainty, now, asked=settings.speed)
        if other.holds and (other.comes_back or other.recovery.limited < found.recovery.limited):
            found = replace(other, slowed=True)
    say.part(0.0, 1.0)(1.0, found.decay)
    return found


def design_at(arm, settings, uncertainty, progress=None, gains=None, asked=None):
    """A `Design` of the speed that is given, whether or not it comes back from the torque limits.

    Parameters
    ----------
    arm, settings, uncertainty, progress, gains
        As of `design`.
    asked : float, optional
        The speed that was asked, from which torque limits have lowered that of the settings [-].

    Returns
    -------
    Design
    """
    task, say = Task(arm, settings, uncertainty), _Progress(progress)
    found = task.found(say.part(0.0, USUAL), gains, -np.inf)
    if found.decay < POOR * task.speed:
        short, other = Task(arm, settings, uncertainty, short=True), None
        if short.low_passes:
            other = short.found(say.part(USUAL, OTHERWISE), gains, LITTLE)
        reached = other.decay if other is not None else -np.inf
        if max(found.decay, reached) < (LEAST if short.low_passes else LITTLE):
            found = task.found_alone(say.part(USUAL, OTHERWISE), gains, found)
        if reached > max(WORTH * found.decay, 0.0):
            task, found = short, other
    if found.decay < SLOW * task.speed:
        task = Task(arm, settings, replace(uncertainty, edges=True), task.short)
        found = task.from_nearby(say.part(OTHERWISE, NEARBY), found)
    made = task.design(found)
    if found.decay > 0.0 and task.nominal.n_modes:
        edged = Task(arm, settings, replace(uncertainty, edges=True), task.short)
        other = leaving_less(edged, found, say.part(NEARBY, 1.0), asked)
        if other is not None:
            sooner = edged.design(other)
            if not later(sooner.recovery, made.recovery):
                made = sooner
    say.part(0.0, 1.0)(1.0, made.decay)
    return made


class _Progress:
    """Fractions of a whole work from those of its parts: they do not fall."""

    def __init__(self, progress):
        self._progress, self._most = progress, 0.0

    def part(self, begin, end):
        """Takes the fraction of a part, and the decay that is reached."""

        def say(fraction, decay):
            self._most = max(self._most, begin + (end - begin) * fraction)
            if self._progress is not None:
                self._progress(self._most, decay)

        return say


class Sets(NamedTuple):
    """Gains of each configuration, and what they do."""

    K: np.ndarray  # (k, n, 3n + 2m); one set, or one for each configuration
    sampling: Sampling
    rows: tuple  # of `Design.slowest`
    left: tuple
    noise: np.ndarray  # (n,)
    slope: float
    evaluations: float

    @property
    def decay(self):
        """Of the slowest pole, over what is wanted [-]."""
        return -max(row.value for row in self.rows)


class Task:
    """One design: what is searched, in one set of gains or in several.

    Parameters
    ----------
    arm : Arm
    settings : Settings
    uncertainty : Uncertainty
    short : bool
        Whether the torque has low passes that end its reach, and no others.

    Attributes
    ----------
    nominal : ArmModel
        Of the arm as the control knows it.
    at : ndarray, shape (k, n)
        Configurations [rad].
    speed : float
        Of the settings, and at least `SLOWEST` [-].
    low_passes : tuple of float
        Corners that are tried, over omega_1; if `short`, those below omega_c: there may be none.
    """

    def __init__(self, arm, settings, uncertainty, short=False):
        self.short = short
        self.arm, self.settings, self.uncertainty = arm, settings, uncertainty
        self.nominal = nominal = build(arm.known)
        self.at = at = places(nominal, settings)
        if not matters(nominal).any():
            self.at = at[:1]  # the same loops everywhere
        self.omega_1 = lowest(nominal)
        self.sampling, self.omega_c = sampling_for(nominal, self.at, settings)
        self.low_passes = tuple(
            factor for factor in LOW_PASS if not short or factor * self.omega_1 < self.omega_c
        )
        self.wanted = Wanted(self.omega_1, self.omega_c, own_damping(arm, uncertainty))
        self.scale = units(nominal, self.at, self.omega_1)
        self.speed = max(settings.speed, SLOWEST)

    def found(self, progress, gains, enough):
        """A set for each configuration; where these reach less than `enough`, one for all may be better."""
        if len(self.at) == 1:
            return self.alone(progress, gains)
        sets = self.scheduled(progress, gains)
        return sets if sets.decay >= enough else self.found_alone(progress, gains, sets)

    def found_alone(self, progress, gains, sets):
        """The better one of `sets` and of one set for all, from which one for each configuration goes on."""
        if len(self.at) == 1:
            return sets
        alone = self.alone(progress, gains)
        if alone.decay < sets.decay:
            return sets
        each = np.repeat(alone.K, len(self.at), axis=0)
        more = self._together(each, alone.sampling, alone.evaluations)
        return more if more.decay > alone.decay else alone

    def alone(self, progress, gains):
        """One set for all configurations."""
        searches = self._searches(self.at, gains)
        chosen, x = race(searches, self.settings.effort, progress)
        search, used = searches[chosen][0], sum(one.evaluations for one, _ in searches)
        if len(self.at) == 1:
            return self.sets(search, x, used)
        return self._together(search.slowest.gains(x)[None], search.sampling, used)

    def scheduled(self, progress, gains):
        """A set for each configuration: a race in the first one, the others from the best of those found."""
        count = len(self.at)

        def say(fraction, decay):
            if progress is not None:
                progress(fraction / count, decay)

        searches = self._searches(self.at[:1], gains)
        chosen, x = race(searches, self.settings.effort, say)
        found, used = [(searches[chosen][0], x)], sum(one.evaluations for one, _ in searches)
        for k in range(1, count):
            low_pass = self.low_passes[chosen]
            search, starts = self._search(low_pass, self.at[k : k + 1], k + 1)
            near = min((x for _, x in found), key=search.value)
            found.append((search, follow(search, [near, starts[0]], self.settings.effort)))
            used += search.evaluations
            if progress is not None:
                progress((k + 1) / count, -max(one.value(x) for one, x in found))
        K = np.array([search.slowest.gains(x) for search, x in found])
        return self._together(K, searches[chosen][0].sampling, used)

    def _together(self, K, sampling, used):
        """`Sets` that hold between the configurations, too, from gains K (1 or k, n, 3n + 2m) that hold in them."""
        loops, weights = self.held(sampling, len(K))
        search = whole = self.search_of(loops, weights, sampling)
        x, relaxed = whole.slowest.scaled(K), set()
        for _ in range(ROUNDS):
            x = search.refined(x, self.settings.effort * TOGETHER)[1]
            used += search.evaluations
            asked, near = search.relaxed(x, relaxed)
            relaxed |= near
            if asked is None:
                break
            search = self.search_of(asked, weights, sampling)
        return self.sets(whole, x, used)

    def from_nearby(self, progress, found):
        """The best of what the search reaches from the gains that were `found` and nearby, see `nearby`."""
        loops, weights = self.held(found.sampling, len(found.K))
        whole = self.search_of(loops, weights, found.sampling)
        x, used = whole.slowest.scaled(found.K), found.evaluations
        rest = round(TRIES * self.settings.effort), SLOW * self.speed, self.settings.seed, progress
        value, x = nearby(whole, x, *rest)
        asked, _ = whole.relaxed(x, least=KEPT)
        if asked is not None and value > -SLOW * self.speed:
            others = self.search_of(asked, weights, found.sampling)
            _, x = nearby(others, x, *rest)
            used += others.evaluations
        return self.sets(whole, x, used + whole.evaluations)

    def held(self, sampling, count):
        """Loops at and between the configurations, and the weights of `count` sets of gains in each."""
        return held_loops(self.nominal, self.at, sampling, self.uncertainty, count)

    def search_of(self, loops, weights, sampling):
        """The `Search` for sets of gains, of which each of the loops has the mean with `weights` of its own."""
        wanted = self._wanted(sampling.torque_corner)
        slowest = SlowestScheduled(loops, wanted, self.scale, weights)
        noise = Noise(slowest, self.nominal, sampling, self.speed * NOISIEST, self.omega_1)
        return Search(slowest, noise, self.speed * FASTEST, sampling=sampling)

    def _wanted(self, corner):
        """What is asked of poles when the torque passes a low pass of a `corner`."""
        reach = min(self.wanted.omega_c, corner) if self.short else self.wanted.omega_c
        return replace(self.wanted, omega_c=reach)

    def _searches(self, at, gains):
        """A search with each low pass, and its starts."""
        found = [self._search(factor, at) for factor in self.low_passes]
        if gains is None:
            return found
        return [(search, [*starts, search.slowest.scaled(gains)]) for search, starts in found]

    def _search(self, factor, at, first=1):
        """The search with a low pass of a corner over omega_1, in configurations from number `first` on; its starts."""
        corner = factor * self.omega_1
        samples = replace(self.sampling, torque_corner=corner)
        loops = uncertain_loops(self.nominal, at, samples, self.uncertainty, first)
        slowest = Slowest(loops, self._wanted(corner), self.scale)
        noise = Noise(slowest, self.nominal, samples, self.speed * NOISIEST, self.omega_1)
        late = samples.delay + 0.5 * samples.period + 1.0 / samples.joint_corner + POLES / corner
        firm = [self.speed * a for a in STARTS]
        if self.speed < 1.0 and any(self.arm.gravity):  # soft joints may not hold the weight
            firm += STARTS
        starts = [start(self.nominal, at, self.scale, a, late, corner) for a in firm]
        handicap = 1.0 if np.isinf(factor) else SLUGGISH
        search = Search(slowest, noise, self.speed * FASTEST, handicap, samples)
        return search, [slowest.scaled(K) for K in starts]

    def sets(self, search, x, used):
        """`Sets` of a search's scaled gains x."""
        slowest = search.slowest
        each = slowest.each(x)
        rows = tuple(
            SlowPole(loop.name, one.s, one.v, loop.kind)
            for loop, one in zip(slowest.loops, each, strict=True)
        )
        left = {round(abs(s), 1) for s in each[0].passed}
        K = slowest.gains(x).reshape(-1, *self.scale.shape)
        noise = np.max([search.noise.shares(one) for one in K], axis=0)
        slope = max(each, key=lambda one: one.v).slope
        return Sets(K, search.sampling, rows, tuple(sorted(left)), noise, slope, used)

    def design(self, sets):
        """The `Design` with these `Sets`."""
        return Design(
            self.arm,
            self.settings,
            self.uncertainty,
            sets.sampling,
            sets.K[0],
            sets.decay,
            self.omega_1,
            self._wanted(sets.sampling.torque_corner).omega_c,
            self.at,
            sets.rows,
            sets.left,
            round(sets.evaluations),
            tuple(sets.noise.tolist()),
            sets.slope,
            sets.K,
            recovery(self.nominal, self.at, sets.sampling, self.uncertainty, sets.K)
            if sets.decay > 0.0
            else None,
        )


def units(model, at, omega_1):
    """Unit of each gain, (n, 3n + 2m): what moves joints and modes at about omega_1; 0 where there is no gain."""
    n, m = model.n_joints, model.n_modes
    out = np.zeros((n, 3 * n + 2 * m))
    for q in at:
        terms = model.terms(q, np.zeros(n))
        M = terms.M
        inertia, modal = np.diag(M)[:n], np.diag(M)[n:]
        one = np.zeros_like(out)
        for i in range(n):
            for k, power in enumerate((2, 1, 3)):
                one[i, k * n + i] = inertia[i] * omega_1**power
        if m:
            omega = np.sqrt(np.abs(np.diag(terms.K2)) / modal)
            coupling = np.abs(M[:n, n:]) + 0.05 * np.sqrt(np.outer(inertia, modal))
            one[:, 3 * n : 3 * n + m] = 3.0 * coupling * omega * omega_1
            one[:, 3 * n + m :] = coupling * omega
        out = np.maximum(out, one)
    return out
