# SPDX-License-Identifier: Apache-2.0
"""How far the tip is off where bending stiffens: ``python -m benchmarks.accuracy``.

Planar arms are simulated with the default options, and at the first order, and compared with Exudyn's cables. The
cables stretch a little, in inverse proportion to their axial stiffness. Two of them are extrapolated to a cable that
does not stretch, which is the reference. The distance of the stiffer cable from it shows the uncertainty of the
reference.
"""

from dataclasses import dataclass, replace

import exudyn
import numpy as np
from exudyn.itemInterface import (
    LoadForceVector,
    LoadMassProportional,
    LoadTorqueVector,
    MarkerBodyMass,
    MarkerNodePosition,
    MarkerNodeRigid,
)
from exudyn.utilities import CreateSymbolicUserFunction

from flexarm_dynamics.models import levels, model
from flexarm_sim.batch import Arms
from flexarm_sim.integrators import substeps
from flexarm_studies import markdown

from . import cases
from .peers import Torque
from .peers.exudyn_cable import ExudynCable

GRAVITY, MODES, INTERVAL = 9.81, (3, 4), 1e-3
#: Settings of the cables; their axial stiffness [N], the larger one first.
FINE, AXIAL = {"elements": 12, "step": 1e-4, "rtol": 1e-6, "atol": 1e-5}, (1e8, 3e7)
_TWO = {"L": 1.0, "rhoA": 0.2, "EI": 8.0, "Jh1": 0.05, "Jh2": 0.05, "Mm": 0.5, "Mp": 0.2, "Jp": 0.0}
_THREE = cases.MORE["three_link_torque"]
_ONE = {"L": 1.0, "rhoA": 0.2, "EI": 8.0, "Jh": 0.05, "Mp": 0.05, "Jp": 0.0}


@dataclass(frozen=True)
class Case:
    """An arm, and the law of each joint's torque: (amplitude, angular frequency), (height, edges) or (height, time)."""

    name: str
    parameters: dict
    kind: str
    laws: tuple
    duration: float
    gravity: float = 0.0


CASES = (
    Case("three links, smooth torques", _THREE, "sine", tuple(Torque("three_link_torque", _THREE).sines), 4.0),
    Case("two links with payload, pulses", _TWO, "pulse", ((1.0, (0.4, 0.8)), (0.3, (0.4, 0.8))), 3.0),
    Case("two links that fall", _TWO, "sine", ((0.0, 1.0), (0.0, 1.0)), 2.0, GRAVITY),
    # It reaches 47 rad/s; the first natural frequency with the joint locked is 15.7 rad/s.
    Case("one link, spun up to three times its first frequency", _ONE, "spin", ((3.916, 4.0),), 4.0),
)  # fmt: skip


def value(kind, law, t, before=False):
    """Torque of a law at time `t` [N m]; at the edge of a pulse, the torque `before` or after the edge."""
    if kind == "sine":
        return law[0] * np.sin(law[1] * t)
    if kind == "spin":
        return law[0] * np.sin(np.pi * t / law[1]) ** 2 if t < law[1] else 0.0
    up, down = law[1]
    t += -1e-9 if before else 1e-9
    return law[0] * (1.0 if t < up else -1.0 if t < down else 0.0)


