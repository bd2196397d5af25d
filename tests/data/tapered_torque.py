# SPDX-License-Identifier: Apache-2.0
"""Writes tapered_torque.csv: a two-link arm with tapered links under sinusoidal torques, by Exudyn; no flexarm in it.

Geometrically exact beam elements, each with the mass per length of its piece of the taper and the mean of its
flexibility, 1/EI; extrapolated in the mesh, in the step and in the stiffness against stretching and shear. Needs
``pip install exudyn==1.13.6``:

    python tests/data/tapered_torque.py
"""

from itertools import pairwise
from pathlib import Path

import exudyn
import numpy as np
from exudyn.itemInterface import (
    CoordinateConstraint,
    LoadTorqueVector,
    MarkerNodeCoordinate,
    MarkerNodeRigid,
    NodePointGround,
    NodeRigidBody2D,
    ObjectBeamGeometricallyExact2D,
    ObjectGenericODE2,
    SensorNode,
)
from exudyn.utilities import CreateSymbolicUserFunction

SAMPLES, PERIOD = 301, 0.01
JOINTS = ({"hub": 0.05, "motor": 0.0}, {"hub": 0.02, "motor": 0.6})
PAYLOAD = {"mass": 0.3, "inertia": 5e-4}
#: Amplitude [N m] and frequency [Hz] of each joint's torque.
TORQUE = ((8.0, 0.5), (0.8, 0.8))
LENGTH = (1.2, 0.9)
#: Where the section jumps, or starts to be tapered [m].
BREAKS = ((0.0, 0.5, 1.2), (0.0, 0.9))


def boom(x):
    """Mass per length and EI of the first link: a CFRP tube of 20 x 1 mm, from 0.5 m on tapered to 12 x 0.8 mm."""
    t = np.maximum(x - 0.5, 0.0) / 0.7
    outer, wall = 0.020 - 0.008 * t, 0.001 - 0.0002 * t
    inner = outer - 2.0 * wall
    area = np.pi / 4.0 * (outer**2 - inner**2)
    return 1600.0 * area, 9e10 * np.pi / 64.0 * (outer**4 - inner**4)


def blade(x):
    """The same of the second link: an aluminium strip, 30 mm high, tapered from 6 to 3 mm."""
    thick = 0.006 - 0.003 * x / 0.9
    return 2700.0 * 0.03 * thick, 7e10 * 0.03 * thick**3 / 12.0


SECTIONS = (boom, blade)


