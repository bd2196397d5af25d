# SPDX-License-Identifier: Apache-2.0
"""The reference trajectories of `cases.MORE`, of fine models in other codes: ``python -m benchmarks.truth``.

Planar: Exudyn's cables with six elements per link, step 0.5 ms. Spatial: MuJoCo's chains with eight hinges per link,
step 0.05 ms. For each, a second model of the same arm is simulated, and the distance of its tip is printed.
"""

import numpy as np

from . import cases
from .peers import errors
from .peers.exudyn_cable import ExudynCable
from .peers.mujoco_chain import MujocoChain
from .peers.mujoco_tubes import MujocoTubes

_FINE = {"elements": 6, "step": 5e-4, "axial": 1e6, "modified_newton": False}
#: For each case: the code of the reference with its settings, and the code that is compared with it.
CODES = {
    "three_link_torque": (
        (ExudynCable, _FINE),
        (MujocoChain, {"segments": 8, "step": 1e-4}),
    ),
    "spatial_torque": (
        (MujocoTubes, {"segments": 8, "step": 5e-5}),
        (MujocoTubes, {"segments": 6, "step": 2e-4}),
    ),
}


def main():
    """Write the references, and print the errors of the other codes."""
    for case, codes in CODES.items():
        p = cases.parameters(case)
        columns, other = (code(case, p, **given).run(cases.DURATION)[1] for code, given in codes)
        table = np.column_stack(list(columns.values()))
        path = cases.OWN_DATA / f"{case}.csv"
        np.savetxt(path, table, "%.8f", ",", header=",".join(columns), comments="")
        print(f"{case}: {1e6 * errors(other, columns)['tip']:.1f} um between two models")


if __name__ == "__main__":
    main()
