# SPDX-License-Identifier: Apache-2.0
"""Finds the shaper type ``retimed`` for a motion: the shortest new time law that leaves at most the wanted vibration.

`flexarm_control.shaping.time_law` predicts what a time law leaves: for each mode the largest vibration over its spread,
divided by the largest vibration that the unshaped motion leaves. Several modes are combined as in `recommendation`.
"""

from dataclasses import replace

import numpy as np

from flexarm_control.shaping import modes as modes_module
from flexarm_control.shaping import time_law
from flexarm_control.shaping.piecewise import PiecewiseMotion
from flexarm_control.trajectory.request import JointTrajectoryData
from flexarm_control.trajectory.values import SECOND
from flexarm_dynamics.parameters import check_all

from .recommendation import LONGEST, SHORTEST, WIDEST, Candidate

RETIMED = modes_module.RETIMED
#: Number of bisection steps to find the shortest time law.
HALVINGS = 5
#: Fraction by which frequencies may be off if they were measured in several configurations, as in the node [-].
SPREAD = 0.15


def of_move(move) -> JointTrajectoryData:
    """The quickest motion of one joint within the limits of a `Move`: a trapezoid of speed, or a triangle."""
    ramp = min(move.velocity / move.acceleration, np.sqrt(move.distance / move.acceleration))
    times = np.array([0.0, ramp, move.duration - ramp, move.duration])
    speed, done = move.acceleration * ramp, 0.5 * move.acceleration * ramp**2
    positions = np.array([0.0, done, move.distance - done, move.distance])
    kept = np.append(np.diff(times) > 1e-9, True)
    fields = (v[kept][:, None] for v in (positions, np.array([0.0, speed, speed, 0.0])))
    times_ns = np.rint(times[kept] * SECOND).astype(np.int64)
    return JointTrajectoryData(0, ("joint1",), times_ns, *fields)


def retimed(trajectory, spreads, places, residual):
    """The shortest new time law that leaves at most the wanted residual, or the best one.

    Parameters
    ----------
    trajectory : JointTrajectoryData
    spreads : sequence of Spread
    places : sequence of (ndarray, list of Spread)
        Configurations [rad] and the modes there; if empty, the modes are the same everywhere.
    residual : float
        Wanted residual [-].

    Returns
    -------
    tuple of Candidate and JointTrajectoryData, or None
        None if the motion is not straight from rest to rest, or has no velocities.
    """
    if len(trajectory.fields) == 1:
        return None
    motion = PiecewiseMotion.through(trajectory.times, trajectory.fields)
    if time_law.along(motion) is None:
        return None
    before = np.array(
        [values.max() for values in time_law.leaves(motion, _modes(motion, spreads, places, 1.0))]
    )
    if not (before > 0.0).all():
        return None

    def made(periods):
        modes = _modes(motion, spreads, places, periods)
        new = time_law.retimed(motion, modes)
        return None if new is None else (_candidate(new, motion, modes, before, spreads), new)

    best, low, high = made(LONGEST), SHORTEST, LONGEST
    if best is not None and best[0].residual <= residual:
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            now = made(middle)
            if now is not None and now[0].residual <= residual:
                high, best = middle, now
            else:
                low = middle
    return None if best is None else (best[0], _as_data(best[1], trajectory))


def _candidate(new, motion, modes, before, spreads):
    left = time_law.leaves(new, modes)
    part = np.array([s.part for s in spreads])
    part = part / part.sum()
    both = (np.array([values.max() for values in left]), np.array([v[len(v) // 2] for v in left]))
    worst, nominal = (float(np.sqrt(part @ (values / before) ** 2)) for values in both)
    every = tuple(range(len(spreads)))
    delay = float(new.duration - motion.duration)
    return Candidate(
        RETIMED, every, delay, worst, nominal, spread=modes.spread, periods=modes.periods
    )


def _modes(motion, spreads, places, periods):
    """The `Modes` of the node."""
    rows = [here for _, here in places] or [spreads]
    spread = SPREAD if places else max((s.high - s.low) / (s.high + s.low) for s in spreads)
    settings = {
        "type": RETIMED,
        "frequencies": [float(s.frequency) for row in rows for s in row],
        "dampings": [float(s.damping) for row in rows for s in row],
        "configurations": [float(q) for place, _ in places for q in place],
        "spread": float(min(spread, WIDEST)),
        "periods": float(periods),
    }
    return modes_module.Modes(check_all(modes_module.PARAMETERS, settings), motion.start.size)


def _as_data(motion, trajectory):
    times_ns = np.rint((motion.knots - motion.knots[0]) * SECOND).astype(np.int64)
    states = motion.states(motion.knots)
    return replace(
        trajectory, times_ns=times_ns, positions=states[0], velocities=states[1], accelerations=None
    )
