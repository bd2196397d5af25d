# SPDX-License-Identifier: Apache-2.0
"""Motions in closed form, and their points for a `trajectory_msgs/JointTrajectory`.

Each motion goes from rest to rest: theta(t) = start + angle sigma(s), s = t / T, sigma from 0 to 1.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import beta, betainc

from flexarm_dynamics.errors import TrajectoryError

#: With a higher smoothness the middle of the motion gets steeper and nothing is gained at its ends.
MAX_SMOOTHNESS = 20
#: A longer motion must be a typing error [s].
MAX_DURATION = 1e9


class Motion(ABC):
    """A motion of n joints, at rest before 0 and after its end.

    Attributes
    ----------
    start, angle : (n,) array
        Positions at t = 0, and how far each joint goes [rad].
    duration : float
        T [s].
    """

    @abstractmethod
    def derivative(self, order, t) -> np.ndarray:
        """Return the derivative of an order from 0 to 2 at t [s], scalar or (k,): (n,) or (k, n)."""

    def position(self, t) -> np.ndarray:
        """Return the positions at t [s], scalar or (k,): (n,) or (k, n) [rad]."""
        return self.derivative(0, t)

    def velocity(self, t) -> np.ndarray:
        """Return the velocities at t [s], scalar or (k,): (n,) or (k, n) [rad/s]."""
        return self.derivative(1, t)

    def acceleration(self, t) -> np.ndarray:
        """Return the accelerations at t [s], scalar or (k,): (n,) or (k, n) [rad/s^2]."""
        return self.derivative(2, t)

    def states(self, t):
        """Return positions, velocities and accelerations at t [s]."""
        return tuple(self.derivative(order, t) for order in range(3))


@dataclass(frozen=True, eq=False)
class Profile(Motion):
    """A motion in closed form, as in the module."""

    start: np.ndarray
    angle: np.ndarray
    duration: float
    shape: tuple[Callable, Callable, Callable]  # sigma and its two derivatives by s in [0, 1] [-]

    def derivative(self, order, t):
        # Rest to rest: beyond either end sigma stays, and its derivatives are 0 as at the end.
        s = np.clip(np.asarray(t, dtype=float) / self.duration, 0.0, 1.0)
        moved = self.shape[order](s)[..., None] * (self.angle / self.duration**order)
        return moved if order else self.start + moved


def paper_profile(duration=2.0, angle=np.pi / 2, start=0.0) -> Profile:
    """Return the motion of the case study of Siciliano & Book (1986), section 5 (fig. 2).

    theta_dot = (angle / T) [1 + sin(2 pi t / T - pi / 2)] = (angle / T) [1 - cos(2 pi t / T)]

    which integrates to theta = angle [s - sin(2 pi s) / (2 pi)], s = t / T. With the defaults
    this is 45 [1 + sin(2 pi t / T - pi / 2)] deg/s, from 0 to 90 deg in 2 s. The published paper
    has 90 instead of 45. That must be a misprint: the mean of the bracket is 1, so that 90 deg/s
    over 2 s would end at 180 deg, but the text ends at 90 deg and designs the fast control there.
    The acceleration is 0 at both ends.

    Parameters
    ----------
    duration : float
        T [s].
    angle : float or (n,) array_like
        How far each joint goes [rad]; a float is one joint.
    start : float or (n,) array_like
        Positions at t = 0 [rad].

    Raises
    ------
    TrajectoryError
        If the duration is not above 0, something is not finite, or the shapes differ.
    """
    start, angle, duration = _checked(start, angle, duration, "angle")
    turn = 2.0 * np.pi
    return Profile(
        start,
        angle,
        duration,
        (
            lambda s: s - np.sin(turn * s) / turn,
            lambda s: 2.0 * np.sin(np.pi * s) ** 2,  # 1 - cos(2 pi s), without cancellation
            lambda s: turn * np.sin(turn * s),
        ),
    )


def quintic(start, end, duration) -> Profile:
    """Return the point-to-point motion with zero velocity and acceleration at both ends.

    sigma = 10 s^3 - 15 s^4 + 6 s^5, the polynomial of least degree with these ends, e.g.
    Biagiotti & Melchiorri (2008), section 2.1.6.

    Parameters
    ----------
    start, end : float or (n,) array_like
        Positions at t = 0 and t = T [rad]; floats are one joint.
    duration : float
        T [s].

    Raises
    ------
    TrajectoryError
        If the duration is not above 0, something is not finite, or the shapes differ.
    """
    start, end, duration = _checked(start, end, duration, "end")
    return Profile(
        start,
        end - start,
        duration,
        (
            lambda s: s**3 * (10.0 + s * (-15.0 + s * 6.0)),
            lambda s: 30.0 * (s * (1.0 - s)) ** 2,
            lambda s: 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s),
        ),
    )


def smooth(start, end, duration, smoothness=3) -> Profile:
    r"""Return the point-to-point motion with k derivatives that vanish at both ends.

    .. math:: \sigma = I_s(k+1, k+1), \qquad
        \sigma' = \frac{s^k (1-s)^k}{B(k+1, k+1)}

    with the beta function B and the regularised incomplete beta function I: the polynomial of
    least degree, 2 k + 1, that has k continuous derivatives together with the rest on both sides. k = 2 is the quintic,
    k = 3 the septic, and so on, e.g. Biagiotti & Melchiorri (2008), section 2.1.7. This form stays accurate for a high
    k, where the power series suffers from cancellation. The more derivatives, the faster the spectrum of the
    acceleration falls (as omega^-k), and the higher the peaks: that of the speed is 1 / (4^k B(k+1, k+1)) times the
    mean speed.

    Parameters
    ----------
    start, end : float or (n,) array_like
        Positions at t = 0 and t = T [rad]; floats are one joint.
    duration : float
        T [s].
    smoothness : int
        k, from 2 to `MAX_SMOOTHNESS`.

    Raises
    ------
    TrajectoryError
        If the smoothness is out of range, and as for `quintic`.
    """
    k = smoothness
    if isinstance(k, bool) or not isinstance(k, int | np.integer) or not 2 <= k <= MAX_SMOOTHNESS:
        limit = f"integers from 2 to {MAX_SMOOTHNESS}"
        raise TrajectoryError("is not possible", field="smoothness", value=k, limit=limit)
    start, end, duration = _checked(start, end, duration, "end")
    peak = 1.0 / beta(k + 1, k + 1)
    return Profile(
        start,
        end - start,
        duration,
        (
            lambda s: betainc(k + 1, k + 1, s),
            lambda s: peak * (s * (1.0 - s)) ** k,
            lambda s: peak * k * (s * (1.0 - s)) ** (k - 1) * (1.0 - 2.0 * s),
        ),
    )


class SampledProfile(NamedTuple):
    """A profile's points, all fields given: quintic interpolation."""

    times: np.ndarray  # from 0, (k,) [s]
    positions: np.ndarray  # (k, n) [rad]
    velocities: np.ndarray  # (k, n) [rad/s]
    accelerations: np.ndarray  # (k, n) [rad/s^2]


