# SPDX-License-Identifier: Apache-2.0
r"""Inverse kinematics: finds joint angles that put the tip of the straight or of the statically bent arm at a point.

The tip of an arm at rest is :math:`p(q, \delta_s(q))`, with :math:`\delta_s` the deflections under gravity
(`ArmModel.static_deflection`), so the sag of the links is taken into account. Newton's method takes the smallest step
that reaches the point, with the damping of Levenberg and Marquardt,

.. math:: \Delta q = J^T (J J^T + \lambda I)^{-1} (p_{wanted} - p), \qquad
    J = \frac{\partial p}{\partial q} - \frac{\partial p}{\partial\delta}
    \left(\frac{\partial F_2}{\partial\delta}\right)^{-1} \frac{\partial F_2}{\partial q},

where :math:`F_2` are the forces on the modes at rest. The smallest step keeps a redundant arm near its start. A joint
that would leave its limits is held at the limit.
"""

from dataclasses import dataclass

import numpy as np

from ..errors import ModelError, check_shape
from ..linear import jacobian
from .chain import Chain

#: The target is reached if the tip is no farther from it than this [m].
TOLERANCE = 1e-10
#: No joint turns farther in one step of the search [rad].
MAX_STEP = 0.5
_STEPS = 100
#: Further searches begin up to these distances from the start [rad], to leave singular configurations and to get
#: around limits.
_SPREADS = (0.05, 0.3, 1.0, 2.0, 3.0)


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a search.

    Attributes
    ----------
    q : (n,) array
        Joint angles [rad].
    tip : (3,) array
        Position of the tip [m].
    distance : float
        Distance from the wanted point [m].
    """

    q: np.ndarray
    tip: np.ndarray
    distance: float


class TipKinematics:
    """Position of an arm's tip at rest as a function of its joints.

    Parameters
    ----------
    model : ArmModel
    bent : bool
        True: the arm bends under its own weight. False: it stays straight, as if it were rigid.
    """

    def __init__(self, model, bent=True):
        self.model = model
        self.bent = bool(bent and model.n_modes and any(model.arm.gravity))
        self.low, self.high = model.arm.position_limits.T

    def deflection(self, q):
        """Deflections at rest, (m,)."""
        return self.model.static_deflection(q) if self.bent else np.zeros(self.model.n_modes)

    def tip(self, q, delta=None):
        """Position of the tip, (3,) [m]."""
        return self.model.tip_position(q, self.deflection(q) if delta is None else delta)

    def jacobian(self, q, delta=None):
        """Derivative of `tip` by the joints, (3, n) [m/rad]; accurate to about nine digits."""
        delta = self.deflection(q) if delta is None else delta
        J = jacobian(lambda x: self.model.tip_position(x, delta), q)
        if not self.bent:
            return J
        give = np.linalg.solve(
            jacobian(lambda x: self._modal_forces(q, x), delta),
            jacobian(lambda x: self._modal_forces(x, delta), q),
        )
        return J - jacobian(lambda x: self.model.tip_position(q, x), delta) @ give

    def _modal_forces(self, q, delta):
        """Forces on the modes at rest, (m,); they are zero for the result of `deflection`."""
        n, rest = self.model.n_joints, np.zeros(self.model.n_joints)
        if isinstance(self.model, Chain):  # not from its terms: these compute derivatives, too
            return self.model.forces(q, rest, delta)[n:]
        terms = self.model.terms(q, rest, delta, np.zeros(self.model.n_modes))
        return terms.f2 + terms.K2 @ delta

    def search(self, target, start) -> Solution:
        """Go from `start` towards the target, until the tip is there or gets no closer; see `solve`."""
        q, damping = np.clip(start, self.low, self.high), 1e-3
        tip = self.tip(q)
        error = target - tip
        for _ in range(_STEPS):
            if np.linalg.norm(error) <= TOLERANCE:
                break
            J = self.jacobian(q)
            push = J.T @ error
            held = ((q <= self.low) & (push < 0.0)) | ((q >= self.high) & (push > 0.0))
            J = np.where(held, 0.0, J)
            size = np.trace(J @ J.T)
            if size == 0.0:
                break
            step = J.T @ np.linalg.solve(J @ J.T + damping * size * np.eye(3), error)
            step *= min(1.0, MAX_STEP / max(np.abs(step).max(), 1e-300))
            there = np.clip(q + step, self.low, self.high)
            new = self.tip(there)
            if np.linalg.norm(target - new) < np.linalg.norm(error):
                gain = np.linalg.norm(error) - np.linalg.norm(target - new)
                q, tip, error, damping = there, new, target - new, max(0.03 * damping, 1e-13)
                if np.linalg.norm(error) > TOLERANCE and gain < 1e-8 * np.linalg.norm(error):
                    break  # it gets no closer
            elif damping > 1e6:
                break
            else:
                damping *= 10.0
        return Solution(q, tip, float(np.linalg.norm(error)))


def solve(model, target, start=None, bent=True) -> Solution:
    """Joint angles that put the tip of the arm at rest at a point.

    Parameters
    ----------
    model : ArmModel
        Any model that knows its tip's position.
    target : (3,) array_like
        In the base frame [m].
    start : (n,) array_like, optional
        Where the search begins; solutions near it are found first. Zero if not given [rad].
    bent : bool
        True: the arm bends under its own weight. False: it is straight.

    Returns
    -------
    Solution
        Within `TOLERANCE` of the target, and within the joints' limits.

    Raises
    ------
    ShapeError
        If `target` or `start` has another shape.
    ModelError
        If the point is not finite, or if no configuration was found that reaches it; the message has the distance.
    """
    target, start = checked(model, target, start)
    kinematics = TipKinematics(model, bent)
    best = kinematics.search(target, start)
    random = np.random.default_rng(0)
    for spread in _SPREADS:
        if best.distance <= TOLERANCE:
            return best
        near = start + spread * random.uniform(-1.0, 1.0, start.size)
        best = min(best, kinematics.search(target, near), key=lambda s: s.distance)
    if best.distance <= TOLERANCE:
        return best
    problem, field = f"m is out of reach: {nearest(best)}", f"tip of {model.arm.name}"
    raise ModelError(problem, field=field, value=target.tolist())


def checked(model, target, start):
    """`target` and `start` as arrays of the right shapes."""
    target = np.array(target, float)
    check_shape(target, (3,), "tip position")
    if not np.isfinite(target).all():
        raise ModelError("is not finite", field="tip position", value=target.tolist())
    start = np.zeros(model.n_joints) if start is None else np.array(start, float)
    check_shape(start, (model.n_joints,), "start")
    return target, start


def nearest(solution):
    """In words, the closest tip position that a search found."""
    return (
        f"the nearest found is {show(solution.tip)} m, {solution.distance:.6g} m away, at q ="
        f" {show(solution.q)} rad"
    )


def show(vector):
    """A short list of numbers."""
    return "[" + ", ".join(f"{v:.6g}" for v in np.round(vector, 9) + 0.0) + "]"
