# SPDX-License-Identifier: Apache-2.0
"""Says in words why a design is no faster, or why no gains hold, and what would help."""

import numpy as np

from .loop import APART, STICKS
from .settings import FASTEST, NOISIEST, SLOWEST

#: Torque hardly moves a pole if the gradient of its value by the scaled gains is shorter than the first number [-]. A
#: pole is too fast for the loop if the delay turns the torque for it by more than the second [rad].
HARDLY, FAST = 1.0, 0.5
#: Why a design has a lower speed than requested.
FROM_LIMITS = "an arm with faster gains would not come back from them in time"


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
