# SPDX-License-Identifier: Apache-2.0
"""No slow control: the fast control alone holds the deflections; the joint drifts."""

import numpy as np

from .base import SlowLaw


class NoSlowLaw(SlowLaw):
    """u_slow = 0."""

    drifts = True

    def torque(self, q, qd, reference, terms):
        return np.zeros(self.model.n_joints)

    def nominal(self, terms, acceleration):
        return np.zeros(self.model.n_joints)
