# SPDX-License-Identifier: Apache-2.0
"""How the loop of a design runs: rate, delay, filters, and how much of the friction the control cancels."""

from dataclasses import dataclass

import numpy as np

from ..fading import lowest
from .loop import Sampling
from .uncertain import configurations, reach, resting

#: Decay over omega_1, and noise over the torque limit, at which the fastest design aims.
FASTEST, NOISIEST = 0.6, 0.03
#: Lowest speed; a lower one counts as this.
SLOWEST = 0.05
#: Time that a torque takes between processes, in addition to one period [s].
TRANSPORT = 1e-3
#: Corner of the filtered derivatives: the first number times omega_c, but at most one radian per sample. For a fast
#: arm the lag of such a filter matters. So the corner is at least the second number times omega_1, or the third number
#: in radians per sample if that is lower.
FILTER, FAST_ARM, PER_SAMPLE = 2.0, 15.0, 2.0
#: Fraction of the file's Coulomb friction that is cancelled, since friction may be less by a fifth. The fraction is
#: smaller if friction would move a joint farther than this angle [rad] before the torque can answer. With full
#: cancellation such a joint would hunt.
CANCELLED, KICK = 0.8, np.radians(0.1)
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
