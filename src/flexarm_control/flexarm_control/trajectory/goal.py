# SPDX-License-Identifier: Apache-2.0
r"""Decides when a motion has reached its goal: the joints within their tolerances, and the tip at rest.

A joint_trajectory_controller ends a goal when the *joints* are there; an arm with flexible links then still swings.
Here the tip has to rest, too: it may have moved by no more than `tip` within half a period of the lowest bending mode,

.. math:: \max_{t-T/2 \le a, b \le t} |p(a) - p(b)|_\infty \le p_{max}, \qquad p = p(q, \delta)

from joint positions and modal amplitudes. A harmonic motion of the amplitude A moves by A to 2 A in that time, whatever
its phase. So A is at most :math:`p_{max}`. The place where the tip rests does not matter, because an unknown payload
bends the links.
"""

from collections import deque
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from flexarm_dynamics.errors import TrajectoryError
from flexarm_dynamics.parameters import parameter

from .values import SECOND

PARAMETERS = (
    parameter("constraints.trajectory", [0.0], "rad", 0.0, 100.0, length="joints").described(
        "How far a joint may be from its reference during the motion; beyond it the goal is aborted and the arm"
        " stopped. 0.0: not judged."
    ),
    parameter("constraints.goal", [0.0], "rad", 0.0, 100.0, length="joints").described(
        "How far a joint may be from the end of its trajectory for the goal to succeed. 0.0: not judged."
    ),
    parameter("constraints.stopped_velocity_tolerance", 0.01, "rad/s", 0.0, 100.0).described(
        "Largest speed of a joint for the goal to succeed. 0.0: not judged."
    ),
    parameter("constraints.tip", 0.0, "m", -1.0, 100.0).described(
        "How far the tip may have moved in the last half period of the lowest mode (once to twice its amplitude) for a"
        " goal to succeed; 0.0: a thousandth of the arm's reach; negative: not judged."
    ),
    parameter("constraints.goal_time", 0.0, "s", 0.0, 1e4).described(
        "A goal that has not succeeded this long after the end of its trajectory is aborted. 0.0: never."
    ),
)

#: Minimum number of looks at the tip within half a period.
LOOKS = 8
#: Fraction of the reach that the tip may swing if nothing else is stated [-].
OF_REACH = 1e-3


class Code(IntEnum):
    """How a goal ended, with the numbers of control_msgs/FollowJointTrajectory."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


@dataclass(frozen=True)
class Tolerances:
    """Tolerances of a goal; infinite where something is not judged.

    Attributes
    ----------
    path, goal : ndarray, shape (2, n)
        Positions [rad] and speeds [rad/s].
    time : float
        [s]
    tip : float
        [m]
    """

    path: np.ndarray
    goal: np.ndarray
    time: float
    tip: float


def tolerances(names, reach, values, path=(), goal=(), time=0.0, tip=0.0):
    """The tolerances of a goal: its own if it has some, otherwise those of the parameters.

    Parameters
    ----------
    names : sequence of str
        Names of the n joints.
    reach : float
        Reach of the arm [m].
    values : mapping
        Values of `PARAMETERS`.
    path, goal : sequence of (name, position, velocity)
        [rad], [rad/s]; 0: the parameter counts, negative: not judged.
    time, tip : float
        [s], [m]; likewise.

    Raises
    ------
    TrajectoryError
        If a joint is not one of the arm's, or a number is not finite.
    """
    n = len(names)
    speed = values["constraints.stopped_velocity_tolerance"]
    own = np.array([np.broadcast_to(values["constraints.trajectory"], n), np.zeros(n)])
    end = np.array([np.broadcast_to(values["constraints.goal"], n), np.full(n, speed)])
    for field, rows, limits in (("path_tolerance", path, own), ("goal_tolerance", goal, end)):
        for i, (name, position, velocity) in enumerate(rows):
            if name not in names:
                raise TrajectoryError(
                    "is no joint of this arm",
                    field=f"{field}[{i}].name",
                    value=name,
                    limit=", ".join(names),
                )
            for row, (what, value) in enumerate((("position", position), ("velocity", velocity))):
                _number(f"{field}[{i}].{what} of {name}", value)
                if value != 0.0:
                    limits[row, names.index(name)] = value
    _number("goal_time_tolerance", time)
    _number("tip_tolerance", tip)
    tip = tip or values["constraints.tip"] or OF_REACH * reach
    time = time or values["constraints.goal_time"]
    judged = [np.where(limits > 0.0, limits, np.inf) for limits in (own, end)]
    return Tolerances(*judged, *(value if value > 0.0 else np.inf for value in (time, tip)))


def _number(field, value):
    if not np.isfinite(value):
        raise TrajectoryError("is no finite number", field=field, value=value)


class TipSwing:
    """How far the tip has moved within half a period of the lowest mode.

    Parameters
    ----------
    period : float
        [s]; 0 for a rigid arm.
    """

    def __init__(self, period):
        self._span = round(0.5 * period * SECOND)
        self._places = deque()

    def add(self, stamp_ns, place):
        """Take the tip's place (3,) [m] at a stamp; one that is not later than the last is ignored."""
        places = self._places
        if places and stamp_ns <= places[-1][0]:
            return
        places.append((stamp_ns, np.array(place, float)))
        # The oldest place that is needed lies half a period or `LOOKS` looks back, whichever is longer ago.
        while len(places) > LOOKS + 1 and places[1][0] <= stamp_ns - self._span:
            places.popleft()

    @property
    def value(self):
        """Largest movement along one axis [m]; NaN until half a period is over."""
        places = self._places
        if len(places) < LOOKS or places[-1][0] - places[0][0] < self._span:
            return np.nan
        return float(np.ptp([place for _, place in places], axis=0).max())


