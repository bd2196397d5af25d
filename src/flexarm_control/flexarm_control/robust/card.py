# SPDX-License-Identifier: Apache-2.0
"""Margins of a design: how far gain, phase, delay, payload and stiffness may be off before a loop becomes unstable."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigvals

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.linear import static_torque
from flexarm_dynamics.models.model import build

from .decay import eigenvalues
from .loop import measured_amplitudes, sampled_loop
from .settling import Motion
from .tip import Tip, softest
from .uncertain import richer

#: Number of bisections of a limit, and how far it is searched for: the largest factor, and the most periods of delay.
BISECTIONS, FARTHEST, LATEST = 12, 16.0, 40.0
#: The response of a pole with the decay d falls to 2 % in this time over d.
LEFT = 4.0
#: Steps per locked period of a motion of which the largest torque is computed.
PEAK_STEPS = 200


@dataclass(frozen=True)
class Card:
    """Limits within which the loops in all configurations are stable; one quantity varies, the rest is as in the file.

    Attributes
    ----------
    gain, payload, stiffness : (float, float)
        Least and greatest factor; 0 and infinite: no limit was found within `FARTHEST` [-].
    delay : float
        Longest delay [s]; infinite: beyond `LATEST` periods.
    phase : float
        Phase margin: the torques of all joints may lag or lead by this angle [rad].
    damping : float
        Least damping ratio of the poles below omega_c, for the arm of the file [-].
    settling : float
        Settling time of the tip to 2 % after a constant force is removed, for the arm of the file, in the slowest
        configuration [s].
    slowest : float
        The response of the slowest pole of the uncertain loops falls to 2 % in this time [s].
    torque_used : ndarray, shape (2, n), or None
        Largest torque of each joint over its limit, when any one joint turns by `settling.ANGLE` in `settling.MOTION`
        locked periods: with the payload of the file, and with the heaviest [-]. It includes the weight where the motion
        ends, and leaves out friction and Coriolis forces. Zero for a joint without a limit, NaN if the arm does not
        rest. None: no link bends, or no joint has a limit.
    tip_stiffness, tip_stiffness_proportional : float
        Stiffness of the tip against a static force, in the softest direction and configuration [N/m]. The first is
        that after the integral has brought the joints back, so that only the links bend; the second is that without
        the integral.
    """

    gain: tuple
    payload: tuple
    stiffness: tuple
    delay: float
    phase: float
    damping: float
    settling: float
    slowest: float
    torque_used: np.ndarray | None
    tip_stiffness: float
    tip_stiffness_proportional: float


def card(design):
    """The `Card` of a design."""
    arm, sampling = richer(design.arm.whole), design.sampling
    nominal = build(design.arm.known)
    plants = {}
    gains = [design.gains_at(k) for k in range(len(design.configurations))]

    def loops(payload=1.0, stiffness=1.0, gain=1.0, delay=None):
        key = payload, stiffness
        if key not in plants:
            plants[key] = build(scaled(arm, payload, stiffness))
        late = sampling if delay is None else replace(sampling, delay=delay)
        for q in design.configurations:
            yield sampled_loop(nominal, plants[key], q, late, gain)

    def stable(phase=0.0, **off):
        # The loop's matrices are real, so a lag and a lead by the same angle are equally stable.
        turn = np.exp(-1j * phase) if phase else 1.0
        try:
            return all(
                np.abs(_poles(loop, turn * K)).max() < 1.0
                for loop, K in zip(loops(**off), gains, strict=True)
            )
        except ModelError:  # it does not rest there
            return False

    def limits(name):
        if not stable():
            return 1.0, 1.0
        low = limit(lambda f: stable(**{name: 1.0 / f}), 1.0, FARTHEST)
        high = limit(lambda f: stable(**{name: f}), 1.0, FARTHEST)
        return (0.0 if np.isinf(low) else 1.0 / low), high

    damping, stated = np.inf, list(loops())
    for loop, K in zip(stated, gains, strict=True):
        s = np.log(eigenvalues(loop, K)[1]) / loop.period
        s = s[(np.abs(s) < design.omega_c) & (s.imag > 0.0)]
        damping = min(damping, float((-s.real / np.abs(s)).min(initial=np.inf)))
    period = sampling.period
    latest = limit(lambda late: stable(delay=late * period), sampling.delay / period, LATEST)
    phase = limit(lambda angle: stable(phase=angle), 0.0, np.pi)
    slowest = min(-row.pole.real for row in design.slowest)
    tips = [Tip(plants[1.0, 1.0], q) for q in design.configurations]
    n, m, more = nominal.n_joints, nominal.n_modes, plants[1.0, 1.0]
    seen = measured_amplitudes(nominal, more)
    given = [np.hstack([K[:, :n], K[:, 3 * n : 3 * n + m] @ seen]) for K in gains]
    settling = np.inf
    if stable():
        settling = max(
            tip.settling(loop, K, softest(tip.compliance(held))[1])
            for tip, loop, K, held in zip(tips, stated, gains, given, strict=True)
        )
    return Card(
        limits("gain"),
        limits("payload"),
        limits("stiffness"),
        latest * period,
        min(phase, np.pi),
        damping,
        settling,
        LEFT / slowest if slowest > 0.0 else np.inf,
        _torques_used(design),
        min(softest(tip.compliance())[0] for tip in tips),
        min(softest(tip.compliance(held))[0] for tip, held in zip(tips, given, strict=True)),
    )


def _torques_used(design):
    """`Card.torque_used` of a design."""
    known = design.arm.known
    if not known.most_modes or not np.isfinite(known.torque_limits).any():
        return None
    return np.array([torque_used(design, f) for f in (1.0, design.uncertainty.payload[1])])


def torque_used(design, payload):
    """One row of `Card.torque_used`, (n,), with a factor of the payload [-]."""
    nominal, plant = build(design.arm.known), build(scaled(richer(design.arm.whole), payload, 1.0))
    limit, largest = np.array(nominal.arm.torque_limits), np.zeros(nominal.n_joints)
    for q in design.configurations:
        period = 2.0 * np.pi / nominal.frequencies(q, locked=True)[0]
        try:
            moving = Motion(plant, q, period, period / PEAK_STEPS).torque + static_torque(plant, q)
        except ModelError:
            return np.full_like(largest, np.nan)
        np.maximum(largest, np.abs(moving).max(axis=(0, 1)), out=largest)
    return largest / limit


def poles(design):
    """Poles of all loops of a design: for each loop (name, fraction of the decay that is asked, s (k,) [1/s])."""
    return [
        (loop.name, loop.fraction, np.log(eigenvalues(loop, K)[1]) / loop.period)
        for loop, K in design.loops()
    ]


def _poles(loop, K):
    return eigvals(loop.F - loop.G @ (K @ loop.N), check_finite=False)


def limit(stable, low, high, bisections=BISECTIONS):
    """The limit between `low` and `high` up to which `stable` is true; infinite if it is true up to `high`.

    A coarse search outwards comes first, then the `bisections`. If `stable` is false at `low`, the limit is `low`.
    """
    if not stable(low):
        return low
    # Outwards first, since beyond the first instability a loop may be stable again.
    steps = np.geomspace(max(low, 0.25), high, 9)[1:]
    for step in steps:
        if not stable(step):
            high = step
            break
        low = step
    else:
        return np.inf
    for _ in range(bisections):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low
