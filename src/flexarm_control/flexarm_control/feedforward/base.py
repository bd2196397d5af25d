# SPDX-License-Identifier: Apache-2.0
"""Base class of feed-forwards."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from ..component import Component

#: Fraction of the torque limits that a planned motion takes by default [-].
SHARE = 0.95


def torque_for_motion(limit, weight, share):
    """Largest torque that a motion should take, (…, n) [N m], of the `limit` (n,).

    It is the fraction `share` of the limit. If the weight takes most of that, it is the `weight` (…, n), and half of
    this fraction of what the weight leaves.
    """
    weight = np.abs(weight)
    return np.maximum(share * limit, weight + 0.5 * share * (limit - weight))


@dataclass(frozen=True)
class Settings:
    """What a feed-forward is designed for."""

    period: float  # of the samples [s]
    configuration: np.ndarray  # of the joints, (n,) [rad]
    known: object = None  # the control's own `ArmModel`, if the feed-forward's model has more
    spread: float = 0.0  # relative error of frequencies, of modes that the joints hardly move [-]
    share: float = SHARE  # fraction of the torque limits that a planned motion takes [-]


class Feedforward(Component, ABC):
    """A motion of the whole arm, bending included, near the reference, and the torque that produces it.

    A feed-forward is registered by name in the entry-point group ``flexarm.feedforwards``. The composite control holds
    the arm to the motion: its slow law tracks the joints of this motion, its fast law the deflections.

    Parameters
    ----------
    model : ArmModel
    manifold : Manifold
    settings : Settings

    Attributes
    ----------
    position, velocity, acceleration : ndarray, shape (n,)
        Joints of the motion at the present sample [rad], [rad/s], [rad/s^2].
    amplitude, rate : ndarray, shape (m,)
        Its deflections [m, rad] and their rates.
    torque : ndarray, shape (n,)
        Torque that produces the motion [N m].
    limit : ndarray, shape (n,)
        Active torque limit [N m]; infinite: none.
    """

    #: Whether `prepare` has anything to do.
    plans = False
    #: Whether the motion was set to another state at the present sample, instead of moving on.
    placed = False

    def __init__(self, model, manifold, settings):
        super().__init__(model)
        n, m = model.n_joints, model.n_modes
        self.manifold, self.settings = manifold, settings
        self.position, self.velocity, self.acceleration = np.zeros(n), np.zeros(n), np.zeros(n)
        self.amplitude, self.rate, self.torque = np.zeros(m), np.zeros(m), np.zeros(n)
        self.limit = np.full(n, np.inf)

    def near(self, offset):
        """State (position, velocity, acceleration), (3, n), at an offset [s], with constant acceleration."""
        out = np.empty((3, self.position.size))
        out[0] = self.position + offset * (self.velocity + 0.5 * offset * self.acceleration)
        out[1] = self.velocity + offset * self.acceleration
        out[2] = self.acceleration
        return out

    def take(self, plan, trajectory_id):
        """Follow `plan`, the result of `prepare` or None, as soon as the reference follows its trajectory."""

    def prepare(self, trajectory, start):
        """Do the design work for a trajectory, off the control path; returns None if there is none to do.

        The trajectory will begin from `start`, the reference's state of rest (position, velocity, acceleration),
        (3, n).
        """
        found = self.prepare_next(trajectory, start, None)
        while found is not None and found.left:
            found = self.prepare_next(trajectory, start, found)
        return found

    def prepare_next(self, trajectory, start, found):
        """Do the next part of `prepare` after what was `found` so far (None at first); `left` names further parts."""
        return None

    @abstractmethod
    def update(self, reference, dt):
        """Move on to the present sample; runs on the control path.

        Parameters
        ----------
        reference : ReferenceGenerator
            At the present stamp.
        dt : float
            Time since the last sample [s]; 0: the first sample.
        """

    def look_ahead(self, reference, dt):
        """Compute ahead, between two samples, for the sample that comes after `dt` [s]; changes no result.

        Returns
        -------
        position, velocity, acceleration : ndarray, shape (n,)
            Expected motion at that sample; or None.
        """
        return None
