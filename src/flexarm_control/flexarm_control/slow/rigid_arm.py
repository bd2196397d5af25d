# SPDX-License-Identifier: Apache-2.0
"""The rigid arm that the slow laws use: the same chain with rigid links, and the kinematics of its tip."""

from dataclasses import replace

import numpy as np

from flexarm_dynamics.models.chain import Chain


def rigid_arm(arm):
    """An arm of any model with its links taken as rigid: a `Chain` without modes."""
    return Chain(
        replace(
            arm,
            model="chain",
            model_options={},
            links=tuple(replace(link, flexible={}) for link in arm.links),
            gauges=(),
            observed_modes=(),
        )
    )


class Tip:
    """Kinematics of the straight arm's tip.

    Parameters
    ----------
    arm : Arm
    """

    def __init__(self, arm):
        self._chain = rigid_arm(arm)
        self._axes = self._chain.data.axis
        #: Distance from the first joint that the tip can't exceed [m].
        self.reach = arm.reach + sum(
            float(np.linalg.norm(joint.origin_xyz)) for joint in arm.joints[1:]
        )

    def at(self, q, qd):
        """Position and Jacobian of the tip, and its acceleration beyond J qdd.

        Parameters
        ----------
        q, qd : ndarray, shape (n,)
            Joint position [rad] and velocity [rad/s].

        Returns
        -------
        position : ndarray, shape (3,)
            In the base frame [m].
        J : ndarray, shape (3, n)
            Jacobian of the position [m].
        bias : ndarray, shape (3,)
            dJ/dt qd [m/s^2]: the links' centripetal accelerations, and those due to joint axes that turn.
        """
        R, p = self._chain.frames(q)
        axes = np.einsum("ijk,ik->ij", R[:-1], self._axes)
        J = _cross(axes, p[-1] - p[:-1]).T
        spin = axes * qd[:, None]
        omega = np.cumsum(spin, axis=0)
        alpha = np.cumsum(_cross(omega - spin, spin), axis=0)
        arms = np.diff(p, axis=0)
        bias = _cross(alpha, arms) + _cross(omega, _cross(omega, arms))
        return p[-1], J, bias.sum(axis=0)


def _cross(a, b):
    """Cross products of rows; numpy's own takes ten times as long for a few of them."""
    return a[:, _NEXT] * b[:, _LAST] - a[:, _LAST] * b[:, _NEXT]


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
