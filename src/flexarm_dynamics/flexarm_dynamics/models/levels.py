# SPDX-License-Identifier: Apache-2.0
r"""Chooses the level of the bending kinematics at which an arm is simulated, and estimates what each level leaves out.

`first_order`: displacements are linear in the deflections. `stiffening`: links keep their length to second order, so a
spinning link is stiffer. `finite_slope`: links keep their length exactly, and their curvature and their tips' angles
are correct for large slopes. See docs/dynamics.md.

For a link with slopes :math:`s^2 = y'^2 + z'^2`, deflection d of its tip and a length l of the arm beyond it, the first
term that a level leaves out would move the arm's tip by about

.. math::
    e_1 = \tfrac12\int_0^L s^2 dx + |\phi(L)^T K^{-1} K_g\,\delta|, \qquad
    e_2 = \tfrac12 s^2 d + \tfrac16 s^3 l, \qquad e_3 = \tfrac18 s^4 d

at the three levels. The first is the foreshortening, and the bending that the geometric stiffness :math:`K_g` of the
axial forces would prevent or add. The second comes from the factor :math:`(1-s^2)^{-1/2}` of the curvature and from the
error :math:`\arcsin s - s` of the angle. The third is the next term of both; the mode shapes of small deflections
can't represent it.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..errors import ModelError
from .chain import Chain

FIRST_ORDER, STIFFENING, FINITE_SLOPE = "first_order", "stiffening", "finite_slope"
AUTO = "auto"
#: Levels that can be requested.
LEVELS = (AUTO, FIRST_ORDER, STIFFENING, FINITE_SLOPE)

#: `auto` takes the lowest level that leaves out no more than this at the tip under the largest known loads [m].
NEGLIGIBLE = 1e-6
#: Deflections under suddenly applied loads, relative to those at rest [-].
OVERSHOOT = 2.0
#: `first_order` and `stiffening` are beyond their range if they leave out more than this, over the arm's length [-].
TOLERANCE = 1e-4
#: Largest slope at which `finite_slope` was compared with independent codes; the end of its range [-].
MAX_SLOPE = 0.5
#: Number of Gauss points along a link where its slopes are evaluated; they are also evaluated at its tip.
_STATIONS = 8


def level_of(arm):
    """The level of the model that `model.build` makes of an arm, from the arm's flags."""
    if arm.finite_slope:
        return FINITE_SLOPE
    return STIFFENING if arm.foreshortening else FIRST_ORDER


def at_level(arm, level):
    """The same arm at a level.

    Parameters
    ----------
    arm : Arm
    level : str
        One of `LEVELS`, except `AUTO`.

    Returns
    -------
    Arm

    Raises
    ------
    ModelError
        For an unknown level, and for a level above `first_order` if the model is not `chain`: the closed forms have
        their own kinematics.
    """
    if level not in LEVELS[1:]:
        raise ModelError("is unknown", field="level", value=level, limit=", ".join(LEVELS))
    if level != FIRST_ORDER and arm.model != "chain":
        problem = f"of {arm.name} supports neither foreshortening nor finite slope"
        raise ModelError(problem, field="model", value=arm.model, limit="chain")
    return replace(arm, foreshortening=level != FIRST_ORDER, finite_slope=level == FINITE_SLOPE)


@dataclass(frozen=True)
class Drive:
    """What is known of a run's motion beyond the limits of the arm's joints; each (n,) or None.

    Attributes
    ----------
    torque : ndarray
        Largest torques [N m].
    acceleration, velocity : ndarray
        Largest accelerations and speeds, of a prescribed motion [rad/s^2], [rad/s].
    """

    torque: np.ndarray | None = None
    acceleration: np.ndarray | None = None
    velocity: np.ndarray | None = None


