# SPDX-License-Identifier: Apache-2.0
"""The searches of one design: over its low passes, for one set of gains or for one per configuration."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flexarm_dynamics.models.model import build

from ..fading import lowest
from ..low_pass import POLES
from ..schedule import matters
from .decay import Slowest, SlowestScheduled, Wanted
from .gains import Design, SlowPole
from .held import held_loops
from .loop import APART, STICKS, Sampling
from .noise import Noise
from .recovery import recovery
from .search import ROUNDS, STARTS, TOGETHER, Search, follow, nearby, race, start
from .settings import FASTEST, NOISIEST, SLOWEST, places, sampling_for
from .uncertain import own_damping, uncertain_loops

#: Corners of the torque's low pass that the search tries, over omega_1; infinite: no low pass.
LOW_PASS = (np.inf, 20.0, 8.0, 4.0)
#: A low pass costs gain and phase margin. It is chosen only if it makes the decay larger by more than this factor.
SLUGGISH = 1.25
#: If the decay is less than `SLOW` times the speed, the search goes on from nearby gains, at most `TRIES` times. Its
#: loops then include arms of which only payload or only stiffness differs. Afterwards it does the same for the loops
#: that do not limit the decay; those that limit it keep the decay `KEPT` [-].
SLOW, TRIES, KEPT = 0.2, 6, 0.055
#: If a vibration grows faster than this while some joints stick and others slide, over omega_1, the arm is likely to
#: hunt. Then the search goes on with such loops [-].
GROWS_FAST = 0.8


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

    def slow(self, found):
        """Whether the decay of the `found` gains is far from the speed (`SLOW`)."""
        return found.decay < SLOW * self.speed

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
