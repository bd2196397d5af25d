# SPDX-License-Identifier: Apache-2.0
"""What a design bears: how far gain, delay, payload and stiffness may be off until a loop becomes unstable."""

from dataclasses import dataclass, replace

import numpy as np

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models.model import build

from .decay import Slowest, Wanted
from .loop import sampled_loop
from .uncertain import own_damping, richer

#: Bisections of a limit, and the farthest that is looked: factors, and periods of delay.
BISECTIONS, FARTHEST, LATEST = 12, 16.0, 40.0


@dataclass(frozen=True)
class Card:
    """Limits within which all loops of a design are stable, each by itself, the rest as in the arm file.

    Attributes
    ----------
    gain, payload, stiffness : (float, float)
        Least and greatest factor; 0 and infinite: none was found within `FARTHEST` [-].
    delay : float
        Longest delay [s]; infinite: beyond `LATEST` periods.
    damping : float
        Least damping ratio of the poles below omega_c, the arm as in its file [-].
    settling : float
        After this time the slowest of the uncertain loops has 2 % left [s].
    """

    gain: tuple
    payload: tuple
    stiffness: tuple
    delay: float
    damping: float
    settling: float


def card(design):
    """The `Card` of a design."""
    arm, sampling, nominal = richer(design.arm), design.sampling, build(design.arm)
    wanted = Wanted(design.omega_1, np.inf, own_damping(design.arm, design.uncertainty))
    plants = {}

    def loops(payload=1.0, stiffness=1.0, gain=1.0, delay=None):
        key = payload, stiffness
        if key not in plants:
            plants[key] = build(scaled(arm, payload, stiffness))
        late = sampling if delay is None else replace(sampling, delay=delay)
        for q in design.configurations:
            yield sampled_loop(nominal, plants[key], q, late, gain)

    def stable(**off):
        try:
            for loop in loops(**off):
                one = Slowest([loop], wanted, np.ones(design.K.shape))
                if one.values(design.K[one.free])[0][3].max() >= 0.0:
                    return False
        except ModelError:  # it does not rest there
            return False
        return True

    def limits(name):
        if not stable():
            return 1.0, 1.0
        low = _limit(lambda f: stable(**{name: 1.0 / f}), 1.0, FARTHEST)
        high = _limit(lambda f: stable(**{name: f}), 1.0, FARTHEST)
        return (0.0 if np.isinf(low) else 1.0 / low), high

    damping = np.inf
    for loop in loops():
        one = Slowest([loop], wanted, np.ones(design.K.shape))
        s = np.log(one.values(design.K[one.free])[0][2]) / loop.period
        s = s[(np.abs(s) < design.omega_c) & (s.imag > 0.0)]
        damping = min(damping, float((-s.real / np.abs(s)).min(initial=np.inf)))
    period = sampling.period
    latest = _limit(lambda late: stable(delay=late * period), sampling.delay / period, LATEST)
    decay = design.decay * design.omega_1
    return Card(
        limits("gain"),
        limits("payload"),
        limits("stiffness"),
        latest * period,
        damping,
        4.0 / decay if decay > 0.0 else np.inf,
    )


def _limit(stable, low, high):
    """Where `stable` ends between `low`, where it holds, and `high`; infinite if it holds there."""
    if not stable(low):
        return low
    # Outwards first: beyond the first instability a loop may be stable again.
    steps = np.geomspace(max(low, 0.25), high, 9)[1:]
    for step in steps:
        if not stable(step):
            high = step
            break
        low = step
    else:
        return np.inf
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low
