# SPDX-License-Identifier: Apache-2.0
"""The set of loops for a design: what may differ from the arm file, and in which configurations the arm is."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import DesignError, ModelError
from flexarm_dynamics.models.model import build

from ..feedforward.base import SHARE
from .loop import ARM, MARGIN, sampled_loop

#: Joint angles of the drawn configurations are at most this far from straight [rad].
WORKSPACE = 1.3
#: Fraction of the decay that is asked of loops for a margin: another gain or delay, or the file's modes only.
UNLIKELY = 0.5
#: For an arm that sticks: Coulomb friction as a damper for movements of several sizes, over the damper that it is at
#: rest, and the fraction of the decay that is asked in each case. At rest the arm creeps, with the time constant
#: friction over stiffness.
STICKING = {1.0: 0.1, 0.1: 0.3}
#: Fraction of the decay that is asked of an arm of which some joints stick and others slide.
SOME_STICK = 0.1
#: If more joints than this can stick, only one of them sticks alone or slides alone: there would be too many sets.
ALL_SETS = 4
#: Every mode is assumed to have at least this damping ratio [-].
MIN_DAMPING = 1e-4


#: Fraction of the torque limits that a motion may take with the heaviest payload, and the least that it may take with
#: the file's, whatever the heaviest one is [-].
ENOUGH, AT_LEAST = 0.975, 0.5


@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty for which the design must be stable.

    Attributes
    ----------
    payload, stiffness, damping : (float, float)
        Least and greatest factor of the value in the file [-].
    gain : (float, float)
        Least and greatest factor of the torque on its way to the arm [-].
    delay : float
        Additional delay of the torque beyond the stated one, in periods [-].
    edges : bool
        Whether the loops include arms of which only payload or only stiffness differs.
    at_once : bool
        Whether the loops of joints that stick are also there without the delay.
    apart : bool
        Whether there are loops in which some joints stick while the others slide.
    """

    payload: tuple = (0.7, 1.3)
    stiffness: tuple = (0.9, 1.1)
    damping: tuple = (0.3, 3.0)
    gain: tuple = (0.6, 1.7)
    delay: float = 1.0
    edges: bool = False
    at_once: bool = False
    apart: bool = False

    @property
    def torque_share(self):
        """Fraction of the torque limits that a motion may take with the file's payload [-].

        The torque of a motion grows with the payload, at most in proportion to it. Up to a payload of
        `ENOUGH` / `AT_LEAST`, the heaviest one has enough of it.
        """
        return round(min(SHARE, max(AT_LEAST, ENOUGH / max(1.0, self.payload[1]))), 3)


def configurations(arm, seed=0):
    """Configurations of a design, (k, n) [rad]: one that is nearly straight, others spread evenly over the limits.

    One joint: straight, and with gravity two more near its position limits.
    """
    n = len(arm.joints)
    low, high = np.clip(arm.position_limits, -WORKSPACE, WORKSPACE).T
    middle = np.clip(0.0, low, high)
    if n == 1:
        return (
            np.array([middle, 0.8 * low + 0.2 * middle, 0.8 * high + 0.2 * middle])
            if any(arm.gravity)
            else middle[None]
        )
    from scipy.stats import qmc  # takes a third of a node's start

    drawn = qmc.scale(
        qmc.Halton(n, seed=seed).random(4 if n == 2 else 5), low, np.maximum(high, low + 1e-9)
    )
    drawn[0] = 0.9 * middle + 0.1 * high
    return drawn


def resting(model, at):
    """The configurations in which the arm rests under gravity."""
    kept, why = [], None
    for q in np.atleast_2d(np.asarray(at, float)):
        try:
            model.static_deflection(q)
            kept.append(q)
        except ModelError as error:
            why = error
    if not kept:
        raise DesignError(
            f"no configuration to design for, of {len(at)}: {why}",
            field=f"arm {model.arm.name}",
            hint="give configurations in which it rests",
        )
    return np.array(kept)


def rests(model, q):
    """Whether the arm rests in a configuration."""
    try:
        model.static_deflection(q)
    except ModelError:
        return False
    return True


def richer(arm):
    """The arm with one mode more in each direction of each link; none is added where shapes are measured or given."""
    if arm.model != "chain":
        return arm
    links = tuple(
        replace(
            link,
            flexible={
                d: f if f.shape == "from_frequencies" else replace(f, modes=f.modes + 1)
                for d, f in link.flexible.items()
            },
        )
        for link in arm.links
    )
    return replace(arm, links=links)


