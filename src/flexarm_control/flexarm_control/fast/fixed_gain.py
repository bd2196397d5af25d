# SPDX-License-Identifier: Apache-2.0
r"""Fast control with a given gain: u_fast = K_f z_f with K_f from a parameter, and a low-pass filter.

The gain comes from `flexarm design` or from a method of your own. There may be several sets of gains, each designed for
its own configuration (`flexarm_control.schedule`).
"""

import numpy as np

from flexarm_dynamics.parameters import parameter

from ..low_pass import BANDWIDTH, LowPass
from ..schedule import SCHEDULE, Schedule
from .base import FastLaw
from .lqr import CONFIGURATION


class FixedGain(FastLaw):
    """Feedback of amplitudes and rates by given gains; see the module."""

    PARAMETERS = (
        parameter("gain", [0.0], "N m/m, N m s/m", -1e12, 1e12, length="gain*").described(
            "K_f of fixed_gain, row by row: for each joint the gains of the modal amplitudes, then of the modal rates;"
            " one set for each configuration of the schedule, or one for all."
        ),
        SCHEDULE,
        CONFIGURATION,
        BANDWIDTH,
    )

    def __init__(self, model, parameters):
        super().__init__(model, parameters)
        shape = model.n_joints, 2 * model.n_modes
        self._schedule = Schedule(model, self.parameters["schedule"], "fast.schedule")
        self._sets = self._schedule.sets(self.parameters["gain"], shape[0] * shape[1], "fast.gain")
        self._now = np.zeros(shape)
        self.K_f = self.gain(self.configuration).copy()
        self._low_pass = LowPass(model.n_joints, self.parameters["bandwidth"])

    def reset(self):
        self._low_pass.reset()

    def resume(self, other):
        if isinstance(other, FixedGain):
            self._low_pass.resume(other._low_pass)

    def advance(self, dt):
        self._low_pass.advance(dt)

    def torque(self, z_f, q):
        return self._low_pass(self.gain(q) @ z_f)

    def gain(self, q):
        self._schedule.blend(q, self._sets, self._now.reshape(-1))
        return self._now

    def state_space(self, dt):
        if not self.parameters["bandwidth"]:
            return None
        A, B, C, D = self._low_pass.state_space(dt)
        return A, B @ self.K_f, C, D @ self.K_f
