# SPDX-License-Identifier: Apache-2.0
"""Other ways to simulate the reference cases, to compare flexarm's accuracy and speed with.

Every module has one or more classes with the interface of `Peer`. They do not import ROS. Each module
imports its own third-party package at its top, so import only modules whose package is installed.
"""

import re

import numpy as np

#: Rate at which every peer reports [Hz].
RATE = 100

#: A stage that is no farther than this from a pulse's edge counts as on the edge [s].
EDGE = 1e-9

_SINE = re.compile(r"\s*([-+.\deE]+)\*sin\(2\*pi\*([.\deE]+)\*t\)\s*")


def hubs(parameters):
    """Inertia of the hub of each link of a case [kg m^2], as a list."""
    if "Jh" in parameters:
        return [parameters["Jh"]]
    return [parameters[f"Jh{i}"] for i in range(1, 9) if f"Jh{i}" in parameters]


class Peer:
    """A simulation of one reference case that starts at rest.

    Parameters
    ----------
    case : str
        One of `cases.TARGETS`.
    parameters : dict
        Parameters of that case, see `cases.parameters`.
    **settings
        The settings of the code: step, segments, tolerance.
    """

    name = ""

    def __init__(self, case, parameters, **settings):
        self.case, self.parameters, self.settings = case, parameters, settings
        self.links = len(hubs(parameters))
        self.torque = Torque(case, parameters)

    def integrate(self, duration):
        """Simulate from rest for a `duration` [s]: torques and integration. The time of this part is compared.

        Returns the code's own result, for `report`.
        """
        raise NotImplementedError

    def report(self, result):
        """Kinematics of what `integrate` returned, sampled at `RATE`, start and end included; each has shape (n,).

        Keys: theta1, tip_x, tip_y; for a spatial arm also tip_z; for two planar links also elbow_x, elbow_y, alpha2
        [rad, m].
        """
        raise NotImplementedError

    def run(self, duration):
        """Simulate from rest for a `duration` [s]; return the times (n,) [s] and the `report` at these times."""
        return times(duration), self.report(self.integrate(duration))


class Torque:
    """Joint torques of a case as functions of time; case and parameters are those of `Peer`.

    Attributes
    ----------
    count : int
        Number of joints.
    edges : tuple of float
        Times at which a torque jumps [s].
    level : tuple of float
        Torques before, between and after the edges [N m], one more than edges; empty if no torque jumps.
    sines : list of tuple of float
        Amplitude [N m] and angular frequency [rad/s] of each joint's sine; empty for a pulse.
    """

    def __init__(self, case, parameters):
        if case == "one_link_pulse":
            height = parameters["T"]
            self.count, self.edges, self.level = 1, (0.5, 1.0), (height, -height, 0.0)
            self.sines = []
        else:
            keys = [f"tau{i + 1}" for i in range(len(hubs(parameters)))]
            self.count, self.edges, self.level, self.sines = len(keys), (), (), []
            for key in keys:
                match = _SINE.fullmatch(parameters[key])
                if match is None:
                    raise ValueError(f"{key}: {parameters[key]!r} is not amplitude*sin(2*pi*f*t)")
                self.sines.append((float(match[1]), 2.0 * np.pi * float(match[2])))

    def __call__(self, t):
        """Torques [N m] at time t [s], shape (count,); on an edge, the level after it."""
        if self.edges:
            return np.array([self.level[sum(t >= edge for edge in self.edges)]])
        return np.array([a * np.sin(w * t) for a, w in self.sines])

    def sample(self, t):
        """Torques [N m] at many times [s], shape (n, count); on an edge, the mean of both levels."""
        t = np.asarray(t)
        if not self.edges:
            return np.stack([a * np.sin(w * t) for a, w in self.sines], axis=-1)
        level = np.array(self.level)
        before = np.searchsorted(self.edges, t - EDGE)
        after = np.searchsorted(self.edges, t + EDGE)
        return (0.5 * (level[before] + level[after]))[:, None]

    def stages(self, steps, step):
        """Torques [N m] at each step's start, middle and end, shape (steps, 3, count).

        If a pulse's edge is on the boundary of a step, the level inside the step is used. Otherwise the last
        stage of Runge-Kutta would use the torque of the next step, and the method would be of first order.
        """
        t = step * np.arange(steps)
        if not self.edges:
            half = self.sample(0.5 * step * np.arange(2 * steps + 1))
            return np.stack([half[:-1:2], half[1::2], half[2::2]], axis=1)
        inside = (t + 2.0 * EDGE, t + 0.5 * step, t + step - 2.0 * EDGE)
        return np.stack([self.sample(s) for s in inside], axis=1)


def steps_per_sample(step):
    """Number of steps between two reports; raises ValueError if the `step` does not divide the interval."""
    count = round(1.0 / (RATE * step))
    if count < 1 or abs(count * step * RATE - 1.0) > 1e-9:
        raise ValueError(f"a step of {step} s does not divide 1/{RATE} s")
    return count


def times(duration):
    """Times of the report [s], shape (n,)."""
    return np.arange(round(duration * RATE) + 1) / RATE


def errors(columns, reference):
    """Largest deviations of the `columns` of `Peer.run` from a `reference` at `RATE`, which may be longer.

    ``tip``: largest distance between the tips [m]; ``theta1``: largest deviation [rad].
    """
    n = len(columns["theta1"])

    def off(key):
        return columns[key] - reference[key][:n]

    return {
        "tip": float(
            np.max(np.linalg.norm([off(k) for k in columns if k.startswith("tip_")], axis=0))
        ),
        "theta1": float(np.max(np.abs(off("theta1")))),
    }
