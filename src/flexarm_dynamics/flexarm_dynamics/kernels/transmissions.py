# SPDX-License-Identifier: Apache-2.0
"""Play and springs of transmissions, and friction that slips, for `kernels.chain`."""

import numpy as np

from .chain_data import ENGAGEMENT


def dead_zone(x, half, rounding):
    """What a deflection x has left beyond a play of +-half, with corners rounded over a width."""
    if rounding == 0.0:
        return x - 0.5 * (abs(x + half) - abs(x - half))
    w2, a, b = rounding * rounding, x + half, x - half
    return x - 0.5 * (np.sqrt(a * a + w2) - np.sqrt(b * b + w2))


def dead_zone_slope(x, half, rounding):
    """Derivative of `dead_zone`."""
    if rounding == 0.0:
        return 1.0 if abs(x) >= half else 0.0
    a, b = x + half, x - half
    return 1.0 - 0.5 * (a / np.hypot(a, rounding) - b / np.hypot(b, rounding))


def dead_zone_energy(x, half, rounding):
    """Integral of `dead_zone` from the middle of the play to x."""
    if rounding == 0.0:
        s = dead_zone(x, half, rounding)
        return 0.5 * s * s
    w2, a, b = rounding * rounding, x + half, x - half
    left = a * np.sqrt(a * a + w2) + w2 * np.arcsinh(a / rounding)
    right = b * np.sqrt(b * b + w2) + w2 * np.arcsinh(b / rounding)
    middle = half * np.sqrt(half * half + w2) + w2 * np.arcsinh(half / rounding)
    return 0.5 * x * x - 0.25 * (left - right) + 0.5 * middle


def spring_damping(c, s):
    """Damping of a transmission with the constants c, whose spring is deflected by s.

    Within the play it is c[5]. It goes over to c[1] with s^2/(s^2 + w^2), w a tenth of half the play and the
    rounding, so that the torque has no jump where the flanks meet.
    """
    value = c[1]
    if c[2] != 0.0 and c[1] != c[5]:
        width = ENGAGEMENT * c[2] + c[4]
        value = c[5] + (c[1] - c[5]) * (s * s / (s * s + width * width))
    return value + c[3] * c[0] * abs(s)


def spring_torque(c, x, rate):
    """Torque that a transmission with the constants c transmits from link to motor, deflected by x."""
    s = dead_zone(x, c[2], c[4])
    return c[0] * s + spring_damping(c, s) * rate


def slip_level(d, i, delta, delta_d, rate):
    """Level of joint i's friction beyond Coulomb's, its motor turning with this rate."""
    c, level = d.slip[i], 0.0
    if c[0] != 0.0:
        x = rate / c[1]
        level += c[0] * np.exp(-x * x)
    if c[2] != 0.0:
        row = d.spring[i]
        level += c[2] * abs(spring_torque(d.transmission[i], delta[row], delta_d[row]))
    return level


def take_off_slip(d, delta, delta_d, qd, driven, torque):
    """Take the joints' friction beyond Coulomb's off the net torque, in place."""
    for i in range(d.links):
        c = d.slip[i]
        if not driven[i] and (c[0] != 0.0 or c[2] != 0.0):
            torque[i] -= slip_level(d, i, delta, delta_d, qd[i]) * np.tanh(qd[i] / c[3])
