# SPDX-License-Identifier: Apache-2.0
r"""Computes the torque that a trajectory needs, and refuses a trajectory that needs more than the joints have.

The torque is that of the slow subsystem (10), the rigid arm with weight, friction and the payload of the arm file:

.. math:: \bar u(t) = B^{-1}(q_r, \dot q_r)\,[\ddot q_r - a(q_r, \dot q_r)] .

It is evaluated at several places of every polynomial, including both of its ends, and for the hold after the last
point. Steps of the velocity, as between points with positions alone, have no finite torque. They are not judged; the
tracking has to deal with them. Torque for the bending is not judged either; it is left to the fast control.
"""

import numpy as np

from flexarm_dynamics.errors import FlexarmError, TrajectoryError
from flexarm_dynamics.singular_perturbation import slow_torque

from .path import Path
from .values import SECOND, TORQUE_ROUNDING

#: Number of places per polynomial; with the maximum, a peak between places is missed by at most half a percent.
MIN_PLACES, MAX_PLACES = 2, 33
#: Approximate number of places of all polynomials together, if there are few polynomials; and maximum number.
PLACES, MOST = 400, 2000


def required_torque(model, motion):
    """Torque of (10) along a `motion`, states (k, 3, n); shape (k, n) [N m], NaN where the model gives none."""
    out = np.full((len(motion), model.n_joints), np.nan)
    for u, (q, qd, qdd) in zip(out, motion, strict=True):
        try:
            u[:] = slow_torque(model.terms(q, qd), qdd)
        except (FlexarmError, np.linalg.LinAlgError):
            continue
    return out


def refuse_torque(model, trajectory, start, limit):
    """Refuse a trajectory that needs more torque than there is.

    Parameters
    ----------
    model : ArmModel
    trajectory : JointTrajectoryData
    start : ndarray, shape (3, n), or None
        State of the reference that it starts from; None: unknown, and the first polynomial is not judged.
    limit : ndarray, shape (n,)
        [N m]; infinite where there is none.

    Raises
    ------
    TrajectoryError
        It names the place with the largest excess, with joint, time, torque and limit.
    """
    if np.isinf(limit).all():
        return
    path = Path.of(trajectory)
    if start is not None:
        path.begin(0, start)
    points = len(trajectory.times_ns)
    piece, time, motion = _places(path, start is not None)
    needed = required_torque(model, motion)
    if path.pushes:
        needed += _effort(path, time, model.n_joints)
    excess = np.nan_to_num(np.abs(needed) / limit)
    worst, joint = np.unravel_index(int(np.argmax(excess)), excess.shape)
    if excess[worst, joint] <= 1.0 + TORQUE_ROUNDING:
        return
    name = model.joint_names[joint]
    raise TrajectoryError(
        "N m are needed there, more than the torque limit",
        field=f"points[{min(piece[worst], points - 1)}]: torque of joint {name} at {time[worst]:.4g} s",
        value=float(f"{needed[worst, joint]:.4g}"),
        limit=float(f"{limit[joint]:.6g}"),
        hint=_hint(model, motion[worst], needed[worst], limit),
    )


def _effort(path, times, n):
    """Effort (k, n) at times (k,) from the start of a path [s]."""
    out = np.empty((len(times), n))
    for row, time in zip(out, times, strict=True):
        path.effort(path.start_ns + round(time * SECOND), row)
    return out


def _places(path, from_start):
    """Of each judged place: point that its polynomial leads to, time from the start [s], and state, (k, 3, n)."""
    points = len(path.lengths)
    kept = np.arange(0 if from_start else 1, points)
    kept = kept[path.lengths[kept] > 0.0]
    each = int(np.clip(PLACES // max(kept.size, 1), MIN_PLACES, MAX_PLACES))
    if kept.size * each > MOST:
        # Keep polynomials at even intervals, and those in which each joint accelerates most.
        ends = np.abs(path.at_places(kept, np.array([0.0, 1.0]))[..., 2, :]).max(axis=1)
        even = np.linspace(0, kept.size - 1, MOST // each).astype(int)
        kept = kept[np.union1d(even, np.argmax(ends, axis=0))]
    fractions = np.linspace(0.0, 1.0, each)
    motion = path.at_places(kept, fractions)
    time = path.starts[kept][:, None] + path.lengths[kept][:, None] * fractions
    n = motion.shape[-1]
    hold = np.zeros((1, 3, n))
    hold[0, 0] = path.end
    return (
        np.append(np.repeat(kept, each), points - 1),
        np.append(time, path.starts[-1] + path.lengths[-1]),
        np.concatenate([motion.reshape(-1, 3, n), hold]),
    )


def _hint(model, state, needed, limit):
    """What to do: move more slowly, if the arm can be held there; a motion's torque falls as one over time squared."""
    still = required_torque(model, (state * [[1.0], [0.0], [0.0]])[None])[0]
    if not (np.abs(still) < limit).all():
        return "the arm can't be held there: choose other positions"
    moving = needed - still
    slower = np.sqrt(np.max(np.abs(moving) / (limit - np.sign(moving) * still)))
    return f"give it {max(slower, 1.01):.3g} times the time, or more"
