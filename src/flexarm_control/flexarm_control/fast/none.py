# SPDX-License-Identifier: Apache-2.0
"""No fast control: the slow control alone."""

import numpy as np

from .base import FastLaw


class NoFastLaw(FastLaw):
    """u_fast = 0."""

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self._zero = np.zeros(model.n_joints)
        self.K_f = np.zeros((model.n_joints, 2 * model.n_modes))

    def torque(self, z_f, q):
        return self._zero
