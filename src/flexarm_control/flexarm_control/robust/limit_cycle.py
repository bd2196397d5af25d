# SPDX-License-Identifier: Apache-2.0
r"""Limit cycles that are likely because of play in a transmission, by the describing function of its dead zone.

For a deflection of amplitude A about the middle of a play of :math:`\pm p`, the first harmonic of the spring's force is
that of a spring with the fraction

.. math:: N(A) = 1 - \frac{2}{\pi}\Bigl(\arcsin\frac pA + \frac pA\sqrt{1-\frac{p^2}{A^2}}\Bigr), \qquad A > p

of the stiffness. The same fraction applies to the spring's damper, which acts only together with it. The loop
oscillates if it has poles on the unit circle with this fraction. This is the harmonic balance of the sampled loop,
filters and delay included. The oscillation keeps its amplitude if a larger one decays, that is, if the loop is unstable
below this fraction and stable above. It is likely only if smaller oscillations also grow fast: a link in its play
drifts, and friction damps an oscillation that hardly grows. Higher harmonics are left out: frequency and amplitude are
right within some ten percent.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from flexarm_dynamics.linear import softened, state_at_rest

#: Fractions of the stiffness that are tried, and the least frequency of an oscillation over the sampling frequency.
FRACTIONS, SLOWEST = np.geomspace(1.0, 0.05, 30), 1e-4
#: A limit cycle is likely if, at half its fraction, the oscillation has at least this negative damping ratio [-].
MIN_GROWTH = 0.01
#: Bisections of the fraction at which a pole crosses the unit circle.
BISECTIONS = 30


def describing_function(amplitude, half):
    """N(A) of a dead zone of +- `half` [rad]; 0 for an amplitude within it."""
    if amplitude <= half:
        return 0.0
    ratio = half / amplitude
    return 1.0 - 2.0 / np.pi * (np.arcsin(ratio) + ratio * np.sqrt(1.0 - ratio**2))


@dataclass(frozen=True)
class LimitCycle:
    """An oscillation that play sustains.

    Attributes
    ----------
    joint : str
    frequency : float
        [Hz]
    amplitude : float
        Of the link's deflection against the motor [rad].
    load : float
        Torque that presses the flanks together at rest [N m]; they do not part while the oscillation's torque is less.
    """

    joint: str
    frequency: float
    amplitude: float
    load: float

    @property
    def text(self):
        """One line of text for the user."""
        start = ""
        if self.load > 0.0:
            start = f"; the load of {self.load:.3g} N m keeps the flanks together until more than that shakes them"
        return (
            f"play of {self.joint}: the loop is likely to oscillate at {self.frequency:.3g} Hz, the link by"
            f" +-{1e3 * self.amplitude:.3g} mrad against its motor{start}; lower the gains, or measure"
            " the motor's angle"
        )


def limit_cycles(plant, q, A, poles, period):
    """Limit cycles of a loop, at most one for each joint.

    Parameters
    ----------
    plant : ArmModel
        The controlled arm, with its play.
    q : ndarray, shape (n,)
        Where it rests [rad].
    A : ndarray
        Of the plant at rest there, as `linear_plant` gives it.
    poles : callable
        Takes a changed A, and returns the poles z of the sampled loop.
    period : float
        Of the samples [s].

    Returns
    -------
    list of LimitCycle
    """
    found = []
    rest = state_at_rest(plant.without_play(), q)
    for joint in plant.arm.joints:
        if joint.transmission is None or not joint.transmission.play:
            continue
        place = plant.n_joints + plant.mode_names.index(f"{joint.name}_transmission")

        def oscillating(fraction, place=place, gear=joint.transmission):
            """The pole with the largest modulus of those that oscillate."""
            z = poles(softened(plant, q, A, place, gear, fraction)).astype(complex)
            z = z[np.abs(np.angle(z)) > 2.0 * np.pi * SLOWEST]
            return z[np.argmax(np.abs(z))]

        crossing = _crossing(oscillating)
        if crossing is None:
            continue
        fraction, z = crossing
        s = np.log(oscillating(0.5 * fraction))
        if s.real < MIN_GROWTH * abs(s):
            continue
        half = 0.5 * joint.transmission.play
        amplitude = brentq(
            lambda a, h=half, N=fraction: describing_function(a, h) - N, half, 1e4 * half
        )
        frequency = abs(float(np.angle(z))) / (2.0 * np.pi * period)
        load = abs(joint.transmission.stiffness * rest[place])
        found.append(LimitCycle(joint.name, frequency, float(amplitude), float(load)))
    return found


def _crossing(oscillating):
    """The largest fraction below which the loop is unstable and above which it is stable, and the pole there.

    None if the loop is unstable with closed play, or stable at all `FRACTIONS`.
    """
    stable = None
    for fraction in FRACTIONS:
        grows = abs(oscillating(fraction)) > 1.0
        if not grows:
            stable = fraction
            continue
        if stable is None:  # unstable with closed play
            return None
        low, high = fraction, stable
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if abs(oscillating(middle)) > 1.0 else (low, middle)
        return low, oscillating(low)
    return None
