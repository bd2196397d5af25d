# SPDX-License-Identifier: Apache-2.0
"""Writes solid_boom.csv and ../../config/arms/solid_boom.npz: a boom of solid finite elements, moved by Exudyn.

The boom is a tapered, bent bar of 8-node bricks, reduced to normal modes with its root held and to shapes under tip
forces (Craig & Bampton 1968). Exudyn moves this reduced body (`ObjectFFRFreducedOrder`) about an axis at its root,
under a torque, with a mass at its tip. There is no gravity, because Exudyn leaves out the moment of the weight on the
deflection. The archive has the shape integrals of the same modes. No flexarm in it.
Needs ``pip install exudyn==1.13.6 scipy``:

    python tests/data/solid_boom.py
"""

from pathlib import Path

import exudyn
import numpy as np
from exudyn.FEM import FEMinterface, ObjectFFRFreducedOrderInterface
from exudyn.itemInterface import (
    GenericJoint,
    LoadTorqueVector,
    MarkerBodyPosition,
    MarkerBodyRigid,
    MarkerNodeRigid,
    MarkerSuperElementPosition,
    MassPoint,
    NodePoint,
    ObjectGround,
    SensorNode,
    SphericalJoint,
)
from scipy.linalg import eigh
from scipy.sparse import coo_matrix, identity, kron
from scipy.sparse.linalg import eigsh, spsolve

LENGTH, DENSITY, YOUNG, POISSON = 1.0, 1200.0, 3.0e9, 0.3
ELEMENTS = (24, 2, 2)
NORMAL_MODES = 5
PAYLOAD = 0.2
#: Torque about the root's axis z: a sine [N m], [Hz].
TORQUE, FREQUENCY = 20.0, 1.5
SAMPLES, PERIOD = 151, 0.01


def mesh():
    """Nodes (P, 3) and elements (E, 8) of a bar that gets thinner, and is bent sideways towards its tip."""
    counts = [n + 1 for n in ELEMENTS]
    x, y, z = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in counts), indexing="ij")
    size = 0.04 - 0.02 * x
    nodes = np.stack([LENGTH * x, size * (y - 0.5), size * (z - 0.5) + 0.05 * x**2], axis=-1)
    number = np.arange(np.prod(counts)).reshape(counts)
    corners = [
        (0, 0, 0),
        (1, 0, 0),
        (1, 1, 0),
        (0, 1, 0),
        (0, 0, 1),
        (1, 0, 1),
        (1, 1, 1),
        (0, 1, 1),
    ]
    cells = [
        number[a : a + ELEMENTS[0], b : b + ELEMENTS[1], c : c + ELEMENTS[2]].ravel()
        for a, b, c in corners
    ]
    return nodes.reshape(-1, 3), np.stack(cells, axis=1)


def bricks(nodes, elements):
    """Stiffness (3P, 3P) and the mass matrix of one direction (P, P)."""
    lame = YOUNG * POISSON / ((1.0 + POISSON) * (1.0 - 2.0 * POISSON))
    shear = YOUNG / (2.0 * (1.0 + POISSON))
    D = np.diag([2.0 * shear] * 3 + [shear] * 3)
    D[:3, :3] += lame
    signs = np.array(
        [
            [-1, -1, -1],
            [1, -1, -1],
            [1, 1, -1],
            [-1, 1, -1],
            [-1, -1, 1],
            [1, -1, 1],
            [1, 1, 1],
            [-1, 1, 1],
        ]
    )
    gauss = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / np.sqrt(3.0)
    rows, columns, stiffness, masses = [], [], [], []
    for cell in elements:
        k, m = np.zeros((24, 24)), np.zeros((8, 8))
        for point in gauss:
            factors = 1.0 + signs * point
            shape = factors.prod(axis=1) / 8.0
            local = (
                np.stack(
                    [
                        signs[:, i] * factors[:, (i + 1) % 3] * factors[:, (i + 2) % 3]
                        for i in range(3)
                    ],
                    1,
                )
                / 8.0
            )
            J = local.T @ nodes[cell]
            slopes, volume = local @ np.linalg.inv(J).T, np.linalg.det(J)
            B = np.zeros((6, 24))
            for i in range(3):
                B[i, i::3] = slopes[:, i]
            for row, (i, j) in zip((3, 4, 5), ((0, 1), (1, 2), (2, 0)), strict=True):
                B[row, i::3], B[row, j::3] = slopes[:, j], slopes[:, i]
            k += volume * B.T @ D @ B
            m += volume * DENSITY * np.outer(shape, shape)
        dofs = (3 * cell[:, None] + np.arange(3)).ravel()
        (
            rows.append(np.repeat(dofs, 24)),
            columns.append(np.tile(dofs, 24)),
            stiffness.append(k.ravel()),
        )
        masses.append((np.repeat(cell, 8), np.tile(cell, 8), m.ravel()))
    size = len(nodes)
    K = coo_matrix(
        (np.concatenate(stiffness), (np.concatenate(rows), np.concatenate(columns))),
        (3 * size, 3 * size),
    )
    a, b, v = (np.concatenate(part) for part in zip(*masses, strict=True))
    return K.tocsc(), coo_matrix((v, (a, b)), (size, size)).tocsc()


