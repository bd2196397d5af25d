# SPDX-License-Identifier: Apache-2.0
r"""Robust gains: a design for an arm that differs from its arm file.

The control has a fixed structure: stiffness, damping and integral of each joint (`slow.type: joint_pid`) and a constant
feedback of modal amplitudes and rates (`fast.type: fixed_gain`), both about the motion of the feed-forward. One search
finds its gains for a whole set of sampled loops (multi-model design). Payload, stiffness, damping, loop gain, delay and
configuration vary; the arm has one mode more per direction than the file; filters and delay are part of each loop
(`loop`). The search makes the slowest pole of all loops as fast as possible (`decay`). It minimises this nonsmooth
function by BFGS (`nonsmooth`) from several starts. The noise that the gains pass on to the torque is bounded.

In the literature this is static output feedback by minimisation of the spectral abscissa (Burke, Henrion, Lewis &
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
from .further import LEAST, later, leaves, leaving_less, rings_longer
from .held import held_loops
from .loop import APART, ARM, STICKS, Sampling
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

#: Corner of the filtered derivatives: the first number times omega_c, but at most one radian per sample. For a fast
#: arm the lag of such a filter matters. So the corner is at least the second number times omega_1, or the third number
#: in radians per sample if that is lower.
FILTER, FAST_ARM, PER_SAMPLE = 2.0, 15.0, 2.0
#: Corners of the torque's low pass that the search tries, over omega_1; infinite: no low pass.
LOW_PASS = (np.inf, 20.0, 8.0, 4.0)
#: A low pass costs gain and phase margin. It is chosen only if it makes the decay larger by more than this factor.
SLUGGISH = 1.25
#: A `stability_margin` so low that the controller's own check passes: it has neither the filters nor the delay.
UNCHECKED = -1000.0
#: Time that a torque takes between processes, in addition to one period [s].
TRANSPORT = 1e-3
#: Torque hardly moves a pole if the gradient of its value by the scaled gains is shorter than the first number [-]. A
#: pole is too fast for the loop if the delay turns the torque for it by more than the second [rad].
HARDLY, FAST = 1.0, 0.5
#: Why a design has a lower speed than requested.
FROM_LIMITS = "an arm with faster gains would not come back from them in time"
#: If the decay of the first search is less than `POOR` times the speed, low passes with a corner below omega_c are
#: tried. Modes beyond such a corner are only asked to keep their own damping. The result is used if its decay is more
#: than `WORTH` times larger, motions leave no more behind than with the first result, and no mode rings longer [-].
POOR, WORTH = 0.25, 1.2
#: If gains scheduled with such low passes reach less decay than this, one set for all configurations is tried as well.
#: One set without these low passes is tried if the best decay so far is below `further.LEAST`, or, if there are no such
#: low passes, below this [-].
LITTLE = 0.08
#: If the decay is less than `SLOW` times the speed, the search goes on from nearby gains, at most `TRIES` times. Its
#: loops then include arms of which only payload or only stiffness differs. Afterwards it does the same for the loops
#: that do not limit the decay; those that limit it keep the decay `KEPT` [-].
SLOW, TRIES, KEPT = 0.2, 6, 0.055
#: The model with finite slopes takes long to compute. The feed-forward uses it only if the number of steps per sample,
#: times the number of modes, is at most this.
QUICK = 12
#: The feed-forward has one mode more than the file if its fastest frequency is then at most this many times the lowest
#: one, with the joints locked. The fastest frequency sets the steps in which a plan is integrated [-].
SPREAD = 2000.0
#: If the arm does not come back from its torque limits (`recovery`), designs at these fractions of the speed follow.
SLOWER = (0.7, 0.5, 0.35)
#: Lowest speed; a lower one counts as this.
SLOWEST = 0.05
#: Progress at the end of the first design; slower designs may follow. Then, within one design, progress at the end of
#: the usual search, of the attempts after a poor result, of the search from nearby gains, and of the search for gains
#: with which motions leave less.
FIRST, USUAL, OTHERWISE, NEARBY, LESS = 0.7, 0.6, 0.75, 0.85, 0.93
#: Fraction of the file's Coulomb friction that is cancelled, since friction may be less by a fifth. The fraction is
#: smaller if friction would move a joint farther than this angle [rad] before the torque can answer. With full
#: cancellation such a joint would hunt.
CANCELLED, KICK = 0.8, np.radians(0.1)
#: If a vibration grows faster than this while some joints stick and others slide, over omega_1, the arm is likely to
#: hunt. Then the search goes on with such loops [-].
GROWS_FAST = 0.8
#: Decay over omega_1, and noise over the torque limit, at which the fastest design aims.
FASTEST, NOISIEST = 0.6, 0.03
#: `slow.return_rate` over omega_1. With the fraction gamma of its friction cancelled, a joint that sticks goes back at
#: gamma / (1 - gamma) times this rate: as fast as the fastest decay. A higher rate would hold the joint so stiffly that
#: it no longer damps the links.
RETURN = FASTEST * (1.0 - CANCELLED) / CANCELLED
#: Fraction of the friction that is overcome where a joint sticks, and `slow.breakaway_rate` over omega_1. At twice this
#: rate a light hub hunted.
BREAKAWAY, BREAKAWAY_RATE = 0.95, 0.5


@dataclass(frozen=True)
class Settings:
    """How the loop runs, and how long a design may take.

    Attributes
    ----------
    rate : float
        Samples per second [Hz].
    delay : float
        From a measurement until its torque acts [s]; if not given, one period plus `TRANSPORT`.
    speed : float
        From 0 to 1: the decay at which the design aims, and the noise that it allows. At 1 these are `FASTEST` and
        `NOISIEST`, the rms torque due to the sensors' noise over the torque limit.
    configurations : tuple of tuple of float
        Where the arm moves [rad]; if none are given, they are drawn from its position limits.
    effort : float
        Factor of the work in the search; 1.0 is the default.
    seed : int
        Of random configurations and of random starts near gains that were found.
    feedforward : str
        Name of the feed-forward in the controller file; the gains do not depend on it.
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
    """Gains, and the properties of the loops with them.

    Attributes
    ----------
    K : ndarray, shape (n, 3n + 2m)
        u = -K (q, qd, -w, delta, delta_d); scheduled gains: those of the first configuration.
    decay : float
        Decay of the slowest pole that gains move, over the decay that is asked of it [-]; negative: unstable.
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
        Of each joint: rms torque due to the sensors' noise over the torque limit [-].
    slope : float
        Length of the gradient of the slowest pole's value by the scaled gains [-].
    sets : ndarray, shape (k, n, 3n + 2m)
        One set of gains for all configurations, or one for each; see `flexarm_control.schedule`.
    recovery : Recovery or None
        From motions that take as much torque as a plan; None: not computed.
    slowed : bool
        Whether the speed is lower than requested, because the arm would not come back from its torque limits with
        faster gains.
    hunts : bool
        Whether a vibration grows fast while some joints stick and others slide (`GROWS_FAST`), and no gains were found
        with which it does not.
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
    hunts: bool = False

    def __post_init__(self):
        if self.sets is None:
            object.__setattr__(self, "sets", self.K[None])

    @property
    def reached(self):
        """The least decay over what is asked, of the loops of kind `ARM` only [-]."""
        return -max(row.value for row in self.slowest if row.kind == ARM)

    @property
    def worst(self):
        """The `SlowPole` of the slowest loop, relative to what is asked of it."""
        return max(self.slowest, key=lambda row: row.value)

    @property
    def scheduled(self):
        """Whether there is a set of gains for each configuration."""
        return len(self.sets) > 1

    def gains_at(self, number):
        """K of a configuration, (n, 3n + 2m); its number counts from 0."""
        return self.sets[number if self.scheduled else 0]

    def loops(self):
        """The loops of the design, each with its gains: pairs of `Loop` and K."""
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
        """Whether the arm comes back from its torque limits; True if that was not computed."""
        return self.recovery is None or self.recovery.comes_back

    def check(self):
        """Refuse a design of which a loop is unstable.

        Raises
        ------
        DesignError
            Names the loop and the pole that are unstable, and what would help.
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
            "feedforward_torque": self.uncertainty.torque_share,
            "motion_delay": numbers([self.settings.delay])[0],
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
    """A flat list of numbers, rounded to six digits as in a parameter file."""
    return [float(f"{v:.6g}") for v in np.ravel(values)]


