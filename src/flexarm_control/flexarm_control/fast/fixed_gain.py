# SPDX-License-Identifier: Apache-2.0
r"""Fast control with a gain that is given: u_fast = K_f z_f with the numbers of the parameter.

The gain is the design's result itself: that of `flexarm design`, or of a method of your own.
"""

import numpy as np

from flexarm_dynamics.parameters import parameter

from .base import FastLaw
from .lqr import CONFIGURATION


class FixedGain(FastLaw):
    """Constant feedback of amplitudes and rates; see the module."""

    PARAMETERS = (
        parameter("gain", [0.0], "N m/m, N m s/m", -1e12, 1e12, length="gain").described(
            "K_f of fixed_gain, row by row: for each joint the modal amplitudes, then the modal rates."
        ),
        CONFIGURATION,
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.K_f = np.array(self.parameters["gain"]).reshape(model.n_joints, 2 * model.n_modes)
