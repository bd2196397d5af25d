# SPDX-License-Identifier: Apache-2.0
"""The reference trajectories of `cases.MORE`, of fine models in other codes: ``python -m benchmarks.truth``.

Planar: Exudyn's cables, six elements a link, 0.5 ms. Spatial: MuJoCo's chains, eight hinges a link, 0.05 ms. Beside
each a second model of the same arm, and how far its tip is off.
"""

import numpy as np

from . import cases
from .peers import errors
from .peers.exudyn_cable import ExudynCable
from .peers.mujoco_chain import MujocoChain
from .peers.mujoco_tubes import MujocoTubes

_FINE = {"elements": 6, "step": 5e-4, "axial": 1e6, "modified_newton": False}
#: Of each case: the code of its reference with settings, and another.
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
    """Write the references, and print how far the other codes are off."""
    for case, codes in CODES.items():
        p = cases.parameters(case)
        columns, other = (code(case, p, **given).run(cases.DURATION)[1] for code, given in codes)
        table = np.column_stack(list(columns.values()))
        path = cases.OWN_DATA / f"{case}.csv"
        np.savetxt(path, table, "%.8f", ",", header=",".join(columns), comments="")
        print(f"{case}: {1e6 * errors(other, columns)['tip']:.1f} um between two models")


if __name__ == "__main__":
    main()
