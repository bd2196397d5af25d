# SPDX-License-Identifier: Apache-2.0
r"""Finds gauges whose zero drifts, too slowly for a jump, and readings of a joint that the links do not follow.

The law of `strain_law`, without its high pass, gives for each gauge the strain that the motion of the joints and the
links' own inertia do not explain,

.. math:: r = \varepsilon - R\delta_p, \qquad R\delta_p = -(R K_2^{-1}(M_{22}\ddot\delta + C_2\dot\delta) + p),

r passes a low-pass filter with the time constant :math:`\tau` (`SLOW`). The result is compared with the zero
:math:`r_0`, the mean of r over the first `LEARNT` seconds in which the arm hardly accelerates:

.. math::
    |\bar r - r_0| \le Z\varepsilon_{max} + \Pi\,
    \overline{\left(|\Delta D||\ddot q| + |\Delta L||\ddot\varepsilon|\right)} + \Pi\,\Delta W\sum_j|q_j - q_{j0}|

with 0.6 % of full scale for the zero (Z = `ZERO`). :math:`\Delta D`, :math:`\Delta L` and :math:`\Delta W` are the
largest changes of :math:`R K_2^{-1}M_{21}`, :math:`R K_2^{-1}M_{22}W` and the weight's strain, over some
configurations, for a payload that is off by `payload_tolerance`; :math:`\Pi` is `MARGIN`. The sum over the joints
counts up to 2 rad. The bound does not contain noise: the low pass leaves less than a tenth of a gauge's noise, and less
than half a microstrain of encoder counts.

A zero that drifts at the rate v is found when it is beyond its bound b by :math:`v\tau`,

.. math:: t = b/v + \tau + 3/\omega_f ,

with the corner :math:`\omega_f` of the law's low pass. This is no later than :math:`\tau + 3/\omega_f` after it has
left the bound, whatever the rate v. A drift within the bound looks the same as another payload. If a gauge that
drifts can't be left out, r minus its zero is subtracted from its reading from then on, with a delay of `CORRECTED` +
:math:`3/\omega_f`; v times this delay remains.

If a wrong acceleration a of one joint explains all residuals together, :math:`r = R K_2^{-1}M_{21}a`, the error may be
in this joint's position or in the strains, or something pushes the arm. Joint and gauges are then named together.
"""

from math import exp

import numpy as np

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.models import model as models

from ... import kernels
from ...kernels import strains

#: Change of a zero that counts as none, as a fraction of full scale [-]; margin for the effect of a payload [-].
ZERO, MARGIN = 0.006, 1.2
#: Fraction by which a payload may differ from the arm file's if nothing else is stated [-].
TOLERANCE = 2.0
#: Time constant of the low pass, time in which the zero is learnt, and time constant of the correction [s].
SLOW, LEARNT, CORRECTED = 0.2, 0.2, 0.05
#: A joint is named if its acceleration leaves less than this fraction of the residuals' square unexplained [-].
UNEXPLAINED = 0.03
#: Number of configurations over which the payload's effect is taken.
CONFIGURATIONS = 8