def of_feedforward(arm, rate):
    """Flat parameters that give the feed-forward a better model than the arm file's.

    It has one mode more per direction, for the compliance of the links that the file's modes leave out: for several
    links with one mode each, the next frequencies are 10 to 20 % too high. It leaves that mode out if the mode is too
    fast (`SPREAD`). It has as much of the kinematics of bending as the arm's loads need, within `levels.TOLERANCE` of
    the arm's reach.
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
    """In words, which loop is unstable with the best gains found, and by which pole."""
    name, pole, *_ = found.worst
    return (
        f"no gains hold all of it: the best found lets a pole at {abs(pole) / (2.0 * np.pi):.3g} Hz grow at"
        f" {pole.real:.3g} 1/s with {name}"
    )


def what_limits(found):
    """In words, why the slowest pole of a stable design is no faster."""
    pole = found.worst.pole
    hertz, lag = abs(pole) / (2.0 * np.pi), _lag(found, pole)
    if found.worst.kind in (STICKS, APART) and abs(pole) < found.omega_1:
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
    """Phase lag of the torque at the frequency of a pole, due to delay and sampling [rad]."""
    return abs(pole) * (found.sampling.delay + 0.5 * found.sampling.period)


def what_helps(found):
    """In words, what to try against the slowest pole of an unstable design."""
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
    """Configurations of a design, (k, n) [rad]: those of the `settings`, or drawn ones."""
    given = settings.configurations or configurations(nominal.arm, settings.seed)
    return resting(nominal, given)


def sampling_for(nominal, at, settings):
    """`Sampling` of the loop, with the corners of its filters, and omega_c [rad/s]; computed without a search."""
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
    r"""Fraction of each joint's Coulomb friction that the control may cancel, as a tuple; 0.0 for a joint without it.

    .. math:: \gamma_i = 0.8\min\Bigl(1, \frac{0.1^\circ}{f_{c,i}\,H_{ii}\,\tau^2}\Bigr)

    H is the inverse of the mass matrix: when a joint breaks loose, only its hub moves at first. When the joint turns
    around, the torque that cancels friction changes its sign only after :math:`\tau`.

    Parameters
    ----------
    model : ArmModel
    at : ndarray, shape (k, n)
        Configurations [rad].
    late : float
        :math:`\tau`, from the moment a joint turns around until this torque does [s].
    """
    n, coulomb = model.n_joints, model.friction_table()[:, 1]
    H = np.max([np.diag(np.linalg.inv(model.terms(q, np.zeros(n)).M))[:n] for q in at], axis=0)
    kick = np.maximum(coulomb * H * late**2, KICK)
    return tuple((np.where(coulomb > 0.0, CANCELLED, 0.0) * KICK / kick).tolist())


def design(arm, settings=None, uncertainty=None, progress=None, gains=None):
    """Gains for the arm of an arm file.

    If the arm would not come back from its torque limits (`recovery`), slower gains are searched for (`SLOWER`).

    Parameters
    ----------
    arm : Arm
    settings : Settings, optional
    uncertainty : Uncertainty, optional
    progress : callable, optional
        Called with the fraction of the work that is done and the decay that is reached.
    gains : ndarray, shape (n, 3n + 2m), optional
        An additional start.

    Returns
    -------
    Design
        The best one found, even if it is unstable: see its `decay`. Its `settings` have the speed that was used.

    Raises
    ------
    DesignError
        If the arm rests in no configuration, or nothing measures its bending.
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
        # With its own starts: from the faster gains the search would end at gains that also ask for much torque.
        other = design_at(arm, slower, uncertainty, now, asked=settings.speed)
        if other.holds and (other.comes_back or other.recovery.limited < found.recovery.limited):
            found = replace(other, slowed=True)
    say.part(0.0, 1.0)(1.0, found.decay)
    return found


