# SPDX-License-Identifier: Apache-2.0
r"""Whether an arm comes to rest after a motion that takes as much of its torque as a plan does.

At a torque limit the feedback is weaker than the gains demand. A loop that is stable with its gains, and with any fixed
fraction of them, may still oscillate with growing amplitude there, since fast gains demand much torque. So the loops
with the heaviest payload are simulated with the torque limits of the arm file. All joints move at once in the time of
`settling`, in the direction from one configuration of the design to another (with a single configuration: all joints
alike). The motion is so large that the feed-forward for the arm of the file takes as much of the limits as a plan
(`Uncertainty.torque_share`, `torque_for_motion`), or that a joint reaches its velocity limit. The torque of the
feed-forward is :math:`u_m`; it includes the file's weight. The feedback after the filters is y. It includes
:math:`u_h`, the additional weight of the heavier payload at rest, which the integral holds. The torque that is sent is
v, as `saturation: together` sends it,

.. math:: y_k = u_h + (V - DKN)\,X_k, \qquad
    v_k = u_m + \min_i\Bigl(1, \frac{\pm u_{max,i} - u_{m,i}}{y_{k,i}}\Bigr)\,y_k ,

and at most :math:`u_{max}`. If the integral of a joint would push it further beyond its limit, it is held
(`slow.joint_pid`). With V, D and E of `loop`,

.. math:: X_{k+1} = (F - GKN)\,X_k + S f_k + E\,(v_k - u_m - y_k) .

Friction, the limit of the torque's rate, and the limit of the integral are left out.
"""

from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.linear import static_torque
from flexarm_dynamics.models.model import build

from ..feedforward.base import torque_for_motion
from ..kernels import compiled
from .loop import sampled_loop
from .settling import ANGLE, MOTION, TOLERANCE, Motion
from .tip import Tip
from .uncertain import richer

#: Largest speed of a quintic over its mean speed [-].
PEAK = 1.875
#: The tip is watched for this many locked periods after the motion.
WATCHED = 8.0
#: An arm does not come back from its limits if they make it settle more than this many locked periods later.
LATER = 2.0
#: Two directions count as one if the cosine of the angle between them is larger than this.
ALIKE = 0.99


@dataclass(frozen=True)
class Recovery:
    """Times until the tip has settled after such motions, in locked periods; infinite: not within `WATCHED`.

    Attributes
    ----------
    limited, unlimited : float
        The longest with the arm file's torque limits, and the longest without limits.
    later : float
        The largest increase of this time by the limits, of all motions.
    """

    limited: float
    unlimited: float
    later: float

    @classmethod
    def of(cls, pairs):
        """The `Recovery` for `pairs` of times with and without limits, one per motion; None if there are no pairs.

        If the tip does not settle without limits either, the limits are not the cause, and the increase counts as 0.
        """
        if not pairs:
            return None
        later = [with_ - none if np.isfinite(none) else 0.0 for with_, none in pairs]
        limited, unlimited = np.max(pairs, axis=0)
        return cls(float(limited), float(unlimited), float(max(later)))

    @property
    def comes_back(self):
        """Whether the limits make the tip settle at most `LATER` later."""
        return self.later <= LATER


def recovery(nominal, at, sampling, uncertainty, sets):
    """The `Recovery` of an arm with its heaviest payload.

    None if the links do not bend, if a joint has no torque limit, or if in every configuration the weight leaves no
    torque for a motion or the arm does not rest.

    Parameters
    ----------
    nominal : ArmModel
        Of the arm file, n joints, m modes.
    at : ndarray, shape (k, n)
        Configurations of the design [rad].
    sampling : Sampling
    uncertainty : Uncertainty
    sets : ndarray, shape (1 or k, n, 3n + 2m)
        Gains: one set, or one for each configuration.
    """
    limit, share = np.array(nominal.arm.torque_limits), uncertainty.torque_share
    if not nominal.n_modes or not np.isfinite(limit).all():
        return None
    arm, ways = richer(nominal.arm.whole), _ways(at, any(nominal.arm.gravity))
    model, plant = build(arm), build(scaled(arm, uncertainty.payload[1], 1.0))
    pairs = []
    for k, q in enumerate(at):
        period = 2.0 * np.pi / nominal.frequencies(q, locked=True)[0]
        motion = Motion(model, q, period, sampling.period)
        try:
            loop = sampled_loop(nominal, plant, q, sampling)
            forces, push = motion.leaves(plant, sampling.period)
            weight = static_torque(model, q)
            heavier = static_torque(plant, q) - weight
        except ModelError:  # too heavy to rest there
            continue
        after = int(np.ceil(WATCHED * period / sampling.period))
        tip = Tip(plant, q).J / (TOLERANCE * arm.reach)
        room = torque_for_motion(limit, weight, share) - np.abs(weight)
        one = _Limited(loop, sets[min(k, len(sets) - 1)], push, tip, heavier, after)
        for way in ways:
            torque = motion.torque.transpose(0, 2, 1) @ way
            part = _part(torque, room, way, arm.velocity_limits, period)
            if part > 0.0:
                given = part * forces @ way, weight + part * torque, weight
                pairs.append(
                    [one.settling(*given, most) / period for most in (limit, np.inf * limit)]
                )
    return Recovery.of(pairs)


