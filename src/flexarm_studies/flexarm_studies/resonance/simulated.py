# SPDX-License-Identifier: Apache-2.0
"""Simulates an arm behind a position loop for measurements: trajectory in; joints, strains, tip acceleration out."""

import numpy as np

from flexarm_dynamics.parameters import check_all
from flexarm_sim.position_loop import PARAMETERS, PositionLoop
from flexarm_sim.simulator import PARAMETERS as SIMULATOR
from flexarm_sim.simulator import Simulator

from ..recordings.streams import Stream, of_joints
from .motion import Arm

#: Samples of the drives per second, and of the commands and joint states [Hz].
DRIVE_RATE, COMMAND_RATE = 1000.0, 125.0


class SimulatedArm(Arm):
    """An arm of an arm file, with the noise of its sensors.

    Parameters
    ----------
    arm : Arm or str
        Arm, or arm file.
    position : ndarray, shape (n,), optional
        Position in which it stands, at rest under its weight [rad].
    **settings
        Settings of the position loop, see `flexarm_sim.position_loop.PARAMETERS`.

    Raises
    ------
    FlexarmError
        If there is no such arm, or its position loop is unstable.
    """

    def __init__(self, arm, position=None, **settings):
        given = {"arm": arm, "rate": DRIVE_RATE, "seed": 1}
        self._simulator = Simulator(check_all(SIMULATOR, given))
        n = self._simulator.nominal.n_joints
        self.joint_names = tuple(self._simulator.arm.joint_names)
        given = {"command_rate": COMMAND_RATE, **settings}
        self._loop = PositionLoop(
            self._simulator.nominal, 1.0 / DRIVE_RATE, check_all(PARAMETERS, given, {"joints": n})
        )
        start = np.zeros(n) if position is None else np.asarray(position, float)
        self._simulator.reset(start)
        self._loop.begin(start)
        self._motion, self._rows = None, []
        self.stopped = False

    def sample(self, patience):
        """As in `Arm`; never None, because this arm always sends states."""
        simulator, loop = self._simulator, self._loop
        tips = []
        for k in range(round(DRIVE_RATE / COMMAND_RATE)):
            if k == 0 and self._motion is not None:
                self._command()
            simulator.advance_with(loop.drive)
            plant = simulator.plant
            tips.append(np.array(plant.model.tip_position(plant.q, plant.delta)))
        self._rows.append(
            (simulator.time, simulator.position.copy(), simulator.strain.copy(), np.array(tips))
        )
        return simulator.time, simulator.position.copy(), None

    def _command(self):
        motion, start, begin = self._motion
        time = np.array([self._simulator.time - begin + 1.0 / COMMAND_RATE])
        self._loop.command(self._simulator.time, start + motion.derivative(0, time)[0])

    def move(self, motion, start):
        """As in `Arm`; the motion begins with the next command."""
        self.begin = self._simulator.time
        self._motion = motion, np.asarray(start, float), self.begin

    def stop(self):
        """As in `Arm`; the arm then holds its position."""
        self._motion, self.stopped = None, True
        self._loop.command(self._simulator.time, self._simulator.position)

    def streams(self):
        """As in `Arm`: joint states, strains, acceleration of the tip."""
        time, position, strain, tips = (np.array(part) for part in zip(*self._rows, strict=True))
        found = [of_joints("joint_states", time, self.joint_names, position=position)]
        gauges = self._simulator.arm.gauge_names
        if gauges:
            found.append(Stream("arm_state", time, {"strain": strain}, {"gauge": tuple(gauges)}))
        way = tips.reshape(-1, 3)
        acceleration = np.gradient(
            np.gradient(way, 1.0 / DRIVE_RATE, axis=0), 1.0 / DRIVE_RATE, axis=0
        )
        every = tips.shape[1]
        found.append(
            Stream(
                "tip", time, {"linear_acceleration": acceleration[every - 1 :: every]},
                {"imu": ("tip_x", "tip_y", "tip_z")},
            )
        )  # fmt: skip
        return found