class Cable(ExudynCable):
    """Exudyn's cables with a `Case`'s torques and its gravity."""

    def __init__(self, case, **settings):
        self.given, self.heavy = case, []
        given = case.parameters | {f"tau{i + 1}": "0*sin(2*pi*1*t)" for i in range(len(case.laws))}
        super().__init__(case.name, given, modified_newton=False, **settings)

    def _mass(self, node, mass, inertia):
        super()._mass(node, mass, inertia)
        if mass and self.given.gravity:
            marker = self.system.AddMarker(MarkerNodePosition(nodeNumber=node))
            load = [0.0, -mass * self.given.gravity, 0.0]
            self.system.AddLoad(LoadForceVector(markerNumber=marker, loadVector=load))

    def _build(self):
        super()._build()
        for number in range(self.system.systemData.NumberOfObjects()):
            if self.given.gravity and "ANCFCable2D" in self.system.GetObject(number)["objectType"]:
                marker = self.system.AddMarker(MarkerBodyMass(bodyNumber=number))
                pull = [0.0, -self.given.gravity, 0.0]
                self.system.AddLoad(LoadMassProportional(markerNumber=marker, loadVector=pull))

    def _torque(self, node, joint, sign):
        kind, law = self.given.kind, self.given.laws[joint]
        symbolic, near, real = exudyn.symbolic, 0.25 * self.step, exudyn.symbolic.Real

        def torque(mbs, t, load):
            if kind == "sine":
                return [0.0, 0.0, sign * law[0] * symbolic.sin(law[1] * t)]
            if kind == "spin":
                wave = symbolic.sin(np.pi / law[1] * t)
                return [
                    0.0,
                    0.0,
                    symbolic.IfThenElse(t < law[1], sign * law[0] * wave * wave, real(0.0)),
                ]
            height, (up, down) = sign * law[0], law[1]
            out = real(0.0)
            for edge, left, mean in ((down, -height, -0.5 * height), (up, height, 0.0)):
                out = symbolic.IfThenElse(t < edge + near, real(mean), out)
                out = symbolic.IfThenElse(t < edge - near, real(left), out)
            return [0.0, 0.0, out]

        function = CreateSymbolicUserFunction(
            self.system, torque, "loadVectorUserFunction", itemTypeName="LoadTorqueVector"
        )
        self.functions.append(function)
        marker = self.system.AddMarker(MarkerNodeRigid(nodeNumber=node))
        self.system.AddLoad(
            LoadTorqueVector(
                markerNumber=marker, loadVector=[0.0, 0.0, 1.0], loadVectorUserFunction=function
            )
        )

    def tip(self):
        """Path of the tip, (k, 2) [m]."""
        columns = self.run(self.given.duration)[1]
        return np.column_stack([columns["tip_x"], columns["tip_y"]])


def inextensible(case):
    """Path of the tip, extrapolated to cables that do not stretch, and the path with the stiffer cables [m]."""
    stiff, soft = (Cable(case, axial=axial, **FINE).tip() for axial in AXIAL)
    return stiff + (stiff - soft) * AXIAL[1] / (AXIAL[0] - AXIAL[1]), stiff


def own(case, modes, level=None):
    """Path of flexarm's tip (k, 2) [m], and the model level that was used."""
    arm = cases.chain(case.parameters, modes=modes).arm
    arm = replace(arm, gravity=(0.0, -case.gravity, 0.0))
    arm = levels.simulated(arm) if level is None else levels.at_level(arm, level)
    chain, count = model.build(arm), round(case.duration / INTERVAL)
    split, size = substeps(chain, INTERVAL), chain.n_joints + chain.n_modes
    arms = Arms(chain, np.zeros((1, 2 * size)), INTERVAL / split, split, "dop853")
    t = INTERVAL * np.arange(count)
    starts, ends = (
        np.array([[value(case.kind, law, s, before) for law in case.laws] for s in times])[None]
        for times, before in ((t, False), (t + INTERVAL, True))
    )
    states = arms.follow(starts, ends)[0]
    rows, n = states[:: round(0.01 / INTERVAL)], chain.n_joints
    tips = [chain.frames(s[:n], s[n:size])[1][-1][:2] for s in rows]
    return np.array(tips), levels.level_of(arm)


def off(path, reference):
    """Largest distance between two paths [µm], as text."""
    with np.errstate(over="ignore", invalid="ignore"):
        far = np.linalg.norm(path - reference, axis=1).max()
    return f"{1e6 * far:.3g}" if far < 1.0 else "diverges"


def main():
    """Print the table."""
    rows = []
    for case in CASES:
        reference, stiff = inextensible(case)
        paths, found = zip(*(own(case, modes) for modes in MODES), strict=True)
        first = own(case, MODES[0], levels.FIRST_ORDER)[0]
        offs = [off(path, reference) for path in (*paths, first, stiff)]
        rows.append((case.name, found[0], *offs))
    with_modes = (f"{modes} modes a link: tip off [µm]" for modes in MODES)
    head = ("case", "level without options", *with_modes, "at first order", "the stiffer cables")
    print("\n".join(markdown.table(head, rows)))


if __name__ == "__main__":
    main()
