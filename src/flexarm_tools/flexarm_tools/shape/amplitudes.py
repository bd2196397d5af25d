# SPDX-License-Identifier: Apache-2.0
"""Gives all modal amplitudes of an arm, from states that contain the observed ones."""

import numpy as np

from flexarm_ros.messages import StateReader


class Amplitudes:
    """All modal amplitudes of an `arm`, from states that contain the observed ones."""

    def __init__(self, arm):
        self.reader = StateReader(arm)
        names = arm.mode_names
        self._places = np.array([names.index(n) for n in arm.observed_modes], int)
        self.values = np.zeros(len(names))

    def read(self, msg, sample):
        """Fill a `sample`; return the amplitudes (m,) [m, rad], zero where the state has none."""
        self.reader.read(msg, sample)
        self.values[:] = 0.0
        if sample.amplitude is not None:
            self.values[self._places] = sample.amplitude
        return self.values
