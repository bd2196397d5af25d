# SPDX-License-Identifier: Apache-2.0
"""Describes the case under analysis: an arm, its controller as designed, and the motion for which it is designed."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from flexarm_control.composite import full_order
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Arm, scaled
from flexarm_dynamics.models import model

from ..loop import scenario as scenarios

#: Stability margin that lets every design pass its check: unstable ones are analysed, too [1/s].
UNCHECKED = -1e6
#: Number of configurations along the motion.
ALONG = 21


@dataclass(frozen=True)
class Case:
    """A design and the motion for which it is made.

    Attributes
    ----------
    scenario : Scenario
        With `UNCHECKED`, so its design is not refused because of its poles.
    model : ArmModel
    law : CompositeControl
    period : float
        [s]
    times : ndarray, shape (k,)
        Along the motion [s].
    positions, velocities : ndarray, shape (k, n)
        [rad], [rad/s]
    """

    scenario: scenarios.Scenario
    model: object
    law: object
    period: float
    times: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray

    @property
    def q(self):
        """End of the motion, where the loop is linearised, shape (n,) [rad]."""
        return self.positions[-1]

    @property
    def places(self):
        """Start, middle and end of the motion, where the loop is judged, shape (3, n) [rad]."""
        return self.positions[[0, len(self.positions) // 2, -1]]

    @property
    def arm(self):
        """The arm file's content."""
        return self.model.arm

    @property
    def without_poles(self):
        """Why there is no linear loop to analyse; empty if there is one."""
        if self.law.slow.drifts:
            return "the slow law leaves the joints free"
        return ""

    def poles(self, plant=None, delay=0.0, period=None, gain=1.0):
        """Poles of the sampled full-order loop, mapped to continuous time [1/s], slowest first.

        Parameters
        ----------
        plant : Arm, optional
            The controlled arm; the design's own if not given.
        delay, period : float
            [s]
        gain : float
            Factor of the torque on its way to the arm [-].
        """
        met = None if plant is None else model.build(plant)
        return full_order.poles(self.law, self.q, period or self.period, delay, met, gain)

    def decay(self, **changed):
        """Decay rate of the slowest pole [1/s]; negative if it grows."""
        return -float(self.poles(**changed)[0].real)


def unchecked(scenario):
    """The scenario, with a design that is not refused because of its poles."""
    return replace(scenario, controller=scenario.controller | {"stability_margin": UNCHECKED})


def of(scenario):
    """The case that a `scenario` describes."""
    scenario = unchecked(scenario)
    loop = scenarios.loop_of(scenario)
    motion = scenarios.trajectory_of(scenario.trajectory, loop.model, loop.simulator.position)
    times = 1e-9 * np.asarray(motion.times_ns, float)
    velocities = np.zeros_like(motion.positions) if motion.velocities is None else motion.velocities
    along = np.linspace(times[0], times[-1], ALONG)
    at = lambda values: np.column_stack([np.interp(along, times, v) for v in np.transpose(values)])  # noqa: E731
    return Case(
        scenario,
        loop.model,
        loop.controller.law,
        1e-9 * loop.simulator.period_ns,
        along,
        at(motion.positions),
        at(velocities),
    )


def redesigned(case, **parameters):
    """The composite control with other parameters, on the same arm (`slow.kp` is written `slow__kp`)."""
    given = {k.replace("__", "."): v for k, v in parameters.items()}
    controller = case.scenario.controller | given | {"feedforward": "none"}
    return scenarios.loop_of(replace(case.scenario, controller=controller)).controller.law


def slower_bending(scenario, factor):
    r"""The same design for an arm whose bending is slower: mu times `factor`, in the arm and in the control model.

    With EI and GJ times 1/factor^2 the fast time scale is `factor` times as long, and nothing else changes. The fast
    control is redesigned for the same loop in its own time: in (18) :math:`\delta/\mu^2`, :math:`\dot\delta/\mu` and
    :math:`t/\mu` replace delta, its rate and t. Gains of other laws follow from the arm.

    Returns the `scenario` with an `Arm` as its arm.
    """
    arm = scenario.arm if isinstance(scenario.arm, Arm) else arm_file.load(scenario.arm)
    kind = scenarios.type_of("fast", scenario.controller)
    values = dict(scenario.controller)
    declared = {p.name: p for p in scenarios.declared("fast", scenario.controller)}
    modes = len(arm.mode_names)
    if {"q", "alpha"} <= set(declared):
        q = np.asarray(values.get("fast.q", declared["q"].default), float)
        q = np.broadcast_to(q, 2 * modes).copy()
        q[:modes] *= factor**-4
        q[modes:] *= factor**-2
        values["fast.q"] = q.tolist()
        values["fast.alpha"] = float(values.get("fast.alpha", declared["alpha"].default)) / factor
    if "observer_pole" in declared:
        pole = values.get("fast.observer_pole", declared["observer_pole"].default)
        values["fast.observer_pole"] = float(pole) / factor
    values["fast.type"] = kind
    return replace(scenario, arm=scaled(arm, stiffness=factor**-2), controller=values)


def first_loss(stable, start, end, scan=12, steps=20):
    """Find where a loop that is stable at `start` first becomes unstable towards `end`, by a scan and bisection.

    Parameters
    ----------
    stable : callable
        From a value: whether the loop is stable.
    start, end : float
        The scan's steps are geometric if both are above 0, otherwise even.
    scan, steps : int
        Intervals of the scan, and bisections of the one in which stability is lost.

    Returns
    -------
    float or None
        The last value known as stable; None if all are. `start` if the loop is unstable there.
    """
    grid = np.geomspace if min(start, end) > 0.0 else np.linspace
    values = grid(start, end, scan + 1)
    if not stable(float(values[0])):
        return float(start)
    for good, bad in pairwise(values):
        if stable(float(bad)):
            continue
        for _ in range(steps):
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if stable(float(middle)) else (good, middle)
        return float(good)
    return None
