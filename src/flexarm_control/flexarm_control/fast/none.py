# SPDX-License-Identifier: Apache-2.0
"""No fast control: the slow control alone."""

import numpy as np

from .base import FastLaw


class NoFastLaw(FastLaw):
    """u_fast = 0."""

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        self._zero = np.zeros(model.n_joints)

    def torque(self, z_f, q):
        return self._zero

    @property
    def K_f(self):
        """Zeros, shape (n, 2m)."""
        return np.zeros((self.model.n_joints, 2 * self.model.n_modes))
