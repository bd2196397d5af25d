# SPDX-License-Identifier: Apache-2.0
r"""Paths of the tip in space, a straight line or a circular arc, as motions of the joints.

The path :math:`x(s)`, s from 0 to 1, is turned into joint angles Q(s) by the inverse kinematics of the arm at rest
(`flexarm_dynamics.models.inverse_kinematics`). That arm is bent by its weight, so that the *bent* arm's tip is on the
path. Each solution begins at the previous one, so that Q has no jumps. Q is the spline of degree five through the
solutions. The number of points is doubled until, midway between them, its tip is within `TOLERANCE` of the path. With a
time law :math:`\sigma(t)`,

.. math:: q = Q(\sigma),\quad \dot q = Q'\dot\sigma,\quad
    \ddot q = Q''\dot\sigma^2 + Q'\ddot\sigma.

The bending by the motion itself is not compensated; a slower motion bends less.
"""

import numpy as np
from scipy.interpolate import make_interp_spline

from flexarm_dynamics.errors import TrajectoryError
from flexarm_dynamics.models.inverse_kinematics import TOLERANCE as ARRIVED
from flexarm_dynamics.models.inverse_kinematics import TipKinematics, checked, nearest, show

from .profiles import Motion

#: How far the resting tip may be from the path [m].
TOLERANCE = 1e-7
_MIN_KNOTS, _MAX_KNOTS = 32, 512


class TipPath(Motion):
    """A motion of the tip along a path: the `curve` x(s), the `joints` Q(s) and the time `law` sigma(t)."""

    def __init__(self, curve, joints, law):
        self._curve, self._joints, self._law = curve, joints, law
        self._slope, self._curvature = joints.derivative(), joints.derivative(2)
        self.duration = law.duration
        self.start = joints(0.0)
        self.angle = joints(1.0) - self.start

    def with_law(self, law):
        """Return the same path with another time law: a motion of one joint from 0 to 1."""
        return TipPath(self._curve, self._joints, law)

    def tip(self, t) -> np.ndarray:
        """Return the wanted position of the tip at t [s], scalar or (k,): (3,) or (k, 3) [m]."""
        return self._curve(self._law.position(t))

    def derivative(self, order, t):
        s = self._law.position(t)[..., 0]
        if order == 0:
            return self._joints(s)
        rate = self._law.velocity(t)
        if order == 1:
            return self._slope(s) * rate
        return self._curvature(s) * rate**2 + self._slope(s) * self._law.acceleration(t)


def line(model, start, end, law) -> TipPath:
    """Return the motion of the tip along a straight line.

    Parameters
    ----------
    model : ArmModel
    start : (n,) array_like
        Joint angles at the start; the line begins at the tip there [rad].
    end : (3,) array_like
        Where it ends, in the base frame [m].
    law : Motion
        Motion of one joint, from 0 to 1: the fraction of the path.

    Raises
    ------
    TrajectoryError
        If the path can't be followed to its end; it names the fraction that can be followed, and how near the tip gets.
    """
    end, start = checked(model, end, start)
    kinematics = TipKinematics(model)
    begin = kinematics.tip(start)
    way = end - begin
    if np.linalg.norm(way) < 1e-9:
        problem, hint = "m is where the tip is already", "give another point"
        raise TrajectoryError(problem, field="tip", value=end.tolist(), hint=hint)
    return _follow(kinematics, start, lambda s: begin + np.multiply.outer(_scalar(s), way), law)


def arc(model, start, via, end, law) -> TipPath:
    """Return the motion of the tip along the circle from where it is, through `via`, to `end`.

    Parameters
    ----------
    via, end : (3,) array_like
        Two more points of the circle, in the base frame [m].
    model, start, law
        As for `line`.

    Raises
    ------
    TrajectoryError
        If the points are on a line, and as for `line`.
    """
    via, _ = checked(model, via, start)
    end, start = checked(model, end, start)
    kinematics = TipKinematics(model)
    curve = circle(kinematics.tip(start), via, end)
    return _follow(kinematics, start, curve, law)


def circle(begin, via, end):
    """Return the circle through three points as a function of s: `begin` at 0, `end` at 1.

    The centre c is where ``|c - begin| = |c - via| = |c - end|`` in the plane of the three.
    """
    a, b = via - begin, end - begin
    normal = np.cross(a, b)
    square = normal @ normal
    if square < 1e-12 * (a @ a) * (b @ b) or not square:
        raise TrajectoryError(
            f"{show(begin)}, {show(via)} and {show(end)} m are on a line and make no circle",
            field="arc",
        )
    to_centre = np.cross((a @ a) * b - (b @ b) * a, normal) / (2.0 * square)
    centre, first = begin + to_centre, -to_centre
    second = np.cross(normal / np.sqrt(square), first)

    def angle(point):
        return np.arctan2((point - centre) @ second, (point - centre) @ first) % (2.0 * np.pi)

    # The normal turns begin into via into end, so that both angles are ahead and via's is less.
    total = angle(end)

    def curve(s):
        turn = total * _scalar(s)
        return (
            centre
            + np.multiply.outer(np.cos(turn), first)
            + np.multiply.outer(np.sin(turn), second)
        )

    return curve


def _scalar(s):
    """The path's parameter (k,), from the (k, 1) of a law of one joint or from (k,)."""
    s = np.asarray(s, float)
    return s[..., 0] if s.ndim and s.shape[-1] == 1 else s


def _follow(kinematics, start, curve, law):
    """Return the `TipPath` along a curve that begins at the tip at `start`."""
    low, high = kinematics.low, kinematics.high
    outside = np.flatnonzero((start < low) | (start > high))
    if outside.size:
        i = int(outside[0])
        raise TrajectoryError(
            "rad is out of range",
            field=f"start of joint {kinematics.model.joint_names[i]}",
            value=float(start[i]),
            limit=f"{low[i]:g} to {high[i]:g}",
        )
    count = _MIN_KNOTS
    while True:
        knots = np.linspace(0.0, 1.0, count + 1)
        # The path is solved again from its start: solutions for added points alone could end in another
        # branch, if an arm has more joints than it needs.
        angles = _solve_along(kinematics, knots, curve, start)
        joints = make_interp_spline(knots, angles, k=5)
        between = 0.5 * (knots[1:] + knots[:-1])
        off = [np.linalg.norm(kinematics.tip(joints(s)) - curve(s)) for s in between]
        if max(off) <= TOLERANCE:
            return TipPath(curve, joints, law)
        if count >= _MAX_KNOTS:
            worst = int(np.argmax(off))
            raise TrajectoryError(
                f"the joints can't follow it smoothly at {100 * between[worst]:.0f} % of it, near q ="
                f" {show(joints(between[worst]))} rad ({max(off):.2g} m off): the arm is nearly singular there, or"
                " a joint meets its limit",
                field="tip path",
                hint="take another path or start",
            )
        count *= 2


def _solve_along(kinematics, knots, curve, start):
    angles = np.empty((knots.size, start.size))
    angles[0] = start
    for k in range(1, knots.size):
        found = kinematics.search(curve(knots[k]), angles[k - 1])
        if found.distance > 10.0 * ARRIVED:
            raise TrajectoryError(
                f"{kinematics.model.arm.name} can't follow it beyond {100 * knots[k - 1]:.0f} %:"
                f" {show(curve(knots[k]))} m is out of reach from there",
                field="tip path",
                hint=nearest(found),
            )
        angles[k] = found.q
    return angles