def reduced(nodes, K, M, tip):
    """Shapes (3P, K) that hold the root: normal modes, and those under forces at the tip; orthonormal in the mass."""
    free = np.flatnonzero(np.repeat(nodes[:, 0] > 1e-9, 3))
    whole = kron(M, identity(3)).tocsc()
    K, mass = K[free][:, free], whole[free][:, free]
    _, normal = eigsh(K, NORMAL_MODES, mass, sigma=0.0)
    forces = np.zeros((len(nodes), 3, 3))
    forces[tip] = np.eye(3) / len(tip)
    static = spsolve(K, forces.reshape(-1, 3)[free])
    basis = np.column_stack([normal, static])
    values, mix = eigh(basis.T @ (K @ basis), basis.T @ (mass @ basis))
    shapes = np.zeros((3 * len(nodes), basis.shape[1]))
    shapes[free] = basis @ mix
    return values, shapes, whole


def frequencies(nodes, K, whole, tip, payload):
    """The lowest of the whole mesh with its root held and a mass at its tip [Hz]."""
    free = np.flatnonzero(np.repeat(nodes[:, 0] > 1e-9, 3))
    end = np.zeros((3 * len(nodes), 3))
    for axis in range(3):
        end[3 * tip + axis, axis] = 1.0 / len(tip)
    mass = (whole + payload * coo_matrix(end @ end.T)).tocsc()
    squares = eigsh(K[free][:, free], 4, mass[free][:, free], sigma=0.0, return_eigenvectors=False)
    return np.sqrt(np.sort(squares)) / (2.0 * np.pi)


def archive(nodes, M, values, shapes, tip):
    """The archive's arrays: integrals over the mesh with its own mass matrix."""
    Phi = shapes.reshape(len(nodes), 3, -1)
    moment = nodes.T @ (M @ nodes)
    first = np.einsum("pa,pbk->kab", nodes, np.stack([M @ Phi[:, b] for b in range(3)], 1))
    second = np.einsum("paj,pbk->jkab", Phi, np.stack([M @ Phi[:, b] for b in range(3)], 1))
    translation = np.einsum("p,pak->ka", np.asarray(M.sum(axis=0)).ravel(), Phi)
    rotation = np.stack([first[:, i, j] - first[:, j, i] for i, j in ((1, 2), (2, 0), (0, 1))], 1)
    stations = np.unique(nodes[:, 0])[1:]
    places = [_section(nodes, Phi, x) for x in stations]
    end = _section(nodes, Phi, LENGTH)
    # On top and on one side, an eighth and half of the way out.
    points = {
        f"{where}_{side}": int(np.argmin(np.linalg.norm(nodes - _surface(x, side), axis=1)))
        for where, x in (("root", 0.125), ("middle", 0.5))
        for side in "yz"
    }
    return {
        "mass": M.sum(), "first_moment": np.asarray(M.sum(axis=0)).ravel() @ nodes,
        "inertia": np.trace(moment) * np.eye(3) - moment,
        "modal_mass": np.eye(len(values)), "modal_stiffness": np.diag(values),
        "translation": translation, "rotation": rotation, "first": first, "second": second,
        "tip": nodes[tip].mean(axis=0), "tip_translation": end[0], "tip_rotation": end[1],
        "stations": stations, "station_translation": np.stack([p[0] for p in places]),
        "station_rotation": np.stack([p[1] for p in places]),
        "strain_names": np.array(list(points)),
        "strain": np.stack([_strain(nodes, Phi, node) for node in points.values()]),
    }  # fmt: skip


def _section(nodes, Phi, x):
    """Mean translation of a section's nodes, and the rotation vector that fits them best; (K, 3) each."""
    here = np.abs(nodes[:, 0] - x) < 1e-9
    r = nodes[here] - nodes[here].mean(axis=0)
    mean = Phi[here].mean(axis=0)
    # Sum over nodes of r x (u - mean) = (r.r 1 - r r') theta.
    inertia = sum((v @ v) * np.eye(3) - np.outer(v, v) for v in r)
    turned = sum(np.cross(v, (u - mean).T) for v, u in zip(r, Phi[here], strict=True))
    return mean.T, np.linalg.solve(inertia, turned.T).T


def _surface(x, side):
    """The middle of the bar's surface at x."""
    half, bent = 0.5 * (0.04 - 0.02 * x), 0.05 * x**2
    return np.array([x, half, bent] if side == "y" else [x, 0.0, bent + half])


def _strain(nodes, Phi, node):
    """Strain along x at a node of the surface, from its neighbours along the bar."""
    line = np.flatnonzero(
        np.abs(np.abs(nodes[:, 0] - nodes[node, 0]) - LENGTH / ELEMENTS[0]) < 1e-9
    )
    line = sorted(line, key=lambda i: np.linalg.norm(nodes[i] - nodes[node]))[:2]
    along = nodes[line[1]] - nodes[line[0]]
    return along @ (Phi[line[1]] - Phi[line[0]]) / (along @ along)