class Simulation:
    """One mesh: elements between two breaks, `stiff` against stretching and shear [N]."""

    def __init__(self, elements, stiff):
        self.container = exudyn.SystemContainer()
        self.system = self.container.AddSystem()
        self.elements, self.stiff = elements, stiff
        self.sensors, self.functions = [], []
        self._build()
        self.system.Assemble()

    def _build(self):
        system, start, pivot = self.system, 0.0, None
        ground = system.AddNode(NodePointGround())
        for i, joint in enumerate(JOINTS):
            places = self._mesh(i)
            nodes = [
                system.AddNode(NodeRigidBody2D(referenceCoordinates=[start + x, 0.0, 0.0]))
                for x in places
            ]
            for pair, ends in zip(pairwise(nodes), pairwise(places), strict=True):
                self._beam(i, pair, *ends)
            self._mass(nodes[0], joint["motor"], joint["hub"])
            anchor = ground if pivot is None else pivot
            for axis in (0, 1):
                markers = [
                    system.AddMarker(MarkerNodeCoordinate(nodeNumber=node, coordinate=c))
                    for node, c in ((anchor, 0 if pivot is None else axis), (nodes[0], axis))
                ]
                system.AddObject(CoordinateConstraint(markerNumbers=markers))
            self._torque(nodes[0], i, 1.0)
            if pivot is not None:
                self._torque(pivot, i, -1.0)
            pivot, start = nodes[-1], start + LENGTH[i]
            self.sensors += [self._sensor(nodes[0]), self._sensor(nodes[-1])]
        self._mass(pivot, PAYLOAD["mass"], PAYLOAD["inertia"])

    def _mesh(self, i):
        places = [0.0]
        for low, high in pairwise(BREAKS[i]):
            places += list(np.linspace(low, high, self.elements + 1)[1:])
        return places

    def _beam(self, i, pair, low, high):
        points, weights = np.polynomial.legendre.leggauss(6)
        x = low + (high - low) * 0.5 * (points + 1.0)
        mass, stiffness = SECTIONS[i](x)
        self.system.AddObject(
            ObjectBeamGeometricallyExact2D(
                nodeNumbers=list(pair),
                length=high - low,
                massPerLength=0.5 * weights @ mass,
                crossSectionInertia=0.0,
                bendingStiffness=1.0 / (0.5 * weights @ (1.0 / stiffness)),
                axialStiffness=self.stiff,
                shearStiffness=self.stiff,
            )
        )

    def _mass(self, node, mass, inertia):
        matrix = np.diag([mass, mass, inertia])
        self.system.AddObject(ObjectGenericODE2(nodeNumbers=[node], massMatrix=matrix))

    def _torque(self, node, joint, sign):
        amplitude, frequency = TORQUE[joint]
        omega, sine = 2.0 * np.pi * frequency, exudyn.symbolic.sin

        def load(mbs, t, vector):
            return [0.0, 0.0, sign * amplitude * sine(omega * t)]

        self.functions.append(
            CreateSymbolicUserFunction(
                self.system, load, "loadVectorUserFunction", itemTypeName="LoadTorqueVector"
            )
        )
        marker = self.system.AddMarker(MarkerNodeRigid(nodeNumber=node))
        self.system.AddLoad(
            LoadTorqueVector(
                markerNumber=marker,
                loadVector=[0.0, 0.0, 1.0],
                loadVectorUserFunction=self.functions[-1],
            )
        )

    def _sensor(self, node):
        return self.system.AddSensor(
            SensorNode(
                nodeNumber=node,
                storeInternal=True,
                writeToFile=False,
                outputVariableType=exudyn.OutputVariableType.Coordinates,
            )
        )

    def run(self, step):
        """Columns of the table, by generalised-alpha without numerical damping in the limit of small steps."""
        options = exudyn.SimulationSettings()
        options.solution.file.write = False
        options.solution.sensors.writePeriod = PERIOD
        options.linearSolver.solverType = exudyn.LinearSolverType.EigenSparse
        integration = options.timeIntegration
        integration.verboseMode = 0
        integration.adaptiveStep = False
        integration.generalizedAlpha.spectralRadius = 0.8
        integration.newton.relativeTolerance = 1e-5
        integration.newton.absoluteTolerance = 1e-7
        integration.newton.useModifiedNewton = False
        integration.endTime = (SAMPLES - 1) * PERIOD
        integration.numberOfSteps = round(integration.endTime / step)
        if not self.system.SolveDynamic(options):
            raise RuntimeError("Exudyn's solver failed")
        base, elbow, second, tip = (self.system.GetSensorStoredData(s)[:, 1:] for s in self.sensors)
        return np.column_stack(
            [
                base[:, 2],
                second[:, 2],
                LENGTH[0] + elbow[:, 0],
                elbow[:, 1],
                sum(LENGTH) + tip[:, 0],
                tip[:, 1],
            ]
        )


def extrapolated(stiff, elements=5, step=1e-3):
    """Columns of the table for a stiffness against stretching and shear; errors of even orders are taken out."""
    coarse, fine, finest = (Simulation(k * elements, stiff).run(step) for k in (1, 2, 4))
    shorter, shortest = (Simulation(elements, stiff).run(step / k) for k in (2, 4))
    first = [b + (b - a) / 3.0 for a, b in ((coarse, fine), (fine, finest))]
    mesh = first[1] + (first[1] - first[0]) / 15.0
    second = [b + (b - a) / 3.0 for a, b in ((coarse, shorter), (shorter, shortest))]
    time = second[1] + (second[1] - second[0]) / 15.0 - coarse
    for name, moved in (
        ("mesh", finest - fine), ("mesh, extrapolated", first[1] - first[0]),
        ("step", shortest - shorter), ("step, extrapolated", second[1] - second[0]),
    ):  # fmt: skip
        print(f"{name}: {np.abs(moved).max(axis=0)}")
    return mesh + time


def main():
    """Write the table, and how far each extrapolation moves it: its error is a small part of that."""
    soft, stiff = extrapolated(1e6), extrapolated(2e6)
    print(f"stretching and shear: {np.abs(stiff - soft).max(axis=0)}")
    table = np.column_stack([np.arange(SAMPLES) * PERIOD, 2.0 * stiff - soft])
    path = Path(__file__).with_suffix(".csv")
    header = "t,theta1,alpha2,elbow_x,elbow_y,tip_x,tip_y"
    np.savetxt(path, table, "%.10g", ",", header=header, comments="")


if __name__ == "__main__":
    main()
