# SPDX-License-Identifier: Apache-2.0
"""This project with the interface of the other codes."""

import numpy as np

from flexarm_sim.integrators import METHODS

from . import cases
from .peers import RATE, Peer, steps_per_sample

#: Fastest settings that keep the tip within `cases.TARGETS`. Scanned: RK4, DOP853 and the implicit
#: method, 10 to 2 ms. 10 ms is the longest step that the report's 100 Hz allow.
BEST = {
    "Flexarm": {
        "one_link_pulse": {"step": 1e-2},
        "two_link_torque_x0p1": {"step": 1e-2},
        "two_link_torque": {"step": 1e-2, "foreshortening": True},
        "three_link_torque": {"step": 1e-2, "foreshortening": True},
        "spatial_torque": {"step": 1e-2, "foreshortening": True},
    },
    "FlexarmLoops": {
        "one_link_pulse": {"step": 1e-2},
        "two_link_torque_x0p1": {"step": 1e-2},
        "two_link_torque": {"step": 1e-2, "foreshortening": True},
        "three_link_torque": {"step": 1e-2, "foreshortening": True},
        "spatial_torque": {"step": 1e-2, "foreshortening": True},
    },
}


def linear_torque(torque, intervals, length):
    """Approximate a case's `torque` by a linear function of time in each interval.

    Returns the torques at the starts and at the ends of the intervals, each (intervals, joints) [N m]. `intervals` is
    their number, `length` the duration of each [s]. The mean over an interval equals that by Simpson's rule.
    """
    stages = torque.stages(intervals, length)
    start, middle, end = stages[:, 0], stages[:, 1], stages[:, 2]
    bulge = (2.0 * middle - start - end) / 3.0
    return start + bulge, end + bulge


class Flexarm(Peer):
    """`flexarm_dynamics.models.chain.Chain` with a fixed step.

    Parameters
    ----------
    step : float
        Step [s]; divides 10 ms.
    method : str
        Of `flexarm_sim.integrators.METHODS`.
    foreshortening : bool
        As in an arm file.
    """

    name = "flexarm"
    straight_line = True

    def __init__(self, case, parameters, *, step=1e-3, method="rk4", foreshortening=False):
        super().__init__(case, parameters, step=step, method=method, foreshortening=foreshortening)
        self.step, self.every = step, steps_per_sample(step)
        self.chain = cases.chain(parameters, foreshortening=foreshortening)
        self.size = self.chain.n_joints + self.chain.n_modes
        self.stepper = self.chain.stepper(METHODS[method], straight_line=self.straight_line)
        self.integrate(1.0 / RATE)  # compiles

    def integrate(self, duration):
        starts, ends = linear_torque(self.torque, round(duration * RATE), 1.0 / RATE)
        states = np.empty((len(starts) + 1, 2 * self.size))
        states[0] = 0.0
        self.stepper.trajectory(states, starts, ends, self.step, self.every)
        return states

    def report(self, result):
        n = self.chain.n_joints
        frames = [self.chain.frames(state[:n], state[n : self.size]) for state in result]
        points = np.array([p for _, p in frames])
        columns = {"theta1": result[:, 0], "tip_x": points[:, -1, 0], "tip_y": points[:, -1, 1]}
        if self.chain.planar_axis is None:
            return columns | {"tip_z": points[:, -1, 2]}
        if self.links != 2:
            return columns
        turns = np.array([R[1] for R, _ in frames])
        return columns | {
            "elbow_x": points[:, 1, 0],
            "elbow_y": points[:, 1, 1],
            "alpha2": np.arctan2(turns[:, 1, 0], turns[:, 0, 0]),
        }


class FlexarmLoops(Flexarm):
    """The same without generated code: the recursion that serves every arm."""

    name = "flexarm, general code in loops"
    straight_line = False
