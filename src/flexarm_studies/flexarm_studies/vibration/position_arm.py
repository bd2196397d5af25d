# SPDX-License-Identifier: Apache-2.0
"""Simulates an arm behind a position loop, commanded as by a joint_trajectory_controller, and how its tip swings."""

from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import check_all
from flexarm_sim.plant import Plant
from flexarm_sim.position_loop import PARAMETERS, PositionLoop

#: Rate of the drives, rate of the commands, and delay of the commands [Hz], [Hz], [s].
DRIVE_RATE, COMMAND_RATE, DELAY = 1000.0, 125.0, 0.008
#: Bandwidth of the drives: this many times the lowest mode with joints locked [-], within these limits [rad/s].
TIMES, BANDWIDTH = 4.0, (20.0, 125.0)
#: Factor by which an unstable loop is made slower, and max. number of times.
SLOWER, ATTEMPTS = 0.7, 20
#: If an explicit method would need more substeps per sample of the drives than this, because of the drives' gains, the
#: plant is integrated implicitly. A light joint behind a flexible link needs thousands.
MAX_SUBSTEPS = 1000
#: The tip is evaluated at every second sample.
TIP_EVERY = 2


@dataclass(frozen=True, eq=False)
class Swing:
    """Result of a motion.

    Attributes
    ----------
    time : (k,) ndarray
        From the motion's start [s].
    tip : (k, 3) ndarray
        [m]
    end : float
        Time at which the last command acts [s].
    saturated : bool
        Whether a drive was at its torque limit.
    """

    time: np.ndarray
    tip: np.ndarray
    end: float
    saturated: bool

    def residual(self, window):
        """Amplitude of the tip in a `window` [s] after the end: norm of half of its range along each axis [m]."""
        after = self.tip[(self.time >= self.end) & (self.time <= self.end + window)]
        return float(np.linalg.norm(0.5 * np.ptp(after, axis=0)))

    def ringing(self, settle=0.0):
        """The tip from a time `settle` [s] after the end on, about its mean (k, 3) [m]."""
        after = self.tip[self.time >= self.end + settle]
        return after - after.mean(axis=0)


class PositionArm:
    """An arm whose drives hold the commanded positions.

    Parameters
    ----------
    known : ArmModel
        The arm as the drives know it.
    plant : ArmModel
        The arm as it is.
    lowest : float
        Lowest natural frequency with joints locked [rad/s].
    """

    def __init__(self, known, plant, lowest):
        self.plant = Plant(plant, 1.0 / DRIVE_RATE)
        bandwidth = float(np.clip(TIMES * lowest, *BANDWIDTH))
        for _ in range(ATTEMPTS):
            settings = {
                "bandwidth": bandwidth,
                "command_rate": COMMAND_RATE,
                "command_delay": DELAY,
            }
            try:
                self.loop = PositionLoop(
                    known,
                    1.0 / DRIVE_RATE,
                    check_all(PARAMETERS, settings, {"joints": known.n_joints}),
                )
                break
            except DesignError:
                bandwidth *= SLOWER
        else:
            raise DesignError("no stable position loop", field=plant.arm.name)
        self.bandwidth = bandwidth
        if self.plant.damped_substeps(self.loop.kd) > MAX_SUBSTEPS:
            self.plant = Plant(plant, 1.0 / DRIVE_RATE, "implicit")

    def follow(self, motion, after) -> Swing:
        """Follow a motion from rest, and hold.

        Parameters
        ----------
        motion : object
            Its `position` maps times (k,) [s] to (k, n) [rad]; it has a `duration` [s].
        after : float
            Time for which the tip is evaluated afterwards [s].
        """
        plant, loop, model = self.plant, self.loop, self.plant.model
        every = round(DRIVE_RATE / COMMAND_RATE)
        count = int((motion.duration + DELAY + after) * COMMAND_RATE) + 1
        commands = motion.position(np.arange(count + 1) / COMMAND_RATE)
        plant.reset(commands[0])
        loop.begin(commands[0])
        tip, saturated = [], False
        for k in range(count * every):
            t = k / DRIVE_RATE
            if k % every == 0:
                loop.command(t, commands[k // every + 1])
            loop.drive(plant, t)
            saturated = saturated or bool(loop.saturated.any())
            if k % TIP_EVERY == TIP_EVERY - 1:
                tip.append(np.array(model.tip_position(plant.q, plant.delta)))
        time = np.arange(1, len(tip) + 1) * TIP_EVERY / DRIVE_RATE
        return Swing(time, np.array(tip), motion.duration + DELAY, saturated)