class ZeroDrift:
    """Judges the strain that the motion does not explain.

    Parameters
    ----------
    channels : Channels
    strain_map : StrainMap
    payload : float
        Fraction by which the payload may differ from the arm file's [-].

    Attributes
    ----------
    residual, bound : ndarray, shape (g,)
        Low-passed residual minus its zero, and its bound [strain].
    found : ndarray of int
        Gauges beyond their bound.
    doubted : ndarray of bool, shape (g,)
        Gauges whose drift is taken out of the amplitudes; the monitor sets it.
    correction : ndarray, shape (g,)
        Subtracted from the readings; for doubted gauges it follows r minus its zero [strain].
    """

    def __init__(self, channels, strain_map, payload=TOLERANCE):
        c = self.channels = channels
        self._drive, self._load, weight = _payload_changes(c.model, strain_map, payload)
        rows = self._rows = np.zeros((8, c.g))
        rows[strains.LEAST] = ZERO * np.array([a.full_scale for a in c.model.arm.gauges])
        rows[strains.BY_WEIGHT] = weight
        self.residual, self.bound = rows[strains.LEFT], rows[strains.ALLOWED]
        self.correction = rows[strains.CORRECTION]
        self.doubted, self._kernels = np.zeros(c.g, bool), kernels.compiled()
        self.reset()

    def reset(self):
        """Forget the past, zero and correction included."""
        self._age, self._count = 0.0, 0
        self._rows[strains.ZERO :] = 0.0
        self.bound[:] = self._rows[strains.LEAST]
        self._start = None
        self.found, self.doubted[:] = NONE, False

    def update(self, residual, acceleration, position, dt):
        """Take the law's residual of a comparison.

        Parameters
        ----------
        residual : ndarray, shape (g,)
            r [strain].
        acceleration : ndarray, shape (g + n,)
            Second derivatives of strains and joint positions.
        position : ndarray, shape (n,)
            Joint positions, filtered in the same way [rad].
        dt : float
            Time since the last comparison [s].
        """
        if self._start is None:
            self._start, self._rows[strains.SLOW] = position.copy(), residual
        learns = self._age <= LEARNT
        ways = self._count, 1.0 - exp(-dt / SLOW), 1.0 - exp(-dt / CORRECTED), learns, NOTHING
        learnt, wrong = self._kernels.follow_drift(
            residual, acceleration, position, self._start, self._drive, self._load, self.doubted, self._rows, ways
        )  # fmt: skip
        if learnt:
            self._age += dt
            self._count += 1
        beyond = wrong and not learns
        self.found = np.flatnonzero(np.abs(self.residual) > self.bound) if beyond else NONE

    def joint(self, drive):
        """The joint whose acceleration explains all residuals of two gauges or more; None if there is none.

        Parameters
        ----------
        drive : ndarray, shape (g, n)
            Strain per joint acceleration at the present configuration.
        """
        r = self.residual
        if r.size < 2 or not self.found.size:
            return None
        size = (drive**2).sum(axis=0)
        explained = (r @ drive) ** 2 / np.where(size > 0.0, size, np.inf)
        j = int(np.argmax(explained))
        return j if explained[j] > (1.0 - UNEXPLAINED) * (r @ r) else None


def law_matrices(model, strain_map, terms):
    """Strains at the gauges per cause of bending, from `terms` and a `strain_map` of the `model`.

    Returns
    -------
    drive, load, turn, force : ndarray, shape (g, n), (g, g), (g, g), (g, m)
        Strain per joint acceleration, per second derivative of the strains, per first one, and per modal force.
    """
    n = model.n_joints
    to_strain = strain_map.rows @ np.linalg.inv(terms.K2)
    load = to_strain @ terms.M[n:, n:] @ strain_map.inverse
    turn = to_strain @ terms.C2 @ strain_map.inverse
    return to_strain @ terms.M[n:, :n], load, turn, to_strain


def _payload_changes(model, strain_map, payload):
    """Largest changes of `law_matrices` under a payload that is off by a fraction `payload`, times `MARGIN`."""
    n, arm = model.n_joints, model.arm
    others = [models.build(scaled(arm, 1.0 + by)) for by in (-min(payload, 1.0), payload)]
    maps = [StrainMap(m) for m in others]
    g = len(arm.gauges)
    found = [np.zeros((g, n)), np.zeros((g, g)), np.zeros(g)]
    random = np.random.default_rng(0)
    for k in range(CONFIGURATIONS):
        q = random.uniform(-1.5, 1.5, n) if k else np.zeros(n)
        own = _at_rest(model, strain_map, q)
        for other, map_ in zip(others, maps, strict=True):
            for out, a, b in zip(found, own, _at_rest(other, map_, q), strict=True):
                np.maximum(out, MARGIN * np.abs(b - a), out=out)
    return found


def _at_rest(model, strain_map, q):
    """The first two `law_matrices` at rest, and the weight's strain: the last matrix times f2."""
    terms = model.terms(q, np.zeros(q.size))
    drive, load, _, to_strain = law_matrices(model, strain_map, terms)
    return drive, load, to_strain @ terms.f2


#: A correction below this fraction of the bound counts as none.
NOTHING = 1e-3
NONE = np.zeros(0, int)