def design_at(arm, settings, uncertainty, progress=None, gains=None, asked=None):
    """A `Design` with the speed of the settings, whether or not the arm comes back from its torque limits.

    Parameters
    ----------
    arm, settings, uncertainty, progress, gains
        As for `design`.
    asked : float, optional
        The requested speed, if the settings have a lower one because of the torque limits [-].

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
        better = reached > max(WORTH * found.decay, 0.0)
        if better and not _rings(task, found, short, other):
            task, found = short, other
    if found.decay < SLOW * task.speed:
        task = Task(arm, settings, replace(uncertainty, edges=True), task.short)
        found = task.from_nearby(say.part(OTHERWISE, NEARBY), found)
    if task.hunts(found):
        more = task.at_once()
        other = more.from_nearby(say.part(OTHERWISE, NEARBY), found)
        if other.decay > 0.0:
            task, found = more, other
    kept, made = found, task.design(found)
    if found.decay > 0.0 and task.nominal.n_modes:
        edged = Task(arm, settings, replace(task.uncertainty, edges=True), task.short)
        other = leaving_less(edged, found, say.part(NEARBY, LESS), asked)
        if other is not None and edged.hunts(other):
            edged = edged.at_once()
            other = leaving_less(edged, found, say.part(NEARBY, LESS), asked)
        if other is not None:
            sooner = edged.design(other)
            if not later(sooner.recovery, made.recovery):
                kept, made = other, sooner
    if task.hunts_apart(kept):
        made = _steadied(task, kept, made, asked, say.part(LESS, 1.0))
    say.part(0.0, 1.0)(1.0, made.decay)
    return made


def _rings(task, found, short, other):
    """Whether the gains `other` of the task `short` leave more behind than the `found` ones of `task`, or ring longer.

    Modes beyond the corner of a low pass may ring long after a motion, although the decay that is asked of the others
    is larger. Nothing is compared with unstable gains, and ringing is not compared if the `found` gains have less decay
    than `further.LEAST`.
    """
    if found.decay <= 0.0 or not task.nominal.n_modes:
        return False
    more = leaves(short, other) > leaves(task, found)
    return more or (found.decay >= LEAST and rings_longer(task, found, short, other))


def _steadied(task, found, made, asked, progress):
    """The design that goes on from the `found` gains until no vibration grows while some joints stick.

    It is `made`, the design with the `found` gains, if there are no such gains, or if with them the arm no longer comes
    back from its torque limits; then it is marked: it `hunts`. The requested speed is `asked`, as in `design_at`.
    """
    loops = replace(task.uncertainty, edges=True, at_once=True, apart=True)
    apart = Task(task.arm, task.settings, loops, task.short)
    other = apart.from_nearby(progress, found)
    made = replace(made, hunts=True)
    if other.decay < min(found.decay, LEAST):
        return made
    steady = apart.design(other)
    if task.nominal.n_modes:
        less = leaving_less(apart, other, progress, asked)
        sooner = steady if less is None else apart.design(less)
        if not later(sooner.recovery, steady.recovery):
            steady = sooner
    return steady if steady.comes_back or not made.comes_back else made


class _Progress:
    """Turns the progress of each part into that of the whole; the fraction never decreases."""

    def __init__(self, progress):
        self._progress, self._most = progress, 0.0

    def part(self, begin, end):
        """A callable for the part from `begin` to `end`: takes its fraction, and the decay that is reached."""

        def say(fraction, decay):
            self._most = max(self._most, begin + (end - begin) * fraction)
            if self._progress is not None:
                self._progress(self._most, decay)

        return say


class Sets(NamedTuple):
    """Gains of each configuration, and the properties of the loops with them."""

    K: np.ndarray  # (k, n, 3n + 2m); one set, or one for each configuration
    sampling: Sampling
    rows: tuple  # of `Design.slowest`
    left: tuple
    noise: np.ndarray  # (n,)
    slope: float
    evaluations: float

    @property
    def decay(self):
        """Of the slowest pole, over what is asked of it [-]."""
        return -max(row.value for row in self.rows)


class Task:
    """The searches of one design, for one set of gains or for several.

    Parameters
    ----------
    arm : Arm
    settings : Settings
    uncertainty : Uncertainty
    short : bool
        Whether the search tries only low passes with a corner below omega_c, which end the torque's reach.

    Attributes
    ----------
    nominal : ArmModel
        Model of the arm as the control knows it.
    at : ndarray, shape (k, n)
        Configurations [rad].
    speed : float
        That of the settings, but at least `SLOWEST` [-].
    low_passes : tuple of float
        Corners that the search tries, over omega_1; if `short`, only those below omega_c, which may be none.
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
        """A set for each configuration; if these reach less decay than `enough`, one set for all is tried as well."""
        if len(self.at) == 1:
            return self.alone(progress, gains)
        sets = self.scheduled(progress, gains)
        return sets if sets.decay >= enough else self.found_alone(progress, gains, sets)

    def found_alone(self, progress, gains, sets):
        """The better one of `sets` and of one set for all, from which a search for one set for each goes on."""
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
        """A set for each configuration: by a race in the first one, then from the best of the sets found so far."""
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
        """`Sets` for all loops in and between the configurations.

        The search starts from gains K (1 or k, n, 3n + 2m) for the loops in the configurations alone.
        """
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
        """The best `Sets` that the search reaches from the gains `found` and from gains near them, see `nearby`."""
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

    def hunts(self, found):
        """Whether a sticking joint would hunt if the torque had no delay.

        False if the task has such loops, or if the `found` gains are unstable.
        """
        rubs = any(joint.friction.coulomb for joint in self.arm.joints)
        if not rubs or self.uncertainty.at_once or found.decay <= 0.0:
            return False
        return self.at_once()._least(found, STICKS) <= 0.0

    def at_once(self):
        """The same task; the loops of joints that stick are there without the delay as well."""
        more = replace(self.uncertainty, at_once=True)
        return Task(self.arm, self.settings, more, self.short)

    def hunts_apart(self, found):
        """Whether a vibration grows fast if some joints stick and others slide (`GROWS_FAST`).

        False if the task has such loops, or if the `found` gains are unstable.
        """
        rubs = any(joint.friction.coulomb for joint in self.arm.joints)
        if not rubs or self.uncertainty.apart or found.decay <= 0.0:
            return False
        return self.apart()._least(found, APART) < -GROWS_FAST

    def apart(self):
        """The same task, with loops in which some joints stick and others slide."""
        more = replace(self.uncertainty, apart=True)
        return Task(self.arm, self.settings, more, self.short)

    def _least(self, found, kind):
        """The least decay of the loops of one kind, over what is asked of them; infinite: there are none [-]."""
        loops, weights = self.held(found.sampling, len(found.K))
        those = [k for k, loop in enumerate(loops) if loop.kind == kind]
        if not those:
            return np.inf
        search = self.search_of(
            [loops[k] for k in those], [weights[k] for k in those], found.sampling
        )
        return min(search.decays(search.slowest.scaled(found.K)))

    def held(self, sampling, count):
        """Loops in and between the configurations, and the weights of `count` sets of gains in each loop."""
        return held_loops(self.nominal, self.at, sampling, self.uncertainty, count)

    def search_of(self, loops, weights, sampling):
        """The `Search` for sets of gains; each loop has their mean, weighted with its own `weights`."""
        wanted = self._wanted(sampling.torque_corner)
        slowest = SlowestScheduled(loops, wanted, self.scale, weights)
        noise = Noise(slowest, self.nominal, sampling, self.speed * NOISIEST, self.omega_1)
        return Search(slowest, noise, self.speed * FASTEST, sampling=sampling)

    def _wanted(self, corner):
        """What is asked of poles when the torque passes a low pass with this `corner` [rad/s]."""
        reach = min(self.wanted.omega_c, corner) if self.short else self.wanted.omega_c
        return replace(self.wanted, omega_c=reach)

    def _searches(self, at, gains):
        """A search with each low pass, and its starts."""
        found = [self._search(factor, at) for factor in self.low_passes]
        if gains is None:
            return found
        return [(search, [*starts, search.slowest.scaled(gains)]) for search, starts in found]

    def _search(self, factor, at, first=1):
        """The search with a low pass, its corner `factor` times omega_1, and its starts.

        The configurations are numbered from `first` on.
        """
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
    """Unit of each gain, (n, 3n + 2m); 0 where there is no gain.

    Gains of this size move joints and modes at about omega_1.
    """
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
