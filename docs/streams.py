# SPDX-License-Identifier: Apache-2.0
"""Prints the table of docs/trajectories.md on streams: a circle of the tip, sent point by point at 50 Hz.

Run `python docs/streams.py`. The arm under control is simulated with a payload and a stiffness that its controller does
not know. Each message has one point, 20 ms ahead.
"""

import sys

import numpy as np

from flexarm_control.trajectory import validate
from flexarm_dynamics.models.inverse_kinematics import TipKinematics
from flexarm_studies.loop.arm import SimulatedArm

PERIOD_NS = 20_000_000  # of the stream [ns]
RISE = 2.0  # [s] in which the circle is begun, and ended


class Circle:
    """Joints that lead the straight arm's tip along a circle, at any time.

    Parameters
    ----------
    model : ArmModel
        Planar.
    start : (n,) array_like
        Where the circle begins and ends [rad].
    radius : float
        [m]
    turn : float
        Time of a turn at speed [s].
    seconds : float
        From start to end [s].
    """

    def __init__(self, model, start, radius, turn, seconds):
        self._kinematics = TipKinematics(model, bent=False)
        self._first, self._q = self._kinematics.tip(np.array(start)), np.array(start, float)
        self._radius, self._turn, self._seconds = radius, turn, seconds

    def _angle(self, time):
        """How far it has turned [rad]: its speed rises, and falls, within `RISE`."""

        def risen(t):
            x = np.clip(t / RISE, 0.0, 1.0)
            return RISE * (x**3 - 0.5 * x**4) + max(t - RISE, 0.0)

        end = self._seconds - RISE
        return 2.0 * np.pi / self._turn * (risen(time) - risen(max(time - end, 0.0)))

    def position(self, time):
        """Joints (n,) [rad]."""
        angle = self._angle(time)
        tip = self._first + self._radius * np.array([np.cos(angle) - 1.0, np.sin(angle), 0.0])
        self._q = self._kinematics.search(tip, self._q).q
        return self._q

    def velocity(self, time, step=1e-4):
        """Their speeds (n,) [rad/s]."""
        after, before = self.position(time + step).copy(), self.position(time - step).copy()
        return (after - before) / (2.0 * step)


def follow(arm, motion, seconds, velocities=True):
    """Stream a motion to an arm, and let it come to rest.

    Parameters
    ----------
    arm : SimulatedArm
        Where the motion begins.
    motion : Circle
    seconds : float
        [s]
    velocities : bool
        Whether the points have velocities.

    Returns
    -------
    Record
    """
    loop, names = arm.loop, arm.model.joint_names
    begin = loop.simulator.stamp_ns
    with arm.recording() as run:
        while (elapsed := loop.simulator.stamp_ns - begin) < (seconds + 2.0) * 1e9:
            if elapsed % PERIOD_NS == 0 and elapsed < seconds * 1e9:
                time = (elapsed + PERIOD_NS) * 1e-9
                rates = motion.velocity(time).tolist() if velocities else ()
                point = (PERIOD_NS, motion.position(time).tolist(), rates, (), ())
                streaming = loop.controller.streaming
                verdict = loop.controller.offer(
                    validate(names, names, 0, [point], streaming=streaming)
                )
                if not verdict.accepted:
                    raise SystemExit(verdict.reason)
            arm.wait(1e-9 * loop.simulator.period_ns)
    return run.record


def figures(name, start, radius, turn, seconds, velocities):
    """Figures of one stream: peak error [deg], largest step of the reference's speed [rad/s], samples at the limit."""
    settings = ["allow_nonzero_velocity_at_trajectory_end=true"]
    arm = SimulatedArm(name, settings, payload_scale=1.2, stiffness_scale=0.95)
    arm.move(start)
    motion = Circle(arm.model, start, radius, turn, seconds)
    record = follow(arm, motion, seconds, velocities)
    error = np.degrees(np.abs(record.reference - record.position).max())
    step = np.abs(np.diff(record.reference, 2, axis=0)).max() / np.diff(record.time).mean()
    return error, step, int(record.saturated.sum())


def main():
    """Print the table."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    print(
        "| arm | circle | points | peak joint error | steps of the speed, at most | samples at the limit |"
    )
    print("|---|---|---|---|---|---|")
    radius, turn = 0.1, 10.0
    for velocities in (True, False):
        error, step, limit = figures("two_link", [0.3, 1.0], radius, turn, seconds, velocities)
        kind = "positions, velocities" if velocities else "positions"
        print(
            f"| two_link | {1e3 * radius:g} mm in {turn:g} s, {seconds:g} s | {kind} | {error:.2f}° |"
            f" {1e3 * step:.1f} mrad/s | {limit} |"
        )


if __name__ == "__main__":
    main()
