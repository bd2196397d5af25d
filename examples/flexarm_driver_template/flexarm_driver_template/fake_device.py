# SPDX-License-Identifier: Apache-2.0
"""Fake device: a simulated arm in real time behind a pseudo-terminal, with counts and lines as a real device."""

import argparse
import contextlib
import os
import select
import signal
import sys
import time
import tty

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.parameters import check_all
from flexarm_sim import simulator

from . import protocol

#: Scales of its electronics per count: a 20 bit encoder, a bridge of 1 nanostrain, a drive of 1 mN m.
POSITION, STRAIN, TORQUE = 2.0 * np.pi / 2**20, 1e-9, 1e-3  # [rad], [-], [N m] per count
#: Its own watchdog takes the safe action after this time without a torque [s].
WATCHDOG = 0.5
#: Samples that it catches up with after the machine was busy; more are lost [-].
MAX_BEHIND = 200


class FakeDevice:
    """The simulated arm, and the lines that it sends and receives.

    Parameters
    ----------
    arm : str
        Arm file of the arm to simulate.
    rate : float
        Samples per second [Hz].
    ignore_torque : bool
        Simulate a drive without power: torques have no effect.
    """

    def __init__(self, arm, rate, ignore_torque=False):
        settings = check_all(simulator.PARAMETERS, {"arm": arm, "rate": rate})
        n = len(simulator.arm_file.load(arm).joints)
        settings["initial_position"] = n * [0.0]
        self.sim = simulator.Simulator(settings)
        self.period = 1e-9 * self.sim.period_ns
        self.ignore_torque = ignore_torque
        self._torque, self._commanded, self._lines = None, 0, protocol.Lines()

    def receive(self, data):
        """Process received bytes."""
        for line in self._lines.feed(data):
            word, numbers = protocol.unseal(line) or ("", [])
            if word == "T" and len(numbers) == self.sim.torque.size:
                self._torque, self._commanded = TORQUE * np.array(numbers), self.sim.sequence
            elif word == "X":
                self._torque = None

    def sample(self):
        """Advance by one period; the line of the next sample."""
        sim = self.sim
        if (sim.sequence - self._commanded) * self.period > WATCHDOG:
            self._torque = None
        sim.advance(None if self.ignore_torque else self._torque)
        return protocol.seal(
            "S",
            sim.sequence,
            sim.stamp_ns // 1000,
            *np.rint(sim.position / POSITION).astype(int),
            *np.rint(sim.strain / STRAIN).astype(int),
            *np.rint(sim.torque / TORQUE).astype(int),
        )


def serve(device, line, stopped):
    """Send samples on the grid of real time, until `stopped` is not empty."""
    due = time.monotonic()
    while not stopped:
        ready, _, _ = select.select([line], [], [], max(0.0, due - time.monotonic()))
        if ready:
            device.receive(os.read(line, 65_536))
        now = time.monotonic()
        due = max(due, now - MAX_BEHIND * device.period)
        while due <= now:
            with contextlib.suppress(BlockingIOError):  # without a reader the sample is lost
                os.write(line, device.sample())
            due += device.period


def main(args=None):
    """Entry point of ``ros2 run flexarm_driver_template fake_device``."""
    parser = argparse.ArgumentParser(prog="fake_device", description=__doc__)
    parser.add_argument("--arm", default="R", help="arm file of the arm to simulate")
    parser.add_argument("--port", required=True, help="path of the serial line to create")
    parser.add_argument("--rate", type=float, default=200.0, help="samples per second [Hz]")
    parser.add_argument(
        "--ignore-torque", action="store_true", help="simulate a drive without power"
    )
    options = parser.parse_args(args)
    stopped = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.append(True))
    try:
        device = FakeDevice(options.arm, options.rate, options.ignore_torque)
    except FlexarmError as error:
        print(f"fake_device: {error}", file=sys.stderr)
        sys.exit(1)
    line, other = os.openpty()
    tty.setraw(other)
    os.set_blocking(line, False)
    # `other` stays open: without any reader the line would be closed.
    with contextlib.suppress(FileNotFoundError):
        os.unlink(options.port)
    os.symlink(os.ttyname(other), options.port)
    try:
        serve(device, line, stopped)
    finally:
        os.unlink(options.port)
    sys.exit(0)


if __name__ == "__main__":
    main()
