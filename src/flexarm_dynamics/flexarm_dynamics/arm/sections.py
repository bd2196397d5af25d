# SPDX-License-Identifier: Apache-2.0
r"""Computes the frames of the sections of bent and twisted links, for pictures and for the rigid pieces of a URDF.

A section at x of a link has the frame that the link's tip would have if the link ended there. It always comes from the
chain model (`chain`), since the models of one link have the same mode shapes. The data that do not change with the
motion are prepared once; an evaluation then takes about 20 us per section.
"""

from dataclasses import replace

import numpy as np

from ..models.chain import Chain


class Sections:
    """Sections of all links, evenly spaced from base to tip.

    Parameters
    ----------
    model : ArmModel
    count : int
        Spaces between the sections of a flexible link; a rigid one has its two ends.
    linear : bool
        True: displacements are linear in the deflections, whatever the arm's level. This is for exaggerated
        deflections, which may be larger than a link of constant length allows.

    Attributes
    ----------
    positions : list of (k,) ndarray
        Positions of each link's sections from its base [m].
    """

    def __init__(self, model, count=16, linear=False):
        self.chain = chain = chain_of(model, linear)
        self.positions = [
            np.linspace(0.0, link.length, count + 1 if link.flexible else 2)
            for link in chain.arm.links
        ]
        self._cuts = [
            [chain._packed(chain._cut(i, x)) for x in places]
            for i, places in enumerate(self.positions)
        ]
        self._zero = np.zeros(chain.n_joints), np.zeros(chain.n_modes)
        self._R, self._p = np.zeros((chain.n_joints + 1, 3, 3)), np.zeros((chain.n_joints + 1, 3))

    def frames(self, q, delta=None):
        """Frames of the sections in the base frame.

        Parameters
        ----------
        q : (n,) array_like
            [rad]
        delta : (m,) array_like, optional
            Modal amplitudes, bending [m], twist [rad]; not given: the straight arm.

        Returns
        -------
        list of (R, p)
            For each link, its sections' orientations (k, 3, 3) and origins (k, 3) [m].

        Raises
        ------
        ShapeError
        """
        chain, R, p = self.chain, self._R, self._p
        q, delta = chain._joint(q, "q"), chain._modal(delta, "delta")
        out = []
        for i, cuts in enumerate(self._cuts):
            turns, places = np.empty((len(cuts), 3, 3)), np.empty((len(cuts), 3))
            for k, cut in enumerate(cuts):
                chain.kernel.frames(cut, chain._work, q, delta, *self._zero, R, p)
                turns[k], places[k] = R[i + 1], p[i + 1]
            out.append((turns, places))
        return out

    def points(self, q, delta=None):
        """Points of each link's axis in the base frame, a list of (k, 3) arrays [m]."""
        return [places for _, places in self.frames(q, delta)]


def chain_of(model, linear=False):
    """The chain model of an arm with the mode shapes of another model of it.

    Parameters
    ----------
    model : ArmModel
    linear : bool
        Whether displacements must be linear in the deflections.

    Returns
    -------
    Chain
    """
    arm = model.arm
    curved = arm.foreshortening or arm.finite_slope
    if isinstance(model, Chain) and not (linear and curved):
        return model
    shapes = {
        (link.name, direction): model.mode_shapes(link.name, direction)
        for link in arm.links
        for direction in link.flexible
    }
    if linear:
        arm = replace(arm, foreshortening=False, finite_slope=False)
    return Chain(replace(arm, model="chain"), shapes=shapes)
