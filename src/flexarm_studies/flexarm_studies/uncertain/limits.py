# SPDX-License-Identifier: Apache-2.0
r"""Computes how quiet an arm can get: links ring while friction holds the joints, and no torque reaches some modes.

With the joints held, (2) gives the torque of the mode phi at the frequency omega on the joints

.. math:: \tau = (K_1 - \omega^2M_{12})\,\phi\,a

for the amplitude a. As long as the friction f_c is larger at every joint, no joint turns, and the links ring with their
own damping, unless the control adds torque beyond the friction. This holds up to the rms of the tip

.. math:: r = \frac{|J\phi|}{\sqrt2}\,\min_j\frac{f_{cj}}{|\tau_j|/a}

with the tip's displacement J phi. If tau is zero, no torque reaches the mode, and r is infinite.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

#: Torque does not reach a mode if the mode's torque on the joints is below this fraction of the torque of a mode that
#: moves with the hub [-].
REACHED = 1e-6
#: Largest amplitude of a mode for the derivative of the tip [m], [rad].
STEP = 1e-6


@dataclass(frozen=True)
class Ringing:
    """A mode with joints held.

    Attributes
    ----------
    frequency : float
        [Hz].
    reached : bool
        Whether any joint's torque moves it.
    held : float
        Rms of the tip below which friction holds the joints, as a fraction of the reach [-]; infinite: not `reached`.
    """

    frequency: float
    reached: bool
    held: float


def ringing(plant, q):
    """Every mode of a plant with its joints held at `q`, the lowest first.

    Parameters
    ----------
    plant : ArmModel
    q : ndarray, shape (n,)
        [rad].

    Returns
    -------
    list of Ringing
    """
    n = plant.n_joints
    terms = plant.terms(q, np.zeros(n))
    hubs = np.sqrt(np.diag(terms.M)[:n])
    friction = plant.friction_table()[:, 1]
    sag = plant.static_deflection(q)
    rest = plant.tip_position(q, sag)
    found = []
    squares, shapes = eigh(terms.K2, terms.M[n:, n:])
    for square, shape in zip(squares, shapes.T, strict=True):
        torque = np.abs(terms.K1 @ shape - square * (terms.M[:n, n:] @ shape))
        # The shape has a kinetic energy of one half at the rate one, like a hub that turns at 1/sqrt(M_jj).
        reached = bool(np.any(torque > REACHED * square * hubs))
        step = STEP / np.abs(shape).max()
        tip = np.linalg.norm(plant.tip_position(q, sag + step * shape) - rest) / step
        held = np.inf
        if reached:
            # A joint on which the mode does not act does not turn, whatever the amplitude.
            bears = np.divide(friction, torque, out=np.full(n, np.inf), where=torque > 0.0)
            held = float(bears.min() * tip / (np.sqrt(2.0) * plant.arm.reach))
        found.append(Ringing(float(np.sqrt(square)) / (2.0 * np.pi), reached, held))
    return found
