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
#: Its watchdog bites after this time without a torque [s]: twice the driver's own `torque_timeout`.
WATCHDOG = 0.1
#: Samples that it catches up with after the machine was busy; more are lost [-].
MAX_BEHIND = 200


class Watchdog:
    """The device's own timer: it takes the safe action when the driver is silent, killed, stopped or cut off.

    The driver's rules need a driver that runs. **Your device needs such a timer, too**: in the drives' firmware, or in
    a circuit between this computer and the drives' enable input, which each torque line retriggers.

    Parameters
    ----------
    timeout : float
        Without a torque line for this long it bites [s].

    Attributes
    ----------
    bites : int
        How often it has.
    """

    def __init__(self, timeout):
        self.timeout, self.bites = timeout, 0
        self._fed = None  # by a torque line; None: none acts

    def feed(self, now):
        """Note a torque line at a time of the device's clock [s]."""
        self._fed = now

    def rest(self):
        """Note the command to take the safe action: nothing to watch over."""
        self._fed = None

    def bite(self, now):
        """Whether the torque ends now, once for each silence."""
        bites = self._fed is not None and now - self._fed > self.timeout
        if bites:
            self._fed = None
            self.bites += 1
            print(f"watchdog: no torque for {self.timeout:g} s: safe action", flush=True)
        return bites


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
    watchdog : float
        See `Watchdog` [s].
    """

    def __init__(self, arm, rate, ignore_torque=False, watchdog=WATCHDOG):
        settings = check_all(simulator.PARAMETERS, {"arm": arm, "rate": rate})
        n = len(simulator.arm_file.load(arm).joints)
        settings["initial_position"] = n * [0.0]
        self.sim = simulator.Simulator(settings)
        self.period = 1e-9 * self.sim.period_ns
        self.ignore_torque = ignore_torque
        self.watchdog = Watchdog(watchdog)
        self._torque, self._lines = None, protocol.Lines()

    def receive(self, data):
        """Process received bytes."""
        for line in self._lines.feed(data):
            word, numbers = protocol.unseal(line) or ("", [])
            if word == "T" and len(numbers) == self.sim.torque.size:
                self._torque = TORQUE * np.array(numbers)
                self.watchdog.feed(self.sim.time)
            elif word == "X":
                self._torque = None
                self.watchdog.rest()

    def sample(self):
        """Advance by one period; the line of the next sample."""
        sim = self.sim
        if self.watchdog.bite(sim.time):
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
    parser.add_argument(
        "--watchdog", type=float, default=WATCHDOG, help="bites after so long without a torque [s]"
    )
    options = parser.parse_args(args)
    stopped = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.append(True))
    try:
        device = FakeDevice(options.arm, options.rate, options.ignore_torque, options.watchdog)
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