def _part(torque, room, way, fastest, period):
    """Factor of the motion; below zero if there is no `room` for it.

    Parameters
    ----------
    torque : ndarray, shape (k, n)
        Of the motion [N m].
    room, fastest : ndarray, shape (n,)
        Largest torques [N m] and speeds [rad/s] that the motion may have.
    way : ndarray, shape (n,)
        Angle by which each joint moves, over `settling.ANGLE`.
    period : float
        Of the lowest mode, joints locked [s].
    """
    with np.errstate(divide="ignore"):
        by_torque = room / np.abs(torque).max(axis=0)
        by_speed = fastest / (PEAK * ANGLE * np.abs(way) / (MOTION * period))
    return min(by_torque.min(), by_speed.min())


def _ways(at, both):
    """Unit vectors (n,) between the configurations, each direction once; `both`: their opposites as well."""
    out = []
    for i, a in enumerate(at):
        for b in at[:i]:
            length = np.linalg.norm(a - b)
            if length > 0.0 and all(abs(way @ (a - b)) < ALIKE * length for way in out):
                out.append((a - b) / length)
    n = at.shape[1]
    out = out or [np.full(n, n**-0.5)]
    return [*out, *(-way for way in out)] if both else out


class _Limited:
    """One loop under torque limits.

    Parameters
    ----------
    loop : Loop
    K : ndarray, shape (n, 3n + 2m)
    push : ndarray, shape (s, h)
        Change of the plant's state in one sample by a unit of each force.
    tip : ndarray, shape (3, h)
        Jacobian of the tip by joints and deflections, over the tolerance.
    held : ndarray, shape (n,)
        Torque of the feedback at rest [N m].
    after : int
        Number of samples that are simulated after a motion.
    """

    def __init__(self, loop, K, push, tip, held, after):
        n, size = len(K), len(loop.F)
        feedback = K @ loop.N
        self._A = np.ascontiguousarray(loop.F - loop.G @ feedback)
        self._sent = np.ascontiguousarray(loop.sent - loop.through @ feedback)
        self._effect, self._held = np.ascontiguousarray(loop.effect), held
        self._integral = np.argmax(loop.N[2 * n : 3 * n], axis=1)  # the state -w of each joint
        self._push, self._period, self._after = push, loop.period, after
        self._C = np.zeros((3, size))
        self._C[:, : tip.shape[1]] = tip

    def settling(self, forces, torque, weight, limit):
        """Time from the end of a motion until the tip has settled [s]; infinite: not in the samples after it.

        Parameters
        ----------
        forces : ndarray, shape (k, h)
            That the feed-forward leaves to the feedback.
        torque : ndarray, shape (k, n)
            Of the motion, weight included; after the motion it is the `weight` (n,) [N m].
        limit : ndarray, shape (n,)
            [N m]
        """
        X = self.states(forces, torque, weight, limit)[len(forces) :]
        outside = np.flatnonzero(~(((X @ self._C.T) ** 2).sum(axis=1) <= 1.0))
        if not outside.size:
            return 0.0
        return np.inf if outside[-1] == self._after else float(self._period * (outside[-1] + 1))

    def states(self, forces, torque, weight, limit):
        """X of all samples, beginning at rest, (k + after + 1, N)."""
        count = len(forces) + self._after
        pushes = np.zeros((count, len(self._A)))
        pushes[: len(forces), : len(self._push)] = forces @ self._push.T
        motion = np.vstack([torque, np.tile(weight, (self._after, 1))])
        X = np.zeros((count + 1, len(self._A)))
        law = self._A, self._sent, self._effect, self._integral
        compiled().limited_steps(*law, self._held, pushes, motion, limit, X)
        return X
