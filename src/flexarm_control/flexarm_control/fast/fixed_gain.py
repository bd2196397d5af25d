# SPDX-License-Identifier: Apache-2.0
r"""Fast control with a gain that is given: u_fast = K_f z_f with the numbers of the parameter, and a low pass.

The gain is the design's result itself: that of `flexarm design`, or of a method of your own.
"""

import numpy as np

from flexarm_dynamics.parameters import parameter

from ..low_pass import BANDWIDTH, LowPass
from .base import FastLaw
from .lqr import CONFIGURATION


class FixedGain(FastLaw):
    """Constant feedback of amplitudes and rates; see the module."""

    PARAMETERS = (
        parameter("gain", [0.0], "N m/m, N m s/m", -1e12, 1e12, length="gain").described(
            "K_f of fixed_gain, row by row: for each joint the modal amplitudes, then the modal rates."
        ),
        CONFIGURATION,
        BANDWIDTH,
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self.K_f = np.array(self.parameters["gain"]).reshape(model.n_joints, 2 * model.n_modes)
        self._low_pass = LowPass(model.n_joints, self.parameters["bandwidth"])

    def reset(self):
        self._low_pass.reset()

    def resume(self, other):
        if isinstance(other, FixedGain):
            self._low_pass.resume(other._low_pass)

    def advance(self, dt):
        self._low_pass.advance(dt)

    def torque(self, z_f, q):
        return self._low_pass(self.K_f @ z_f)

    def state_space(self, dt):
        if not self.parameters["bandwidth"]:
            return None
        A, B, C, D = self._low_pass.state_space(dt)
        return A, B @ self.K_f, C, D @ self.K_f