def uncertain_loops(nominal, at, sampling, uncertainty, first=1, sticking=True):
    """The set of loops for a design.

    - In each configuration: the softest, the stated and the stiffest arm, each with one mode more than the file, with
      the delay and without.
    - In each configuration: the stated arm with the file's modes only, with the delay and without. A mode beyond the
      file's makes a joint more compliant, so gains may be stable with it and unstable without it.
    - In the first configuration: the stated arm with a larger gain, with a smaller gain, and with a longer delay.
    - If the arm has Coulomb friction: each of the three arms, sticking. Friction is then a damper. At rest it is as
      steep as its smoothing makes it; for larger movements it is less, by the first harmonic. A loop that is stable
      with every fraction of this damper does not hunt.
    - With ``uncertainty.edges``: arms of which only payload or only stiffness differs, with the delay.
    - With ``uncertainty.at_once``: the loops of the arms that stick, also without the delay.
    - With ``uncertainty.apart``: in each configuration the stated arm, with each set of joints that can stick while the
      others slide, with the delay and without. If more than `ALL_SETS` joints can stick: only one sticks, or only one
      slides.

    In all loops joint speeds are filtered derivatives, like the observer's (`observer.measured_velocity`). A loop with
    measured speeds differs from these.

    Parameters
    ----------
    nominal : ArmModel
        Of the arm file.
    at : ndarray, shape (k, n)
        Configurations [rad].
    sampling : Sampling
    uncertainty : Uncertainty
    first : int
        Number of the first configuration, for names.
    sticking : bool
        Whether loops that stick are included, for an arm with Coulomb friction.

    Returns
    -------
    list of Loop
    """
    (p0, p1), (k0, k1), (d0, _) = uncertainty.payload, uncertainty.stiffness, uncertainty.damping
    arm = richer(nominal.arm.whole)
    plants = {
        f"payload x {p:g}, stiffness x {k:g}": build(scaled(arm, p, k, d0))
        for p, k in ((1.0, 1.0), (p1, k0), (p0, k1))
    }
    edges = {
        f"payload x {p:g}, stiffness x {k:g}": build(scaled(arm, p, k, d0))
        for p, k in ((p1, 1.0), (p0, 1.0), (1.0, k0), (1.0, k1))
        if uncertainty.edges
    }
    stated = next(iter(plants.values()))
    at_once = replace(sampling, delay=0.0)
    timings = {"": (sampling, 1.0, ARM), ", no delay": (at_once, UNLIKELY, MARGIN)}
    out, here = [], "" if first == 1 else f", at configuration {first}"
    for i, q in enumerate(at, first):
        for name, plant in (plants | edges).items():
            for words, (samples, fraction, kind) in timings.items():
                if words and name in edges:
                    continue
                name_here = f"{name}{words}, at configuration {i}"
                try:
                    one = sampled_loop(
                        nominal, plant, q, samples, 1.0, name_here, fraction, kind=kind
                    )
                except ModelError:  # too heavy to rest there
                    continue
                out.append(one)
    later = replace(sampling, delay=sampling.delay + uncertainty.delay * sampling.period)
    margins = [(sampling, gain, f"gain x {gain:g}{here}") for gain in uncertainty.gain]
    margins.append((later, 1.0, f"delay {1e3 * later.delay:.3g} ms{here}"))
    for samples, gain, name in margins:
        out.append(sampled_loop(nominal, stated, at[0], samples, gain, name, UNLIKELY, kind=MARGIN))
    own = build(scaled(nominal.arm.whole, 1.0, 1.0, d0))
    if own.n_modes < stated.n_modes:
        for i, q in enumerate(at, first):
            for words, (samples, *_) in timings.items():
                name = f"the file's modes alone{words}, at configuration {i}"
                out.append(sampled_loop(nominal, own, q, samples, 1.0, name, UNLIKELY, kind=MARGIN))
    if sticking and any(joint.friction.coulomb for joint in arm.joints):
        out += _sticking(nominal, plants, at, sampling, first)
        if uncertainty.at_once:
            out += _sticking(nominal, plants, at, at_once, first, ", no delay", UNLIKELY)
        if uncertainty.apart:
            for words, (samples, *_) in timings.items():
                out += _apart(nominal, stated, at, samples, first, words)
    return out


def _sticking(nominal, plants, at, sampling, first, more="", likely=1.0):
    """Loops of the named `plants` that stick: for small movements their Coulomb friction is a damper.

    `more` is added to their names; `likely` is a factor of the decay that is asked of them.
    """
    out = []
    for i, q in enumerate(at, first):
        for name, plant in plants.items():
            for part, fraction in STICKING.items():
                words = f"sticking, {part:g} of its friction, {name}{more}, at configuration {i}"
                if rests(plant, q):
                    asked = likely * fraction
                    out.append(sampled_loop(nominal, plant, q, sampling, 1.0, words, asked, part))
    return out


def _apart(nominal, plant, at, sampling, first, more):
    """Loops of a `plant` of which some joints stick and the others slide; `more` is added to their names."""
    joints, out = plant.arm.joints, []
    rubs = sum(joint.friction.coulomb > 0.0 for joint in joints)
    choices = product(*([0.0, 1.0] if joint.friction.coulomb else [0.0] for joint in joints))
    some = list(choices)[1:-1]  # neither none nor all
    if rubs > ALL_SETS:
        some = [which for which in some if sum(which) in (1.0, rubs - 1.0)]
    for i, q in enumerate(at, first):
        for which in some if rests(plant, q) else ():
            stuck = " and ".join(j.name for j, part in zip(joints, which, strict=True) if part)
            words = f"only {stuck} sticking{more}, at configuration {i}"
            out.append(sampled_loop(nominal, plant, q, sampling, 1.0, words, SOME_STICK, which))
    return out


def reach(model, at, late):
    """Frequency up to which a torque that is `late` [s] can influence a mode, omega_c [rad/s].

    At the frequency omega the delay is a phase lag of omega times `late`, and one radian is the most that is allowed.
    The frequency is also at most 1.5 times that of the stiffest mode in the controller's model, which has no modes
    beyond that.
    """
    if not model.n_modes:
        return 1.0 / late
    return min(1.0 / late, 1.5 * max(float(model.frequencies(q)[-1]) for q in at))


def own_damping(arm, uncertainty):
    """Least damping ratio that the arm's modes may have within the `uncertainty` [-]."""
    stated = [d for link in arm.links for f in link.flexible.values() for d in f.damping]
    return max(uncertainty.damping[0] * min(stated, default=0.0), MIN_DAMPING)
