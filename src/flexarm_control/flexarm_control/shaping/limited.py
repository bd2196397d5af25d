# SPDX-License-Identifier: Apache-2.0
"""Finds the quickest time laws, within limits of jerk by Ruckig, of speed and acceleration along a path by TOPP-RA.

Ruckig (Berscheid & Kroeger 2021) joins two states in the shortest time within limits of speed, acceleration and jerk.
In a motion from rest, all joints stay on the straight line between both positions, and the progress on it keeps the
limits of the joints. TOPP-RA (Pham & Pham 2018) moves along the cubic spline through points, by length, in the shortest
time within limits of speed and acceleration.

Both are separate libraries, imported only where they are used: `ruckig` and `toppra` on PyPI.
"""

import importlib
import logging

import numpy as np

from flexarm_dynamics.errors import DesignError, TrajectoryError

from .piecewise import PiecewiseMotion

#: Number of spline points at which TOPP-RA keeps the limits, for each piece between two given points; and minimum and
#: maximum of their total without the given points. Each is a point of the motion; a shaper multiplies their number.
GRID, FEWEST, MOST = 50, 100, 800
#: A grid point closer to a given point than this fraction of a grid step is left out: the given point replaces it.
CLOSE = 0.1
#: Points closer to each other than this count as one [rad].
SAME = 1e-7
#: Knots closer than this count as one [s].
MOMENT = 1e-9


def jerk_limited(begin, end, velocity, acceleration, jerk) -> PiecewiseMotion:
    """Return the quickest motion to rest within limits of speed, acceleration and jerk.

    Parameters
    ----------
    begin : (3, n) array_like
        Position, velocity and acceleration [rad], [rad/s], [rad/s^2].
    end : (n,) array_like
        [rad]
    velocity, acceleration, jerk : (n,) array_like
        Finite and above 0 [rad/s], [rad/s^2], [rad/s^3].

    Raises
    ------
    DesignError
        If `ruckig` is not installed, or a limit is not given.
    TrajectoryError
        If there is no such motion.
    """
    ruckig = library("ruckig")
    begin, end = np.asarray(begin, float), np.asarray(end, float)
    limits = {"velocity": velocity, "acceleration": acceleration, "jerk": jerk}
    _refuse_unlimited(limits)
    limits = {k: np.broadcast_to(v, end.shape).astype(float) for k, v in limits.items()}
    way = end - begin[0]
    if begin[1:].any():
        knots, states = _joined(ruckig, begin, end, limits)
    else:  # all joints together on the straight line
        size = np.maximum(np.abs(way), 1e-300)
        own = {name: np.array([(values / size).min()]) for name, values in limits.items()}
        one = np.abs(way).max() > SAME
        knots, states = _joined(ruckig, np.zeros((3, 1)), np.ones(1) * one, own)
        states = states * way
        states[:, 0] += begin[0]
    if knots.size == 1:
        return PiecewiseMotion.resting(end, 0.0)
    states[-1] = end, 0.0 * end, 0.0 * end
    return PiecewiseMotion.through(knots, list(states.transpose(1, 0, 2)))


def _joined(ruckig, begin, end, limits):
    """Knots (k,) [s] and states there (k, 3, n) of Ruckig's motion from a state (3, n) to rest at an end (n,)."""
    asked = ruckig.InputParameter(end.size)
    asked.current_position, asked.current_velocity, asked.current_acceleration = begin.tolist()
    asked.target_position = end.tolist()
    for name, values in limits.items():
        setattr(asked, f"max_{name}", values.tolist())
    found = ruckig.Trajectory(end.size)
    try:
        done = ruckig.Ruckig(end.size).calculate(asked, found)
    except ruckig.RuckigError as error:
        raise TrajectoryError(f"has no time law: {error}", field="trajectory") from error
    if done not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise TrajectoryError(f"has no time law: {done}", field="trajectory")
    knots = [0.0, found.duration]
    for profile in found.profiles[0]:
        steps = np.concatenate([profile.brake.t, profile.t])
        knots += np.cumsum(np.maximum(steps, 0.0)).tolist()
    knots = np.unique(np.clip(knots, 0.0, found.duration))
    knots = knots[np.concatenate([[True], np.diff(knots) > MOMENT])]
    return knots, np.array([found.at_time(float(t)) for t in knots])