def sample(profile, n_points) -> SampledProfile:
    """Return a profile at equally spaced times, both ends included.

    Parameters
    ----------
    profile : Motion
    n_points : int
        k, at least 2.

    Raises
    ------
    TrajectoryError
        If there are fewer than 2 points.
    """
    if not isinstance(n_points, int | np.integer) or n_points < 2:
        limit = "integers from 2"
        raise TrajectoryError("is not possible", field="n_points", value=n_points, limit=limit)
    times = np.linspace(0.0, profile.duration, n_points)
    return SampledProfile(times, *profile.states(times))


def rows(points):
    """Return a `SampledProfile` as the `points` that `flexarm_control.trajectory.validate` takes."""
    lists = (values.tolist() for values in points)
    return [(round(1e9 * t), *values, []) for t, *values in zip(*lists, strict=True)]


def _checked(start, other, duration, other_name):
    """Return `start` and `other` as (n,) arrays of one length, and the duration as a float."""
    try:
        duration = float(duration)
        start, other = np.broadcast_arrays(
            np.atleast_1d(np.array(start, dtype=float)), np.atleast_1d(np.array(other, dtype=float))
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise TrajectoryError(
            str(error),
            field=f"start, {other_name}, duration",
            hint="give a number or one per joint for the first two, seconds for the duration",
        ) from None
    if start.ndim != 1:
        raise TrajectoryError(
            f"have shape {start.shape}",
            field=f"start, {other_name}",
            hint="give (n,), one number per joint",
        )
    if not 0.0 < duration <= MAX_DURATION:
        raise TrajectoryError(
            "s is out of range",
            field="duration",
            value=duration,
            limit=f"above 0, at most {MAX_DURATION:g}",
        )
    for name, values in (("start", start), (other_name, other)):
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise TrajectoryError(
                "rad is not finite", field=f"{name}[{bad[0]}]", value=float(values[bad[0]])
            )
    return start, other, duration
