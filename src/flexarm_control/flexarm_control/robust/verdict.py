# SPDX-License-Identifier: Apache-2.0
"""The verdict on a loop in words: stable with margin, fragile and to what, or unstable and in which joint or mode.

The verdict is on the sampled loops of `whole`, with observer and delay, at rest in one or several configurations. Each
of the `perturbations` is tried alone; the rest is as in the arm file. Loops that stay stable under all of them are
stable with margin.
"""

from dataclasses import asdict, dataclass

import numpy as np

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models.model import build

from .card import FARTHEST, LATEST, limit
from .limit_cycle import limit_cycles
from .uncertain import Uncertainty, richer
from .whole import WholeLoop

#: Phase lag of the torques of all joints [rad], and additional delay in periods [-], that are tried.
PHASE, PERIODS = np.radians(30.0), 1.0
WITH_MARGIN, FRAGILE, UNSTABLE, UNKNOWN = (
    "stable with margin",
    "stable, fragile",
    "unstable",
    "unknown",
)
#: Bisections of a limit: for a result with three digits, and for a quick estimate.
FINE, QUICK = 10, 6


@dataclass(frozen=True)
class Perturbation:
    """What is tried: a description in words, and changes of the arm file or of the loop."""

    words: str
    payload: float = 1.0
    stiffness: float = 1.0
    gain: complex = 1.0
    later: float = 0.0  # additional delay [s]
    richer: bool = False  # one bending mode more in each direction


def perturbations(period):
    """The standard perturbations, for a sampling `period` [s]; the factors are those of a design, see `Uncertainty`."""
    usual = Uncertainty()
    out = [Perturbation(f"a payload x {f:g}", payload=f) for f in usual.payload]
    out += [Perturbation(f"a stiffness x {f:g}", stiffness=f) for f in usual.stiffness]
    out += [Perturbation(f"torques x {f:g}", gain=f) for f in usual.gain]
    ms = 1e3 * PERIODS * period
    return [
        *out,
        Perturbation(f"a delay {ms:.3g} ms longer", later=PERIODS * period),
        Perturbation(f"a phase lag of {np.degrees(PHASE):.0f} degrees", gain=np.exp(-1j * PHASE)),
        Perturbation("a bending mode more than the arm file has", richer=True),
    ]


@dataclass(frozen=True)
class Bears:
    """Limits within which a loop is stable; only one quantity varies at a time.

    Attributes
    ----------
    payload : (float, float)
        Least and greatest factor; 0 and None: no limit was found [-].
    delay : float or None
        Longest, from a measurement to its torque; None: no limit was found [s].
    reason : str
        Why the limits are unknown; empty if they are known.
    limit_cycles : tuple of LimitCycle
        Likely because of play, although the loop is stable with closed play.
    """

    payload: tuple = (None, None)
    delay: float | None = None
    reason: str = ""
    limit_cycles: tuple = ()

    def as_dict(self):
        """Ready for JSON."""
        values = asdict(self)
        return values | {name: list(values[name]) for name in ("payload", "limit_cycles")}


@dataclass(frozen=True)
class Verdict:
    """The verdict; see the module.

    Attributes
    ----------
    word : str
        `WITH_MARGIN`, `FRAGILE`, `UNSTABLE` or `UNKNOWN`.
    text : str
        A sentence: to what the loop is fragile, what is unstable, or why the verdict is unknown.
    tried : tuple of (str, bool)
        Description of each perturbation, and whether the loop stays stable under it.
    bears : Bears
    """

    word: str
    text: str
    tried: tuple = ()
    bears: Bears = Bears()

    def as_dict(self):
        """Ready for JSON."""
        tried = [{"perturbation": what, "stable": ok} for what, ok in self.tried]
        return {"word": self.word, "text": self.text, "tried": tried, "bears": self.bears.as_dict()}