def time_optimal(points, velocity, acceleration) -> PiecewiseMotion:
    """Return the quickest motion from rest to rest through points, within limits of speed and acceleration.

    Parameters
    ----------
    points : (k, n) array_like
        [rad]
    velocity, acceleration : (n,) array_like
        Finite and above 0 [rad/s], [rad/s^2].

    Raises
    ------
    DesignError
        If `toppra` is not installed, or a limit is not given.
    TrajectoryError
        If there is no such motion.
    """
    toppra = library("toppra")
    points = np.asarray(points, float)
    _refuse_unlimited({"velocity": velocity, "acceleration": acceleration})
    away = np.linalg.norm(np.diff(points, axis=0), axis=1)
    end, points = points[-1], points[np.concatenate([[True], away > SAME])]
    points[-1] = end
    if len(points) < 2:
        return PiecewiseMotion.resting(points[0], 0.0)
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    logging.getLogger("toppra").setLevel(logging.ERROR)
    bounds = [
        np.broadcast_to(values, points[0].shape)[:, None] * np.array([-1.0, 1.0])
        for values in (velocity, acceleration)
    ]
    constraints = [
        toppra.constraint.JointVelocityConstraint(bounds[0]),
        toppra.constraint.JointAccelerationConstraint(bounds[1]),
    ]
    path = toppra.SplineInterpolator(length, points, bc_type="natural")
    grid = _grid(length)
    problem = toppra.algorithm.TOPPRA(constraints, path, gridpoints=grid)
    rate = problem.compute_parameterization(0.0, 0.0)[1]
    if rate is None or not (rate[1:] + rate[:-1] > 0.0).all():
        raise TrajectoryError("has no time law within the limits", field="trajectory")
    # The acceleration along the path is constant between the points of the grid.
    times = np.append(0.0, np.cumsum(2.0 * np.diff(grid) / (rate[1:] + rate[:-1])))
    states = [np.array(path(grid)), np.array(path(grid, 1)) * rate[:, None]]
    states[0][[0, -1]], states[1][[0, -1]] = points[[0, -1]], 0.0
    motion = PiecewiseMotion.through(times, states)
    # Between the points of the grid the limits are exceeded a little.
    places = (times[:-1, None] + np.diff(times)[:, None] * np.array([0.0, 0.5, 1.0 - 1e-6])).ravel()
    speed, bend = (np.abs(motion.derivative(order, places)).max(axis=0) for order in (1, 2))
    slower = max((speed / velocity).max(), np.sqrt((bend / acceleration).max()), 1.0)
    return PiecewiseMotion.through(slower * times, [states[0], states[1] / slower])


def _grid(length):
    """Places (g,) at which the limits are kept: the points at `length` (k,), and equal steps between them."""
    count = int(np.clip(GRID * (length.size - 1), FEWEST, MOST))
    even = np.linspace(0.0, length[-1], count + 1)
    after = np.clip(np.searchsorted(length, even), 1, length.size - 1)
    apart = np.minimum(np.abs(even - length[after - 1]), np.abs(even - length[after]))
    # At two places that differ only by rounding, TOPP-RA's speeds would differ by more than the distance allows.
    return np.union1d(even[apart > CLOSE * even[1]], length)


def _refuse_unlimited(limits):
    for name, values in limits.items():
        values = np.atleast_1d(np.asarray(values, float))
        if not (np.isfinite(values) & (values > 0.0)).all():
            hint = f"give the largest {name} of each joint"
            raise DesignError(
                "is not given", field=f"limits.{name}", value=values.tolist(), hint=hint
            )


def library(name):
    """Import one of the two libraries, `name`.

    Raises
    ------
    DesignError
        If it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        hint = f"install it: pip install {name}"
        raise DesignError("is not installed", field=name, hint=hint) from error
