# SPDX-License-Identifier: Apache-2.0
r"""Exudyn model of planar flexible links from ANCF cable elements.

Every node has a position and a slope vector :math:`r'` (`NodePoint2DSlope1`); the cables' axial
stiffness keeps :math:`|r'|` near one, so that an inertia J on :math:`\dot r'` in both directions is
the inertia J against rotation of that cross-section. Hubs and payload are therefore constant mass
matrices on nodes (`ObjectGenericODE2`) and only pivots are constraints: two for the base, two for
the elbow. Torques are symbolic user functions, which Exudyn evaluates without Python.
"""

from itertools import pairwise

import exudyn
import numpy as np
from exudyn.itemInterface import (
    CoordinateConstraint,
    LoadTorqueVector,
    MarkerNodeCoordinate,
    MarkerNodeRigid,
    NodePoint2DSlope1,
    NodePointGround,
    ObjectANCFCable2D,
    ObjectGenericODE2,
    SensorNode,
)
from exudyn.utilities import CreateSymbolicUserFunction

from . import Peer, hubs, steps_per_sample, times

#: Version that was tested; wheels for CPython 3.10 to 3.14.
PINNED = "exudyn==1.13.6"

#: Fastest settings that keep the tip within 0.5 mm (one_link_pulse), 50 um (two_link_torque_x0p1)
#: and 0.1 mm (two_link_torque). Scanned: 1 to 4 elements, steps of 10, 5 and 2.5 ms, axial 1e5 and
#: 1e6, spectral radius 0.6 to 1, Newton's tolerances; a setting counts only if half its step keeps
#: the target too. One element for one_link_pulse is accurate only with axial = 1e5 (0.8 mm with
#: 1e6). Two elements do not depend on this; they take 0.50 instead of 0.39 ms per second.
BEST = {
    "ExudynCable": {
        "one_link_pulse": {"elements": 1, "step": 1e-2, "rtol": 1e-4, "atol": 1e-6},
        "two_link_torque_x0p1": {"elements": 1, "step": 1e-2, "rtol": 1e-4, "atol": 1e-6},
        "two_link_torque": {"elements": 2, "step": 5e-3, "rtol": 1e-4, "atol": 1e-6},
        "three_link_torque": {
            "elements": 3, "step": 2.5e-3, "axial": 1e6, "spectral_radius": 0.8, "rtol": 1e-4, "atol": 1e-6,
        },
    }
}  # fmt: skip