def simulate(nodes, elements, K, whole, values, shapes, tip, step):
    """Angle, and the tip's place, by Exudyn: the floating frame is the root's, which the shapes hold."""
    container = exudyn.SystemContainer()
    system = container.AddSystem()
    fem = FEMinterface()
    fem.nodes = {"Position": nodes}
    fem.elements = [{"Name": "boom", "Hex8": elements}]
    fem.massMatrix, fem.stiffnessMatrix = whole.tocsr(), K.tocsr()
    fem.modeBasis = {"matrix": shapes, "type": "NormalModes"}
    fem.eigenValues = values
    interface = ObjectFFRFreducedOrderInterface(fem)
    made = interface.AddObjectFFRFreducedOrder(
        system, positionRef=[0, 0, 0], initialVelocity=[0, 0, 0], rotationMatrixRef=np.eye(3),
        initialAngularVelocity=[0, 0, 0],
    )  # fmt: skip
    ground = system.AddMarker(MarkerBodyRigid(bodyNumber=system.AddObject(ObjectGround())))
    frame = system.AddMarker(MarkerNodeRigid(nodeNumber=made["nRigidBody"]))
    system.AddObject(
        GenericJoint(markerNumbers=[ground, frame], constrainedAxes=[1, 1, 1, 1, 1, 0])
    )

    def torque(mbs, t, load):
        return [0.0, 0.0, TORQUE * np.sin(2.0 * np.pi * FREQUENCY * t)]

    system.AddLoad(
        LoadTorqueVector(markerNumber=frame, loadVector=[0, 0, 1], loadVectorUserFunction=torque)
    )
    place = nodes[tip].mean(axis=0)
    point = system.AddNode(NodePoint(referenceCoordinates=place.tolist()))
    mass = system.AddObject(MassPoint(nodeNumber=point, mass=PAYLOAD))
    end = system.AddMarker(
        MarkerSuperElementPosition(
            bodyNumber=made["oFFRFreducedOrder"],
            meshNodeNumbers=tip.tolist(),
            weightingFactors=[1.0 / len(tip)] * len(tip),
        )
    )
    own = system.AddMarker(MarkerBodyPosition(bodyNumber=mass))
    system.AddObject(SphericalJoint(markerNumbers=[end, own]))
    kinds = exudyn.OutputVariableType
    sensors = [
        system.AddSensor(
            SensorNode(
                nodeNumber=made["nRigidBody"],
                storeInternal=True,
                writeToFile=False,
                outputVariableType=kinds.RotationMatrix,
            )
        ),
        system.AddSensor(
            SensorNode(
                nodeNumber=point,
                storeInternal=True,
                writeToFile=False,
                outputVariableType=kinds.Position,
            )
        ),
    ]
    system.Assemble()
    options = exudyn.SimulationSettings()
    options.solution.file.write = False
    options.solution.sensors.writePeriod = PERIOD
    integration = options.timeIntegration
    integration.verboseMode = 0
    integration.adaptiveStep = False
    integration.generalizedAlpha.spectralRadius = 0.9
    integration.newton.relativeTolerance, integration.newton.absoluteTolerance = (
        1e-7,
        1e-9,
    )
    integration.endTime = (SAMPLES - 1) * PERIOD
    integration.numberOfSteps = round(integration.endTime / step)
    if not system.SolveDynamic(options):
        raise RuntimeError("Exudyn's solver failed")
    R, position = (system.GetSensorStoredData(s)[:, 1:] for s in sensors)
    return np.column_stack([np.arctan2(R[:, 3], R[:, 0]), position])


def main():
    """Write archive and table; print the frequencies and how far half a step moves the table."""
    nodes, elements = mesh()
    K, M = bricks(nodes, elements)
    tip = np.flatnonzero(nodes[:, 0] > LENGTH - 1e-9)
    values, shapes, whole = reduced(nodes, K, M, tip)
    arrays = archive(nodes, M, values, shapes, tip)
    here = Path(__file__).resolve().parent
    target = here.parents[1] / "config" / "arms"
    np.savez(
        target / "solid_boom.npz" if target.is_dir() else here / "solid_boom.npz",
        **arrays,
    )
    for payload in (0.0, PAYLOAD):
        print(f"{payload} kg at the tip: {frequencies(nodes, K, whole, tip, payload)} Hz")
    body = nodes, elements, K, whole, values, shapes, tip
    runs = [simulate(*body, step) for step in (1e-4, 5e-5, 2.5e-5)]
    for run in runs:
        run[:, 0] = np.unwrap(run[:, 0])
    first = [b + (b - a) / 3.0 for a, b in ((runs[0], runs[1]), (runs[1], runs[2]))]
    best = first[1] + (first[1] - first[0]) / 15.0
    print("half a step", np.abs(runs[2] - runs[1]).max(axis=0))
    print("extrapolated", np.abs(first[1] - first[0]).max(axis=0))
    table = np.column_stack([np.arange(SAMPLES) * PERIOD, best])
    np.savetxt(
        here / "solid_boom.csv",
        table,
        "%.10g",
        ",",
        header="t,theta,tip_x,tip_y,tip_z",
        comments="",
    )


if __name__ == "__main__":
    main()
