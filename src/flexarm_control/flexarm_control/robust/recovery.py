# SPDX-License-Identifier: Apache-2.0
r"""Whether an arm comes to rest after a motion that takes nearly all the torque it has.

Where a torque is at its limit, less is fed back than the gains ask for. A loop that is stable with its gains, and with
any fixed part of them, may swing up there: fast gains ask for much torque. So the loops of the heaviest payload are
followed with the torque limits of the arm file. All joints move at once in the time of `settling`, from one
configuration of the design towards another (of a single configuration: all joints alike), so far that the feed-forward
for the arm of the file takes `SHARE` of the limits, or a joint has the largest speed it may have. The feed-forward's
torque is :math:`u_m`, the file's weight included. The feedback is y, after the filters, with the rest :math:`u_h` of
the heavier weight, which the integral holds. What is sent is v, as `saturation: together` sends it,

.. math:: y_k = u_h + (V - DKN)\,X_k, \qquad
    v_k = u_m + \min_i\Bigl(1, \frac{\pm u_{max,i} - u_{m,i}}{y_{k,i}}\Bigr)\,y_k ,

and at most :math:`u_{max}`. The integral of a joint that is pushed further is held (`slow.joint_pid`). With V, D and E
of `loop`,

.. math:: X_{k+1} = (F - GKN)\,X_k + S f_k + E\,(v_k - u_m - y_k) .

Left out are friction, the limit of the torque's rate, and that of the integral.
"""

from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.linear import static_torque
from flexarm_dynamics.models.model import build

from ..kernels import compiled
from .loop import sampled_loop
from .settling import ANGLE, MOTION, TOLERANCE, Motion
from .tip import Tip
from .uncertain import richer

#: Part of the torque limits that the motion takes [-].
SHARE = 0.9
#: Largest speed of a quintic over its mean speed [-].
PEAK = 1.875
#: The tip is looked at for so many locked periods after the motion.
WATCHED = 8.0
#: An arm does not come back where the limits make it settle by more than so many locked periods later.
LATER = 2.0
#: Directions whose angle has a larger cosine than this are one.
ALIKE = 0.99


@dataclass(frozen=True)
class Recovery:
    """Times until the tip has settled after such motions, in locked periods; infinite: not while watched.

    Attributes
    ----------
    limited, unlimited : float
        The longest with the arm file's torque limits, and the longest without any.
    later : float
        By how much the limits make it longer, of the motion with the largest difference.
    """

    limited: float
    unlimited: float
    later: float

    @classmethod
    def of(cls, pairs):
        """That of motions whose times with and without limits are `pairs`; None if there are none.

        Where the tip does not settle without limits, these are not what is in the way.
        """
        if not pairs:
            return None
        later = [with_ - none if np.isfinite(none) else 0.0 for with_, none in pairs]
        limited, unlimited = np.max(pairs, axis=0)
        return cls(float(limited), float(unlimited), float(max(later)))

    @property
    def comes_back(self):
        """Whether the limits make it settle at most `LATER` later."""
        return self.later <= LATER


def recovery(nominal, at, sampling, uncertainty, sets):
    """The `Recovery` of an arm with its heaviest payload.

    None if the links do not bend, a joint has no torque limit, or the weight alone takes the torque everywhere.

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
    limit = np.array(nominal.arm.torque_limits)
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
        except ModelError:  # heavier than what rests there
            continue
        after = int(np.ceil(WATCHED * period / sampling.period))
        tip = Tip(plant, q).J / (TOLERANCE * arm.reach)
        one = _Limited(loop, sets[min(k, len(sets) - 1)], push, tip, heavier, after)
        for way in ways:
            torque = motion.torque.transpose(0, 2, 1) @ way
            part = _part(torque, SHARE * limit - np.abs(weight), way, arm.velocity_limits, period)
            if part > 0.0:
                given = part * forces @ way, weight + part * torque, weight
                pairs.append(
                    [one.settling(*given, most) / period for most in (limit, np.inf * limit)]
                )
    return Recovery.of(pairs)


def _part(torque, room, way, fastest, period):
    """By what the motion is multiplied; below zero where there is no `room` for it.

    Parameters
    ----------
    torque : ndarray, shape (k, n)
        Of the motion [N m].
    room, fastest : ndarray, shape (n,)
        Torques [N m] and speeds [rad/s] that it may have.
    way : ndarray, shape (n,)
        Of the joints, in `settling.ANGLE`.
    period : float
        [s]
    """
    with np.errstate(divide="ignore"):
        by_torque = room / np.abs(torque).max(axis=0)
        by_speed = fastest / (PEAK * ANGLE * np.abs(way) / (MOTION * period))
    return min(by_torque.min(), by_speed.min())


def _ways(at, both):
    """Unit vectors (n,) from each configuration to the others, each direction once; `both`: and back again."""
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
        What a force does to the plant's state in one sample.
    tip : ndarray, shape (3, h)
        Jacobian of the tip by joints and deflections, over the tolerance.
    held : ndarray, shape (n,)
        Torque that is fed back at rest [N m].
    after : int
        Samples that are looked at after a motion.
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
        """Time from the end of a motion until the tip has settled [s].

        Parameters
        ----------
        forces : ndarray, shape (k, h)
            Left to the feedback.
        torque : ndarray, shape (k, n)
            Of the motion, weight included; after it the `weight` (n,) [N m].
        limit : ndarray, shape (n,)
            [N m]
        """
        X = self.states(forces, torque, weight, limit)[len(forces) :]
        outside = np.flatnonzero(~(((X @ self._C.T) ** 2).sum(axis=1) <= 1.0))
        if not outside.size:
            return 0.0
        return np.inf if outside[-1] == self._after else float(self._period * (outside[-1] + 1))

    def states(self, forces, torque, weight, limit):
        """X of all samples, from rest on, (k + after + 1, N)."""
        count = len(forces) + self._after
        pushes = np.zeros((count, len(self._A)))
        pushes[: len(forces), : len(self._push)] = forces @ self._push.T
        motion = np.vstack([torque, np.tile(weight, (self._after, 1))])
        X = np.zeros((count + 1, len(self._A)))
        law = self._A, self._sent, self._effect, self._integral
        compiled().limited_steps(*law, self._held, pushes, motion, limit, X)
        return X