class ExudynCable(Peer):
    """ANCF cables, generalised-alpha.

    Parameters
    ----------
    step : float
        Step [s]; divides 10 ms. On a pulse's edge the torque is the mean of both levels.
    elements : int
        Cable elements per link.
    axial : float
        EA [N]; the beams of the reference are inextensible.
    spectral_radius : float
        Spectral radius of generalised-alpha at infinite frequency.
    rtol, atol : float
        Tolerances of Newton's method.
    modified_newton : bool
        Whether the Jacobian is kept over several steps.
    sparse : bool
        Whether Eigen's sparse solver replaces Exudyn's dense one.
    """

    name = "Exudyn ANCF cable, generalised-alpha"

    def __init__(
        self,
        case,
        parameters,
        *,
        step=1e-3,
        elements=4,
        axial=1e5,
        spectral_radius=0.9,
        rtol=1e-6,
        atol=1e-8,
        modified_newton=True,
        sparse=False,
    ):
        super().__init__(case, parameters, step=step, elements=elements)
        steps_per_sample(step)
        self.step, self.elements, self.axial = step, elements, axial
        # Items refer to the container, so it must live as long as they do.
        self.container = exudyn.SystemContainer()
        self.system = self.container.AddSystem()
        self.functions = []
        self._build()
        self.system.Assemble()
        self.options = self._options(spectral_radius, rtol, atol, modified_newton, sparse)

    def _build(self):
        """Nodes, cables, masses, pivots, torques and sensors."""
        p, system = self.parameters, self.system
        ground = system.AddNode(NodePointGround())
        ends, pivot, self.sensors = [], None, []
        for number, hub in enumerate(hubs(p)):
            start = number * p["L"]
            nodes = [
                system.AddNode(NodePoint2DSlope1(referenceCoordinates=[start + x, 0.0, 1.0, 0.0]))
                for x in np.linspace(0.0, p["L"], self.elements + 1)
            ]
            for pair in pairwise(nodes):
                system.AddObject(
                    ObjectANCFCable2D(
                        physicsLength=p["L"] / self.elements,
                        physicsMassPerLength=p["rhoA"],
                        physicsBendingStiffness=p["EI"],
                        physicsAxialStiffness=self.axial,
                        nodeNumbers=list(pair),
                        useReducedOrderIntegration=1,
                    )
                )
            self._mass(nodes[0], p["Mm"] if number else 0.0, hub)
            for axis in (0, 1):
                anchor = ground if pivot is None else pivot
                markers = [
                    system.AddMarker(
                        MarkerNodeCoordinate(
                            nodeNumber=node, coordinate=0 if node is ground else axis
                        )
                    )
                    for node in (anchor, nodes[0])
                ]
                system.AddObject(CoordinateConstraint(markerNumbers=markers))
            self._torque(nodes[0], number, 1.0)
            if pivot is not None:
                self._torque(pivot, number, -1.0)
            pivot = nodes[-1]
            ends.append((nodes[0], nodes[-1]))
        self._mass(pivot, p["Mp"], p["Jp"])
        for pair in ends:
            for node in pair:
                self.sensors.append(
                    system.AddSensor(
                        SensorNode(
                            nodeNumber=node,
                            storeInternal=True,
                            writeToFile=False,
                            outputVariableType=exudyn.OutputVariableType.Coordinates,
                        )
                    )
                )

    def _mass(self, node, mass, inertia):
        """Put a point mass and an inertia on a node."""
        self.system.AddObject(
            ObjectGenericODE2(
                nodeNumbers=[node], massMatrix=np.diag([mass, mass, inertia, inertia])
            )
        )

    def _torque(self, node, joint, sign):
        """Put a joint's torque on a node."""
        choose, sine = exudyn.symbolic.IfThenElse, exudyn.symbolic.sin
        edges, level = self.torque.edges, self.torque.level
        near = 0.25 * self.step

        def pulse(mbs, t, load):
            value = exudyn.symbolic.Real(sign * level[-1])
            for k in reversed(range(len(edges))):
                mean = exudyn.symbolic.Real(0.5 * sign * (level[k] + level[k + 1]))
                value = choose(t < edges[k] + near, mean, value)
                value = choose(t < edges[k] - near, exudyn.symbolic.Real(sign * level[k]), value)
            return [0.0, 0.0, value]

        def wave(mbs, t, load):
            amplitude, omega = self.torque.sines[joint]
            return [0.0, 0.0, sign * amplitude * sine(omega * t)]

        function = CreateSymbolicUserFunction(
            self.system,
            pulse if edges else wave,
            "loadVectorUserFunction",
            itemTypeName="LoadTorqueVector",
        )
        self.functions.append(function)
        marker = self.system.AddMarker(MarkerNodeRigid(nodeNumber=node))
        self.system.AddLoad(
            LoadTorqueVector(
                markerNumber=marker, loadVector=[0.0, 0.0, 1.0], loadVectorUserFunction=function
            )
        )

    def _options(self, spectral_radius, rtol, atol, modified_newton, sparse):
        """Simulation settings without the end time."""
        options = exudyn.SimulationSettings()
        options.solution.file.write = False
        options.solution.sensors.writePeriod = 0.01
        options.linearSolver.solverType = (
            exudyn.LinearSolverType.EigenSparse if sparse else exudyn.LinearSolverType.EXUdense
        )
        integration = options.timeIntegration
        integration.verboseMode = 0
        integration.adaptiveStep = False
        integration.generalizedAlpha.spectralRadius = spectral_radius
        integration.newton.useModifiedNewton = modified_newton
        integration.newton.relativeTolerance = rtol
        integration.newton.absoluteTolerance = atol
        return options

    def integrate(self, duration):
        integration = self.options.timeIntegration
        integration.endTime = float(duration)
        integration.numberOfSteps = round(duration / self.step)
        if not self.system.SolveDynamic(self.options):
            raise RuntimeError("Exudyn's solver failed")
        return times(duration).size

    def report(self, result):
        data = [self.system.GetSensorStoredData(s)[:result, 1:] for s in self.sensors]
        length = self.parameters["L"]
        columns = {"theta1": np.arctan2(data[0][:, 3], 1.0 + data[0][:, 2])}
        columns |= {"tip_x": self.links * length + data[-1][:, 0], "tip_y": data[-1][:, 1]}
        if self.links != 2:
            return columns
        return columns | {
            "elbow_x": length + data[1][:, 0],
            "elbow_y": data[1][:, 1],
            "alpha2": np.arctan2(data[2][:, 3], 1.0 + data[2][:, 2]),
        }