@dataclass(frozen=True)
class Outcome:
    """How a goal ended.

    Attributes
    ----------
    code : Code
    text : str
        What happened, in words.
    swing : float
        Swing of the tip [m]; NaN if it was not judged.
    """

    code: Code
    text: str
    swing: float = np.nan


class GoalCheck:
    """Follows an accepted trajectory to its end, look by look.

    Parameters
    ----------
    joint_names : sequence of str
    tolerances : Tolerances
    end_ns : int
        When the trajectory ends, or can end at the earliest [ns].
    period : float
        Period of the lowest bending mode [s].
    """

    def __init__(self, joint_names, tolerances, end_ns, period):
        self._names, self.tolerances, self._end_ns = tuple(joint_names), tolerances, end_ns
        self._swing, self._since = TipSwing(period), None

    def on_the_way(self, error, velocity_error):
        """Judge the arm during the motion, by errors (n,) [rad], [rad/s]; an `Outcome` ends the goal."""
        at = self._beyond((error, velocity_error), self.tolerances.path)
        if at is None:
            return None
        text = f"path tolerance violated: {at}"
        return Outcome(Code.PATH_TOLERANCE_VIOLATED, text)

    def at_the_end(self, stamp_ns, error, velocity, tip):
        """Judge the arm while its reference holds the end.

        Parameters
        ----------
        stamp_ns : int
            [ns]; before `end_ns` the reference is not there yet.
        error, velocity : ndarray, shape (n,)
            Distance of the joints from the end [rad], and their speed [rad/s].
        tip : ndarray, shape (3,)
            Place of the tip [m].

        Returns
        -------
        Outcome or None
            None: go on.
        """
        if stamp_ns < self._end_ns:
            return None
        self._since = stamp_ns if self._since is None else min(self._since, stamp_ns)
        limit = self.tolerances
        missing = self._beyond((error, velocity), limit.goal)
        swing = np.nan
        if np.isfinite(limit.tip):
            self._swing.add(stamp_ns, tip)
            swing = self._swing.value
            if missing is None and not swing <= limit.tip:
                what = (
                    "has not rested yet" if np.isnan(swing) else f"swings by {1e3 * swing:.3g} mm"
                )
                missing = f"the tip {what}, {1e3 * limit.tip:.3g} mm are allowed"
        if missing is None:
            return Outcome(Code.SUCCESSFUL, "goal reached", swing)
        if stamp_ns - self._since > limit.time * SECOND:
            text = f"goal_time_tolerance of {limit.time:g} s is over: {missing}"
            return Outcome(Code.GOAL_TOLERANCE_VIOLATED, text, swing)
        return None

    def _beyond(self, values, limits):
        """The joint that is farthest beyond its limit, in words; None if none is."""
        excess = np.abs(values) / np.where(limits > 0.0, limits, 1.0)
        if not (excess > 1.0).any():
            return None
        row, j = np.unravel_index(int(np.argmax(excess)), excess.shape)
        unit = ("rad", "rad/s")[row]
        off, limit = abs(values[row][j]), limits[row, j]
        return f"{self._names[j]} is off by {off:.3g} {unit}, {limit:.3g} {unit} are allowed"