def simulated(arm, level=AUTO, drive=None, negligible=NEGLIGIBLE):
    """The arm as it is simulated.

    Parameters
    ----------
    arm : Arm
    level : str
        One of `LEVELS`. `auto` takes the lowest level that leaves out no more than `negligible` under the largest known
        loads, but none below the flags of the arm file. These loads are gravity, with the joints straight or one of
        them at right angles, and the torques of the `drive`, or of the joints' limits, suddenly applied. Without limits
        the loads are unknown, and the level is `finite_slope`. Models other than `chain` have their own kinematics, so
        their arms stay as they are.
    drive : Drive, optional
    negligible : float
        At the tip [m].

    Returns
    -------
    Arm
        With the chosen level in its flags `foreshortening` and `finite_slope`.
    """
    if level != AUTO:
        return at_level(arm, level)
    if arm.model == "chain" and any(link.reduced and link.reduced.stiffens for link in arm.links):
        arm = arm if arm.finite_slope else replace(arm, foreshortening=True)
    if arm.model != "chain" or arm.finite_slope or not _bends(arm):
        return arm
    first, stiffening = neglected(arm, drive)
    if stiffening > negligible:
        return at_level(arm, FINITE_SLOPE)
    return arm if first <= negligible else at_level(arm, STIFFENING)


def _bends(arm):
    return any(d in link.flexible for link in arm.links for d in ("y", "z"))


def neglected(arm, drive=None):
    """What `first_order` and `stiffening` leave out at the tip under the largest known loads [m].

    `arm` and `drive` are those of `simulated`.

    Returns
    -------
    first_order, stiffening : float
        Infinite if the loads are unknown.
    """
    drive = drive or Drive()
    chain = Chain(at_level(arm, FIRST_ORDER))
    slopes = Slopes(chain)
    n = chain.n_joints
    limits = arm.torque_limits if drive.torque is None else np.asarray(drive.torque, float)
    known = limits if drive.acceleration is None else np.asarray(drive.acceleration, float)
    if not np.isfinite(known).all():
        return np.inf, np.inf
    K, rest = chain.stiffness_matrix(), np.zeros(n)
    # Axial forces may prevent or add this fraction of the bending: all of it with gravity or at unknown speeds.
    speed = arm.velocity_limits if drive.velocity is None else np.asarray(drive.velocity, float)
    ratio = 1.0
    if np.isfinite(speed).all() and not any(arm.gravity):
        ratio = min(1.0, (speed.sum() / chain.frequencies(locked=True)[0]) ** 2)
    worst = np.zeros(2)
    for q in _poses(n):
        M = chain.mass_matrix(q)
        loads = [-chain.forces(q, rest)[n:]]
        motion = known * np.eye(n)
        if drive.acceleration is None:
            motion = np.linalg.solve(M[:n, :n], motion)
        loads += list(-(M[n:, :n] @ motion).T)
        bent = OVERSHOOT * np.abs(np.linalg.solve(K, np.array(loads).T)).sum(axis=1)
        first, stiffening, _ = slopes.neglected(bent, added=True)
        first += ratio * slopes.deflection(bent, added=True).sum()
        worst = np.maximum(worst, (first, stiffening))
    return tuple(map(float, worst))


def _poses(n):
    """Joint angles at which loads are evaluated: straight, and each joint at right angles."""
    yield np.zeros(n)
    for i in range(n):
        for side in (-0.5, 0.5):
            q = np.zeros(n)
            q[i] = side * np.pi
            yield q


