# SPDX-License-Identifier: Apache-2.0
"""Computes a picture of an arm: lines along its links, the path of its tip, arrows for its torques. No ROS."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.arm.sections import Sections

#: Length of the arrow of a joint's whole torque limit, relative to the arm's length [-].
ARROW = 0.6


@dataclass(frozen=True)
class Picture:
    """An arm in its base frame, lengths in metres.

    Attributes
    ----------
    beam : (k, 3) ndarray
        Points along the axes of all links, as they are bent.
    ghost : (l, 3) ndarray
        Points with the same joint angles and straight links.
    joints : (n, 3) ndarray
        Positions of the joints.
    tip : (3,) ndarray
    slow, fast : (n, 2, 3) ndarray
        Arrows of the torques along the joints' axes, from and to. The slow arrow starts at the joint, and the fast
        arrow starts where the slow one ends. So together they end at the sum.
    """

    beam: np.ndarray
    ghost: np.ndarray
    joints: np.ndarray
    tip: np.ndarray
    slow: np.ndarray
    fast: np.ndarray


class Drawer:
    """Draws an arm.

    Parameters
    ----------
    model : ArmModel
    count : int
        Number of straight parts of each flexible link.
    """

    def __init__(self, model, count=12):
        self.arm, self._model, self._count = model.arm, model, count
        self.reach = self.arm.reach
        self._sections, self._ends = Sections(model, count), Sections(model, 1)
        self._linear = None
        self._axes = np.array([joint.axis for joint in self.arm.joints])
        limits = self.arm.torque_limits
        # If the arm file has no limit, the largest torque so far.
        self._open = ~np.isfinite(limits)
        self._full = np.where(self._open, 1e-9, limits)
        self._rest = np.zeros(len(self.arm.modes))

    def picture(self, q, delta=None, slow=None, fast=None, exaggeration=1.0):
        """The arm as it is now, a `Picture`.

        Parameters
        ----------
        q : (n,) array_like
            [rad]
        delta : (m,) array_like, optional
            Modal amplitudes [m, rad]; none: straight.
        slow, fast : (n,) array_like, optional
            Torques [N m].
        exaggeration : float
            Factor by which the deflections are enlarged; other than 1, at first order.

        Raises
        ------
        ShapeError
        """
        delta = self._rest if delta is None else np.asarray(delta, float)
        frames = self._of(exaggeration).frames(q, exaggeration * delta)
        joints = np.array([p[0] for _, p in frames])
        # A joint's own rotation does not move its axis.
        axes = np.array([R[0] @ axis for (R, _), axis in zip(frames, self._axes, strict=True)])
        one, other = self._lengths(slow, fast)
        middle = joints + one[:, None] * axes
        return Picture(
            beam=np.concatenate([p for _, p in frames]),
            ghost=np.concatenate(self._ends.points(q)),
            joints=joints,
            tip=frames[-1][1][-1].copy(),
            slow=np.stack((joints, middle), axis=1),
            fast=np.stack((middle, middle + other[:, None] * axes), axis=1),
        )

    def plan(self, points):
        """The straight arm at the last of some joint positions (k, n) [rad], and the tip's path along them.

        Both are points, (., 3) [m].
        """
        points = np.asarray(points, float)
        way = np.array([self._model.tip_position(q, self._rest) for q in points])
        return np.concatenate(self._ends.points(points[-1])), way

    def tip_error(self, q, delta, reference):
        """Distance of the tip from that of the rigid arm at the reference (n,) [m]."""
        tip = self._model.tip_position(np.asarray(q, float), np.asarray(delta, float))
        wanted = self._model.tip_position(np.asarray(reference, float), self._rest)
        return float(np.linalg.norm(tip - wanted))

    def _of(self, exaggeration):
        if exaggeration == 1.0:
            return self._sections
        if self._linear is None:
            self._linear = Sections(self._model, self._count, linear=True)
        return self._linear

    def _lengths(self, slow, fast):
        """Lengths of the arrows [m]."""
        zero = np.zeros(len(self.arm.joints))
        slow = zero if slow is None else np.asarray(slow, float)
        fast = zero if fast is None else np.asarray(fast, float)
        largest = np.maximum(np.abs(slow), np.abs(fast))
        self._full = np.where(self._open, np.maximum(self._full, largest), self._full)
        return tuple(ARROW * self.reach * torque / self._full for torque in (slow, fast))


class Trail:
    """The newest part of the tip's path.

    Parameters
    ----------
    count : int
        Number of points that are kept.
    gap : float
        A point nearer than this to the one before is left out [m].
    """

    def __init__(self, count, gap):
        self._points, self._gap = deque(maxlen=count), gap
        self._session = None

    def add(self, point, session=0):
        """Add a point; another `session` of the source starts the path again."""
        if session != self._session:
            self._points.clear()
            self._session = session
        if not self._points or np.linalg.norm(point - self._points[-1]) >= self._gap:
            self._points.append(np.array(point))

    def clear(self):
        """Remove all points."""
        self._points.clear()

    @property
    def points(self):
        """(k, 3) ndarray [m]."""
        return np.array(self._points).reshape(-1, 3)