class Judge:
    """Loops of one control in several configurations.

    Parameters
    ----------
    controllers : sequence of LinearController
    delay : float
        From a measurement until its torque acts [s].
    """

    def __init__(self, controllers, delay=0.0):
        self.loops = [WholeLoop(c, delay) for c in controllers]
        self.delay, self.period = delay, controllers[0].period
        self.arm = controllers[0].model.arm.whole
        self._models = {}

    def stable(self, payload=1.0, stiffness=1.0, gain=1.0, later=0.0, richer=False):
        """Whether all loops are stable with this perturbation of arm, gain and delay, see `Perturbation`."""
        key = payload, stiffness, richer
        try:
            if key not in self._models:
                self._models[key] = build(_arm(self.arm, *key))
            return all(
                loop.stable(
                    plant=loop.plant(self._models[key], key), gain=gain, delay=self.delay + later
                )
                for loop in self.loops
            )
        except (FlexarmError, np.linalg.LinAlgError):  # it does not rest there
            return False

    def limit_cycles(self):
        """Limit cycles in the loops by `limit_cycle.limit_cycles`; for each joint the one of the largest amplitude."""
        plant, found = build(self.arm), {}
        for loop in self.loops:
            whole, c = loop.plant(plant), loop.controller

            def poles(A, loop=loop, whole=whole):
                return np.linalg.eigvals(loop.matrix(plant=(A, *whole[1:])))

            for cycle in limit_cycles(plant, c.q, whole[0], poles, self.period):
                if cycle.joint not in found or cycle.amplitude > found[cycle.joint].amplitude:
                    found[cycle.joint] = cycle
        return list(found.values())

    def bears(self, bisections=FINE):
        """`Bears` of the loops, each limit found by this number of `bisections`."""
        if not self.stable():
            return Bears(reason="the loop is unstable as it is")
        T = self.period
        low = 0.0
        if not self.stable(payload=0.0):
            low = 1.0 / limit(lambda f: self.stable(payload=1.0 / f), 1.0, FARTHEST, bisections)
        high = limit(lambda f: self.stable(payload=f), 1.0, FARTHEST, bisections)
        first = self.delay / T
        late = limit(
            lambda k: self.stable(later=(k - first) * T), first, first + LATEST, bisections
        )
        finite = [None if np.isinf(v) else float(v) for v in (high, late * T)]
        return Bears((float(low), finite[0]), finite[1], limit_cycles=tuple(self.limit_cycles()))

    def verdict(self):
        """The `Verdict`."""
        for loop in self.loops:
            if not loop.stable():
                return Verdict(UNSTABLE, f"{UNSTABLE}: {_growing(loop)}", (), self.bears())
        tried = tuple(
            (p.words, self.stable(p.payload, p.stiffness, p.gain, p.later, p.richer))
            for p in perturbations(self.period)
        )
        weak = [words for words, ok in tried if not ok]
        if not weak:
            return Verdict(WITH_MARGIN, WITH_MARGIN, tried, self.bears())
        return Verdict(FRAGILE, f"{FRAGILE}: to {', to '.join(weak)}", tried, self.bears())


def unknown(reason):
    """The `Verdict` on a loop that cannot be judged."""
    return Verdict(UNKNOWN, f"{UNKNOWN}: {reason}", (), Bears(reason=str(reason)))


def _arm(arm, payload, stiffness, more):
    return scaled(richer(arm) if more else arm, payload, stiffness)


def _growing(loop):
    s, name = loop.growing()
    q = ", ".join(f"{v:.3g}" for v in loop.controller.q)
    if abs(s.imag) < 1e-3 * abs(s.real):
        how = "moves away"
    elif abs(s.imag) > 0.9 * np.pi / loop.controller.period:
        how = "alternates from sample to sample"
    else:
        how = f"oscillates at {abs(s.imag) / (2.0 * np.pi):.3g} Hz"
    return f"{name} {how}, doubling in {np.log(2.0) / s.real:.3g} s, at rest in [{q}] rad"