class Slopes:
    """Slopes and deflections of an arm's links, and what the levels leave out for them.

    Parameters
    ----------
    model : ArmModel
    """

    def __init__(self, model):
        arm, m = model.arm, model.n_modes
        points, weights = np.polynomial.legendre.leggauss(_STATIONS)
        stations = np.append(0.5 * (points + 1.0), 1.0)
        links = [link for link in arm.links if {"y", "z"} & set(link.flexible)]
        self.model, self.names = model, [link.name for link in links]
        shape = (2, len(links), stations.size, m)
        self._slope, self._tip = np.zeros(shape), np.zeros((2, len(links), m))
        self._weights = np.array([0.5 * link.length * np.append(weights, 0.0) for link in links])
        for i, link in enumerate(links):
            for axis, direction in enumerate("yz"):
                of = [k for k, mode in enumerate(arm.modes) if mode.link == link.name]
                of = [k for k in of if arm.modes[k].direction == direction]
                if of:
                    shapes = model.mode_shapes(link.name, direction)
                    self._slope[axis, i][:, of] = shapes(stations, 1) / link.length
                    self._tip[axis, i, of] = shapes(1.0)
        self.reach = arm.reach
        beyond, self._lever = float(np.linalg.norm(arm.payload.offset)), {}
        for joint, link in zip(arm.joints[::-1], arm.links[::-1], strict=True):
            self._lever[link.name] = beyond
            beyond += link.length + float(np.linalg.norm(joint.origin_xyz))
        self._lever = np.array([self._lever[name] for name in self.names])

    def of(self, delta, added=False):
        """Slope of each link at the stations, (links, stations) [-]; `added`: the sum of all modes' magnitudes."""
        rows = np.abs(self._slope) if added else self._slope
        return np.hypot(*(rows @ delta))

    def deflection(self, delta, added=False):
        """Deflection of each link's tip, (links,) [m]; `added` as for `of`."""
        rows = np.abs(self._tip) if added else self._tip
        return np.hypot(*(rows @ delta))

    def neglected(self, delta, added=False):
        """What each level leaves out at the arm's tip, without the geometric stiffness: e1, e2, e3 [m].

        `delta` are modal amplitudes (m,); `added` as for `of`.
        """
        s, d = self.of(delta, added), self.deflection(delta, added)
        top = s.max(axis=1)
        return (
            0.5 * float((self._weights * s * s).sum()),
            float((0.5 * top**2 * d + top**3 / 6.0 * self._lever).sum()),
            float((0.125 * top**4 * d).sum()),
        )


class Range:
    """Whether a simulated arm stays in the range of its level.

    Parameters
    ----------
    model : ArmModel
        Model of the simulated arm.

    Attributes
    ----------
    error : float
        The largest estimate so far of what the level leaves out at the tip [m].
    warning : str
        Why the level is beyond its range, set the first time that it is; empty until then.
    """

    def __init__(self, model):
        self.model, self.level = model, level_of(model.arm)
        self.watched = model.arm.model == "chain" and _bends(model.arm)
        self._slopes = Slopes(model) if self.watched else None
        self.reset()

    def reset(self):
        """Forget all earlier states."""
        self.error, self.warning = 0.0, ""

    @cached_property
    def _stiffer(self):
        model = self.model
        shapes = {
            (link.name, direction): model.mode_shapes(link.name, direction)
            for link in model.arm.links
            for direction in link.flexible
        }
        return Chain(at_level(model.arm, STIFFENING), shapes=shapes), model.stiffness_matrix()

    def check(self, q, qd, delta):
        """Take one state into account; True if this state is the first beyond the range of the level.

        The state has joint angles `q` and speeds `qd`, both (n,), and amplitudes `delta` (m,).
        """
        if not self.watched or self.warning:
            return False
        slope = self._slopes.of(delta)
        errors = self._slopes.neglected(delta)
        error = errors[LEVELS.index(self.level) - 1]
        if self.level == FIRST_ORDER:
            error += self._unstiffened(q, qd, delta)
        self.error = max(self.error, error)
        link = self._slopes.names[int(slope.max(axis=1).argmax())]
        top = float(slope.max())
        limit = TOLERANCE * self._slopes.reach
        beyond = top > MAX_SLOPE if self.level == FINITE_SLOPE else error > limit
        if not beyond and np.isfinite(error):
            return False
        if self.level == FINITE_SLOPE:
            hint = f"slopes above {MAX_SLOPE:g} have not been held against other codes"
        else:
            hint = f"more than {1e3 * limit:.2g} mm; take level {FINITE_SLOPE}"
        self.warning = (
            f"level {self.level} of {self.model.arm.name} leaves out some {1e3 * error:.2g} mm at the tip,"
            f" with a slope of {top:.2g} of {link}: {hint}"
        )
        return True

    def _unstiffened(self, q, qd, delta):
        """Bending at the tips of the links that geometric stiffness would prevent or add [m]."""
        n = self.model.n_joints
        stiffer, K = self._stiffer
        Kg = stiffer.linearisation(q, qd)[0][n:] - self.model.linearisation(q, qd)[0][n:]
        return float(self._slopes.deflection(np.linalg.solve(K, Kg @ delta)).sum())
